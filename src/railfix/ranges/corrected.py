"""Corrected pseudoranges of a log as plain arrays: the first stage by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Strings
from railfix.core.constants import CLOCK_GROUP
from railfix.gnss.navigation import Navigation, glonass_channels
from railfix.gnss.observations import Observations
from railfix.gnss.orbits import satellite_states
from railfix.gnss.signals import carrier_frequency_hz
from railfix.ranges.atmospheric_delays import SeenFrom, modelled_delays
from railfix.ranges.weights import (
    DEFAULT_SIGNALS,
    PLAUSIBLE_CODE_M,
    CodeNoise,
    NominalErrors,
    channel_order,
    code_sigma_m,
    first_available,
)


@dataclass(frozen=True, kw_only=True)
class CorrectedCodes:
    """Corrected pseudoranges of T epochs by K channels, those of one receiver clock side by side.

    Attributes
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    satellite, signal, clock : ndarray of str, shape (K,)
        Clock: letter of the receiver clock that a channel is measured with.
    column : ndarray of int, shape (K,)
        Channels of the observations.
    sat_ecef_m : ndarray, shape (T, K, 3) [m]
        Satellites at the time of transmission.
    code_m : ndarray, shape (T, K) [m]
        Pseudorange with satellite clock, group delay and atmosphere applied; NaN where there is none, where another
        signal of the satellite is used, or where no healthy record is valid.
    sigma_m : ndarray, shape (T, K) [m]
        Its standard deviation by C/N0, elevation and stated accuracy.
    elevation_deg, azimuth_deg : ndarray, shape (T, K)
    frequency_hz : ndarray, shape (K,)
    """

    time: Datetimes
    satellite: Strings
    signal: Strings
    clock: Strings
    column: np.ndarray[tuple[int, ...], np.dtype[np.intp]]
    sat_ecef_m: Floats
    code_m: Floats
    sigma_m: Floats
    elevation_deg: Floats
    azimuth_deg: Floats
    frequency_hz: Floats


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
    delays = modelled_delays(
        observations.time,
        seen,
        frequency,
        klobuchar=navigation.klobuchar.get("G", navigation.klobuchar.get("J")),
        troposphere=troposphere,
    )
    clean = code + states.clock_m - states.group_delay_m - delays.ionosphere_m - delays.troposphere_m
    stated = (nominal or NominalErrors()).stated_m(states.accuracy_m)
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
