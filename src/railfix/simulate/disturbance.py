"""Disturbances of clean signals, such as multipath and shadowing, and the geometry that they depend on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from railfix.core.arrays import Datetimes, Floats, Strings


@dataclass(frozen=True, kw_only=True)
class SightGeometry:
    """Positions of one antenna and directions to its satellites at T epochs, M channels.

    Attributes
    ----------
    antenna : str
        "front" or "rear".
    time : ndarray of datetime64[ns], shape (T,)
    satellite, signal : ndarray of str, shape (M,)
    chainage_m : ndarray, shape (T,) [m]
        Of the centreline point abeam the antenna.
    speed_mps : ndarray, shape (T,) [m/s]
        Negative toward falling chainage.
    antenna_ecef_m : ndarray, shape (T, 3) [m]
    heading_deg : ndarray, shape (T,) [deg]
        Azimuth of the vehicle's forward axis.
    elevation_deg, azimuth_deg : ndarray, shape (T, M) [deg]
    """

    antenna: str
    time: Datetimes
    satellite: Strings
    signal: Strings
    chainage_m: Floats
    speed_mps: Floats
    antenna_ecef_m: Floats
    heading_deg: Floats
    elevation_deg: Floats
    azimuth_deg: Floats


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Terms added to the observations, shapes (T, M).

    Attributes
    ----------
    code_m : ndarray [m]
        NaN where the signal is lost; all observables are then absent.
    phase_m : ndarray [m]
    doppler_hz : ndarray [Hz]
    cn0_db : ndarray [dB]
        Negative where the signal is attenuated.
    """

    code_m: Floats
    phase_m: Floats
    doppler_hz: Floats
    cn0_db: Floats


#: A source of disturbances: a function of the geometry alone, so that results do not depend on the chunks.
Disturbances = Callable[[SightGeometry], Disturbance]


CN0_HORIZON_DBHZ: Final = 34.0
CN0_RISE_DB: Final = 16.0
CN0_SECOND_DB: Final = -3.0
