"""Disturbances of clean signals, such as multipath and shadowing, and the geometry that they depend on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from railfix.core.arrays import Datetimes, Floats, Strings


@dataclass(frozen=True, kw_only=True)
class SightGeometry:
    """Positions of one antenna and directions to its satellites at T epochs, M channels."""

    antenna: str  #: "front" or "rear".
    time: Datetimes  #: Shape (T,).
    #: Shape (M,).
    satellite: Strings
    signal: Strings
    chainage_m: Floats  #: Of the centreline point abeam the antenna, shape (T,).
    speed_mps: Floats  #: Negative toward falling chainage, shape (T,).
    antenna_ecef_m: Floats  #: Shape (T, 3).
    heading_deg: Floats  #: Azimuth of the vehicle's forward axis, shape (T,).
    #: Shape (T, M).
    elevation_deg: Floats
    azimuth_deg: Floats


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """Terms added to the observations, shapes (T, M)."""

    code_m: Floats  #: NaN where the signal is lost; all observables are then absent.
    phase_m: Floats
    doppler_hz: Floats
    cn0_db: Floats  #: Negative where the signal is attenuated.


#: A source of disturbances: a function of the geometry alone, so that results do not depend on the chunks.
Disturbances = Callable[[SightGeometry], Disturbance]


CN0_HORIZON_DBHZ: Final = 34.0
CN0_RISE_DB: Final = 16.0
CN0_SECOND_DB: Final = -3.0
