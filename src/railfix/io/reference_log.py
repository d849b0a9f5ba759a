"""Where each antenna really was: reference files, the simulator's truth, logs of good positions.

One CSV for all of them; a row is an antenna at an instant:

=========== ===============================================================================
time_gpst   ISO 8601, GPS time
antenna     ``front``, ``rear``
chainage_m  of the line at the antenna's place; empty where it is not known
x_m y_m z_m ECEF
speed_mps   along the line, + toward rising chainage
sigma_m     standard deviation along the track
source      ``rtk`` a position of a receiver, ``bridged`` carried between two, ``truth`` made up
environment where the train is: ``open``, ``cutting``, or whatever words the file has
=========== ===============================================================================

Only time and place are needed (geodetic coordinates will do). The simulator's ``truth.csv`` is
such a file without a source, and so are logs of positions (RTKLIB, CSV, NMEA).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Masks, Strings, read_only
from railfix.core.errors import InputFileError
from railfix.core.files import ending, write_whole
from railfix.io.named_columns import NamedColumns, read_named_columns
from railfix.io.nmea import read_any_positions
from railfix.io.position_log import PositionLog, positions_of_table

#: Columns of the file, in this order.
COLUMNS: Final = (
    "time_gpst", "antenna", "chainage_m", "x_m", "y_m", "z_m", "speed_mps", "sigma_m", "source", "environment",
)  # fmt: skip
#: Where an instant comes from; blank where the file does not tell.
SOURCES: Final = ("rtk", "bridged", "truth", "")
#: A CSV with these columns and no source is the simulator's truth.
_OF_TRUTH: Final = ("antenna", "chainage_m", "kilometrage_m", "speed_mps")
#: RTKLIB's quality of a fixed solution.
_FIX: Final = 1


@dataclass(frozen=True, kw_only=True)
class AntennaReference:
    """Places of one antenna, R instants.

    Attributes
    ----------
    time : ndarray of datetime64[ns], shape (R,)
        Rising, GPS time.
    ecef_m : ndarray, shape (R, 3) [m]
    chainage_m : ndarray, shape (R,) [m]
        NaN where the file has none.
    speed_mps : ndarray, shape (R,) [m/s]
        Along the line, + toward rising chainage; NaN unknown.
    sigma_m : ndarray, shape (R,) [m]
        Standard deviation along the track; NaN where it is not stated.
    source : ndarray of str, shape (R,)
        One of `SOURCES`.
    environment : ndarray of str, shape (R,)
        Blank where it is not told.
    """

    time: Datetimes
    ecef_m: Floats
    chainage_m: Floats
    speed_mps: Floats
    sigma_m: Floats
    source: Strings
    environment: Strings

    def __post_init__(self) -> None:
        instants = len(self.time)
        if self.ecef_m.shape != (instants, 3):
            raise ValueError(f"ecef_m has shape {self.ecef_m.shape}, expected ({instants}, 3)")
        for item in fields(self):
            value = getattr(self, item.name)
            if len(value) != instants:
                raise ValueError(f"{item.name} has {len(value)} instants, time has {instants}")
            object.__setattr__(self, item.name, read_only(value))
        if np.isnat(self.time).any() or not (np.diff(self.time) > np.timedelta64(0, "ns")).all():
            raise ValueError("time must rise strictly")
        strange = sorted(set(self.source.tolist()) - set(SOURCES))
        if strange:
            raise ValueError(f"source is {strange[0]!r}, expected one of {', '.join(map(repr, SOURCES))}")

    def __len__(self) -> int:
        return len(self.time)


def read_reference(path: str | PathLike[str], antennas: Sequence[str]) -> dict[str, AntennaReference]:
    """Read the reference of one antenna, or of several by the column ``antenna``.

    Parameters
    ----------
    path : path
        A reference file or the simulator's truth (``.csv``, ``.csv.gz``), or a log of positions that
        `railfix.io.nmea.read_any_positions` reads. Where quality is told, 1 (fix) alone counts.
    antennas : sequence of str
        Those that are wanted. A file without the column ``antenna`` is about the only one.

    Returns
    -------
    dict of str to AntennaReference
        Of every antenna asked for. Of rows with the same time the first counts. ``source`` is what
        the file says; "truth" for the simulator's, "rtk" for a plain log of positions.

    Raises
    ------
    InputFileError
        No reference, no times, an unknown source, or nothing that says which antenna's they are.
    """
    table = _table(Path(path))
    log = read_any_positions(path) if table is None else positions_of_table(table)
    usable = np.isfinite(log.ecef_m).all(axis=1) & ~np.isnat(log.time)
    if log.has_quality:
        usable &= log.quality == _FIX
    owner = np.full(len(log), antennas[0])
    if table is not None and "antenna" in table:
        owner = np.array(table.cells["antenna"])
    elif len(antennas) > 1:
        raise InputFileError(
            path, f"a column antenna ({', '.join(antennas)}) is needed for the reference of two antennas"
        )
    whole = _columns(log, table)
    return {name: _of_antenna(path, name, owner, usable, whole) for name in antennas}


def _table(path: Path) -> NamedColumns | None:
    """The file as a table, or None where it is no CSV."""
    return read_named_columns(path) if ending(path) == ".csv" else None


def _columns(log: PositionLog, table: NamedColumns | None) -> dict[str, NDArray[np.generic]]:
    """All columns of all rows, blank where the file has none."""
    absent = np.full(len(log), np.nan)
    found: dict[str, NDArray[np.generic]] = {"time": log.time, "ecef_m": log.ecef_m}
    for name in ("chainage_m", "speed_mps", "sigma_m"):
        found[name] = table.numbers(name, blank=np.nan) if table is not None and name in table else absent
    source = np.full(len(log), "truth" if table is not None and all(n in table for n in _OF_TRUTH) else "rtk")
    environment = np.full(len(log), "")
    if table is not None and "source" in table:
        source = np.array(table.cells["source"], dtype=np.str_)
        strange = ~np.isin(source, SOURCES)
        if strange.any():
            row = int(np.argmax(strange))
            raise table.error(row, f"source is '{source[row]}'; {', '.join(SOURCES[:-1])} or blank was expected")
    if table is not None and "environment" in table:
        environment = np.array(table.cells["environment"], dtype=np.str_)
    return {**found, "source": source, "environment": environment}


def _of_antenna(
    path: str | PathLike[str],
    name: str,
    owner: Strings,
    usable: Masks,
    whole: Mapping[str, NDArray[np.generic]],
) -> AntennaReference:
    rows = np.flatnonzero(usable & (owner == name))
    _, first = np.unique(whole["time"][rows], return_index=True)
    if len(first) < 2:
        raise InputFileError(path, f"fewer than two positions with a time for the antenna {name}")
    return AntennaReference(**{key: values[rows[first]] for key, values in whole.items()})  # type: ignore[arg-type]


def write_reference(path: str | PathLike[str], references: Mapping[str, AntennaReference]) -> None:
    """Write references as CSV (`COLUMNS`), by time and then antenna; whole or not at all.

    Parameters
    ----------
    path : path
    references : mapping of str to AntennaReference
        By antenna.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    write_whole(path, "\n".join(reference_lines(references)) + "\n")


def reference_lines(references: Mapping[str, AntennaReference]) -> list[str]:
    """Lines of the CSV, the header first."""
    if not references:
        return [",".join(COLUMNS)]
    parts = list(references.values())
    owner = np.repeat(np.array(list(references)), [len(part) for part in parts])
    time = np.concatenate([part.time for part in parts])
    order = np.argsort(time, kind="stable")
    columns = [np.datetime_as_string(time, unit="ns"), owner, _decimals(parts, "chainage_m")]
    columns += [_text(np.concatenate([part.ecef_m[:, i] for part in parts])) for i in range(3)]
    columns += [_decimals(parts, "speed_mps"), _decimals(parts, "sigma_m")]
    columns += [np.concatenate([getattr(part, name) for part in parts]) for name in ("source", "environment")]
    rows = zip(*(column[order].tolist() for column in columns), strict=True)
    return [",".join(COLUMNS), *(",".join(row) for row in rows)]


def _decimals(parts: Sequence[AntennaReference], name: str) -> Strings:
    return _text(np.concatenate([getattr(part, name) for part in parts]))


def _text(values: Floats) -> Strings:
    """Numbers with four decimals, NaN blank."""
    return np.array([f"{value:.4f}" if value == value else "" for value in values.tolist()], dtype=np.str_)
