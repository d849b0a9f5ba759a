"""Reference positions of each antenna: reference files, ground truth of the simulator, position logs.

All are one kind of CSV; a row is an antenna at an epoch:

=========== ===============================================================================
time_gpst   ISO 8601, GPS time
antenna     ``front``, ``rear``
chainage_m  along the line at the antenna; empty where unknown
x_m y_m z_m ECEF
speed_mps   along the line, + toward rising chainage
sigma_m     standard deviation along the track
source      ``rtk`` receiver position, ``bridged`` interpolated, ``truth`` simulated ground truth
environment surroundings of the train: ``open``, ``cutting``, or any other word
=========== ===============================================================================

Only time and position are required (geodetic coordinates are accepted). ``truth.csv`` of the simulator
is such a file without a source, and so are position logs (RTKLIB, CSV, NMEA).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Masks, Strings, freeze_arrays
from railfix.core.errors import InputFileError
from railfix.core.files import ending
from railfix.io.named_columns import NamedColumns, read_named_columns
from railfix.io.nmea import read_any_positions
from railfix.io.position_log import CSV_COLUMNS, PositionLog, positions_of_table, qualities_in_words, renamed

#: Columns of the file, in this order.
COLUMNS: Final = (
    "time_gpst", "antenna", "chainage_m", "x_m", "y_m", "z_m", "speed_mps", "sigma_m", "source", "environment",
)  # fmt: skip
#: Source of a reference position; blank where the file has none.
SOURCES: Final = ("rtk", "bridged", "truth", "")
#: A CSV with these columns and no source is ground truth of the simulator.
_OF_TRUTH: Final = ("antenna", "chainage_m", "kilometrage_m", "speed_mps")
#: RTKLIB's quality of a fixed solution.
_FIX: Final = 1


@dataclass(frozen=True, kw_only=True)
class AntennaReference:
    """Reference positions of one antenna, R epochs."""

    time: Datetimes  #: Rising, GPS time; shape (R,).
    ecef_m: Floats  #: Shape (R, 3).
    chainage_m: Floats  #: NaN where the file has none, shape (R,).
    speed_mps: Floats  #: Along the line, positive toward rising chainage; NaN where unknown; shape (R,).
    sigma_m: Floats  #: Standard deviation along the track; NaN where the file has none; shape (R,).
    source: Strings  #: One of `SOURCES`, shape (R,).
    environment: Strings  #: Blank where the file has none, shape (R,).

    def __post_init__(self) -> None:
        epochs = len(self.time)
        if self.ecef_m.shape != (epochs, 3):
            raise ValueError(f"ecef_m has shape {self.ecef_m.shape}, expected ({epochs}, 3)")
        for item in fields(self):
            value = getattr(self, item.name)
            if len(value) != epochs:
                raise ValueError(f"{item.name} has {len(value)} epochs, time has {epochs}")
        freeze_arrays(self)
        if np.isnat(self.time).any() or not (np.diff(self.time) > np.timedelta64(0, "ns")).all():
            raise ValueError("time must rise strictly")
        unknown = sorted(set(self.source.tolist()) - set(SOURCES))
        if unknown:
            raise ValueError(f"source is {unknown[0]!r}, expected one of {', '.join(map(repr, SOURCES))}")

    def __len__(self) -> int:
        return len(self.time)


def read_reference(
    path: str | PathLike[str],
    antennas: Sequence[str],
    *,
    quality: Collection[int] = (_FIX,),
    columns: Mapping[str, str] | None = None,
) -> dict[str, AntennaReference]:
    """Read the reference of one antenna, or of several by the column ``antenna``.

    Parameters
    ----------
    path : path
        A reference file or ground truth of the simulator (``.csv``, ``.csv.gz``), or a position log for
        `railfix.io.nmea.read_any_positions`.
    antennas : sequence of str
        Antennas to read. A file without the column ``antenna`` holds one antenna.
    quality : collection of int
        Accepted qualities, where the log has them.
    columns : mapping of str, optional
        For CSV with other column names, as in `read_positions`.

    Returns
    -------
    dict of str to AntennaReference
        Of rows with the same time the first is used. ``source`` is that of the file; else "truth" for files of the
        simulator, "rtk" for position logs.

    Raises
    ------
    InputFileError
        No positions, no times, an unknown source, or no column ``antenna`` where two are to be read.
    """
    table = _table(Path(path), columns or {})
    log = read_any_positions(path, columns=columns) if table is None else positions_of_table(table)
    usable = np.isfinite(log.ecef_m).all(axis=1) & ~np.isnat(log.time)
    if log.has_quality:
        usable &= np.isin(log.quality, [*quality])
    owner = np.full(len(log), antennas[0])
    if table is not None and "antenna" in table:
        owner = np.array(table.cells["antenna"].to_list(), dtype=np.str_)
    elif len(antennas) > 1:
        raise InputFileError(
            path,
            f"a column antenna ({', '.join(antennas)}) is needed for the reference of two antennas; give a CSV file "
            "with one (railfix reference makes it of a log of one antenna)",
        )
    values = _columns(log, table)
    what = ""
    if log.has_quality:
        wanted, there = ", ".join(map(str, quality)), qualities_in_words(log)
        what = f" and quality {wanted} (the log has {there}; railfix evaluate --reference-quality takes others)"
    return {name: _of_antenna(path, name, owner, usable, values, what) for name in antennas}


def _table(path: Path, columns: Mapping[str, str]) -> NamedColumns | None:
    """Read the file as a table; None for a file other than CSV."""
    if ending(path) != ".csv":
        return None
    return renamed(read_named_columns(path), columns, known=dict.fromkeys((*CSV_COLUMNS, *COLUMNS)))


def _columns(log: PositionLog, table: NamedColumns | None) -> dict[str, NDArray[np.generic]]:
    """Collect all columns of all rows, blank where the file has none."""
    absent = np.full(len(log), np.nan)
    columns: dict[str, NDArray[np.generic]] = {"time": log.time, "ecef_m": log.ecef_m}
    for name in ("chainage_m", "speed_mps", "sigma_m"):
        columns[name] = table.numbers(name, blank=np.nan) if table is not None and name in table else absent
    source = np.full(len(log), "truth" if table is not None and all(n in table for n in _OF_TRUTH) else "rtk")
    environment = np.full(len(log), "")
    if table is not None and "source" in table:
        source = np.array(table.cells["source"].to_list(), dtype=np.str_)
        unknown = ~np.isin(source, SOURCES)
        if unknown.any():
            row = int(np.argmax(unknown))
            raise table.error(row, f"source is '{source[row]}'; {', '.join(SOURCES[:-1])} or blank was expected")
    if table is not None and "environment" in table:
        environment = np.array(table.cells["environment"].to_list(), dtype=np.str_)
    return {**columns, "source": source, "environment": environment}


def _of_antenna(
    path: str | PathLike[str],
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
        there = f"; the file has those of {', '.join(others)}" if others else ""
        raise InputFileError(path, f"fewer than two positions for the antenna {name} with a time{what}{there}")
    return AntennaReference(**{key: values[rows[first]] for key, values in columns.items()})  # type: ignore[arg-type]


def reference_table(references: Mapping[str, AntennaReference]) -> pl.DataFrame:
    """Return the rows of such a file, by time and then antenna; null where blank."""
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
