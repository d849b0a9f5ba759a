"""Speeds and distances from the instants of pulses, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.core.timescale import seconds, timedelta
from railfix.motion.samples import TachometerPulses
from railfix.motion.tachometer import TachometerLimits, check_speeds, pulse_acceleration, pulse_speeds, tooth_faults

START = np.datetime64("2026-03-01T06:00:00", "ns")
LIMITS = TachometerLimits()


def _pulses(instants_s: np.ndarray, direction: int = 1) -> TachometerPulses:
    return TachometerPulses(
        time=START + timedelta(instants_s),
        pulse=np.arange(1, len(instants_s) + 1),
        direction=np.full(len(instants_s), direction),
    )


def _even(v0: float, a: float, distance: float) -> np.ndarray:
    """Instants of the pulses of an even acceleration: root of v0 t + a t^2 / 2 = n p."""
    s = np.arange(1, int(distance / LIMITS.pulse_m)) * LIMITS.pulse_m
    return s / v0 if a == 0 else (np.sqrt(v0**2 + 2.0 * a * s) - v0) / a


def _at(values: list[float]) -> np.ndarray:
    return START + timedelta(np.array(values))


@pytest.mark.requirement("E2")
@pytest.mark.parametrize("a", [0.0, 0.5, -0.7])
def test_even_acceleration_gives_the_speed_at_the_returned_instant(a: float) -> None:
    pulses = _pulses(_even(10.0, a, 60.0))
    found = pulse_speeds(pulses, _at([1.0, 2.5, 4.0]), limits=LIMITS)
    np.testing.assert_allclose(found.speed_mps, 10.0 + a * seconds(found.time - START), atol=1e-6)
    later = pulse_speeds(pulses, _at([1.5, 3.0, 4.5]), limits=LIMITS)
    np.testing.assert_allclose(pulse_acceleration(found, later), a, atol=1e-5)


@pytest.mark.requirement("E2")
def test_a_change_of_acceleration_is_seen_within_the_window() -> None:
    """P2 2.2: with a moving average of counts the acceleration right after a notch is wrong."""
    s = np.arange(1, 900) * LIMITS.pulse_m
    instants = np.where(s < 20.0, s / 10.0, 2.0 + (np.sqrt(100.0 + 2.0 * 0.9 * np.maximum(s - 20.0, 0)) - 10.0) / 0.9)
    pulses = _pulses(instants)
    early, late = (pulse_speeds(pulses, _at([t]), limits=LIMITS) for t in (2.2, 2.5))
    assert pulse_acceleration(early, late)[0] == pytest.approx(0.9, abs=1e-3)
    count = np.array([np.searchsorted(instants, t) for t in (1.5, 2.5)]) * LIMITS.pulse_m
    before = np.array([np.searchsorted(instants, t) for t in (0.5, 1.5)]) * LIMITS.pulse_m
    averaged = ((count[1] - before[1]) - (count[0] - before[0])) / 1.0
    assert averaged < 0.5


@pytest.mark.requirement("E2")
def test_lost_and_doubled_teeth_are_found() -> None:
    instants = np.arange(60) * 0.005
    lost, _ = tooth_faults(_pulses(np.delete(instants, 30)))
    assert np.flatnonzero(lost).tolist() == [30]
    _, doubled = tooth_faults(_pulses(np.insert(instants, 21, instants[20] + 0.0015)))
    assert 21 in np.flatnonzero(doubled) or 20 in np.flatnonzero(doubled)
    assert not tooth_faults(_pulses(instants))[0].any()
    assert not tooth_faults(_pulses(instants))[1].any()
    uneven = np.cumsum([0.010] * 8 + [0.026] + [0.016] * 8)  # twice the mean of neighbours that differ by 60 %
    assert not tooth_faults(_pulses(uneven))[0].any()


@pytest.mark.requirement("E2")
@pytest.mark.parametrize(("share", "found"), [(0.85, True), (1.15, True), (0.75, False), (1.25, False)])
def test_a_doubled_tooth_is_one_within_a_fifth_of_its_neighbours(share: float, found: bool) -> None:
    """Two intervals, one after the other, that together are as long as the one before and the one after."""
    intervals = np.full(30, 0.005)
    intervals[14:16] = share * 0.005 * np.array([0.3, 0.7])
    assert tooth_faults(_pulses(np.cumsum(intervals)))[1].any() == found


@pytest.mark.requirement("E2")
@pytest.mark.parametrize(("ratio", "found"), [(1.75, True), (2.25, True), (1.65, False), (2.35, False)])
def test_a_lost_tooth_is_one_within_a_third_of_an_interval(ratio: float, found: bool) -> None:
    intervals = np.full(30, 0.005)
    intervals[14] *= ratio
    assert tooth_faults(_pulses(np.cumsum(intervals)))[0].any() == found


@pytest.mark.requirement("E2")
@pytest.mark.parametrize(("factor", "unit"), [(1.0, "m/s"), (3.6, "km/h"), (2.2369, "miles per hour")])
@pytest.mark.parametrize("lag", [0.0, 1.0, -0.8])
def test_units_lags_and_diameters_of_logs_are_found(factor: float, unit: str, lag: float) -> None:
    t = np.arange(0.0, 300.0, 1.0)

    def speed(at: np.ndarray) -> np.ndarray:
        return 12.0 + 6.0 * np.sin(at / 9.0) + 3.0 * np.sin(at / 4.0)

    logged = factor * 1.015 * speed(t - lag) + np.random.default_rng(1).normal(0.0, 0.05, len(t))
    found = check_speeds(START + timedelta(t), logged, START + timedelta(t), speed(t))
    assert found.unit == unit
    assert found.lag_s == pytest.approx(lag, abs=0.11)
    assert found.ratio == pytest.approx(1.015, abs=0.003)
    creeping = 1.5 + 0.3 * np.sin(t / 9.0)  # speeds over 1 m/s count
    assert check_speeds(START + timedelta(t), factor * creeping, START + timedelta(t), creeping).unit == unit
