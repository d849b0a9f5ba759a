"""Slip, slide, low speed and rolling away on motions with known truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railfix.core.constants import GRAVITY_MPS2
from railfix.live.state_values import decode, encode
from railfix.motion.slip import MotionSamples, MotionState, find_slips, heading_rate_radps, pitch_rate_radps
from slip_motion import RATE_HZ, SLIPPING, even_motion, motion

SLIPS = [(70.0 + 40.0 * k, 1.0 + 0.4 * (k % 5), (0.3, -0.3, 0.15, -0.5, 0.8)[k % 5]) for k in range(12)]


@pytest.mark.requirement("E1")
def test_a_body_that_leans_in_a_level_curve_turns_and_does_not_pitch() -> None:
    lean, turn, speed = 0.15, 0.05, np.array([17.0])
    rate = turn * np.array([[0.0, np.sin(lean), np.cos(lean)]])
    force = np.array([[0.0, speed[0] * rate[0, 2] - 9.80665 * np.sin(lean), 0.0]])
    assert heading_rate_radps(force, rate, speed) == pytest.approx(turn, rel=1e-9)
    assert pitch_rate_radps(force, rate, speed) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.requirement("E1")
def test_every_slip_is_found_and_its_way_kept() -> None:
    case = motion(600.0, SLIPS, noise=0.02, pitching=0.002)
    found = case.run()
    slipping = np.isin(found.state, SLIPPING)
    for begin, duration, ratio in SLIPS:
        inside = (case.time_s >= begin) & (case.time_s <= begin + duration + 1.5)
        assert slipping[inside].any(), (begin, duration, ratio)
        error = case.way_error_m(found, begin - 1.0, begin + duration + 3.0)
        assert abs(error) < 0.15, (begin, duration, ratio)


@pytest.mark.requirement("E1")
def test_a_long_slip_is_released_though_the_carried_speed_has_drifted() -> None:
    """8 s of a 5 % slip, in which the accelerometer is off by 0.02 m/s2: 0.16 m/s and more at its end."""
    case = motion(110.0, [(75.0, 8.0, 0.3)])
    slip = (case.time_s > 75.0) & (case.time_s < 83.0)
    case = replace(case, force=case.force + 0.024 * slip)
    slipping = [np.isin(case.run(carry_drift_mps2=drift).state[case.time_s > 85.0], SLIPPING) for drift in (0.01, 0.0)]
    assert not slipping[0].any()
    assert slipping[1].any()


@pytest.mark.requirement("E1")
@pytest.mark.parametrize(("hours", "alarms"), [(0.5, 1), pytest.param(10.0, 10, marks=pytest.mark.slow)])
def test_less_than_one_false_alarm_an_hour(hours: float, alarms: int) -> None:
    slipping = np.isin(motion(3600.0 * hours, [], noise=0.1, pitching=0.004, seed=3).run().state, SLIPPING)
    assert np.count_nonzero(np.diff(slipping.astype(int)) == 1) < alarms


@pytest.mark.requirement("E1")
@pytest.mark.parametrize("permille", [5.0, 20.0])
def test_rolling_away_on_a_gradient_is_found_below_walking_speed(permille: float) -> None:
    t = np.arange(0.0, 12.0, 1.0 / RATE_HZ)
    sine = -permille / 1e3
    free = t > 6.0
    force = np.where(free, 0.0, GRAVITY_MPS2 * sine)
    wheel = np.where(t < 0.5, 0.0, np.nan)
    found, _ = find_slips(MotionSamples(t, wheel, np.zeros(len(t)), force, np.full(len(t), sine)))
    rolling = np.flatnonzero(found.state == MotionState.ROLLING)
    assert (found.state[(t > 0.6) & (t < 1.4)] == MotionState.LOW_SPEED).all()  # it may be moving yet
    assert (found.state[(t > 2.0) & (t < 6.0)] == MotionState.STANDING).all()
    assert len(rolling)
    true = GRAVITY_MPS2 * permille / 1e3 * (t - 6.0)
    assert true[rolling[0]] < 1.0 / 3.6
    np.testing.assert_allclose(found.speed_mps[rolling], true[rolling], atol=0.03)


@pytest.mark.requirement("E1")
@pytest.mark.parametrize("permille", [10.0, -15.0])
def test_a_body_that_comes_to_rest_after_braking_does_not_roll_away(permille: float) -> None:
    """The nose comes up again over a second after the stop: a change of the pitch, and no motion."""
    t = np.arange(0.0, 120.0, 1.0 / RATE_HZ)
    swing = permille / 1e3 * np.exp(-np.maximum(t - 1.0, 0.0) / 0.8)
    wheel, force = np.where(t < 0.7, 1.0 - t, np.nan), np.where(t < 1.0, -1.0, 0.0) + GRAVITY_MPS2 * swing
    found, _ = find_slips(MotionSamples(t, wheel, np.where(t < 0.7, -1.0, np.nan), force, np.zeros(len(t))))
    assert (found.state[t > 3.0] == MotionState.STANDING).all()
    assert found.distance_m[-1] == pytest.approx(found.distance_m[np.searchsorted(t, 1.1)], abs=0.2)


@pytest.mark.requirement("E1")
def test_rolling_without_a_pulse_expires_as_other_carries_do() -> None:
    t = np.arange(0.0, 60.0, 1.0 / RATE_HZ)
    force = np.where(t < 10.0, 0.05, 0.0)
    wheel, unknown = np.where(t < 0.5, 0.0, np.nan), np.full(len(t), np.nan)
    found, state = find_slips(MotionSamples(t, wheel, np.zeros(len(t)), force, unknown))
    assert encode(decode(encode(state))) == encode(state), "a state can be stored"
    rolling = t[found.state == MotionState.ROLLING]
    assert rolling[0] < 12.0
    assert rolling[-1] - rolling[0] == pytest.approx(30.0, abs=0.1)
    assert (found.state[t > rolling[-1] + 0.1] == MotionState.STANDING).all()


@pytest.mark.requirement("E1")
def test_noiseless_pitch_is_that_of_the_line() -> None:
    case = motion(300.0, [])
    found = case.run()
    late = case.time_s > 5.0
    np.testing.assert_allclose(found.metric[late], 0.02 / GRAVITY_MPS2, atol=1e-4)


@pytest.mark.requirement("E1")
@pytest.mark.parametrize("drift_mps2", [0.015, -0.015])
def test_half_of_the_final_gap_of_wheel_and_inertia_is_taken_off_the_distance(drift_mps2: float) -> None:
    """The accelerometer's offset changes as a slip of 10 s begins: carried too far by 0.75 m, and put back."""
    case = even_motion(90.0, 60.0, 10.0, 6.0)
    found = replace(case, force=np.where(case.time_s >= 60.0, drift_mps2, 0.0)).run()
    slips = np.isin(found.state, SLIPPING)
    assert slips[(case.time_s > 61.0) & (case.time_s < 69.0)].all()
    assert not slips[case.time_s > 75.0].any()
    assert abs(case.way_error_m(found, 55.0, 80.0)) < 0.4


@pytest.mark.requirement("E1")
def test_the_bias_of_the_gyro_is_learnt_from_the_line() -> None:
    case, bias = motion(3000.0, []), 2e-4
    found = case.run(gyro_bias_radps=bias)
    assert found.gyro_bias_radps[0] == pytest.approx(0.0, abs=1e-6)
    assert found.gyro_bias_radps[-1] == pytest.approx(bias, rel=0.03)
    np.testing.assert_allclose(found.pitch[-1000:], case.sine[-1000:], atol=2e-4)


@pytest.mark.requirement("E1")
def test_the_bias_of_the_gyro_is_learnt_while_standing_and_nothing_expires() -> None:
    """Two minutes at rest, the gyro 2 mrad/s off, no map; then 0.5 m/s2 for 30 s."""
    t, bias = np.arange(0.0, 150.0, 1.0 / RATE_HZ), 2e-3
    speed = 0.5 * np.maximum(t - 120.0, 0.0)
    wheel = np.where((t > 1.0) & (speed < 0.5), np.nan, speed)
    acceleration = np.where(np.isnan(wheel) | (t < 1.0), 0.0, 0.5)
    body = np.stack([np.zeros(len(t)), np.full(len(t), bias), np.zeros(len(t))], axis=1)
    case = MotionSamples(t, wheel, acceleration, np.where(t < 120.0, 0.0, 0.5), np.full(len(t), np.nan), body)
    found, _ = find_slips(case)
    assert found.gyro_bias_radps[t > 115.0] == pytest.approx(bias, rel=0.05)
    assert not (found.state[t > 2.0] == MotionState.EXPIRED).any()
    assert (found.state[(t > 4.0) & (t < 120.0)] == MotionState.STANDING).all()
    np.testing.assert_allclose(found.speed_mps[t > 125.0], speed[t > 125.0], atol=0.1)


@pytest.mark.requirement("E1")
def test_a_slide_that_ends_at_rest_is_a_standstill() -> None:
    """The wheel locks at 5 m/s, the train stops after 5 s; it stands for a minute."""
    t = np.arange(0.0, 75.0, 1.0 / RATE_HZ)
    speed = np.clip(15.0 - t, 0.0, 5.0)
    wheel = np.where(t < 10.5, np.where(t < 10.0, 5.0, 5.0 - 10.0 * (t - 10.0)), np.nan)
    force = np.where((t >= 10.0) & (t < 15.0), -1.0, 0.0)
    acceleration = np.where(np.isnan(wheel), np.nan, np.where(t < 10.0, 0.0, -10.0))
    found, _ = find_slips(MotionSamples(t, wheel, acceleration, force, np.zeros(len(t))))
    assert (found.state[(t > 10.5) & (t < 14.0)] == MotionState.INERTIAL_SLIDE).all()
    assert (found.state[t > 16.0] == MotionState.STANDING).all()
    true = float(np.trapezoid(speed, t))
    assert found.distance_m[-1] == pytest.approx(true, abs=0.3)


@pytest.mark.requirement("E1")
def test_a_false_acceleration_at_the_first_pulse_leaves_the_speed_that_of_a_train() -> None:
    """4 m/s2 too much in one sample, without a map: no pitch of a train, and no reference for the carry."""
    case = motion(120.0, [(60.0, 4.0, 0.6)])
    acceleration = np.gradient(case.wheel, case.time_s)
    acceleration[0] += 4.0
    body = np.zeros((len(case.time_s), 3))
    found, _ = find_slips(
        MotionSamples(case.time_s, case.wheel, acceleration, case.force, np.full(len(case.time_s), np.nan), body)
    )
    assert np.nanmax(np.abs(found.speed_mps)) < 1.5 * case.speed.max()


@pytest.mark.requirement("E1")
@pytest.mark.parametrize("rule", ["p2", "map"])
@pytest.mark.every(2)
def test_the_bias_of_the_gyro_is_learnt_without_a_line_and_a_slip_is_carried_by_it(rule: str) -> None:
    """P2 2.1(3) and (4): no map; pitch by wheel and accelerometer gives the bias, the corrected gyro carries."""
    case, bias = motion(2000.0, [(1940.0, 8.0, 0.6)]), 5e-4
    found = case.run(gyro_bias_radps=bias, line=False, rule=rule)
    before = case.time_s > 1900.0
    assert found.gyro_bias_radps[before] == pytest.approx(bias, rel=0.1)
    # the accelerometer's offset is in the pitch and leaves the carry again
    offset = 0.02 / GRAVITY_MPS2
    np.testing.assert_allclose(found.pitch[before], case.sine[before] + offset, atol=1e-3)
    if rule == "map":  # P2's own rule lets go at the top of the slip
        wheel = float(np.sum((case.wheel - case.speed)[before]) / RATE_HZ)
        assert wheel > 30.0
        assert abs(case.way_error_m(found, 1935.0, 1955.0)) < 0.5


@pytest.mark.requirement("E1")
@pytest.mark.parametrize(("duration", "excess"), [(1.0, 0.3), (2.0, 0.6), (4.0, 1.0), (4.0, 3.0)])
def test_the_papers_rule_is_blind_where_its_closed_form_says(duration: float, excess: float) -> None:
    """Half a sine of slip accelerates the wheel by ``excess pi / duration cos``: seen beyond 45 permille of gravity."""
    case = even_motion(20.0, 5.0, duration, excess)
    inside = (case.time_s >= 5.0) & (case.time_s <= 5.0 + duration)
    flagged = np.isin(case.run(rule="p2").state, SLIPPING)
    share = min(0.045 * GRAVITY_MPS2 * duration / (np.pi * excess), 1.0)
    # each of the two flanks is confirmed for 0.1 s first
    seen = max(2.0 / np.pi * np.arccos(share) - 0.2 / duration, 0.0)
    assert flagged[inside].mean() == pytest.approx(seen, abs=0.05)
