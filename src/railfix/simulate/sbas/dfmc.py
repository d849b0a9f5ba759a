"""Messages of dual-frequency SBAS (L5) from their fields: types 0, 31, 32, 34, 35, 36, 37, 63."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from railfix.core.arrays import Bytes, Floats
from railfix.ranges.sbas.dfmc import AUGMENTED, PREAMBLES
from railfix.simulate.sbas.service import Field, packed


def message(kind: int, second: int, *fields: Field) -> Bytes:
    """Message of a type, its preamble by its second, with parity, shape (32,).

    The fields (value, length) lie from bit 10 on, negative values in two's complement. ValueError: one does not fit.
    """
    return packed(f"{PREAMBLES[second % 6]:04b}{kind:06b}", kind, fields)


def mask(second: int, slots: Collection[int], iodm: int = 0) -> Bytes:
    """Type 31: satellites by their slots."""
    return message(31, second, *((int(slot in slots), 1) for slot in range(1, 215)), (iodm, 2))


def correction(
    second: int,
    slot: int,
    issue: int,
    moved: Sequence[float],
    rates: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    *,
    time_of_day_s: float,
    covariance: tuple[int, Floats] = (5, np.eye(4)),
    dfrei: int = 3,
) -> Bytes:
    """Type 32: position and clock [m], their rates [m/s], and the upper triangular factor of the covariance.

    `covariance`: exponent, and the factor in units of 2^(exponent - 5).
    """
    exponent, factor = covariance
    values = [(round(v / 0.0625), 11) for v in moved[:3]] + [(round(moved[3] / 0.03125), 12)]
    values += [(round(v * 2**11), 8) for v in rates[:3]] + [(round(rates[3] * 2**12), 9)]
    upper = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    return message(
        32, second, (slot, 8), (issue, 10), *values, (round(time_of_day_s / 16.0), 13), (exponent, 3),
        *((round(float(factor[k, k])), 9) for k in range(4)), *((round(float(factor[i, j])), 10) for i, j in upper),
        (dfrei, 4), (15, 4),
    )  # fmt: skip


def changes(second: int, change: Sequence[int], dfrei: Sequence[int] = (), iodm: int = 0) -> Bytes:
    """Type 34: for each satellite of the mask 0 nothing new, 1 the next of `dfrei`, 2 one more, 3 do not use."""
    every = [*change, *([0] * (AUGMENTED - len(change)))]
    grades = [*dfrei, *([0] * (7 - len(dfrei)))]
    return message(34, second, *((c, 2) for c in every), *((g, 4) for g in grades), (0, 2), (iodm, 2))


def integrity(second: int, dfrei: Sequence[int], *, kind: int = 35, iodm: int = 0) -> Bytes:
    """Types 35 and 36: indicators of the first 53 satellites of the mask, and of the others."""
    count = 53 if kind == 35 else 39
    fields = [(grade, 4) for grade in [*dfrei, *([15] * (count - len(dfrei)))]]
    return message(kind, second, *fields, (0, 2 if kind == 35 else 58), (iodm, 2))


def parameters(
    second: int,
    *,
    valid_s: float = 120.0,
    covariance: float = 0.0,
    degradation: tuple[float, float, float] = (0.0, 0.0, 0.0),
    scale: int = 0,
) -> Bytes:
    """Type 37: one degradation (interval [s], step [m], rate [m/s]) of all constellations, one code of the scale."""
    interval, step, rate = degradation
    each = [(round(interval / 6.0), 5), (round(step / 0.01), 8), (round(rate / 0.0002), 8)]
    valid = (round(valid_s / 6.0), 6)
    return message(
        37, second, valid, valid, (0, 6), (round(covariance / 0.1), 7), *(each * 6), *([(scale, 4)] * 15), (0, 3)
    )
