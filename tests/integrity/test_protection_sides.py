"""Satellites of one side of the track, and a wrong map, as hypotheses of the level, against deleting and solving."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import level_cases
import protection_oracle
import raim_cases
import raim_oracle as oracle
from railfix.integrity.protection import Cause, RiskBudget, protection_level
from railfix.integrity.protection.solution_separation import MapDeviation, RangeBounds
from railfix.integrity.raim import linear_model
from railfix.pipeline.level_stage import late_sides
from railfix.simulate.demonstration import demo_files

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
SYSTEMS = "GGGGEEECC"
SIDES = ((0, 5, 8), (2, 3, 7), (1,))
MAP_SIGMA_M = np.array([2.0, 5.0])


def without_the_map(case: oracle.Problem, seen_m: tuple[float, float] | None, scale: float) -> oracle.Problem:
    """The offset of the last minutes in place of the rows of the map, or nothing."""
    n = len(case.channels)
    design, observed = case.design.copy(), case.observed.copy()
    design[[n, n + 1], [1, 2]] = 0.0 if seen_m is None else case.scale_of[1:3] / MAP_SIGMA_M
    observed[n : n + 2] = np.array(seen_m or (0.0, 0.0)) / MAP_SIGMA_M
    design[:n], observed[:n] = design[:n] / scale, observed[:n] / scale
    return replace(case, design=design, observed=observed)


@given(
    seed=st.integers(0, 2**32 - 1),
    side_prior=st.sampled_from([0.0, 1e-6, 3e-3, 6e-3]),
    of_constellation=st.sampled_from([0.0, 1e-5, 1e-3]),
    common=st.sampled_from([0.0, 8e-4, 4e-3]),
    scale=st.sampled_from([1.0, 2.5]),
    biased=st.booleans(),
    seen=st.sampled_from([(0.0, 0.0), (4.5, -10.0), None]),
)
@settings(max_examples=15)
def test_tails_of_all_hypotheses_use_up_the_risk(seed, side_prior, of_constellation, common, scale, biased, seen):
    """Satellites, sides, constellations, a wrong map, and as many of them together as their priors ask for."""
    ranges = raim_cases.made(ARC, SYSTEMS, seed=seed, faults_m={1: 9.0})
    model, case = linear_model(ranges, raim_cases.LINE, ARC), oracle.problem_on_line(ranges, 0, ARC[0], raim_cases.LINE)
    members = np.zeros((1, len(SIDES), len(SYSTEMS)), dtype=bool)
    for number, side in enumerate(SIDES):
        members[0, number, list(side)] = True
    bias = np.random.default_rng(seed).uniform(0.0, 1.0, len(SYSTEMS)) if biased else None
    risk = RISK.replaced(
        side_prior=side_prior, local_prior=common, constellation_prior=dict.fromkeys("EC", of_constellation)
    )
    got = protection_level(
        model,
        list(SYSTEMS),
        risk=risk,
        scale=scale,
        overbound=RangeBounds(bias_m=bias),
        map_error=MapDeviation(
            seen=(np.array([seen or (0.0, 0.0)]), np.diag(MAP_SIGMA_M**-2.0)[None] * (seen is not None))
        ),
        sides=members,
    )
    prior = dict(enumerate(risk.prior(list(SYSTEMS)).tolist()))
    events = [
        *(protection_oracle.Event("constellation", of_constellation, of_letter(letter)) for letter in "EC"),
        *(protection_oracle.Event("side", side_prior, side) for side in SIDES if len(side) > 1),
        protection_oracle.Event("map", risk.map_prior),
    ]
    expected = protection_oracle.level(
        case,
        prior,
        risk_per_sample=1e-4,
        share=1.0 / 3.0,
        false_alarm=risk.false_alarm,
        scale=scale,
        bias_m=bias,
        events=[event for event in events if event.prior > 0.0],
        unmapped=protection_oracle.Resolved(without_the_map(case, seen, scale), 1.0),
    )
    assert got.unchecked_risk[0] == pytest.approx(expected.unchecked, rel=1e-9)
    if expected.unchecked >= 1e-4:
        assert got.cause[0] == Cause.BUDGET
        return
    assert got.k_false_alarm[0] == pytest.approx(expected.k_false_alarm, rel=1e-9)
    assert np.isinf(got.level_m[0]) == np.isinf(expected.largest_m)
    for mine, theirs in (
        (got.fault_free_m, expected.fault_free_m),
        (got.one_fault_m, expected.one_fault_m),
        (got.two_fault_m, expected.two_fault_m),
    ):
        if not 1e3 < theirs < np.inf:
            assert mine[0] == pytest.approx(theirs, rel=1e-6)
    if expected.largest_m < 1e3:
        assert expected.level_m * (1.0 - 1e-6) <= got.level_m[0] <= 1.01 * expected.level_m
    assert got.separation[0] == pytest.approx(expected.separation, rel=1e-5)


def of_letter(letter: str) -> tuple[int, ...]:
    return tuple(c for c, s in enumerate(SYSTEMS) if s == letter)


@pytest.mark.parametrize(("sides", "expected"), [("beside", ["DE", "BC"]), ("all", ["DE", "BC", "AB", "DF"])])
def test_satellites_ahead_and_behind_are_late_together_where_that_is_asked(sides: str, expected: list[str]) -> None:
    """A train to the east: A ahead and high, B ahead right, C right and high ahead, D behind left, E left, F behind."""
    azimuth = np.array([[90.0, 120.0, 170.0, 300.0, 10.0, 268.0]])
    elevation = np.array([[60.0, 20.0, 40.0, 30.0, 5.0, 71.0]])
    found = late_sides(azimuth, elevation, np.array([90.0]), RiskBudget(late_sides=sides))
    assert [set(np.array(list("ABCDEF"))[mask]) for mask in found[0]] == [set(names) for names in expected]


def test_levels_of_a_run_have_the_satellites_ahead_where_that_is_asked() -> None:
    """On a minute of the demonstration no level is smaller with these hypotheses, and half are 1.5 times as large."""
    case = level_cases.of_files(demo_files())
    case = replace(case, observations=case.observations[600:900], reference_ecef_m=case.reference_ecef_m[600:900])
    beside, every = (
        case.solved(level_cases.SETTINGS.model_copy(update={"risk": RiskBudget(late_sides=sides)})).protection
        for sides in ("beside", "all")
    )
    ratio = every.level.level_m / beside.level.level_m
    ratio = ratio[np.isfinite(ratio)]
    assert len(ratio) > 200
    assert ratio.min() > 0.99
    assert np.median(ratio) > 1.5
