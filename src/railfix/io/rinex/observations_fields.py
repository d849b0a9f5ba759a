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

from railfix.core.arrays import Bytes, Floats, Indices, Integers, Masks
from railfix.kernels import compiled_by

Words = NDArray[np.uint64]

#: Characters of one field.
FIELD_WIDTH: Final = 16
#: Blank characters that must follow the last character of a block, so that loads may run over it.
PADDING: Final = 2048
#: Fields parsed at a time, so that the intermediate arrays stay in the processor's cache.
_CHUNK: Final = 16384

_U = np.uint64
_BLANKS: Final = _U(0x2020202020202020)
_ZEROS: Final = _U(0x3030303030303030)
#: As `_ZEROS`, with the decimal point at byte 2.
_ZEROS_POINT: Final = _U(0x30303030302E3030)
_NOT_A_DIGIT: Final = _U(0x1010101010101010)
_MINUS: Final = _U(0x0D0D0D0D0D0D0D0D)
_BYTE: Final = _U(0xFF)
_LOW_2: Final = _U(0x000000000000FFFF)
_LOW_6: Final = _U(0x0000FFFFFFFFFFFF)
_DECIMALS: Final = _U(0x0000FFFFFF000000)
_OVER_NINE: Final = _U(0x0606060606060606)
_HIGH_NIBBLES: Final = _U(0xF0F0F0F0F0F0F0F0)
_PAIRS: Final = _U(0x000000FF000000FF)

_OVER_NINE_6: Final = _OVER_NINE & _LOW_6
_BLANKS_6: Final = _BLANKS & _LOW_6
_POINT: Final = _U(0x0000000000FF0000)

#: Loss-of-lock digit by the last two characters of a field, where these are blanks or digits.
_TAIL_WRONG: Final = 255
_TAIL: Final = np.full(1 << 16, _TAIL_WRONG, dtype=np.uint8)
for _lock in b" 0123456789":
    for _strength in b" 0123456789":
        _TAIL[_lock | _strength << 8] = 0 if _lock == ord(" ") else _lock - ord("0")

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
    value, lock, odd = decoded_fields(data, start, length, index, divisor)
    bad = np.zeros(value.shape, dtype=np.bool_)
    row, column = np.nonzero(odd)
    if len(row):
        at = FIELD_WIDTH * index[column]
        read, wrong = _read_slowly(gather(data, start[row] + at, length[row] - at, 1).reshape(-1, 2))
        value[row, column] = read / divisor[column]
        lock[row[wrong], column[wrong]] = 0
        bad[row, column] = wrong
    return Fields(value, lock, bad)


@compiled_by("reading")
def decoded_fields(
    data: Bytes, start: Integers, length: Integers, index: Indices, divisor: Floats
) -> tuple[Floats, Bytes, Masks]:
    """Decode the fields of the usual form, shape (n, k); the arguments are those of `read_fields`.

    Values, NaN where blank or of another form; loss-of-lock digits (uint8), 255 where the last two characters are
    neither blanks nor digits; and which fields have another form.
    """
    words = gather(data, start, length, int(index.max()) + 1)
    if len(index) < words.shape[1]:
        words = np.ascontiguousarray(words[:, index])
    shape = (len(start), len(index))
    value, lock, odd = np.empty(shape), np.empty(shape, dtype=np.uint8), np.empty(shape, dtype=np.bool_)
    per = divisor * 1000.0
    step = max(_CHUNK // shape[1], 1)
    for first in range(0, shape[0], step):
        part = slice(first, first + step)
        thousandths, other = _thousandths(words[part].reshape(-1, 2), lock[part])
        thousandths[other] = np.nan
        np.divide(thousandths.reshape(-1, shape[1]), per, out=value[part])
        odd[part] = other.reshape(-1, shape[1])
    return value, lock, odd


def _thousandths(flat: Words, lock: Bytes) -> tuple[Floats, Masks]:
    """Compute the thousandths of each field (NaN where blank), and flag the fields of another form."""
    first = flat[:, 0]
    high = first ^ _ZEROS  # digits become 0..9, a blank 0x10, a minus 0x1D
    low = flat[:, 1] ^ _ZEROS_POINT  # as high; the point becomes 0
    # Blanks and sign before the digits, as masks of whole bytes from the lowest byte up.
    lead_high = ((high & _NOT_A_DIGIT) >> _U(4)) * _BYTE
    lead_low = ((low & _NOT_A_DIGIT & _LOW_2) >> _U(4)) * _BYTE
    sign_high = (high ^ _NOT_A_DIGIT) & lead_high
    sign_low = (low ^ _NOT_A_DIGIT) & lead_low
    digits = high & ~lead_high
    decimals = low & ~lead_low & _LOW_6
    # The remaining characters must be digits and the point a point.
    wrong = ((digits + _OVER_NINE) | (decimals + _OVER_NINE_6)) & _HIGH_NIBBLES
    wrong |= low & _POINT
    wrong |= lead_high & (lead_high + _U(1))
    wrong |= lead_low & (lead_low + _U(1))
    # A sign is a minus directly before the digits; all characters before it are blank.
    wrong |= sign_high ^ (_sign_place(lead_high) * (sign_high != 0))
    wrong |= sign_low ^ (_sign_place(lead_low) * (sign_low != 0))
    spilled = lead_low != 0
    empty_high = first == _BLANKS
    odd = wrong != 0
    odd |= spilled & ~empty_high
    blank = empty_high & ((flat[:, 1] & _LOW_6) == _BLANKS_6)
    odd &= ~blank
    tail = _TAIL[flat.view("<u2")[:, 7]]
    odd |= tail == _TAIL_WRONG
    lock.reshape(-1)[:] = tail
    thousandths = _eight_digits(digits).astype(np.float64)
    thousandths *= 100_000.0
    thousandths += _eight_digits(((decimals & _LOW_2) << _U(24)) | ((decimals & _DECIMALS) << _U(16)))
    np.negative(thousandths, out=thousandths, where=(sign_high | sign_low) != 0)
    thousandths[blank] = np.nan
    return thousandths, odd


def _sign_place(lead: Words) -> Words:
    """Return a minus (as in `high`) at the last of the leading bytes."""
    place: Words = (lead ^ (lead >> _U(8))) & _MINUS
    return place


def _eight_digits(word: Words) -> Words:
    """Compute the value of eight digits, the lowest byte the most significant."""
    word = word * _U(10) + (word >> _U(8))
    low = (word & _PAIRS) * _U(100 + (1_000_000 << 32))
    high = ((word >> _U(16)) & _PAIRS) * _U(1 + (10_000 << 32))
    total: Words = (low + high) >> _U(32)
    return total


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
