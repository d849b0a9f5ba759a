"""Robust receiver clock estimate from residuals at a known position."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Floats

#: Huber's tuning constant [sigma]: 95 % efficiency for normal errors.
HUBER: Final = 1.345
_ROUNDS: Final = 10


@dataclass(frozen=True, kw_only=True)
class RobustClock:
    """Clocks of T epochs, G groups, K channels."""

    clock_m: Floats  #: NaN with fewer than `least_ranges` ranges, shape (T, G).
    share: Floats  #: Weight of each channel in its clock estimate; 0 for channels not used; shape (T, K).


def robust_clock(
    residual_m: Floats, sigma_m: Floats, groups: tuple[slice, ...], *, least_ranges: int = 4
) -> RobustClock:
    """Receiver clock of each group: Huber-weighted mean of the residuals, starting at their median.

    Parameters
    ----------
    residual_m, sigma_m : ndarray, shape (T, K) [m]
        Range errors plus the clock; NaN is ignored.
    groups : tuple of slice
        Channels of one receiver clock.
    least_ranges : int
        Fewest ranges from which a clock is estimated.
    """
    clock = np.full((len(residual_m), len(groups)), np.nan)
    share = np.zeros(residual_m.shape)
    for g, group in enumerate(groups):
        part, sigma = residual_m[:, group], sigma_m[:, group]
        valid = np.isfinite(part) & np.isfinite(sigma)
        rows = np.flatnonzero(valid.sum(axis=1) >= least_ranges)
        if not len(rows):
            continue
        part, valid = np.where(valid, part, np.nan)[rows], valid[rows]
        root = np.where(valid, 1.0 / np.where(valid, sigma[rows], 1.0), 0.0)
        value = np.nanmedian(part, axis=1)
        residual = np.where(valid, part, 0.0)
        for _ in range(_ROUNDS):
            score = np.abs(residual - value[:, None]) * root
            weight = root**2 * np.minimum(1.0, HUBER / np.maximum(score, 1e-12))
            total = weight.sum(axis=1)
            value = (weight * residual).sum(axis=1) / total
        clock[rows, g] = value
        share[rows, group] = weight / total[:, None]
    return RobustClock(clock_m=clock, share=share)
