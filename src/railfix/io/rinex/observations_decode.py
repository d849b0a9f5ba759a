"""Decode satellite lines to arrays of epochs by channels, without Python loops over epochs or channels.

A field of sixteen characters fits in two 64-bit words. The value of eight digits in one word is computed by three
multiplications (L. Lamport, "Multiple byte processing with full-word instructions", CACM 18(8), 1975,
doi:10.1145/360933.360994). The result is an exact number of thousandths, so its division by 1000 equals
``float(text)``. Fields of other forms than F14.3 are read one by one with `float`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from railfix import kernels
from railfix.core.arrays import Bytes, Floats, Indices, Integers, Masks, places_in_groups, take_rows
from railfix.gnss.joined_observations import channels_with_data
from railfix.io.rinex.header import RinexHeader
from railfix.io.rinex.observations_epochs import NOT_SELECTED, SATELLITES, UNKNOWN_SYSTEMS, FaultLog
from railfix.io.rinex.observations_lines import KINDS, SYSTEMS, EpochHeads, Lines, SignalColumn

Words = NDArray[np.uint64]

FIELD_WIDTH: Final = 16  #: Number of characters of an observation, with its two indicators.
#: Number of blanks that must follow a block, because fields are also loaded beyond the end of short lines.
PADDING: Final = 2048

_U = np.uint64
_BLANKS: Final = _U(0x2020202020202020)


_NUMBER: Final = re.compile(r" *[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d{1,2})?")
_DIGIT_OR_BLANK: Final = re.compile("[ 0-9]{2}")

#: Bit masks that keep the first n characters of a field, in two words, n from 0 to 16; shape (17, 2).
_KEEP: Final = np.array(
    [[(1 << 8 * min(n, 8)) - 1, (1 << 8 * max(n - 8, 0)) - 1] for n in range(FIELD_WIDTH + 1)], dtype=np.uint64
)


def gather(data: Bytes, start: Integers, length: Integers, count: int) -> Words:
    """Return `count` fields of each line as pairs of little-endian 64-bit words, shape (n, count, 2); characters beyond
    the end of a line are blanks.
    """
    width = FIELD_WIDTH * count
    if width > PADDING:
        raise ValueError(f"a line of {count} fields is longer than the padding of {PADDING} bytes")
    items = np.ndarray((len(data) - width + 1,), dtype=f"V{width}", buffer=data, strides=(1,))
    words: Words = items[start].view("<u8").reshape(len(start), count, 2)
    short = np.flatnonzero(length < width)
    if len(short):
        first = max(int(length[short].min()) // FIELD_WIDTH, 0)
        columns = FIELD_WIDTH * np.arange(first, count)
        kept = _KEEP[np.clip(length[short, None] - columns, 0, FIELD_WIDTH)]
        rows: Any = slice(None) if len(short) == len(start) else short
        words[rows, first:] = ((words[rows, first:] ^ _BLANKS) & kept) ^ _BLANKS
    return words


def read_fields(
    data: Bytes, start: Integers, length: Integers, index: Indices, divisor: Floats
) -> tuple[Floats, Bytes, Masks]:
    """Return values, loss-of-lock digits and bad-field flags of n satellite lines and k types, shape (n, k) each.

    The value of a blank or bad field is NaN, and its digit is 0. A field is bad if it is neither blank nor a number, or
    if one of its two indicators is neither blank nor a digit. `index` is the field number of each type, and `divisor`
    the type's scale factor (SYS / SCALE FACTOR), shape (k,) each. The other arguments are as in `gather`.
    """
    value, lock, odd = kernels.reading.decode_fields(data, start, length, index, divisor)
    bad = np.zeros(value.shape, dtype=np.bool_)
    row, column = np.nonzero(odd)
    if len(row):
        at = FIELD_WIDTH * index[column]
        read, wrong = _read_slowly(gather(data, start[row] + at, length[row] - at, 1).reshape(-1, 2))
        value[row, column] = read / divisor[column]
        lock[row[wrong], column[wrong]] = 0
        bad[row, column] = wrong
    return value, lock, bad


def _read_slowly(flat: Words) -> tuple[Floats, Masks]:
    """Read right-aligned decimal numbers of any form. Return the values and a mask of bad fields."""
    value = np.full(len(flat), np.nan)
    wrong = np.ones(len(flat), dtype=np.bool_)
    characters = flat.tobytes().decode("latin-1")
    for i in range(len(flat)):
        text = characters[FIELD_WIDTH * i : FIELD_WIDTH * (i + 1)]
        if not _DIGIT_OR_BLANK.fullmatch(text[14:]):
            continue
        if not text[:14].strip():
            wrong[i] = False
        elif _NUMBER.fullmatch(text[:14]):
            value[i] = float(text[:14].replace("D", "E").replace("d", "e"))
            wrong[i] = False
    return value, wrong


_BLANK: Final = ord(" ")
_ZERO: Final = ord("0")
NAMES_PER_LINE: Final = 12  #: Number of satellite names on a full RINEX 2 epoch line.
_FIRST_NAME: Final = 32  #: Column of the first satellite name on a RINEX 2 epoch line, from 0.
#: Number of observations on a full RINEX 2 line.
FIELDS_PER_LINE: Final = 5
_LETTERS: Final = range(ord("A"), ord("Z") + 1)


@dataclass(frozen=True)
class DecodedRows:
    """Satellites of consecutive epochs, one row per satellite and epoch, n rows."""

    epoch: Integers  #: Index of the satellite's epoch, shape (n,).
    letter: Bytes  #: Constellation letter as ASCII code, shape (n,).
    number: Integers  #: Satellite number; -1 if the satellite's name cannot be read, shape (n,).
    line: Integers  #: Index in `Lines` of the satellite's first observation line, shape (n,).

    def __getitem__(self, which: Masks | Integers) -> DecodedRows:
        return take_rows(self, which)


def lines_per_satellite(header: RinexHeader) -> int:
    """Return the number of observation lines per satellite, which is 1 from RINEX 3 on."""
    return max(-(-len(header.get_types("G") or ()) // FIELDS_PER_LINE), 1) if header.version < 3.0 else 1


def decode(
    lines: Lines, epochs: EpochHeads, *, header: RinexHeader, systems: frozenset[str] | None, log: FaultLog
) -> dict[str, Any]:
    """Decode the observations of epochs (flags 0 and 1); return arrays by the field names of `Observations`."""
    rows = _rows(lines, epochs, header)
    rows = _select(lines, rows, header=header, systems=systems, log=log)
    rows = _without_repeats(lines, rows, len(epochs), log)
    parts = []
    for system in SYSTEMS:
        chosen = rows[rows.letter == ord(system)]
        if len(chosen.epoch) and (columns := header.columns(system)):
            chosen, value, lock = _values(lines, chosen, system, columns, header, log)
            parts.append((system, chosen, value, lock, columns))
    return _scatter(parts, len(epochs))


def _rows(lines: Lines, epochs: EpochHeads, header: RinexHeader) -> DecodedRows:
    count = epochs.count
    epoch, order = places_in_groups(count)
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
    return DecodedRows(epoch, name[:, 0], number, line)


def _select(
    lines: Lines, rows: DecodedRows, *, header: RinexHeader, systems: frozenset[str] | None, log: FaultLog
) -> DecodedRows:
    """Return the rows with a valid satellite name and a known, selected and declared constellation; count others."""
    broken = rows.number < 0
    log.faults(
        SATELLITES,
        lines.number[rows.line[broken]],
        lambda i: f"no satellite name can be read ('{lines.text(int(rows.line[broken][i]))[:20]}')",
    )
    known = _is_any(rows.letter, SYSTEMS)
    log.count(UNKNOWN_SYSTEMS, int((~known & ~broken).sum()))
    kept = known & ~broken
    if systems is not None:
        in_selection = _is_any(rows.letter, systems)
        log.count(NOT_SELECTED, int((kept & ~in_selection).sum()))
        kept &= in_selection
    declared = [s for s in SYSTEMS if header.get_types(s) is not None]
    undeclared = kept & ~_is_any(rows.letter, declared)
    log.faults(
        SATELLITES,
        lines.number[rows.line[undeclared]],
        lambda i: f"satellite {_name(rows[undeclared], i)}: the header has no observation types of its constellation",
    )
    kept &= ~undeclared
    return rows if kept.all() else rows[kept]


def _is_any(letter: Bytes, letters: Iterable[str]) -> Masks:
    table = np.zeros(256, dtype=np.bool_)
    table[[ord(each) for each in letters]] = True
    return np.asarray(table[letter])


def _number(key: Integers) -> tuple[Integers, Integers]:
    """Return the distinct numbers in ascending order, and the index of each number among the distinct numbers."""
    occurs = np.zeros(int(key.max(initial=0)) + 1, dtype=np.bool_)
    occurs[key] = True
    return np.flatnonzero(occurs), (np.cumsum(occurs) - 1)[key]


def _name(rows: DecodedRows, i: int) -> str:
    return f"{chr(rows.letter[i])}{rows.number[i]:02d}"


def _without_repeats(lines: Lines, rows: DecodedRows, epochs: int, log: FaultLog) -> DecodedRows:
    """Keep the first row of each satellite in an epoch. Further rows of the satellite are recorded as faults."""
    key = rows.letter.astype(np.int64) * 100 + rows.number
    names, name = _number(key)
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
    lines: Lines, rows: DecodedRows, system: str, columns: tuple[SignalColumn, ...], header: RinexHeader, log: FaultLog
) -> tuple[DecodedRows, Floats, Bytes]:
    """Return the rows, values and loss-of-lock digits in `columns`. Rows with faults are omitted, but recorded."""
    count = len(header.get_types(system) or ())
    width, before = (count, 3) if header.version >= 3.0 else (FIELDS_PER_LINE, 0)
    too_long = np.zeros(len(rows.line), dtype=np.bool_)
    parts = []
    for k, first in enumerate(range(0, count, width)):
        line = rows.line + k
        start, length = lines.start[line] + before, lines.length[line] - before
        too_long |= _continues(lines.data, start, length, FIELD_WIDTH * min(width, count - first))
        here = [column for column in columns if first <= column.index < first + width]
        if here:
            index, divisor = np.array([c.index - first for c in here]), np.array([c.divisor for c in here])
            parts.append(read_fields(lines.data, start, length, index, divisor))
    value, lock, bad = (
        blocks[0] if len(blocks) == 1 else np.concatenate(blocks, axis=1) for blocks in zip(*parts, strict=True)
    )
    log.faults(
        SATELLITES,
        lines.number[rows.line[too_long]],
        lambda i: f"the line of {_name(rows[too_long], i)} continues after its {count} declared observations",
    )
    broken = bad.any(axis=1) & ~too_long
    which = np.flatnonzero(broken)

    def message(i: int) -> str:
        j = int(np.argmax(bad[which[i]]))
        line, place = divmod(columns[j].index, width)
        text = lines.text(int(rows.line[which[i]]) + line)[before + FIELD_WIDTH * place :][:FIELD_WIDTH]
        return (
            f"{columns[j].name} of {_name(rows[which], i)} is '{text:<{FIELD_WIDTH}}', a number with its digits for "
            "loss of lock and signal strength was expected"
        )

    log.faults(SATELLITES, lines.number[rows.line[which]], message)
    fine = ~(broken | too_long)
    return (rows, value, lock) if fine.all() else (rows[fine], value[fine], lock[fine])


def _continues(data: Bytes, start: Integers, length: Integers, width: int) -> Masks:
    """Return whether each line has non-blank characters in the 16 columns after its fields."""
    result = np.zeros(len(start), dtype=np.bool_)
    long = np.flatnonzero(length > width)
    if len(long):
        extra = gather(data, start[long] + width, length[long] - width, 1).view(np.uint8).reshape(len(long), -1)
        result[long] = (extra != _BLANK).any(axis=1)
    return result


def _scatter(
    parts: list[tuple[str, DecodedRows, Floats, Bytes, tuple[SignalColumn, ...]]], epochs: int
) -> dict[str, Any]:
    """Arrange decoded values in arrays of epochs by channels. Channels without any observation are omitted."""
    satellites: list[str] = []
    signals: list[str] = []
    placed = []
    for system, rows, value, digit, columns in parts:
        numbers, place = _number(rows.number)
        names = sorted({c.signal for c in columns})
        placed.append((len(satellites) + place * len(names), rows, value, digit, columns, names))
        satellites += [f"{system}{n:02d}" for n in numbers.tolist() for _ in names]
        signals += names * len(numbers)
    shape = (epochs, len(satellites))
    kinds, lock = np.full((len(KINDS), *shape), np.nan), np.zeros(shape, dtype=np.uint8)
    for base, rows, value, digit, columns, names in placed:
        cell = rows.epoch * shape[1] + base
        kind, signal = np.array([c.kind for c in columns]), np.array([names.index(c.signal) for c in columns])
        kernels.reading.place_fields(kinds, lock, cell, kind, signal, value, digit)
    used = channels_with_data(kinds, lock)
    keep = np.flatnonzero(used) if not used.all() else slice(None)
    names_of = {"satellite": np.array(satellites, dtype="<U3")[keep], "signal": np.array(signals, dtype="<U2")[keep]}
    return {**names_of, **dict(zip(KINDS.values(), kinds[:, :, keep], strict=True)), "loss_of_lock": lock[:, keep]}
