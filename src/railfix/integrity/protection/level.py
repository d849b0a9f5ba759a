"""Protection level along the track with fault hypotheses: solution separation over one and two satellites.

While ``|x_J - x| <= T_J`` the position x is that far at most from x_J, in which a fault of the subset J has no
part, and whose own error has the Gaussian tail of ``sigma_J``. The level L is where the tails of all
hypotheses together use up the risk (EU-U.S. WG-C ARAIM, in one dimension):

    ``2 Q((L - b_0)/sigma_0) + sum_J p_J Q((L - T_J - b_J)/sigma_J) = risk``

Thresholds ``T_J = K_fa sigma(x_J - x)`` divide the false alarms evenly. It is found from above: from the largest
of three parts, each of which has its share of the risk,

- no fault: ``K_ff sigma_0 + b_0``;
- one fault, two faults: the largest ``T_J + K sigma_J + b_J``, the share divided in proportion to the priors, so
  that all hypotheses of a part have one K.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Codes, Floats, Indices, Masks, Strings
from railfix.integrity.protection.allocation import Allocation, allocate
from railfix.integrity.protection.groups import without_constellation_and_one, without_group
from railfix.integrity.protection.risk import RiskBudget, one_sided_k, pair_sum
from railfix.integrity.protection.separation import (
    AllInView,
    Separations,
    all_in_view,
    without_constellation,
    without_map,
    without_one,
    without_three,
    without_two,
)
from railfix.integrity.protection.tails import Tails, least_level
from railfix.integrity.raim import LinearModel

#: Numbers of a pair array that a block of epochs holds.
_BLOCK_SIZE: Final = 80_000
#: Number of the tails of three faults among those of all kinds.
_OF_TRIPLES: Final = 3
#: Separation, over the sigma of the position, below which the two positions are the same.
_SAME: Final = 1e-9


class Cause(IntEnum):
    """Hypothesis that uses most of the risk of an epoch at its level, or why there is no level."""

    #: The noise of the position without a fault.
    FAULT_FREE = 0
    #: A fault of one satellite, or of a constellation.
    ONE_FAULT = 1
    #: Faults of two satellites, or of a constellation and a satellite of another.
    TWO_FAULTS = 2
    #: Infinite: a fault that nothing checks is likelier than its share of the risk.
    UNCHECKED = 3
    #: Infinite: more faults than are checked are likelier than the risk allows, or too many satellites excluded.
    BUDGET = 4
    #: No position.
    NO_POSITION = 5
    #: Faults of three satellites.
    THREE_FAULTS = 6
    #: Infinite: local faults cannot be bounded at this place of the line.
    UNBOUNDED = 7


@dataclass(frozen=True, kw_only=True)
class ProtectionLevel:
    """Levels along the track of T epochs; NaN where there is no position.

    Attributes
    ----------
    level_m : ndarray, shape (T,) [m]
        Where all tails together keep within the risk; at most the largest of the three parts, which have shares
        of it that need not be used up. Infinite where `cause` says why.
    fault_free_m, one_fault_m, two_fault_m : ndarray, shape (T,) [m]
        The parts. 0 where the part's hypotheses fit into its share of the risk unchecked.
    sigma_m : ndarray, shape (T,) [m]
        Standard deviation of the position along the track, without a fault.
    k_fault_free, k_one_fault, k_two_faults : ndarray, shape (T,)
        Sigmas of each part; -inf where it is not asked for.
    k_false_alarm : ndarray, shape (T,)
        Sigmas of the thresholds.
    separation : ndarray, shape (T,)
        The largest ``|x_J - x|/T_J``; 0 where nothing can be left out.
    consistent : ndarray of bool, shape (T,)
        It is at most 1. Where not the level does not hold. False where there is no position.
    worst_one : ndarray of int, shape (T,)
        Channel that sets `one_fault_m`; -1 where none does (a constellation: `worst_constellation`).
    worst_two : ndarray of int, shape (T, 2)
        Channels that set `two_fault_m`; -1 where none do.
    worst_constellation : ndarray of str, shape (T,)
        Letter of the constellation that sets `one_fault_m`; empty where none does.
    unchecked_risk : ndarray, shape (T,)
        Probability of more faults than are checked, taken off the risk.
    cause : ndarray of int8, shape (T,)
        `Cause`.
    """

    level_m: Floats
    fault_free_m: Floats
    one_fault_m: Floats
    two_fault_m: Floats
    sigma_m: Floats
    k_fault_free: Floats
    k_one_fault: Floats
    k_two_faults: Floats
    k_false_alarm: Floats
    separation: Floats
    consistent: Masks
    worst_one: Indices
    worst_two: Indices
    worst_constellation: Strings
    unchecked_risk: Floats
    cause: Codes


@dataclass(frozen=True)
class _Part:
    """One part of the level: T epochs."""

    level_m: Floats
    k: Floats
    worst: Indices  # hypothesis; -1
    separation: Floats
    tails: Tails  # of what is checked
    unchecked: Floats  # prior of what is not


def along_track_level(
    model: LinearModel,
    systems: Sequence[str],
    *,
    risk: RiskBudget | None = None,
    scale: ArrayLike = 1.0,
    least_sigma_m: ArrayLike | None = None,
    bias_m: ArrayLike | None = None,
    map_bias_m: ArrayLike | None = None,
    map_seen: tuple[Floats, Floats] | None = None,
    sides: Masks | None = None,
    n_excluded: ArrayLike = 0,
) -> ProtectionLevel:
    """Protection level along the track (P1 2.4; WG-C ARAIM in one dimension, up to two satellites).

    Parameters
    ----------
    model : LinearModel
        T epochs on the line (`constrained_model`), after exclusions; 1/weight is the variance of the range.
    systems : sequence of str, length M
        Constellation letter of each channel.
    risk : RiskBudget, optional
    scale : array_like, shape (T,) or ()
        Noise scale: multiplies the sigmas of the ranges, not the map error.
    least_sigma_m : array_like, shape (T, M) or (M,) [m], optional
        Least standard deviation of each range, as an overbound gives it; none: that of its weight times the scale.
    bias_m : array_like, shape (T, M) or (M,) [m], optional
        Largest nominal bias of each range, as a paired overbound gives it; none: 0.
    map_bias_m : array_like, shape (T, 2) or (2,) [m], optional
        Offset of the map across and up that is not within its sigma; none: 0.
    map_seen : tuple of ndarray, shapes (T, 2) [m] and (T, 2, 2) [1/m^2], optional
        Place of the antenna across and above the line without the map, and its inverse covariance (0: unknown). With it
        a wrong map, alone and with each faulty satellite, is a hypothesis of prior `RiskBudget.map_prior`.
    sides : ndarray of bool, shape (T, S, M), optional
        Sets of satellites that one reflection can make faulty together, each a hypothesis of `RiskBudget.side_prior`.
    n_excluded : array_like of int, shape (T,) or ()
        Satellites that fault detection left out at this epoch (not: what the screens rejected before).

    Returns
    -------
    ProtectionLevel

    Raises
    ------
    ValueError
        A model in space, a number of systems that is not that of the channels, a constellation without prior,
        a scale that is not positive.
    """
    if model.interest != 1:
        raise ValueError("a level along the track asks for a model on the line (constrained_model)")
    risk = risk or RiskBudget()
    epochs, channels = model.root_weight.shape
    if len(systems) != channels:
        raise ValueError(f"systems names each channel: {channels} channels, got {len(systems)}")
    scale = np.broadcast_to(np.asarray(scale, dtype=np.float64), (epochs,))
    if (scale <= 0).any():
        raise ValueError("the noise scale must be positive")
    out = np.broadcast_to(np.asarray(n_excluded, dtype=np.int64), (epochs,))
    bias = None if bias_m is None else np.broadcast_to(np.asarray(bias_m, dtype=np.float64), (epochs, channels))
    least = None if least_sigma_m is None else np.broadcast_to(np.asarray(least_sigma_m, float), (epochs, channels))
    offset = None if map_bias_m is None else np.broadcast_to(np.asarray(map_bias_m, dtype=np.float64), (epochs, 2))
    located = np.isfinite(model.covariance_m2).all(axis=(1, 2)) & np.isfinite(scale)
    together = np.zeros((epochs, 0, channels), dtype=bool) if sides is None else sides
    plan = allocate(model, systems, risk, out, together, wrong_map=map_seen is not None)
    result = _empty(epochs, plan)
    for block in _blocks(model, np.flatnonzero(located)):
        part = model.take(block)
        some, moved, low = (None if v is None else v[block] for v in (bias, offset, least))
        seen = None if map_seen is None else (map_seen[0][block], map_seen[1][block])
        _level_of_block(
            result, block, part, plan, all_in_view(part, scale[block], some, moved, low), seen, together[block]
        )
    return result


def _empty(epochs: int, plan: Allocation) -> ProtectionLevel:
    """A result without positions."""

    def nan() -> Floats:
        return np.full(epochs, np.nan)

    return ProtectionLevel(
        level_m=nan(),
        fault_free_m=nan(),
        one_fault_m=nan(),
        two_fault_m=nan(),
        sigma_m=nan(),
        k_fault_free=nan(),
        k_one_fault=nan(),
        k_two_faults=nan(),
        k_false_alarm=nan(),
        separation=nan(),
        consistent=np.zeros(epochs, dtype=bool),
        worst_one=np.full(epochs, -1, dtype=np.intp),
        worst_two=np.full((epochs, 2), -1, dtype=np.intp),
        worst_constellation=np.full(epochs, "", dtype="<U1"),
        unchecked_risk=plan.beyond,
        cause=np.full(epochs, Cause.NO_POSITION, dtype=np.int8),
    )


def _blocks(model: LinearModel, rows: Indices) -> Iterator[Indices]:
    """Epochs of like numbers of satellites together: no block is wider than it must be."""
    used = np.count_nonzero(model.used[rows], axis=1)
    rows = rows[np.argsort(used, kind="stable")]
    widest = int(used.max(initial=1))
    size = max(1, _BLOCK_SIZE // (widest * widest))
    return (rows[first : first + size] for first in range(0, len(rows), size))


def _level_of_block(
    result: ProtectionLevel,
    rows: Indices,
    model: LinearModel,
    plan: Allocation,
    full: AllInView,
    map_seen: tuple[Floats, Floats] | None,
    sides: Masks,
) -> None:
    """Levels of a block of epochs with positions; written into `result`."""
    sigma = full.sigma_m
    k_fault_free, k_false_alarm = one_sided_k(plan.fault_free[rows] / 2.0), plan.k_false_alarm[rows]
    fault_free = k_fault_free * sigma + full.bias_m
    prior = np.take_along_axis(plan.prior[rows], full.channel, axis=1) * full.used

    single_separations, single_prior = [without_one(full)], [prior]
    for c, (_, members) in enumerate(plan.groups):
        single_separations.append(without_constellation(model, members, full))
        single_prior.append(plan.group_prior[rows, c : c + 1])
    for c in range(sides.shape[1] if plan.side_prior.any() else 0):
        of_side = np.take_along_axis(sides[:, c], full.channel, axis=1) & full.used
        single_separations.append(without_group(full, of_side))
        single_prior.append(plan.side_prior[rows, c : c + 1])
    wrong_map = None
    if map_seen is not None and plan.map_prior > 0.0:
        wrong_map = without_map(full, model, *map_seen)
        single_separations.append(wrong_map[0])
        single_prior.append(np.full((len(rows), 1), plan.map_prior))
    single_fault = _part(
        _beside(single_separations), np.concatenate(single_prior, axis=1), plan.one[rows], k_false_alarm, sigma
    )

    n, pairs = prior.shape[1], plan.pairs[rows]
    first, second = np.triu_indices(n, 1)
    double_separations, double_prior = [], []
    if pairs.any() and n > 1:
        double_separations.append(without_two(full, first, second))
        double_prior.append(prior[:, first] * prior[:, second] * pairs[:, None])
    for c, (_, members) in enumerate(plan.groups):
        of_group = members[full.channel] & full.used
        double_separations.append(without_constellation_and_one(full, of_group))
        double_prior.append(plan.group_prior[rows, c : c + 1] * prior * ~of_group)
    if wrong_map is not None:
        double_separations.append(wrong_map[1])
        double_prior.append(plan.map_prior * prior)
    double_fault = _nothing(len(rows))
    if double_separations:
        every = np.concatenate(double_prior, axis=1)
        double_fault = _part(_beside(double_separations), every, plan.two[rows], k_false_alarm, sigma)

    triple_fault, of_three = _nothing(len(rows)), np.zeros(len(rows))
    triples = plan.triples[rows]
    if triples.any() and n > 2:
        triple = np.array(list(combinations(range(n), 3)), dtype=np.intp)
        triple_prior = prior[:, triple].prod(axis=2) * triples[:, None]
        of_three = np.where(triples, (plan.fault_free[rows] + plan.one[rows] + plan.two[rows]) / 3.0, 0.0)
        triple_fault = _part(without_three(full, triple), triple_prior, of_three, k_false_alarm, sigma)

    noise = Tails(offset_m=full.bias_m[:, None], sigma_m=sigma[:, None], weight=np.full((len(rows), 1), 2.0))
    remaining_risk = plan.fault_free[rows] + plan.one[rows] + plan.two[rows] + of_three
    remaining_risk = remaining_risk - single_fault.unchecked - double_fault.unchecked - triple_fault.unchecked
    remaining_risk = remaining_risk - np.where(pairs, 0.0, pair_sum(prior))
    above = np.maximum(
        np.maximum(fault_free, single_fault.level_m), np.maximum(double_fault.level_m, triple_fault.level_m)
    )
    level, spender = least_level(
        above, [noise, single_fault.tails, double_fault.tails, triple_fault.tails], remaining_risk
    )
    result.level_m[rows], result.sigma_m[rows] = level, sigma
    result.fault_free_m[rows], result.k_fault_free[rows] = fault_free, k_fault_free
    result.one_fault_m[rows], result.k_one_fault[rows] = single_fault.level_m, single_fault.k
    result.two_fault_m[rows], result.k_two_faults[rows] = double_fault.level_m, double_fault.k
    result.k_false_alarm[rows] = k_false_alarm
    result.separation[rows] = np.maximum(
        np.maximum(single_fault.separation, double_fault.separation), triple_fault.separation
    )
    result.consistent[rows] = result.separation[rows] <= 1.0
    at = np.arange(len(rows))
    has_single = (single_fault.worst >= 0) & (single_fault.worst < n)
    result.worst_one[rows] = np.where(has_single, full.channel[at, np.where(has_single, single_fault.worst, 0)], -1)
    # The last are the sides, a wrong map, and none.
    letters = np.array([*(letter for letter, _ in plan.groups), *[""] * (sides.shape[1] + 2)])
    result.worst_constellation[rows] = letters[np.where(single_fault.worst >= n, single_fault.worst - n, -1)]
    if n > 1:
        has_pair = (double_fault.worst >= 0) & (double_fault.worst < len(first)) & bool(pairs.any())
        places = np.stack([first, second], axis=1)[np.where(has_pair, double_fault.worst, 0)]
        channels = np.take_along_axis(full.channel, places, axis=1)
        result.worst_two[rows] = np.where(has_pair[:, None], channels, -1)
    infinite = np.where(plan.fault_free[rows] > 0, Cause.UNCHECKED, Cause.BUDGET)
    spent_on = np.where(spender == _OF_TRIPLES, Cause.THREE_FAULTS, spender)
    result.cause[rows] = np.where(np.isinf(level), infinite, spent_on)
    result.unchecked_risk[rows] = plan.beyond[rows]


def _beside(parts: list[Separations]) -> Separations:
    """Hypotheses of several kinds, one after the other."""
    names = [item.name for item in fields(Separations)]
    return Separations(**{name: np.concatenate([getattr(p, name) for p in parts], axis=1) for name in names})


def _nothing(epochs: int) -> _Part:
    """A part without hypotheses."""
    zero, empty = np.zeros(epochs), np.zeros((epochs, 0))
    return _Part(
        level_m=zero,
        k=np.full(epochs, -np.inf),
        worst=np.full(epochs, -1, dtype=np.intp),
        separation=zero,
        tails=Tails(offset_m=empty, sigma_m=empty, weight=empty),
        unchecked=zero,
    )


def _part(apart: Separations, prior: Floats, budget: Floats, k_false_alarm: Floats, sigma: Floats) -> _Part:
    """The level that the hypotheses of one part ask for.

    What nothing checks goes into the risk with its whole prior; the rest of it is for what is checked.
    """
    blind = (prior > 0) & np.isinf(apart.sigma_m)
    checked = (prior > 0) & ~blind
    unchecked = (prior * blind).sum(axis=1)
    total = (prior * checked).sum(axis=1)
    left = budget - unchecked
    needed = unchecked + total > budget
    k = np.where(needed, one_sided_k(left / np.where(total > 0, total, np.inf)), -np.inf)
    k = np.where(needed & (left > 0) & (total == 0), -np.inf, k)
    usable = checked & np.isfinite(k)[:, None]
    threshold = k_false_alarm[:, None] * apart.separation_sigma_m
    offset = np.where(checked, threshold + apart.bias_m, 0.0)
    tails = Tails(offset_m=offset, sigma_m=np.where(checked, apart.sigma_m, 1.0), weight=prior * checked)
    with np.errstate(invalid="ignore"):
        each = np.where(usable, offset + k[:, None] * tails.sigma_m, -np.inf)
    spent = needed & (left <= 0)
    culprits = np.where(np.any(blind, axis=1, keepdims=True), blind, checked)
    each = np.where(spent[:, None] & culprits, np.inf, each)
    level = np.maximum(each.max(axis=1), 0.0)
    worst = np.where(each.max(axis=1) > -np.inf, np.argmax(each, axis=1), -1)
    moving = checked & (apart.separation_sigma_m > _SAME * sigma[:, None])
    ratio = np.where(moving, np.abs(apart.moved_m) / np.where(moving, threshold, 1.0), 0.0)
    return _Part(
        level_m=level,
        k=k,
        worst=np.asarray(worst, dtype=np.intp),
        separation=ratio.max(axis=1),
        tails=tails,
        unchecked=unchecked,
    )
