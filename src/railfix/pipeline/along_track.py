"""Apply the filter along the track to the corrected ranges of each antenna."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Masks, copy_with, join_rows
from railfix.core.constants import FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.core.geodesy import geodetic_from_ecef
from railfix.core.reasons import Reason
from railfix.core.timescale import seconds
from railfix.integrity.interference import Suspicion, WheelSigns, WheelState, wheel_signs
from railfix.motion.samples import BaliseReadings, ListedBalises, SensorSamples
from railfix.pipeline.balises import BaliseLimits, find_passings
from railfix.pipeline.config import Config
from railfix.pipeline.filter_result import AlongTrack, FilterFix, FilterState, Replay, SingleEpochs, SmoothedTrack
from railfix.pipeline.interference_stage import Interference
from railfix.pipeline.outage_gate import ReturnState, gated_codes
from railfix.pipeline.sensed_motion import SensedMotion
from railfix.pipeline.sensor_epochs import LineReferences, sensor_epochs
from railfix.pipeline.solution import Solution, with_coordinates
from railfix.positioning.carrier import CycleSlipState, Slips, corrected_phase_m, find_slips
from railfix.positioning.map_offset import beyond_threshold
from railfix.ranges.atmosphere import klobuchar_delay_m
from railfix.ranges.corrected import CorrectedRanges
from railfix.screens import Screened
from railfix.track.trajectory import Trajectory
from railfix.tracking import GnssEpochs, Line, RangeEpochs, SensorEpochs, Tracked, TrackStatus, track
from railfix.tracking.levels import track_with_levels
from railfix.tracking.result import is_bounded

#: Rejection reasons that the filter ignores, because it reduces the weights of multipath and faults itself.
_WEIGHED_BY_FILTER: Final = (
    Reason.FAULT_EXCLUDED
    | Reason.ALONE_ON_ITS_CLOCK
    | Reason.DOPPLER
    | Reason.CN0_FLOOR
    | Reason.CN0_CURVE
    | Reason.ANTENNA_PAIR
)
#: Rejection reasons that apply to the code only; the filter still uses the satellite's phase and Doppler.
_CODE_ALONE: Final = Reason.GROSS_ERROR
#: The train is at standstill if its speed plus two sigmas is below this [m/s]; tachometers measure from 1 km/h on.
STANDSTILL_MPS: Final = 1.0 / 3.6
#: Positions beyond an end of the line by at most this number of sigmas are moved to the end.
_END_SIGMAS: Final = 4.0
#: Positions beyond an end by at most this distance are moved to the end, whatever the sigma [m].
_END_M: Final = 30.0
#: A two-way range is used if it differs from the predicted range by at most this number of standard deviations.
_GATE_SIGMAS: Final = 3.0
#: Two-way ranges too long by at most this are also used [m]. Echoes delayed by over 0.3 m are separable (P2, table 3).
_LATE_M: Final = 0.6
#: Vertical error of the ionospheric model that the filter's constants `slow_code_m` and `TILT_M` assume [m].
_QUIET_IONOSPHERE_M: Final = 1.0
#: With sensors, the filter processes epochs in blocks of this length of GPS time [ns].
_BLOCK_NS: Final = 5_000_000_000
#: The direction of motion is reported if the speed exceeds this number of its sigmas.
_DIRECTION_SIGMAS: Final = 3.0


def along_track(
    ranges: CorrectedRanges,
    slips: Slips | None,
    single: SingleEpochs,
    line: Line,
    config: Config,
    state: FilterState,
    *,
    samples: SensorSamples | None = None,
    references: LineReferences | None = None,
) -> tuple[AlongTrack, tuple[Replay, ...], FilterState]:
    """Return the filtered positions of one antenna, the filter's input, and the filter's state.

    Codes rejected for reasons in `_WEIGHED_BY_FILTER` are used with the filter's own weights; codes rejected for other
    reasons are left out (`gnss_epochs`).

    `railfix.tracking.levels.track_with_levels` computes positions and levels; docs/filter-equations.md has the
    equations. `samples` are the on-board sensor samples since the previous chunk; `references` has the line's features,
    ground units and balises.
    """
    epochs, after_slips = gnss_epochs(ranges, single.noise_scale, config, state.slips, slips=slips)
    epochs = copy_with(epochs, off_map=single.off_map, near_ecef_m=single.near_ecef_m, tilt_scale=single.tilt_scale)
    trajectory = line.trajectory
    tracked, sensed, replays, after = _run_filter(
        epochs, line, config, copy_with(state, slips=after_slips), samples, references, (single.arc_m, single.sigma_m)
    )  # fmt: skip
    beside = (tracked.status == TrackStatus.TRACKING) & single.map_offset
    tracked = mark_doubtful(tracked, beside, TrackStatus.MAP_OFFSET)
    spoofed = single.suspicion == Suspicion.SPOOFING_SUSPECTED
    tracked = mark_doubtful(tracked, spoofed & is_bounded(tracked.status), TrackStatus.SPOOFING_SUSPECTED)
    doubted = np.isin(single.suspicion, (Suspicion.TIME_TAGS, Suspicion.LEFT_MAP, Suspicion.CONTRADICTED))
    placed = is_bounded(tracked.status) | (tracked.status == TrackStatus.SEVERAL_BRANCHES)
    tracked = mark_doubtful(tracked, doubted & placed, TrackStatus.DOUBTFUL)
    wheel = None
    if config.interference.use == "on" and any(replay.sensors.wheel_m is not None for replay in replays):
        wheel, wheel_state = _against_wheel(replays, single.arc_m, single.sigma_m, after.wheel, config)
        after = replace(after, wheel=wheel_state)
        if config.interference.wheel_level == "on":
            sure = np.where(is_bounded(tracked.status), tracked.sigma_m, np.nan)
            of_filter, filter_wheel = _against_wheel(replays, tracked.arc_m, sure, after.filter_wheel, config)
            after, tracked = replace(after, filter_wheel=filter_wheel), _bound_by_wheel(tracked, of_filter.bound_m)
        # the spoofing status replaces a doubtful status, unless a time-tag error is suspected
        unnamed = (tracked.status == TrackStatus.DOUBTFUL) & (single.suspicion != Suspicion.TIME_TAGS)
        parted = wheel.parted & (is_bounded(tracked.status) | unnamed)
        tracked = mark_doubtful(tracked, parted, TrackStatus.SPOOFING_SUSPECTED)
    speed, sigma = tracked.speed_mps, tracked.speed_sigma_mps
    direction = np.where(np.abs(speed) > _DIRECTION_SIGMAS * sigma, np.sign(speed), 0.0)
    result = AlongTrack(
        tracked=tracked, trajectory=trajectory, arc_m=on_line_m(tracked, trajectory),
        direction=direction.astype(np.int8), standstill=np.abs(speed) + 2.0 * sigma < STANDSTILL_MPS, sensed=sensed,
        spacing_error_m=np.full(len(tracked), np.nan), wheel=wheel,
    )  # fmt: skip
    return result, replays, after


def single_epochs(solution: Solution, interference: Interference | None, config: Config) -> SingleEpochs:
    """Return those single-epoch results of an antenna that the filter along the track uses."""
    has = with_coordinates(config.failed_checks)[solution.status]
    return SingleEpochs(
        noise_scale=solution.noise_scale,
        arc_m=np.where(has, solution.arc_m, np.nan),
        sigma_m=solution.epoch_sigma_m,
        near_ecef_m=solution.point.ecef_m,
        off_map=solution.off_map,
        map_offset=beyond_threshold(solution.map_offset, config.map_offset),
        suspicion=np.zeros(len(has), dtype=np.int8) if interference is None else interference.suspicion,
    )


def _bound_by_wheel(tracked: Tracked, bound_m: Floats) -> Tracked:
    """Raise finite protection levels to at least `bound_m`, the largest error that wheel distances cannot reveal."""
    levels = {name: np.asarray(getattr(tracked, name)) for name in ("level_m", "ground_level_m", "amount_m")}
    return replace(
        tracked, **{n: np.where(np.isfinite(level), np.fmax(level, bound_m), level) for n, level in levels.items()}
    )


def _against_wheel(
    replays: Sequence[Replay], arc_m: Floats, sigma_m: Floats, state: WheelState, config: Config
) -> tuple[WheelSigns, WheelState]:
    """Compare the distances between positions with wheel distances."""
    parts = [(replay.epochs.time, replay.sensors.wheel_m) for replay in replays]
    rolled = np.concatenate([np.full(len(time), np.nan) if distance is None else distance for time, distance in parts])
    return wheel_signs(
        np.concatenate([time for time, _ in parts]), arc_m, sigma_m, rolled, state, config.interference,
        signed=all(replay.sensors.wheel_sign == "measured" for replay in replays if replay.sensors.wheel_m is not None),
    )  # fmt: skip


def apply_spacing_verdict(
    result: AlongTrack, spacing: Screened | None, state: FilterState, held_s: float
) -> tuple[AlongTrack, FilterState]:
    """Mark positions as doubtful where the antennas' positions or speeds disagree; return positions and test state.

    `spacing` has the verdicts of the antenna spacing screen, shape (T,), or is None. After a rejection, positions stay
    doubtful for `held_s` seconds.
    """
    time, error = result.tracked.time, result.spacing_error_m
    disagreed = np.full(len(time) + 1, state.disagreed)
    if spacing is not None:
        disagreed[1:], error = np.where(spacing.reject, time, np.datetime64("NaT", "ns")), spacing.metric
    disagreed = np.fmax.accumulate(disagreed)
    held = seconds(time - disagreed[1:]) <= held_s
    tracked = mark_doubtful(result.tracked, held & is_bounded(result.tracked.status), TrackStatus.ANTENNAS_DISAGREE)
    return copy_with(result, tracked=tracked, spacing_error_m=error), copy_with(state, disagreed=disagreed[-1])


def with_passings(
    result: AlongTrack,
    state: FilterState,
    listed: ListedBalises | None,
    trajectory: Trajectory,
    samples: SensorSamples | None,
    limits: BaliseLimits,
) -> tuple[AlongTrack, FilterState]:
    """Return `result`, which must have its final statuses, with the passings of balises; also return the new state."""
    if listed is None:
        return result, state
    readings = samples.balises if samples else BaliseReadings()
    found, after = find_passings(result.tracked, listed, trajectory, readings, state.passings, limits)
    return replace(result, passings=found), replace(state, passings=after)


def mark_doubtful(tracked: Tracked, doubtful: Masks, status: TrackStatus) -> Tracked:
    """Return positions whose doubtful epochs have the given `status` and infinite levels; NaN levels are kept."""
    if not doubtful.any():
        return tracked
    reported = np.where(doubtful, np.int8(status), tracked.status)
    unbounded = doubtful & ~np.isnan(tracked.level_m)
    names = ("level_m", "ground_level_m", "amount_m")
    levels = {name: np.where(unbounded, np.inf, getattr(tracked, name)) for name in names}
    return copy_with(tracked, status=reported, **levels)


def _run_filter(
    epochs: GnssEpochs,
    line: Line,
    config: Config,
    state: FilterState,
    samples: SensorSamples | None,
    references: LineReferences | None,
    single: tuple[Floats, Floats],
) -> tuple[Tracked, SensedMotion, tuple[Replay, ...], FilterState]:
    """Return the filter's positions, the sensor motion, the smoother's input, and the state for the next chunk.

    `single` has single-epoch arc lengths and their standard deviations, shape (T,) each [m].

    With sensors, the epochs are processed in blocks of `_BLOCK_NS` of GPS time, wherever chunks begin. At the start of
    each block, dead reckoning, whose position determines the map's gradient, restarts from the filter's position.
    """

    def sine_at(arc_m: Floats) -> Floats:
        slope = line.gradient_at(arc_m)
        return np.asarray(slope / np.sqrt(1.0 + slope**2))

    sensing = bool(samples) or bool(state.sensors.samples)
    number = epochs.time.astype(np.int64) // _BLOCK_NS
    edges = np.diff(number, prepend=number[:1], append=number[-1:]).nonzero()[0] if sensing else np.empty(0, np.intp)
    parts: list[Tracked] = []
    motions: list[SensedMotion] = []
    replays: list[Replay] = []
    for first, last in pairwise([0, *edges.tolist(), len(epochs)]):
        part = epochs if last - first == len(epochs) else epochs.take(slice(first, last))
        if len(part) and state.fixed is not None and _block(part.time[0]) != _block(state.fixed.time):
            state = _restart_state(state, state.fixed)
        before = state.sensors
        sensors, sensed, kept = sensor_epochs(
            samples, part.time, line.trajectory, before, limits=config.sensors, sine_at=sine_at,
            sources=config.filter_sources, references=references,
        )  # fmt: skip
        samples = None
        if sensors.ranges is not None:
            sensors = replace(sensors, ranges=_gated_ranges(sensors.ranges, part.time, line, state, config))
        if sensing and len(part):
            part, gate = _gate(part, sensors, single[0][first:last], single[1][first:last], line, state, config)
            state = replace(state, gate=gate)
        replays.append(Replay(epochs=part, sensors=sensors, before=state.track))
        level = state.level
        if config.tracking.level == "on":
            tracked, after, level = track_with_levels(part, line, state.track, level, config.tracking, sensors)
        else:
            tracked, after = track(part, line, state.track, limits=config.tracking, sensors=sensors)
        fixed = _find_fix(tracked) if len(part) else state.fixed
        state = copy_with(state, track=after, level=level, sensors=kept, fixed=fixed)
        parts.append(tracked)
        motions.append(sensed)
    return join_rows(parts), join_rows(motions), tuple(replays), state


def _gate(
    epochs: GnssEpochs,
    sensors: SensorEpochs,
    place_m: Floats,
    sigma_m: Floats,
    line: Line,
    state: FilterState,
    config: Config,
) -> tuple[GnssEpochs, ReturnState]:
    """Return the epochs without the codes that `gated_codes` withholds after an outage, and the gate's state."""
    distance = np.full(len(epochs), np.nan)
    for other in (sensors.radar_m, sensors.wheel_m):
        if other is not None and (other is not sensors.wheel_m or sensors.wheel_sign == "measured"):
            distance = np.where(np.isfinite(other), other, distance)
    observed = np.asarray(np.isfinite(epochs.code_m).any(axis=1))
    refused, gate = gated_codes(epochs.time, observed, distance, place_m, sigma_m, state.gate, line, config.sensors)
    return (
        replace(epochs, code_m=np.where(refused[:, None], np.nan, epochs.code_m)) if refused.any() else epochs
    ), gate


def _gated_ranges(ranges: RangeEpochs, time: Datetimes, line: Line, state: FilterState, config: Config) -> RangeEpochs:
    """Return two-way ranges, NaN where they contradict the filter's position or the filter has no position (P2 3.3).

    The gate rejects echoes and ranges to wrongly surveyed units. The position is predicted from the start of the block
    with constant speed; to allow for acceleration, the gate widens with the square of the elapsed time.
    """
    fixed = state.anchor
    if fixed is None:
        return replace(ranges, range_m=np.full(ranges.range_m.shape, np.nan))
    since = seconds(time - fixed.time)[:, None] - ranges.age_s
    place = fixed.arc_m + fixed.speed_mps * since
    spread = np.sqrt(fixed.sigma_m**2 + (0.5 * config.tracking.acceleration_mps2 * since**2) ** 2 + ranges.sigma_m**2)
    along, right, up = ranges.lever_m.tolist()
    point, axes = line.at(np.nan_to_num(place + along).ravel())
    unit = point + right * axes[:, 1] + up * axes[:, 2]
    size = np.linalg.norm(ranges.unit_ecef_m - unit.reshape(*place.shape, 3), axis=-1)
    residual = ranges.range_m - size
    late = np.maximum(_GATE_SIGMAS * spread, _LATE_M)
    kept = (residual >= -_GATE_SIGMAS * spread) & (residual <= late) & np.isfinite(place)
    return replace(ranges, range_m=np.where(kept, ranges.range_m, np.nan))


def _block(time: np.datetime64) -> int:
    return int(time.astype(np.int64)) // _BLOCK_NS


def _restart_state(state: FilterState, fixed: FilterFix) -> FilterState:
    """Return the state for a new block, with dead reckoning restarted from the filter's position."""
    sensors = state.sensors
    if sensors.motion.tick:
        motion = replace(sensors.motion, arc_m=fixed.arc_at(sensors.motion.time), sigma_m=fixed.sigma_m)
        sensors = replace(sensors, motion=motion)
    gate = replace(state.gate, place_m=fixed.arc_m, sigma_m=fixed.sigma_m, distance_m=0.0)
    return replace(state, sensors=sensors, anchor=fixed, gate=gate)


def _find_fix(tracked: Tracked) -> FilterFix:
    decided = int(tracked.status[-1]) in (TrackStatus.TRACKING, TrackStatus.COASTING)
    arc, speed = float(tracked.arc_m[-1]), float(tracked.speed_mps[-1])
    sigma = float(tracked.sigma_m[-1])
    return FilterFix(time=tracked.time[-1], arc_m=arc if decided else np.nan, sigma_m=sigma, speed_mps=speed)


def on_line_m(tracked: Tracked | SmoothedTrack, trajectory: Trajectory) -> Floats:
    """Return arc lengths on the trajectory, shape (T,) [m].

    A position beyond an end by at most the larger of four sigmas and 30 m is moved to that end. Positions farther out
    are NaN.
    """
    arc, end = tracked.arc_m, trajectory.arc_m[-1]
    near = np.clip(arc, 0.0, end)
    return np.where(np.abs(arc - near) <= np.maximum(_END_SIGMAS * tracked.sigma_m, _END_M), near, np.nan)


def gnss_epochs(
    ranges: CorrectedRanges,
    noise_scale: Floats,
    config: Config,
    state: CycleSlipState | None,
    *,
    slips: Slips | None = None,
) -> tuple[GnssEpochs, CycleSlipState | None]:
    """Return the filter's measurements, and the state of the slip detection.

    A code is the corrected pseudorange. It is NaN if the epoch is `unsure`, or if the code has a rejection reason
    outside `_WEIGHED_BY_FILTER`. Its standard deviation is the range sigma times `noise_scale`, shape (T,).

    Carrier phases are corrected for satellite clock and troposphere. Dopplers are not corrected, because the drift of a
    satellite clock and the tropospheric rate are only some millimetres per second.
    """
    obs, columns = ranges.observations, ranges.columns
    after = state
    if slips is None:
        slips, after = find_slips(obs, state, frequency_hz=ranges.channels.every_frequency_hz, limits=config.slips)
    code_used = ((ranges.reason & ~int(_WEIGHED_BY_FILTER)) == 0) & ~ranges.unsure[:, None]
    motion_used = (ranges.reason & ~int(_WEIGHED_BY_FILTER | _CODE_ALONE)) == 0
    phases, dopplers = ("phase" in config.filter_sources, "doppler" in config.filter_sources)
    no_delay, air = np.zeros(ranges.code_m.shape), ranges.troposphere_m
    phase = corrected_phase_m(
        slips.phase_m[:, columns],
        ranges.satellites.clock_m,
        no_delay,
        np.where(np.isnan(air), 0.0, air),
    )
    epochs = GnssEpochs(
        time=obs.time, satellite=ranges.satellite, signal=ranges.signal, clock=ranges.channels.clock,
        sat_ecef_m=ranges.satellites.position_ecef_m, sat_velocity_mps=ranges.satellites.velocity_ecef_mps,
        code_m=np.where(code_used, ranges.corrected_code_m, np.nan), code_sigma_m=ranges.sigma_m * noise_scale[:, None],
        phase_m=np.where(motion_used & phases, phase, np.nan), phase_joined=~slips.slip[:, columns],
        rate_mps=np.where(motion_used & dopplers, -SPEED_OF_LIGHT / ranges.frequency_hz * ranges.doppler_hz, np.nan),
        cn0_dbhz=ranges.cn0_dbhz, off_map=np.zeros(len(obs.time), dtype=np.bool_),
    )  # fmt: skip
    return epochs, after


def compute_tilt_scale(ranges: CorrectedRanges, line: Line, klobuchar: Floats | None, config: Config) -> Floats:
    """Return `GnssEpochs.tilt_scale`, shape (T,).

    The scale is 0 for ionosphere-free codes. It is 1 if SBAS or a base station corrects the ranges, or if there is no
    ionospheric model. Otherwise it is the larger of 1 and the error of the Klobuchar model in metres:
    `NominalErrors.ionosphere_share` times the vertical delay at the beginning of the line.
    """
    one = np.ones(len(ranges.time))
    if klobuchar is None or config.dual_frequency_sbas:
        return 0.0 * one if config.dual_frequency_sbas else one
    latitude, longitude, _ = geodetic_from_ecef(line.ecef_m[0])
    zenith, north = np.full((len(one), 1), 90.0), np.zeros((len(one), 1))
    coordinates = latitude * one, longitude * one
    vertical = klobuchar_delay_m(ranges.time, *coordinates, zenith, north, klobuchar, np.array([FREQUENCY_L1]))[:, 0]
    scale = np.maximum(config.nominal.ionosphere_share * vertical / _QUIET_IONOSPHERE_M, 1.0)
    return scale if ranges.base is None else np.where(np.isfinite(ranges.base.code_m).any(axis=1), 1.0, scale)
