"""Reader of on-board sensor tables: CSV (plain or compressed), Parquet, and EGNSS MATE tables."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes
from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, read_bytes
from railfix.core.tables import reading_table
from railfix.core.timescale import utc_to_gpst
from railfix.io.mate import mate_table, only_device, read_mate

#: Columns of each kind of table, apart from ``time_gpst``. Columns in brackets may be absent.
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
    "pulses": ("[count]", "[pulse]", "[distance_m]", "[direction]"),
    "acceleration": ("[specific_force_mps2]", "[force_forward_mps2]", "[acceleration_mps2]"),
}  # fmt: skip
#: Kinds of tables that may have rows with only a time. Such a row means that the sensor had no output.
_SILENT: Final = ("tachometer", "ranging", "balises")
_TIMELESS: Final = ("ranging_units", "list of balises")  #: Kinds of tables without times.
#: Kinds of tables that must have at least two rows, strictly increasing times and no empty values.
_COMPLETE: Final = ("pulses", "acceleration")
_NAMES: Final = ("unit", "balise", "track")  #: Columns that are read as text.
_WHOLE: Final = ("pulse", "direction")  #: Columns that are read as integers.


def read_sensor_table(path: FilePath, kind: str) -> pl.DataFrame:
    """Read a sensor table of a kind in `COLUMNS`. Times are in GPS time.

    Rows with only a time are dropped from the tables of `tachometer`, `ranging` and `balises`. Raise InputFileError if
    the file is not such a table or has no rows, if times decrease, or if a value is missing or wrong.
    """
    with reading_table(path, f"cannot be read as a table of the {kind} ({{}})"):
        if mate_table(path):
            table = _read_mate_table(path, kind)
        elif Path(path).suffix == ".parquet":
            table = pl.read_parquet(Path(path))
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
        raise InputFileError(path, f"has no column {missing[0]}; a table of the {kind} needs {', '.join(needed)}")
    if not len(table):
        raise InputFileError(path, f"has no rows; expected rows of the {kind}; if there are none, leave the file out")
    present = [name for name in names_of_columns(kind) if name in table.columns]
    silent = table.select(pl.all_horizontal(pl.col(present).is_null())).to_series() if kind in _SILENT else None
    table = table.with_columns(
        pl.col(name).cast(pl.String) if name in _NAMES else _numbers(path, table[name], kind, silent)
        for name in present
    )
    if stamp:
        _check_times(path, table["time_gpst"], kind)
    if silent is not None:  # a recorded stream has rows with only a time (`railfix.live.stream`)
        table = table.filter(~silent)
        if not len(table):
            raise InputFileError(path, f"has times but no values of the {kind}; leave the file out")
    if "balise" in present and (empty := table["balise"].is_null()).any():
        raise InputFileError(path, f"row {int(empty.arg_max() or 0) + 2}: balise is empty; name it")
    return table


def find_sensor_table(names: Collection[str]) -> str | None:
    """Return the kind in `COLUMNS` of a table that has columns with the given names, or None if no kind fits."""
    present = set(names)
    for kind, columns in COLUMNS.items():
        needed = {name for name in columns if not name.startswith("[")}
        if not needed:  # where all columns are optional, one must be present
            needed = (present & set(names_of_columns(kind)) - {"direction"}) or {""}
        if needed <= present and ("time_gpst" in present) == (kind not in _TIMELESS):
            return kind
    return None


def names_of_columns(kind: str) -> list[str]:
    """Return all column names of a kind of table, optional columns included, the time excluded."""
    return [column.strip("[]") for column in COLUMNS[kind]]


def get_times(table: pl.DataFrame) -> Datetimes:
    """Return the times of a table, GPS time."""
    return table["time_gpst"].to_numpy().astype("datetime64[ns]")


def get_column(table: pl.DataFrame, name: str) -> NDArray[Any]:
    """Return a column of a table, NaN if absent. Empty cells are 0 in integer columns and NaN in other columns."""
    if name not in table.columns:
        return np.full(len(table), np.nan)
    if name in _NAMES:
        return table[name].to_numpy().astype(np.str_)
    return table[name].fill_null(0 if table[name].dtype.is_integer() else np.nan).to_numpy()


def _check_times(path: FilePath, column: pl.Series, kind: str) -> None:
    if not column.dtype.is_temporal():
        raise InputFileError(path, "time_gpst is not a time; expected GPS time such as 2024-03-05T03:10:00.000000000")
    if (unknown := column.is_null()).any():
        raise InputFileError(path, f"row {int(unknown.arg_max() or 0) + 2}: time_gpst is empty; remove the row")
    step, nothing = np.diff(column.to_numpy().astype("datetime64[ns]")), np.timedelta64(0, "ns")
    wrong = np.flatnonzero(step <= nothing if kind in _COMPLETE else step < nothing)
    if len(wrong):
        how = "falls" if step[wrong[0]] < nothing else "repeats the row before"
        raise InputFileError(path, f"row {int(wrong[0]) + 3}: time_gpst {how}; sort the rows and keep each time once")
    if kind in _COMPLETE and not len(step):
        raise InputFileError(path, "has fewer than two rows")


def _numbers(path: FilePath, column: pl.Series, kind: str, silent: pl.Series | None) -> pl.Series:
    """Return a column as numbers. Raise InputFileError if a value is no number, or if a required value is missing."""
    numbers = column.cast(pl.Int64 if column.name in _WHOLE else pl.Float64, strict=False)
    wrong = numbers.is_null() & column.is_not_null()
    if kind in _COMPLETE or column.name == "chainage_m":
        wrong = numbers.is_null()
    elif column.name == "pulse" and silent is not None:
        wrong = numbers.is_null() & ~silent
    if wrong.any():
        row = int(wrong.arg_max() or 0)
        message = f"row {row + 2}: {column.name} is {column[row]!r}, a number was expected; correct the row"
        raise InputFileError(path, message)
    return numbers


#: Mapping from EGNSS MATE column names to railfix's column names, for each table.
_MATE_COLUMNS: Final[dict[str, dict[str, str]]] = {
    "S_IMU": {
        "SPEC_FORCE_X": "force_forward_mps2", "SPEC_FORCE_Y": "force_right_mps2", "SPEC_FORCE_Z": "force_down_mps2",
        "ANG_RATE_X": "roll_rate_radps", "ANG_RATE_Y": "pitch_rate_radps", "ANG_RATE_Z": "yaw_rate_radps",
    },
    "S_SPEEDOMETER": {"SPEED": "speed_mps"},
}  # fmt: skip


def _read_mate_table(path: FilePath, kind: str) -> pl.DataFrame:
    """Read an EGNSS MATE table; return a table with the columns in `COLUMNS`.

    Raise InputFileError if the table is of another kind, has several devices, or has forces compensated for gravity.
    """
    name = mate_table(path)
    expected = {"inertial": "S_IMU", "radar": "S_SPEEDOMETER", "balises": "S_BALISEREADER"}
    if name != expected.get(kind, "S_DM_BALISE" if kind == "list of balises" else ""):
        raise InputFileError(path, f"is the EGNSS MATE table {name}, which has no data of the {kind}")
    if name == "S_DM_BALISE":
        table = read_mate(path, ("NID_C", "NID_BG", "N_PIG", "TRACK_EDGE_ID", "POSITION"))
        rows = _first_of_group(table).unique(("NID_C", "NID_BG"), keep="last", maintain_order=True)
        track = pl.col("TRACK_EDGE_ID").cast(pl.String)
        return rows.select(_group(), chainage_m=pl.col("POSITION").cast(pl.Float64), track=track)
    if name == "S_BALISEREADER":
        table = only_device(path, read_mate(path, ("TIMESTAMP_UTC", "NID_C", "NID_BG", "N_PIG")))
        return _in_gps_time(path, _first_of_group(table)).select("time_gpst", _group())
    columns = _MATE_COLUMNS[name]
    table = only_device(path, read_mate(path, ("TIMESTAMP_UTC", *columns)))
    if name == "S_IMU" and table["COMPENSATED"].cast(pl.Boolean).fill_null(False).any():
        raise InputFileError(
            path, "the forces are compensated for gravity; give specific forces, or leave the table out"
        )
    codes = [column for column in table.columns if column.endswith("ERROR_CODE")]
    good = table.filter(pl.all_horizontal(pl.col(column).cast(pl.Int64).fill_null(0) == 0 for column in codes))
    values = [pl.col(column).cast(pl.Float64).alias(to) for column, to in columns.items()]
    return _in_gps_time(path, good).select("time_gpst", *values)


def _first_of_group(table: pl.DataFrame) -> pl.DataFrame:
    """Return the rows of the first balise of each group (N_PIG = 0). This balise's position is used for the group."""
    return table.filter(pl.col("N_PIG").cast(pl.Int64).fill_null(0) == 0)


def _group() -> pl.Expr:
    """Return the polars expression of a balise group's identity, "NID_C-NID_BG"."""
    parts = [pl.col(name).cast(pl.Int64).cast(pl.String) for name in ("NID_C", "NID_BG")]
    return pl.concat_str(parts, separator="-").alias("balise")


def _in_gps_time(path: FilePath, table: pl.DataFrame) -> pl.DataFrame:
    """Return the rows sorted by time, with ``TIMESTAMP_UTC`` converted to GPS time in ``time_gpst``."""
    column = table["TIMESTAMP_UTC"]
    utc = column.str.to_datetime(time_unit="ns", strict=False) if column.dtype == pl.String else column
    if not utc.dtype.is_temporal() or utc.is_null().any():
        raise InputFileError(path, "TIMESTAMP_UTC has a value that is not a time; correct the row")
    gps = utc_to_gpst(utc.cast(pl.Datetime("ns")).to_numpy())
    return table.with_columns(time_gpst=pl.Series(gps, dtype=pl.Datetime("ns"))).sort("time_gpst", maintain_order=True)
