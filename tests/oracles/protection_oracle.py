"""The level along the track by rows and columns: every subset deleted and solved again, formulas as written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb, prod

import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm

import raim_oracle


@dataclass(frozen=True)
class Answer:
    """One position: of which the level is made."""

    place_m: float
    sigma_m: float
    operator: np.ndarray  # of the rows: whitened ranges, then priors
    determined: bool


@dataclass(frozen=True)
class Level:
    level_m: float
    fault_free_m: float
    one_fault_m: float
    two_fault_m: float
    largest_m: float
    separation: float
    worst_one: int
    worst_two: tuple[int, int]
    sigma_m: float
    unchecked: float
    k_false_alarm: float
    orders: dict[tuple[Event, ...], int]


class Resolved:
    """One epoch solved with all satellites and without any of them, by least squares of what is left."""

    def __init__(self, case: raim_oracle.Problem, scale: float, least_sigma_m: np.ndarray | None = None) -> None:
        self.case, self.rows = case, len(case.observed)
        noise = np.full(self.rows, scale)  # ranges and ties
        n = len(case.channels)
        noise[n : n + 2] = 1.0  # the map: across and up
        if least_sigma_m is not None:
            noise[:n] = np.maximum(noise[:n], least_sigma_m[case.channels] / case.sigma_m)
        self.noise = noise
        self.answers: dict[tuple[int, ...], Answer] = {}
        self.all = self.without(())

    def without(self, members: tuple[int, ...]) -> Answer:
        """Position of what is left, solved once."""
        if members not in self.answers:
            self.answers[members] = self.solved(members)
        return self.answers[members]

    def solved(self, members: tuple[int, ...]) -> Answer:
        out = np.zeros(self.rows, dtype=bool)
        out[: len(self.case.channels)] = np.isin(self.case.channels, members)
        design, observed = self.case.design[~out], self.case.observed[~out]
        place, *_ = np.linalg.lstsq(design, observed, rcond=1e-12)
        inverse = np.linalg.pinv(design, rcond=1e-12)
        operator = np.zeros(self.rows)
        operator[~out] = inverse[0] * self.case.scale_of[0]
        aim = (inverse @ design)[0]
        return Answer(
            place_m=float(place[0] * self.case.scale_of[0]),
            sigma_m=float(np.sqrt(((operator * self.noise) ** 2).sum())),
            operator=operator,
            determined=bool(abs(aim[0] - 1.0) < 1e-7 and np.abs(aim[1:]).max() < 1e-7),
        )

    def apart(self, answer: Answer) -> tuple[float, float]:
        """Distance from the position of all, and its sigma."""
        difference = (answer.operator - self.all.operator) * self.noise
        return answer.place_m - self.all.place_m, float(np.sqrt((difference**2).sum()))


@dataclass(frozen=True)
class Event:
    """A fault that satellites share, or (without any) a wrong map."""

    kind: str  # constellation, side, map
    prior: float
    members: tuple[int, ...] = ()


def products(priors: Iterable[float], size: int) -> float:
    """Sum of the products over all sets of a size."""
    return sum(prod(chosen) for chosen in combinations(priors, size))


def sets_of(events: Sequence[Event]) -> list[tuple[Event, ...]]:
    """Sets of up to three shared faults."""
    return [some for size in range(4) for some in combinations(events, size)]


def kind_of(shared: tuple[Event, ...]) -> int:
    """Number of faults; sides count as one."""
    return len(shared) - max(sum(e.kind == "side" for e in shared) - 1, 0)


def hypotheses(
    everyone: Sequence[float], events: Sequence[Event], share: float, typical: float
) -> tuple[dict[tuple[Event, ...], int], float]:
    """Satellites left out at most with each set of shared faults (-1: it is no hypothesis), and the probability left.

    The rule in words: a class (shared faults, number of satellites) that is likelier than `share` is a hypothesis, and
    as long as all others together are, so is the one with the likeliest members.
    """
    always = {"constellation": 1, "side": 0, "map": 1}
    order = {}
    for shared in sets_of(events):
        p = prod(e.prior for e in shared)
        least = 2 if not shared else always[shared[0].kind] if len(shared) == 1 else -1
        order[shared] = max([least, *(k for k in range(5) if p * products(everyone, k) > share)])

    def rest() -> float:
        total = products([e.prior for e in events], 4)
        for shared, k in order.items():
            within = [s for size in range(len(shared)) for s in combinations(shared, size)]
            if k >= 0 or all(order[s] >= 0 for s in within):
                total += prod(e.prior for e in shared) * products(everyone, k + 1)
        return total

    while rest() > share:
        further = {s: (prod(e.prior for e in s) * typical ** (k + 1), -k) for s, k in order.items() if k < 4}
        if not further:
            break
        for shared, likely in further.items():
            order[shared] += likely == max(further.values())
    return order, rest()


def level(
    case: raim_oracle.Problem,
    prior: dict[int, float],
    *,
    risk_per_sample: float,
    share: float,
    false_alarm: float,
    scale: float = 1.0,
    bias_m: np.ndarray | None = None,
    events: Sequence[Event] = (),
    unmapped: Resolved | None = None,
) -> Level:
    """The level of one epoch; `prior` by channel, `share` of each part, `unmapped` what takes the place of the map."""
    solved = Resolved(case, scale)
    channels = [int(c) for c in case.channels]
    everyone, n = [prior[c] for c in channels], len(channels)
    bias = np.zeros(len(solved.noise))
    if bias_m is not None:
        bias[:n] = bias_m[channels] / case.sigma_m
    typical = float(np.mean(list(prior.values())))
    order, beyond = hypotheses(everyone, events, 0.3 * risk_per_sample, typical)
    more = any(k >= 0 and kind_of(shared) + k >= 3 for shared, k in order.items())
    part = share * max(risk_per_sample - beyond, 0.0) * (0.75 if more else 1.0)
    asked = order[()] > 2 or products(everyone, 2) > part
    order[()] = order[()] if asked else 1
    tests = -1 + sum(comb(n, k) for s, m in order.items() if all(e.kind != "map" for e in s) for k in range(m + 1))
    k_alarm = norm.isf(false_alarm / (2.0 * tests))

    kinds: list[list[tuple[float, float, float, tuple[int, ...], float]]] = [[], [], [], []]
    for shared, most in order.items():
        out = {c for e in shared for c in e.members}
        free = any(e.kind == "map" for e in shared)
        for k in range(most + 1):
            for further in combinations([c for c in channels if c not in out], k):
                p = prod(e.prior for e in shared) * prod(prior[c] for c in further) * (1.0 if shared or k else 2.0)
                members = (*sorted(out), *further)
                answer = (unmapped if free and unmapped is not None else solved).without(members)
                if not answer.determined or answer.sigma_m > 1e4:
                    offset, ratio = np.nan, 0.0
                elif free:
                    effect = np.abs(answer.operator) @ (bias / scale)
                    offset, ratio = abs(answer.place_m - solved.all.place_m) + effect, 0.0
                else:
                    distance, sigma = solved.apart(answer)
                    offset = k_alarm * sigma + np.abs(answer.operator) @ bias
                    ratio = abs(distance) / (k_alarm * sigma) if sigma > 1e-6 * solved.all.sigma_m else 0.0
                kinds[min(kind_of(shared) + k, 3)].append((p, float(offset), answer.sigma_m, members, ratio))

    def of(kind: int) -> tuple[float, tuple[int, ...]]:
        tails = [each for each in kinds[kind] if np.isfinite(each[1])]
        left = part - sum(each[0] for each in kinds[kind] if not np.isfinite(each[1]))
        total = sum(each[0] for each in tails)
        if sum(each[0] for each in kinds[kind]) <= part:
            k = -np.inf
        elif left <= 0:
            return np.inf, ()
        else:
            k = norm.isf(left / total) if left < total else -np.inf
        largest = max(((offset + k * sigma, members) for _, offset, sigma, members, _ in tails), default=(0.0, ()))
        return (float(largest[0]), largest[1]) if largest[0] > 0.0 else (0.0, ())

    reserved = 0.0 if asked else products(everyone, 2)
    blind = sum(each[0] for kind in kinds for each in kind if not np.isfinite(each[1]))
    whole = [each for kind in kinds for each in kind if np.isfinite(each[1])]
    p_of, offset_of, sigma_of = (np.array([each[k] for each in whole]) for k in range(3))

    def spent(level_m: float) -> float:
        return float((p_of * norm.sf((level_m - offset_of) / sigma_of)).sum() + blind + reserved)

    (fault_free, _), (one, worst_one), (two, worst_two), (three, _) = (of(kind) for kind in range(4))
    largest = max(fault_free, one, two, three if more else 0.0)
    lowest = largest
    if np.isfinite(largest) and largest < 1e4:
        lowest = float(
            brentq(lambda at: np.log(spent(at)) - np.log((4.0 if more else 3.0) * part), 0.0, largest, xtol=1e-9)
        )
    return Level(
        level_m=lowest,
        fault_free_m=fault_free,
        one_fault_m=one,
        two_fault_m=two,
        largest_m=largest,
        separation=max(each[4] for each in whole),
        worst_one=worst_one[0] if len(worst_one) == 1 else -1,
        worst_two=worst_two if len(worst_two) == 2 else (-1, -1),
        sigma_m=solved.all.sigma_m,
        unchecked=beyond,
        k_false_alarm=float(k_alarm),
        orders=order,
    )
