"""Conventional 3-D positions of one antenna without a track map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.gnss.observations import Observations
from railfix.gnss.orbits import SatelliteStates, satellite_states
from railfix.pipeline.channels import ChannelBook, Channels
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import ANCHOR_SIGMA_M, usable_ranges, without
from railfix.pipeline.received import Received
from railfix.positioning.constrained import single_point
from railfix.positioning.noise_scale import robust_fit
from railfix.positioning.normal_equations import Ranges
from railfix.ranges.atmosphere import SeenFrom, modelled_delays
from railfix.ranges.weights import PLAUSIBLE_CODE_M, code_sigma_m, first_available

_EARTH_RADIUS_M: Final = 6.371e6
#: Degrees of freedom from which residuals scale the standard deviation of an epoch.
_LEAST_REDUNDANCY: Final = 2


@dataclass(frozen=True, kw_only=True)
class Located:
    """3-D positions of one antenna, T epochs."""

    time: Datetimes  #: Shape (T,).
    ecef_m: Floats  #: NaN where there is no position, shape (T, 3).
    #: Standard deviations north, east and up: from the sigmas of the ranges, atmosphere and orbits included, and larger
    #: where the residuals are; shape (T, 3).
    sigma_m: Floats
    n_used: Integers  #: Shape (T,).


@dataclass(frozen=True, kw_only=True)
class UncorrectedRanges:
    """Corrected ranges of one antenna seen from an approximate place, T epochs by K channels."""

    channels: Channels
    ranges: Ranges  #: Weight 0 where a range cannot be used.
    states: SatelliteStates
    #: Shape (T, K).
    elevation_deg: Floats
    azimuth_deg: Floats
    place_ecef_m: Floats  #: The approximate place; NaN where the codes give none; shape (T, 3).


def uncorrected_ranges(obs: Observations, received: Received, config: Config, book: ChannelBook) -> UncorrectedRanges:
    """Corrected ranges of one antenna without a track: the approximate place is that of the codes alone.

    Parameters
    ----------
    received : Received
        Navigation records and coefficients.
    config : Config
        Constellations, signals, mask, noise and atmosphere.
    """
    channels = book.of(obs, received.navigation)
    satellite, columns = channels.satellite, channels.columns
    code, cn0 = obs.code_m[:, columns], obs.cn0_dbhz[:, columns]
    plausible = (code > PLAUSIBLE_CODE_M[0]) & (code < PLAUSIBLE_CODE_M[1])
    usable = plausible & first_available(satellite, plausible)
    states = satellite_states(
        obs.time, satellite, channels.signal, code, received.navigation, max_age_s=config.max_ephemeris_age_s
    )
    usable &= ~(states.no_record | states.too_old | states.unhealthy)
    clean = code + states.clock_m - states.group_delay_m
    reason = np.where(usable, 0, 1)
    raw = usable_ranges(states, clean, np.array(1.0 / ANCHOR_SIGMA_M**2), reason, channels.groups)
    place = single_point(raw, _below(raw), limits=config.single_point).ecef_m
    seen = SeenFrom.of(np.where(np.isnan(place), _below(raw), place), states.position_ecef_m)
    delays = modelled_delays(
        obs.time,
        seen,
        channels.frequency_hz,
        klobuchar=received.klobuchar,
        ionosphere_sigma_m=received.ionosphere_sigma_m,
        troposphere=config.troposphere,
    )
    clean = clean - delays.ionosphere_m - delays.troposphere_m
    sigma = np.hypot(code_sigma_m(cn0, seen.elevation_deg, noise=config.noise), delays.sigma_m)
    sigma = np.hypot(sigma, config.nominal.sigma_m(seen.elevation_deg))
    sigma = np.hypot(sigma, config.nominal.stated_m(states.accuracy_m))
    usable &= seen.elevation_deg >= config.elevation.mask_deg
    ranges = usable_ranges(states, clean, 1.0 / sigma**2, np.where(usable, 0, 1), channels.groups)
    return UncorrectedRanges(
        channels=channels,
        ranges=ranges,
        states=states,
        elevation_deg=seen.elevation_deg,
        azimuth_deg=seen.azimuth_deg,
        place_ecef_m=place,
    )


def locate(obs: Observations, received: Received, config: Config, book: ChannelBook) -> Located:
    """Compute the conventional position of every epoch, ranges that disagree left out.

    Parameters
    ----------
    obs, received, config, book
        As for `uncorrected_ranges`.
    """
    return locate_ranges(obs.time, uncorrected_ranges(obs, received, config, book), config)


def locate_ranges(time: Datetimes, seen: UncorrectedRanges, config: Config) -> Located:
    """Compute the conventional position of every epoch from corrected ranges; see `locate`."""
    ranges = seen.ranges
    start = np.where(np.isnan(seen.place_ecef_m), _below(ranges), seen.place_ecef_m)
    fit = robust_fit(ranges, start, limits=config.robust_fit)
    ranges = without(ranges, (ranges.weight > 0) & ~fit.kept)
    point = single_point(ranges, start, limits=config.single_point)
    freedom = ranges.n_used - ranges.n_clocks - 3
    scale = np.where(freedom >= _LEAST_REDUNDANCY, point.wsse / np.maximum(freedom, 1), 1.0)
    sigma = np.full((len(time), 3), np.nan)
    known = np.flatnonzero(np.isfinite(point.ecef_m[:, 0]))
    if len(known):
        latitude, longitude, _ = geodetic_from_ecef(point.ecef_m[known[0]])
        axes = enu_axes(latitude, longitude)[[1, 0, 2]]
        variance = np.einsum("ai,tij,aj->ta", axes, point.covariance_m2, axes)
        sigma = np.sqrt(variance * np.maximum(scale, 1.0)[:, None])
    return Located(time=time, ecef_m=point.ecef_m, sigma_m=sigma, n_used=ranges.n_used)


def _below(ranges: Ranges) -> Floats:
    """The point of the Earth's surface below the mean of the satellites, shape (T, 3) [m]: a start for the fit."""
    weight = (ranges.weight > 0).astype(np.float64)
    mean = np.einsum("tk,tki->ti", weight, ranges.sat_ecef_m) + np.array([1.0, 0.0, 0.0])
    return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True) * _EARTH_RADIUS_M)
