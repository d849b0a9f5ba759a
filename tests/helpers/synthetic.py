"""Made lines, satellites and ranges for tests of the estimators; nothing here uses the code under test
except the frames and the trajectory type."""

from __future__ import annotations

import numpy as np

from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.positioning.range_arrays import Ranges
from railfix.ranges.channels import clock_groups
from railfix.track import Track
from railfix.track.trajectory import Trajectory

ORIGIN = (35.0, 135.7, 60.0)


def enu_to_ecef(enu_m: np.ndarray) -> np.ndarray:
    origin = ecef_from_geodetic(*ORIGIN)
    return origin + np.asarray(enu_m) @ enu_axes(ORIGIN[0], ORIGIN[1])


def line(length_m: float = 1000.0, spacing_m: float = 5.0, *, curvature: float = 1 / 400.0) -> Trajectory:
    """A line that swings left and right, with a gentle gradient."""
    s = np.arange(0.0, length_m + spacing_m / 2, spacing_m)
    heading = 0.3 + np.sin(s / 150.0) * 150.0 * curvature
    steps = np.stack([np.sin(heading), np.cos(heading), 0.01 * np.sin(s / 90.0)], axis=1)[:-1] * spacing_m
    enu = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return Trajectory.from_antenna_path(Track.from_ecef(enu_to_ecef(enu), name="made line"))


def satellites(rng: np.random.Generator, epochs: int, systems: str) -> np.ndarray:
    """Satellites spread over the sky, shape (T, M, 3)."""
    count = len(systems)
    azimuth = np.radians((np.arange(count) * 137.5 + rng.uniform(0, 360, (epochs, 1))) % 360.0)
    elevation = np.radians(rng.uniform(20, 85, (epochs, count)))
    los = np.stack(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)], axis=-1
    )
    return enu_to_ecef(los * rng.uniform(2.0e7, 2.6e7, (epochs, count, 1)))


def travelled_range(sat_ecef_m: np.ndarray, receiver_ecef_m: np.ndarray) -> np.ndarray:
    """Range by turning the satellite into the frame of reception, iterated: the second formula."""
    delta = sat_ecef_m - receiver_ecef_m
    distance = np.sqrt((delta**2).sum(axis=-1))
    for _ in range(4):
        angle = EARTH_ROTATION_RATE * distance / SPEED_OF_LIGHT
        cos, sin = np.cos(angle), np.sin(angle)
        x = cos * sat_ecef_m[..., 0] + sin * sat_ecef_m[..., 1]
        y = -sin * sat_ecef_m[..., 0] + cos * sat_ecef_m[..., 1]
        turned = np.stack([x, y, sat_ecef_m[..., 2]], axis=-1)
        distance = np.sqrt(((turned - receiver_ecef_m) ** 2).sum(axis=-1))
    return distance


def ranges(
    trajectory: Trajectory,
    arc_m: np.ndarray,
    *,
    systems: str = "GGGGJEEE",
    sigma_m: float = 1.0,
    seed: int = 1,
    clock_m: float = 3.0e5,
) -> Ranges:
    """Ranges of an antenna at `arc_m`, noise of `sigma_m` (weights as if at least 1 mm)."""
    rng = np.random.default_rng(seed)
    sat = satellites(rng, len(arc_m), systems)
    groups = clock_groups(list(systems))
    clock = np.zeros((len(arc_m), len(systems)))
    for g, group in enumerate(groups):
        clock[:, group] = clock_m * (1 + 0.01 * g)
    place = trajectory.at_arc(arc_m)
    code = travelled_range(sat, place[:, None, :]) + clock + rng.normal(0.0, 1.0, clock.shape) * sigma_m
    weight = np.full(code.shape, 1.0 / max(sigma_m, 1e-3) ** 2) * rng.uniform(0.3, 1.0, code.shape)
    for array in (sat, code, weight):
        array.flags.writeable = False
    return Ranges(sat_ecef_m=sat, code_m=code, weight=weight, groups=groups)
