"""CRC-24Q checksums of RTCM, SBAS and navigation messages."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Indices, Integers

_CRC24_POLYNOMIAL: Final = 0x1864CFB


def _crc24_table() -> Integers:
    table = np.arange(256, dtype=np.int64) << 16
    for _ in range(8):
        table = np.where(table & 0x800000, table << 1 ^ _CRC24_POLYNOMIAL, table << 1)
    return table & 0xFFFFFF


_CRC24: Final = _crc24_table()


def crc24q(data: Bytes, start: Indices, end: Indices) -> Integers:
    """Compute the CRC-24Q of N byte ranges of a buffer, from `start` up to but excluding `end`, shape (N,)."""
    crc = np.zeros(len(start), dtype=np.int64)
    order = np.argsort(start - end, kind="stable")  # longest first, so that unfinished ranges come first
    first, length = start[order], (end - start)[order]
    state = np.zeros(len(start), dtype=np.int64)
    running = len(start)
    for k in range(int(length[0]) if len(length) else 0):
        while running and length[running - 1] <= k:
            running -= 1
        part = state[:running]
        state[:running] = part << 8 & 0xFFFFFF ^ _CRC24[part >> 16 ^ data[first[:running] + k]]
    crc[order] = state
    return crc
