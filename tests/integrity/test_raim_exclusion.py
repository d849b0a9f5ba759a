"""Exclusion of one and two satellites: against trying every subset by solving again, and by hand."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import raim_cases
import raim_oracle as oracle
import synthetic
from railfix.integrity.raim import LinearModel, Outcome, RaimLimits, exclude, linear_model
from railfix.positioning.range_arrays import UNTIED_M, Ranges

pytestmark = pytest.mark.requirement("B4")

SYSTEMS = [
    ("GGGGGGGG", None),
    ("GGGGGEEE", None),
    ("GGGGEECC", None),
    ("GGGGEEC", None),
    ("GGGGGEEE", (0.0, 1.0)),
    ("GGGGECC", (0.0, 0.5, UNTIED_M)),
    ("GGGG", None),
    ("GGEE", None),
]
BIG = st.floats(-200.0, 200.0)


def check_against_trying(case: oracle.Problem, model: LinearModel, limits: RaimLimits, scale: float) -> None:
    outcome, equals = oracle.exclusion_by_trying(case, limits, scale)
    got = exclude(model, limits=limits, scale=scale)
    assert Outcome(got.outcome[0]) == outcome
    if not equals:
        assert (got.best == -1).all()
        assert np.isnan(got.own_error_m).all()
        return
    # Of equals, which comes first is arbitrary.
    best = next(c for c in equals if list(c.members) == [b for b in got.best[0] if b >= 0])
    members = list(best.members)
    assert np.flatnonzero(got.excluded[0]).tolist() == ([] if outcome is Outcome.INSEPARABLE else members)
    assert np.flatnonzero(np.isfinite(got.own_error_m[0])).tolist() == members
    assert got.own_error_m[0, members] == pytest.approx(best.own_m, rel=1e-4, abs=1e-3)
    assert got.position_change_m[0] == pytest.approx(best.move_m, rel=1e-4, abs=1e-3)
    assert got.statistic_after[0] == pytest.approx(best.statistic, rel=1e-4, abs=1e-4)


@given(
    seed=st.integers(0, 2**32 - 1),
    system=st.sampled_from(SYSTEMS),
    faults=st.dictionaries(st.integers(0, 3), BIG, max_size=3),
    scale=st.sampled_from([1.0, 0.7, 3.0]),
    limits=st.sampled_from(
        [
            RaimLimits(),
            RaimLimits(separation_risk=1.0),
            RaimLimits(separation_risk=1.0, min_redundancy=2),
            RaimLimits(same_position_m=5.0),
            RaimLimits(max_excluded=1, false_alarm=1e-2),
            RaimLimits(mode="fixed"),
            RaimLimits(mode="fixed", separation_risk=1.0),
        ]
    ),
)
@example(seed=4147, system=SYSTEMS[5], faults={2: 7.0}, scale=1.0, limits=RaimLimits(mode="fixed"))
@example(seed=0, system=SYSTEMS[0], faults={2: 14.0}, scale=1.0, limits=RaimLimits(mode="fixed"))
@example(
    seed=0, system=SYSTEMS[6], faults={1: 150.0}, scale=1.0, limits=RaimLimits(separation_risk=1.0, min_redundancy=2)
)
@example(seed=0, system=SYSTEMS[0], faults={0: 60.0, 2: -90.0}, scale=1.0, limits=RaimLimits(max_excluded=1))
@settings(max_examples=40)
def test_line_equals_trying_every_subset(seed, system, faults, scale, limits):
    systems, ties = system
    arc = np.array([731.0])
    ranges = raim_cases.made(arc, systems, seed=seed, tie_sigma_m=ties, faults_m=faults)
    model = linear_model(ranges, raim_cases.LINE, arc)
    if np.isfinite(model.wsse[0]):
        check_against_trying(oracle.problem_on_line(ranges, 0, arc[0], raim_cases.LINE), model, limits, scale)


@given(
    seed=st.integers(0, 2**32 - 1),
    system=st.sampled_from(SYSTEMS[:5]),
    faults=st.dictionaries(st.integers(0, 3), BIG, max_size=2),
    limits=st.sampled_from([RaimLimits(), RaimLimits(separation_risk=1.0), RaimLimits(mode="fixed")]),
)
@settings(max_examples=40)
def test_space_equals_trying_every_subset(seed, system, faults, limits):
    systems, ties = system
    ranges = raim_cases.made(np.array([731.0]), systems, seed=seed, tie_sigma_m=ties, faults_m=faults)
    place = raim_cases.LINE.at_arc(np.array([731.0]))
    model = raim_cases.point_model(ranges, place)
    if np.isfinite(model.wsse[0]):
        check_against_trying(oracle.problem_in_space(ranges, 0, place[0]), model, limits, 1.0)


def test_every_outcome_is_reached_by_the_cases():
    """The comparisons above would prove nothing if all cases ended alike."""
    reached = set()
    arc = np.full(200, 731.0)
    for systems, ties in SYSTEMS:
        for faults in ({}, {0: 60.0}, {0: 60.0, 2: -90.0}, {0: 60.0, 1: 80.0, 2: -90.0, 3: 150.0}):
            ranges = raim_cases.made(arc, systems, seed=6, tie_sigma_m=ties, faults_m=faults)
            reached |= set(exclude(linear_model(ranges, raim_cases.LINE, arc)).outcome.tolist())
    only_three = raim_cases.only(raim_cases.made(arc, "GGGEEE", seed=6), [0, 3])
    reached |= set(exclude(linear_model(only_three, raim_cases.LINE, arc)).outcome.tolist())
    assert reached == {o.value for o in Outcome}


def parallel_case(along: int) -> Ranges:
    """Satellites ahead at one elevation, the others across the track: the first one's range is 100 m too long."""
    azimuth = np.radians(np.r_[np.full(along, 36.87), [126.87, 306.87] * 3])
    elevation = np.radians(np.r_[np.full(along, 30.0), [20.0, 25.0, 40.0, 50.0, 65.0, 75.0]])
    los = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=1
    )
    place = raim_cases.LINE.at_arc(np.array([1000.0]))[0]
    sat = place + synthetic.enu_to_ecef(2.2e7 * los) - synthetic.enu_to_ecef(np.zeros(3))
    sigma = np.full(len(azimuth), 0.5)
    return raim_cases.made(
        np.array([1000.0]), "G" * len(azimuth), seed=2, faults_m={0: 100.0}, sat_ecef_m=sat[None], sigma_m=sigma
    )


def test_parallel_lines_of_sight_that_alone_tell_the_place_cannot_be_separated():
    model = linear_model(parallel_case(2), raim_cases.LINE, np.array([1000.0]))
    got = exclude(model)
    assert got.outcome[0] == Outcome.INSEPARABLE
    assert not got.excluded.any()
    assert {got.best[0, 0], got.alternative[0, 0]} == {0, 1}
    assert got.alternative_shift_m[0] == pytest.approx(100.0 / np.cos(np.radians(30.0)), rel=0.03)
    # A third satellite ahead tells which.
    got = exclude(linear_model(parallel_case(3), raim_cases.LINE, np.array([1000.0])))
    assert got.outcome[0] == Outcome.EXCLUDED_ONE
    assert got.best[0].tolist() == [0, -1]
    assert got.own_error_m[0, 0] == pytest.approx(100.0, abs=3.0)


def mixed_case() -> tuple[Ranges, np.ndarray]:
    """Epochs of all kinds: clean, one fault, two, three, few satellites, channels without weight."""
    arc = np.linspace(100.0, 1900.0, 120)
    ranges = raim_cases.made(arc, "GGGGGGEEEECC", seed=21, tie_sigma_m=(0.0, 1.0, UNTIED_M))
    rng = np.random.default_rng(5)
    code, weight = ranges.code_m.copy(), ranges.weight.copy()
    for t in range(120):
        code[t, rng.choice(12, t % 4, replace=False)] += rng.uniform(20, 200, t % 4)
        weight[t, rng.choice(12, t % 10, replace=False)] = 0.0
    for array in (code, weight):
        array.flags.writeable = False
    return replace(ranges, code_m=code, weight=weight), arc


def test_all_epochs_at_once_is_epoch_by_epoch():
    ranges, arc = mixed_case()
    model = linear_model(ranges, raim_cases.LINE, arc)
    scale = np.linspace(0.7, 2.0, len(arc))
    whole = exclude(model, scale=scale)
    assert len(set(whole.outcome.tolist())) >= 5
    for t in range(len(arc)):
        one = exclude(model.take(np.array([t])), scale=scale[t])
        for item in fields(whole):
            if item.name != "detection":
                a, b = getattr(whole, item.name)[t], getattr(one, item.name)[0]
                assert a == pytest.approx(b, rel=1e-6, abs=1e-6, nan_ok=True), item.name


def test_unused_channels_are_never_named():
    ranges, arc = mixed_case()
    got = exclude(linear_model(ranges, raim_cases.LINE, arc), limits=RaimLimits(separation_risk=1.0))
    unused = ranges.weight == 0
    assert not (got.excluded & unused).any()
    assert np.isnan(got.own_error_m[unused]).all()
    for named in (got.best, got.alternative):
        t, k = np.nonzero(named >= 0)
        assert len(t) > 10
        assert not unused[t, named[t, k]].any()


def test_epochs_that_cannot_be_tested():
    arc = np.array([500.0, np.nan, 700.0, 900.0])
    ranges = raim_cases.made(np.nan_to_num(arc, nan=500.0), "GGGGGG", seed=5, faults_m={2: 300.0})
    weight = ranges.weight.copy()
    weight[2, 2:] = 0.0
    weight[3] = 0.0
    got = exclude(linear_model(replace(ranges, weight=weight), raim_cases.LINE, arc))
    assert got.outcome.tolist() == [Outcome.EXCLUDED_ONE] + [Outcome.UNTESTABLE] * 3
    assert got.position_change_m[1:].tolist() == [[0.0]] * 3
    nothing = exclude(linear_model(ranges, raim_cases.LINE, arc).take(np.zeros(4, dtype=bool)))
    assert nothing.excluded.shape == (0, 6)


def test_two_faults_of_forty_satellites_are_excluded():
    """Failing epochs, all pairs."""
    arc = np.linspace(50.0, 1950.0, 3000)
    ranges = raim_cases.made(arc, "G" * 12 + "E" * 10 + "C" * 10 + "R" * 8, seed=1, faults_m={3: 100.0, 20: -60.0})
    got = exclude(linear_model(ranges, raim_cases.LINE, arc))
    assert (got.outcome == Outcome.EXCLUDED_TWO).mean() > 0.95
