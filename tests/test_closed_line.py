"""A line that closes on itself: the filter goes round (requirement E5)."""

from __future__ import annotations

import numpy as np
import pytest

import synthetic
from railfix import kernels
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.positioning.constrained import constrained_position
from railfix.positioning.section_search import SearchIndex, SectionLimits, search
from railfix.positioning.single_point import single_point
from railfix.track import Track
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import Vehicle, antenna_trajectory
from railfix.tracking import Line, TrackStatus, track
from tracking_cases import LATITUDE, LONGITUDE, bent_line, ride

RADIUS_M = 400.0
POINTS = 250


def ring(laps: float, *, apart_m: float = 0.0, backward: bool = False) -> Trajectory:
    """A circle, walked so many times; `apart_m` further out after each lap."""
    turn = np.arange(0.0, laps + 1e-9, 1.0 / POINTS)
    angle = 2.0 * np.pi * turn * (-1.0 if backward else 1.0)
    radius = RADIUS_M + apart_m * turn
    axes = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))
    flat = radius[:, None] * (np.sin(angle)[:, None] * axes[0] + np.cos(angle)[:, None] * axes[1])
    return Trajectory.from_track(Track.from_ecef(ecef_from_geodetic(LATITUDE, LONGITUDE, 40.0) + flat))


def test_where_a_line_closes() -> None:
    closed = Line.of(ring(1.0))
    length = closed.arc_m[-1]
    # The end is the start; both lie on the other's vertex, of which no segment ends there.
    assert closed.joins_m == pytest.approx((length, 0.0), abs=1e-3)
    overlapping = Line.of(ring(1.2))
    assert overlapping.joins_m == pytest.approx((length, 0.2 * length), abs=0.5)
    np.testing.assert_allclose(
        overlapping.round_m(np.array([-5.0, 10.0, 1.2 * length + 5.0])), [length, 0.0, -length], atol=0.5
    )


@pytest.mark.parametrize("line", [bent_line(), ring(0.9), ring(1.0, apart_m=4.0)], ids=["bent", "gap", "4 m beside"])
def test_open_lines_do_not_close(line: Trajectory) -> None:
    assert np.isnan(Line.of(line).joins_m).all()
    assert Line.of(line).bounds_m == pytest.approx((0.0, line.arc_m[-1]))


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("kernel", ["numpy", "numba"])
@pytest.mark.parametrize("backward", [False, True], ids=["rising", "falling"])
def test_the_filter_goes_round(kernel: str, backward: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if kernel == "numba":
        pytest.importorskip("numba", reason="railfix[fast] is not installed")
    monkeypatch.setattr(kernels, "CHOSEN", kernel)
    closed, laps = ring(1.0), ring(3.0, backward=backward)
    length = closed.arc_m[-1]
    case = ride(300, trajectory=laps, start_m=100.0, noise=1.0)
    found, _ = track(case.epochs, Line.of(closed))
    true = np.mod(-case.arc_m if backward else case.arc_m, length)
    error = np.mod(found.arc_m - true + 0.5 * length, length) - 0.5 * length
    assert case.arc_m[-1] > 1.5 * length
    assert np.abs(error[30:]).max() < 3.0
    assert ((found.arc_m[30:] > -5.0) & (found.arc_m[30:] < length + 5.0)).all()
    assert (found.status[30:] == TrackStatus.TRACKING).all()


def round_the_ring(found_m: np.ndarray, true_m: np.ndarray, length_m: float) -> np.ndarray:
    """Difference of places the short way round."""
    return np.asarray(np.mod(found_m - true_m + 0.5 * length_m, length_m) - 0.5 * length_m)


@pytest.mark.requirement("C1")
def test_a_vehicle_on_a_ring_has_closed_paths() -> None:
    axes = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS + 1)
    flat = 200.0 * (np.sin(angle)[:, None] * axes[0] + np.cos(angle)[:, None] * axes[1])
    map_of_ring = Track.from_ecef(ecef_from_geodetic(LATITUDE, LONGITUDE, 40.0) + flat)
    vehicle = Vehicle.model_validate(
        {"bogie_distance_m": 13.8, "antennas": {"front": {"along_m": 9.1, "across_m": 0.25, "up_m": 3.95}}}
    )
    path = antenna_trajectory(map_of_ring, vehicle)
    assert np.isfinite(path.joins_m).all()
    assert path.turn_m == pytest.approx(path.arc_m[-1], abs=0.01)
    np.testing.assert_allclose(path.ecef_m[-1], path.ecef_m[0], atol=0.01)
    assert path.body_chainage_m is not None
    np.testing.assert_allclose(path.body_chainage_m[[0, -1]], map_of_ring.chainage_m[[0, -1]], atol=1e-6)


@pytest.mark.requirement("A3")
def test_single_epochs_at_the_join_are_placed_and_have_one_place() -> None:
    """Points of the map 20 m apart, and a start on the other side of the join."""
    angle = np.linspace(0.0, 2.0 * np.pi, POINTS + 1)
    circle = 800.0 * np.stack([np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)
    closed = Trajectory.from_track(Track.from_ecef(synthetic.enu_to_ecef(circle)))
    length = float(closed.arc_m[-1])
    true = np.array([length - 8.0, 8.0, 0.0, 1500.0])
    ranges = synthetic.ranges(closed, true, sigma_m=0.0)
    for start in (0, len(closed) - 1):
        found = constrained_position(ranges.take(np.arange(3)), closed, np.full(3, start))
        np.testing.assert_allclose(round_the_ring(found.arc_m, true[:3], length), 0.0, atol=1e-3)
        np.testing.assert_allclose(found.overshoot_m, 0.0, atol=1e-3)
    noisy = synthetic.ranges(closed, true, sigma_m=5.0)
    point = single_point(noisy, closed.ecef_m[:4])
    assert (search(noisy, SearchIndex(closed), point).excess > SectionLimits().threshold).all()
