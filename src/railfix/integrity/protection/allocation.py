"""Allocation of the risk of each epoch to the hypotheses of its level.

A hypothesis is a set of faults: shared ones (a constellation, the low satellites of one side of the track, a wrong map)
and those of single satellites. Hypotheses of the same shared faults and the same number of satellites are a class,
whose probability is at most the product of the priors of the shared faults times the sum over sets of satellites.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, groupby
from math import prod
from operator import itemgetter
from typing import Final, NamedTuple

import numpy as np
from scipy.special import comb

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.integrity.protection.risk import (
    MOST_EXCLUDED,
    MOST_TOGETHER,
    RiskBudget,
    one_sided_k,
    pair_sum,
    set_sums,
)
from railfix.integrity.raim import LinearModel

#: Shared faults at a time that may be hypotheses; the probability of more is taken off the risk.
_MOST_SHARED: Final = 3
#: Epochs of two antennas, live: their allocation is kept.
FEW: Final = 2
#: Sets of a class that are left out one by one at most: four of 34 satellites.
_MOST_SETS: Final = 46_376


class Shared(NamedTuple):
    """Shared faults at a time."""

    events: tuple[int, ...]  # constellations, then sets that fail together
    wrong_map: bool
    kind: int  # number of faults; two sides count as one

    @property
    def size(self) -> int:
        """Number of shared faults, the map included."""
        return len(self.events) + self.wrong_map


@dataclass(frozen=True)
class Allocation:
    """Allocation of the risk, T epochs."""

    prior: Floats  # (T, M), 0 where not used
    groups: tuple[str, ...]  # letters of the C constellations with a prior of their own
    shared: tuple[Shared, ...]  # B sets of shared faults, of which the first is empty
    members: Masks  # (T, B, M) satellites of these
    shared_prior: Floats  # (T, B) of these, 0 where absent
    order: Indices  # (T, B) satellites at most that are left out with each; -1: not a hypothesis
    beyond: Floats  # probability of the classes that are no hypotheses
    fault_free: Floats  # risk of each part
    one: Floats
    two: Floats
    more: Floats  # 0 where three faults are no hypotheses
    reserved: Floats  # of pairs of satellites where they fit into their share unchecked
    k_false_alarm: Floats


def allocate(
    model: LinearModel, systems: Sequence[str], risk: RiskBudget, out: Integers, sides: Masks, *, wrong_map: bool
) -> Allocation:
    """Divide the risk of each epoch.

    Satellites alone, in pairs (where these are likelier than their share) and with a wrong map, constellations with one
    satellite, and sides are hypotheses always. So is each class that is likelier than what may stay unchecked, and
    where the rest together is, further ones, those with the likeliest single hypotheses first.

    Parameters
    ----------
    model : LinearModel
        T epochs, M channels.
    systems : sequence of str, length M
    out : ndarray of int, shape (T,)
        Satellites excluded.
    sides : ndarray of bool, shape (T, S, M)
        Sets of satellites that fail together.
    wrong_map : bool
        Whether a wrong map is a hypothesis.
    """
    used = model.used
    if len(used) <= FEW:  # live, where the same satellites are used epoch after epoch
        given = (used.tobytes(), out.tobytes(), (sides & used[:, None]).tobytes())
        return _of_few_epochs(_Same(risk), tuple(systems), *given, sides.shape[1], wrong_map)
    return _allocate(used, systems, risk, out, sides, wrong_map=wrong_map)


class _Same:
    """A budget that is equal to itself alone: its contents are not hashed."""

    def __init__(self, risk: RiskBudget) -> None:
        self.risk = risk

    def __hash__(self) -> int:
        return id(self.risk)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.risk is self.risk


@lru_cache(maxsize=64)
def _of_few_epochs(
    risk: _Same, systems: tuple[str, ...], used: bytes, out: bytes, sides: bytes, count: int, wrong_map: bool
) -> Allocation:
    """Allocation of few epochs, kept: nobody writes into it."""
    channels, excluded = len(systems), np.frombuffer(out, dtype=np.int64).copy()
    return _allocate(
        np.frombuffer(used, dtype=bool).reshape(len(excluded), channels).copy(),
        systems,
        risk.risk,
        excluded,
        np.frombuffer(sides, dtype=bool).reshape(len(excluded), count, channels).copy(),
        wrong_map=wrong_map,
    )


def _allocate(
    used: Masks, systems: Sequence[str], risk: RiskBudget, out: Integers, sides: Masks, *, wrong_map: bool
) -> Allocation:
    of_channel = risk.prior(systems)
    prior = used * of_channel
    # Excluded satellites count among those that may be faulty, with the largest prior.
    everyone = np.concatenate([prior, (np.arange(MOST_EXCLUDED) < out[:, None]) * of_channel.max(initial=0.0)], axis=1)
    letters = [s for s in dict.fromkeys(systems) if risk.constellation_prior.get(s, 0.0) > 0.0]
    of_letter = np.array([[t == s for t in systems] for s in letters], dtype=bool).reshape(len(letters), len(systems))
    members = np.concatenate([used[:, None] & of_letter, sides], axis=1)
    # A constellation has a satellite at least, a side two.
    nominal = np.array([risk.constellation_prior[s] for s in letters] + [risk.side_prior] * sides.shape[1])
    least = np.array([1] * len(letters) + [2] * sides.shape[1])
    event_prior = nominal * (np.count_nonzero(members & used[:, None], axis=2) >= least)
    events = np.flatnonzero(event_prior.any(axis=0)).tolist()
    of_map = risk.map_prior if wrong_map else 0.0
    shared, within = _sets_of(tuple(events), len(letters), wrong_map=of_map > 0.0)
    each = np.stack([event_prior[:, s.events].prod(axis=1) * (of_map if s.wrong_map else 1.0) for s in shared], axis=1)
    likely = [prod(nominal[[*s.events]].tolist()) * (of_map if s.wrong_map else 1.0) for s in shared]
    further = np.zeros(len(used))
    if len(events) + wrong_map > _MOST_SHARED:
        of_each = np.concatenate([event_prior, np.full((len(used), 1), of_map)], axis=1)
        further = set_sums(of_each, _MOST_SHARED + 1)[:, -1]
    n = np.count_nonzero(used, axis=1)
    always = [2] + [-1 if s.size > 1 else int(s.wrong_map or s.events[0] < len(letters)) for s in shared[1:]]
    classes = _Classes(each, within, set_sums(everyone, MOST_TOGETHER + 1), further, always)
    order = classes.chosen(
        risk.unchecked_share * risk.risk_per_sample, likely, float(of_channel.mean()) if len(of_channel) else 0.0, n
    )
    beyond = classes.rest(order)
    left = risk.sample_risk(n, out, beyond)
    # With hypotheses of three faults every part gives up a quarter to them.
    more = (order + [s.kind for s in shared] >= 3).any(axis=1, where=order >= 0)
    left = np.where(more, 0.75, 1.0) * left
    parts = [s * left for s in (risk.fault_free_share, risk.one_fault_share, risk.two_fault_share)]
    of_pairs = pair_sum(prior)
    pairs = (of_pairs > parts[2]) | (order[:, 0] > 2)
    order[:, 0] = np.where(pairs, order[:, 0], 1)
    mapped = np.array([s.wrong_map for s in shared])
    sizes = np.cumsum(comb(n[:, None], np.arange(MOST_TOGETHER + 1)), axis=1)
    sizes = np.concatenate([sizes, np.zeros((len(n), 1))], axis=1)
    tests = np.where(mapped, 0.0, np.take_along_axis(sizes, order, axis=1)).sum(axis=1) - 1.0
    asked = [0, *(b for b in range(1, len(shared)) if (order[:, b] >= 0).any())]
    return Allocation(
        prior=prior,
        groups=tuple(letters),
        shared=tuple(shared[b] for b in asked),
        members=np.stack([members[:, shared[b].events].any(axis=1) for b in asked], axis=1),
        shared_prior=each[:, asked],
        order=order[:, asked],
        beyond=beyond,
        fault_free=parts[0],
        one=parts[1],
        two=parts[2],
        more=np.where(more, sum(parts) / 3.0, 0.0),
        reserved=np.where(pairs, 0.0, of_pairs),
        k_false_alarm=one_sided_k(risk.false_alarm / (2.0 * np.maximum(tests, 1.0))),
    )


@lru_cache(maxsize=64)
def _sets_of(events: tuple[int, ...], constellations: int, *, wrong_map: bool) -> tuple[tuple[Shared, ...], Masks]:
    """Return the B sets of up to three shared faults, smaller first, and which are those of one fault less (B, B)."""
    sets = []
    for size in range(_MOST_SHARED + 1):
        for some in combinations([*events, -1] if wrong_map else events, size):
            own = tuple(e for e in some if e >= 0)
            together = max(sum(e >= constellations for e in own) - 1, 0)
            sets.append(Shared(own, -1 in some, size - together))
    sets.sort(key=lambda s: (s.kind, s.size > 1))
    faults = [{*s.events, *([-1] if s.wrong_map else [])} for s in sets]
    within = [[part < whole and len(part) + 1 == len(whole) for part in faults] for whole in faults]
    return tuple(sets), np.array(within)


@dataclass(frozen=True)
class _Classes:
    """Classes of hypotheses: T epochs, B sets of shared faults, 0 to `MOST_TOGETHER` satellites with each."""

    each: Floats  # (T, B) prior of the shared faults
    within: Masks  # (B, B) sets of one fault less
    sums: Floats  # (T, MOST_TOGETHER + 2) over sets of satellites of 0, 1, 2, ...
    further: Floats  # (T,) probability of more shared faults than may be hypotheses
    least: Sequence[int]  # length B, satellites left out with each whatever the probability; -1: no hypothesis

    def _of(self, rows: Indices) -> _Classes:
        return replace(self, each=self.each[rows], sums=self.sums[rows], further=self.further[rows])

    def rest(self, order: Indices) -> Floats:
        """Return the probability of all faults that are no hypotheses, shape (T,).

        A set of shared faults that is no hypothesis counts whole, and with it all larger ones.
        """
        whole = (order < 0) & (self.each > 0.0)
        covered = whole.astype(np.float64) @ self.within.T > 0.0
        each = np.where(covered, 0.0, self.each * np.take_along_axis(self.sums, order + 1, axis=1))
        return np.asarray(each.sum(axis=1) + self.further)

    def chosen(self, share: float, likely: Sequence[float], satellite: float, used: Integers) -> Indices:
        """Return how many satellites at most are left out with each set of shared faults, shape (T, B).

        Parameters
        ----------
        share : float
            Probability that may stay unchecked.
        likely : sequence of float, length B
            Priors of the shared faults.
        satellite : float
            Prior of a satellite.
        used : ndarray of int, shape (T,)
        """
        sizes = np.arange(MOST_TOGETHER + 1)
        feasible = comb(used[:, None], sizes) <= _MOST_SETS
        alone = (self.each[..., None] * self.sums[:, None, :-1] > share) & feasible[:, None]
        order = np.maximum(np.max(np.where(alone, sizes, -1), axis=2), self.least)
        order = np.where(self.each > 0.0, order, -1)
        rows = np.flatnonzero(self.rest(order) > share)
        if not len(rows):
            return np.asarray(order, dtype=np.intp)
        classes = [(-likely[b] * satellite**k, k, b) for b in range(len(likely)) for k in sizes.tolist()]
        for (_, k), alike in groupby(sorted(classes), key=itemgetter(0, 1)):
            if not len(rows):
                break
            which = [b for _, _, b in alike]
            here = (order[rows][:, which] == k - 1) & (self.each[rows][:, which] > 0.0) & feasible[rows, k, None]
            if here.any():
                order[rows[:, None], which] += here
                rows = rows[self._of(rows).rest(order[rows]) > share]
        return np.asarray(order, dtype=np.intp)
