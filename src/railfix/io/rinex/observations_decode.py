"""Decoding of satellite lines to dense arrays over epochs and channels, without loops over either."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Floats, Integers, Masks, Strings
from railfix.io.rinex.fault_log import NOT_SELECTED, SATELLITES, UNKNOWN_SYSTEMS, FaultLog
from railfix.io.rinex.header import RinexHeader
from railfix.io.rinex.observations_epochs import Epochs
from railfix.io.rinex.observations_fields import FIELD_WIDTH, Fields, Words, gather, parse
from railfix.io.rinex.observations_lines import Lines
from railfix.io.rinex.observations_signals import KINDS, SYSTEMS, Column

_BLANK: Final = ord(" ")
_ZERO: Final = ord("0")
#: Satellite names on a RINEX 2 epoch line, and the column of the first one.
NAMES_PER_LINE: Final = 12
_FIRST_NAME: Final = 32
#: Observations on a RINEX 2 line.
FIELDS_PER_LINE: Final = 5
_LETTERS: Final = range(ord("A"), ord("Z") + 1)


@dataclass(frozen=True)
class Rows:
    """Satellites of a run of epochs, shape (n,) each.

    Attributes
    ----------
    epoch : ndarray of int64
        Index of the epoch.
    letter : ndarray of uint8
        Constellation letter.
    number : ndarray of int64
        Satellite number; -1 where the name cannot be read.
    line : ndarray of int64
        Index of the (first) line of observations.
    """

    epoch: Integers
    letter: Bytes
    number: Integers
    line: Integers

    def __getitem__(self, which: Masks | Integers) -> Rows:
        return Rows(self.epoch[which], self.letter[which], self.number[which], self.line[which])


@dataclass(frozen=True)
class Dense:
    """Observations of a run of epochs, T by M channels, M sorted by satellite, then signal."""

    satellite: Strings
    signal: Strings
    kinds: tuple[Floats, Floats, Floats, Floats]
    lock: Bytes


def lines_per_satellite(header: RinexHeader) -> int:
    """Return the number of observation lines of a satellite: several in RINEX 2, else one."""
    return max(-(-len(header.types_of("G") or ()) // FIELDS_PER_LINE), 1) if header.version < 3.0 else 1


def decode(
    lines: Lines, epochs: Epochs, *, header: RinexHeader, systems: frozenset[str] | None, log: FaultLog
) -> Dense:
    """Decode the observations of epochs (flags 0 and 1) to dense arrays."""
    rows = _rows(lines, epochs, header)
    rows = _selected(lines, rows, header=header, systems=systems, log=log)
    rows = _without_repeats(lines, rows, len(epochs), log)
    parts = []
    for system in SYSTEMS:
        chosen = rows[rows.letter == ord(system)]
        columns = header.columns(system)
        if len(chosen.epoch) and columns:
            chosen, fields = _values(lines, chosen, system, columns, header, log)
            parts.append((system, chosen, fields, columns))
    return _scatter(parts, len(epochs))


def _rows(lines: Lines, epochs: Epochs, header: RinexHeader) -> Rows:
    count = epochs.count
    epoch = np.repeat(np.arange(len(epochs)), count)
    order = np.arange(len(epoch)) - np.repeat(np.cumsum(count) - count, count)
    if header.version >= 3.0:
        line = epochs.line[epoch] + 1 + order
        name = lines.columns(line, 3)
    else:
        named = epochs.line[epoch] + order // NAMES_PER_LINE
        column = _FIRST_NAME + 3 * (order % NAMES_PER_LINE)
        name = lines.data[(lines.start[named] + column)[:, None] + np.arange(3)]
        name[column + 3 > lines.length[named]] = _BLANK
        file_system = header.system if header.system in SYSTEMS else "G"
        name[name[:, 0] == _BLANK, 0] = ord(file_system)
        more = np.maximum(-(-count // NAMES_PER_LINE), 1) - 1
        line = (epochs.line + 1 + more)[epoch] + order * lines_per_satellite(header)
    tens, ones = name[:, 1].astype(np.int64) - _ZERO, name[:, 2].astype(np.int64) - _ZERO
    tens[name[:, 1] == _BLANK] = 0
    fine = (tens >= 0) & (tens <= 9) & (ones >= 0) & (ones <= 9)
    fine &= (name[:, 0] >= _LETTERS.start) & (name[:, 0] < _LETTERS.stop)
    number = np.where(fine, tens * 10 + ones, -1)
    number[number == 0] = -1
    return Rows(epoch, name[:, 0], number, line)


def _selected(lines: Lines, rows: Rows, *, header: RinexHeader, systems: frozenset[str] | None, log: FaultLog) -> Rows:
    """Select rows with a valid name, of a known, selected constellation whose types the header declares."""
    broken = rows.number < 0
    log.faults(
        SATELLITES,
        lines.number[rows.line[broken]],
        lambda i: f"no satellite name can be read ('{lines.text(int(rows.line[broken][i]))[:20]}')",
    )
    known = np.isin(rows.letter, np.frombuffer(SYSTEMS.encode(), dtype=np.uint8))
    log.count(UNKNOWN_SYSTEMS, int((~known & ~broken).sum()))
    kept = known & ~broken
    if systems is not None:
        in_selection = np.isin(rows.letter, np.frombuffer("".join(sorted(systems)).encode(), dtype=np.uint8))
        log.count(NOT_SELECTED, int((kept & ~in_selection).sum()))
        kept &= in_selection
    declared = "".join(s for s in SYSTEMS if header.types_of(s) is not None)
    undeclared = kept & ~np.isin(rows.letter, np.frombuffer(declared.encode(), dtype=np.uint8))
    log.faults(
        SATELLITES,
        lines.number[rows.line[undeclared]],
        lambda i: f"satellite {_name(rows[undeclared], i)}: the header has no observation types of its constellation",
    )
    kept &= ~undeclared
    return rows if kept.all() else rows[kept]


def _name(rows: Rows, i: int) -> str:
    return f"{chr(rows.letter[i])}{rows.number[i]:02d}"


def _without_repeats(lines: Lines, rows: Rows, epochs: int, log: FaultLog) -> Rows:
    """Keep the first row of a satellite that occurs twice in an epoch."""
    key = rows.letter.astype(np.int64) * 100 + rows.number
    names, name = np.unique(key, return_inverse=True)
    row = np.arange(len(key))
    last = np.zeros((epochs, len(names)), dtype=np.int64)
    last[rows.epoch, name] = row
    if (last[rows.epoch, name] == row).all():
        return rows
    _, first = np.unique(rows.epoch * len(names) + name, return_index=True)
    repeated = np.ones(len(key), dtype=np.bool_)
    repeated[first] = False
    log.faults(
        SATELLITES,
        lines.number[rows.line[repeated]],
        lambda i: f"satellite {_name(rows[repeated], i)} occurs twice in the epoch",
    )
    return rows[~repeated]


def _values(
    lines: Lines, rows: Rows, system: str, columns: tuple[Column, ...], header: RinexHeader, log: FaultLog
) -> tuple[Rows, Fields]:
    """Parse the selected columns of the satellite lines; rows with faults are dropped and recorded."""
    count = len(header.types_of(system) or ())
    if header.version >= 3.0:
        start, length = lines.start[rows.line] + 3, lines.length[rows.line] - 3
        words = gather(lines.data, start, length, count)
        too_long = _continues(lines.data, start, length, FIELD_WIDTH * count)
    else:
        words, too_long = _gather_lines(lines, rows, count)
    if len(columns) < count:
        words = np.ascontiguousarray(words[:, [c.index for c in columns]])
    fields = parse(words, np.array([c.divisor for c in columns]))
    log.faults(
        SATELLITES,
        lines.number[rows.line[too_long]],
        lambda i: f"the line of {_name(rows[too_long], i)} continues after its {count} declared observations",
    )
    broken = fields.bad.any(axis=1) & ~too_long
    which = np.flatnonzero(broken)

    def message(i: int) -> str:
        j = int(np.argmax(fields.bad[which[i]]))
        text = words[which[i], j].tobytes().decode("latin-1")
        return (
            f"{columns[j].name} of {_name(rows[which], i)} is '{text}', a number with its digits for loss of lock "
            "and signal strength was expected"
        )

    log.faults(SATELLITES, lines.number[rows.line[which]], message)
    fine = ~(broken | too_long)
    if fine.all():
        return rows, fields
    return rows[fine], Fields(fields.value[fine], fields.lock[fine], fields.bad[fine])


def _continues(data: Bytes, start: Integers, length: Integers, width: int) -> Masks:
    """Flag the lines that have non-blank characters after their fields (within one field width)."""
    result = np.zeros(len(start), dtype=np.bool_)
    long = np.flatnonzero(length > width)
    if len(long):
        extra = gather(data, start[long] + width, length[long] - width, 1).view(np.uint8).reshape(len(long), -1)
        result[long] = (extra != _BLANK).any(axis=1)
    return result


def _gather_lines(lines: Lines, rows: Rows, count: int) -> tuple[Words, Masks]:
    """Gather the fields of a RINEX 2 satellite from its lines of five fields."""
    parts = []
    too_long = np.zeros(len(rows.line), dtype=np.bool_)
    for k, first in enumerate(range(0, count, FIELDS_PER_LINE)):
        here = rows.line + k
        fields = min(FIELDS_PER_LINE, count - first)
        parts.append(gather(lines.data, lines.start[here], lines.length[here], fields))
        too_long |= _continues(lines.data, lines.start[here], lines.length[here], FIELD_WIDTH * fields)
    return np.concatenate(parts, axis=1), too_long


def _scatter(parts: list[tuple[str, Rows, Fields, tuple[Column, ...]]], epochs: int) -> Dense:
    """Fill arrays over epochs and channels; channels without any observation are dropped."""
    satellites: list[str] = []
    signals: list[str] = []
    placed = []
    for system, rows, fields, columns in parts:
        numbers, place = np.unique(rows.number, return_inverse=True)
        names = sorted({c.signal for c in columns})
        placed.append((len(satellites) + place * len(names), rows, fields, columns, names))
        satellites += [f"{system}{n:02d}" for n in numbers.tolist() for _ in names]
        signals += names * len(numbers)
    shape = (epochs, len(satellites))
    kinds = tuple(np.full(shape, np.nan) for _ in KINDS)
    lock = np.zeros(shape, dtype=np.uint8)
    for base, rows, fields, columns, names in placed:
        cell = rows.epoch * shape[1] + base
        for j, column in enumerate(columns):
            at = cell + names.index(column.signal)
            value = fields.value[:, j]
            kinds[column.kind].reshape(-1)[at] = np.where(value == 0.0, np.nan, value)
            if KINDS[column.kind] == "L":
                lock.reshape(-1)[at] = fields.lock[:, j]
    used = lock.any(axis=0)
    for array in kinds:
        used |= ~np.isnan(array).all(axis=0)
    keep = np.flatnonzero(used) if not used.all() else slice(None)
    return Dense(
        satellite=np.array(satellites, dtype="<U3")[keep],
        signal=np.array(signals, dtype="<U2")[keep],
        kinds=(kinds[0][:, keep], kinds[1][:, keep], kinds[2][:, keep], kinds[3][:, keep]),
        lock=lock[:, keep],
    )
