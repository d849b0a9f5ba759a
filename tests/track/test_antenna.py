"""The trajectory: arc length, axes, kilometrage, nearest point."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.track import Track
from railfix.track.trajectory import TRACK_AS_PATH, Trajectory, project_on_segments

ORIGIN = (35.0, 139.0, 50.0)


def ecef(enu_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of a local plane as ECEF, exactly."""
    return ecef_from_geodetic(*ORIGIN) + np.asarray(enu_m, dtype=np.float64) @ enu_axes(*ORIGIN[:2])


def trajectory(enu_m: object, **attributes: object) -> Trajectory:
    return Trajectory.from_antenna_path(Track.from_ecef(ecef(np.array(enu_m, dtype=np.float64)), **attributes))  # type: ignore[arg-type]


@pytest.mark.requirement("A2")
def test_track_taken_as_the_antennas_path_says_so() -> None:
    line = trajectory([[0, 0, 0], [0, 100, 0], [50, 100, 0]])
    assert TRACK_AS_PATH in line.notes
    np.testing.assert_allclose(line.arc_m, [0.0, 100.0, 150.0], atol=1e-6)
    np.testing.assert_allclose(line.chainage_m, line.arc_m, atol=1e-6)
    assert (line.sigma_plan_m, line.sigma_height_m) == (0.30, 0.60)


def test_axes_of_a_line_to_the_north() -> None:
    line = trajectory([[0, 0, 0], [0, 10, 0.1]])
    axes = enu_axes(*ORIGIN[:2])
    np.testing.assert_allclose(line.up[0], axes[2], atol=1e-5)
    np.testing.assert_allclose(line.across[0], axes[0], atol=1e-5)  # right of north is east
    np.testing.assert_allclose(line.heading_deg, 0.0, atol=1e-3)
    np.testing.assert_allclose(line.gradient_permille, 10.0, atol=1e-3)
    np.testing.assert_allclose(np.sum(line.across * line.up, axis=1), 0.0, atol=1e-12)


def test_positions_along_the_line() -> None:
    line = trajectory([[0, 0, 0], [0, 100, 0], [50, 100, 0]])
    arc = np.array([[0.0, 30.0], [line.arc_m[1], 125.0]])
    np.testing.assert_allclose(line.at_arc(arc)[1, 1], ecef(np.array([[25.0, 100.0, 0.0]]))[0], atol=1e-6)
    index, along = line.segment_at(arc)
    np.testing.assert_array_equal(index, [[0, 0], [1, 1]])
    np.testing.assert_allclose(along, [[0.0, 30.0], [0.0, 25.0]], atol=1e-6)
    np.testing.assert_allclose(line.arc_at_chainage(line.chainage_at(arc)), arc, atol=1e-6)
    np.testing.assert_array_equal(line.at_arc(line.arc_m), line.ecef_m)


def test_beyond_the_ends_and_nan_there_is_no_place() -> None:
    line = trajectory([[0, 0, 0], [0, 100, 0]])
    arc = np.array([-1.0, 101.0, np.nan])
    assert np.isnan(line.at_arc(arc)).all()
    assert np.isnan(line.chainage_at(arc)).all()
    assert np.isnan(line.arc_at_chainage(arc)).all()
    found, offset = line.nearest(np.array([[np.nan, 0.0, 0.0]]))
    assert np.isnan(found).all()
    assert np.isnan(offset).all()


def _brute(line: Trajectory, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    share, offset = project_on_segments(points[:, None], line.ecef_m[:-1], np.diff(line.ecef_m, axis=0))
    best = np.argmin(offset, axis=1)
    rows = np.arange(len(points))
    return line.arc_m[best] + share[rows, best] * line.length_m[best], offset[rows, best]


@settings(deadline=None, max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    points=st.integers(2, 60),
    spread=st.sampled_from([0.5, 20.0, 3000.0]),
    mix=st.sampled_from([0.0, 1.0, 3.0]),
)
def test_nearest_is_the_exhaustive_search(seed: int, points: int, spread: float, mix: float) -> None:
    random = np.random.default_rng(seed)
    # at most 24 km in all: a line goes no deeper than 100 km below the ground
    steps = random.normal(size=(points, 3)) * np.exp(mix * np.minimum(random.normal(size=(points, 1)), 2.0))
    line = trajectory(np.cumsum(steps, axis=0))
    asked = line.ecef_m[random.integers(0, points, 40)] + spread * random.normal(size=(40, 3))
    arc, offset = line.nearest(asked)
    expected_arc, expected_offset = _brute(line, asked)
    np.testing.assert_allclose(offset, expected_offset, rtol=1e-12, atol=1e-7)
    np.testing.assert_allclose(line.at_arc(arc), line.at_arc(expected_arc), atol=1e-3)


@pytest.mark.parametrize("chainage", [[0.0, 1.0, 1.0], [0.0, 2.0, 1.0]])
def test_chainage_that_does_not_rise_is_refused(chainage: list[float]) -> None:
    points = ecef(np.array([[0, 0, 0], [0, 1, 0], [0, 2, 0]]))
    zero = np.zeros(3)
    with pytest.raises(ValueError, match="rise strictly"):
        Trajectory(
            name="x", ecef_m=points, chainage_m=np.array(chainage), kilometrage_m=zero, cant_m=zero, roll_deg=zero
        )


@pytest.mark.requirement("A1")
def test_kilometrage_is_not_interpolated_over_a_jump() -> None:
    north = np.array([0.0, 100.0, 200.0, 300.0, 400.0])
    line = trajectory(
        np.stack([0 * north, north, 0 * north], axis=1), kilometrage_m=[1000.0, 1100.0, 5000.0, 4900.0, 4800.0]
    )
    np.testing.assert_allclose(
        line.kilometrage_at(np.array([50.0, 140.0, 160.0, 250.0])), [1050.0, 1140.0, 5040.0, 4950.0], atol=1e-3
    )
