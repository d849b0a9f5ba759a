"""Two-way ranges with echoes, and the formulas of P2's millimetre wave."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.core.constants import SPEED_OF_LIGHT
from railfix.motion.ranging import (
    along_m,
    along_sigma_m,
    radar_speed_mps,
    reject_echoes,
    two_way_range_m,
)


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
    measured = 20.0 * np.cos(np.pi / 4 + pitch) / np.cos(np.pi / 4)
    assert np.trapezoid(measured, t)[()] == pytest.approx(np.trapezoid(np.full(len(t), 20.0), t), rel=3e-4)
    assert np.abs(measured / 20.0 - 1.0).max() > 0.015


@pytest.mark.requirement("E4")
def test_distance_along_the_track_and_its_sigma() -> None:
    ranges = np.array([50.0, 5.0, 3.0])
    along = along_m(ranges, 3.0, 4.0)
    np.testing.assert_allclose(along[:2], [np.sqrt(2500.0 - 25.0), 0.0])
    assert np.isnan(along[2])
    assert along_sigma_m(ranges[:1], along[:1], 0.2)[0] == pytest.approx(0.2 * 50.0 / along[0])
    assert np.isinf(along_sigma_m(ranges[1:2], along[1:2], 0.2)[0])


@pytest.mark.requirement("E4")
@pytest.mark.parametrize("sigma", [0.19, 0.24])
def test_15_000_ranges_with_echoes(sigma: float) -> None:
    random = np.random.default_rng(7)
    right = wrong = rejected_direct = direct = 0
    for _ in range(100):
        t = np.arange(150) * 0.2
        predicted = np.abs(100.0 - 11.0 * t) + 0.02 * t
        noise = sigma * random.normal(size=len(t))
        echo = random.uniform(size=len(t)) < 0.03
        measured = predicted + 3.2 + noise + np.where(echo, random.uniform(1.5, 15.0, len(t)), 0.0)
        found = reject_echoes(measured, predicted, np.full(len(t), 11.0))
        judged = np.isfinite(found.residual_m)
        error = measured - predicted - 3.2
        good = np.abs(error) <= 0.3 + 3.0 * sigma
        right += int((found.accepted & good).sum())
        wrong += int((found.accepted & ~good).sum())
        direct += int((judged & ~echo).sum())
        rejected_direct += int((judged & ~echo & ~found.accepted).sum())
    assert right + wrong > 14_000 * 0.9
    assert right / (right + wrong) >= 0.999
    assert rejected_direct / direct < 0.01


@pytest.mark.requirement("E4")
def test_standing_beside_a_wall_nothing_is_acquired() -> None:
    measured = np.full(50, 60.0 + 4.0)
    found = reject_echoes(measured, np.full(50, 60.0), np.zeros(50))
    assert not found.accepted.any()
