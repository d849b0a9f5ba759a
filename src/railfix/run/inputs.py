"""Input files of a run, with checks and hashes, and options of a run."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar, Final, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import BrokenLines, Reader, fingerprint, path_names
from railfix.core.options import option
from railfix.core.settings import INPUTS, Settings
from railfix.io.file_kind import find_kind
from railfix.io.position_log import column_names
from railfix.pipeline.config import Config
from railfix.run.mate_folder import find_inputs
from railfix.run.output import Overwrite
from railfix.track.frames import MapMotion
from railfix.track.route import MapReading
from railfix.track.vehicle import Reference

#: Value of `RunInputs.heights` that selects the heights of the log's own positions.
OF_LOG = Path("log")
Antenna = Literal["front", "rear"]


def input_option(text: str, default: Any = ..., *, metavar: str = "FILE") -> Any:
    """Return a settings field for a command-line option that accepts one or several input files."""
    return option(text, default, metavar=metavar, panel=INPUTS)


#: Help texts of options that several commands share.
NAVIGATION: Final = (
    "Navigation file: RINEX, or a receiver's log; may be repeated. Without this option, the ephemerides in the "
    "receiver's log itself "
    "are used."
)
TRACK: Final = (
    "Track map; several files are joined to a route in the given order. In a single file with a network of tracks, the "
    "route is found from the log."
)
VEHICLE: Final = (
    "Vehicle file with bogie distance, gauge and antenna positions. Without it, the antenna is assumed to move along "
    "the mapped track itself."
)
BALISE_LIST: Final = (
    "Positions of the balises: CSV with balise, chainage_m and, if known, sigma_m and track (chainage_m is then "
    "measured from the beginning of that track)."
)
VIRTUAL_BALISES: Final = (
    "List of virtual balises, in the format of --balise-list: points on the line whose passing times are reported "
    "with bounds. Requires protection levels."
)


class InputFiles(Settings):
    """Input files of a command; each field is a path, several paths, or None."""

    #: Names of the fields with logs. Ephemerides in receiver logs are used if no navigation file is given.
    own_navigation: ClassVar[tuple[str, ...]] = ()

    @model_validator(mode="before")
    @classmethod
    def _with_own_navigation(cls, values: Any) -> Any:
        """Return the inputs, with the receiver logs as navigation files if no navigation file is given."""
        if not cls.own_navigation or not isinstance(values, dict) or values.get("nav"):
            return values
        logs = [Path(path) for name in cls.own_navigation if values.get(name) for path in path_names(values[name])]
        own = tuple(path for path in logs if path.is_file() and find_kind(path) == "receiver")
        if logs and not own:
            raise ValueError("nav (--nav) is missing; give the navigation file, which RINEX observations need")
        return {**values, "nav": own}

    def files_by_name(self) -> Iterator[tuple[str, Path]]:
        """Yield the field name and the path of each file."""
        for name in type(self).model_fields:
            value = getattr(self, name)
            for path in value if isinstance(value, tuple) else (value,):
                if path is not None and (name, path) != ("heights", OF_LOG):
                    yield name, path

    @property
    def paths(self) -> tuple[Path, ...]:
        """Paths of all files."""
        return tuple(path for _, path in self.files_by_name())

    def check_files(self) -> None:
        """Raise InputFileError if a file is missing, is a folder, or cannot be read."""
        for name, path in self.files_by_name():
            _check_file(f"--set {name}" if name == "integrity_support" else f"--{name.replace('_', '-')}", path)

    def entries(self, pool: Executor, folder: Path) -> Entries:
        """Let the executor `pool` compute the `fingerprint` of each file, with paths relative to `folder`."""
        return [
            pool.submit(fingerprint, kind, path, name=record_path(path, folder)) for kind, path in self.files_by_name()
        ]


Entries = Sequence[Future[dict[str, Any]]]


class RunInputs(InputFiles):
    """Input files of a run. Command-line options specify most files; the settings name the others."""

    own_navigation = ("front", "rear")
    front: tuple[Path, ...] = input_option(
        "Observation file of the front (or only) antenna; may be repeated for a log in several files.",
        (),
        metavar="OBS",
    )
    nav: tuple[Path, ...] = input_option(NAVIGATION, ())
    track: tuple[Path, ...] = input_option(TRACK, (), metavar="TRACK")
    mate: Path | None = input_option(
        "Folder with EGNSS MATE tables, used instead of --front, --track and the sensor options; if one of these "
        "options is given, its file replaces the table.",
        None,
        metavar="FOLDER",
    )
    rear: tuple[Path, ...] = input_option(
        "Observation file of the rear antenna, if there is one; may be repeated.", (), metavar="OBS"
    )
    base: tuple[Path, ...] = input_option(
        "Observations of a base station, whose range errors are subtracted from the train's ranges; may be repeated.",
        (),
        metavar="OBS",
    )
    sp3: tuple[Path, ...] = input_option("Precise orbits and clocks, used instead of broadcast orbits and clocks.", ())
    heights: Path | None = input_option(
        "Heights for a map without heights: a raster (GeoTIFF, ESRI ASCII grid, SRTM), CSV with chainage_m or "
        "kilometrage_m, "
        "positions of a run, or the word log for the heights of the log's own positions.",
        None,
    )
    vehicle: Path | None = input_option(VEHICLE, None, metavar="TOML")
    tachometer: Path | None = input_option(
        "Pulses of a tachometer: CSV or Parquet with time_gpst, pulse and, if known, direction; "
        "the settings sensors.tachometer describe the wheel.",
        None,
    )
    inertial: Path | None = input_option("Specific forces and angular rates of an inertial unit: CSV or Parquet.", None)
    radar: Path | None = input_option("Speeds of a Doppler radar: CSV or Parquet with time_gpst, speed_mps.", None)
    ranging: Path | None = input_option(
        "Two-way ranges to ground units: CSV or Parquet with time_gpst, unit, range_m and, if known, sigma_m.",
        None,
    )
    ranging_units: Path | None = input_option("Surveyed ground units: CSV with unit, x_m, y_m, z_m (ECEF).", None)
    balises: Path | None = input_option(
        "Balises read by the train: CSV or Parquet with time_gpst, balise and, if known, sigma_m.", None
    )
    balise_list: Path | None = input_option(BALISE_LIST, None, metavar="CSV")
    virtual_balises: Path | None = input_option(VIRTUAL_BALISES, None, metavar="CSV")
    config: Path | None = None
    cn0_curve: Path | None = None
    error_model: Path | None = None
    integrity_support: Path | None = None
    sbas: tuple[Path, ...] = ()
    truth: Path | None = input_option(
        "Reference positions: CSV with named columns (including `antenna` if there are two antennas) or RTKLIB .pos; "
        "if the file has a quality for each position, only positions of quality 1 are used.",
        None,
        metavar="POSITIONS",
    )

    @model_validator(mode="before")
    @classmethod
    def _with_mate(cls, values: Any) -> Any:
        """Return the inputs with the tables in the folder `mate`. Explicitly specified inputs take precedence."""
        if not isinstance(values, dict) or values.get("mate") is None:
            return values
        given = {name: value for name, value in values.items() if name != "mate" and value not in (None, ())}
        return {**find_inputs(Path(values["mate"])), **given}

    @model_validator(mode="after")
    def _complete(self) -> Self:
        missing = [name for name in ("front", "track") if not getattr(self, name)]
        if missing:
            raise ValueError(f"{missing[0]} (--{missing[0]}) is missing; give its file, or use --mate FOLDER")
        return self

    def prepare(self, config: Config) -> tuple[Self, Config]:
        """Check the inputs, and add the files that settings name. In the returned settings, `sbas` is not "stream"."""
        self.check()
        config = self._with_own_sbas(config)
        inputs = self.with_settings(config)
        inputs.check()
        return inputs, config

    def with_settings(self, config: Config) -> Self:
        """Return the inputs, with the files that settings name."""
        models = {name: getattr(config, name) for name in ("cn0_curve", "error_model", "integrity_support")}
        return self.replaced(**models, sbas=() if config.sbas == "stream" else config.sbas)

    def _with_own_sbas(self, config: Config) -> Config:
        """Return the settings with ``sbas = "stream"`` replaced by the receiver logs, which contain SBAS messages.

        Raise SettingsError if all logs are RINEX files.
        """
        if config.sbas != "stream":
            return config
        logs = tuple(path for paths in self.logs.values() for path in paths if find_kind(path) == "receiver")
        if not logs:
            raise SettingsError(
                "sbas = stream: RINEX logs contain no SBAS messages; give a log of SBAS messages (--sbas FILE)"
            )
        return config.replaced(sbas=logs)

    @property
    def logs(self) -> dict[Antenna, tuple[Path, ...]]:
        """Observation files by antenna."""
        return logs_by_antenna(self.front, self.rear)

    def check(self) -> None:
        """Raise InputFileError if a file is missing or cannot be read, or if a log or track file is specified twice."""
        self.check_files()
        logs = [("base", self.base), *self.logs.items()]
        check_given_once((f"--{name}", path) for name, paths in logs for path in paths)
        check_given_once(("--track", path) for path in self.track)


def logs_by_antenna(front: tuple[Path, ...], rear: tuple[Path, ...]) -> dict[Antenna, tuple[Path, ...]]:
    """Return the observation files by antenna. Antennas without files are omitted."""
    both: dict[Antenna, tuple[Path, ...]] = {"front": front, "rear": rear}
    return {name: paths for name, paths in both.items() if paths}


def check_given_once(files: Iterable[tuple[str, Path]]) -> None:
    """Raise InputFileError if a file is specified twice. `files` are pairs of option name and path."""
    seen: dict[Path, tuple[str, Path]] = {}
    for name, path in files:
        resolved = path.resolve()
        if resolved in seen:
            option_name, first = seen[resolved]
            raise InputFileError(path, f"is given twice ({option_name} {first} and {name} {path}); give each file once")
        seen[resolved] = (name, path)


def record_path(path: Path, folder: Path) -> str:
    """Return the path of an input for the record. Relative paths are recorded relative to the results folder."""
    if path.is_absolute():
        return str(path)
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def input_path(entry: Mapping[str, Any], folder: Path) -> Path:
    """Return the present path of a recorded input. A relative recorded path is relative to the results folder."""
    path = folder / str(entry["path"])
    plain = Path(os.path.normpath(path))
    return plain if plain.exists() or not path.exists() else path


def _check_file(name: str, path: Path) -> None:
    try:
        if path.is_dir():
            raise InputFileError(path, f"is a folder, {name} expects a file; give the file in it")
        if not path.is_file():
            problem = "is not a regular file" if path.exists() else "there is no such file"
            raise InputFileError(path, f"{problem}; check the path given by {name}")
        with path.open("rb") as file:
            file.read(1)
    except OSError as error:
        raise InputFileError(path, f"cannot be read ({error.strerror}); check the path given by {name}") from error


#: Last full year that 64-bit times in nanoseconds can represent.
LAST_YEAR: Final = 2261


class TrackReading(Settings):
    """Options for reading the track, and the vehicle's reference point for the chainage."""

    crs: str | None = option("CRS of the track, if its file does not state it.", None, metavar="EPSG")
    height_datum: str | None = option("Height datum of the track: ellipsoidal or orthometric.", None, metavar="DATUM")
    geoid: str | None = option(
        "Geoid of orthometric heights: egm96 (worldwide), japan (JPGEO2024), gsigeo2011, or a grid or CRS of PROJ.",
        None,
        metavar="MODEL",
    )
    plan_sigma: float | None = option(
        "Standard deviation of the track in plan, instead of the value in its file (for OpenStreetMap, 2 m "
        "if the file states none).",
        None,
        metavar="M",
        gt=0,
        le=1000.0,
    )
    height_sigma: float | None = option(
        "Standard deviation of the track's heights, instead of the value in its file; required for a raster.",
        None,
        metavar="M",
        gt=0,
        le=1000.0,
    )
    map_epoch: float | None = option(
        "Epoch of the track's coordinates, if its frame is an ITRF or is fixed at an epoch (JGD2011).",
        None,
        metavar="YEAR",
        gt=1980.0,
        lt=2100.0,
    )
    plate: str | None = option(
        "Tectonic plate whose motion converts the track's coordinates from their epoch to the time of the log.",
        None,
        metavar="NAME",
    )
    jgd_parameters: Path | None = option(
        "Semi-dynamic correction parameters (.par) that transform a map in JGD2011 to the epoch given by --map-epoch.",
        None,
        metavar="FILE",
    )
    reference: Reference = option("Point of the vehicle to which the chainage refers.", "antenna")

    @property
    def of_map(self) -> MapReading:
        """Options of the map readers."""
        return MapReading(crs=self.crs, height_datum=self.height_datum, geoid=self.geoid, sigma_plan_m=self.plan_sigma)

    @property
    def motion(self) -> MapMotion:
        """Arguments for transforming the track to the reference frame of the satellites."""
        return {"epoch": self.map_epoch, "plate": self.plate, "parameters": self.jgd_parameters}

    cache: Literal["use", "skip"] = option(
        "Prepare the line without reading or writing the cache folder.", "use", name="--no-cache"
    )


class LogReading(Settings):
    """Options for reading logs and navigation files, shared by all commands."""

    date: datetime | None = option(
        "GPS time within half a week of the beginning of the log. It is required for RTCM 3 logs without ephemerides, "
        "whose observations do not contain the week.",
        None,
        metavar="TIME",
    )
    broken_lines: BrokenLines = option(
        "Skip and count broken parts of the input files, instead of stopping with an error. Irregularities without "
        "loss of data are accepted without this option: comments, repeated headers, duplicate or exchanged "
        "epochs, an incomplete last record.",
        "stop",
        name="--lenient",
    )

    reader: Reader = option(
        "Reader of RINEX observation files: railfix, or georinex, an independent reader for comparison, "
        "which is slower, reads whole files at once, and supports neither events nor broken lines.",
        "railfix",
    )

    @property
    def arguments(self) -> dict[str, Any]:
        """Keyword arguments for the readers of position logs and navigation files."""
        return {"date": self.instant, "broken_lines": self.broken_lines}

    @property
    def of_observations(self) -> dict[str, Any]:
        """Keyword arguments for the readers of observations."""
        return {**self.arguments, "reader": self.reader}

    @property
    def instant(self) -> np.datetime64 | None:
        """`date` as numpy time, as the readers require, or None if `date` is None."""
        return None if self.date is None else np.datetime64(self.date.replace(tzinfo=None), "ns")


class ColumnNames(Settings):
    """Options for reading position logs: column names of tables, and the fields of `LogReading`."""

    column: tuple[str, ...] = option(
        "Name of a column in CSV positions, as in time_utc=Timestamp; may be repeated. Quantities: time_gpst, "
        "time_utc, unix_s, or week and tow_s; latitude_deg, longitude_deg, height_m, or x_m, y_m, z_m; antenna, "
        "chainage_m, quality, ...",
        (),
        metavar="NAME=COLUMN",
    )

    logs: LogReading = Field(default_factory=LogReading)

    @property
    def arguments(self) -> dict[str, Any]:
        """Keyword arguments for `railfix.io.read_positions`."""
        return {"columns": self.names, **self.logs.arguments}

    @property
    def names(self) -> dict[str, str]:
        """For each quantity, its column in the file. Raise SettingsError if a text is not NAME=COLUMN."""
        return column_names(self.column)


class RunOptions(Settings):
    """Options of a run, in addition to the settings (`Config`)."""

    start: datetime | None = option("GPS time from which epochs are processed.", None, metavar="TIME")
    end: datetime | None = option("GPS time before which epochs are processed.", None, metavar="TIME")
    base_place: str | None = option(
        "Position of the base station in the frame of the satellites; by default from the header of its log.",
        None,
        metavar="LAT,LON,HEIGHT",
    )
    observations: Literal["skip", "write"] = option(
        "Also write observations.parquet, with one row per epoch, satellite and signal, and its rejection reason.",
        "skip",
        name="--observations",
    )
    overwrite: Overwrite = option("Replace existing results.", "refuse", name="--overwrite")
    chunk_epochs: int = option(
        "Number of epochs processed together in memory; results do not depend on it.",
        4000,
        name="--chunk",
        metavar="EPOCHS",
        ge=1,
    )
    smooth: Literal["off", "on"] = option(
        "Also write smoothed positions, from all measurements before and after each epoch, to columns of train.*",
        "off",
        name="--smooth",
    )
    track: TrackReading = Field(default_factory=TrackReading)
    logs: LogReading = Field(default_factory=LogReading)

    @property
    def of_filter(self) -> list[str]:
        """Names of the selected options that require the along-track filter."""
        return ["smooth"] if self.smooth == "on" else []

    @field_validator("start", "end")
    @classmethod
    def _within_gps_time(cls, value: datetime | None) -> datetime | None:
        if value is not None and not 1980 <= value.year <= LAST_YEAR:
            raise ValueError(f"a GPS time from 1980 to {LAST_YEAR} was expected")
        return value

    @model_validator(mode="after")
    def _start_before_end(self) -> Self:
        if self.start is not None and self.end is not None and self.start >= self.end:
            raise ValueError(f"--start {self.start} is not before --end {self.end}; give an earlier start")
        return self
