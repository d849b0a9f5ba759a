"""What is added to clean signals: the place where multipath and shadowing come in."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from railfix.core.arrays import Datetimes, Floats, Strings


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """Where one antenna and its satellites are at T epochs, M channels.

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
    """What is added to the observations, shapes (T, M).

    Attributes
    ----------
    code_m : ndarray [m]
        NaN where the signal is lost: the channel is then absent altogether.
    phase_m : ndarray [m]
    doppler_hz : ndarray [Hz]
    cn0_db : ndarray [dB]
        Negative where the signal is weakened.
    """

    code_m: Floats
    phase_m: Floats
    doppler_hz: Floats
    cn0_db: Floats


class Disturbances(Protocol):
    """A source of disturbances; a function of the geometry alone, so that pieces of a run equal the whole."""

    def __call__(self, geometry: Geometry) -> Disturbance:
        """Disturbance of every channel and epoch."""
        ...
