"""Receiver noise scale and single-epoch sigma.

Two scales are estimated from earlier epochs, as root mean squares with exponential forgetting. The robust scale is
estimated from the ranges of each epoch that agree with each other. This scale is used in the RAIM test, and does not
depend on the results of RAIM. The stated scale is estimated from the ranges that RAIM accepted, and is used in every
sigma and protection level. Epochs that RAIM did not resolve, and epochs off the map, contribute to neither scale.
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
    """Limits of the estimation of a receiver's noise scale."""

    #: Time constant of exponential forgetting. Code errors are correlated over about 20 s (0.6 after 10 s on
    #: recordings). Five correlation times contain enough independent samples for a mean. They are short enough that the
    #: effect of one street or station decays before the next one.
    window_s: float = Field(default=100.0, gt=0)
    #: Weight of the prior scale, as a number of redundant ranges; the default corresponds to two or three epochs. With
    #: infinity, the scale remains the prior scale.
    prior: float = Field(default=20.0, gt=0)
    least_epochs: float = Field(default=20.0, ge=1)  #: Fewest epochs in the window; gaps are not counted.
    #: Degrees of freedom of the model of the scale's variation between epochs. The noise of single epochs varies more
    #: than chi-square predicts, so the variance stated for an epoch combines the window's variance, weighted by this
    #: number, with the epoch's squared residuals. Student's t of recorded code errors also has 4 degrees of freedom.
    spread: float = Field(default=4.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class NoiseState:
    """Decayed sums of the noise scales, after the last epoch."""

    #: Time of the last epoch; NaT before the first.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: Age of the last epoch since the start of the log [windows].
    #: Weighted sum of squared residuals, and degrees of freedom, of the ranges kept by the robust fit; shape (2,).
    robust: Floats = field(default_factory=lambda: np.zeros(2))
    #: The same two sums for the ranges accepted by RAIM, shape (2,).
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
    """Return the ranges' standard deviation divided by the assumed value, shape (T,), and the new sums, (A, 2).

    The ratio (1 in P4) is the root mean square of the normalised residuals of earlier epochs, with exponential
    forgetting and the a-priori value `prior`, shape (T,). The ratio is at least `least`; if `limits.prior` is infinite,
    residuals are not used. Only epochs in the mask `teaching` are used. `start`, shape (A, 2), are the sums after the
    previous epochs.
    """
    use = teaching & (freedom > 0) & np.isfinite(wsse)
    values = np.array([np.where(use, wsse, 0.0), np.where(use, freedom, 0)], dtype=np.float64).T
    before, after = windows.sums(values, start)
    if np.isinf(limits.prior):
        return np.maximum(prior, least), after
    scale = np.sqrt((before[:, 0] + limits.prior * prior**2) / (before[:, 1] + limits.prior))
    return np.maximum(scale, least), after


def epoch_variance(scale: Floats, wsse: Floats, redundancy: Integers, *, limits: NoiseScaleLimits) -> Floats:
    """Return the variance of the ranges of each epoch relative to their weights, shape (T,).

    The prior of the variance is a scaled inverse chi-square distribution with `spread` degrees of freedom about the
    variance of the window. The result is the scale of the posterior distribution given the residuals of the epoch.
    """
    freedom = np.where(np.isfinite(wsse), np.maximum(redundancy, 0), 0)
    own = np.where(freedom > 0, np.fmax(wsse, 0.0), 0.0)
    return np.asarray((limits.spread * scale**2 + own) / (limits.spread + freedom))


def epoch_sigma_m(redundancy: Integers, wsse: Floats, sigma_m: Floats, scale: Floats) -> Floats:
    """Return the single-epoch sigma along the line, shape (T,) [m].

    The sigma is the standard deviation from the weights, times the larger of the receiver's scale and the scale of the
    epoch's residuals, times the ratio of the 97.5 % quantiles of Student's t and of the normal distribution.
    """
    freedom = np.maximum(redundancy, 1)
    shown = np.sqrt(np.maximum(wsse, 0.0) / freedom)
    widened = scipy.special.stdtrit(np.minimum(freedom, _MOST_FREEDOM), 0.975) / scipy.special.ndtri(0.975)
    return np.asarray(sigma_m * np.maximum(scale, shown) * widened)


#: Huber's tuning constant [sigma]: 95 % efficiency for normal errors.
HUBER: Final = 1.345
_ROUNDS: Final = 10  #: Number of reweightings.


@dataclass(frozen=True, kw_only=True)
class RobustClock:
    """Robust receiver clocks of T epochs and G groups, from K channels."""

    clock_m: Floats  #: NaN with fewer than `least_ranges` ranges, shape (T, G).
    share: Floats  #: Weight of each channel in the clock estimate of its group; 0 for unused channels; shape (T, K).


def robust_clock(
    residual_m: Floats, sigma_m: Floats, groups: tuple[slice, ...], *, least_ranges: int = 4
) -> RobustClock:
    """Estimate the receiver clock of each group of channels as the Huber-weighted mean of residuals.

    `residual_m`, shape (T, K), are range errors plus the clock, and `sigma_m` their standard deviations; channels with
    NaN are left out. The iteration starts from the median. `least_ranges` is the fewest ranges for an estimate.
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
