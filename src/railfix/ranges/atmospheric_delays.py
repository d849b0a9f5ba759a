"""Ionospheric and tropospheric delays, and the directions they depend on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Bits, Datetimes, Floats
from railfix.core.constants import FREQUENCY_L1
from railfix.core.geodesy import angles_of, enu_axes, geodetic_from_ecef
from railfix.ranges.atmosphere import klobuchar_delay_m, saastamoinen_delay_m, thin_shell_obliquity


@dataclass(frozen=True, kw_only=True)
class SeenFrom:
    """Directions to the satellites from a receiver position good to some hundred metres: T epochs by K channels.

    Attributes
    ----------
    receiver_ecef_m : ndarray, shape (T, 3) [m]
    latitude_deg, longitude_deg, height_m : ndarray, shape (T,)
        Geodetic coordinates of the receiver.
    satellite_ecef_m : ndarray, shape (T, K, 3) [m]
    elevation_deg, azimuth_deg : ndarray, shape (T, K)
    """

    receiver_ecef_m: Floats
    latitude_deg: Floats
    longitude_deg: Floats
    height_m: Floats
    satellite_ecef_m: Floats
    elevation_deg: Floats
    azimuth_deg: Floats

    @classmethod
    def of(cls, receiver_ecef_m: Floats, satellite_ecef_m: Floats) -> SeenFrom:
        """Directions and geodetic coordinates from Earth-fixed positions."""
        latitude, longitude, height = geodetic_from_ecef(receiver_ecef_m)
        elevation, azimuth = angles_of(satellite_ecef_m - receiver_ecef_m[:, None], enu_axes(latitude, longitude))
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
    """Delays of T epochs by K channels, and the standard deviation of the errors that remain after them.

    Attributes
    ----------
    ionosphere_m, troposphere_m : ndarray, shape (T, K) [m]
        On the channel's own carrier; 0 where a model is off, NaN where SBAS has none.
    sigma_m : ndarray, shape (T, K) [m]
        To be added to that of local errors; 0 by models with received coefficients, NaN where a part of it is
        unknown.
    reason : ndarray of int64, shape (T, K)
        Flags of unknown delays (`railfix.core.reasons.Reason`).
    """

    ionosphere_m: Floats
    troposphere_m: Floats
    sigma_m: Floats
    reason: Bits


def modelled_delays(
    time: Datetimes,
    seen: SeenFrom,
    frequency_hz: Floats,
    *,
    klobuchar: Floats | None,
    ionosphere_sigma_m: float = 0.0,
    troposphere: str,
) -> Delays:
    """Delays by the models of Klobuchar and Saastamoinen, 0 by a model that is off.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    seen : SeenFrom
    frequency_hz : ndarray, shape (K,) [Hz]
    klobuchar : ndarray, shape (8,), or None
        None: off.
    ionosphere_sigma_m : float
        Standard deviation of the vertical delay at L1 for coefficients that were not received.
    troposphere : {"saastamoinen", "off"}
    """
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
        ionosphere_m=ionosphere,
        troposphere_m=troposphere_m,
        sigma_m=sigma,
        reason=np.zeros(shape, dtype=np.int64),
    )
