"""Numbers out of message bits, all messages of a type at once."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Datetimes, Floats, Integers, Masks
from railfix.core.timescale import seconds, timedelta

_DAY: Final = 86_400.0


class Fields:
    """Bit fields of messages of one layout.

    Parameters
    ----------
    bits : ndarray of uint8, shape (n, 32)
        As in `SbasLog.bits`.
    """

    def __init__(self, bits: Bytes) -> None:
        self._bits = np.unpackbits(np.ascontiguousarray(bits), axis=1)

    def unsigned(self, start: int, length: int) -> Integers:
        """Unsigned number of `length` bits from bit `start` on, shape (n,)."""
        weights = np.int64(1) << np.arange(length - 1, -1, -1, dtype=np.int64)
        return np.asarray(self._bits[:, start : start + length].astype(np.int64) @ weights)

    def signed(self, start: int, length: int) -> Integers:
        """The same in two's complement, shape (n,)."""
        value = self.unsigned(start, length)
        return np.where(value >> (length - 1), value - (np.int64(1) << length), value)

    def positive(self, start: int, length: int, unit: float) -> Floats:
        """Unsigned number times its unit, shape (n,)."""
        return np.asarray(self.unsigned(start, length) * unit, dtype=np.float64)

    def real(self, start: int, length: int, unit: float) -> Floats:
        """Signed number times its unit, shape (n,)."""
        return np.asarray(self.signed(start, length) * unit, dtype=np.float64)

    def unsigned_row(self, start: int, length: int, count: int, step: int | None = None) -> Integers:
        """`count` unsigned numbers, each `step` bits (its own length) after the one before, shape (n, count)."""
        width = length if step is None else step
        return np.stack([self.unsigned(start + i * width, length) for i in range(count)], axis=1)

    def signed_row(self, start: int, length: int, count: int) -> Integers:
        """`count` signed numbers one after another, shape (n, count)."""
        return np.stack([self.signed(start + i * length, length) for i in range(count)], axis=1)

    def real_row(self, start: int, length: int, count: int, unit: float) -> Floats:
        """The same times their unit, shape (n, count)."""
        return np.asarray(self.signed_row(start, length, count) * unit, dtype=np.float64)

    def flags(self, start: int, count: int) -> Masks:
        """Single bits, shape (n, count)."""
        return np.asarray(self._bits[:, start : start + count] != 0)


def day_time(time_of_day_s: Floats, near: Datetimes) -> Datetimes:
    """The instant with a time of day that lies nearest to another instant; NaT where it is NaN."""
    midnight = near.astype("datetime64[D]").astype("datetime64[ns]")
    offset = time_of_day_s - seconds(near - midnight)
    return np.asarray(near + timedelta(offset - _DAY * np.rint(offset / _DAY)), dtype="datetime64[ns]")
