"""Allocation of the risk of each epoch to the hypotheses of its level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from railfix.core.arrays import Floats, Integers, Masks
from railfix.integrity.protection.risk import (
    MOST_EXCLUDED,
    RiskBudget,
    more_than_three,
    more_than_two,
    one_sided_k,
    pair_sum,
)
from railfix.integrity.raim import LinearModel


@dataclass(frozen=True)
class Allocation:
    """Allocation of the risk, T epochs."""

    prior: Floats  # (T, M), 0 where not used
    groups: tuple[str, ...]  # letters of the C constellations with a prior of their own
    members: Masks  # (C, M) of these
    group_prior: Floats  # (T, C), 0 where absent
    beyond: Floats
    fault_free: Floats  # risk of each part
    one: Floats
    two: Floats
    pairs: Masks  # two faults are likelier than their share
    triples: Masks  # three faults are likelier than what may stay unchecked
    k_false_alarm: Floats
    map_prior: float  # of a wrong map; 0: no hypothesis
    sides: Masks  # (T, S, M) of satellites that fail together; two of these sets at a time where that is likely
    side_prior: Floats  # (T, S), 0 where fewer than two
    sides_with_one: Masks  # (T, S) with another fault likelier than what may stay unchecked


def allocate(
    model: LinearModel, systems: Sequence[str], risk: RiskBudget, out: Integers, sides: Masks, *, wrong_map: bool
) -> Allocation:
    """Divide the risk of each epoch.

    Parameters
    ----------
    model : LinearModel
        T epochs, M channels.
    systems : sequence of str, length M
    risk : RiskBudget
    out : ndarray of int, shape (T,)
        Satellites excluded.
    sides : ndarray of bool, shape (T, S, M)
        Sets of satellites that fail together.
    wrong_map : bool
        Whether a wrong map is a hypothesis.
    """
    used = model.used
    if len(used) == 1:  # live, where the same satellites are used epoch after epoch
        return _of_one_epoch(
            _Same(risk), tuple(systems), used.tobytes(), int(out[0]), sides.tobytes(), sides.shape[1], wrong_map
        )
    return _allocated(used, systems, risk, out, sides, wrong_map=wrong_map)


class _Same:
    """A budget that is equal to itself alone: its contents are not hashed."""

    def __init__(self, risk: RiskBudget) -> None:
        self.risk = risk

    def __hash__(self) -> int:
        return id(self.risk)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.risk is self.risk


@lru_cache(maxsize=64)
def _of_one_epoch(
    risk: _Same, systems: tuple[str, ...], used: bytes, out: int, sides: bytes, count: int, wrong_map: bool
) -> Allocation:
    """Allocation of one epoch, kept: nobody writes into it."""
    channels = len(systems)
    return _allocated(
        np.frombuffer(used, dtype=bool).reshape(1, channels).copy(),
        systems,
        risk.risk,
        np.array([out]),
        np.frombuffer(sides, dtype=bool).reshape(1, count, channels).copy(),
        wrong_map=wrong_map,
    )


def _allocated(
    used: Masks, systems: Sequence[str], risk: RiskBudget, out: Integers, sides: Masks, *, wrong_map: bool
) -> Allocation:
    of_channel = risk.prior(systems)
    prior = used * of_channel
    # Excluded satellites count among those that may be faulty, with the largest prior.
    everyone = np.concatenate([prior, (np.arange(MOST_EXCLUDED) < out[:, None]) * of_channel.max(initial=0.0)], axis=1)
    letters = [s for s in dict.fromkeys(systems) if risk.constellation_prior.get(s, 0.0) > 0.0]
    of_letter = np.array([[t == s for t in systems] for s in letters], dtype=bool).reshape(len(letters), len(systems))
    group_prior = np.zeros((len(used), len(letters)))
    together = np.zeros(len(used))
    for c, (letter, members) in enumerate(zip(letters, of_letter, strict=True)):
        group_prior[:, c] = (used & members).any(axis=1) * risk.constellation_prior[letter]
        # A constellation and two satellites of others: not checked.
        together += group_prior[:, c] * pair_sum(prior * ~members)
    three, share = more_than_two(everyone), risk.unchecked_share * risk.risk_per_sample
    triples = three > share
    map_prior = risk.map_prior if wrong_map else 0.0
    # A wrong map with a constellation, or with two satellites.
    of_groups, every = group_prior.sum(axis=1), everyone.sum(axis=1)
    together += map_prior * (of_groups + pair_sum(everyone))
    side_prior = np.where(np.count_nonzero(sides & used[:, None], axis=2) > 1, risk.side_prior, 0.0)
    # A side with a satellite or a wrong map: not checked, or with two other faults. With a constellation, both sides.
    if not side_prior.any():
        sides, side_prior = sides[:, :0], side_prior[:, :0]
    any_side = side_prior.sum(axis=1)
    with_one, with_two = any_side * (every + map_prior), any_side * (pair_sum(everyone) + map_prior * every)
    sides_with_one = (with_one > share)[:, None] & (side_prior > 0.0)
    together += np.where(with_one > share, with_two, with_one) + any_side * of_groups
    # Two sides at a time: one more set each, or not checked; with any other fault, or three, not checked.
    i, j = np.triu_indices(side_prior.shape[1], 1)
    both_prior = side_prior[:, i] * side_prior[:, j]
    both = both_prior.sum(axis=1)
    together += np.where(both > share, both * (every + map_prior + of_groups), both) + more_than_two(side_prior)
    if (both > share).any():
        sides = np.concatenate([sides, sides[:, i] | sides[:, j]], axis=1)
        side_prior = np.concatenate([side_prior, both_prior * (both > share)[:, None]], axis=1)
        sides_with_one = np.concatenate([sides_with_one, np.zeros(both_prior.shape, dtype=bool)], axis=1)
    beyond = np.where(triples, more_than_three(everyone), three) + together + pair_sum(group_prior)
    n = np.count_nonzero(used, axis=1)
    left = risk.sample_risk(n, out, beyond)
    # With triples every part gives up a quarter to them.
    left = np.where(triples, 0.75, 1.0) * left
    two = risk.two_fault_share * left
    pairs = (pair_sum(prior) > two) | triples
    tests = n + np.where(pairs, n * (n - 1) // 2, 0) + np.count_nonzero(group_prior, axis=1)
    tests = tests + np.count_nonzero(side_prior, axis=1) + n * np.count_nonzero(sides_with_one, axis=1)
    tests = tests + n * np.count_nonzero(group_prior, axis=1)
    tests = tests + np.where(triples, n * (n - 1) * (n - 2) // 6, 0)
    return Allocation(
        prior=prior,
        groups=tuple(letters),
        members=of_letter,
        group_prior=group_prior,
        beyond=beyond,
        fault_free=risk.fault_free_share * left,
        one=risk.one_fault_share * left,
        two=two,
        pairs=pairs,
        triples=triples,
        k_false_alarm=one_sided_k(risk.false_alarm / (2.0 * np.maximum(tests, 1))),
        map_prior=map_prior,
        sides=sides,
        side_prior=side_prior,
        sides_with_one=sides_with_one,
    )
