"""Two-way ranges with echoes, and the formulas of P2's millimetre wave."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.core.constants import SPEED_OF_LIGHT
from railfix.motion.samples import radar_speed_mps, two_way_range_m
from railfix.pipeline.along_track import _gated_ranges
from railfix.pipeline.config import Config
from railfix.pipeline.filter_result import FilterFix, FilterState
from railfix.track.track import Track
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line, RangeEpochs


@pytest.mark.requirement("E4")
def test_equation_1_by_hand() -> None:
    """100 m out and back take 667.128 ns beside an answer of 5 us."""
    delay = np.array([5e-6 + 200.0 / SPEED_OF_LIGHT])
    assert two_way_range_m(delay, 5e-6)[0] == pytest.approx(100.0, abs=1e-6)


@pytest.mark.requirement("E4")
def test_radar_gives_111_hz_a_km_per_hour_ahead_and_79_at_45_degrees() -> None:
    kmh = 1.0 / 3.6
    assert radar_speed_mps(np.array([111.2]), 60e9, 0.0)[0] == pytest.approx(kmh, rel=2e-3)
    assert radar_speed_mps(np.array([78.6]), 60e9, np.pi / 4)[0] == pytest.approx(kmh, rel=2e-3)
    off = radar_speed_mps(np.array([1.0]), 60e9, np.pi / 4 + np.radians(1.0))
    assert off[0] / radar_speed_mps(np.array([1.0]), 60e9, np.pi / 4)[0] - 1.0 == pytest.approx(0.0175, abs=5e-4)


@pytest.mark.requirement("E4")
def test_way_by_the_radar_is_free_of_a_periodic_pitch() -> None:
    t = np.arange(0.0, 20.0, 0.01)
    pitch = 0.02 * np.sin(2.0 * np.pi * t)
    shift = 2.0 * 60e9 * 20.0 * np.cos(np.pi / 4 + pitch) / SPEED_OF_LIGHT
    measured = radar_speed_mps(shift, 60e9, np.pi / 4)
    assert np.trapezoid(measured, t)[()] == pytest.approx(np.trapezoid(np.full(len(t), 20.0), t), rel=3e-4)
    assert np.abs(measured / 20.0 - 1.0).max() > 0.015


def gated(measured_m: np.ndarray, unit_arc_m: np.ndarray, *, place_m: float, sigma_m: float) -> np.ndarray:
    """Which ranges to units 3 m beside a straight line the filter keeps, whose place is `place_m` to 1 cm."""
    ecef = np.array([6.378e6, 0.0, 0.0]) + np.array([[0.0, 0.0, 0.0], [0.0, 400.0, 0.0]])
    line = Line(Trajectory.from_antenna_path(Track.from_ecef(ecef)))
    point, axes = line.at(unit_arc_m)
    time = np.array(["2024-03-05T00:00:00"], dtype="datetime64[ns]")
    ranges = RangeEpochs(
        range_m=measured_m[None], sigma_m=np.full((1, len(measured_m)), sigma_m), age_s=np.zeros((1, len(measured_m))),
        unit_ecef_m=(point + 3.0 * axes[:, 1])[None], lever_m=np.zeros(3),
    )  # fmt: skip
    state = FilterState(anchor=FilterFix(time=time[0], arc_m=place_m, sigma_m=0.01, speed_mps=11.0))
    return np.isfinite(_gated_ranges(ranges, time, line, state, Config()).range_m[0])


@pytest.mark.requirement("E4")
@pytest.mark.parametrize("sigma", [0.19, 0.24])
def test_15_000_ranges_with_echoes(sigma: float) -> None:
    random = np.random.default_rng(7)
    unit = random.uniform(100.0, 300.0, 15_000)
    noise = sigma * random.normal(size=len(unit))
    echo = random.uniform(size=len(unit)) < 0.03
    error = noise + np.where(echo, random.uniform(1.5, 15.0, len(unit)), 0.0)
    accepted = gated(np.hypot(unit - 200.0, 3.0) + error, unit, place_m=200.0, sigma_m=sigma)
    good = np.abs(error) <= 0.3 + 3.0 * sigma
    assert (accepted & good).sum() / accepted.sum() >= 0.999
    assert (~accepted & ~echo).sum() / (~echo).sum() < 0.01


@pytest.mark.requirement("E4")
def test_beside_a_wall_no_echo_is_taken() -> None:
    unit = np.full(50, 260.0)
    direct = np.hypot(unit - 200.0, 3.0)
    assert gated(direct, unit, place_m=200.0, sigma_m=0.24).all()
    assert not gated(direct + 4.0, unit, place_m=200.0, sigma_m=0.24).any()


@pytest.mark.requirement("E4")
@pytest.mark.parametrize(("sigma", "early_m", "late_m"), [(0.24, 0.72, 0.72), (0.1, 0.3, 0.6)])
def test_the_gate_is_three_sigma_wide_on_both_sides_and_never_narrower_than_echoes_are_late(
    sigma: float, early_m: float, late_m: float
) -> None:
    """P2 3.3: no echo comes early, so that the early side has no such least width."""
    unit = np.full(4, 260.0)
    direct = np.hypot(unit - 200.0, 3.0)
    error = np.array([0.02 - early_m, -0.02 - early_m, late_m - 0.02, late_m + 0.02])
    assert gated(direct + error, unit, place_m=200.0, sigma_m=sigma).tolist() == [True, False, True, False]
