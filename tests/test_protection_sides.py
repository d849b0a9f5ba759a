"""Satellites of one side of the track, and a wrong map, as hypotheses of the level, against deleting and solving."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from math import comb, prod

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import norm

import protection_oracle
import raim_oracle as oracle
from railfix.integrity.protection import RiskBudget, along_track_level
from railfix.integrity.raim import constrained_model

pytestmark = pytest.mark.requirement("C2")

ARC = np.array([731.0])
RISK = RiskBudget(
    risk_per_hour=1e-4,
    samples_per_hour=1.0,
    exclusion_share=0.0,
    false_alarm=0.01,
    satellite_prior={"G": 4e-4, "E": 6e-4, "C": 7e-4},
    local_prior=0.0,
    map_prior=1e-3,
)
SYSTEMS = "GGGGGEEEECCC"
SIDES = ((0, 5, 9), (2, 3, 10), (4,))
MAP_SIGMA_M = np.array([2.0, 5.0])


def without_the_map(case: oracle.Problem, seen_m: tuple[float, float] | None, scale: float) -> oracle.Problem:
    """The offset of the last minutes in place of the rows of the map, or nothing."""
    n = len(case.channels)
    design, observed = case.design.copy(), case.observed.copy()
    design[[n, n + 1], [1, 2]] = 0.0 if seen_m is None else case.scale_of[1:3] / MAP_SIGMA_M
    observed[n : n + 2] = np.array(seen_m or (0.0, 0.0)) / MAP_SIGMA_M
    design[:n], observed[:n] = design[:n] / scale, observed[:n] / scale
    return replace(case, design=design, observed=observed)


def products(priors: list[float], size: int) -> float:
    return sum(prod(chosen) for chosen in combinations(priors, size))


@given(
    seed=st.integers(0, 2**32 - 1),
    side_prior=st.sampled_from([0.0, 1e-6, 3e-3, 6e-3]),
    scale=st.sampled_from([1.0, 2.5]),
    biased=st.booleans(),
    seen=st.sampled_from([(0.0, 0.0), (4.5, -10.0), None]),
)
@settings(max_examples=15, deadline=None)
def test_tails_of_all_hypotheses_use_up_the_risk(seed, side_prior, scale, biased, seen):
    """Sides, sides with one satellite or a wrong map where these are likely, and what is counted as unchecked."""
    ranges = oracle.made(ARC, SYSTEMS, seed=seed, faults_m={1: 9.0})
    model, case = constrained_model(ranges, oracle.LINE, ARC), oracle.problem_on_line(ranges, 0, ARC[0])
    members = np.zeros((1, len(SIDES), len(SYSTEMS)), dtype=bool)
    for number, side in enumerate(SIDES):
        members[0, number, list(side)] = True
    bias = np.random.default_rng(seed).uniform(0.0, 1.0, len(SYSTEMS)) if biased else None
    got = along_track_level(
        model,
        list(SYSTEMS),
        risk=RISK.replaced(side_prior=side_prior),
        scale=scale,
        bias_m=bias,
        map_seen=(np.array([seen or (0.0, 0.0)]), np.diag(MAP_SIGMA_M**-2.0)[None] * (seen is not None)),
        sides=members,
    )
    prior = dict(enumerate(RISK.prior(list(SYSTEMS)).tolist()))
    every, n = list(prior.values()), len(SYSTEMS)
    of_map, sides = RISK.map_prior, [side for side in SIDES if len(side) > 1 and side_prior > 0.0]
    with_one = len(sides) * side_prior * (sum(every) + of_map)
    sided, with_two = with_one > 0.3e-4, len(sides) * side_prior * (products(every, 2) + of_map * sum(every))
    both = [(tuple({*a, *b}), side_prior**2) for a, b in combinations(sides, 2) if side_prior**2 > 0.3e-4]
    beyond = products(every, 3) + of_map * products(every, 2)
    beyond += with_two if sided else with_one
    beyond += side_prior**2 * (sum(every) + of_map) if both else products([side_prior] * len(sides), 2)
    assert (sided, len(both)) == (side_prior >= 3e-3, side_prior == 6e-3)
    assert got.unchecked_risk[0] == pytest.approx(beyond, rel=1e-9)
    # Two satellites are hypotheses where they are likelier than a third of the risk.
    pairs = list(combinations(prior, 2)) if products(every, 2) > (1e-4 - beyond) / 3.0 else []
    tests = n + (comb(n, 2) if pairs else 0) + len(sides) * (n + 1 if sided else 1) + len(both)
    k_alarm = norm.isf(RISK.false_alarm / (2 * tests))
    assert got.k_false_alarm[0] == pytest.approx(k_alarm, rel=1e-9)

    ones = [((c,), p) for c, p in prior.items()] + [(side, side_prior) for side in sides] + both
    ones += [((c, d), prior[c] * prior[d]) for c, d in pairs]
    ones += [((*s, c), side_prior * p) for s in sides for c, p in prior.items() if sided and c not in s]
    free = [((), of_map)] + [((c,), of_map * p) for c, p in prior.items()]
    free += [(side, of_map * side_prior) for side in sides if sided]
    solved = protection_oracle.Resolved(case, scale)
    unmapped = protection_oracle.Resolved(without_the_map(case, seen, scale), 1.0)

    def shifted(answer: protection_oracle.Answer, noise: float) -> float:
        share = np.abs(answer.operator[:n]) / (noise * case.sigma_m)
        return 0.0 if bias is None else float(share @ bias)

    level = float(got.level_m[0])
    spent = 2.0 * norm.sf((level - shifted(solved.all, 1.0)) / solved.all.sigma_m)
    ratio = 0.0
    for left_out, p in ones:
        answer = solved.without(left_out)
        if not answer.determined or answer.sigma_m > 1e4:
            spent += p
            continue
        distance, sigma = solved.apart(answer)
        spent += p * norm.sf((level - k_alarm * sigma - shifted(answer, 1.0)) / answer.sigma_m)
        if sigma > 1e-6 * solved.all.sigma_m:
            ratio = max(ratio, abs(distance) / (k_alarm * sigma))
    for left_out, p in free:
        answer = unmapped.without(left_out)
        if not answer.determined or answer.sigma_m > 1e4:
            spent += p
            continue
        away = abs(answer.place_m - solved.all.place_m) + shifted(answer, scale)
        spent += p * norm.sf((level - away) / answer.sigma_m)
    allowed = 1e-4 - beyond - (0.0 if pairs else products(every, 2))
    if np.isinf(level):
        assert spent > (1e-4 - beyond) / 3.0
    else:
        assert 0.99 * allowed < spent <= allowed * (1.0 + 1e-6)
    assert got.separation[0] == pytest.approx(ratio, rel=1e-5)
