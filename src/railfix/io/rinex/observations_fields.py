"""Parsing of observation fields (F14.3, I1, I1), sixteen characters at a time as two integers.

A field of RINEX is sixteen characters: ten of sign and digits, a point, three decimals, the
loss-of-lock digit and the signal-strength digit. Two 64-bit words hold it, and eight digits in
one integer become their value in three multiplications (the "SIMD within a register" of
L. Lamport, "Multiple byte processing with full-word instructions", CACM 18(8), 1975,
doi:10.1145/360933.360994). The value is an exact integer of thousandths divided by 1000, hence
the double nearest to the text: the same as ``float(text)``. Fields of any other form (other
decimals, an exponent, letters) are marked and read one at a time with `float`.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from railfix import kernels
from railfix.core.arrays import Bytes, Floats, Indices, Integers, Masks

Words = NDArray[np.uint64]

#: Characters of one field.
FIELD_WIDTH: Final = 16
#: Blank characters that must follow the last character of a block, so that loads may run over it.
PADDING: Final = 2048

_U = np.uint64
_BLANKS: Final = _U(0x2020202020202020)


_NUMBER: Final = re.compile(r" *[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d{1,2})?")
_DIGIT_OR_BLANK: Final = re.compile("[ 0-9]{2}")

#: Words that keep the first 0..16 characters of a field, shape (17, 2).
_KEEP: Final = np.array(
    [[(1 << 8 * min(n, 8)) - 1, (1 << 8 * max(n - 8, 0)) - 1] for n in range(FIELD_WIDTH + 1)], dtype=np.uint64
)


@dataclass(frozen=True)
class Fields:
    """Values of fields, shape (n, k): n satellite lines by k observation types.

    Attributes
    ----------
    value : ndarray of float64
        NaN where blank, and where `bad`.
    lock : ndarray of uint8
        Loss-of-lock digit, 0 where blank.
    bad : ndarray of bool
        The field is neither blank nor a number, or one of its two indicators is no digit.
    """

    value: Floats
    lock: Bytes
    bad: Masks


def joined(parts: Sequence[Fields]) -> Fields:
    """Return the fields of the same satellites side by side."""
    arrays = ([getattr(part, name) for part in parts] for name in ("value", "lock", "bad"))
    return Fields(*(np.concatenate(some, axis=1) for some in arrays))


def gather(data: Bytes, start: Integers, length: Integers, count: int) -> Words:
    """Gather fields of lines as pairs of 64-bit words; characters beyond the end of a line are blank.

    Parameters
    ----------
    data : ndarray of uint8
        Text, followed by at least `PADDING` bytes.
    start, length : ndarray of int64, shape (n,)
        Where the first field of each line starts, and how many characters the line has from there
        (less than zero counts as none).
    count : int
        Number of fields of a line.

    Returns
    -------
    ndarray of uint64, shape (n, count, 2)
        Little-endian words: the first character is the lowest byte.
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


def read_fields(data: Bytes, start: Integers, length: Integers, index: Indices, divisor: Floats) -> Fields:
    """Read some fields of lines (`index`, shape (k,)); `data`, `start` and `length` are as for `gather`.

    Values are divided by `divisor`, shape (k,) (SYS / SCALE FACTOR; 1 where there is none).
    """
    value, lock, odd = kernels.reading.decoded_fields(data, start, length, index, divisor)
    bad = np.zeros(value.shape, dtype=np.bool_)
    row, column = np.nonzero(odd)
    if len(row):
        at = FIELD_WIDTH * index[column]
        read, wrong = _read_slowly(gather(data, start[row] + at, length[row] - at, 1).reshape(-1, 2))
        value[row, column] = read / divisor[column]
        lock[row[wrong], column[wrong]] = 0
        bad[row, column] = wrong
    return Fields(value, lock, bad)


def _read_slowly(flat: Words) -> tuple[Floats, Masks]:
    """Read fields of another form: any decimal number that ends at the end of the field."""
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
