"""Probability of branches within the error of the map against how often they are right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binomtest

from plain_kernels import given, kernel_state, plain
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.constants import BRANCH_FLOOR, CODE_COMMON_M, MAP_BRANCH_M
from railfix.track import Track
from railfix.track.trajectory import Trajectory
from railfix.tracking import TrackingLimits, TrackState, track
from tracking_cases import LATITUDE, LONGITUDE, corner_line, part, ride

LAP_M = 800.0


def _laps(apart_m: float) -> Trajectory:
    """Three laps of one ring, each so much further out."""
    radius = LAP_M / (2.0 * np.pi)
    angle = np.arange(0.0, 6.0 * np.pi, 8.0 / radius)
    distance = radius + apart_m * angle / (2.0 * np.pi)
    axes = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))
    origin = ecef_from_geodetic(LATITUDE, LONGITUDE, 40.0)
    points = origin + (distance * np.cos(angle))[:, None] * axes[0] + (distance * np.sin(angle))[:, None] * axes[1]
    return Trajectory.from_antenna_path(Track.from_ecef(points))


@pytest.mark.requirement("E5")
def test_laps_within_the_error_of_the_map_are_not_told_apart_with_certainty() -> None:
    """The map is wrong across by up to 1 m: laps 1 m apart; the satellites see the vehicle beside its line."""
    line, random = _laps(1.0), np.random.default_rng(5)
    stated, right = [], []
    for seed in range(18):
        start = float(random.uniform(50.0, 3.0 * LAP_M - 250.0))
        case = ride(40, trajectory=line, start_m=start, noise=1.0, code_sigma_m=1.0, seed=seed)
        # The vehicle runs beside the line that the map shows: its error of a metre, the same all the time.
        _, axes = case.line.at(case.arc_m)
        shift = random.normal() * axes[:, 1]
        sight = case.epochs.sat_ecef_m - np.asarray(case.line.at(case.arc_m)[0])[:, None]
        sight /= np.linalg.norm(sight, axis=2, keepdims=True)
        code = case.epochs.code_m - (sight * shift[:, None]).sum(axis=2)
        found, _ = track(replace(case.epochs, code_m=code), case.line)
        stated.append(float(found.probability[-1]))
        right.append(bool(abs(found.arc_m[-1] - case.arc_m[-1]) < 0.25 * LAP_M))
    stated_of, right_of = np.array(stated), np.array(right)
    low, high = binomtest(int(right_of.sum()), len(right_of)).proportion_ci(0.999, method="exact")
    assert low <= stated_of.mean() <= high
    sure = stated_of > 0.99
    assert not (sure & ~right_of).any()


@pytest.mark.requirement("E5")
def test_every_lap_is_a_hypothesis_at_the_start() -> None:
    line = _laps(1.0)
    for start in (433.0, 1000.0, 1777.0):
        case = ride(3, trajectory=line, start_m=start, noise=0.0, code_sigma_m=0.3)
        _, state = track(part(case.epochs, slice(0, 1)), case.line)
        assert isinstance(state, TrackState)
        laps = np.round((state.mean[:, 0] - case.arc_m[0]) / LAP_M, 1)
        assert any(abs(lap) < 0.05 for lap in laps), start
        assert len(state.mean) == 3


@pytest.mark.requirement("C6")
def test_a_wrong_position_on_the_right_lap_does_not_decide_for_the_other_lap() -> None:
    """A code 16 m short puts the filter 10 m back; the right position, on both laps, is improbable until a bend."""
    line, steady = corner_line(4700.0, turn_m=30.0), lambda t: np.full(len(t), 10.0)
    case = ride(45, trajectory=line, start_m=2750.0, noise=1.0, speed_mps=steady)
    code = case.epochs.code_m - 16.0 * (case.epochs.satellite == "G04")
    code[20:] = np.nan
    code[:, [2, 6, 7, 8, 9]] = np.nan
    epochs, both = replace(case.epochs, code_m=code), [ix.ARC, ix.PREVIOUS_ARC]
    _, state = track(part(epochs, slice(0, 20)), case.line)
    lap = [int(np.argmin(np.abs(state.mean[:, ix.ARC] - case.arc_m[19])))] * 3
    back = case.arc_m[19] - state.mean[lap[0], ix.ARC]
    assert back == pytest.approx(10.0, abs=1.0)
    state.mean, state.covariance, state.hypothesis = state.mean[lap], state.covariance[lap], state.hypothesis[lap]
    state.mean[:, both] += np.array([[0.0], [back], [back - 2400.0]])
    state.covariance[1:, np.ix_(both, both)[0], both] += 10.0**2
    state.hypothesis["log_probability"] = np.log([0.8, 0.1, 0.1])
    found, _ = track(part(epochs, slice(20, 45)), case.line, state)
    assert (found.probability[-10:] < 0.6).all()


PLACES = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [18.0, 0.0, 0.0], [300.0, 0.0, 0.0]])


def judged(
    log_probability: np.ndarray, log_code: np.ndarray, motion: np.ndarray, code: np.ndarray, places: np.ndarray,
    branch_s: float, branch_m: float, dt: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Probabilities after an epoch's evidence for branches at places, and the part of them by codes."""
    limits = TrackingLimits()
    state = kernel_state(
        np.zeros(len(places)), np.ones(len(places)), log_probability, limits, branch_s=branch_s, branch_m=branch_m
    )
    state.hypothesis["log_code"] = log_code
    arc = np.zeros(len(places))
    parameters = given(limits).parameters[0]
    plain("tracking.hypotheses").reweigh(parameters, state, motion, code, places, arc, dt)
    return state.hypothesis["log_probability"], state.hypothesis["log_code"]


def _after(seconds_: int, motion: float, code: float, *, speed_mps: float = 10.0) -> np.ndarray:
    """Logarithms of the odds of four branches after so many seconds of the same evidence against all but the first."""
    probability, of_code = np.log(np.full(4, 0.25)), np.zeros(4)
    against = np.array([0.0, 1.0, 1.0, 1.0])
    for k in range(seconds_):
        probability, of_code = judged(
            probability, of_code, motion * against, code * against, PLACES, float(k), k * speed_mps
        )
    return np.asarray(probability - probability[0])


@pytest.mark.requirement("C6")
def test_evidence_within_the_error_of_the_map_saturates() -> None:
    odds = _after(200, -2.0, 0.0)
    assert odds[1] == pytest.approx(-2.25 / MAP_BRANCH_M**2)
    assert odds[3] < -300.0


@pytest.mark.requirement("C6")
def test_codes_alone_leave_a_near_branch_its_floor_and_decide_against_a_far_one() -> None:
    odds = _after(900, 0.0, -2.0)
    assert odds[2] == pytest.approx(np.log(BRANCH_FLOOR))
    assert odds[3] < -100.0
    # one independent epoch: d^2 / (2 code_common_m^2)
    first = _after(1, 0.0, -1e3)
    assert first[2] == pytest.approx(-(18.0**2) / (2.0 * CODE_COMMON_M**2))


@pytest.mark.requirement("C6")
def test_motion_decides_by_the_distance_travelled_and_a_burst_of_it_counts_little() -> None:
    assert _after(900, -2.0, 0.0, speed_mps=0.0)[3] == 0.0
    assert _after(2, -1e3, 0.0, speed_mps=100.0)[3] == pytest.approx(-5.0, abs=0.01)
    assert _after(60, -2.0, 0.0)[2] < -15.0


@pytest.mark.requirement("C6")
@pytest.mark.parametrize("motion", [-2.0, -1e3])
def test_evidence_of_motion_counts_once_a_second_at_any_rate_and_a_long_epoch_once(motion: float) -> None:
    near, far = np.zeros(2), np.array([[0.0, 0.0, 0.0], [300.0, 0.0, 0.0]])

    def odds(epochs: int, dt: float) -> float:
        probability = code = near
        for _ in range(epochs):
            probability, code = judged(probability, code, np.array([0.0, motion]), near, far, 60.0, 600.0, dt)
        return float(probability[1] - probability[0])

    assert odds(1, 1.0) == pytest.approx(max(motion, -5.0), abs=0.01)
    assert odds(10, 0.1) == pytest.approx(odds(1, 1.0), abs=0.01)
    assert odds(1, 5.0) == pytest.approx(odds(1, 1.0), abs=0.01)


@pytest.mark.requirement("C6")
@pytest.mark.parametrize(
    ("apart_m", "along_m", "goes"),
    [(5.0, 350.0, 1), (5.0, -61.0, 1), (5.0, 5.0, 0), (8.9, 350.0, 1), (9.1, 350.0, 0), (18.0, 350.0, 0)],
)
def test_of_laps_within_the_error_of_the_map_codes_of_the_last_half_minute_choose(
    apart_m: float, along_m: float, goes: int
) -> None:
    """The choice is no evidence: probabilities are those without it, and what codes said is forgotten."""
    limits, branches = TrackingLimits(), plain("tracking.hypotheses")
    state = kernel_state([0.0, along_m], np.ones(2), np.log([0.6, 0.4]), limits, branch_s=60.0, branch_m=600.0)
    points, one = np.array([[0.0, 0.0, 0.0], [apart_m, 0.0, 0.0]]), state.hypothesis
    parameters = given(limits).parameters[0]

    def step(code: float) -> None:
        one["log_probability"], one["log_code"] = np.log([0.6, 0.4]), 0.0
        branches.reweigh(parameters, state, np.zeros(2), np.array([0.0, code]), points, state.x[:, 0], 1.0)

    def after(seconds_: int, code: float) -> int:
        for _ in range(seconds_):
            before = one["log_recent"].copy()
            step(code)
            assert (np.abs(one["log_recent"]) <= 3.0).all()
            if not code:
                np.testing.assert_allclose(one["log_recent"], before * np.exp(-1.0 / 30.0))
        return int(branches.find_leading(one, 2))

    assert after(1, 0.5) == 0
    assert after(60, 0.5) == goes
    bare, _ = judged(np.log([0.6, 0.4]), np.zeros(2), np.zeros(2), np.zeros(2), points, 60.0, 600.0)
    step(0.0)
    np.testing.assert_allclose(one["log_probability"], bare)
    assert after(200, 0.0) == 0


@pytest.mark.requirement("C6")
def test_what_codes_said_of_a_branch_far_away_does_not_hold_once_it_is_near() -> None:
    probability, code = np.array([0.0, -60.0]), np.array([0.0, -60.0])
    near = np.array([[0.0, 0.0, 0.0], [18.0, 0.0, 0.0]])
    after, _ = judged(probability, code, np.zeros(2), np.zeros(2), near, 60.0, 600.0)
    assert after[1] - after[0] == pytest.approx(np.log(BRANCH_FLOOR))
