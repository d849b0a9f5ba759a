"""Fault detection with the sum of squared residuals (P4: chi-square test; P1 2.3(4): 100 m^2), and fault exclusion.

Leaving out a set E of satellites is equivalent to estimating a bias for each satellite of E. The estimated biases are
``b_E = S_EE^-1 nu_E``. The weighted sum of squared residuals (WSSE) decreases by ``nu_E^T b_E``, and the position
changes by ``-Q B_E^T b_E``. The symbols are defined in `position_model`. Every satellite and every pair can thus be
tested without a new solution.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache
from typing import Final, Literal, Self

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from railfix.core.arrays import Codes, Floats, Indices, Integers, Masks
from railfix.core.constants import LEAST_REDUNDANCY
from railfix.core.settings import Settings
from railfix.integrity.raim.position_model import Compact, LinearModel, compact

_TABLE_STEP: Final = 64  #: The number of thresholds in a table is a multiple of this number.


class RaimLimits(Settings):
    """Limits of fault detection, fault exclusion and reliability."""

    mode: Literal["chi_square", "fixed"] = "chi_square"  #: Threshold from `false_alarm` (P4) or `fixed_limit_m2` (P1).
    #: Probability that noise alone is detected as a fault; 0.001 in P4. In mode "chi_square", the error of an excluded
    #: satellite must also be significant at this probability.
    false_alarm: float = Field(default=1e-3, gt=0, lt=1)
    #: Probability with which the minimal detectable fault is missed. P4 states no value.
    missed_detection: float = Field(default=1e-3, gt=0, lt=1)
    #: In mode "fixed", limit of the sum of squared residuals, and lower limit of an excluded satellite's squared error;
    #: P1 table 6 ("FDE 2 SAT, 100 m2").
    fixed_limit_m2: float = Field(default=100.0, gt=0)
    #: Largest number of satellites excluded at an epoch; 2 in P1 2.3(4).
    max_excluded: int = Field(default=2, ge=0, le=2)
    min_redundancy: int = Field(default=1, ge=1)  #: Minimum degrees of freedom that remain after an exclusion.
    #: Probability that noise alone makes the WSSE of the correct exclusion exceed the WSSE of a competing exclusion by
    #: more than the separation (chi-square, one degree of freedom). An epoch is inseparable if another exclusion of as
    #: many satellites passes and its WSSE exceeds the smallest WSSE by less than the separation.
    separation_risk: float = Field(default=1e-3, gt=0, le=1)
    #: Exclusions do not compete if their positions are closer than this distance, because the choice hardly changes the
    #: position (for example, between two satellites that alone share a clock). With 0, exclusions always compete.
    same_position_m: float = Field(default=0.0, ge=0)
    #: Two-sided probability that the position noise exceeds the noise part K sigma of the protection level. A value of
    #: 1 means K = 0, as in ``HSlope sigma0 sqrt(lambda)`` of P4.
    noise_risk: float = Field(default=1e-3, gt=0, le=1)
    alarm_limit_m: float = Field(default=20.0, gt=0)  #: Alarm limit of the level. P4 accepts a car length, 20 m.
    faults: int = Field(default=1, ge=1, le=2)  #: Number of simultaneous faults that the level covers; 1 in paper P4.

    @model_validator(mode="after")
    def _rates_below_one(self) -> Self:
        if not self.false_alarm + self.missed_detection < 1.0:
            raise ValueError("false_alarm and missed_detection must add up to less than 1")
        return self

    @cached_property
    def separation(self) -> float:
        """Difference between the WSSEs of two exclusions below which an epoch is inseparable, in noise variances."""
        return float(scipy.special.chdtri(1, self.separation_risk))

    @cached_property
    def own_error(self) -> float:
        """Squared normalised error below which a satellite is not excluded."""
        return float(scipy.special.chdtri(1, self.false_alarm))


@dataclass(frozen=True, kw_only=True)
class Detection:
    """Result of fault detection at T epochs."""

    #: Test statistic, shape (T,): WSSE divided by the squared noise scale, or in mode "fixed" the sum of squared
    #: residuals [m^2]. NaN without a position.
    statistic: Floats
    threshold: Floats  #: Threshold of the statistic, shape (T,); NaN where not testable.
    freedom: Integers  #: Degrees of freedom, shape (T,).
    detected: Masks  #: True where the statistic reaches or exceeds the threshold, shape (T,).
    testable: Masks  #: True where at least one range is redundant, shape (T,).


def detect(
    wsse: ArrayLike,
    residual_m: ArrayLike,
    freedom: ArrayLike,
    *,
    limits: RaimLimits | None = None,
    scale: ArrayLike = 1.0,
) -> Detection:
    """Test the residuals of each position for a fault (P4: ``T >= T_D``).

    The arguments are results of a solver, or attributes of a `LinearModel`.

    Parameters
    ----------
    wsse : array_like, shape (T,)
        Weighted sum of squared residuals; NaN without a position.
    residual_m : array_like, shape (T, M) [m]
        Residuals, 0 or NaN for unused channels; used in mode "fixed" only. `LinearModel.residual_m` includes the map
        error, `Constrained.residual_m` does not. They are equal only for an exact map (sigma of a millimetre), as in
        P1.
    freedom : array_like of int, shape (T,)
        Ranges minus unknowns: ``ranges.n_used - ranges.n_clocks - 1`` on the line, ``- 3`` instead of ``- 1`` in space.
    scale : array_like, shape (T,) or ()
        Ratio of the receiver's range sigma to the range sigma assumed in the weights. Not used in fixed mode.
    """
    limits = limits or RaimLimits()
    freedom = np.asarray(freedom, dtype=np.int64)
    if limits.mode == "chi_square":
        statistic = np.asarray(wsse, dtype=np.float64) / np.asarray(scale, dtype=np.float64) ** 2
    else:
        squares = np.nansum(np.asarray(residual_m, dtype=np.float64) ** 2, axis=1)
        statistic = np.where(np.isfinite(wsse), squares, np.nan)
    testable = (freedom >= 1) & np.isfinite(statistic)
    limit = np.where(testable, threshold(freedom, limits=limits), np.nan)
    return Detection(
        statistic=statistic, threshold=limit, freedom=freedom, detected=statistic >= limit, testable=testable
    )


def threshold(freedom: ArrayLike, *, limits: RaimLimits | None = None) -> Floats:
    """Return the threshold of the test statistic for each number of degrees of freedom; NaN below 1.

    Example (P4): for a false-alarm rate of 0.001 and 3 degrees of freedom, T_CS = 16.27 and T_D = sqrt(T_CS) = 4.03.
    """
    limits = limits or RaimLimits()
    freedom = np.asarray(freedom, dtype=np.int64)
    if limits.mode == "fixed":
        return np.where(freedom >= 1, limits.fixed_limit_m2, np.nan)
    size = int(freedom.max(initial=0)) // _TABLE_STEP + 1
    return np.asarray(_chi_square_table(limits.false_alarm, size * _TABLE_STEP)[np.maximum(freedom, 0)])


@lru_cache(maxsize=64)
def _chi_square_table(false_alarm: float, size: int) -> Floats:
    """Return the chi-square thresholds for 0 to size - 1 degrees of freedom; NaN for 0."""
    table = np.full(size, np.nan)
    table[1:] = scipy.special.chdtri(np.arange(1, size), false_alarm)
    table.flags.writeable = False
    return table


_ROUNDING: Final = 1e-9  #: Relative difference within which two WSSE count as equal.
_BLOCK_SIZE: Final = 40_000  #: Largest number of elements of a block's array; the array fits into the cache of a core.


class Outcome(IntEnum):
    """Result of fault detection and exclusion at an epoch."""

    #: The test statistic is within its threshold.
    PASSED = 0
    #: One satellite is excluded, and the remaining satellites pass.
    EXCLUDED_ONE = 1
    #: Two satellites are excluded, and the remaining satellites pass.
    EXCLUDED_TWO = 2
    #: A fault is detected, but no satellite is excluded because two exclusions explain the fault about equally well.
    INSEPARABLE = 3
    #: A fault is detected, and no permitted exclusion passes.
    UNRESOLVED = 4
    #: There is no redundant range, or no position.
    UNTESTABLE = 5


@dataclass(frozen=True, kw_only=True)
class Exclusion:
    """Result of the exclusion of satellites at T epochs with M channels."""

    outcome: Codes  #: `Outcome`, shape (T,).
    excluded: Masks  #: True for excluded channels, shape (T, M).
    #: Channels of the passing exclusion with the smallest statistic, even at inseparable epochs, shape (T, 2). The
    #: second is -1 for a single channel; both are -1 if no exclusion passes.
    best: Indices
    #: Channels of the next best passing exclusion of as many channels, shape (T, 2); unused entries are -1. At
    #: inseparable epochs, only competing exclusions are considered.
    alternative: Indices
    #: Range error of each channel of `best`, positive if the range is too long, shape (T, M); NaN for other channels.
    own_error_m: Floats
    #: Test statistic without the channels of `best`, or with all channels where no subset passes, shape (T,).
    statistic_after: Floats
    #: Position change caused by leaving out `best`, shape (T, k); 0 where no subset passes. The components are along
    #: the line (k = 1), or east and north (k = 2).
    position_change_m: Floats
    #: Distance between the positions without `best` and without `alternative`, shape (T,); NaN if either is missing.
    alternative_shift_m: Floats
    detection: Detection  #: Fault detection before any exclusion.


@dataclass(frozen=True)
class _Trial:
    """Results of leaving out each of K subsets of equal size at T epochs."""

    members: Indices  # (K, 1 or 2), indices in the compact arrays
    statistic: Floats  # (T, K) test statistic of the remaining channels
    wsse_drop: Floats  # (T, K)
    own: tuple[Floats, ...]  # (T, K) error of each member in sigmas
    allowed: Masks  # (T, K) all members are used, tested by other channels, and have errors above the limit


def exclude(model: LinearModel, *, limits: RaimLimits | None = None, scale: ArrayLike = 1.0) -> Exclusion:
    """Detect faults, and exclude a single satellite or a pair from each faulty epoch.

    A subset can be excluded if the remaining ranges pass with at least `min_redundancy` degrees of freedom. In
    addition, the error of each excluded satellite must be significant (`false_alarm`) or, in mode "fixed", exceed
    ``sqrt(fixed_limit_m2)``. Single satellites are preferred to pairs. Of several subsets, the one with the smallest
    statistic is excluded. The epoch is inseparable if another subset of equal size could also be excluded and noise can
    explain the difference between the statistics (`separation_risk`). `scale` is the noise scale (see `detect`).
    """
    limits = limits or RaimLimits()
    epochs, channels = model.root_weight.shape
    scale = np.broadcast_to(np.asarray(scale, dtype=np.float64), (epochs,))
    detection = detect(model.wsse, model.residual_m, model.freedom, limits=limits, scale=scale)
    result = Exclusion(
        outcome=np.where(detection.testable, Outcome.PASSED, Outcome.UNTESTABLE).astype(np.int8),
        excluded=np.zeros((epochs, channels), dtype=bool),
        best=np.full((epochs, 2), -1, dtype=np.intp),
        alternative=np.full((epochs, 2), -1, dtype=np.intp),
        own_error_m=np.full((epochs, channels), np.nan),
        statistic_after=detection.statistic.copy(),
        position_change_m=np.zeros((epochs, model.interest)),
        alternative_shift_m=np.full(epochs, np.nan),
        detection=detection,
    )
    failing = np.flatnonzero(detection.detected)
    result.outcome[failing] = Outcome.UNRESOLVED
    used = np.count_nonzero(model.used[failing], axis=1)
    # Epochs are sorted by number of satellites, so that block arrays are small.
    failing = failing[np.argsort(used, kind="stable")]
    widest = int(used.max(initial=1))
    size = max(1, _BLOCK_SIZE // (widest * widest))
    for first in range(0, len(failing), size):
        block = failing[first : first + size]
        _exclude_block(result, block, model.take(block), scale[block], limits)
    return result


def _exclude_block(result: Exclusion, epochs: Indices, model: LinearModel, scale: Floats, limits: RaimLimits) -> None:
    """Write the exclusions of a block of epochs into `result`; pairs are tried where no single satellite passes."""
    parts, wsse, freedom = compact(model), model.wsse, model.freedom
    for size in range(1, limits.max_excluded + 1):
        going = np.flatnonzero(
            (result.outcome[epochs] == Outcome.UNRESOLVED) & (freedom - size >= limits.min_redundancy)
        )
        if not len(going):
            return
        if len(going) < len(epochs):
            epochs, parts, wsse, freedom, scale = (
                epochs[going], parts.take(going), wsse[going], freedom[going], scale[going],
            )  # fmt: skip
        trial = _singles(parts, wsse, scale, limits) if size == 1 else _pairs(parts, wsse, scale, limits)
        _choose(result, epochs, parts, trial, threshold(freedom - size, limits=limits), scale, limits)


def _singles(parts: Compact, wsse: Floats, scale: Floats, limits: RaimLimits) -> _Trial:
    """Return the results of leaving out each single channel."""
    n = parts.channel.shape[1]
    share = np.einsum("tii->ti", parts.projector)
    checked = parts.used & (share > LEAST_REDUNDANCY)
    safe = np.where(checked, share, 1.0)
    own = parts.residual / safe
    drop = parts.residual * own
    if limits.mode == "chi_square":
        statistic = (wsse[:, None] - drop) / scale[:, None] ** 2
        over = drop > limits.own_error * scale[:, None] ** 2  # `drop` is own^2 divided by its variance 1/S_ii
    else:
        total, linear, square = _sum_squares(parts)
        statistic = total[:, None] - 2.0 * own * linear + own**2 * np.einsum("tii->ti", square)
        over = (own * parts.sigma_m) ** 2 > limits.fixed_limit_m2
    return _Trial(np.arange(n)[:, None], statistic, drop, (own,), checked & over)


def _pairs(parts: Compact, wsse: Floats, scale: Floats, limits: RaimLimits) -> _Trial:
    """Return the results of leaving out each pair of channels."""
    n = parts.channel.shape[1]
    i, j = np.triu_indices(n, 1)
    flat = parts.projector.reshape(len(parts.projector), n * n)
    share = np.einsum("tii->ti", parts.projector)
    a, b, c = share[:, i], np.take(flat, i * n + j, axis=1), share[:, j]
    one, two = parts.residual[:, i], parts.residual[:, j]
    product = a * c
    determinant = product - b * b
    single = parts.used & (share > LEAST_REDUNDANCY)
    checked = single[:, i] & single[:, j] & (determinant > LEAST_REDUNDANCY * product)
    inverse = 1.0 / np.where(checked, determinant, 1.0)
    own_one, own_two = (c * one - b * two) * inverse, (a * two - b * one) * inverse
    drop = one * own_one + two * own_two
    if limits.mode == "chi_square":
        variance = scale[:, None] ** 2
        statistic = (wsse[:, None] - drop) / variance
        # The variance of the first error is (S_EE^-1)_11 = c / determinant.
        bound = limits.own_error * variance * inverse
        over = (own_one**2 > bound * c) & (own_two**2 > bound * a)
    else:
        total, linear, square = _sum_squares(parts)
        own_square = np.einsum("tii->ti", square)
        statistic = total[:, None] - 2.0 * (own_one * linear[:, i] + own_two * linear[:, j])
        statistic += own_one**2 * own_square[:, i] + own_two**2 * own_square[:, j]
        statistic += 2.0 * own_one * own_two * square[:, i, j]
        sigma = parts.sigma_m
        over = np.minimum((own_one * sigma[:, i]) ** 2, (own_two * sigma[:, j]) ** 2) > limits.fixed_limit_m2
    return _Trial(np.stack([i, j], axis=1), statistic, drop, (own_one, own_two), checked & over)


def _sum_squares(parts: Compact) -> tuple[Floats, Floats, Floats]:
    """Return ``|V nu|^2``, ``S V^2 nu`` and ``S V^2 S`` with the sigmas V, for sums of squared residuals [m^2].

    The whitened residuals without the channels E are ``nu - S_E b_E``.
    """
    metres = parts.residual * parts.sigma_m
    weighted = parts.projector * parts.sigma_m[:, None, :]
    linear = np.einsum("tij,tj->ti", weighted, metres)
    return (metres**2).sum(axis=1), linear, weighted @ weighted.swapaxes(1, 2)


def _choose(
    result: Exclusion, epochs: Indices, parts: Compact, trial: _Trial, after: Floats, scale: Floats, limits: RaimLimits
) -> None:
    """Write each epoch's best passing subset and closest competing subset into `result`."""
    passing = trial.allowed & (trial.statistic < after[:, None])
    rows = np.flatnonzero(passing.any(axis=1))
    if not len(rows):
        return
    passing, statistic, drop = passing[rows], trial.statistic[rows], trial.wsse_drop[rows]
    at = np.arange(len(rows))
    best = np.argmin(np.where(passing, statistic, np.inf), axis=1)
    passing[at, best] = False
    shift = _moves(parts, trial, rows)
    apart = np.linalg.norm(shift - shift[at, best][:, None, :], axis=2)
    most = drop[at, best][:, None]
    margin = limits.separation * scale[rows, None] ** 2 + _ROUNDING * most
    rival = passing & (most - drop <= margin) & ~(apart < limits.same_position_m)
    inseparable = rival.any(axis=1)
    second = np.argmin(np.where(np.where(inseparable[:, None], rival, passing), statistic, np.inf), axis=1)
    has_second = passing.any(axis=1)

    where, size = epochs[rows], trial.members.shape[1]
    channel = parts.channel[rows]
    accepted = Outcome.EXCLUDED_ONE if size == 1 else Outcome.EXCLUDED_TWO
    result.outcome[where] = np.where(inseparable, Outcome.INSEPARABLE, accepted)
    for k in range(size):
        place = trial.members[best, k]
        chosen = channel[at, place]
        result.best[where, k] = chosen
        result.alternative[where, k] = np.where(has_second, channel[at, trial.members[second, k]], -1)
        result.excluded[where[~inseparable], chosen[~inseparable]] = True
        result.own_error_m[where, chosen] = trial.own[k][rows, best] * parts.sigma_m[rows, place]
    result.statistic_after[where] = statistic[at, best]
    result.position_change_m[where] = shift[at, best]
    result.alternative_shift_m[where] = np.where(has_second, apart[at, second], np.nan)


def _moves(parts: Compact, trial: _Trial, rows: Indices) -> Floats:
    """Return the position change caused by leaving out each subset, shape (rows, K, k) [m]."""
    moves = np.zeros((len(rows), len(trial.members), parts.gain_m.shape[2]))
    for k, own in enumerate(trial.own):
        moves -= parts.gain_m[rows][:, trial.members[:, k]] * own[rows][..., None]
    return moves


def worst_channel(model: LinearModel) -> Indices:
    """Return the channel whose removal reduces the WSSE most, shape (T,); 0 if no range is tested."""
    share = model.redundancy
    checked = model.used & (share > LEAST_REDUNDANCY)
    drop = np.where(checked, model.residual**2 / np.where(checked, share, 1.0), 0.0)
    return np.asarray(np.argmax(drop, axis=1), dtype=np.intp)
