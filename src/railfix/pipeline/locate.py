"""Positions and ranges of a log without a track map: conventional positions, epochs of a survey."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, join_rows
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.core.timescale import seconds
from railfix.gnss.observations import Observations
from railfix.gnss.orbits import SatelliteStates, satellite_states
from railfix.pipeline.channels import ChannelBook, Channels
from railfix.pipeline.config import Config
from railfix.pipeline.corrected_ranges import ANCHOR_SIGMA_M, usable_ranges, without
from railfix.pipeline.received import Received
from railfix.positioning.carrier import CycleSlipState, corrected_phase_m, find_slips
from railfix.positioning.noise_scale import robust_fit
from railfix.positioning.normal_equations import Ranges, single_point
from railfix.ranges.atmosphere import SeenFrom, model_delays
from railfix.ranges.corrected import PLAUSIBLE_CODE_M, code_sigma_m, first_available
from railfix.track.survey.runs import RunSignals, SurveyLimits, SurveyRun, rows_apart

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
    """Return corrected ranges of one antenna without a track: the approximate place is that of the codes alone."""
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
    delays = model_delays(
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
    sigma = np.hypot(sigma, config.nominal.unusual_sigma_m(states.accuracy_m))
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
    """Compute the conventional position of every epoch, ranges that disagree left out; see `uncorrected_ranges`."""
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


#: Steps longer than so many intervals have no changes: Dopplers at both ends tell too little.
_LONGEST_STEP: Final = 2.5
#: Standard deviation of a change by Dopplers from the curvature of the motion [m/s^2].
_CURVED_MPS2: Final = 0.05


def survey_run(
    parts: Iterable[Observations], received: Received, config: Config, limits: SurveyLimits, *, name: str
) -> SurveyRun:
    """Return the run of a log, read part by part, with its ranges and their changes.

    Between two parts there is no change. ValueError: fewer than three epochs have a position.
    """
    book, slips = ChannelBook(config), None
    runs: list[SurveyRun] = []
    signals: list[RunSignals] = []
    for part in parts:
        if len(part):
            run, own, slips = _survey_part(part, received, config, limits, book, slips)
            before = sum(map(len, runs))
            signals.append(replace(own, row=own.row + before, step=own.step + before))
            runs.append(run)
    if sum(int(np.isfinite(run.ecef_m[:, 0]).sum()) for run in runs) < 3:
        raise ValueError("fewer than three epochs have a position; are the navigation files of the day of the log?")
    return replace(join_rows(runs), name=name, signals=join_rows(signals))


def _survey_part(
    obs: Observations,
    received: Received,
    config: Config,
    limits: SurveyLimits,
    book: ChannelBook,
    slip_state: CycleSlipState | None,
) -> tuple[SurveyRun, RunSignals, CycleSlipState | None]:
    """Return the run of some observations, thinned to the interval of the survey, and the state of the slips.

    A range changes by the carrier phase where it goes on without a slip at every epoch between, else by the mean of
    the Dopplers at both ends.
    """
    seen = uncorrected_ranges(obs, received, config, book)
    located = locate_ranges(obs.time, seen, config)
    slips, after = find_slips(obs, slip_state, frequency_hz=seen.channels.every_frequency_hz, limits=config.slips)
    columns = seen.channels.columns
    usable = seen.ranges.weight > 0
    nothing = np.zeros(usable.shape)
    phase = corrected_phase_m(slips.phase_m[:, columns], seen.states.clock_m, nothing, nothing)
    rate = -SPEED_OF_LIGHT / seen.channels.frequency_hz * obs.doppler_hz[:, columns]
    broken = np.cumsum(slips.slip[:, columns] | obs.break_before[:, None], axis=0, dtype=np.intp)
    rows = rows_apart(obs.time, limits.interval_s)
    time, cn0_dbhz = obs.time[rows], obs.cn0_dbhz[:, columns]
    weak = 10.0 ** ((45.0 - np.where(np.isnan(cn0_dbhz), 45.0, np.minimum(cn0_dbhz, 50.0))) / 10.0)
    used, position, weak = usable[rows], seen.states.position_ecef_m[rows], weak[rows]
    step_s = seconds(np.diff(time))[:, None]
    both = used[1:] & used[:-1] & (step_s <= _LONGEST_STEP * limits.interval_s)
    phase, rate, broken = phase[rows], rate[rows], broken[rows]
    by_phase = np.diff(phase, axis=0)
    by_doppler = 0.5 * (rate[1:] + rate[:-1]) * step_s
    joined = both & np.isfinite(by_phase) & (np.diff(broken, axis=0) == 0)
    doppler = both & np.isfinite(by_doppler) & ~joined
    weak = 0.5 * (weak[1:] + weak[:-1])
    noise = config.tracking
    phase_m = np.sqrt(noise.phase_floor_m**2 + noise.phase_zenith_m**2 * weak)
    doppler_m = np.hypot(
        np.sqrt(noise.doppler_floor_mps**2 + noise.doppler_zenith_mps**2 * weak) * step_s, _CURVED_MPS2 * step_s**2
    )
    clock = np.zeros(used.shape[1], dtype=np.intp)
    for number, group in enumerate(seen.channels.groups):
        clock[group] = number
    row, channel = np.nonzero(used)
    step, of_step = np.nonzero(joined | doppler)
    signals = RunSignals(
        row=row,
        sat_ecef_m=position[row, channel],
        code_m=seen.ranges.code_m[rows][row, channel],
        sigma_m=1.0 / np.sqrt(seen.ranges.weight[rows][row, channel]),
        clock=clock[channel],
        step=step,
        before_ecef_m=position[step, of_step],
        after_ecef_m=position[step + 1, of_step],
        change_m=np.where(joined, by_phase, by_doppler)[step, of_step],
        change_sigma_m=np.where(joined, phase_m, doppler_m)[step, of_step],
        by_doppler=doppler[step, of_step],
    )
    sigma = np.nan_to_num(located.sigma_m[rows][:, [1, 0, 2]], nan=1.0)
    return SurveyRun(name="", time=time, ecef_m=located.ecef_m[rows], sigma_m=sigma), signals, after
