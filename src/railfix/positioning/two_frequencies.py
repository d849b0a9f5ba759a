"""Combination of the codes on two frequencies into one pseudorange per satellite, with an ionospheric estimate.

The difference between the two corrected codes of a satellite does not depend on the geometry. With ``ratio =
(f1/f2)^2``,

    ``P2 - P1 = B + (ratio - 1) I + e2 - e1``

where I is the error of the modelled ionospheric delay on the first frequency, and B is the receiver delay of P2 minus
the receiver delay of P1. I is the sum of a spatial field (an offset and two gradients, with the sigma of the model as
prior) and a residual of each satellite. I and B are estimated from the mean code differences of all satellites by best
linear prediction. The range is then estimated by least squares from both codes, corrected for the predicted ionospheric
delay. The weights account for the remaining ionospheric error, which differs between the two codes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, channel_sums
from railfix.core.epoch_rows import EVERY
from railfix.core.notebook import NotebookTable
from railfix.core.settings import Settings
from railfix.positioning.noise_windows import correlated_sums
from railfix.ranges.corrected import SecondCodes

_FROM_MEAN_SIZE: Final = 1.2533  #: Inverse of the mean absolute value of a standard normal variable.
_FIRST_SAMPLES: Final = 2.0  #: Number of samples that the prior noise scale of 1 counts as.
_CLIP: Final = 2.5  #: Deviations of a satellite's mean code difference from the fit count as at most this many sigmas.
_LEAST_SUSPICION_M: Final = 3.0  #: Ranges with a smaller absolute `Combined.difference_m` are not suspected [m].


class TwoFrequencyLimits(Settings):
    """Limits of the two-frequency combination."""

    #: Time constant of forgetting code differences. The error of the Klobuchar model changes over many minutes.
    window_s: float = Field(default=600.0, gt=0)
    #: Epochs within this time count together as one sample, because multipath errors at standstill are correlated.
    correlation_s: float = Field(default=60.0, gt=0)
    #: Standard deviation of the error of the difference between the broadcast group delays of two signals.
    delay_sigma_m: float = Field(default=0.2, gt=0)
    #: Ranges are suspected if the code difference minus its prediction exceeds this many standard deviations.
    suspicion: float = Field(default=4.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class TwoFrequencyState:
    """Mean code differences estimated so far, for Q pairs; a pair is two signals of the same satellite."""

    names: tuple[str, ...] = ()  #: Name of each pair.
    #: Information of each pair [1/m^2], followed by information times mean code difference [1/m], shape (2 Q,).
    sums: Floats = field(default_factory=lambda: np.empty(0))
    #: Sum of the absolute normalised code differences, and number of code differences, shape (2,).
    scale: Floats = field(default_factory=lambda: np.zeros(2))
    #: Time of the last epoch, NaT before the first.
    last: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: Time from the start of the log to the last epoch, in window lengths (`noise_windows`).

    def with_pairs(self, names: tuple[str, ...]) -> tuple[TwoFrequencyState, Integers]:
        """Return the state after adding the pairs of a chunk, and the index of each of these pairs in the new state."""
        if names == self.names:
            return self, np.arange(len(names))
        known = {name: i for i, name in enumerate(self.names)}
        fresh = tuple(name for name in names if name not in known)
        known |= {name: len(known) + i for i, name in enumerate(fresh)}
        information, moment = np.split(self.sums, 2)
        none = np.zeros(len(fresh))
        sums = np.concatenate([information, none, moment, none])
        own = replace(self, names=self.names + fresh, sums=sums)
        return own, np.array([known[name] for name in names], dtype=np.intp)


@dataclass(frozen=True, kw_only=True, repr=False)
class Combined(NotebookTable):
    """Pseudoranges from two codes, T epochs by K channels; NaN where only the first code is used."""

    code_m: Floats  #: Combined code, shape (T, K).
    variance_m2: Floats  #: Variance of the combined code minus variance of the first code, shape (T, K).
    share: Floats  #: Weight of the second code, shape (T, K). The weight of the first code is 1 - `share`.
    ionosphere_m: Floats  #: Ionospheric delay on the first frequency minus modelled delay, shape (T, K).
    ionosphere_sigma_m: Floats  #: Standard deviation of `ionosphere_m`, shape (T, K).
    difference_m: Floats  #: Second code minus first code minus predicted difference, shape (T, K).
    suspected: Masks  #: True for ranges whose `difference_m` exceeds its limit, shape (T, K).


def combine_codes(
    time: Datetimes,
    code_m: Floats,
    noise_m: Floats,
    second: SecondCodes,
    field_m: Floats,
    pairs: tuple[tuple[str, ...], Integers],
    state: TwoFrequencyState,
    limits: TwoFrequencyLimits,
) -> tuple[Combined, TwoFrequencyState]:
    """Return combined codes and the new state. The ionospheric delay is estimated from earlier epochs.

    `code_m`, shape (T, K), are corrected first codes, NaN where unusable, and `noise_m` are their noise sigmas.
    `field_m`, shape (T, K, 4), has the sigmas of the error of the modelled ionospheric delay on the first frequency due
    to the offset, the two gradients and the satellite's residual, each with the sign of its effect. `pairs` are the
    names and the groups of Q signal pairs. All pairs of a group have the same receiver delay.
    """
    names, groups = pairs
    own, number = state.with_pairs(names)
    size = len(own.names)
    first, other = noise_m**2, second.noise_m**2
    variance = first + other
    difference = second.code_m - code_m
    both = np.isfinite(difference) & np.isfinite(variance)
    at = number[second.pair] if size else second.pair
    row = np.nonzero(both)[0]
    sample = np.zeros((len(time), 2 * size))
    sample[row, at[both]] = 1.0 / variance[both]
    sample[row, size + at[both]] = difference[both] / variance[both]
    ages = {"window_s": limits.window_s, "correlation_s": limits.correlation_s}
    last_epoch = [(own.last, own.age)]
    before, _, (sums,), ((last, age),) = correlated_sums(time, sample, own.sums[None], (EVERY,), last_epoch, **ages)
    information, mean = np.zeros(both.shape), np.zeros(both.shape)
    information[both] = before[row, at[both]]
    known = both & (information > 0.0)
    mean[known] = before[np.nonzero(known)[0], size + at[known]] / information[known]
    scale, of_scale = _noise_scale(time, difference - mean, variance, known, own, ages)
    # if errors are constant over a time C, the mean over a time T has 1 + T / C independent samples
    of_mean = scale[:, None] / (information + 1.0 / np.where(known, variance, 1.0))
    lever = second.ratio - 1.0
    delay = second.delay_sigma_m**2 + limits.delay_sigma_m**2
    basis = np.where(known[..., None], field_m, 0.0)
    own_m2 = basis[..., 3] ** 2
    error = of_mean + delay + lever**2 * own_m2
    group = np.where(known, groups[second.pair], -1) if size else second.pair
    weight = np.where(known, 1.0 / error, 0.0)
    for _ in range(2):  # in the second pass, outliers have small weights
        field, of_field, bias, of_bias = _fit_field(mean, basis[..., :3], lever, weight, group)
        rest = mean - bias - lever * field
        weight = np.where(known, 1.0 / (error + (rest / _CLIP) ** 2), 0.0)
    rest = np.clip(rest / error, -_CLIP / np.sqrt(error), _CLIP / np.sqrt(error))
    ionosphere = field + lever * own_m2 * rest
    prior = of_field + own_m2
    p1, p2 = code_m - ionosphere, second.code_m - bias - second.ratio * ionosphere - delay * rest
    noise = np.minimum(scale, 1.0)[:, None]
    # both codes are already corrected for the ionospheric error estimated from the mean differences
    untold = of_mean / (error + of_bias + lever**2 * of_field)
    share, total = share_of_second(
        scale[:, None] * first, scale[:, None] * other + untold * (delay + of_bias), second.ratio, untold * prior
    )
    share = np.where(known, share, np.nan)
    apart = np.where(known, p2 - p1, np.nan)
    found = Combined(
        code_m=p1 + share * apart,
        variance_m2=noise * ((1.0 - share) ** 2 * first + share**2 * other - first),
        share=share,
        ionosphere_m=np.where(known, ionosphere, np.nan),
        ionosphere_sigma_m=np.where(known, np.sqrt(prior - (lever * own_m2) ** 2 / error), np.nan),
        difference_m=apart,
        suspected=np.abs(apart) > np.maximum(limits.suspicion * np.sqrt(total), _LEAST_SUSPICION_M),
    )
    return found, TwoFrequencyState(names=own.names, sums=sums, scale=of_scale, last=last, age=age)


def ionosphere_free(
    code_m: Floats, noise_m: Floats, second: SecondCodes, delays_m: tuple[Floats, ...], found: Combined
) -> Combined:
    """Return the ionosphere-free combination of two codes, with `difference_m` and `suspected` as in `found`.

    The combination is ``P = (ratio P1 - P2) / (ratio - 1)``. `delays_m` are the group delays in the corrections of the
    two codes, shape (T, K); they are added back. `found` is the result of `combine_codes`.
    """
    share = np.where(np.isfinite(code_m + second.code_m), -1.0 / (second.ratio - 1.0), np.nan)
    first, other = code_m + delays_m[0], second.code_m + delays_m[1]
    return replace(
        found, code_m=first + share * (other - first),
        variance_m2=(1.0 - share) ** 2 * noise_m**2 + share**2 * second.noise_m**2 - noise_m**2, share=share,
        ionosphere_m=-share * (second.code_m - code_m), ionosphere_sigma_m=-share * np.hypot(noise_m, second.noise_m),
    )  # fmt: skip


def share_of_second(first_m2: Floats, second_m2: Floats, ratio: Floats, ionosphere_m2: Floats) -> tuple[Floats, Floats]:
    """Return the least-squares weight of the second code, and the variance of the code difference.

    The code variances `first_m2` and `second_m2` do not contain the ionospheric error.
    """
    total = first_m2 + second_m2 + (ratio - 1.0) ** 2 * ionosphere_m2
    return (first_m2 - (ratio - 1.0) * ionosphere_m2) / total, total


def _noise_scale(
    time: Datetimes, deviation: Floats, variance: Floats, known: Masks, own: TwoFrequencyState, ages: dict[str, float]
) -> tuple[Floats, Floats]:
    """Return the ratio of actual to assumed variance of the code differences in earlier epochs, and the new sums."""
    size = np.where(known, np.abs(deviation) / np.sqrt(np.where(known, variance, 1.0)), 0.0)
    sample = np.stack([channel_sums(size), channel_sums(known.astype(np.float64))], axis=1)
    last_epoch = [(own.last, own.age)]
    before, _, (after,), _ = correlated_sums(time, sample, own.scale[None], (EVERY,), last_epoch, **ages)
    mean = (_FROM_MEAN_SIZE * before[:, 0] + _FIRST_SAMPLES) / (before[:, 1] + _FIRST_SAMPLES)
    return mean**2, after


def _fit_field(
    mean: Floats, basis: Floats, lever: Floats, weight: Floats, group: Integers
) -> tuple[Floats, Floats, Floats, Floats]:
    """Fit the spatial ionospheric field and the receiver delay of each group to mean code differences.

    Return the field, its variance, the receiver delay and its variance for each channel, shape (T, K) each.
    """
    values = np.concatenate([lever[..., None] * basis, mean[..., None]], axis=-1)
    centre, of_centre = np.zeros(values.shape), np.zeros(mean.shape)
    for number in np.unique(group[group >= 0]).tolist():
        here = group == number
        own = np.where(here, weight, 0.0)
        total = np.where(here.any(axis=1), channel_sums(own), 1.0)
        centre = np.where(here[..., None], (channel_sums(own[..., None] * values) / total[:, None])[:, None], centre)
        of_centre = np.where(here, 1.0 / total[:, None], of_centre)
    apart = values - centre
    normal = channel_sums((weight[..., None] * apart)[..., None] * apart[..., None, :])
    covariance = np.linalg.inv(normal[:, :3, :3] + np.eye(3))
    factors = np.einsum("tij,tj->ti", covariance, normal[:, :3, 3])
    variance = [np.einsum("tki,tij,tkj->tk", at, covariance, at) for at in (basis, centre[..., :3])]
    field, of_centre_m = (np.einsum("tki,ti->tk", at, factors) for at in (basis, centre[..., :3]))
    return field, variance[0], centre[..., 3] - of_centre_m, of_centre + variance[1]
