"""The readers as a run needs them: the line with its trajectories, navigation, logs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from railfix.core.errors import SettingsError
from railfix.core.files import BrokenLines
from railfix.gnss.observations import Observations
from railfix.io.logs import scan_observations
from railfix.run.inputs import Antenna
from railfix.run.options import TrackReading
from railfix.track import Track, read_track
from railfix.track.frames import FrameShift, track_at
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import Vehicle, antenna_trajectory, read_vehicle


@dataclass(frozen=True, kw_only=True)
class Line:
    """The line and the path of each antenna on it.

    Attributes
    ----------
    track : Track
    vehicle : Vehicle or None
    trajectories : dict of str to Trajectory
    frame : FrameShift or None
        How the track was moved to the frame of the satellites; None where no time was given.
    """

    track: Track
    vehicle: Vehicle | None
    trajectories: dict[str, Trajectory]
    frame: FrameShift | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the map, the vehicle and the trajectories, each once."""
        notes = [note for trajectory in self.trajectories.values() for note in trajectory.notes]
        return tuple(dict.fromkeys([*notes, *self.track.provenance.notes, *(self.frame.notes if self.frame else ())]))

    @property
    def facts(self) -> dict[str, Any]:
        """Plain values for JSON."""
        track, provenance = self.track, self.track.provenance
        return {
            "track": {
                "name": track.name,
                "points": len(track),
                "length_m": round(float(track.chainage_m[-1]), 3),
                "sections": list(track.sections),
                "sigma_plan_m": track.sigma_plan_m,
                "sigma_height_m": track.sigma_height_m,
                "crs": provenance.crs,
                "frame": None if self.frame is None else self.frame.facts,
                "height_datum_asked": provenance.height_datum_asked,
                "height_datum_used": provenance.height_datum_used,
                "geoid": provenance.geoid,
            },
            "vehicle": None if self.vehicle is None else self.vehicle.model_dump(mode="json"),
            "chainage_of": {name: trajectory.reference for name, trajectory in self.trajectories.items()},
        }


def open_line(
    track: tuple[Path, ...],
    vehicle: Path | None,
    *,
    antennas: tuple[Antenna, ...],
    reading: TrackReading,
    at: np.datetime64 | None = None,
) -> Line:
    """Read the track and the vehicle, and compute the path of each antenna.

    With a time `at` the track is moved to the frame of the satellites then (`railfix.track.frames`); without it
    the coordinates stay in the map's own frame.

    Raises
    ------
    InputFileError, SettingsError, MismatchError
        A file is not what it should be, or track and vehicle do not fit.
    """
    centreline = read_track(track, crs=reading.crs, height_datum=reading.height_datum, geoid=reading.geoid)
    shift = None
    if at is not None:
        centreline, shift = track_at(centreline, at, epoch=reading.map_epoch, plate=reading.plate)
    if vehicle is None:
        if reading.reference != "antenna":
            raise SettingsError(
                f"the chainage of {reading.reference} was asked for, which only a vehicle file can give; name one"
            )
        path = Trajectory.from_track(centreline)
        return Line(track=centreline, vehicle=None, trajectories=dict.fromkeys(antennas, path), frame=shift)
    body = read_vehicle(vehicle)
    return Line(
        track=centreline,
        vehicle=body,
        trajectories={n: antenna_trajectory(centreline, body, n, reference=reading.reference) for n in antennas},
        frame=shift,
    )


@dataclass(kw_only=True)
class Log:
    """The files of one antenna's log, read piece by piece.

    Attributes
    ----------
    paths : tuple of Path
    chunk_epochs : int
    broken_lines : {"stop", "count"}
    start, end : datetime or None
        First epoch, and the time before which the last one lies.
    share : float
        Part of the files that has been read, 0 to 1.
    problems : list of str
        Sentences on what was broken and passed over.
    skipped : Counter of str
        Skipped items, counted by kind.
    """

    paths: tuple[Path, ...]
    chunk_epochs: int
    broken_lines: BrokenLines = "stop"
    start: datetime | None = None
    end: datetime | None = None
    share: float = 0.0
    problems: list[str] = field(default_factory=list)
    skipped: Counter[str] = field(default_factory=Counter)

    def parts(self) -> Iterator[Observations]:
        """Pieces of the log in order of time.

        Raises
        ------
        InputFileError, MismatchError
            See `railfix.io.rinex.scan_observations`.
        """
        pieces = scan_observations(
            self.paths,
            epochs=self.chunk_epochs,
            broken_lines=self.broken_lines,
            start=None if self.start is None else np.datetime64(self.start, "ns"),
            end=None if self.end is None else np.datetime64(self.end, "ns"),
            progress=self._read_to,
        )
        for piece in pieces:
            self.problems += piece.problems
            self.skipped.update(piece.skipped)
            if len(piece):
                yield piece

    def _read_to(self, share: float) -> None:
        self.share = share
