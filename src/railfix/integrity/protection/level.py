"""Protection level along the track with fault hypotheses: solution separation over one and two satellites.

While ``|x_J - x| <= T_J`` the position x is that far at most from x_J, in which a fault of the subset J has no
part, and whose own error has the Gaussian tail of ``sigma_J``. The level L is where the tails of all
hypotheses together use up the risk (EU-U.S. WG-C ARAIM, in one dimension):

    ``2 Q((L - b_0)/sigma_0) + sum_J p_J Q((L - T_J - b_J)/sigma_J) = risk``

Thresholds ``T_J = K_fa sigma(x_J - x)`` divide the false alarms evenly. The level is found from above: from the largest
of three parts, each of which has its share of the risk,

- no fault: ``K_ff sigma_0 + b_0``;
- one fault, two faults: the largest ``T_J + K sigma_J + b_J``, the share divided in proportion to the priors, so
  that all hypotheses of a part have one K.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from itertools import combinations
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Codes, Floats, Indices, Masks, Strings
from railfix.integrity.protection.allocation import Allocation, allocate
from railfix.integrity.protection.groups import without_group, without_group_and_one
from railfix.integrity.protection.risk import RiskBudget, pair_sum
from railfix.integrity.protection.separation import (
    Separations,
    all_in_view,
    without_map,
    without_none,
    without_one,
    without_three,
    without_two,
)
from railfix.integrity.protection.tails import lowered
from railfix.integrity.raim import LinearModel
from railfix.kernels import compiled_by

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
    #: A fault of one satellite, of a constellation, of a side of the track, or of the map.
    ONE_FAULT = 1
    #: Faults of two satellites, or of one satellite and what else `ONE_FAULT` names, or of a side and the map.
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
        Channel that sets `one_fault_m`; -1 where none does (a constellation: `worst_constellation`; a side, the map).
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
    groups = np.zeros((epochs, 0, channels), dtype=bool) if sides is None else sides
    plan = allocate(model, systems, risk, out, groups, wrong_map=map_seen is not None)
    given = (
        scale,
        _by_epoch(least_sigma_m, epochs, channels),
        _by_epoch(bias_m, epochs, channels),
        _by_epoch(0.0 if map_bias_m is None else map_bias_m, epochs, 2),
        np.zeros((epochs, 2)) if map_seen is None else map_seen[0],
        np.zeros((epochs, 2, 2)) if map_seen is None else map_seen[1],
        plan.sides,
    )
    located = np.isfinite(model.covariance_m2).all(axis=(1, 2)) & np.isfinite(scale)
    result = _empty(epochs, plan)
    for block in _blocks(model, np.flatnonzero(located)):
        _level_of_block(result, block, model.take(block), plan, *(each[block] for each in given))
    return result


def _by_epoch(values: ArrayLike | None, epochs: int, width: int) -> Floats:
    """Values for each epoch, shape (T, width); (T, 0) for none."""
    if values is None:
        return np.zeros((epochs, 0))
    return np.broadcast_to(np.asarray(values, dtype=np.float64), (epochs, width))


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
    result: ProtectionLevel, rows: Indices, model: LinearModel, plan: Allocation, *given: Floats | Masks
) -> None:
    """Levels of a block of epochs with positions; written into `result`."""
    arrays: Iterable[Any] = (
        *(model.root_weight, model.clock, model.clock_covariance_m2, model.design, model.covariance_m2, model.prior),
        *(model.misfit, *given),
        *(plan.prior[rows], plan.members, plan.group_prior[rows], plan.side_prior[rows]),
        *(plan.sides_with_one[rows], plan.pairs[rows], plan.triples[rows], plan.k_false_alarm[rows]),
    )
    arrays = (*map(np.ascontiguousarray, arrays), plan.map_prior)
    channel, offset, sigma, weight, bounds, separation = hypotheses(*arrays)
    share = np.stack([plan.fault_free[rows], plan.one[rows], plan.two[rows]], axis=1)
    share = np.concatenate([share, np.where(plan.triples[rows], share.sum(axis=1) / 3.0, 0.0)[:, None]], axis=1)
    reserved = np.where(plan.pairs[rows], 0.0, pair_sum(plan.prior[rows]))
    level, spender, part, k, worst = lowered(offset, sigma, weight, bounds, share, reserved)

    n = channel.shape[1]
    result.level_m[rows], result.sigma_m[rows], result.k_false_alarm[rows] = (
        level,
        sigma[:, 0],
        plan.k_false_alarm[rows],
    )
    result.fault_free_m[rows], result.one_fault_m[rows], result.two_fault_m[rows] = part.T[:3]
    result.k_fault_free[rows], result.k_one_fault[rows], result.k_two_faults[rows] = k.T[:3]
    result.separation[rows], result.consistent[rows] = separation, separation <= 1.0
    one, two = worst[:, 1], worst[:, 2]
    result.worst_one[rows] = _channels(channel, np.where(one < n, one, -1)[:, None])[:, 0]
    # After the channels: constellations, then the sides, a wrong map, and none.
    letters = np.array([*plan.groups, *[""] * (plan.side_prior.shape[1] + 2)])
    result.worst_constellation[rows] = letters[np.where(one >= n, one - n, -1)]
    pairs = np.stack(np.triu_indices(n if plan.pairs[rows].any() else 0, 1), axis=1)
    pairs = np.concatenate([pairs, [[-1, -1]]])
    result.worst_two[rows] = _channels(channel, pairs[np.where(two < len(pairs), two, -1)])
    infinite = np.where(plan.fault_free[rows] > 0, Cause.UNCHECKED, Cause.BUDGET)
    spent_on = np.where(spender == _OF_TRIPLES, Cause.THREE_FAULTS, spender)
    result.cause[rows] = np.where(np.isinf(level), infinite, spent_on)


def _channels(channel: Indices, place: Indices) -> Indices:
    """Channels at places side by side, shape (T, k); -1 for -1."""
    return np.where(place >= 0, np.take_along_axis(channel, np.maximum(place, 0), axis=1), -1)


@compiled_by("hypotheses")
def hypotheses(
    root_weight: Floats,
    clock: Indices,
    clock_covariance_m2: Floats,
    design: Floats,
    covariance_m2: Floats,
    map_prior: Floats,
    misfit: Floats,
    scale: Floats,
    least_sigma_m: Floats,
    bias_m: Floats,
    map_bias_m: Floats,
    map_seen_m: Floats,
    map_information: Floats,
    sides: Masks,
    prior: Floats,
    groups: Masks,
    group_prior: Floats,
    side_prior: Floats,
    sides_with_one: Masks,
    pairs: Masks,
    triples: Masks,
    k_false_alarm: Floats,
    wrong_map: float,
) -> tuple[Indices, Floats, Floats, Floats, Indices, Floats]:
    """Return the tails of all hypotheses of a block of epochs: no fault, one, two and three.

    Parameters are fields of `LinearModel` and of `Allocation`, and parameters of `along_track_level`, of these epochs
    and in C order; `least_sigma_m` and `bias_m` of shape (T, 0) for none, `wrong_map` 0 for no such hypothesis.

    Returns
    -------
    channel : ndarray of int, shape (T, n)
        Channels in use, side by side.
    offset_m, sigma_m, weight : ndarray, shape (T, K)
        As `tails.lowered` takes them: threshold and bias, sigma (infinite where nothing bounds a fault), probability.
    bounds : ndarray of int, shape (5,)
    separation : ndarray, shape (T,)
        `ProtectionLevel.separation`.
    """
    model = LinearModel(
        root_weight=root_weight,
        clock=clock,
        clock_covariance_m2=clock_covariance_m2,
        design=design,
        covariance_m2=covariance_m2,
        prior=map_prior,
        misfit=misfit,
        freedom=np.zeros(len(scale), dtype=np.int64),
        interest=1,
    )
    full = all_in_view(model, scale, least_sigma_m, bias_m, map_bias_m)
    n, zero = full.channel.shape[1], np.zeros((len(scale), 1))
    likely = np.take_along_axis(prior, full.channel, axis=1) * full.used
    ones, twos, threes = [(without_one(full), likely)], [], []
    if pairs.any():
        i, j = np.triu_indices(n, 1)
        twos.append((without_two(full, i, j), likely[:, i] * likely[:, j] * pairs[:, None]))
    for c, members in enumerate(groups):
        of_group, of_all = members[full.channel] & full.used, group_prior[:, c, None]
        ones.append((without_group(full, of_group), of_all))
        twos.append((without_group_and_one(full, of_group), of_all * likely * ~of_group))
    sided = np.any(sides_with_one, axis=0).tolist()
    side = [np.take_along_axis(sides[:, c], full.channel, axis=1) & full.used for c in range(sides.shape[1])]
    for c, of_side in enumerate(side):
        ones.append((without_group(full, of_side), side_prior[:, c, None]))
        if sided[c]:
            of_one = (side_prior[:, c] * sides_with_one[:, c])[:, None] * likely * ~of_side
            twos.append((without_group_and_one(full, of_side), of_one))
    if wrong_map > 0.0:
        free = without_map(full, model, map_seen_m, map_information, groups=any(sided))
        ones.append((free.apart(without_none(free.of_ranges)), zero + wrong_map))
        twos.append((free.apart(without_one(free.of_ranges)), wrong_map * likely))
        for c in (number for number, asked in enumerate(sided) if asked):
            of_both = wrong_map * (side_prior[:, c] * sides_with_one[:, c])[:, None]
            twos.append((free.apart(without_group(free.of_ranges, side[c])), of_both))
    if triples.any():
        i, j, k = np.array(list(combinations(range(n), 3)), dtype=np.intp).reshape(-1, 3).T
        of_three = likely[:, i] * likely[:, j] * likely[:, k] * triples[:, None]
        threes.append((without_three(full, i, j, k), of_three))
    kinds = [[(without_none(full), zero + 2.0)], ones, twos, threes]  # noise passes on either side
    apart = [part for kind in kinds for part, _ in kind]
    weight = np.concatenate([each for kind in kinds for _, each in kind], axis=1)
    sigma, between, moved, bias = (
        np.concatenate([getattr(part, item.name) for part in apart], axis=1) for item in fields(Separations)
    )
    threshold = k_false_alarm[:, None] * between
    moving = (weight > 0.0) & (between > _SAME * sigma[:, :1])
    separation = np.max(np.abs(moved) / np.where(moving, threshold, np.inf), axis=1)
    bounds = np.cumsum([0, *(sum(each.shape[1] for _, each in kind) for kind in kinds)])
    return full.channel, threshold + bias, sigma, weight, bounds, separation
