"""Reliability: detectable biases by simulation, slopes and protection levels by searching for the worst fault."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binom, chi2, ncx2, norm

import raim_cases
import raim_oracle as oracle
import synthetic
from railfix.integrity.raim import RaimLimits, detect, linear_model, noncentrality, reliability
from railfix.positioning.range_arrays import UNTIED_M
from raim_cases import point_model

pytestmark = pytest.mark.requirement("B6")

ARC = np.array([731.0])
SYSTEMS = [
    ("GGGGGG", None),
    ("GGGGEEE", None),
    ("GGGGEEC", None),
    ("GGGGEE", (0.0, 1.0)),
    ("GGGGECC", (0.0, 0.5, UNTIED_M)),
    ("GGGC", None),
]


def test_noncentrality_misses_with_the_stated_probability():
    freedom = np.array([1, 2, 3, 8, 30])
    for limits in (RaimLimits(), RaimLimits(false_alarm=1e-5, missed_detection=1e-7), RaimLimits(missed_detection=0.2)):
        value = noncentrality(freedom, limits=limits)
        missed = ncx2.cdf(chi2.isf(limits.false_alarm, freedom), freedom, value)
        assert missed == pytest.approx(np.full(5, limits.missed_detection), rel=1e-6)
        # One degree of freedom is a two-sided Gaussian test; its other tail is far away.
        gauss = norm.isf(limits.false_alarm / 2) + norm.isf(limits.missed_detection)
        assert value[0] == pytest.approx(gauss**2, rel=1e-3)
    assert np.isnan(noncentrality([0, -1])).all()


def responses(case: oracle.Problem) -> tuple[np.ndarray, np.ndarray]:
    """Projector of the ranges, (n, n), and movement of the wanted components, (n, k), for whitened errors."""
    inverse = np.linalg.pinv(case.design, rcond=1e-12)
    whole = np.eye(len(case.design)) - case.design @ inverse
    n, k = len(case.channels), case.interest
    return whole[:n, :n], (case.scale_of[:k, None] * inverse[:k, :n]).T


def worst_single(case: oracle.Problem, noncentral: float) -> float:
    """Movement by an error of one satellite, as large as the test misses, tried for each."""
    projector, gain = responses(case)
    moved = []
    for i in range(len(case.channels)):
        fault = np.eye(len(case.channels))[i]
        seen = fault @ projector @ fault
        if seen > 1e-9:
            moved.append(np.linalg.norm(gain.T @ fault) * np.sqrt(noncentral / seen))
        else:
            moved.append(np.inf if np.linalg.norm(gain.T @ fault) > 1e-7 else 0.0)
    return max(moved)


def worst_pair(case: oracle.Problem, noncentral: float) -> float:
    """The same of two satellites, their errors tried in all proportions."""
    projector, gain = responses(case)
    angle = np.linspace(0.0, np.pi, 20_001)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    worst = 0.0
    for i, j in combinations(range(len(case.channels)), 2):
        both = [i, j]
        seen = np.einsum("ai,ij,aj->a", direction, projector[np.ix_(both, both)], direction)
        moved = np.linalg.norm(direction @ gain[both], axis=1)
        clear = seen > 1e-6
        worst = max(worst, float((moved[clear] * np.sqrt(noncentral / seen[clear])).max(initial=0.0)))
    return worst


@given(seed=st.integers(0, 2**32 - 1), system=st.sampled_from(SYSTEMS), space=st.booleans())
@settings(max_examples=40)
def test_protection_level_is_the_worst_fault_found_by_search(seed, system, space):
    ranges = raim_cases.made(ARC, system[0], seed=seed, tie_sigma_m=system[1])
    place = raim_cases.LINE.at_arc(ARC)
    if space:
        model, case = point_model(ranges, place), oracle.problem_in_space(ranges, 0, place[0])
    else:
        model, case = (
            linear_model(ranges, raim_cases.LINE, ARC),
            oracle.problem_on_line(ranges, 0, ARC[0], raim_cases.LINE),
        )
    if case.freedom < 1 or not np.isfinite(model.wsse[0]):
        return
    value = float(noncentrality(case.freedom))
    got = reliability(model)
    expected = worst_single(case, value)
    if not 1e6 < expected < np.inf:  # at the edge of what is checked
        assert got.fault_level_m[0] == pytest.approx(expected, rel=1e-4)
    share = np.diag(responses(case)[0])
    seen = share > 1e-6
    bias = got.minimal_detectable_bias_m[0][seen]
    assert bias == pytest.approx((case.sigma_m * np.sqrt(value / np.maximum(share, 1e-9)))[seen], rel=1e-4)
    assert np.isinf(got.minimal_detectable_bias_m[0][share < 1e-10]).all()

    two = reliability(model, limits=RaimLimits(faults=2))
    assert two.fault_level_m[0] >= got.fault_level_m[0] * (1 - 1e-12)
    if two.fault_level_m[0] < 300.0:  # flat enough for a search by angles
        assert two.fault_level_m[0] == pytest.approx(max(worst_pair(case, value), expected), rel=1e-3)


def test_a_fault_of_the_protection_level_moves_the_position_by_it():
    """Not in the linear model: ranges with the worst fault, solved again, without noise."""
    sat = synthetic.satellites(np.random.default_rng(9), 1, "GGGGEEE")
    sigma = np.full(7, 1.0)
    clean = raim_cases.made(ARC, "GGGGEEE", seed=1, sat_ecef_m=sat, sigma_m=sigma, noise=0.0)
    got, model = raim_cases.solved(clean, ARC)
    level = reliability(model)
    code = clean.code_m.copy()
    code[0, level.worst[0]] += level.minimal_detectable_bias_m[0, level.worst[0]]
    moved, after = raim_cases.solved(replace(clean, code_m=code), ARC)
    assert abs(moved.arc_m[0] - got.arc_m[0]) == pytest.approx(level.fault_level_m[0], rel=1e-3)
    assert after.wsse[0] == pytest.approx(level.noncentrality[0], rel=0.05)


def test_error_beyond_the_level_and_undetected_is_rarer_than_missed_detection():
    """The worst fault at the size that is missed most, with noise: P4's purpose of the level."""
    limits, epochs = RaimLimits(missed_detection=0.05, noise_risk=0.05), 20_000
    sat = synthetic.satellites(np.random.default_rng(12), 1, "GGGGG")
    sigma = np.array([1.0, 1.5, 0.7, 2.0, 1.0])
    arc = np.full(epochs, ARC[0])
    probe = raim_cases.made(ARC, "GGGGG", seed=1, sat_ecef_m=sat, sigma_m=sigma)
    level = reliability(linear_model(probe, raim_cases.LINE, ARC), limits=limits)
    worst = int(level.worst[0])
    hazard = []
    for share in (0.6, 0.8, 1.0, 1.2, 1.5):
        ranges = raim_cases.made(
            arc,
            "GGGGG",
            seed=5,
            faults_m={worst: share * level.minimal_detectable_bias_m[0, worst]},
            sat_ecef_m=np.repeat(sat, epochs, axis=0),
            sigma_m=sigma,
        )
        got, line = raim_cases.solved(ranges, arc)
        missed = ~detect(got.wsse, got.residual_m, line.freedom, limits=limits).detected
        hazard.append(np.mean(missed & (np.abs(got.arc_m - arc) > level.protection_level_m[0])))
    assert max(hazard) < 0.05
    assert max(hazard) > 0.0


def test_noise_level():
    """Fault-free errors are beyond K sigma with the stated risk along the line, at most so in the plane."""
    epochs = 20_000
    sat = np.repeat(synthetic.satellites(np.random.default_rng(3), 1, "GGGGGG"), epochs, axis=0)
    arc = np.full(epochs, ARC[0])
    ranges = raim_cases.made(arc, "GGGGGG", seed=6, sat_ecef_m=sat, sigma_m=np.full(6, 1.0))
    limits = RaimLimits(noise_risk=0.05)
    got, model = raim_cases.solved(ranges, arc)
    level = reliability(model, limits=limits)
    beyond = int((np.abs(got.arc_m - arc) > level.noise_level_m).sum())
    low, high = binom.interval(0.9999, epochs, 0.05)
    assert low <= beyond <= high
    assert level.noise_level_m[0] == pytest.approx(1.959964 * got.sigma_m[0], rel=1e-6)

    exact = raim_cases.made(ARC, "GGGGGG", seed=6, sat_ecef_m=sat[:1], sigma_m=np.full(6, 1.0), noise=0.0)
    space = point_model(exact, raim_cases.LINE.at_arc(ARC))
    level = reliability(space, limits=limits)
    draws = np.random.default_rng(8).normal(size=(epochs, 6))
    beyond = int((np.linalg.norm(draws @ space.gain_m[0], axis=1) > level.noise_level_m[0]).sum())
    assert 0 < beyond <= high
    assert (reliability(space, limits=RaimLimits(noise_risk=1.0)).noise_level_m == 0).all()


@pytest.mark.parametrize(
    ("channels", "level", "available"),
    [
        # GGGG EE C: what is used -> fault level finite, one fault; available
        ([0, 1, 2, 3, 4, 5], "finite", True),
        ([0, 1, 2, 3, 6], "finite", True),  # the lone C determines its clock and moves nothing
        ([0, 1], "infinite", False),  # a position, no redundancy
        ([0, 4], "nan", False),  # no position: every range is a clock
        ([], "nan", False),
    ],
)
def test_availability(channels, level, available):
    ranges = raim_cases.only(raim_cases.made(ARC, "GGGGEEC", seed=3), channels)
    got = reliability(linear_model(ranges, raim_cases.LINE, ARC), limits=RaimLimits(alarm_limit_m=1e5))
    value = got.protection_level_m[0]
    assert {"finite": np.isfinite(value), "infinite": np.isposinf(value), "nan": np.isnan(value)}[level]
    assert bool(got.available[0]) is available
    assert bool(got.alarm[0]) is not available
    unused = np.setdiff1d(np.arange(7), channels)
    assert np.isnan(got.slope_m[0, unused]).all()
    assert np.isnan(got.minimal_detectable_bias_m[0, unused]).all()
    assert got.worst[0] in [*channels, -1]


def test_lone_satellite_of_a_clock():
    got = reliability(
        linear_model(raim_cases.only(raim_cases.made(ARC, "GGGGEEC", seed=3), [0, 1, 2, 3, 6]), raim_cases.LINE, ARC)
    )
    assert np.isposinf(got.minimal_detectable_bias_m[0, 6])
    assert got.slope_m[0, 6] == 0.0
    # Known clock: the satellite is checked, and counts.
    tied = raim_cases.only(raim_cases.made(ARC, "GGGGEEC", seed=3, tie_sigma_m=(0.0, 1.0, 1.0)), [0, 1, 2, 3, 6])
    got = reliability(linear_model(tied, raim_cases.LINE, ARC))
    assert np.isfinite(got.minimal_detectable_bias_m[0, 6])
    assert got.slope_m[0, 6] > 0.0


def test_pair_that_hides_a_fault():
    """Two satellites in error in the proportion that another place or clock would show."""
    ranges = raim_cases.made(ARC, "GGG", seed=3)
    one, two = (
        reliability(linear_model(ranges, raim_cases.LINE, ARC), limits=RaimLimits(faults=k, alarm_limit_m=1e6))
        for k in (1, 2)
    )
    assert one.available[0]
    assert np.isposinf(two.protection_level_m[0])  # one degree of freedom cannot see two
    assert two.alarm[0]
    # The two satellites of a clock of their own hide a common error, which moves nothing.
    ranges = raim_cases.made(ARC, "GGGGGGEE", seed=3)
    two = reliability(linear_model(ranges, raim_cases.LINE, ARC), limits=RaimLimits(faults=2))
    assert two.available[0]


def test_alarm_truth_table():
    model = linear_model(raim_cases.made(ARC, "GGGGGG", seed=3), raim_cases.LINE, ARC)
    level = float(reliability(model).protection_level_m[0])
    for limit, alarm in ((level, False), (np.nextafter(level, 0.0), True), (level / 2, True), (2 * level, False)):
        assert bool(reliability(model, limits=RaimLimits(alarm_limit_m=limit)).alarm[0]) is alarm


def test_scale_multiplies_what_the_noise_does():
    model = linear_model(raim_cases.made(ARC, "GGGGGEE", seed=3), raim_cases.LINE, ARC)
    one, three = reliability(model), reliability(model, scale=3.0)
    for name in ("minimal_detectable_bias_m", "slope_m", "fault_level_m"):
        assert getattr(three, name) == pytest.approx(3.0 * getattr(one, name), rel=1e-9)
    assert one.position_sigma_m[0] < three.position_sigma_m[0] < 3.0 * one.position_sigma_m[0]


def test_all_epochs_at_once_is_epoch_by_epoch_in_any_order_of_satellites():
    arc = np.linspace(100.0, 1900.0, 60)
    ranges = raim_cases.made(arc, "GGGGGEEEECC", seed=5)
    rng, weight = np.random.default_rng(4), ranges.weight.copy()
    for t in range(60):
        weight[t, rng.choice(11, t % 10, replace=False)] = 0.0
    weight.flags.writeable = False
    ranges = replace(ranges, weight=weight)
    order = np.r_[rng.permutation(5), 5 + rng.permutation(4), 10, 9]
    shuffled = replace(
        ranges, sat_ecef_m=ranges.sat_ecef_m[:, order], code_m=ranges.code_m[:, order], weight=weight[:, order]
    )
    limits = RaimLimits(faults=2)
    models = [linear_model(r, raim_cases.LINE, arc) for r in (ranges, shuffled)]
    whole, other = (reliability(m, limits=limits) for m in models)
    rows = [reliability(models[0].take(np.array([t])), limits=limits) for t in range(60)]
    for item in fields(whole):
        value = getattr(whole, item.name)
        alone = np.concatenate([getattr(r, item.name) for r in rows])
        assert alone == pytest.approx(value, rel=1e-6, nan_ok=True), item.name
        if item.name != "worst":
            turned = value[:, order] if value.ndim == 2 else value
            assert getattr(other, item.name) == pytest.approx(turned, rel=1e-5, nan_ok=True), item.name
    assert len(reliability(models[0].take(np.zeros(60, dtype=bool)), limits=limits).alarm) == 0
