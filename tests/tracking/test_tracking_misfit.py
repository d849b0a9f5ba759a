"""A map whose lengths are wrong: seen in the codes, said, and followed."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.track import Track
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line, TrackingLimits, track
from tracking_cases import Ride, bent_line, ride


def drawn_in_waves(trajectory: Trajectory, amplitude_m: float, wavelength_m: float) -> Trajectory:
    """The line as a map has it that sways about it: by amplitudes of some metres it is a few per cent too long."""
    arc = np.arange(0.0, trajectory.arc_m[-1], 5.0)
    points, axes = Line(trajectory).at(arc)
    aside = amplitude_m * np.sin(2.0 * np.pi * arc / wavelength_m)
    return Trajectory.from_antenna_path(Track.from_ecef(points + aside[:, None] * axes[:, 1]))


def error_m(found_arc_m: np.ndarray, on: Trajectory, run: Ride) -> np.ndarray:
    error = Line(on).at(found_arc_m)[0] - run.line.at(run.arc_m)[0]
    return np.asarray(np.linalg.norm(error, axis=1))


@pytest.mark.requirement("C2", "E5")
def test_a_map_two_per_cent_too_long_is_found_and_the_codes_are_followed() -> None:
    line = bent_line(5000.0)
    run, drawn = ride(320, trajectory=line, noise=1.0, seed=1), drawn_in_waves(line, 5.0, 100.0)
    assert drawn.arc_m[-1] / line.arc_m[-1] == pytest.approx(1.024, abs=0.001)
    learning, _ = track(run.epochs, Line(drawn))
    trusting, _ = track(run.epochs, Line(drawn), limits=TrackingLimits(map_misfit_sigmas=1e3))
    assert np.percentile(error_m(trusting.arc_m, drawn, run)[60:], 95) > 11.0
    assert np.percentile(error_m(learning.arc_m, drawn, run)[60:], 95) < 8.0
    assert learning.map_scale[-1] > 3.0


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("rate_hz", [1.0, 5.0])
def test_on_a_right_map_nothing_is_learnt(rate_hz: float) -> None:
    run = ride(240, trajectory=bent_line(5000.0), noise=1.0, seed=3, rate_hz=rate_hz)
    found, state = track(run.epochs, run.line)
    assert found.map_scale.max() < 1.1
    mean, variance = state.monitors.code_shift, state.monitors.code_shift_variance
    assert abs(mean) < 3.0 * np.sqrt(variance)


@pytest.mark.requirement("E5")
def test_what_was_learnt_is_forgotten_on_a_right_map() -> None:
    line = bent_line(9000.0, turn_deg=10.0)
    points, axes = Line(line).at(np.arange(0.0, line.arc_m[-1], 5.0))
    arc = np.arange(0.0, line.arc_m[-1], 5.0)
    aside = np.where(arc < 2500.0, 5.0 * np.sin(2.0 * np.pi * arc / 100.0), 0.0)
    drawn = Trajectory.from_antenna_path(Track.from_ecef(points + aside[:, None] * axes[:, 1]))
    run = ride(590, trajectory=line, noise=1.0, seed=4)
    found, _ = track(run.epochs, Line(drawn))
    assert found.map_scale.max() > 3.0
    assert found.map_scale[-1] < 0.6 * found.map_scale.max()
    assert error_m(found.arc_m, drawn, run)[-60:].max() < 4.0
