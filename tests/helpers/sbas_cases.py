"""SBAS messages built field by field: those of the simulator's encoder, and types that it does not send."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from railfix.ranges.sbas import SbasMessages
from railfix.simulate.sbas_service import (
    factors,
    fast,
    grid_delay,
    grid_mask,
    half,
    integrity,
    long_term,
    mask,
    message,
    mixed,
    parameters,
)

START = np.datetime64("2025-02-15T12:00:00", "ns")


def message_log(rows: Sequence[tuple[float, int, np.ndarray]], prn: int = 137) -> SbasMessages:
    """Log of (second of reception, PRN or 0 for the usual one, message) in the order of time."""
    rows = sorted(rows, key=lambda row: row[0])
    bits = np.array([row[2] for row in rows], dtype=np.uint8).reshape(-1, 32)
    count = len(rows)
    return SbasMessages(
        time=START + np.array([round(row[0] * 1e9) for row in rows], dtype="timedelta64[ns]"),
        prn=np.array([row[1] or prn for row in rows], dtype=np.int64),
        type=(bits[:, 1] >> 2).astype(np.int64),
        bits=bits,
        parity_bits=np.full(count, 24),
        source=np.zeros(count, dtype=np.int64),
        line=np.arange(1, count + 1),
        sources=("cases",),
    )


def moving(
    second: int,
    slot: int,
    iode: int,
    position: Sequence[float],
    velocity: Sequence[int],
    clock: int,
    rate: int,
    time_of_day: int,
    iodp: int = 0,
) -> np.ndarray:
    """Type 25 of velocity code 1, one satellite in the first half; velocities and clock are raw numbers."""
    first = [
        (1, 1), (slot, 6), (iode, 8), *((round(v / 0.125), 11) for v in position), (clock, 11),
        *((v, 8) for v in velocity), (rate, 8), (time_of_day // 16, 13), (iodp, 2),
    ]  # fmt: skip
    return message(25, second, *first, *half([], iodp))


def service(
    second: int,
    *,
    inside: int,
    outside: int,
    regions: Sequence[tuple[int, int, int, int, int]],
    issue: int = 0,
    messages: int = 1,
    number: int = 1,
    priority: int = 0,
) -> np.ndarray:
    """Type 27; regions (latitude 1, longitude 1, latitude 2, longitude 2, square)."""
    head = [(issue, 3), (messages - 1, 3), (number - 1, 3), (len(regions), 3), (priority, 2), (inside, 4), (outside, 4)]
    corners = [field for a, b, c, d, s in regions for field in ((a, 8), (b, 9), (c, 8), (d, 9), (s, 1))]
    return message(27, second, *head, *corners)


def covariance(
    second: int, slot: int, exponent: int, diagonal: Sequence[int], upper: Sequence[int], iodp: int = 0
) -> np.ndarray:
    """Type 28 of one satellite (slot from 1): E11 E22 E33 E44, E12 E13 E14 E23 E24 E34."""
    fields = [(iodp, 2), (slot, 6), (exponent, 3), *((v, 9) for v in diagonal), *((v, 10) for v in upper)]
    return message(28, second, *fields)


__all__ = [
    "START",
    "covariance",
    "factors",
    "fast",
    "grid_delay",
    "grid_mask",
    "integrity",
    "long_term",
    "mask",
    "message",
    "message_log",
    "mixed",
    "moving",
    "parameters",
    "service",
]
