"""Bit fields of many messages at once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Floats, Integers

#: A field: first bit, number of bits, factor, and how it is coded ("u" unsigned, "s" two's complement,
#: "m" sign and magnitude). A field in pieces is a tuple of (first bit, number of bits) instead of the first two.
Field = tuple[int | tuple[tuple[int, int], ...], int, float, str]

_LONGEST: Final = 62


def unsigned(bits: Bytes, first: int, length: int) -> Integers:
    """Unsigned integers from a bit field, shape (N,)."""
    if length > _LONGEST:
        raise ValueError(f"a field has at most {_LONGEST} bits, {length} were asked for")
    value = np.zeros(len(bits), dtype=np.int64)
    for column in bits[:, first : first + length].T:
        value = value << 1 | column
    return value


def signed(bits: Bytes, first: int, length: int) -> Integers:
    """Integers in two's complement from a bit field, shape (N,)."""
    value = unsigned(bits, first, length)
    return np.where(value >> (length - 1) & 1, value - (1 << length), value)


def sign_magnitude(bits: Bytes, first: int, length: int) -> Integers:
    """Integers as sign and magnitude (GLONASS), shape (N,)."""
    value = unsigned(bits, first + 1, length - 1)
    return np.where(bits[:, first] == 1, -value, value)


def fields(bits: Bytes, layout: Mapping[str, Field]) -> dict[str, Floats]:
    """All fields of a layout, scaled, shape (N,) each, of bits of shape (N, bits)."""
    values = {}
    for name, (where, length, factor, coding) in layout.items():
        if isinstance(where, tuple):
            joined = np.concatenate([bits[:, first : first + count] for first, count in where], axis=1)
            first = 0
        else:
            joined, first = bits, where
        read = {"u": unsigned, "s": signed, "m": sign_magnitude}[coding]
        values[name] = np.asarray(read(joined, first, length) * factor, dtype=np.float64)
    return values
