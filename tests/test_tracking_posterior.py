"""Probability of branches within the error of the map against how often they are right."""

from __future__ import annotations

import numpy as np
import pytest

from posterior_score import bounds
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.track import Track
from railfix.track.trajectory import Trajectory
from railfix.tracking import TrackingLimits, TrackState, track
from railfix.tracking.branches import judged
from tracking_cases import LATITUDE, LONGITUDE, part, ride

LAP_M = 800.0


def _laps(apart_m: float) -> Trajectory:
    """Three laps of one ring, each so much further out."""
    radius = LAP_M / (2.0 * np.pi)
    angle = np.arange(0.0, 6.0 * np.pi, 8.0 / radius)
    distance = radius + apart_m * angle / (2.0 * np.pi)
    axes = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))
    origin = ecef_from_geodetic(LATITUDE, LONGITUDE, 40.0)
    points = origin + (distance * np.cos(angle))[:, None] * axes[0] + (distance * np.sin(angle))[:, None] * axes[1]
    return Trajectory.from_track(Track.from_ecef(points))


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
        epochs = part(case.epochs, slice(0, 40))
        epochs = type(epochs)(
            **{
                **{name: getattr(epochs, name) for name in epochs.__dataclass_fields__},
                "code_m": epochs.code_m - (sight * shift[:, None]).sum(axis=2),
            }
        )
        found, _ = track(epochs, case.line)
        stated.append(float(found.probability[-1]))
        right.append(bool(abs(found.arc_m[-1] - case.arc_m[-1]) < 0.25 * LAP_M))
    stated_of, right_of = np.array(stated), np.array(right)
    low, high = bounds(int(right_of.sum()), len(right_of), risk=1e-3)
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


@pytest.mark.requirement("E5")
def test_evidence_within_the_error_of_the_map_saturates() -> None:
    limits = TrackingLimits()
    place = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [300.0, 0.0, 0.0]])
    probability = np.log(np.full(3, 1.0 / 3.0))
    for _ in range(200):
        probability = judged(probability, np.array([0.0, -2.0, -2.0]), place, limits)
    assert probability[1] - probability[0] == pytest.approx(-0.25)
    assert probability[2] - probability[0] < -300.0
    apart = np.array([0.0, -9.0, 0.0])
    assert judged(apart, np.array([0.0, -2.0, 0.0]), place, limits)[1] == pytest.approx(-9.0)
