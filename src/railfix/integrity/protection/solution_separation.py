"""Protection level along the track by solution separation.

The position x_J is computed without the satellites of the fault hypothesis J, so that a fault of these satellites does
not affect it. At consistent epochs, ``|x_J - x| <= T_J`` for all J. At the level L, the tail probabilities of all
hypotheses add up to the risk (EU-U.S. WG-C ARAIM, in one dimension):

    ``2 Q((L - b_0)/sigma_0) + sum_J p_J Q((L - T_J - b_J)/sigma_J) = risk``

The thresholds are ``T_J = K_fa sigma(x_J - x)``; each has an equal fraction of the false-alarm probability. The search
for the level starts at an upper bound, the largest of ``K_ff sigma_0 + b_0`` (no fault) and all ``T_J + K sigma_J +
b_J``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from railfix import kernels
from railfix.core.arrays import Codes, Floats, Indices, Masks, Strings, over_blocks
from railfix.core.notebook import NotebookTable
from railfix.integrity.protection.risk import FEW, MOST_TOGETHER, REMEMBERED, Allocation, RiskBudget, allocate
from railfix.integrity.raim import LinearModel

_BLOCK_SIZE: Final = 200_000  #: Largest number of elements of a block's hypothesis arrays.
_OF_MORE: Final = 3  #: Index of the risk part for three or more faults.


class Cause(IntEnum):
    """Hypothesis with the largest part of an epoch's risk, or reason for an infinite or missing protection level.

    A single fault affects a satellite, a constellation, one or both sides of the track, or the map.
    """

    #: Fault-free noise of the position.
    FAULT_FREE = 0
    #: A single fault.
    ONE_FAULT = 1
    #: Two simultaneous faults.
    TWO_FAULTS = 2
    #: Infinite level: the probability of undetectable satellite faults exceeds the risk allocated to them.
    UNCHECKED = 3
    #: Infinite level: the probability of faults that no hypothesis covers exceeds the risk, or too many satellites are
    #: excluded.
    BUDGET = 4
    #: No position.
    NO_POSITION = 5
    #: Three or more simultaneous faults.
    THREE_FAULTS = 6
    #: Infinite level: local faults cannot be bounded on this part of the line.
    UNBOUNDED = 7
    #: Infinite level as for `UNCHECKED`; the faults are mostly faults of a constellation.
    UNCHECKED_CONSTELLATION = 8
    #: Infinite level as for `UNCHECKED`; the faults are mostly faults of one or both sides of the track.
    UNCHECKED_SIDE = 9
    #: Infinite level as for `UNCHECKED`; the faults are mostly faults of the map.
    UNCHECKED_MAP = 10
    #: Infinite level as for `UNCHECKED`; the faults are mostly simultaneous faults of constellations, sides or the map.
    UNCHECKED_TOGETHER = 11


@dataclass(frozen=True, kw_only=True, repr=False)
class ProtectionLevel(NotebookTable):
    """Protection levels along the track of T epochs; NaN without a position."""

    #: Protection level, shape (T,), at which the tail probabilities add up to at most the risk. If infinite, see
    #: `cause`.
    level_m: Floats
    #: Separate levels for no fault, one fault and two faults, shape (T,). A level is 0 if the total probability of its
    #: hypotheses is within the risk allocated to it.
    fault_free_m: Floats
    one_fault_m: Floats
    two_fault_m: Floats
    sigma_m: Floats  #: Fault-free standard deviation of the position along the track, shape (T,).
    #: Factor K of each of these three levels, shape (T,); -inf where the level is 0.
    k_fault_free: Floats
    k_one_fault: Floats
    k_two_faults: Floats
    k_false_alarm: Floats  #: Factor K_fa of the thresholds, shape (T,).
    separation: Floats  #: Largest ``|x_J - x|/T_J`` of all J, shape (T,); 0 where no position x_J exists.
    #: True where the separation is at most 1, shape (T,). Where False, the protection level is invalid.
    consistent: Masks
    #: Channel whose fault determines `one_fault_m`, shape (T,); -1 if the fault is not of a satellite.
    worst_one: Indices
    worst_two: Indices  #: Channels whose faults determine `two_fault_m`, shape (T, 2); -1 for other faults.
    #: Constellation whose fault determines `one_fault_m`, shape (T,); empty if the fault is not of a constellation.
    worst_constellation: Strings
    unchecked_risk: Floats  #: Probability of faults that no hypothesis covers, subtracted from the risk, shape (T,).
    cause: Codes  #: `Cause` of each epoch, shape (T,).


class RangeBounds(NamedTuple):
    """Paired overbound: lower limit of the sigma, and largest bias, of each range, shape (T, M) or (M,) [m]."""

    sigma_m: ArrayLike | None = None
    bias_m: ArrayLike | None = None


class MapDeviation(NamedTuple):
    """Lateral and vertical map error in addition to the map sigmas."""

    bias_m: ArrayLike = 0.0  #: Map offset that the map sigmas do not cover, shape (T, 2) or (2,).
    #: Lateral and vertical offset of the 3-D position from the map, shape (T, 2) [m], and the inverse covariance of the
    #: offset, shape (T, 2, 2) [1/m^2] (0 if unknown). If present, a wrong map is a hypothesis.
    seen: tuple[Floats, Floats] | None = None


def protection_level(
    model: LinearModel,
    systems: Sequence[str],
    *,
    risk: RiskBudget | None = None,
    scale: ArrayLike = 1.0,
    overbound: RangeBounds | None = None,
    map_error: MapDeviation | None = None,
    sides: Masks | None = None,
    n_excluded: ArrayLike = 0,
) -> ProtectionLevel:
    """Compute the protection level along the track (P1 2.4; WG-C ARAIM in one dimension).

    Parameters
    ----------
    model : LinearModel
        Model of T epochs on the line (`linear_model`), after exclusions.
    systems : sequence of str, length M
        Constellation letter of each channel.
    scale : array_like, shape (T,) or ()
        Noise scale, which multiplies the sigmas of the ranges but not the map error.
    overbound : RangeBounds, optional
        Lower limit of the sigma of each range, and its nominal bias. By default, the sigma follows from the weight of
        the range and the noise scale, and the bias is 0.
    sides : ndarray of bool, shape (T, S, M), optional
        S sets of satellites that reflections can make faulty together. Each set is a hypothesis with the prior
        `RiskBudget.side_prior`.
    n_excluded : array_like of int, shape (T,) or (), or ndarray of bool, shape (T, M)
        Number of satellites excluded by RAIM, or `RaimResult.excluded`. Satellites rejected by screens do not count.

    Raises
    ------
    ValueError
        The model is not of positions on the line, the noise scale is not positive, `systems` does not have one letter
        per channel, or the model uses an excluded satellite.
    """
    if model.interest != 1:
        raise ValueError("a level along the track requires a model of positions on the line (linear_model)")
    risk, overbound, map_error = risk or RiskBudget(), overbound or RangeBounds(), map_error or MapDeviation()
    epochs, channels = model.root_weight.shape
    if len(systems) != channels:
        raise ValueError(f"systems must have one letter per channel: {channels} channels, got {len(systems)}")
    scale = _broadcast(np.asarray(scale, dtype=np.float64), (epochs,))
    if (scale <= 0).any():
        raise ValueError("the noise scale must be positive")
    excluded = np.asarray(n_excluded)
    if excluded.ndim == 2:
        if (excluded & model.used).any():
            raise ValueError(
                "the model uses excluded satellites; build it from the ranges and positions returned by "
                "exclude_faults, which no longer contain these satellites"
            )
        excluded = excluded.sum(axis=1)
    out = _broadcast(np.asarray(excluded, dtype=np.int64), (epochs,))
    groups = np.zeros((epochs, 0, channels), dtype=bool) if sides is None else sides
    plan = allocate(model, systems, risk, out, groups, wrong_map=map_error.seen is not None)
    given = Errors(
        scale, _by_epoch(overbound.sigma_m, epochs, channels), _by_epoch(overbound.bias_m, epochs, channels),
        _by_epoch(map_error.bias_m, epochs, 2),
        *((np.zeros((epochs, 2)), np.zeros((epochs, 2, 2))) if map_error.seen is None else map_error.seen),
    )  # fmt: skip
    located = np.isfinite(model.covariance_m2).all(axis=(1, 2)) & np.isfinite(scale)
    if 0 < epochs <= FEW and located.all():
        return ProtectionLevel(**_level_of_block(np.arange(epochs), model, plan, given))
    result = _empty(epochs, plan)

    def fill(block: Indices) -> None:
        for name, values in _level_of_block(block, model.take(block), plan, given).items():
            getattr(result, name)[block] = values

    over_blocks(fill, _blocks(model, plan, located.nonzero()[0]))
    return result


def _by_epoch(values: ArrayLike | None, epochs: int, width: int) -> Floats:
    """Return values with the shape (T, width), or (T, 0) for None."""
    if values is None:
        return np.zeros((epochs, 0))
    return _broadcast(np.asarray(values, dtype=np.float64), (epochs, width))


def _broadcast(values: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    return values if values.shape == shape else np.broadcast_to(values, shape)


def _empty(epochs: int, plan: Allocation) -> ProtectionLevel:
    """Return the result of epochs without a position."""
    floats = "level_m fault_free_m one_fault_m two_fault_m sigma_m k_fault_free k_one_fault k_two_faults k_false_alarm"
    return ProtectionLevel(
        **{name: np.full(epochs, np.nan) for name in (*floats.split(), "separation")},
        consistent=np.zeros(epochs, dtype=bool), worst_one=np.full(epochs, -1, dtype=np.intp),
        worst_two=np.full((epochs, 2), -1, dtype=np.intp), worst_constellation=np.full(epochs, "", dtype="<U1"),
        unchecked_risk=plan.beyond.copy(), cause=np.full(epochs, Cause.NO_POSITION, dtype=np.int8),
    )  # fmt: skip


def _blocks(model: LinearModel, plan: Allocation, rows: Indices) -> Iterator[Indices]:
    """Return blocks of epochs with similar numbers of hypotheses, so that block arrays are small."""
    if len(rows) <= FEW:
        return iter([rows] if len(rows) else [])
    used = model.used[rows].sum(axis=1)
    sizes = np.cumsum(scipy.special.comb(used[:, None], np.arange(MOST_TOGETHER + 1)), axis=1)
    sizes = np.concatenate([sizes, np.zeros((len(rows), 1))], axis=1)
    count = np.take_along_axis(sizes, plan.order[rows], axis=1).sum(axis=1)
    order = np.lexsort((used, count))
    rows, widest = rows[order], max(int(count.max(initial=1)), int(used.max(initial=1)) ** 2)
    size = max(1, _BLOCK_SIZE // widest)
    return (rows[first : first + size] for first in range(0, len(rows), size))


class Errors(NamedTuple):
    """Range and map errors passed to `protection_level`; shape (T, 0) if not passed."""

    scale: Floats
    least_sigma_m: Floats
    bias_m: Floats
    map_bias_m: Floats
    map_seen_m: Floats
    map_information: Floats


class Asked(NamedTuple):
    """Hypotheses of a block of epochs: fields of `Allocation`, and indices into the hypothesis arrays."""

    prior: Floats  # (T, M)
    members: Masks  # (T, B, M) satellites of each set of shared faults
    wrong_map: Masks  # (B,)
    shared_prior: Floats  # (T, B)
    order: Indices  # (T, B)
    k_false_alarm: Floats  # (T,)
    first: Indices  # (B, MOST_TOGETHER + 1) first hypothesis of each class; -1: no hypothesis
    bounds: Indices  # (5,) first hypothesis with 0, 1, 2 and more faults, and number of hypotheses


class _Names(NamedTuple):
    """Hypotheses of a block, the risk of each part, and the names of the faults."""

    asked: Asked
    share: Floats  # (T, 4) risk for zero, one, two, and more faults
    letters: Strings  # letters of constellations with a single-fault hypothesis, numbered after the n channels
    pairs: Indices  # (K, 2) pairs of channels; the last entry is (-1, -1)


def _level_of_block(rows: Indices, model: LinearModel, plan: Allocation, given: Errors) -> dict[str, NDArray[Any]]:
    """Compute the fields of `ProtectionLevel` of a block of epochs with positions."""
    of_block = Errors(*(np.ascontiguousarray(each[rows]) for each in given))
    n = int(model.used.sum(axis=1).max())
    # allocations of few epochs and the data derived from them are cached
    every = len(rows) == len(plan.beyond) <= FEW
    asked, share, letters, pairs = _names_of_few(plan, n) if every else _names(plan, rows, n)
    channel, offset, sigma, weight, separation = kernels.hypotheses.tails_of_hypotheses(model.arrays, of_block, asked)
    level, spender, part, k, worst = kernels.level.solve_level(
        offset, sigma, weight, asked.bounds, share, plan.reserved[rows]
    )
    one, two = worst[:, 1], worst[:, 2]
    infinite = np.full(len(rows), Cause.BUDGET)
    if (unchecked := np.isinf(level) & (plan.fault_free[rows] > 0)).any():
        infinite[unchecked] = _find_unchecked(plan, asked, np.where(np.isinf(sigma), weight, 0.0), n)[unchecked]
    spent_on = np.where(spender == _OF_MORE, Cause.THREE_FAULTS, spender)
    return {
        "level_m": level,
        "fault_free_m": part[:, 0],
        "one_fault_m": part[:, 1],
        "two_fault_m": part[:, 2],
        "sigma_m": sigma[:, 0],
        "k_fault_free": k[:, 0],
        "k_one_fault": k[:, 1],
        "k_two_faults": k[:, 2],
        "k_false_alarm": plan.k_false_alarm[rows],
        "separation": separation,
        "consistent": separation <= 1.0,
        "worst_one": _channels(channel, np.where(one < n, one, -1)[:, None])[:, 0],
        "worst_two": _channels(channel, pairs[np.where(two < len(pairs), two, -1)]),
        "worst_constellation": letters[np.where(one >= n, one - n, -1)],
        "unchecked_risk": plan.beyond[rows],
        "cause": np.where(np.isinf(level), infinite, spent_on).astype(np.int8),
    }


def _find_unchecked(plan: Allocation, asked: Asked, open_to_faults: Floats, n: int) -> Codes:
    """Return the `Cause` of the shared faults with the largest part of the unchecked probability (T, K)."""
    spent, causes = [], []
    for shared, first in zip(plan.shared, asked.first.tolist(), strict=True):
        classes = [open_to_faults[:, at : at + math.comb(n, k)].sum(axis=1) for k, at in enumerate(first) if at >= 0]
        spent.append(sum(classes, np.zeros(len(open_to_faults))))
        kinds = {event < len(plan.groups) for event in shared.events}
        if len(kinds) + shared.wrong_map > 1 or shared.kind > 1:
            causes.append(Cause.UNCHECKED_TOGETHER)
        elif shared.events:
            causes.append(Cause.UNCHECKED_CONSTELLATION if kinds == {True} else Cause.UNCHECKED_SIDE)
        else:
            causes.append(Cause.UNCHECKED_MAP if shared.wrong_map else Cause.UNCHECKED)
    return np.asarray(np.array(causes, dtype=np.int8)[np.argmax(spent, axis=0)])


@lru_cache(maxsize=256)
def _places(kinds: tuple[int, ...], most: tuple[int, ...], n: int) -> tuple[Indices, Indices]:
    """Return `Asked.first` and `Asked.bounds`; up to `most` of n satellites are added to each set of shared faults."""
    bounds, place = [], 0
    first = np.full((len(kinds), MOST_TOGETHER + 1), -1, dtype=np.intp)
    for kind in range(_OF_MORE + 1):
        bounds.append(place)
        for b, own in enumerate(kinds):
            for k in range(most[b] + 1):
                if min(own + k, _OF_MORE) == kind:
                    first[b, k], place = place, place + math.comb(n, k)
    return first, np.array([*bounds, place])


@lru_cache(maxsize=REMEMBERED)
def _names_of_few(plan: Allocation, n: int) -> _Names:
    return _names(plan, np.arange(len(plan.beyond)), n)


def _names(plan: Allocation, rows: Indices, n: int) -> _Names:
    """Return the hypotheses of epochs with at most n used channels, sorted by number of faults."""
    order = plan.order[rows]
    kinds = tuple(shared.kind for shared in plan.shared)
    first, bounds = _places(kinds, tuple(order.max(axis=0).tolist()), n)
    asked = Asked(
        prior=plan.prior[rows], members=plan.members[rows],
        wrong_map=np.array([shared.wrong_map for shared in plan.shared]), shared_prior=plan.shared_prior[rows],
        order=order, k_false_alarm=plan.k_false_alarm[rows], first=first, bounds=bounds,
    )  # fmt: skip
    share = np.array([plan.fault_free, plan.one, plan.two, plan.more])[:, rows].T.copy()
    letters = np.array([*plan.groups, *[""] * (len(plan.shared) + 1)])
    pairs = _pairs(n) if first[0, 2] >= 0 else np.empty((0, 2), dtype=np.intp)
    return _Names(asked, share, letters, np.concatenate([pairs, [[-1, -1]]]))


def _channels(channel: Indices, place: Indices) -> Indices:
    """Convert indices among the used channels to channel numbers, shape (T, k); -1 remains -1."""
    return np.where(place >= 0, channel[np.arange(len(channel))[:, None], np.maximum(place, 0)], -1)


@lru_cache(maxsize=64)
def _pairs(n: int) -> Indices:
    """Return all pairs of n indices, shape (K, 2)."""
    return np.stack(np.triu_indices(n, 1), axis=1)


class LevelStatus(IntEnum):
    """Status of an epoch's protection level relative to the alarm limit."""

    #: The protection level is within the alarm limit.
    AVAILABLE = 0
    #: The protection level exceeds the alarm limit, or there is no position.
    UNAVAILABLE = 1
    #: The ranges are inconsistent, so that the protection level is invalid.
    ALARM = 2
