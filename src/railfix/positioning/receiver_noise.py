"""Receiver noise scale and single-epoch sigma.

A noise scale is the ratio of the actual to the assumed standard deviation of ranges. Two scales are estimated from
earlier epochs, with exponential forgetting. The robust scale, from ranges that agree with each other, is used in the
RAIM test and does not depend on the results of RAIM. The stated scale, from ranges accepted by RAIM, is used in sigmas
and protection levels. Epochs with unresolved faults and epochs off the map contribute to neither scale.
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

#: Larger numbers of degrees of freedom count as this number in the quantile of Student's t.
_MOST_FREEDOM: Final = 128


class NoiseScaleLimits(Settings):
    """Limits of the estimation of noise scales."""

    #: Time constant of exponential forgetting. The default is five correlation times of code errors (about 20 s; the
    #: correlation is 0.6 after 10 s on recordings). This window contains enough independent samples for a mean, and the
    #: effect of one street or station decays before the next one.
    window_s: float = Field(default=100.0, gt=0)
    #: Weight of the prior scale, as a number of redundant ranges. The default corresponds to two or three epochs. With
    #: infinity, the scale is always the prior scale.
    prior: float = Field(default=20.0, gt=0)
    least_epochs: float = Field(default=20.0, ge=1)  #: Minimum window length in epochs.
    #: Degrees of freedom with which the variance of the window enters the variance of an epoch. The variance of an
    #: epoch also includes the epoch's squared residuals, because the noise varies more between epochs than chi-square
    #: predicts. The default is the number of degrees of freedom of Student's t for recorded code errors.
    spread: float = Field(default=4.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class NoiseState:
    """State of the noise scales after a chunk: sums with exponential forgetting."""

    #: Time of the last epoch; NaT before the first.
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: Time from the start of the log to the last epoch, in window lengths (`noise_windows`).
    #: Weighted sum of squared residuals, and sum of degrees of freedom, of ranges kept by the robust fit, shape (2,).
    robust: Floats = field(default_factory=lambda: np.zeros(2))
    #: The same two sums as in `robust`, computed from the ranges accepted by RAIM, shape (2,).
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
    """Return the noise scale, shape (T,), and the new sums, shape (A, 2).

    The noise scale (1 in P4) is the root mean square of the normalised residuals of those earlier epochs that
    `teaching` marks, with exponential forgetting. It is at least `least`. The prior value is `prior`, shape (T,); if
    `limits.prior` is infinite, only this value is used. `start`, shape (A, 2), are the sums of the previous chunk.
    """
    use = teaching & (freedom > 0) & np.isfinite(wsse)
    values = np.array([np.where(use, wsse, 0.0), np.where(use, freedom, 0)], dtype=np.float64).T
    before, after = windows.sums(values, start)
    if np.isinf(limits.prior):
        return np.maximum(prior, least), after
    scale = np.sqrt((before[:, 0] + limits.prior * prior**2) / (before[:, 1] + limits.prior))
    return np.maximum(scale, least), after


def epoch_variance(scale: Floats, wsse: Floats, redundancy: Integers, *, limits: NoiseScaleLimits) -> Floats:
    """Return the ratio of the range variance of each epoch to the variance assumed in the weights, shape (T,).

    The prior is a scaled inverse chi-square distribution with `spread` degrees of freedom and the variance of the
    window. The result is the scale of the posterior distribution, given the residuals of the epoch.
    """
    freedom = np.where(np.isfinite(wsse), np.maximum(redundancy, 0), 0)
    own = np.where(freedom > 0, np.fmax(wsse, 0.0), 0.0)
    return np.asarray((limits.spread * scale**2 + own) / (limits.spread + freedom))


def epoch_sigma_m(redundancy: Integers, wsse: Floats, sigma_m: Floats, scale: Floats) -> Floats:
    """Return the single-epoch sigma along the line, shape (T,) [m].

    The sigma is a product of three factors: the standard deviation `sigma_m` from the weights; the larger of the noise
    scale and the scale of the epoch's residuals; and the ratio of the 97.5 % quantiles of Student's t and the normal
    distribution.
    """
    freedom = np.maximum(redundancy, 1)
    shown = np.sqrt(np.maximum(wsse, 0.0) / freedom)
    widened = scipy.special.stdtrit(np.minimum(freedom, _MOST_FREEDOM), 0.975) / scipy.special.ndtri(0.975)
    return np.asarray(sigma_m * np.maximum(scale, shown) * widened)


#: Huber's tuning constant in sigmas, for 95 % efficiency with normal errors.
HUBER: Final = 1.345
_ROUNDS: Final = 10  #: Number of reweightings.


@dataclass(frozen=True, kw_only=True)
class RobustClock:
    """Robust receiver clocks of G groups of K channels at T epochs."""

    clock_m: Floats  #: Receiver clocks, shape (T, G); NaN with too few ranges.
    share: Floats  #: Weight of each channel in its clock estimate, shape (T, K); 0 for unused channels.


def robust_clock(
    residual_m: Floats, sigma_m: Floats, groups: tuple[slice, ...], *, least_ranges: int = 4
) -> RobustClock:
    """Estimate the receiver clock of each group of channels as the Huber-weighted mean of residuals.

    `residual_m`, shape (T, K), are range errors plus the clock, and `sigma_m` their standard deviations; channels with
    NaN are not used. The iteration starts from the median. At least `least_ranges` ranges are required.
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
