"""Receiver noise scale and single-epoch sigma.

Two scales are estimated from earlier epochs, as root mean squares with exponential forgetting: the robust one, from the
ranges of each epoch that agree with each other, for the RAIM test, which does not influence it; and the stated one,
from the ranges that RAIM accepted, for every sigma and protection level. Epochs that RAIM did not resolve, and epochs
off the map, contribute to neither.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import scipy
from pydantic import Field

from railfix.core.arrays import Floats, Integers, Masks, channel_sums
from railfix.core.settings import Settings
from railfix.positioning.noise_windows import Windows

#: Student's t is evaluated at no more than this many degrees of freedom.
_MOST_FREEDOM: Final = 128


class NoiseScaleLimits(Settings):
    """Estimation of a receiver's noise scale."""

    #: Time constant of forgetting. Code errors are correlated over about 20 s (0.6 after 10 s on recordings): five such
    #: times give enough independent samples for a mean, and are short enough for a street or station to be forgotten
    #: before the next one.
    window_s: float = Field(default=100.0, gt=0)
    #: Weight of the prior scale of 1 as a number of redundant ranges: two or three epochs. Infinite keeps the scale at
    #: 1.
    prior: float = Field(default=20.0, gt=0)
    least_epochs: float = Field(default=20.0, ge=1)  #: Fewest epochs in the window, gaps left out.
    #: Degrees of freedom of the scale from epoch to epoch: the noise of single epochs varies more than chi-square
    #: predicts, so the variance stated for an epoch combines the window's variance, counted this many times, with the
    #: variance of its own residuals. 4 is also the Student t of code errors on recordings.
    spread: float = Field(default=4.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class NoiseState:
    """Decayed sums behind the noise scales, after the last epoch."""

    #: Of the last epoch; NaT before the first.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: Of the last epoch [windows].
    #: Weighted sum of squared residuals, and degrees of freedom: of the ranges kept by the robust fit, and of the
    #: ranges accepted by RAIM; shape (2,).
    robust: Floats = field(default_factory=lambda: np.zeros(2))
    remaining: Floats = field(default_factory=lambda: np.zeros(2))


def noise_scale(
    windows: Windows,
    wsse: Floats,
    freedom: Integers,
    teaching: Masks,
    prior: Floats,
    start: Floats,
    *,
    limits: NoiseScaleLimits,
    least: float = 0.0,
) -> tuple[Floats, Floats]:
    """Return the ratio of the ranges' standard deviation to the assumed one (P4: 1), and new sums.

    Root mean square of the residuals of the epochs before, with forgetting, around a prior scale, shape (T,); it is at
    least `least`. `start`: sums before (A, 2).
    """
    use = teaching & (freedom > 0) & np.isfinite(wsse)
    values = np.array([np.where(use, wsse, 0.0), np.where(use, freedom, 0)], dtype=np.float64).T
    before, after = windows.sums(values, start)
    if np.isinf(limits.prior):
        return np.maximum(prior, least), after
    scale = np.sqrt((before[:, 0] + limits.prior * prior**2) / (before[:, 1] + limits.prior))
    return np.maximum(scale, least), after


def epoch_variance(scale: Floats, wsse: Floats, redundancy: Integers, *, limits: NoiseScaleLimits) -> Floats:
    """Return the variance of the ranges of each epoch against their weights, shape (T,).

    Posterior mean of a variance that scatters about the window's variance with `spread` degrees of freedom (scaled
    inverse chi-square distribution), given the epoch's own residuals.
    """
    freedom = np.where(np.isfinite(wsse), np.maximum(redundancy, 0), 0)
    own = np.where(freedom > 0, np.fmax(wsse, 0.0), 0.0)
    return np.asarray((limits.spread * scale**2 + own) / (limits.spread + freedom))


def epoch_sigma_m(redundancy: Integers, wsse: Floats, sigma_m: Floats, scale: Floats) -> Floats:
    """Return the single-epoch sigma along the line, shape (T,) [m].

    The standard deviation by the weights, times the larger of the receiver's scale and the scale of the epoch's own
    residuals, widened as Student's t where the redundancy is small.
    """
    freedom = np.maximum(redundancy, 1)
    shown = np.sqrt(np.maximum(wsse, 0.0) / freedom)
    widened = scipy.special.stdtrit(np.minimum(freedom, _MOST_FREEDOM), 0.975) / scipy.special.ndtri(0.975)
    return np.asarray(sigma_m * np.maximum(scale, shown) * widened)


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
    """Return the receiver clock of each group of channels: Huber-weighted mean of residuals, starting at their median.

    `residual_m`, `sigma_m`, shape (T, K): range errors plus the clock, NaN is ignored; `least_ranges`: fewest ranges
    for a clock estimate.
    """
    clock = np.full((len(residual_m), len(groups)), np.nan)
    share = np.zeros(residual_m.shape)
    for g, group in enumerate(groups):
        part, sigma = residual_m[:, group], sigma_m[:, group]
        valid = np.isfinite(part) & np.isfinite(sigma)
        rows = (valid.sum(axis=1) >= least_ranges).nonzero()[0]
        if not len(rows):
            continue
        part, valid = np.where(valid, part, np.nan)[rows], valid[rows]
        root = np.where(valid, 1.0 / np.where(valid, sigma[rows], 1.0), 0.0)
        value = np.nanmedian(part, axis=1)
        residual = np.where(valid, part, 0.0)
        for _ in range(_ROUNDS):
            score = np.abs(residual - value[:, None]) * root
            weight = root**2 * np.minimum(1.0, HUBER / np.maximum(score, 1e-12))
            total = channel_sums(weight)
            value = channel_sums(weight * residual) / total
        clock[rows, g] = value
        share[rows, group] = weight / total[:, None]
    return RobustClock(clock_m=clock, share=share)
