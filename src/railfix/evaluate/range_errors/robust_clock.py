"""The receiver clock behind residuals of a known place, not carried away by multipath."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Floats

#: Huber's limit, in sigmas: 95 % efficient on normal errors.
HUBER: Final = 1.345
_ROUNDS: Final = 10


@dataclass(frozen=True, kw_only=True)
class RobustClock:
    """Clocks of T epochs, G groups, K channels.

    Attributes
    ----------
    clock_m : ndarray, shape (T, G) [m]
        NaN where too few ranges tell.
    share : ndarray, shape (T, K)
        Part of a channel's own error that went into its clock; 0 for channels that had no say.
    """

    clock_m: Floats
    share: Floats


def robust_clock(
    residual_m: Floats, sigma_m: Floats, groups: tuple[slice, ...], *, least_ranges: int = 4
) -> RobustClock:
    """Weighted mean of the residuals of each group by Huber's weights, started at their median.

    Parameters
    ----------
    residual_m : ndarray, shape (T, K) [m]
        Range errors plus the clock; NaN where a range has no say.
    sigma_m : ndarray, shape (T, K) [m]
    groups : tuple of slice
        Channels of one receiver clock.
    least_ranges : int
        With fewer of them a group has no clock.

    Returns
    -------
    RobustClock
    """
    clock = np.full((len(residual_m), len(groups)), np.nan)
    share = np.zeros(residual_m.shape)
    for g, group in enumerate(groups):
        part, sigma = residual_m[:, group], sigma_m[:, group]
        says = np.isfinite(part) & np.isfinite(sigma)
        rows = np.flatnonzero(says.sum(axis=1) >= least_ranges)
        if not len(rows):
            continue
        part, says = np.where(says, part, np.nan)[rows], says[rows]
        root = np.where(says, 1.0 / np.where(says, sigma[rows], 1.0), 0.0)
        value = np.nanmedian(part, axis=1)
        away = np.where(says, part, 0.0)
        for _ in range(_ROUNDS):
            score = np.abs(away - value[:, None]) * root
            weight = root**2 * np.minimum(1.0, HUBER / np.maximum(score, 1e-12))
            total = weight.sum(axis=1)
            value = (weight * away).sum(axis=1) / total
        clock[rows, g] = value
        share[rows, group] = weight / total[:, None]
    return RobustClock(clock_m=clock, share=share)
