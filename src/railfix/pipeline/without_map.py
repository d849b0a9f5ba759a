"""Positions and ranges of a log without a track map, for conventional positions and for surveys."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final

import numpy as np

from railfix.core.arrays import Codes, Datetimes, Floats, Integers, Masks, join_rows
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.core.reasons import Reason
from railfix.core.timescale import seconds
from railfix.gnss.observations import Observations
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.range_stage import raw_ranges
from railfix.pipeline.received import Received, broadcast_source, with_base_station
from railfix.positioning.carrier import CycleSlipState, corrected_phase_m, find_slips
from railfix.positioning.gross_errors import GROSS_M, disagreeing, gross_in_space
from railfix.positioning.igg3_fit import robust_fit
from railfix.positioning.normal_equations import SinglePoint, point_position
from railfix.positioning.range_arrays import Ranges, weighted_ranges, without
from railfix.ranges.corrected import CorrectedRanges, corrected_ranges, find_satellites
from railfix.track.survey.runs import RunSignals, SurveyLimits, SurveyRun, rows_apart

_EARTH_RADIUS_M: Final = 6.371e6
#: Positions outside this range of ellipsoidal heights count as wrong [m]; it covers receivers on land and in aircraft.
_HEIGHTS_M: Final = (-500.0, 10_000.0)
#: Heights are clipped to this range for the tropospheric model [m].
_MODELLED_HEIGHTS_M: Final = (-100.0, 10_000.0)
#: Gross errors are searched for only if the rms of the residuals, before atmospheric corrections, exceeds this [m].
_QUIET_M: Final = 10.0


class NoPosition(IntEnum):
    """Reason why an epoch has no position."""

    #: The epoch has a position.
    NONE = 0
    #: No pseudorange was observed.
    NO_CODE = 1
    #: Too few satellites have a valid and healthy record in the navigation files.
    NO_RECORD = 2
    #: There are fewer usable satellites than unknowns: three coordinates and one clock per constellation.
    TOO_FEW_SATELLITES = 3
    #: The ranges do not determine a position, or the iteration did not converge.
    NO_CONVERGENCE = 4
    #: The ranges are inconsistent by more than 100 m, and no exclusion restores consistency.
    INCONSISTENT = 5
    #: The position is below -500 m or above 10 km.
    IMPLAUSIBLE_HEIGHT = 6

    @property
    def text(self) -> str:
        """Reason in words."""
        return _TEXTS[self]


_TEXTS: Final = {
    NoPosition.NONE: "position",
    NoPosition.NO_CODE: "no pseudorange observed",
    NoPosition.NO_RECORD: "too few satellites with a valid and healthy navigation record",
    NoPosition.TOO_FEW_SATELLITES: "too few usable satellites",
    NoPosition.NO_CONVERGENCE: "satellite geometry without a solution",
    NoPosition.INCONSISTENT: "ranges contradict each other by over 100 m",
    NoPosition.IMPLAUSIBLE_HEIGHT: "height below -500 m or above 10 km",
}


@dataclass(frozen=True, kw_only=True)
class Located:
    """3-D positions of one antenna, T epochs."""

    time: Datetimes  #: Time tags, shape (T,).
    ecef_m: Floats  #: Antenna positions, NaN if unknown, shape (T, 3).
    #: Standard deviations north, east and up, shape (T, 3), from range sigmas that include atmospheric and orbit
    #: errors. They are scaled up if residuals are large.
    sigma_m: Floats
    n_used: Integers  #: Number of satellites used, shape (T,).
    no_position: Codes  #: `NoPosition` of each epoch, shape (T,).


@dataclass(frozen=True, kw_only=True)
class RangesWithoutMap:
    """Corrected ranges of one antenna at an approximate position, T epochs by K channels."""

    corrected: CorrectedRanges
    #: Ranges with sigmas that include satellite and atmospheric errors; ranges that must not be fitted have weight 0.
    ranges: Ranges
    near_ecef_m: Floats  #: Approximate position, shape (T, 3); NaN if the codes determine none.
    no_position: Codes  #: `NoPosition` from the numbers of codes, records and satellites; shape (T,).


#: Codes with one of these rejection reasons count as not observed.
_OF_CODES: Final = int(Reason.NOT_OBSERVED | Reason.IMPLAUSIBLE_CODE | Reason.OTHER_SIGNAL_TAKEN)


def ranges_without_map(obs: Observations, received: Received, config: Config, book: ChannelBook) -> RangesWithoutMap:
    """Return an antenna's corrected ranges, computed without a track, and approximate positions from the codes.

    The ranges are corrected by the delay models and by received base station errors, but not by SBAS.
    """
    channels = book.of(obs, received.navigation)
    source = with_base_station(replace(broadcast_source(received, config), second="none"), received, config)
    satellites = find_satellites(obs, channels, source, max_age_s=config.max_ephemeris_age_s)
    raw = raw_ranges(obs, channels, satellites)
    observed, implausible = (satellites.reason & _OF_CODES) == 0, int(Reason.NOT_OBSERVED | Reason.IMPLAUSIBLE_CODE)
    near, gross, apart = _approximate_position(raw, config)
    seen_from = _at_surface(np.where(np.isnan(near), _below(raw), near))
    corrected = corrected_ranges(obs, channels, satellites, seen_from, source, gross=gross, noise=config.noise)
    sigma = np.hypot(corrected.sigma_m, corrected.nominal_elevation_sigma_m)
    position, code = corrected.satellites.position_ecef_m, corrected.used_code_m
    # satellites below the mask help to identify the wrong ranges
    wrong = disagreeing(weighted_ranges(position, code, sigma, channels.clock), seen_from)
    code = np.where(wrong | ~(corrected.elevation_deg >= config.elevation.mask_deg), np.nan, code)
    ranges = weighted_ranges(position, code, sigma, channels.clock)
    no_position = np.zeros(len(obs), dtype=np.int8)
    for failed, cause in (
        (((satellites.reason & implausible) != 0).all(axis=1), NoPosition.NO_CODE),
        (~_solvable(replace(raw, weight=observed.astype(np.float64))), NoPosition.TOO_FEW_SATELLITES),
        (~_solvable(raw), NoPosition.NO_RECORD),
        (apart, NoPosition.INCONSISTENT),
        (np.isfinite(near[:, 0]) & ~_plausible_height(near), NoPosition.IMPLAUSIBLE_HEIGHT),
        (~_solvable(ranges), NoPosition.TOO_FEW_SATELLITES),
    ):
        no_position = np.where(failed & (no_position == 0), np.int8(cause), no_position)
    return RangesWithoutMap(corrected=corrected, ranges=ranges, near_ecef_m=near, no_position=no_position)


def _solvable(ranges: Ranges) -> Masks:
    """Return the epochs with at least as many satellites as unknowns, shape (T,)."""
    return np.asarray(ranges.space_redundancy >= 0)


def _approximate_position(raw: Ranges, config: Config) -> tuple[Floats, Masks, Masks]:
    """Return positions from raw ranges (T, 3), and masks of gross errors (T, M) and of inconsistent epochs (T,).

    Unknown positions are NaN.
    """
    start = _below(raw)
    point = point_position(raw, start, limits=config.single_point)
    place, gross, rms = point.ecef_m.copy(), np.zeros(raw.weight.shape, dtype=np.bool_), _rms_m(raw, point)
    suspect = np.flatnonzero(~(rms < _QUIET_M) | ~_plausible_height(place))
    if len(suspect):
        part = raw.take(suspect)
        gross[suspect] = gross_in_space(part, start[suspect])
        part = without(part, gross[suspect])
        again = point_position(part, start[suspect], limits=config.single_point)
        place[suspect], rms[suspect] = again.ecef_m, _rms_m(part, again)
    return place, gross, rms > GROSS_M


def _rms_m(ranges: Ranges, point: SinglePoint) -> Floats:
    """Return the root of (sum of squared residuals / redundancy), shape (T,) [m]; 0 without redundancy."""
    freedom = ranges.space_redundancy
    square = np.where(ranges.weight > 0, point.residual_m, 0.0) ** 2
    return np.asarray(np.where(freedom >= 1, np.sqrt(square.sum(axis=1) / np.maximum(freedom, 1)), 0.0))


def _plausible_height(ecef_m: Floats) -> Masks:
    """Return the mask of positions at plausible receiver heights; false for NaN; shape (T,)."""
    height = geodetic_from_ecef(ecef_m)[2]
    return np.asarray((height >= _HEIGHTS_M[0]) & (height <= _HEIGHTS_M[1]))


def _at_surface(ecef_m: Floats) -> Floats:
    """Return positions moved vertically into the height range of the tropospheric model, shape (T, 3) [m]."""
    latitude, longitude, height = geodetic_from_ecef(ecef_m)
    return ecef_from_geodetic(latitude, longitude, np.clip(height, *_MODELLED_HEIGHTS_M))


def locate(obs: Observations, received: Received, config: Config, book: ChannelBook) -> Located:
    """Compute the conventional position of every epoch from consistent ranges; see `ranges_without_map`."""
    return locate_ranges(obs.time, ranges_without_map(obs, received, config, book), config)


def locate_ranges(time: Datetimes, seen: RangesWithoutMap, config: Config) -> Located:
    """Compute the conventional position of every epoch from corrected ranges; see `locate`."""
    ranges = seen.ranges
    start = np.where(np.isnan(seen.near_ecef_m), _below(ranges), seen.near_ecef_m)
    fit = robust_fit(ranges, start, limits=config.robust_fit)
    rest = without(ranges, (ranges.weight > 0) & ~fit.kept)
    checked = rest.space_redundancy > 0  # at least one redundant range is needed to identify wrong ranges
    ranges = without(ranges, (ranges.weight > 0) & ~fit.kept & checked[:, None])
    point = point_position(ranges, start, limits=config.single_point)
    freedom = ranges.space_redundancy
    scale = np.where(freedom >= 1, point.wsse / np.maximum(freedom, 1), 1.0)
    no_position = seen.no_position
    for failed, reason in (
        (np.isnan(point.ecef_m[:, 0]), NoPosition.NO_CONVERGENCE),
        (_rms_m(ranges, point) > GROSS_M, NoPosition.INCONSISTENT),
        (~_plausible_height(point.ecef_m), NoPosition.IMPLAUSIBLE_HEIGHT),
    ):
        no_position = np.where(failed & (no_position == 0), np.int8(reason), no_position)
    ecef = np.where((no_position == 0)[:, None], point.ecef_m, np.nan)
    sigma = np.full((len(time), 3), np.nan)
    known = np.flatnonzero(no_position == 0)
    if len(known):
        latitude, longitude, _ = geodetic_from_ecef(ecef[known[0]])
        axes = enu_axes(latitude, longitude)[[1, 0, 2]]
        variance = np.einsum("ai,tij,aj->ta", axes, point.covariance_m2, axes)
        sigma = np.sqrt(variance * np.maximum(scale, 1.0)[:, None])
        sigma[no_position != 0] = np.nan
    return Located(time=time, ecef_m=ecef, sigma_m=sigma, n_used=ranges.n_used, no_position=no_position)


def _below(ranges: Ranges) -> Floats:
    """Return start positions of the fit, on the Earth's surface below the mean of the satellites, shape (T, 3) [m]."""
    weight = (ranges.weight > 0).astype(np.float64)
    mean = np.einsum("tk,tki->ti", weight, ranges.sat_ecef_m) + np.array([1.0, 0.0, 0.0])
    return np.asarray(mean / np.linalg.norm(mean, axis=1, keepdims=True) * _EARTH_RADIUS_M)


#: Range changes are computed between epochs at most this number of survey intervals apart; over longer times the mean
#: of two Dopplers is too inaccurate.
_LONGEST_STEP: Final = 2.5
#: Acceleration assumed for the standard deviation of a range change computed from Dopplers [m/s^2].
_CURVED_MPS2: Final = 0.05


def survey_run(
    parts: Iterable[Observations], received: Received, config: Config, limits: SurveyLimits, *, name: str
) -> SurveyRun:
    """Return the survey run of a log that is read in parts, including ranges and range changes.

    No range change spans two parts. Raise ValueError if fewer than three epochs have a position.
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
        raise ValueError("fewer than three epochs have a position; are the navigation files from the day of the log?")
    return replace(join_rows(runs), name=name, signals=join_rows(signals))


def _survey_part(
    obs: Observations,
    received: Received,
    config: Config,
    limits: SurveyLimits,
    book: ChannelBook,
    slip_state: CycleSlipState | None,
) -> tuple[SurveyRun, RunSignals, CycleSlipState | None]:
    """Return the survey run of observations decimated to the survey interval, the signals, and the slip state.

    A range change is the change of the carrier phase, if the phase has no slip or break between the two epochs.
    Otherwise, it is computed from the mean of the Dopplers at both epochs.
    """
    seen = ranges_without_map(obs, received, config, book)
    located, channels = locate_ranges(obs.time, seen, config), seen.corrected.channels
    slips, after = find_slips(obs, slip_state, frequency_hz=channels.every_frequency_hz, limits=config.slips)
    columns = channels.columns
    usable = seen.ranges.weight > 0
    nothing = np.zeros(usable.shape)
    phase = corrected_phase_m(slips.phase_m[:, columns], seen.corrected.satellites.clock_m, nothing, nothing)
    rate = -SPEED_OF_LIGHT / channels.frequency_hz * obs.doppler_hz[:, columns]
    broken = np.cumsum(slips.slip[:, columns] | obs.break_before[:, None], axis=0, dtype=np.intp)
    rows = rows_apart(obs.time, limits.interval_s)
    time, cn0_dbhz = obs.time[rows], obs.cn0_dbhz[:, columns]
    weak = 10.0 ** ((45.0 - np.where(np.isnan(cn0_dbhz), 45.0, np.minimum(cn0_dbhz, 50.0))) / 10.0)
    used, position, weak = usable[rows], seen.corrected.satellites.position_ecef_m[rows], weak[rows]
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
    for number, group in enumerate(channels.groups):
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
