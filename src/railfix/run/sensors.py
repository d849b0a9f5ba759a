"""Tables of the sensors on board as samples, and their parts by time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from polars.exceptions import PolarsError

from railfix.core.errors import InputFileError
from railfix.motion.samples import InertialSamples, RadarSpeeds, SensorSamples, TachometerPulses

#: Columns of each table beside ``time_gpst``, as `railfix simulate` writes them; those in brackets may be absent.
COLUMNS: Final[Mapping[str, tuple[str, ...]]] = {
    "tachometer": ("pulse", "[direction]"),
    "inertial": (
        "force_forward_mps2", "force_right_mps2", "force_down_mps2", "roll_rate_radps", "pitch_rate_radps",
        "yaw_rate_radps",
    ),
    "radar": ("speed_mps",),
}  # fmt: skip


def read_sensors(
    *, tachometer: Path | None = None, inertial: Path | None = None, radar: Path | None = None
) -> SensorSamples:
    """Read the tables of the sensors, CSV (also .gz) or Parquet; a sensor without a file has no samples.

    Raises
    ------
    InputFileError
        A file is no such table, or its times fall.
    """
    values: dict[str, Any] = {}
    if tachometer is not None:
        table = _table(tachometer, "tachometer")
        direction = table["direction"] if "direction" in table.columns else pl.Series([0]).new_from_index(0, len(table))
        values["tachometer"] = TachometerPulses(
            time=_times(table),
            pulse=table["pulse"].cast(pl.Int64).to_numpy(),
            direction=direction.cast(pl.Int64).to_numpy(),
        )
    if inertial is not None:
        table = _table(inertial, "inertial")
        columns = COLUMNS["inertial"]
        values["inertial"] = InertialSamples(
            time=_times(table),
            force_mps2=table.select(columns[:3]).cast(pl.Float64).to_numpy(),
            rate_radps=table.select(columns[3:]).cast(pl.Float64).to_numpy(),
        )
    if radar is not None:
        table = _table(radar, "radar")
        speed = table["speed_mps"].cast(pl.Float64).fill_null(float("nan")).to_numpy()
        values["radar"] = RadarSpeeds(time=_times(table), speed_mps=speed)
    return SensorSamples(**values)


def until(samples: SensorSamples, begin: np.datetime64, end: np.datetime64) -> SensorSamples:
    """Return the samples after one instant (all where it is NaT) up to another."""
    parts: dict[str, Any] = {}
    for sensor in fields(samples):
        rows = getattr(samples, sensor.name)
        first = 0 if np.isnat(begin) else int(np.searchsorted(rows.time, begin, side="right"))
        last = int(np.searchsorted(rows.time, end, side="right"))
        parts[sensor.name] = type(rows)(**{f.name: getattr(rows, f.name)[first:last] for f in fields(rows)})
    return SensorSamples(**parts)


def _times(table: pl.DataFrame) -> np.ndarray[tuple[int, ...], np.dtype[np.datetime64]]:
    return table["time_gpst"].to_numpy().astype("datetime64[ns]")


def _table(path: Path, kind: str) -> pl.DataFrame:
    try:
        if path.suffix == ".parquet":
            table = pl.read_parquet(path)
        else:
            table = pl.read_csv(
                path, schema_overrides={"time_gpst": pl.Datetime("ns")}, infer_schema_length=None, comment_prefix="#"
            )
    except (PolarsError, OSError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputFileError(path, f"cannot be read as a table of the {kind} ({reason})") from error
    needed = ("time_gpst", *(name for name in COLUMNS[kind] if not name.startswith("[")))
    missing = [name for name in needed if name not in table.columns]
    if missing:
        raise InputFileError(path, f"has no column {missing[0]}; expected {', '.join(needed)} of the {kind}")
    if not table["time_gpst"].dtype.is_temporal():
        raise InputFileError(path, "time_gpst is no time; expected GPS time as 2024-03-05T03:10:00.000000000")
    falling = np.flatnonzero(np.diff(_times(table)) < np.timedelta64(0, "ns"))
    if len(falling):
        raise InputFileError(path, f"row {int(falling[0]) + 3}: time_gpst falls; sort the table by time")
    return table
