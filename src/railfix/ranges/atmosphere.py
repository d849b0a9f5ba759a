"""Delays of the signal in the ionosphere and the troposphere, from broadcast and standard models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike

from railfix.core.arrays import Bits, Datetimes, Floats
from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.geodesy import compute_angles, enu_axes, geodetic_from_ecef
from railfix.core.timescale import SECONDS_PER_DAY, to_week

_RTCA_LATITUDE: Final = np.array([15.0, 30.0, 45.0, 60.0, 75.0])  #: Latitudes of its tables [deg].
#: Pressure [mbar], temperature [K], vapour pressure [mbar], lapse of temperature [K/m] and of vapour (table A-2).
_RTCA_MEAN: Final = np.array(
    [
        [1013.25, 1017.25, 1015.75, 1011.75, 1013.00],
        [299.65, 294.15, 283.15, 272.15, 263.65],
        [26.31, 21.79, 11.66, 6.78, 4.11],
        [6.30e-3, 6.05e-3, 5.58e-3, 5.39e-3, 4.53e-3],
        [2.77, 3.15, 2.57, 1.81, 1.55],
    ]
)
_RTCA_SEASON: Final = np.array(
    [
        [0.0, -3.75, -2.25, -1.75, -0.50],
        [0.0, 7.00, 11.00, 15.00, 14.50],
        [0.0, 8.85, 7.24, 5.36, 3.39],
        [0.0, 0.25e-3, 0.32e-3, 0.81e-3, 0.62e-3],
        [0.0, 0.33, 0.46, 0.74, 0.30],
    ]
)
#: Refractivity constants [K/mbar, K^2/mbar], gas constant of dry air [J/kg/K], gravity [m/s^2].
_K1, _K2, _RD, _GM, _G = 77.604, 382_000.0, 287.054, 9.784, 9.80665
#: Standard deviation of the vertical delay [m].
SIGMA_VERTICAL_M: Final = 0.12
_LOWEST_DEG: Final = 2.0
#: Klobuchar coefficients that GPS broadcast on 2004-01-01, at middling solar activity; RTKLIB too takes them where it
#: has none. Their vertical delay is 2.8 m RMS over day and latitude; that of the five other available days from 2005 to
#: 2024 differs from it by 0.7 to 1.7 m RMS.
TYPICAL_KLOBUCHAR: Final = np.array([1.118e-8, -7.451e-9, -5.961e-8, 1.192e-7, 1.167e5, -2.294e5, -1.311e5, 1.049e6])
#: Radius of the Earth over that of the ionosphere's thin shell, 350 km above it (DO-229D A.4.4.10.4).
_SHELL: Final = 6_378.1363 / (6_378.1363 + 350.0)


def thin_shell_obliquity(elevation_deg: Floats) -> Floats:
    """Return the slant over vertical delay of a thin-shell ionosphere (DO-229D A.4.4.10.4); NaN below the horizon."""
    cosine = np.cos(np.radians(np.where(elevation_deg > 0.1, elevation_deg, np.nan)))
    return np.asarray(1.0 / np.sqrt(1.0 - (_SHELL * cosine) ** 2))


def geomagnetic_latitude(latitude: Floats, longitude: Floats) -> Floats:
    """Return the geomagnetic latitude of the broadcast ionosphere model (IS-GPS-200, 20.3.3.5.2.5) in semicircles."""
    return np.asarray(latitude + 0.064 * np.cos((longitude - 1.617) * np.pi))


def klobuchar_delay_m(
    time: Datetimes,
    latitude_deg: Floats,
    longitude_deg: Floats,
    elevation_deg: Floats,
    azimuth_deg: Floats,
    coefficients: ArrayLike,
    frequency_hz: Floats,
) -> Floats:
    """Return the ionospheric delay of the broadcast model (IS-GPS-200, 20.3.3.5.2.5, figure 20-4), shape (T, M) [m].

    Latitude and longitude (T,), angles (T, M), `coefficients` alpha 0 to 3, beta 0 to 3, `frequency_hz` (M,): carriers
    other than L1 scale by (f1/f)^2. NaN where an input is NaN, and at or below the horizon.
    """
    _, seconds_of_week = to_week(time)
    alpha, beta = np.array(coefficients, dtype=np.float64).reshape(2, 4)
    elevation = np.where(elevation_deg > 0.0, elevation_deg, np.nan) / 180.0
    azimuth = np.radians(azimuth_deg)
    earth_angle = 0.0137 / (elevation + 0.11) - 0.022
    latitude = np.clip(latitude_deg[:, None] / 180.0 + earth_angle * np.cos(azimuth), -0.416, 0.416)
    longitude = longitude_deg[:, None] / 180.0 + earth_angle * np.sin(azimuth) / np.cos(latitude * np.pi)
    magnetic = geomagnetic_latitude(latitude, longitude)
    local = (43_200.0 * longitude + seconds_of_week[:, None]) % SECONDS_PER_DAY
    low = 0.53 - elevation
    slant = 1.0 + 16.0 * low * low * low
    amplitude = np.maximum(polyval(magnetic, alpha), 0.0)
    period = np.maximum(polyval(magnetic, beta), 72_000.0)
    phase = 2.0 * np.pi * (local - 50_400.0) / period
    cosine = 1.0 + phase * phase * (-0.5 + phase * phase / 24.0)
    # With this order of comparison NaN stays NaN and does not become the delay of the night.
    delay = slant * np.where(np.abs(phase) >= 1.57, 5e-9, 5e-9 + amplitude * cosine)
    return np.asarray(SPEED_OF_LIGHT * delay * (FREQUENCY_L1 / frequency_hz) ** 2)


def saastamoinen_delay_m(
    latitude_deg: Floats, height_m: Floats, elevation_deg: Floats, *, relative_humidity: float = 0.7
) -> Floats:
    """Return the tropospheric delay of Saastamoinen in the standard atmosphere (Saastamoinen, 1972), shape (T, M) [m].

    Both parts are mapped by 1/sin(elevation). Ellipsoidal heights below sea level count as sea level. NaN where an
    input is NaN, at or below the horizon, and outside -100 m to 10 km.
    """
    height = np.where((height_m >= -100.0) & (height_m <= 1e4), np.maximum(height_m, 0.0), np.nan)
    pressure = 1013.25 * (1.0 - 2.2557e-5 * height) ** 5.2568
    temperature = 15.0 - 6.5e-3 * height + 273.16
    vapour = 6.108 * relative_humidity * np.exp((17.15 * temperature - 4684.0) / (temperature - 38.45))
    gravity = 1.0 - 0.00266 * np.cos(2.0 * np.radians(latitude_deg)) - 0.00028 * height / 1e3
    zenith = 0.0022768 * pressure / gravity + 0.002277 * (1255.0 / temperature + 0.05) * vapour
    elevation = np.where(elevation_deg > 0.0, elevation_deg, np.nan)
    return np.asarray(zenith[:, None] / np.sin(np.radians(elevation)))


def rtca_mapping(elevation_deg: Floats) -> Floats:
    """Return the slant over vertical tropospheric delay of DO-229D (A.4.2.4), any shape; NaN below 2 degrees."""
    elevation = np.where(elevation_deg >= _LOWEST_DEG, elevation_deg, np.nan)
    low = 1.0 + 0.015 * np.maximum(0.0, 4.0 - elevation) ** 2
    return np.asarray(1.001 / np.sqrt(0.002001 + np.sin(np.radians(elevation)) ** 2) * low)


def rtca_troposphere_sigma_m(elevation_deg: Floats) -> Floats:
    """Return the standard deviation of the slant delay after correction by `rtca_troposphere_m` [m]."""
    return SIGMA_VERTICAL_M * rtca_mapping(elevation_deg)


def rtca_troposphere_m(time: Datetimes, latitude_deg: Floats, height_m: Floats, elevation_deg: Floats) -> Floats:
    """Return the tropospheric slant delay of RTCA DO-229D (A.4.2.4) by latitude and day of year, shape (T, K) [m].

    Height above mean sea level is meant; the ellipsoidal one differs by 1 mm in 3 m. NaN below 2 degrees, and outside
    -100 m to 10 km.
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


@dataclass(frozen=True, kw_only=True)
class SeenFrom:
    """Directions to the satellites from a receiver position good to some hundred metres: T epochs by K channels."""

    receiver_ecef_m: Floats  #: Shape (T, 3).
    #: Geodetic coordinates of the receiver, shape (T,).
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    satellite_ecef_m: Floats  #: Shape (T, K, 3).
    #: Shape (T, K).
    elevation_deg: Floats
    azimuth_deg: Floats

    @classmethod
    def of(cls, receiver_ecef_m: Floats, satellite_ecef_m: Floats) -> SeenFrom:
        """Return directions and geodetic coordinates from Earth-fixed positions."""
        latitude, longitude, height = geodetic_from_ecef(receiver_ecef_m)
        elevation, azimuth = compute_angles(satellite_ecef_m - receiver_ecef_m[:, None], enu_axes(latitude, longitude))
        return cls(
            receiver_ecef_m=receiver_ecef_m,
            latitude_deg=latitude,
            longitude_deg=longitude,
            height_m=height,
            satellite_ecef_m=satellite_ecef_m,
            elevation_deg=elevation,
            azimuth_deg=azimuth,
        )


@dataclass(frozen=True, kw_only=True)
class Delays:
    """Delays of T epochs by K channels, and the standard deviation of the errors that remain after them."""

    #: On the channel's own carrier; 0 where a model is off, NaN where SBAS has none; shape (T, K).
    ionosphere_m: Floats
    troposphere_m: Floats
    #: Standard deviation added to that of local errors; 0 with received coefficients, NaN where unknown; shape (T, K).
    sigma_m: Floats
    reason: Bits  #: Flags of unknown delays (`railfix.core.reasons.Reason`), shape (T, K).


def model_delays(
    time: Datetimes,
    seen: SeenFrom,
    frequency_hz: Floats,
    *,
    klobuchar: Floats | None,
    ionosphere_sigma_m: float = 0.0,
    troposphere: str,
) -> Delays:
    """Return the delays by the models of Klobuchar and Saastamoinen, 0 by a model that is off (`klobuchar` None)."""
    shape = seen.elevation_deg.shape
    ionosphere, troposphere_m, sigma = np.zeros((3, *shape))
    if klobuchar is not None:
        ionosphere = klobuchar_delay_m(
            time, seen.latitude_deg, seen.longitude_deg, seen.elevation_deg, seen.azimuth_deg, klobuchar, frequency_hz
        )
    if ionosphere_sigma_m > 0.0:
        sigma = ionosphere_sigma_m * thin_shell_obliquity(seen.elevation_deg) * (FREQUENCY_L1 / frequency_hz) ** 2
    if troposphere == "saastamoinen":
        troposphere_m = saastamoinen_delay_m(seen.latitude_deg, seen.height_m, seen.elevation_deg)
    return Delays(
        ionosphere_m=ionosphere, troposphere_m=troposphere_m, sigma_m=sigma, reason=np.zeros(shape, dtype=np.int64)
    )
