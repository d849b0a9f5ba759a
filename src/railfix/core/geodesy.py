"""Conversions between ECEF (WGS 84), geodetic and local east-north-up coordinates; ranges corrected for Earth rotation.

Where an input is NaN, the result is NaN.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from pyproj import Transformer

from railfix.core.arrays import Floats
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT


@cache
def _to_geodetic() -> Transformer:
    return Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True)


def geodetic_from_ecef(ecef_m: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Convert ECEF, shape (..., 3) [m], to latitude, longitude [deg] and ellipsoidal height [m]."""
    xyz = np.asarray(ecef_m, dtype=np.float64)
    finite = np.asarray(np.isfinite(xyz).all(axis=-1))
    filled = np.where(finite[..., None], xyz, (6_378_137.0, 0.0, 0.0))
    lon, lat, height = _to_geodetic().transform(filled[..., 0], filled[..., 1], filled[..., 2])
    return np.where(finite, lat, np.nan), np.where(finite, lon, np.nan), np.where(finite, height, np.nan)


def ecef_from_geodetic(latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike) -> Floats:
    """Convert latitude, longitude [deg] and ellipsoidal height [m] on WGS 84 to ECEF, shape (..., 3) [m]."""
    lat, lon, height = np.broadcast_arrays(
        np.radians(np.asarray(latitude_deg, dtype=np.float64)),
        np.radians(np.asarray(longitude_deg, dtype=np.float64)),
        np.asarray(height_m, dtype=np.float64),
    )
    a, f = 6_378_137.0, 1.0 / 298.257_223_563
    e2 = f * (2.0 - f)
    n = a / np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    return np.stack(
        [
            (n + height) * np.cos(lat) * np.cos(lon),
            (n + height) * np.cos(lat) * np.sin(lon),
            (n * (1.0 - e2) + height) * np.sin(lat),
        ],
        axis=-1,
    )


def enu_axes(latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> Floats:
    """Compute the unit vectors east, north and up in ECEF as the rows of matrices, shape (..., 3, 3).

    ``axes @ (ecef - origin)`` gives the east, north and up components of a position relative to `origin`.
    """
    lat = np.radians(np.asarray(latitude_deg, dtype=np.float64))
    lon = np.radians(np.asarray(longitude_deg, dtype=np.float64))
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(lat), np.cos(lat), np.sin(lon), np.cos(lon)
    axes = np.empty((*np.broadcast_shapes(lat.shape, lon.shape), 3, 3))
    axes[..., 0, 0], axes[..., 0, 1], axes[..., 0, 2] = -sin_lon, cos_lon, 0.0
    axes[..., 1, 0], axes[..., 1, 1], axes[..., 1, 2] = -sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat
    axes[..., 2, 0], axes[..., 2, 1], axes[..., 2, 2] = cos_lat * cos_lon, cos_lat * sin_lon, sin_lat
    return axes


def axes_at(ecef_m: ArrayLike) -> Floats:
    """Compute `enu_axes` at ECEF positions of shape (..., 3) [m]."""
    latitude, longitude, _ = geodetic_from_ecef(ecef_m)
    return enu_axes(latitude, longitude)


def sigma_along(sigma_enu_m: Floats, ecef_m: Floats, direction: Floats) -> Floats:
    """Compute the sigma [m] along ECEF unit vectors (T, 3) at positions (T, 3) from independent ENU sigmas (T, 3)."""
    components = np.einsum("tij,tj->ti", axes_at(ecef_m), direction)
    return np.asarray(np.sqrt(np.sum((components * sigma_enu_m) ** 2, axis=1)))


def elevation_azimuth(sat_ecef_m: ArrayLike, receiver_ecef_m: ArrayLike) -> tuple[Floats, Floats]:
    """Compute the elevation and azimuth (clockwise from north) [deg] of satellites (T, N, 3) at receivers (T, 3)."""
    sat = np.asarray(sat_ecef_m, dtype=np.float64)
    receiver = np.asarray(receiver_ecef_m, dtype=np.float64)
    return compute_angles(sat - receiver[:, None, :], axes_at(receiver))


def compute_angles(line_ecef_m: Floats, axes: Floats) -> tuple[Floats, Floats]:
    """Compute the elevation and azimuth [deg], shape (T, N), from vectors to satellites (T, N, 3) and `enu_axes`."""
    enu = np.matmul(axes, line_ecef_m.swapaxes(1, 2))
    east, north, up = enu[:, 0], enu[:, 1], enu[:, 2]
    azimuth = np.degrees(np.arctan2(east, north))
    azimuth[azimuth < 0.0] += 360.0
    azimuth[azimuth == 360.0] = 0.0  # a tiny negative azimuth is rounded to 360
    return np.degrees(np.arctan2(up, np.sqrt(east * east + north * north))), azimuth


def range_with_rotation(sat_ecef_m: ArrayLike, receiver_ecef_m: ArrayLike) -> tuple[Floats, Floats]:
    """Compute the geometric range with the Sagnac correction [m] and the line of sight, shapes (...) and (..., 3).

    The satellite position `s` is in the Earth-fixed frame at transmission. To first order, rotating `s` into the frame
    at reception adds ``omega / c * (s_x r_y - s_y r_x)`` to the distance from the receiver position `r` (Sagnac;
    IS-GPS-200, 20.3.3.4.3.4). The neglected terms are below 0.2 mm. The line of sight `u` is the unit vector from
    receiver to satellite: d(range)/d(receiver) = -u; the gradient of the Sagnac term, at most 1.1e-5, is neglected.
    """
    sat = np.asarray(sat_ecef_m, dtype=np.float64)
    receiver = np.asarray(receiver_ecef_m, dtype=np.float64)
    delta = sat - receiver
    distance = np.sqrt(np.einsum("...i,...i->...", delta, delta))
    sagnac = EARTH_ROTATION_RATE / SPEED_OF_LIGHT * (sat[..., 0] * receiver[..., 1] - sat[..., 1] * receiver[..., 0])
    return distance + sagnac, delta / distance[..., None]
