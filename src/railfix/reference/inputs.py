"""Input files of a reference, and options that do not change it."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

from pydantic import Field

from railfix.core.errors import SettingsError
from railfix.core.files import BrokenLines
from railfix.core.settings import Settings, option
from railfix.run.inputs import (
    Antenna,
    InputFiles,
    check_given_once,
    input_option,
    logs_by_antenna,
    track_option,
    vehicle_option,
)
from railfix.run.options import ColumnNames, TrackReading
from railfix.run.output import Overwrite


class ReferenceInputs(InputFiles):
    """Input files of a reference."""

    #: Positions of the front (or only) and of the rear antenna.
    rtk: Path | None = input_option(
        "Positions of the front (or only) antenna: RTKLIB .pos, NMEA (.nmea) or CSV with named columns.", None
    )
    rtk_rear: Path | None = input_option("The same of the rear antenna.", None)

    track: tuple[Path, ...] = track_option()
    vehicle: Path | None = vehicle_option()
    #: Observation files of either antenna and navigation files, for Doppler speeds; may be empty.
    front: tuple[Path, ...] = input_option(
        "RINEX observation file of the front antenna, for Doppler speeds; repeat it for several.", (), metavar="OBS"
    )
    rear: tuple[Path, ...] = input_option("The same of the rear antenna.", (), metavar="OBS")
    nav: tuple[Path, ...] = input_option("RINEX navigation file, for Doppler speeds; repeat it for several.", ())

    pulses: Path | None = input_option(
        "Tachometer: time_gpst with count, distance_m, or one row per pulse; direction if known.",
        None,
        metavar="CSV",
    )
    acceleration: Path | None = input_option(
        "Acceleration: time_gpst with specific_force_mps2 (as an accelerometer measures) or acceleration_mps2.",
        None,
        metavar="CSV",
    )

    @property
    def positions(self) -> dict[Antenna, Path]:
        """Position logs by antenna."""
        both: dict[Antenna, Path | None] = {"front": self.rtk, "rear": self.rtk_rear}
        return {name: path for name, path in both.items() if path is not None}

    @property
    def logs(self) -> dict[Antenna, tuple[Path, ...]]:
        """Observation files by antenna."""
        return logs_by_antenna(self.front, self.rear)

    def check(self) -> None:
        """Check the input files before anything is read.

        SettingsError: no positions, observations without navigation or the other way round, two antennas without a
        vehicle. InputFileError: a file is missing, or given as both antennas'.
        """
        if not self.positions:
            raise SettingsError("no positions are given; name a log of them with --rtk or --rtk-rear")
        if bool(self.logs) != bool(self.nav):
            raise SettingsError("Doppler speeds need both observations (--front, --rear) and navigation (--nav)")
        if self.vehicle is None and len(set(self.positions) | set(self.logs)) > 1:
            raise SettingsError("two antennas need the vehicle that they are on; name its file with --vehicle")
        self.check_files()
        options = {"front": "--rtk", "rear": "--rtk-rear"}
        check_given_once((options[name], path) for name, path in self.positions.items())
        check_given_once((f"--{name}", path) for name, paths in self.logs.items() for path in paths)


class ReferenceOptions(Settings):
    """Options that do not change the reference."""

    #: Of NMEA logs that have none (UTC), and of RTCM 3 logs (to within half a week).
    date: dt.date | None = option(
        "UTC date of an NMEA log without RMC sentences, or of an RTCM 3 log.", None, metavar="DATE"
    )
    #: What to do with lines that cannot be read.
    broken_lines: BrokenLines = option(
        "Count broken lines of the input files and continue, instead of stopping.", "stop", name="--lenient"
    )

    overwrite: Overwrite = option("Replace results that are already there.", "refuse", name="--overwrite")
    track: TrackReading = Field(default_factory=TrackReading)
    columns: ColumnNames = Field(default_factory=ColumnNames)  #: Of positions in CSV.
