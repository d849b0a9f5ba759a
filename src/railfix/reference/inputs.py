"""Files that a reference is made of, and choices that do not touch it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import fingerprint
from railfix.run.inputs import Antenna
from railfix.run.sources import TrackReading


@dataclass(frozen=True, kw_only=True)
class ReferenceInputs:
    """Files of a reference.

    Attributes
    ----------
    rtk, rtk_rear : Path or None
        Positions of the front (or only) and of the rear antenna.
    track : tuple of Path
    vehicle : Path or None
    front, rear, nav : tuple of Path
        Observation files of either antenna and navigation files, for Doppler speeds; may be empty.
    pulses, acceleration : Path or None
    """

    track: tuple[Path, ...]
    rtk: Path | None = None
    rtk_rear: Path | None = None
    vehicle: Path | None = None
    front: tuple[Path, ...] = ()
    rear: tuple[Path, ...] = ()
    nav: tuple[Path, ...] = ()
    pulses: Path | None = None
    acceleration: Path | None = None

    @property
    def positions(self) -> dict[Antenna, Path]:
        """Logs of positions by antenna."""
        both: dict[Antenna, Path | None] = {"front": self.rtk, "rear": self.rtk_rear}
        return {name: path for name, path in both.items() if path is not None}

    @property
    def logs(self) -> dict[Antenna, tuple[Path, ...]]:
        """Observation files by antenna."""
        both: dict[Antenna, tuple[Path, ...]] = {"front": self.front, "rear": self.rear}
        return {name: paths for name, paths in both.items() if paths}

    def named(self) -> Iterator[tuple[str, Path]]:
        """Each file with the option that names it."""
        for name in ("rtk", "rtk_rear", "track", "vehicle", "front", "rear", "nav", "pulses", "acceleration"):
            value = getattr(self, name)
            for path in value if isinstance(value, tuple) else (value,):
                if path is not None:
                    yield name.replace("_", "-"), path

    def check(self) -> None:
        """Look at what is asked for before anything is read.

        Raises
        ------
        SettingsError
            No positions, observations without navigation or the other way round, two antennas without a vehicle.
        InputFileError
            A file is missing, or given as both antennas'.
        """
        if not self.positions:
            raise SettingsError("no positions are given; name a log of them with --rtk or --rtk-rear")
        if bool(self.logs) != bool(self.nav):
            raise SettingsError("Doppler speeds need both observations (--front, --rear) and navigation (--nav)")
        if self.vehicle is None and len(set(self.positions) | set(self.logs)) > 1:
            raise SettingsError("front and rear antennas are told apart by the vehicle; name its file with --vehicle")
        for name, path in self.named():
            if not path.is_file():
                raise InputFileError(path, f"there is no such file; check what --{name} names")
        if self.rtk is not None and self.rtk_rear is not None and self.rtk.resolve() == self.rtk_rear.resolve():
            raise InputFileError(self.rtk, "is given as the positions of both antennas; give each its own")

    def fingerprints(self) -> list[dict[str, Any]]:
        """Name, path, size and hash of every file, as plain values."""
        return [fingerprint(name, path) for name, path in self.named()]


@dataclass(frozen=True, kw_only=True)
class ReferenceOptions:
    """Choices that do not touch the reference.

    Attributes
    ----------
    broken_lines : {"stop", "count"}
    overwrite : {"refuse", "replace"}
    track : TrackReading
    date : datetime64 or None
        UTC date of NMEA logs that do not tell it.
    """

    broken_lines: Literal["stop", "count"] = "stop"
    overwrite: Literal["refuse", "replace"] = "refuse"
    track: TrackReading = field(default_factory=TrackReading)
    date: np.datetime64 | None = None
