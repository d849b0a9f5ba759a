"""Delays of the signal in the ionosphere and the troposphere, from broadcast and standard models."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Datetimes, Floats
from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.timescale import SECONDS_PER_DAY, to_week


def klobuchar_delay_m(
    time: Datetimes,
    latitude_deg: Floats,
    longitude_deg: Floats,
    elevation_deg: Floats,
    azimuth_deg: Floats,
    coefficients: ArrayLike,
    frequency_hz: Floats,
) -> Floats:
    """Ionospheric delay of the broadcast model (IS-GPS-200, 20.3.3.5.2.5, figure 20-4).

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
        GPS time.
    latitude_deg, longitude_deg : ndarray, shape (T,) [deg]
    elevation_deg, azimuth_deg : ndarray, shape (T, M) [deg]
    coefficients : array_like, shape (8,)
        alpha 0 to 3, beta 0 to 3 [s, s/semicircle, ...].
    frequency_hz : ndarray, shape (M,) [Hz]
        The model is made for L1; other carriers scale by (f1/f)^2.

    Returns
    -------
    ndarray, shape (T, M) [m]
        NaN where an angle, a coordinate or a frequency is NaN, and at or below the horizon.
    """
    alpha, beta = np.asarray(coefficients, dtype=np.float64).reshape(2, 4)
    elevation = np.where(elevation_deg > 0.0, elevation_deg, np.nan) / 180.0
    azimuth = np.radians(azimuth_deg)
    earth_angle = 0.0137 / (elevation + 0.11) - 0.022
    latitude = np.clip(latitude_deg[:, None] / 180.0 + earth_angle * np.cos(azimuth), -0.416, 0.416)
    longitude = longitude_deg[:, None] / 180.0 + earth_angle * np.sin(azimuth) / np.cos(latitude * np.pi)
    magnetic = latitude + 0.064 * np.cos((longitude - 1.617) * np.pi)
    _, seconds_of_week = to_week(time)
    local = (43_200.0 * longitude + seconds_of_week[:, None]) % SECONDS_PER_DAY
    slant = 1.0 + 16.0 * (0.53 - elevation) ** 3
    amplitude = np.maximum(_cubic(alpha, magnetic), 0.0)
    period = np.maximum(_cubic(beta, magnetic), 72_000.0)
    phase = 2.0 * np.pi * (local - 50_400.0) / period
    cosine = 1.0 + phase * phase * (-0.5 + phase * phase / 24.0)
    # Asked this way round, NaN stays NaN and does not become the delay of the night.
    delay = slant * np.where(np.abs(phase) >= 1.57, 5e-9, 5e-9 + amplitude * cosine)
    return np.asarray(SPEED_OF_LIGHT * delay * (FREQUENCY_L1 / frequency_hz) ** 2)


def _cubic(coefficients: Floats, x: Floats) -> Floats:
    return np.asarray(coefficients[0] + x * (coefficients[1] + x * (coefficients[2] + x * coefficients[3])))


def saastamoinen_delay_m(
    latitude_deg: Floats, height_m: Floats, elevation_deg: Floats, *, relative_humidity: float = 0.7
) -> Floats:
    """Tropospheric delay of Saastamoinen in the standard atmosphere (J. Saastamoinen, 1972).

    Pressure, temperature and vapour pressure follow the standard atmosphere at the height; both
    parts are mapped by 1/sin(elevation), as single-point programs do.

    Parameters
    ----------
    latitude_deg, height_m : ndarray, shape (T,)
        Ellipsoidal height; below sea level counts as sea level. NaN delay outside -100 m to 10 km.
    elevation_deg : ndarray, shape (T, M) [deg]
    relative_humidity : float
        0 to 1.

    Returns
    -------
    ndarray, shape (T, M) [m]
        NaN where an input is NaN, and at or below the horizon.
    """
    height = np.where((height_m >= -100.0) & (height_m <= 1e4), np.maximum(height_m, 0.0), np.nan)
    pressure = 1013.25 * (1.0 - 2.2557e-5 * height) ** 5.2568
    temperature = 15.0 - 6.5e-3 * height + 273.16
    vapour = 6.108 * relative_humidity * np.exp((17.15 * temperature - 4684.0) / (temperature - 38.45))
    gravity = 1.0 - 0.00266 * np.cos(2.0 * np.radians(latitude_deg)) - 0.00028 * height / 1e3
    zenith = 0.0022768 * pressure / gravity + 0.002277 * (1255.0 / temperature + 0.05) * vapour
    elevation = np.where(elevation_deg > 0.0, elevation_deg, np.nan)
    return np.asarray(zenith[:, None] / np.sin(np.radians(elevation)))
