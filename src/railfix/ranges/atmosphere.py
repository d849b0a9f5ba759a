"""Ionospheric and tropospheric delays from broadcast and standard models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike

from railfix.core.array_functions import medians
from railfix.core.arrays import Bits, Datetimes, Floats
from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.geodesy import compute_angles, enu_axes, geodetic_from_ecef
from railfix.core.timescale import SECONDS_PER_DAY, to_week

#: Klobuchar coefficients broadcast by GPS on 2004-01-01 (moderate solar activity); RTKLIB also uses them if none were
#: received. Their vertical delay is 2.8 m RMS over time of day and latitude; the delays from the coefficients of five
#: other days from 2005 to 2024 differ from this delay by 0.7 to 1.7 m RMS.
TYPICAL_KLOBUCHAR: Final = np.array([1.118e-8, -7.451e-9, -5.961e-8, 1.192e-7, 1.167e5, -2.294e5, -1.311e5, 1.049e6])
#: Earth's radius divided by the radius of a thin ionospheric shell at a height of 350 km (DO-229D A.4.4.10.4).
_SHELL: Final = 6_378.1363 / (6_378.1363 + 350.0)


def thin_shell_obliquity(elevation_deg: Floats) -> Floats:
    """Return the slant-to-vertical delay ratio of a thin shell (DO-229D A.4.4.10.4); NaN up to 0.1 deg elevation."""
    cosine = np.cos(np.radians(np.where(elevation_deg > 0.1, elevation_deg, np.nan)))
    return np.asarray(1.0 / np.sqrt(1.0 - (_SHELL * cosine) ** 2))


def vertical_delay_m(slant_m: Floats, elevation_deg: Floats, frequency_hz: Floats) -> Floats:
    """Return the median of the channels' vertical L1 delays, shape (T,) [m]; 0 where no channel has a delay.

    `slant_m` and `elevation_deg` have shape (T, K); `frequency_hz` has shape (K,).
    """
    vertical = medians(slant_m / thin_shell_obliquity(elevation_deg) * (frequency_hz / FREQUENCY_L1) ** 2)
    return np.where(np.isfinite(vertical), vertical, 0.0)


def geomagnetic_latitude(latitude: Floats, longitude: Floats) -> Floats:
    """Return the geomagnetic latitude as defined by Klobuchar's model (IS-GPS-200, 20.3.3.5.2.5) in semicircles."""
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

    Latitude and longitude of the receiver have shape (T,), elevation and azimuth shape (T, M). `coefficients` are alpha
    0 to 3 and beta 0 to 3. The L1 delay is multiplied by (f1/f)^2 for the carriers `frequency_hz`, shape (M,). The
    delay is NaN at or below the horizon, and where an input is NaN.
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
    # A NaN phase fails the comparison, which makes the delay NaN instead of the night-time delay.
    delay = slant * np.where(np.abs(phase) >= 1.57, 5e-9, 5e-9 + amplitude * cosine)
    return np.asarray(SPEED_OF_LIGHT * delay * (FREQUENCY_L1 / frequency_hz) ** 2)


def saastamoinen_delay_m(
    latitude_deg: Floats, height_m: Floats, elevation_deg: Floats, *, relative_humidity: float = 0.7
) -> Floats:
    """Return Saastamoinen's tropospheric delay in the standard atmosphere (Saastamoinen, 1972), shape (T, M) [m].

    The hydrostatic and wet delays are mapped by 1/sin(elevation). Ellipsoidal heights from -100 m to 0 are replaced by
    0. The delay is NaN where an input is NaN, at or below the horizon, and at heights below -100 m or above 10 km.
    """
    height = np.where((height_m >= -100.0) & (height_m <= 1e4), np.maximum(height_m, 0.0), np.nan)
    pressure = 1013.25 * (1.0 - 2.2557e-5 * height) ** 5.2568
    temperature = 15.0 - 6.5e-3 * height + 273.16
    vapour = 6.108 * relative_humidity * np.exp((17.15 * temperature - 4684.0) / (temperature - 38.45))
    gravity = 1.0 - 0.00266 * np.cos(2.0 * np.radians(latitude_deg)) - 0.00028 * height / 1e3
    zenith = 0.0022768 * pressure / gravity + 0.002277 * (1255.0 / temperature + 0.05) * vapour
    elevation = np.where(elevation_deg > 0.0, elevation_deg, np.nan)
    return np.asarray(zenith[:, None] / np.sin(np.radians(elevation)))


@dataclass(frozen=True, kw_only=True)
class SeenFrom:
    """Satellite directions at T epochs for K channels; receiver positions accurate to hundreds of metres suffice."""

    receiver_ecef_m: Floats  #: Position of the receiver, shape (T, 3).
    latitude_deg: Floats  #: Geodetic latitude of the receiver, shape (T,).
    longitude_deg: Floats  #: Longitude of the receiver, shape (T,).
    height_m: Floats  #: Ellipsoidal height of the receiver, shape (T,).
    satellite_ecef_m: Floats  #: Positions of the satellites, shape (T, K, 3).
    elevation_deg: Floats  #: Elevation of each satellite, shape (T, K).
    azimuth_deg: Floats  #: Azimuth of each satellite, shape (T, K).

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
    """Atmospheric delays, and sigma of the corrected ranges, T epochs by K channels."""

    #: Delays at the carrier frequency, shape (T, K); 0 if the model of the delay is off, NaN where SBAS has no delay.
    ionosphere_m: Floats
    troposphere_m: Floats
    #: Sigma added to receiver noise in quadrature, (T, K); 0 for received Klobuchar coefficients, NaN if unknown.
    sigma_m: Floats
    reason: Bits  #: Rejection reasons (`Reason` bits) where a delay is unknown, shape (T, K).


def model_delays(
    time: Datetimes,
    seen: SeenFrom,
    frequency_hz: Floats,
    *,
    klobuchar: Floats | None,
    ionosphere_sigma_m: float = 0.0,
    troposphere: str,
) -> Delays:
    """Return Klobuchar and Saastamoinen delays; each is 0 if its model is off (`klobuchar` None, `troposphere` off)."""
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
