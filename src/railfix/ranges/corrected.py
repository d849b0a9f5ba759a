"""Corrected pseudoranges of a log as plain arrays: the first stage by hand.

The sum of the variances is that of DO-229D (J.2.2), without the airborne receiver's: ``sigma_flt^2 +
sigma_UIRE^2 + sigma_tropo^2``. Multipath and receiver noise on a railway are added by the caller (P1 2.4).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from pydantic import Field

from railfix.core.arrays import Bits, Datetimes, Floats, Indices, Masks, Strings
from railfix.core.constants import CLOCK_GROUP, FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.reasons import Reason
from railfix.core.settings import Settings
from railfix.gnss.navigation import Navigation, glonass_channels
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.gnss.orbits import SatelliteStates, satellite_states
from railfix.ranges.atmosphere import (
    Delays,
    SeenFrom,
    model_delays,
    rtca_troposphere_m,
    rtca_troposphere_sigma_m,
    thin_shell_obliquity,
)
from railfix.ranges.sbas import IonosphereState, SatelliteCorrections, SatelliteState, SbasCorrections
from railfix.ranges.sbas.dfmc import DfmcCorrections, DfmcState, residual_ionosphere_m

#: A pseudorange lies between these [m]: nearest satellite less a receiver clock 33 ms off, GEO plus the same.
PLAUSIBLE_CODE_M: Final = (1e7, 1e8)


#: Signals near L1 in order of preference, RINEX 3 codes without the type letter.
DEFAULT_SIGNALS: Final[Mapping[str, tuple[str, ...]]] = {
    "G": ("1C", "1W", "1P", "1X", "1L", "1S"),
    "J": ("1C", "1X", "1L", "1S", "1Z"),
    "E": ("1C", "1X", "1B", "1Z", "1A"),
    "C": ("2I", "2X", "2Q"),
    "R": ("1C", "1P"),
}

#: Second signals in order of preference. L2 comes before L5 for GPS and QZSS: LNAV lacks the delay of L5
#: (`railfix.gnss.orbits.prepared_records.group_delay_sigma_m`).
SECOND_SIGNALS: Final[Mapping[str, tuple[str, ...]]] = {
    "G": ("2L", "2X", "2S", "2W", "5Q", "5X", "5I"),
    "J": ("2L", "2X", "2S", "5Q", "5X", "5I"),
    "E": ("5Q", "5X", "5I", "7Q", "7X", "7I"),
    "C": ("7I", "7Q", "7X", "6I", "6Q", "6X", "5P", "5X", "5D"),
}

#: Signals that SBAS on L5 corrects, first and second, by constellation.
DFMC_SIGNALS: Final[Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]] = {
    "G": (("1C",), ("5Q", "5X", "5I")),
    "E": (("1C", "1X", "1B"), ("5Q", "5X", "5I")),
    "C": (("1P", "1X", "1D"), ("5P", "5X", "5D")),
}

#: A C/N0 above the cap counts as the cap.
_CN0_REFERENCE_DBHZ: Final = 45.0
_CN0_CAP_DBHZ: Final = 50.0


class CodeNoise(Settings):
    """Standard deviation of a corrected pseudorange from C/N0 and elevation.

    ``sigma^2 = floor_sigma_m^2 + (zenith_sigma_m * 10^((cn0_reference - min(C/N0, cn0_cap)) / 20) / sin(el))^2``
    """

    model: Literal["cn0_elevation", "elevation"] = "cn0_elevation"  #: "elevation" leaves the C/N0 factor out.
    #: At the zenith and the reference C/N0. Only ratios matter to the position: its value for a receiver is estimated
    #: from the residuals (`pipeline.AntennaState`).
    zenith_sigma_m: float = Field(default=1.0, gt=0)
    #: Error floor: residual errors of satellite clock and orbit, ionosphere and troposphere.
    floor_sigma_m: float = Field(default=1.0, ge=0)


def code_sigma_m(cn0_dbhz: Floats, elevation_deg: Floats, *, noise: CodeNoise | None = None) -> Floats:
    """Return the sigma of corrected pseudoranges (T, M) [m]; NaN C/N0 is the reference; NaN at or below the horizon."""
    noise = noise or CodeNoise()
    sine = np.sin(np.radians(np.where(elevation_deg > 0.1, elevation_deg, np.nan)))
    sigma = noise.zenith_sigma_m / sine
    if noise.model == "cn0_elevation":
        cn0 = np.where(np.isnan(cn0_dbhz), _CN0_REFERENCE_DBHZ, np.minimum(cn0_dbhz, _CN0_CAP_DBHZ))
        sigma = sigma * np.exp((_CN0_REFERENCE_DBHZ - cn0) * (np.log(10.0) / 20.0))
    return np.asarray(np.hypot(sigma, noise.floor_sigma_m))


#: Accuracies of records (URA, SISA) up to this stand for `satellite_sigma_m`: 2 to 4.85 m are usual. A worse one is
#: believed: it is added to the sigma of the satellite's ranges.
_USUAL_ACCURACY_M: Final = 5.0


class NominalErrors(Settings):
    """Assumed standard deviations of the errors that a local error model does not cover, where SBAS gives none.

    ``sigma^2 = satellite^2 + (ionosphere F(el))^2 + (troposphere m(el))^2`` with the mappings of DO-229D
    (A.4.4.10.4 and A.4.2.4).
    """

    #: Orbit and clock in the range; GPS and Galileo stay near half a metre, their service definitions promise 2 m and
    #: 95 % of the time less.
    satellite_sigma_m: float = Field(default=0.8, ge=0)
    #: Vertical delay that Klobuchar's model leaves. Mostly common to all satellites, taken as independent.
    ionosphere_sigma_m: float = Field(default=1.0, ge=0)
    #: Added to it, and to the ranges, with typical coefficients: what the two models differ by.
    typical_ionosphere_sigma_m: float = Field(default=2.0, ge=0)
    #: Vertical delay that the standard atmosphere leaves (DO-229D A.4.2.4).
    troposphere_sigma_m: float = Field(default=0.12, ge=0)

    def sigma_m(self, elevation_deg: Floats) -> Floats:
        """Return the standard deviation at elevations, any shape [m]; NaN below the horizon."""
        sine = np.sin(np.radians(np.where(elevation_deg > 0.1, elevation_deg, np.nan)))
        wet = 1.001 / np.sqrt(0.002001 + sine**2)
        parts = (self.satellite_sigma_m**2, (self.ionosphere_sigma_m * thin_shell_obliquity(elevation_deg)) ** 2)
        return np.asarray(np.sqrt(sum(parts) + (self.troposphere_sigma_m * wet) ** 2))

    def unusual_sigma_m(self, accuracy_m: Floats) -> Floats:
        """Accuracies of records, any shape, where they are worse than usual; 0 for the others and for unknown ones."""
        return np.where(accuracy_m > _USUAL_ACCURACY_M, accuracy_m, 0.0)


def channel_order(
    satellite: Strings, signal: Strings, *, systems: Sequence[str], signals: Mapping[str, Sequence[str]]
) -> Indices:
    """Return channels that may be used, those of one clock side by side, by preference of `signals`, shape (K,)."""
    keys = []
    for i, (name, code) in enumerate(zip(satellite.tolist(), signal.tolist(), strict=True)):
        letter = name[0]
        preference = signals.get(letter, ())
        if letter in systems and code in preference:
            keys.append((CLOCK_GROUP[letter], name, preference.index(code), i))
    return np.array([key[-1] for key in sorted(keys)], dtype=np.intp)


def first_available(satellite: Strings, available: Masks) -> Masks:
    """Choose one channel a satellite and epoch: the first available one, in `channel_order`, shape (T, K)."""
    starts = np.flatnonzero(np.append(True, satellite[1:] != satellite[:-1])) if len(satellite) else np.empty(0, int)
    if len(starts) == len(satellite):
        return available.copy()
    count = np.cumsum(available, axis=1)
    before = np.where(starts > 0, count[:, starts - 1], 0)
    offset = np.repeat(before, np.diff(np.append(starts, len(satellite))), axis=1)
    return np.asarray(available & (count - offset == 1))


@dataclass(frozen=True, kw_only=True)
class CorrectedCodes:
    """Corrected pseudoranges of T epochs by K channels, those of one receiver clock side by side."""

    time: Datetimes  #: Shape (T,).
    #: Clock: letter of the receiver clock that a channel is measured with; shape (K,).
    satellite: Strings
    signal: Strings
    clock: Strings
    column: np.ndarray[tuple[int, ...], np.dtype[np.intp]]  #: Channels of the observations, shape (K,).
    sat_ecef_m: Floats  #: Satellites at the time of transmission, shape (T, K, 3).
    #: Pseudorange with satellite clock, group delay and atmosphere applied; NaN where there is none, where another
    #: signal of the satellite is used, or where no healthy record is valid; shape (T, K).
    code_m: Floats
    sigma_m: Floats  #: Its standard deviation by C/N0, elevation and stated accuracy; shape (T, K).
    #: Shape (T, K).
    elevation_deg: Floats
    azimuth_deg: Floats
    frequency_hz: Floats  #: Shape (K,).


def corrected_ranges(
    observations: Observations,
    navigation: Navigation,
    near_ecef_m: Floats,
    *,
    systems: Sequence[str] = ("G", "J", "E"),
    signals: Mapping[str, Sequence[str]] = DEFAULT_SIGNALS,
    troposphere: Literal["saastamoinen", "off"] = "saastamoinen",
    noise: CodeNoise | None = None,
    nominal: NominalErrors | None = None,
) -> CorrectedCodes:
    """Correct the pseudoranges of a log by broadcast records, Klobuchar's model and the standard atmosphere.

    Parameters
    ----------
    observations : Observations
    navigation : Navigation
        The ionosphere is left uncorrected without coefficients of GPS or QZSS.
    near_ecef_m : ndarray, shape (3,) or (T, 3) [m]
        Place of the antenna to some hundred metres, for directions and atmosphere.
    systems : sequence of str
        Letters of the constellations used.
    signals : mapping of str to sequence of str
        Signals of each constellation in order of preference, as RINEX 3 codes without the type letter.
    troposphere : {"saastamoinen", "off"}
    noise : CodeNoise, optional
    nominal : NominalErrors, optional
        Says which accuracies of records are usual; worse ones are in the sigmas.
    """
    column = channel_order(observations.satellite, observations.signal, systems=systems, signals=signals)
    satellite, signal = observations.satellite[column], observations.signal[column]
    glonass = {**glonass_channels(navigation), **observations.header.glonass_channel}
    frequency = carrier_frequency_hz(satellite, signal, glonass)
    code = observations.code_m[:, column]
    plausible = (code > PLAUSIBLE_CODE_M[0]) & (code < PLAUSIBLE_CODE_M[1])
    states = satellite_states(observations.time, satellite, signal, code, navigation)
    near = np.broadcast_to(np.asarray(near_ecef_m, dtype=np.float64), (len(observations), 3))
    seen = SeenFrom.of(near, states.position_ecef_m)
    delays = model_delays(
        observations.time,
        seen,
        frequency,
        klobuchar=navigation.klobuchar.get("G", navigation.klobuchar.get("J")),
        troposphere=troposphere,
    )
    clean = code + states.clock_m - states.group_delay_m - delays.ionosphere_m - delays.troposphere_m
    stated = (nominal or NominalErrors()).unusual_sigma_m(states.accuracy_m)
    sigma = np.hypot(code_sigma_m(observations.cn0_dbhz[:, column], seen.elevation_deg, noise=noise), stated)
    used = first_available(satellite, plausible) & ~states.unhealthy & np.isfinite(sigma)
    return CorrectedCodes(
        time=observations.time,
        satellite=satellite,
        signal=signal,
        clock=np.array([CLOCK_GROUP[name[0]] for name in satellite.tolist()], dtype="<U1"),
        column=column,
        sat_ecef_m=states.position_ecef_m,
        code_m=np.where(used, clean, np.nan),
        sigma_m=np.where(used, sigma, np.nan),
        elevation_deg=seen.elevation_deg,
        azimuth_deg=seen.azimuth_deg,
        frequency_hz=frequency,
    )


SBAS_SIGNAL: Final = "1C"  #: The signal that corrections are made for: GPS L1 C/A, as RINEX 3 calls it.

_REASON_OF: Final = {
    **dict.fromkeys(SatelliteState, Reason.SBAS_NO_CORRECTION),
    SatelliteState.OK: Reason.USED,
    SatelliteState.NOT_IN_MASK: Reason.SBAS_NOT_COVERED,
    SatelliteState.TIMED_OUT: Reason.SBAS_TIMED_OUT,
    SatelliteState.GEO_STOPPED: Reason.SBAS_DO_NOT_USE,
    SatelliteState.DO_NOT_USE: Reason.SBAS_DO_NOT_USE,
    SatelliteState.NOT_MONITORED: Reason.SBAS_DO_NOT_USE,
    SatelliteState.UDREI_TOO_LARGE: Reason.SBAS_DO_NOT_USE,
}
#: Reason of each state of a satellite, by its number.
REASONS: Final = np.array([int(_REASON_OF[state]) for state in sorted(SatelliteState)], dtype=np.int64)


_DFMC_REASON_OF: Final = {
    **dict.fromkeys(DfmcState, Reason.SBAS_NO_CORRECTION),
    DfmcState.OK: Reason.USED,
    DfmcState.NOT_IN_MASK: Reason.SBAS_NOT_COVERED,
    DfmcState.TIMED_OUT: Reason.SBAS_TIMED_OUT,
    DfmcState.STOPPED: Reason.SBAS_DO_NOT_USE,
    DfmcState.DO_NOT_USE: Reason.SBAS_DO_NOT_USE,
}
#: The same of SBAS on L5.
DFMC_REASONS: Final = np.array([int(_DFMC_REASON_OF[state]) for state in sorted(DfmcState)], dtype=np.int64)


def apply_dfmc(
    states: SatelliteStates, fixes: DfmcCorrections, satellite: Strings, signal: Strings
) -> tuple[SatelliteStates, Bits]:
    """Return satellites with the corrections of SBAS on L5 applied, and the reasons of those without, shape (T, K)."""
    covered = [code in DFMC_SIGNALS.get(name[0], ((),))[0] for name, code in zip(satellite, signal, strict=True)]
    moved, clock = states.position_ecef_m + fixes.position_m, states.clock_m + fixes.clock_m
    reason = np.where(covered, DFMC_REASONS[fixes.state], int(Reason.SBAS_NOT_COVERED))
    return replace(states, position_ecef_m=moved, clock_m=clock), reason


def dfmc_delays(fixes: DfmcCorrections, time: Datetimes, seen: SeenFrom, modelled: Delays) -> Delays:
    """Troposphere of DO-229D, with the sigma of corrected ionosphere-free codes; the modelled ionosphere cancels there.

    ``sigma^2 = sigma_corrections^2 + sigma_ionosphere^2 + sigma_troposphere^2`` (ED-259A), without the receiver's.
    """
    sight = seen.satellite_ecef_m - seen.receiver_ecef_m[:, None, :]
    along = fixes.sigma_along_m(sight / np.linalg.norm(sight, axis=-1, keepdims=True))
    elevation = seen.elevation_deg
    variance = along**2 + residual_ionosphere_m(elevation) ** 2 + rtca_troposphere_sigma_m(elevation) ** 2
    return Delays(
        ionosphere_m=modelled.ionosphere_m,
        troposphere_m=rtca_troposphere_m(time, seen.latitude_deg, seen.height_m, elevation),
        sigma_m=np.where(fixes.state == DfmcState.OK, np.sqrt(variance), np.nan),
        reason=np.zeros(fixes.state.shape, dtype=np.int64),
    )


def apply_long_term(states: SatelliteStates, fixes: SatelliteCorrections) -> tuple[SatelliteStates, Bits]:
    """Satellites with long-term corrections applied to the records they are for, and reasons of the others (T, K)."""
    moved = states.position_ecef_m + np.nan_to_num(fixes.position_m)
    clock = states.clock_m + SPEED_OF_LIGHT * np.nan_to_num(fixes.clock_s)
    return replace(states, position_ecef_m=moved, clock_m=clock), REASONS[fixes.state]


def sbas_delays(
    sbas: SbasCorrections, fixes: SatelliteCorrections, time: Datetimes, seen: SeenFrom, frequency_hz: Floats
) -> Delays:
    """Delays from the SBAS grid and DO-229D's troposphere, with the sigma of the corrected codes; others rejected."""
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
