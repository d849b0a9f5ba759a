"""On-board sensor tables: tachometer pulses and longitudinal acceleration."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats
from railfix.core.errors import InputFileError
from railfix.core.timescale import seconds
from railfix.io.named_columns import NamedColumns, parse_named_columns, read_named_columns
from railfix.io.position_log import positions_times

#: Format of times.
_ISO: Final = "%Y-%m-%dT%H:%M:%S%.9f"

#: Rows further apart than this are a gap, within which values are unknown [s].
LONGEST_STEP_S = 1.0


@dataclass(frozen=True, kw_only=True)
class Pulses:
    """Cumulative pulses of a tachometer, P rows."""

    path: str
    time: Datetimes
    count: Floats  #: Falling where the train runs backward, if the table has the direction; shape (P,).
    kind: str  #: Rows are readings of a counter, single pulses, or distances in metres.
    signed: bool  #: Whether the count has a direction: it falls somewhere, or the table has the column.

    def at(self, time: Datetimes) -> Floats:
        """Interpolate the count linearly; NaN outside the table and in gaps during which the train moves."""
        at, known = seconds(time - self.time[0]), seconds(self.time - self.time[0])
        count = np.interp(at, known, self.count, left=np.nan, right=np.nan)
        after = np.clip(np.searchsorted(known, at), 1, len(known) - 1)
        gap = (known[after] - known[after - 1] > LONGEST_STEP_S) & (self.kind != "pulse")
        gap &= self.count[after] != self.count[after - 1]
        gap &= (at != known[after]) & (at != known[after - 1])
        return np.where(gap, np.nan, count)


@dataclass(frozen=True, kw_only=True)
class Acceleration:
    """Longitudinal acceleration toward the vehicle's front, A rows [m/s2].

    `kind`: acceleration of the "motion", or "specific_force", which includes gravity on gradients.
    """

    path: str
    time: Datetimes
    acceleration_mps2: Floats
    kind: str

    def mean_over(self, time: Datetimes) -> Floats:
        """Compute the mean between consecutive times, shape (len(time) - 1,) [m/s2]; NaN across gaps of the table."""
        known, at = seconds(self.time - self.time[0]), seconds(time - self.time[0])
        step = np.diff(known)
        velocity = np.concatenate(
            [[0.0], np.cumsum(step * (self.acceleration_mps2[1:] + self.acceleration_mps2[:-1]) / 2.0)]
        )
        gaps = np.concatenate([[0], np.cumsum(step > LONGEST_STEP_S)])
        total = np.interp(at, known, velocity, left=np.nan, right=np.nan)
        before = gaps[np.clip(np.searchsorted(known, at[:-1], side="right") - 1, 0, len(known) - 1)]
        after = gaps[np.clip(np.searchsorted(known, at[1:], side="left"), 0, len(known) - 1)]
        return np.where(before == after, np.diff(total) / np.diff(at), np.nan)


def read_pulses(path: str | PathLike[str]) -> Pulses:
    """Read a tachometer table: CSV (or the same as .parquet) with ``time_gpst`` and the count.

    ``count`` is the reading of a counter (falling when running backward, never wrapping), ``distance_m`` the distance
    run; with neither, each row is one pulse. A column ``direction`` of 1 and -1 gives the sign. InputFileError: no such
    table, times that do not rise, a direction other than 1 and -1.
    """
    table = _table(path)
    time = _rising_times(table)
    kind = "count" if "count" in table else "distance" if "distance_m" in table else "pulse"
    if kind == "pulse":
        count = np.arange(len(table), dtype=np.float64)
    else:
        count = table.numbers("count" if kind == "count" else "distance_m")
    if "direction" in table:
        direction = table.numbers("direction")
        wrong = ~np.isin(direction, (-1.0, 1.0))
        if wrong.any():
            row = int(np.argmax(wrong))
            raise table.error(row, f"direction is {direction[row]:g}; 1 or -1 was expected")
        count = np.cumsum(np.diff(count, prepend=count[0]) * direction)
    falling = bool((np.diff(count) < 0).any())
    return Pulses(path=str(path), time=time, count=count, kind=kind, signed=falling or "direction" in table)


def read_acceleration(path: str | PathLike[str]) -> Acceleration:
    """Read a table of accelerations toward the front: CSV, or .parquet, with ``time_gpst`` and one other column.

    ``specific_force_mps2`` and ``force_forward_mps2`` (of the simulator) are measured by an accelerometer and
    include gravity on gradients, which is removed with the map; ``acceleration_mps2`` is that of the motion.
    InputFileError: none or several of the columns, or times that do not rise.
    """
    table = _table(path)
    kinds = {
        "specific_force_mps2": "specific_force",
        "force_forward_mps2": "specific_force",
        "acceleration_mps2": "motion",
    }
    present = [name for name in kinds if name in table]
    if len(present) != 1:
        raise InputFileError(
            path,
            f"one column of {', '.join(kinds)} was expected; the columns are {', '.join(table.cells)}",
            line=table.header_line,
        )
    return Acceleration(
        path=str(path),
        time=_rising_times(table),
        acceleration_mps2=table.numbers(present[0]),
        kind=kinds[present[0]],
    )


def _table(path: str | PathLike[str]) -> NamedColumns:
    if Path(path).suffix == ".parquet":
        try:
            return parse_named_columns(pl.read_parquet(Path(path)).write_csv(datetime_format=_ISO).splitlines(), path)
        except (OSError, pl.exceptions.PolarsError) as error:
            raise InputFileError(path, f"cannot be read as a Parquet table ({error})") from None
    return read_named_columns(path)


def _rising_times(table: NamedColumns) -> Datetimes:
    if "time_gpst" not in table:
        raise InputFileError(
            table.path,
            f"there is no column time_gpst; the columns are {', '.join(table.cells)}",
            line=table.header_line,
        )
    time = positions_times(table)
    if len(time) < 2:
        raise InputFileError(table.path, "fewer than two rows")
    bad = np.isnat(time)
    if bad.any():
        raise table.error(int(np.argmax(bad)), "there is no time")
    bad[1:] = np.diff(time) <= np.timedelta64(0, "ns")
    if bad.any():
        raise table.error(int(np.argmax(bad)), "the time does not rise; sort the table and remove duplicates")
    return time
