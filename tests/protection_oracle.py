"""The level along the track by rows and columns: every subset deleted and solved again, formulas as written."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

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


def level(
    case: raim_oracle.Problem,
    prior: dict[int, float],
    *,
    risk_per_sample: float,
    share: float,
    false_alarm: float,
    scale: float = 1.0,
    bias_m: np.ndarray | None = None,
    constellations: tuple[tuple[tuple[int, ...], float], ...] = (),
    unchecked_share: float = 0.3,
) -> Level:
    """The level of one epoch; `prior` by channel, `share` of each part, constellations as (channels, prior)."""
    solved = Resolved(case, scale)
    channels = [int(c) for c in case.channels]
    bias = np.zeros(len(solved.noise))
    if bias_m is not None:
        bias[: len(channels)] = bias_m[channels] / case.sigma_m
    ones = [((c,), prior[c]) for c in channels] + list(constellations)
    twos = [((c, d), prior[c] * prior[d]) for c, d in combinations(channels, 2)]
    threes = [((c, d, e), prior[c] * prior[d] * prior[e]) for c, d, e in combinations(channels, 3)]
    triples = sum(p for _, p in threes) > unchecked_share * risk_per_sample
    fours = sum(prior[c] * prior[d] * prior[e] * prior[f] for c, d, e, f in combinations(channels, 4))
    beyond = fours if triples else sum(p for _, p in threes)
    with_one = []
    for members, p in constellations:
        others = [c for c in channels if c not in members]
        with_one += [((*members, c), p * prior[c]) for c in others]
        beyond += p * sum(prior[c] * prior[d] for c, d in combinations(others, 2))
    beyond += sum(p * q for (_, p), (_, q) in combinations(constellations, 2))
    part = share * max(risk_per_sample - beyond, 0.0) * (0.75 if triples else 1.0)
    asked = triples or sum(p for _, p in twos) > part
    tests = len(ones) + (len(twos) if asked else 0) + (len(threes) if triples else 0)
    tests += len(channels) * len(constellations)
    k_alarm = norm.isf(false_alarm / (2.0 * tests))

    def of(hypotheses: list[tuple[tuple[int, ...], float]]) -> tuple[float, float, tuple[int, ...]]:
        answers = [(members, p, solved.without(members)) for members, p in hypotheses]
        left = part - sum(p for _, p, answer in answers if not answer.determined)
        total = sum(p for _, p, answer in answers if answer.determined)
        if sum(p for _, p, _ in answers) <= part:
            k = -np.inf
        elif left <= 0:
            return np.inf, 0.0, ()
        else:
            k = norm.isf(left / total) if left < total else -np.inf
        largest, ratio, worst = 0.0, 0.0, ()
        for members, _, answer in answers:
            if answer.determined:
                distance, sigma = solved.apart(answer)
                here = k_alarm * sigma + k * answer.sigma_m + np.abs(answer.operator) @ bias
                if here > largest:
                    largest, worst = float(here), members
                if sigma > 1e-6 * solved.all.sigma_m:
                    ratio = max(ratio, abs(distance) / (k_alarm * sigma))
        return largest, ratio, worst

    one, ratio_one, worst_one = of(ones)
    doubles = [*(twos if asked else []), *with_one]
    two, ratio_two, worst_two = of(doubles) if doubles else (0.0, 0.0, ())
    three, ratio_three, _ = of(threes) if triples else (0.0, 0.0, ())
    fault_free = norm.isf(part / 2.0) * solved.all.sigma_m + np.abs(solved.all.operator) @ bias

    def spent(level_m: float) -> float:
        total = 2.0 * norm.sf((level_m - np.abs(solved.all.operator) @ bias) / solved.all.sigma_m)
        for members, p in [*ones, *doubles, *(threes if triples else [])]:
            answer = solved.without(members)
            if answer.determined:
                offset = k_alarm * solved.apart(answer)[1] + np.abs(answer.operator) @ bias
                total += p * norm.sf((level_m - offset) / answer.sigma_m)
            else:
                total += p
        return float(total + (0.0 if asked else sum(p for _, p in twos)))

    largest = max(float(fault_free), one, two, three)
    whole = largest
    if np.isfinite(largest) and largest < 1e4:
        whole = float(
            brentq(lambda at: np.log(spent(at)) - np.log((4.0 if triples else 3.0) * part), 0.0, largest, xtol=1e-9)
        )
    return Level(
        level_m=whole,
        fault_free_m=float(fault_free),
        one_fault_m=one,
        two_fault_m=two,
        largest_m=largest,
        separation=max(ratio_one, ratio_two, ratio_three),
        worst_one=worst_one[0] if len(worst_one) == 1 else -1,
        worst_two=worst_two if len(worst_two) == 2 else (-1, -1),
        sigma_m=solved.all.sigma_m,
    )
