"""Tables of the sensors on board as samples, and their parts by time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Strings, join_rows
from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.files import read_bytes
from railfix.core.tables import reading_table
from railfix.io.mate import mate_table
from railfix.motion.samples import GroundUnits, ListedBalises, Samples, SensorSamples
from railfix.pipeline.config import Config
from railfix.run.convert import sensor_table
from railfix.track import Track
from railfix.track.track import section_spans

#: Columns of each table besides ``time_gpst``, as `railfix simulate` writes them; those in brackets may be absent.
COLUMNS: Final[Mapping[str, tuple[str, ...]]] = {
    "tachometer": ("pulse", "[direction]"),
    "inertial": (
        "force_forward_mps2", "force_right_mps2", "force_down_mps2", "roll_rate_radps", "pitch_rate_radps",
        "yaw_rate_radps",
    ),
    "radar": ("speed_mps",),
    "ranging": ("unit", "range_m", "[sigma_m]"),
    "ranging_units": ("unit", "x_m", "y_m", "z_m"),
    "balises": ("balise", "[sigma_m]"),
    "list of balises": ("balise", "chainage_m", "[track]", "[sigma_m]"),
}  # fmt: skip


#: Class of the samples of each sensor.
_CLASSES: Final = {name: type(samples) for name, samples in SensorSamples().tables.items()}
#: Sensors that may be silent for some time, which rows with the time alone report.
_SILENT: Final = ("tachometer", "ranging", "balises")
#: Tables without a time, and columns of names.
_TIMELESS: Final = ("ranging_units", "list of balises")
_NAMES: Final = ("unit", "balise", "track")


def read_sensors(
    *,
    tachometer: Path | None = None,
    inertial: Path | None = None,
    radar: Path | None = None,
    ranging: Path | None = None,
    balises: Path | None = None,
) -> SensorSamples:
    """Read the tables of the sensors, CSV (also .gz) or Parquet; a sensor without a file has no samples.

    InputFileError: a file is no such table, or its times are not in order.
    """
    paths = {
        "tachometer": tachometer, "inertial": inertial, "radar": radar, "ranging": ranging, "balises": balises
    }  # fmt: skip
    samples: dict[str, Any] = {}
    for sensor, path in paths.items():
        if path is not None:
            table = _table(path, sensor)
            columns = {name: _column(path, table, name) for name in _names_of_columns(sensor)}
            samples[sensor] = make_samples(sensor, _times(table), columns)
    return SensorSamples(**samples)


def make_samples(sensor: str, time: Datetimes, columns: Mapping[str, NDArray[Any]]) -> Samples:
    """Return samples from all columns of the table of a sensor but the time; NaN where a number is absent."""
    values = dict(columns)
    if sensor == "tachometer":
        values = {name: np.nan_to_num(column).astype(np.int64) for name, column in columns.items()}
    elif sensor == "inertial":
        six = np.stack([columns[name] for name in COLUMNS["inertial"]], axis=1)
        values = {"force_mps2": six[:, :3], "rate_radps": six[:, 3:]}
    elif sensor == "ranging":
        values["station"] = values.pop("unit")
    return _CLASSES[sensor](time=time, **values)


def units_of_ranges(samples: SensorSamples, units: Path | None, *, ranging: Path | str | None) -> GroundUnits | None:
    """Read the ground units that ranges, a table or a stream, are measured to; None without ranges.

    InputFileError: no such table. MismatchError: a range is to a unit that it does not have. SettingsError: one of the
    two is given without the other.
    """
    if ranging is None and units is not None:
        raise SettingsError("--ranging-units is given without --ranging; give the ranges, or leave the units out")
    if ranging is not None and units is None:
        raise SettingsError("--ranging needs --ranging-units, the surveyed positions of the ground units")
    surveyed = None if units is None else read_units(units)
    if surveyed is not None:
        missing = sorted(set(samples.ranging.station.tolist()) - set(surveyed.name.tolist()))
        if missing:
            raise MismatchError(f"ranges name the ground unit {missing[0]}, and {units} has no such unit; add it")
    return surveyed


def read_units(path: Path) -> GroundUnits:
    """Read the surveyed positions of ground units: ``unit,x_m,y_m,z_m``, ECEF of the line's frame.

    InputFileError: no such table, or a unit twice.
    """
    table = _columns(path, "ranging_units")
    names = table["unit"].cast(pl.String)
    if names.n_unique() < len(names):
        raise InputFileError(path, f"names unit {names.filter(names.is_duplicated())[0]} twice; give each once")
    return GroundUnits(
        name=names.to_numpy().astype(np.str_), ecef_m=table.select("x_m", "y_m", "z_m").cast(pl.Float64).to_numpy()
    )


def read_listed_balises(path: Path, track: Track, *, virtual: bool = False) -> ListedBalises:
    """Read balises, or virtual ones, along a line: ``balise,chainage_m`` and, where there are such, ``track,sigma_m``.

    With the name of a track, a chainage counts from the beginning of that track; balises of tracks that are not part of
    the line, or beyond its ends, are left out.

    InputFileError: no such table, a name twice, or none on the line.
    """
    table = _columns(path, "list of balises")
    names = _names(path, table, "balise")
    if len(twice := table["balise"].filter(table["balise"].is_duplicated())):
        raise InputFileError(path, f"lists balise {twice[0]} twice; give each once")
    chainage = table["chainage_m"].to_numpy()
    if "track" in table.columns:
        spans = _spans(track)
        begin, end = np.array([spans.get(name, (np.nan, np.nan)) for name in table["track"]]).T
        inside = chainage <= np.abs(end - begin)
        chainage = np.where(inside, begin + np.sign(end - begin) * chainage, np.nan)
    inside = (chainage >= 0.0) & (chainage <= track.chainage_m[-1])
    if not inside.any():
        raise InputFileError(
            path, f"lists no balise on the line (0 to {track.chainage_m[-1]:.0f} m); give chainages of this line"
        )
    sigma = table.get_column("sigma_m", default=pl.zeros(len(table), eager=True))
    return ListedBalises(
        name=names[inside],
        chainage_m=chainage[inside],
        sigma_m=sigma.fill_null(0.0).to_numpy()[inside],
        virtual=np.full(int(inside.sum()), virtual),
    )


def _spans(track: Track) -> dict[str | None, tuple[float, float]]:
    """Chainages of the beginning and end of tracks of a line, by file, file and name, or name; None is the line."""
    spans: dict[str | None, tuple[float, float]] = {None: (0.0, float(track.chainage_m[-1]))}
    for source, (begin, end) in zip(track.sections, section_spans(track), strict=True):
        file, _, name = source.removesuffix(")").partition(" (")
        spans |= dict.fromkeys([source, name or Path(file).stem], (begin, end))
    return spans


def load_balises(
    readings: Path | str | None, places: Path | None, virtual: Path | None, track: Track, config: Config
) -> ListedBalises | None:
    """Read the positions of the balises that the train reads, a table or a stream, and of virtual ones; None without.

    InputFileError: see `read_listed_balises`. SettingsError: readings without a list, or a list without; virtual
    balises without levels of the filter.
    """
    if virtual is not None and (config.filter == "off" or config.tracking.level == "off"):
        raise SettingsError(
            "--virtual-balises needs the levels of the filter; leave out --filter off, tracking.level=off"
        )
    if (readings is None) != (places is None):
        given, lacking = ("--balises", "--balise-list") if places is None else ("--balise-list", "--balises")
        raise SettingsError(f"{given} is given without {lacking}; give both, or leave it out")
    lists = [
        read_listed_balises(path, track, virtual=is_virtual)
        for path, is_virtual in ((places, False), (virtual, True))
        if path is not None
    ]
    return join_rows(lists) if lists else None


def check_filter(config: Config, options: Iterable[str]) -> None:
    """Raise SettingsError where an option is given that only the filter along the track uses, and that is off."""
    for name in options:
        if config.filter == "off":
            raise SettingsError(f"--{name} needs the filter along the track; leave out --filter off")


def _times(table: pl.DataFrame) -> Datetimes:
    return table["time_gpst"].to_numpy().astype("datetime64[ns]")


def _names_of_columns(kind: str) -> list[str]:
    """Return the names of the columns of a table, including optional ones."""
    return [column.strip("[]") for column in COLUMNS[kind]]


def _column(path: Path, table: pl.DataFrame, name: str) -> NDArray[Any]:
    """A column of a sensor table; an empty whole number is 0, other missing values are NaN."""
    if name not in table.columns:
        return np.full(len(table), np.nan)
    if name == "balise":
        return _names(path, table, name)
    if name == "unit":
        return table[name].cast(pl.String).to_numpy().astype(np.str_)
    return table[name].fill_null(0 if table[name].dtype.is_integer() else np.nan).to_numpy()


def _names(path: Path, table: pl.DataFrame, name: str) -> Strings:
    """Return a column of names, none of them empty."""
    if (empty := table[name].is_null()).any():
        raise InputFileError(path, f"row {int(empty.arg_max() or 0) + 2}: {name} is empty; name it")
    return table[name].cast(pl.String).to_numpy().astype(np.str_)


def _table(path: Path, kind: str) -> pl.DataFrame:
    """Return a table with times that do not fall."""
    table = _columns(path, kind)
    if not table["time_gpst"].dtype.is_temporal():
        raise InputFileError(path, "time_gpst is no time; expected GPS time as 2024-03-05T03:10:00.000000000")
    if (unknown := table["time_gpst"].is_null()).any():
        raise InputFileError(path, f"row {int(unknown.arg_max() or 0) + 2}: time_gpst is empty; remove the row")
    falling = np.flatnonzero(np.diff(_times(table)) < np.timedelta64(0, "ns"))
    if len(falling):
        raise InputFileError(path, f"row {int(falling[0]) + 3}: time_gpst falls; sort the table by time")
    if kind in _SILENT:  # a stream that was recorded has rows with the time alone (`railfix.live.stream`)
        table = table.filter(~pl.all_horizontal(_select_columns(table, kind).is_null()))
        if not len(table):
            raise InputFileError(path, f"has no row of the {kind} but its time; leave the file out")
    return table


def _select_columns(table: pl.DataFrame, kind: str) -> pl.Expr:
    """Return the columns of a sensor that the table has, without the time."""
    return pl.col([name for name in _names_of_columns(kind) if name in table.columns])


def _columns(path: Path, kind: str) -> pl.DataFrame:
    with reading_table(path, f"cannot be read as a table of the {kind} ({{}})"):
        if mate_table(path):
            table = sensor_table(path, kind)
        elif path.suffix == ".parquet":
            table = pl.read_parquet(path)
        else:
            table = pl.read_csv(
                read_bytes(path),
                schema_overrides={"time_gpst": pl.Datetime("ns"), **dict.fromkeys(_NAMES, pl.String())},
                infer_schema_length=None,
                comment_prefix="#",
            )
    stamp = () if kind in _TIMELESS else ("time_gpst",)
    needed = (*stamp, *(name for name in COLUMNS[kind] if not name.startswith("[")))
    missing = [name for name in needed if name not in table.columns]
    if missing:
        raise InputFileError(path, f"has no column {missing[0]}; expected {', '.join(needed)} of the {kind}")
    if not len(table):
        raise InputFileError(path, f"has no rows; expected those of the {kind}, or leave the file out")
    empty = table.select(pl.all_horizontal(_select_columns(table, kind).is_null())).to_series()
    return table.with_columns(
        _numbers(path, table[name], may_be_empty=empty if name == "pulse" else pl.Series([name != "chainage_m"]))
        for name in _names_of_columns(kind)
        if name not in _NAMES and name in table.columns
    )


def _numbers(path: Path, column: pl.Series, *, may_be_empty: pl.Series) -> pl.Series:
    """Return a column as numbers; pulses and directions are whole numbers."""
    numbers = column.cast(pl.Int64 if column.name in ("pulse", "direction") else pl.Float64, strict=False)
    wrong = numbers.is_null() & (column.is_not_null() | ~may_be_empty)
    if wrong.any():
        row = int(wrong.arg_max() or 0)
        message = f"row {row + 2}: {column.name} is {column[row]!r}, a number was expected; correct the row"
        raise InputFileError(path, message)
    return numbers
