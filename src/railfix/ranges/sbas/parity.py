"""The 24-bit parity of SBAS messages and their three preambles, for all messages at once."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Bytes, Integers

#: CRC-24Q, x^24 included (DO-229D, A.4.3.3).
POLYNOMIAL: Final = 0x1864CFB
#: First eight bits of three successive messages (DO-229D, A.4.3.1).
PREAMBLES: Final = (0x53, 0x9A, 0xC6)
#: Preamble, type and data; parity; bytes a message takes in `SbasLog.bits`.
DATA_BITS: Final = 226
PARITY_BITS: Final = 24
ROW_BYTES: Final = 32


def _table() -> Integers:
    value = np.arange(256, dtype=np.int64) << 16
    for _ in range(8):
        value = value << 1
        value = np.where(value & 0x1000000, value ^ POLYNOMIAL, value)
    return value


_TABLE: Final = _table()


def crc24q(rows: Bytes) -> Integers:
    """Parity of whole bytes, first bit first.

    Parameters
    ----------
    rows : ndarray of uint8, shape (N, B)

    Returns
    -------
    ndarray of int64, shape (N,)
        24 bits.
    """
    crc = np.zeros(len(rows), dtype=np.int64)
    for column in rows.T:
        crc = ((crc << 8) & 0xFFFFFF) ^ _TABLE[(crc >> 16) ^ column]
    return crc


def message_parity(bits: Bytes) -> Integers:
    """Parity that belongs to the 226 data bits of each message, shape (N,).

    Parameters
    ----------
    bits : ndarray of uint8, shape (N, 32)
        Messages from their first bit on.
    """
    # Six zero bits in front make whole bytes of 226 bits and do not change the parity.
    data = bits[:, :29].astype(np.int64)
    before = np.concatenate([np.zeros((len(bits), 1), dtype=np.int64), data[:, :-1]], axis=1)
    return crc24q((((before << 2) & 0xFF) | (data >> 6)).astype(np.uint8))


def carried_parity(bits: Bytes) -> Integers:
    """The 24 bits that stand after the data bits of each message, shape (N,)."""
    tail = bits[:, 28:32].astype(np.int64)
    return ((tail[:, 0] & 0x3F) << 18) | (tail[:, 1] << 10) | (tail[:, 2] << 2) | (tail[:, 3] >> 6)


def with_parity(bits: Bytes) -> Bytes:
    """The same messages with the parity that belongs to them, shape (N, 32); what follows it is zero."""
    whole = np.zeros((len(bits), ROW_BYTES), dtype=np.uint8)
    whole[:, :29] = bits[:, :29]
    parity = message_parity(whole)
    whole[:, 28] = (whole[:, 28] & 0xC0) | (parity >> 18).astype(np.uint8)
    whole[:, 29] = ((parity >> 10) & 0xFF).astype(np.uint8)
    whole[:, 30] = ((parity >> 2) & 0xFF).astype(np.uint8)
    whole[:, 31] = ((parity << 6) & 0xFF).astype(np.uint8)
    return whole


def preamble_number(bits: Bytes) -> Integers:
    """0, 1 or 2 for the three preambles, -1 for anything else, shape (N,)."""
    number = np.full(len(bits), -1, dtype=np.int64)
    for i, preamble in enumerate(PREAMBLES):
        number[bits[:, 0] == preamble] = i
    return number
