"""Read the inputs of a reference, and write ``reference.csv``, ``fixes.csv`` and ``reference.json``."""

from __future__ import annotations

import platform
import sys
import time as clock
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from pydantic import Field

from railfix import __version__
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.gnss.joined_observations import concatenate
from railfix.io.logs import read_navigation
from railfix.io.position_log import PositionLog
from railfix.io.positions import read_positions
from railfix.io.reference_log import read_acceleration, read_pulses, reference_table
from railfix.positioning.doppler_speed import Dopplers, dopplers_of_log
from railfix.ranges.channels import DEFAULT_SIGNALS
from railfix.reference.build import ReferenceData, build_references
from railfix.reference.fixes import FixRejection, ReferenceSettings
from railfix.reference.smoother import Built
from railfix.run.inputs import (
    TRACK,
    VEHICLE,
    Antenna,
    ColumnNames,
    InputFiles,
    LogReading,
    TrackReading,
    check_given_once,
    input_option,
    logs_by_antenna,
)
from railfix.run.output import OutputFolder, Overwrite
from railfix.run.sources import Log, OpenedLine, open_line
from railfix.track.trajectory import Trajectory


class ReferenceInputs(InputFiles):
    """Input files of a reference."""

    rtk: Path | None = input_option(
        "Positions of the front (or only) antenna: RTKLIB .pos, NMEA (.nmea) or CSV with named columns.", None
    )
    rtk_rear: Path | None = input_option("Positions of the rear antenna, in the same formats.", None)

    track: tuple[Path, ...] = input_option(TRACK, metavar="TRACK")
    vehicle: Path | None = input_option(VEHICLE, None, metavar="TOML")
    front: tuple[Path, ...] = input_option(
        "RINEX observation file of the front antenna, for Doppler speeds; may be repeated.", (), metavar="OBS"
    )
    rear: tuple[Path, ...] = input_option(
        "RINEX observation file of the rear antenna, for Doppler speeds; may be repeated.", (), metavar="OBS"
    )
    nav: tuple[Path, ...] = input_option("RINEX navigation file, for Doppler speeds; may be repeated.", ())

    pulses: Path | None = input_option(
        "Tachometer table: time_gpst with count or distance_m, or one row per pulse; direction is optional.",
        None,
        metavar="CSV",
    )
    acceleration: Path | None = input_option(
        "Acceleration table: time_gpst and specific_force_mps2 (measured by an accelerometer) or acceleration_mps2.",
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
        """Raise SettingsError or InputFileError if the input files are incomplete or unusable."""
        if not self.positions:
            raise SettingsError("no positions are given; name a position log with --rtk or --rtk-rear")
        if bool(self.logs) != bool(self.nav):
            raise SettingsError("Doppler speeds need both observations (--front, --rear) and navigation (--nav)")
        if self.vehicle is None and len(set(self.positions) | set(self.logs)) > 1:
            raise SettingsError("two antennas need a vehicle; name its file with --vehicle")
        self.check_files()
        options = {"front": "--rtk", "rear": "--rtk-rear"}
        check_given_once((options[name], path) for name, path in self.positions.items())
        check_given_once((f"--{name}", path) for name, paths in self.logs.items() for path in paths)


class ReferenceOptions(Settings):
    """Options that do not affect the reference."""

    logs: LogReading = Field(default_factory=LogReading)
    overwrite: Overwrite = option("Replace existing results.", "refuse", name="--overwrite")
    track: TrackReading = Field(default_factory=TrackReading)
    columns: ColumnNames = Field(default_factory=ColumnNames)  #: Column names of position logs in CSV.


def fixes_table(name: str, part: Built, trajectory: Trajectory) -> pl.DataFrame:
    """Return one antenna's rows of ``fixes.csv``, rounded to 0.1 mm."""
    fixes = part.fixes
    words = {int(code): FixRejection(int(code)).text or "good" for code in np.unique(fixes.rejection)}
    table = pl.DataFrame(
        {
            "time_gpst": fixes.time,
            "antenna": np.full(len(fixes), name),
            "verdict": [words[code] for code in fixes.rejection.tolist()],
            "quality": fixes.quality,
            "ratio": fixes.ratio,
            "chainage_m": trajectory.chainage_at(fixes.arc_m),
            "lateral_m": fixes.lateral_m,
            "height_m": fixes.height_m,
            "spacing_m": fixes.spacing_m,
            "travel_m": fixes.travel_m,
            "sigma_m": fixes.sigma_m,
        }
    )
    return table.with_columns(pl.col(pl.Float64).round(4).fill_nan(None))


def antenna_record(part: Built) -> dict[str, Any]:
    """Return one antenna's entry in ``reference.json``, as plain values."""
    reference = part.reference
    sigma = reference.sigma_m[reference.source == "bridged"]
    return {
        "positions": len(part.fixes),
        "verdicts": part.fixes.counts(),
        "instants": {source: int((reference.source == source).sum()) for source in ("rtk", "bridged")},
        "left_out": part.left_out,
        "bridged_by": part.bridged_by,
        "bridged_sigma_m": None
        if not len(sigma)
        else {"p50": float(np.median(sigma)), "p95": float(np.percentile(sigma, 95)), "max": float(sigma.max())},
        "gaps": [
            {
                "start": np.datetime_as_string(gap.start, unit="ms"),
                "end": np.datetime_as_string(gap.end, unit="ms"),
                "length_s": gap.length_s,
                "bridged": gap.bridged,
            }
            for gap in part.gaps
        ],
        **part.facts,
    }


SYSTEMS: Final = ("G", "J", "E", "C", "R")  #: Constellations whose Dopplers are used.
_CHUNK: Final = 3000  #: Number of epochs of an observation log that are read together.
_NAMED: Final = 5  #: The notes list at most this number of gaps.


@dataclass(frozen=True, kw_only=True)
class ReferenceSummary:
    """Reference trajectories of a run, notes on them, and the written files."""

    built: Mapping[str, Built]  #: Reference with its fixes and gaps, by antenna.
    notes: tuple[str, ...]
    files: Mapping[str, Path]  #: Paths by file name.


def reference_files(
    inputs: ReferenceInputs,
    settings: ReferenceSettings | None = None,
    *,
    out: Path,
    options: ReferenceOptions | None = None,
    asked: Mapping[str, Any] | None = None,
) -> ReferenceSummary:
    """Build the reference of a run, and write it into the folder `out`.

    ================== ======================================================================
    reference.csv      `railfix.io.reference_log`, one row per instant and antenna
    fixes.csv          every row of the position logs, with its reasons for rejection
    reference.json     versions, hashes of the inputs, settings, counts by reason, gaps
    ================== ======================================================================

    The settings that the user specified explicitly, `asked`, are recorded in ``reference.json``. If a RailfixError is
    raised (see `railfix.core.errors`), no new files remain in `out`.
    """
    began = clock.perf_counter()
    settings, options = settings or ReferenceSettings(), options or ReferenceOptions()
    inputs.check()
    with (
        OutputFolder(out, overwrite=options.overwrite, inputs=inputs.paths) as folder,
        ThreadPoolExecutor(max_workers=1) as pool,
    ):
        entries = inputs.entries(pool, out)
        wanted: tuple[Antenna, ...] = ("front", "rear")
        antennas = tuple(name for name in wanted if name in inputs.positions or name in inputs.logs)
        line = open_line(inputs.track, inputs.vehicle, antennas=antennas, reading=options.track)
        data, notes = _read(inputs, line, options)
        built = build_references(data, settings)
        for name, part in built.items():
            notes += _notes(name, part, settings)
        notes = list(dict.fromkeys([*line.notes, *notes]))
        folder.append_csv("reference.csv", reference_table({name: part.reference for name, part in built.items()}))
        for name, part in built.items():
            folder.append_csv("fixes.csv", fixes_table(name, part, line.trajectories[name]))
        record = {
            "versions": {"railfix": __version__, "python": platform.python_version()},
            "command": list(sys.argv),
            "inputs": [entry.result() for entry in entries],
            "settings_asked": dict(asked or {}),
            "settings_used": settings.model_dump(mode="json"),
            "line": line.facts,
            "notes": notes,
            "antennas": {name: antenna_record(part) for name, part in built.items()},
            "wall_s": round(clock.perf_counter() - began, 3),
        }
        folder.write_json("reference.json", record)
        files = folder.commit()
    return ReferenceSummary(built=built, notes=tuple(notes), files=files)


def _read(inputs: ReferenceInputs, line: OpenedLine, options: ReferenceOptions) -> tuple[ReferenceData, list[str]]:
    """Read all files except the track files."""
    logs: dict[str, PositionLog] = {
        name: read_positions(path, **options.columns.arguments) for name, path in inputs.positions.items()
    }
    notes = [note for log in logs.values() for note in log.notes]
    unrated = [log.path for log in logs.values() if not log.has_quality]
    notes += [f"{path} has no column of solution quality; every row is assumed to be an RTK fix" for path in unrated]
    dopplers: dict[str, Dopplers] = {}
    if inputs.logs:
        navigation = read_navigation(inputs.nav, **options.logs.arguments)
        for name, paths in inputs.logs.items():
            log = Log(paths=paths, chunk_epochs=_CHUNK, reading=options.logs)
            antenna_dopplers = dopplers_of_log(
                concatenate(list(log.parts())), navigation, systems=SYSTEMS, signals=DEFAULT_SIGNALS
            )
            notes += log.problems
            if np.isfinite(antenna_dopplers.rate_mps).any():
                dopplers[name] = antenna_dopplers
                continue
            problem = "has no Doppler observation of a satellite with a navigation record"
            if inputs.pulses is None and inputs.acceleration is None:
                raise InputFileError(
                    paths[0],
                    f"{problem}; provide a log with Doppler (D) observations and its navigation file, or use another "
                    "sensor",
                )
            notes.append(f"{paths[0]}: {problem}; no speed is computed from this log")
    vehicle = line.vehicle
    distance, facing = float("nan"), 1
    if vehicle is not None:
        facing = 1 if vehicle.facing == "rising" else -1
        if len(vehicle.antennas) == 2:
            first, second = (np.array([a.along_m, a.across_m, a.up_m]) for a in vehicle.antennas.values())
            distance = float(np.linalg.norm(first - second))
    elif inputs.acceleration is not None:
        notes.append("no vehicle file: the accelerometer is assumed to face rising chainage")
    data = ReferenceData(
        logs=logs,
        trajectories=line.trajectories,
        dopplers=dopplers,
        pulses=None if inputs.pulses is None else read_pulses(inputs.pulses),
        acceleration=None if inputs.acceleration is None else read_acceleration(inputs.acceleration),
        facing=facing,
        distance_m=distance,
    )
    return data, notes


def _notes(name: str, part: Built, settings: ReferenceSettings) -> list[str]:
    """Return notes on gaps without a reference, uncertain instants, and positions that were not checked."""
    notes = []
    long = [gap for gap in part.gaps if not gap.bridged]
    if long:
        total = sum(gap.length_s for gap in long)
        named = [f"{np.datetime_as_string(gap.start, unit='s')} ({gap.length_s:.0f} s)" for gap in long[:_NAMED]]
        more = [f"{len(long) - _NAMED} more"] if len(long) > _NAMED else []
        limit = f"{len(long)} gaps of over {settings.max_gap_s:g} s are left out, {total:.0f} s in total"
        notes.append(f"{name}: {limit}: {', '.join(named + more)}")
    if count := part.left_out["uncertain"]:
        notes.append(
            f"{name}: {count} bridged instants with a standard deviation above {settings.max_sigma_m:g} m are left out"
        )
    if alone := part.bridged_by.get("nothing"):
        notes.append(f"{name}: {alone} instants are bridged by the motion model alone, without a sensor")
    if np.isnan(part.fixes.travel_m).all():
        notes.append(f"{name}: no sensor measured the distance between fixes, so it was not checked")
    return notes
