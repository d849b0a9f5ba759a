"""Fault exclusion: the one or two satellites that disagree with the rest.

P1 2.3(4) excludes up to two satellites, and only those whose error is over the limit. Leaving out
the satellites E is the same as giving each an unknown bias: against the rest their own errors are
``b_E = S_EE^-1 nu_E``, the WSSE falls by ``nu_E^T b_E``, the position moves by ``-Q B_E^T b_E``.
So every single satellite and every pair is tried without solving anything again.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Codes, Floats, Indices, Masks
from railfix.integrity.raim.detection import Detection, RaimLimits, detect, threshold
from railfix.integrity.raim.model import Compact, LinearModel, compact
from railfix.kernels.layout import LEAST_REDUNDANCY

#: Share of a WSSE within which two are the same number.
_ROUNDING: Final = 1e-9
#: Numbers of a subset array that a block of epochs holds: about what a core's cache does.
_BLOCK_SIZE: Final = 40_000


class Outcome(IntEnum):
    """Result of fault detection and exclusion at an epoch."""

    #: The residuals are within the noise.
    PASSED = 0
    #: One satellite excluded; the rest passes.
    EXCLUDED_ONE = 1
    #: Two satellites excluded; the rest passes.
    EXCLUDED_TWO = 2
    #: A fault, but another exclusion of as many satellites explains it as well: none is made.
    INSEPARABLE = 3
    #: A fault, and no exclusion that is allowed passes.
    UNRESOLVED = 4
    #: No redundant range, or no position.
    UNTESTABLE = 5


@dataclass(frozen=True, kw_only=True)
class Exclusion:
    """Exclusions of T epochs by M channels."""

    outcome: Codes  #: `Outcome`, shape (T,).
    excluded: Masks  #: Channels to leave out; none unless the outcome is EXCLUDED_ONE or EXCLUDED_TWO; shape (T, M).
    #: Channels of the subset that leaves the least statistic, of those that pass; -1 where none. Given for INSEPARABLE
    #: too; shape (T, 2).
    best: Indices
    #: The next such subset of as many channels: where INSEPARABLE, the closest competing exclusion; -1 where none;
    #: shape (T, 2).
    alternative: Indices
    #: Error of the channels of `best` against the rest: + where the range is too long; NaN elsewhere; shape (T, M).
    own_error_m: Floats
    statistic_after: Floats  #: Of the rest without `best`; the statistic itself where there is none; shape (T,).
    threshold_after: Floats  #: What it is compared with, shape (T,).
    #: By leaving out `best`: along the line (k = 1), or east and north (k = 2); 0 where there is none; shape (T, k).
    position_change_m: Floats
    #: Distance between the positions without `best` and without `alternative`; NaN where either is none; shape (T,).
    alternative_shift_m: Floats
    detection: Detection  #: The test before any exclusion.


@dataclass(frozen=True)
class _Trial:
    """Every subset of one size left out, T epochs by K subsets."""

    members: Indices  # (K, 1 or 2), places in the compact arrays
    statistic: Floats
    wsse_drop: Floats
    own: tuple[Floats, ...]  # own errors of each member [sigma]
    allowed: Masks  # all members in use, checked by the rest, and each over the limit of own errors


def exclude(model: LinearModel, *, limits: RaimLimits | None = None, scale: ArrayLike = 1.0) -> Exclusion:
    """Test, and where a fault is detected try every single satellite, then every pair.

    A subset is excluded when the rest passes and has `min_redundancy` degrees of freedom left, and
    when each of its satellites is in error against the rest: by more than noise of its sigma
    reaches (chi-square mode), by more than the square root of the limit (fixed mode). One goes
    before two; of several the least statistic. Where another subset of the same size would be
    excluded as well and fits worse by no more than noise explains (`separation_risk`), the epoch
    is inseparable.

    Parameters
    ----------
    model : LinearModel
        T epochs; those without a fault cost next to nothing.
    limits : RaimLimits, optional
    scale : array_like, shape (T,) or ()
        Noise scale, as in `detect`.
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
        threshold_after=detection.threshold.copy(),
        position_change_m=np.zeros((epochs, model.interest)),
        alternative_shift_m=np.full(epochs, np.nan),
        detection=detection,
    )
    failing = np.flatnonzero(detection.detected)
    result.outcome[failing] = Outcome.UNRESOLVED
    used = np.count_nonzero(model.used[failing], axis=1)
    # Epochs of like numbers of satellites together: no block is wider than it must be.
    failing = failing[np.argsort(used, kind="stable")]
    widest = int(used.max(initial=1))
    size = max(1, _BLOCK_SIZE // (widest * widest))
    for first in range(0, len(failing), size):
        block = failing[first : first + size]
        _exclude_block(result, block, model.take(block), scale[block], limits)
    return result


def _exclude_block(result: Exclusion, epochs: Indices, model: LinearModel, scale: Floats, limits: RaimLimits) -> None:
    """Singles for all epochs of a block, pairs for those that no single resolves; written into `result`."""
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
    """Each channel alone left out."""
    n = parts.channel.shape[1]
    share = np.einsum("tii->ti", parts.projector)
    checked = parts.used & (share > LEAST_REDUNDANCY)
    safe = np.where(checked, share, 1.0)
    own = parts.residual / safe
    drop = parts.residual * own
    if limits.mode == "chi_square":
        statistic = (wsse[:, None] - drop) / scale[:, None] ** 2
        over = drop > limits.own_error * scale[:, None] ** 2  # own^2 over its variance 1/S_ii
    else:
        total, linear, square = _sum_squares(parts)
        statistic = total[:, None] - 2.0 * own * linear + own**2 * np.einsum("tii->ti", square)
        over = (own * parts.sigma_m) ** 2 > limits.fixed_limit_m2
    return _Trial(np.arange(n)[:, None], statistic, drop, (own,), checked & over)


def _pairs(parts: Compact, wsse: Floats, scale: Floats, limits: RaimLimits) -> _Trial:
    """Each pair of channels left out."""
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
        # The variance of the first own error is (S_EE^-1)_11 = c / determinant.
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
    """``|V nu|^2``, ``S V^2 nu`` and ``S V^2 S`` with V the sigmas: sums of squares in m^2 after any exclusion.

    The whitened residuals without E are ``nu - S_E b_E``.
    """
    metres = parts.residual * parts.sigma_m
    weighted = parts.projector * parts.sigma_m[:, None, :]
    linear = np.einsum("tij,tj->ti", weighted, metres)
    return (metres**2).sum(axis=1), linear, weighted @ weighted.swapaxes(1, 2)


def _choose(
    result: Exclusion,
    epochs: Indices,
    parts: Compact,
    trial: _Trial,
    after: Floats,
    scale: Floats,
    limits: RaimLimits,
) -> None:
    """Write the best subset of each epoch that has one, and the closest competing exclusion."""
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
    result.threshold_after[where] = after[rows]
    result.position_change_m[where] = shift[at, best]
    result.alternative_shift_m[where] = np.where(has_second, apart[at, second], np.nan)


def _moves(parts: Compact, trial: _Trial, rows: Indices) -> Floats:
    """Change of the position by each subset, shape (rows, K, k) [m]."""
    moves = np.zeros((len(rows), len(trial.members), parts.gain_m.shape[2]))
    for k, own in enumerate(trial.own):
        moves -= parts.gain_m[rows][:, trial.members[:, k]] * own[rows][..., None]
    return moves


def worst_channel(model: LinearModel) -> Indices:
    """Channel whose removal lowers the weighted sum of squared residuals most, shape (T,); 0 where none is checked."""
    share = model.redundancy
    checked = model.used & (share > LEAST_REDUNDANCY)
    drop = np.where(checked, model.residual**2 / np.where(checked, share, 1.0), 0.0)
    return np.asarray(np.argmax(drop, axis=1), dtype=np.intp)
