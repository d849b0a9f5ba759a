"""Readers of reference positions, tachometer pulses and longitudinal acceleration.

A reference is a CSV file with ``time_gpst``, ``antenna`` (``front``, ``rear``), ``chainage_m``, ``x_m y_m z_m`` or
geodetic coordinates, ``speed_mps``, ``sigma_m`` along the track, ``source`` (``rtk``, ``bridged``, ``truth``) and
``environment`` (``open``, ``cutting`` or any word). Only time and position are required.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Masks, Strings, freeze_rows
from railfix.core.errors import InputFileError
from railfix.core.files import BrokenLines, FilePath
from railfix.core.notebook import NotebookTable
from railfix.core.timescale import seconds
from railfix.io.named_columns import NamedColumns
from railfix.io.position_log import PositionLog, numbers_or_nan, qualities_in_words
from railfix.io.positions import read_positions
from railfix.io.sensor_tables import get_column, get_times, read_sensor_table

#: Columns of a reference file, in the order of the file.
COLUMNS: Final = (
    "time_gpst", "antenna", "chainage_m", "x_m", "y_m", "z_m", "speed_mps", "sigma_m", "source", "environment",
)  # fmt: skip
SOURCES: Final = ("rtk", "bridged", "truth", "")  #: Accepted sources of a reference position; blank means unknown.
#: A CSV file with all these columns, but no column ``source``, is taken as ground truth from the simulator.
_OF_TRUTH: Final = ("antenna", "chainage_m", "kilometrage_m", "speed_mps")
_FIX: Final = 1  #: RTKLIB quality number of a fixed solution.


@dataclass(frozen=True, kw_only=True, repr=False)
class AntennaReference(NotebookTable):
    """Reference positions of one antenna, R epochs."""

    time: Datetimes  #: GPS time, strictly increasing, shape (R,).
    ecef_m: Floats  #: Position in ECEF, shape (R, 3).
    chainage_m: Floats  #: Chainage; NaN where absent, shape (R,).
    speed_mps: Floats  #: Speed along the line, positive toward rising chainage; NaN where absent, shape (R,).
    sigma_m: Floats  #: Along-track standard deviation of the position; NaN where absent, shape (R,).
    source: Strings  #: Source of the position, one of `SOURCES`; shape (R,).
    environment: Strings  #: Environment such as "open"; blank where absent, shape (R,).

    def __post_init__(self) -> None:
        epochs = len(self.time)
        if self.ecef_m.shape != (epochs, 3):
            raise ValueError(f"ecef_m has shape {self.ecef_m.shape}, expected ({epochs}, 3)")
        freeze_rows(self, "epochs")
        if np.isnat(self.time).any() or not (np.diff(self.time) > np.timedelta64(0, "ns")).all():
            raise ValueError("time must rise strictly")
        unknown = sorted(set(self.source.tolist()) - set(SOURCES))
        if unknown:
            raise ValueError(f"source is {unknown[0]!r}, expected one of {', '.join(map(repr, SOURCES))}")

    def __len__(self) -> int:
        return len(self.time)


def read_reference(
    path: FilePath,
    antennas: Sequence[str],
    *,
    quality: Collection[int] = (_FIX,),
    columns: Mapping[str, str] | None = None,
    broken_lines: BrokenLines = "stop",
    date: np.datetime64 | None = None,
) -> dict[str, AntennaReference]:
    """Read the reference positions of one or several antennas.

    Parameters
    ----------
    path : path
        A reference file or ground truth of the simulator (``.csv``, ``.csv.gz``), or a position log for
        `railfix.io.positions.read_positions`.
    antennas : sequence of str
        Antennas to read. A file without the column ``antenna`` has the positions of one antenna.
    quality : collection of int
        Accepted values of `PositionLog.quality`; ignored for a log without quality numbers.
    columns : mapping of str, optional
        Column names of a CSV file, as in `read_positions`.
    broken_lines, date
        As in `read_positions`.

    Returns
    -------
    dict of str to AntennaReference
        Rows without position or time are dropped, and only the first of several rows with the same time is used. If the
        file has no column ``source``, the source is "truth" for simulator files and "rtk" for others.

    Raises
    ------
    InputFileError
        An antenna has fewer than two accepted positions with a time; a source is unknown; or `antennas` names several
        antennas, but the file has no column ``antenna``.
    NoPositionError
        No row has a position.
    """
    log = read_positions(path, columns=columns, broken_lines=broken_lines, date=date, antennas="several")
    usable = np.isfinite(log.ecef_m).all(axis=1) & ~np.isnat(log.time)
    if log.has_quality:
        usable &= np.isin(log.quality, [*quality])
    empty = NamedColumns(path=log.path, metadata={}, header_line=0, line=log.line, cells={})
    cells = empty if log.table is None else log.table
    owner = cells.texts("antenna", absent=antennas[0])
    if "antenna" not in cells and len(antennas) > 1:
        raise InputFileError(
            path,
            f"the reference of several antennas must have a column antenna ({', '.join(antennas)}); give a CSV file "
            "with this column, as railfix reference writes it from the log of one antenna",
        )
    values = _columns(log, cells)
    what = ""
    if log.has_quality:
        wanted, there = ", ".join(map(str, quality)), qualities_in_words(log)
        what = f" and quality {wanted} (the log has {there}; see railfix evaluate --reference-quality)"
    return {name: _of_antenna(path, name, owner, usable, values, what) for name in antennas}


def _columns(log: PositionLog, table: NamedColumns) -> dict[str, NDArray[np.generic]]:
    """Return the columns of all rows; absent values are NaN or blank. Raise InputFileError for an unknown source."""
    source = table.texts("source", absent="truth" if all(name in table for name in _OF_TRUTH) else "rtk")
    unknown = ~np.isin(source, SOURCES)
    if unknown.any():
        row = int(np.argmax(unknown))
        raise table.error(row, f"source is '{source[row]}'; {', '.join(SOURCES[:-1])} or blank was expected")
    return {
        "time": log.time,
        "ecef_m": log.ecef_m,
        **{name: numbers_or_nan(table, name) for name in ("chainage_m", "speed_mps", "sigma_m")},
        "source": source,
        "environment": table.texts("environment", absent=""),
    }


def _of_antenna(
    path: FilePath,
    name: str,
    owner: Strings,
    usable: Masks,
    columns: Mapping[str, NDArray[np.generic]],
    what: str,
) -> AntennaReference:
    rows = np.flatnonzero(usable & (owner == name))
    _, first = np.unique(columns["time"][rows], return_index=True)
    if len(first) < 2:
        others = sorted({*owner.tolist()} - {name})
        there = f"; the file has positions of {', '.join(others)}" if others else ""
        raise InputFileError(path, f"the antenna {name} has fewer than two positions with a time{what}{there}")
    return AntennaReference(**{key: values[rows[first]] for key, values in columns.items()})  # type: ignore[arg-type]


def reference_table(references: Mapping[str, AntennaReference]) -> pl.DataFrame:
    """Return a table of the reference positions, sorted by time, with the columns of a reference file; absent values
    are null.
    """
    tables = [
        pl.DataFrame(
            {
                "time_gpst": part.time,
                "antenna": np.full(len(part), name),
                "chainage_m": part.chainage_m,
                **{axis: part.ecef_m[:, i] for i, axis in enumerate(("x_m", "y_m", "z_m"))},
                "speed_mps": part.speed_mps,
                "sigma_m": part.sigma_m,
                "source": part.source,
                "environment": part.environment,
            }
        )
        for name, part in references.items()
    ]
    table = pl.concat(tables).sort("time_gpst", maintain_order=True).select(COLUMNS)
    return table.with_columns(
        pl.col(pl.Float64).round(4).fill_nan(None), pl.col("source", "environment").replace("", None)
    )


LONGEST_STEP_S = 1.0  #: A longer interval between rows is a gap, in which values are unknown [s].


@dataclass(frozen=True, kw_only=True)
class Pulses:
    """Cumulative pulses of a tachometer, P rows."""

    path: str
    time: Datetimes
    #: Count of pulses, or distance [m] if `kind` is "distance"; shape (P,). If `signed`, the count decreases when the
    #: train runs backward.
    count: Floats
    kind: str  #: Source of the count: "count" (readings of a counter), "pulse" (single pulses) or "distance".
    signed: bool  #: Whether the running direction is known, from a column ``direction`` or because the count decreases.

    def at(self, time: Datetimes) -> Floats:
        """Interpolate the count linearly. Return NaN outside the table, and in gaps across which the count changes.

        Single pulses (`kind` "pulse") have no gaps.
        """
        at, known = seconds(time - self.time[0]), seconds(self.time - self.time[0])
        count = np.interp(at, known, self.count, left=np.nan, right=np.nan)
        after = np.clip(np.searchsorted(known, at), 1, len(known) - 1)
        gap = (known[after] - known[after - 1] > LONGEST_STEP_S) & (self.kind != "pulse")
        gap &= self.count[after] != self.count[after - 1]
        gap &= (at != known[after]) & (at != known[after - 1])
        return np.where(gap, np.nan, count)


@dataclass(frozen=True, kw_only=True)
class Acceleration:
    """Longitudinal acceleration [m/s2], positive toward the vehicle's front, A rows.

    `kind` is "motion", or "specific_force" if the values include gravity on gradients.
    """

    path: str
    time: Datetimes
    acceleration_mps2: Floats
    kind: str

    def mean_over(self, time: Datetimes) -> Floats:
        """Compute mean accelerations between consecutive times, shape (len(time) - 1,); NaN outside the table or across
        gaps.
        """
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


def read_pulses(path: FilePath) -> Pulses:
    """Read a tachometer table (CSV or Parquet) with ``time_gpst`` and a count.

    The count is in one of the columns ``count`` (counter reading; it must not wrap, and may decrease when the train
    runs backward), ``pulse`` (pulse number, as in tables for `railfix run`) and ``distance_m`` (distance run). Without
    these columns, each row is one pulse. A column ``direction`` has the running direction. Raise InputFileError if the
    file is not such a table, the times do not increase strictly, or a direction is neither 1 nor -1.
    """
    table = read_sensor_table(path, "pulses")
    names = {"count": "count", "pulse": "pulse", "distance_m": "distance"}
    name = next((name for name in names if name in table.columns), "")
    count = get_column(table, name).astype(np.float64) if name else np.arange(len(table), dtype=np.float64)
    if signed := "direction" in table.columns:
        direction = get_column(table, "direction")
        wrong = ~np.isin(direction, (-1, 1))
        if wrong.any():
            row = int(np.argmax(wrong))
            raise InputFileError(path, f"row {row + 2}: direction is {direction[row]}; 1 or -1 was expected")
        count = np.cumsum(np.diff(count, prepend=count[0]) * direction)
    signed |= bool((np.diff(count) < 0).any())
    return Pulses(path=str(path), time=get_times(table), count=count, kind=names.get(name, "pulse"), signed=signed)


def read_acceleration(path: FilePath) -> Acceleration:
    """Read a table (CSV or Parquet) of accelerations toward the front, with ``time_gpst`` and one column of values.

    ``specific_force_mps2`` (``force_forward_mps2`` in simulator tables) is measured by an accelerometer. It includes
    gravity on gradients, which is later removed by means of the map. ``acceleration_mps2`` is the train's acceleration
    without gravity. Raise InputFileError if the table has none or several of these columns, or the times do not
    increase strictly.
    """
    table = read_sensor_table(path, "acceleration")
    kinds = {
        "specific_force_mps2": "specific_force",
        "force_forward_mps2": "specific_force",
        "acceleration_mps2": "motion",
    }
    present = [name for name in kinds if name in table.columns]
    if len(present) != 1:
        there = ", ".join(table.columns)
        raise InputFileError(path, f"one column of {', '.join(kinds)} was expected; the columns are {there}")
    return Acceleration(
        path=str(path), time=get_times(table), acceleration_mps2=get_column(table, present[0]), kind=kinds[present[0]]
    )
