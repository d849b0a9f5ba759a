"""Frames and ranges against closed forms and known geometry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod, Transformer

from railfix.core.arrays import read_only
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.core.geodesy import (
    ecef_from_geodetic,
    elevation_azimuth,
    enu_axes,
    geodetic_from_ecef,
    range_with_rotation,
)

A, F = 6_378_137.0, 1 / 298.257_223_563
latitudes, longitudes = st.floats(-90.0, 90.0), st.floats(-180.0, 180.0)
heights = st.floats(-500.0, 1e4)


def test_known_points() -> None:
    points = ecef_from_geodetic([0.0, 0.0, 90.0, -90.0], [0.0, 90.0, 12.0, 0.0], [0.0, 100.0, 0.0, 10.0])
    polar = A * (1 - F)
    expected = [[A, 0, 0], [0, A + 100, 0], [0, 0, polar], [0, 0, -polar - 10]]
    np.testing.assert_allclose(points, expected, atol=1e-9)


@given(latitudes, longitudes, heights)
def test_closed_form_is_proj(latitude: float, longitude: float, height: float) -> None:
    proj = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    expected = proj.transform(longitude, latitude, height)
    np.testing.assert_allclose(ecef_from_geodetic(latitude, longitude, height), expected, atol=2e-9)


@given(latitudes, longitudes, heights)
def test_there_and_back(latitude: float, longitude: float, height: float) -> None:
    ecef = ecef_from_geodetic(latitude, longitude, height)
    again = ecef_from_geodetic(*geodetic_from_ecef(ecef))
    np.testing.assert_allclose(again, ecef, atol=1e-6)
    # PROJ divides by the cosine of the latitude: near a pole its height has lost a micrometre
    assert geodetic_from_ecef(ecef)[2] == pytest.approx(height, abs=1e-5)


def test_shapes_and_absent_points() -> None:
    grid = read_only(ecef_from_geodetic(np.full((2, 3), 35.0), np.full((2, 3), 139.0), np.zeros((2, 3))))
    assert grid.shape == (2, 3, 3)
    with_gap = grid.copy()
    with_gap[1, 2, 0] = np.nan
    latitude, longitude, height = geodetic_from_ecef(read_only(with_gap))
    assert np.isnan(latitude).sum() == np.isnan(longitude).sum() == np.isnan(height).sum() == 1
    assert np.isnan(latitude[1, 2])
    assert latitude[0, 0] == pytest.approx(35.0)


@given(latitudes, longitudes)
def test_axes_are_right_handed_and_orthonormal(latitude: float, longitude: float) -> None:
    axes = enu_axes(latitude, longitude)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(axes) == pytest.approx(1.0)


@given(st.floats(-89.0, 89.0), longitudes)
def test_axes_are_the_derivatives_of_position(latitude: float, longitude: float) -> None:
    step = 1e-4
    place = ecef_from_geodetic(latitude, longitude, 0.0)
    east = ecef_from_geodetic(latitude, longitude + step, 0.0) - place
    north = ecef_from_geodetic(latitude + step, longitude, 0.0) - place
    up = ecef_from_geodetic(latitude, longitude, 10.0) - place
    found = enu_axes(latitude, longitude) @ np.array([east, north, up]).T
    np.testing.assert_allclose(found / np.linalg.norm(found, axis=0), np.eye(3), atol=1e-5)


@pytest.mark.parametrize(
    ("east", "north", "up", "elevation", "azimuth"),
    [
        (0, 0, 1, 90.0, None),
        (0, 1, 0, 0.0, 0.0),
        (1, 0, 0, 0.0, 90.0),
        (0, -1, 1, 45.0, 180.0),
        (-1, 0, -1, -45.0, 270.0),
        (-1, 1, np.sqrt(2), 45.0, 315.0),
    ],
)
def test_elevation_and_azimuth_of_known_directions(
    east: float, north: float, up: float, elevation: float, azimuth: float | None
) -> None:
    place = np.array([[35.7, 139.7, 40.0], [-77.0, -12.0, 2000.0]])
    receiver = ecef_from_geodetic(*place.T)
    direction = np.array([east, north, up]) @ enu_axes(place[:, 0], place[:, 1])
    satellite = receiver + 2.2e7 * direction
    found_elevation, found_azimuth = elevation_azimuth(read_only(satellite[:, None, :]), read_only(receiver))
    np.testing.assert_allclose(found_elevation[:, 0], elevation, atol=1e-7)
    if azimuth is not None:
        assert ((found_azimuth >= 0.0) & (found_azimuth < 360.0)).all()
        np.testing.assert_allclose((found_azimuth[:, 0] - azimuth + 180.0) % 360.0, 180.0, atol=1e-7)


def test_azimuth_is_that_of_the_geodesic() -> None:
    """A point 1 m away at the same height lies in the direction of the geodesic to it."""
    geod = Geod(ellps="WGS84")
    for azimuth in (10.0, 123.0, 250.0):
        longitude, latitude, _ = geod.fwd(139.0, 35.0, azimuth, 1.0)
        receiver, other = ecef_from_geodetic(35.0, 139.0, 0.0), ecef_from_geodetic(latitude, longitude, 0.0)
        _, found = elevation_azimuth(other[None, None], receiver[None])
        assert found[0, 0] == pytest.approx(azimuth, abs=1e-3)


def test_direction_to_an_absent_satellite_is_absent() -> None:
    receiver = ecef_from_geodetic(35.0, 139.0, 0.0)[None]
    satellites = np.stack([receiver[0] * 4.0, np.full(3, np.nan)])[None]
    elevation, azimuth = elevation_azimuth(satellites, receiver)
    assert np.isfinite(elevation[0, 0])
    assert np.isnan(elevation[0, 1])
    assert np.isnan(azimuth[0, 1])


def test_range_is_that_of_the_satellite_turned_by_the_flight() -> None:
    """Second formula: turn the satellite by the Earth's rotation during the flight, iterated."""
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(400, 2, 3))
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    receiver, satellite = 6.37e6 * direction[:, 0], 2.66e7 * direction[:, 1]
    visible = np.einsum("ni,ni->n", satellite - receiver, receiver) > 0.0
    receiver, satellite = receiver[visible], satellite[visible]
    distance = np.linalg.norm(satellite - receiver, axis=1)
    for _ in range(5):
        angle = EARTH_ROTATION_RATE * distance / SPEED_OF_LIGHT
        turned = np.stack(
            [
                satellite[:, 0] * np.cos(angle) + satellite[:, 1] * np.sin(angle),
                satellite[:, 1] * np.cos(angle) - satellite[:, 0] * np.sin(angle),
                satellite[:, 2],
            ],
            axis=-1,
        )
        distance = np.linalg.norm(turned - receiver, axis=1)
    found, sight = range_with_rotation(read_only(satellite), read_only(receiver))
    assert np.abs(distance - np.linalg.norm(satellite - receiver, axis=1)).max() > 20.0
    np.testing.assert_allclose(found, distance, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(sight, axis=1), 1.0, atol=1e-15)


def test_line_of_sight_is_the_gradient_of_the_range() -> None:
    receiver = ecef_from_geodetic(35.0, 139.0, 0.0)
    satellite = np.array([-2.0e7, 1.2e7, 1.3e7])
    _, sight = range_with_rotation(satellite, receiver)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 10.0
        change = range_with_rotation(satellite, receiver + step)[0] - range_with_rotation(satellite, receiver - step)[0]
        assert change / 20.0 == pytest.approx(-sight[axis], abs=1e-5)
