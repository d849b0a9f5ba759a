"""Simulated fixes of three receivers on a triangle, with faults put in."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, range_with_rotation
from railfix.ground.station_fixes import StationFixes, fixes_of_ranges
from railfix.positioning.normal_equations import Ranges

#: East and north of the receivers [m].
PLAN_M: Floats = np.array([[0.0, 0.0], [800.0, 100.0], [300.0, 700.0]])
#: Directions to the satellites [deg].
ELEVATION_DEG = np.array([75.0, 50.0, 48.0, 35.0, 33.0, 25.0, 22.0, 18.0, 60.0])
AZIMUTH_DEG = np.array([20.0, 80.0, 150.0, 215.0, 290.0, 340.0, 110.0, 250.0, 310.0])
TIME = np.datetime64("2024-03-05T00:00:00", "ns")


def points_ecef_m() -> Floats:
    """Known points of the receivers, shape (3, 3) [m]."""
    return ecef_from_geodetic(35.7, 139.7, 100.0) + PLAN_M @ enu_axes(35.7, 139.7)[:2]


def simulated_fixes(
    rng: np.random.Generator,
    *,
    epochs: int = 60,
    common_m: Floats | None = None,
    moved_m: Floats | None = None,
    noise_m: float = 0.4,
) -> StationFixes:
    """Return fixes, one a second, from simulated ranges of satellites that stand still.

    `common_m`, shape (T, 9): errors of the satellites, common to the receivers. `moved_m`, shape (T, 3, 2): east and
    north by which the fix of a receiver moves; NaN: it has none, and its C/N0 has fallen.
    """
    points, axes = points_ecef_m(), enu_axes(35.7, 139.7)
    el, az = np.radians(ELEVATION_DEG), np.radians(AZIMUTH_DEG)
    enu = np.stack([np.cos(el) * np.sin(az), np.cos(el) * np.cos(az), np.sin(el)], axis=1)
    satellites = points[0] + 2.2e7 * enu @ axes
    shape = (epochs, len(el))
    common = rng.normal(0.0, 0.5, (1, len(el))) + (0.0 if common_m is None else common_m)
    ranges = []
    for k in range(3):
        shift = np.zeros((epochs, 2)) if moved_m is None else moved_m[:, k]
        antenna = points[k] + shift @ axes[:2]
        distance, _ = range_with_rotation(satellites, antenna[:, None])
        code = distance + common + rng.normal(0.0, noise_m, shape) + rng.normal(0.0, 1e4)
        absent = ~np.isfinite(code)
        ranges.append(
            Ranges(
                sat_ecef_m=np.broadcast_to(satellites, (*shape, 3)),
                code_m=np.where(absent, 0.0, code),
                weight=np.where(absent, 0.0, 1.0),
                groups=(slice(0, len(el)),),
            )
        )
    fallen = np.isnan(np.zeros((epochs, 3)) if moved_m is None else moved_m[..., 0])
    time = TIME + np.arange(epochs) * np.timedelta64(1, "s")
    return fixes_of_ranges(time, ranges, points, cn0_fallen=fallen)
