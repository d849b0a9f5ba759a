"""Tropospheric delay and its standard deviation for SBAS users, by RTCA DO-229D (A.4.2.4)."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats

#: Refractivity constants [K/mbar, K^2/mbar], gas constant of dry air [J/kg/K], mean and surface gravity [m/s^2].
_K1, _K2, _RD, _GM, _G = 77.604, 382_000.0, 287.054, 9.784, 9.80665
_RTCA_LATITUDE: Final = np.array([15.0, 30.0, 45.0, 60.0, 75.0])  #: Latitudes of table A-2 [deg].
#: Mean pressure [mbar], temperature [K], vapour pressure [mbar], temperature lapse rate [K/m] and vapour lapse rate by
#: latitude (table A-2).
_RTCA_MEAN: Final = np.array(
    [
        [1013.25, 1017.25, 1015.75, 1011.75, 1013.00],
        [299.65, 294.15, 283.15, 272.15, 263.65],
        [26.31, 21.79, 11.66, 6.78, 4.11],
        [6.30e-3, 6.05e-3, 5.58e-3, 5.39e-3, 4.53e-3],
        [2.77, 3.15, 2.57, 1.81, 1.55],
    ]
)
#: Seasonal variations of the quantities in `_RTCA_MEAN` (table A-2).
_RTCA_SEASON: Final = np.array(
    [
        [0.0, -3.75, -2.25, -1.75, -0.50],
        [0.0, 7.00, 11.00, 15.00, 14.50],
        [0.0, 8.85, 7.24, 5.36, 3.39],
        [0.0, 0.25e-3, 0.32e-3, 0.81e-3, 0.62e-3],
        [0.0, 0.33, 0.46, 0.74, 0.30],
    ]
)
#: Standard deviation of the vertical tropospheric delay [m].
SIGMA_VERTICAL_M: Final = 0.12
_LOWEST_DEG: Final = 2.0


def rtca_mapping(elevation_deg: Floats) -> Floats:
    """Return the ratio of slant to vertical tropospheric delay of DO-229D (A.4.2.4), any shape; NaN below 2 degrees."""
    elevation = np.where(elevation_deg >= _LOWEST_DEG, elevation_deg, np.nan)
    low = 1.0 + 0.015 * np.maximum(0.0, 4.0 - elevation) ** 2
    return np.asarray(1.001 / np.sqrt(0.002001 + np.sin(np.radians(elevation)) ** 2) * low)


def rtca_troposphere_sigma_m(elevation_deg: Floats) -> Floats:
    """Return the standard deviation of the slant delay after correction by `rtca_troposphere_m` [m]."""
    return SIGMA_VERTICAL_M * rtca_mapping(elevation_deg)


def rtca_troposphere_m(time: Datetimes, latitude_deg: Floats, height_m: Floats, elevation_deg: Floats) -> Floats:
    """Return the tropospheric slant delay of RTCA DO-229D (A.4.2.4) from latitude and day of year, shape (T, K) [m].

    The model is for heights above mean sea level; with ellipsoidal heights, the delay changes by 1 mm per 3 m of geoid
    height. The delay is NaN at elevations below 2 degrees, and at heights outside -100 m to 10 km.
    """
    year = time.astype("datetime64[Y]").astype("datetime64[ns]")
    day = (time - year) / np.timedelta64(1, "D") + 1.0
    season = np.cos(2.0 * np.pi * (day - np.where(latitude_deg >= 0.0, 28.0, 211.0)) / 365.25)
    at = np.clip(np.abs(latitude_deg), 15.0, 75.0)
    pressure, temperature, vapour, lapse, vapour_lapse = (
        np.interp(at, _RTCA_LATITUDE, mean) - np.interp(at, _RTCA_LATITUDE, swing) * season
        for mean, swing in zip(_RTCA_MEAN, _RTCA_SEASON, strict=True)
    )
    height = np.where((height_m >= -100.0) & (height_m <= 1e4), height_m, np.nan)
    dry = 1e-6 * _K1 * _RD * pressure / _GM
    wet = 1e-6 * _K2 * _RD / (_GM * (vapour_lapse + 1.0) - lapse * _RD) * vapour / temperature
    ratio = 1.0 - lapse * height / temperature
    dry = dry * ratio ** (_G / (_RD * lapse))
    wet = wet * ratio ** ((vapour_lapse + 1.0) * _G / (_RD * lapse) - 1.0)
    return np.asarray((dry + wet)[:, None] * rtca_mapping(elevation_deg))
