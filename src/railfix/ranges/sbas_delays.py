"""SBAS corrections applied: satellites, delays with their sigma, reasons for rejection.

The sum of the variances is that of DO-229D (J.2.2), without the airborne receiver's: ``sigma_flt^2 +
sigma_UIRE^2 + sigma_tropo^2``. Multipath and receiver noise on a railway are added by the caller (P1 2.4).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from railfix.core.arrays import Bits, Datetimes, Floats
from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.reasons import Reason
from railfix.gnss.orbits import SatelliteStates
from railfix.ranges.atmosphere import rtca_troposphere_m, rtca_troposphere_sigma_m
from railfix.ranges.atmospheric_delays import Delays, SeenFrom
from railfix.ranges.sbas import (
    IonosphereState,
    SatelliteCorrections,
    SatelliteState,
    SbasCorrections,
)

#: The signal that corrections are made for: GPS L1 C/A, as RINEX 3 calls it.
SBAS_SIGNAL: Final = "1C"

_REASON_OF: Final = {
    SatelliteState.OK: Reason.USED,
    SatelliteState.GEO_STOPPED: Reason.SBAS_DO_NOT_USE,
    SatelliteState.NO_MASK: Reason.SBAS_NO_CORRECTION,
    SatelliteState.NOT_IN_MASK: Reason.SBAS_NOT_COVERED,
    SatelliteState.NO_FAST: Reason.SBAS_NO_CORRECTION,
    SatelliteState.DO_NOT_USE: Reason.SBAS_DO_NOT_USE,
    SatelliteState.NOT_MONITORED: Reason.SBAS_DO_NOT_USE,
    SatelliteState.TIMED_OUT: Reason.SBAS_TIMED_OUT,
    SatelliteState.UDREI_TOO_LARGE: Reason.SBAS_DO_NOT_USE,
    SatelliteState.NO_LONG_TERM: Reason.SBAS_NO_CORRECTION,
    SatelliteState.IODE_MISMATCH: Reason.SBAS_NO_CORRECTION,
    SatelliteState.NO_DEGRADATION: Reason.SBAS_NO_CORRECTION,
    SatelliteState.NO_RANGE_RATE: Reason.SBAS_NO_CORRECTION,
}
#: Reason of each state of a satellite, by its number.
REASONS: Final = np.array([int(_REASON_OF[state]) for state in sorted(SatelliteState)], dtype=np.int64)


def corrected_satellites(states: SatelliteStates, fixes: SatelliteCorrections) -> tuple[SatelliteStates, Bits]:
    """Satellites with long-term corrections applied, and the reasons of those without corrections.

    Parameters
    ----------
    states : SatelliteStates
        Of the records that the corrections are for.
    fixes : SatelliteCorrections

    Returns
    -------
    SatelliteStates
    ndarray of int64, shape (T, K)
    """
    moved = states.position_ecef_m + np.nan_to_num(fixes.position_m)
    clock = states.clock_m + SPEED_OF_LIGHT * np.nan_to_num(fixes.clock_s)
    return replace(states, position_ecef_m=moved, clock_m=clock), REASONS[fixes.state]


def sbas_delays(
    sbas: SbasCorrections,
    fixes: SatelliteCorrections,
    time: Datetimes,
    seen: SeenFrom,
    frequency_hz: Floats,
) -> Delays:
    """Delays from the SBAS grid and the troposphere of DO-229D, with the sigma of the corrected codes.

    Computed for the channels that have a correction at any of the epochs; the others are rejected.

    Parameters
    ----------
    sbas : SbasCorrections
    fixes : SatelliteCorrections
    time : ndarray of datetime64[ns], shape (T,)
    seen : SeenFrom
    frequency_hz : ndarray, shape (K,) [Hz]

    Returns
    -------
    Delays
    """
    shape = fixes.state.shape
    ionosphere, troposphere, sigma = np.full((3, *shape), np.nan)
    reason = np.zeros(shape, dtype=np.int64)
    some = np.flatnonzero((fixes.state == SatelliteState.OK).any(axis=0))
    if len(some):
        part = fixes.take_satellites(some)
        latitude, longitude, height = seen.latitude_deg, seen.longitude_deg, seen.height_m
        elevation, azimuth = seen.elevation_deg[:, some], seen.azimuth_deg[:, some]
        grid = sbas.ionosphere(time, latitude, longitude, elevation, azimuth)
        sight = seen.satellite_ecef_m[:, some] - seen.receiver_ecef_m[:, None, :]
        sight = sight / np.linalg.norm(sight, axis=-1, keepdims=True)
        flt = part.sigma_flt_m(sbas.delta_udre(time, part, sight, latitude, longitude))
        scale = (FREQUENCY_L1 / frequency_hz[some]) ** 2
        known = (grid.state == IonosphereState.OK) & np.isfinite(grid.sigma_uire_m)
        variance = flt**2 + (scale * grid.sigma_uire_m) ** 2 + rtca_troposphere_sigma_m(elevation) ** 2
        unknown = np.where(known, 0, int(Reason.SBAS_NO_IONOSPHERE))
        corrected = part.state == SatelliteState.OK
        ionosphere[:, some] = scale * np.where(known & corrected, grid.delay_m, np.nan)
        troposphere[:, some] = np.where(corrected, rtca_troposphere_m(time, latitude, height, elevation), np.nan)
        sigma[:, some] = np.where(corrected, np.sqrt(variance), np.nan)
        reason[:, some] = np.where(corrected, unknown, 0)
    return Delays(ionosphere_m=ionosphere, troposphere_m=troposphere, sigma_m=sigma, reason=reason)
