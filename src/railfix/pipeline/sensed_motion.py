"""Motion between the epochs by wheel and inertial unit (slips, carried distances), places by features of the line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np

from railfix.core.arrays import Codes, Datetimes, Floats, Integers, Masks
from railfix.core.constants import GRAVITY_MPS2
from railfix.core.timescale import seconds
from railfix.motion.features import (
    HALF_LENGTH_M,
    Feature,
    LineSeries,
    LocatedFeature,
    line_series,
    locate,
    map_features,
)
from railfix.motion.samples import InertialSamples, TachometerPulses
from railfix.motion.slip import (
    LOOK_BACK_S,
    SMOOTHING_S,
    MotionSamples,
    MotionState,
    SlipLimits,
    SlipState,
    find_slips,
    heading_rate_radps,
    pitch_rate_radps,
    roll_sine,
)
from railfix.motion.tachometer import (
    PulseSpeeds,
    TachometerLimits,
    distance_m,
    faults_until,
    pulse_acceleration,
    pulse_speeds,
)
from railfix.track import Track
from railfix.track.curves import curved_line
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line

#: Slower than this the rates say nothing of the line [m/s].
SLOWEST_MPS: Final = 1.0
#: Rates over a length are the mean of so many metres: the body's swings are shorter.
_LEAST_POINTS: Final = 30


@dataclass(frozen=True, kw_only=True)
class LineFeatures:
    """Gradient and curvature of a line, and its features in order; arc lengths are those of the line itself."""

    series: LineSeries
    features: tuple[Feature, ...]
    #: Arc lengths of the antenna's trajectory, and of the body's middle on the line then: the body turns about it;
    #: shape (V,).
    antenna_m: Floats
    body_m: Floats
    line: Line  #: Shows whether it is closed.

    @classmethod
    def of(cls, track: Track, trajectory: Trajectory) -> LineFeatures:
        """Return the features of a track for the body that carries an antenna."""
        line = curved_line(track)
        series = line_series(line)
        body = trajectory.chainage_m if trajectory.body_chainage_m is None else trajectory.body_chainage_m
        inside = np.clip(body, line.chainage_m[0], line.chainage_m[-1])
        return cls(
            series=series, features=tuple(map_features(series)), antenna_m=np.asarray(trajectory.arc_m),
            body_m=line.arc_at_chainage(inside) + body - inside, line=Line.of(line),
        )  # fmt: skip

    def body_at(self, antenna_m: Floats) -> Floats:
        """Place of the body's middle where an antenna is at an arc length of its trajectory [m]."""
        return np.interp(antenna_m, self.antenna_m, self.body_m)


def ahead_m(trajectory: Trajectory) -> float:
    """Return how far an antenna is ahead of the vehicle's middle in rising arc length [m]; 0 without a vehicle."""
    if trajectory.body_chainage_m is None:
        return 0.0
    return float(np.median(trajectory.chainage_m - trajectory.body_chainage_m))


@dataclass(frozen=True, kw_only=True)
class RateSeries:
    """Rates of the body at K ticks."""

    #: Times at which they hold, and when they were known; shape (K,).
    time: Datetimes
    known: Datetimes
    distance_m: Floats  #: Wheel's distance since the tick before the first, in rising arc length; shape (K,).
    arc_m: Floats  #: Place of the antenna by the wheel; NaN where it is not known; shape (K,).
    #: Change of heading (+ to the right) and of pitch (+ nose up) since the tick before, shape (K,).
    turned_rad: Floats
    climbed_rad: Floats
    speed_mps: Floats  #: In rising arc length, shape (K,).
    rolls: Masks  #: The wheel rolls, shape (K,).

    def arc_at(self, time: Datetimes) -> Floats:
        """Return places at times after the first tick, on from the tick before each [m]."""
        last = np.maximum(np.searchsorted(self.time, time, side="right") - 1, 0)
        since = seconds(time - self.time[last])
        return np.asarray(self.arc_m[last] + np.nan_to_num(self.speed_mps[last]) * since)


@dataclass(frozen=True, kw_only=True)
class FeatureState:
    """What one chunk leaves to the next."""

    distance_m: float = 0.0  #: Distance at the last tick.
    angles: tuple[float, float] = (0.0, 0.0)  #: Heading and pitch there, from any beginning [rad].
    #: Whole metres passed without a break, in the order of travel; shape (M,).
    metre: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    #: At each, shape (M,).
    heading_rad: Floats = field(default_factory=lambda: np.empty(0))
    pitch_rad: Floats = field(default_factory=lambda: np.empty(0))
    #: Place of the last accepted feature, its standard deviation, and the distance there [m].
    last: tuple[float, float, float] | None = None
    done_m: float = float("nan")  #: Place up to which features have been compared; NaN before the first.


@dataclass(frozen=True, kw_only=True)
class FeatureFix:
    """Verdict on one feature."""

    tick: int  #: After which of the ticks it was passed.
    feature: Feature
    located: LocatedFeature

    @property
    def correction_m(self) -> float:
        """Place less that by the wheel [m]; NaN unless accepted."""
        return self.located.arc_m - self.feature.arc_m


class _Stretch(NamedTuple):
    """Ticks without a break from `first` on, and the whole metres passed up to the last of them."""

    first: int
    sense: float  #: 1 toward rising arc length, else -1.
    distance_m: Floats  #: At all ticks of the chunk, the one before the first of them at index 0.
    body_m: Floats  #: Place of the body's middle at each tick of the stretch.
    behind_m: Floats  #: And the place that a feature has to be passed by to be compared.
    metre: Integers
    heading_rad: Floats
    pitch_rad: Floats

    def shift_m(self, tick: int) -> float:
        """Return what leads from distances to places of the body's middle at a tick."""
        return float(self.body_m[tick - self.first] - self.distance_m[tick + 1])


def _fix_feature(
    feature: Feature,
    stretch: _Stretch,
    line: LineFeatures,
    noise: tuple[float, tuple[float, float]],
    facing: float,
    last: tuple[float, float, float] | None,
) -> FeatureFix | None:
    """Compare the profile that was passed with a feature; `noise` is of the place by the wheel, and of the profile."""
    tick = stretch.first + int(np.argmax(stretch.sense * (stretch.behind_m - feature.arc_m) >= 0.0))
    shift, distance = stretch.shift_m(tick), stretch.distance_m[tick + 1]
    # In rising arc length: a vehicle that backs or faces the other way turns the signs of pitch, heading stays.
    passed = np.flatnonzero(stretch.sense * (stretch.metre - distance) <= 0.0)[:: int(stretch.sense)]
    place = np.asarray(stretch.metre[passed] + shift, dtype=np.float64)
    profile = (place, stretch.heading_rad[passed], facing * stretch.pitch_rad[passed])
    before = None
    if last is not None:
        covered = feature.arc_m - shift - last[2]
        # on a closed line the last feature may lie before the join
        nearest = line.line.nearest_m(np.array(last[0]), np.array(feature.arc_m - covered))
        before = (float(nearest), last[1], covered)
    located = _compare(profile, feature, line, noise[0], before, noise[1])
    return None if located is None else FeatureFix(tick=tick, feature=feature, located=located)


def feature_fixes(
    rates: RateSeries,
    line: LineFeatures,
    facing: float,
    sigma_m: float,
    state: FeatureState,
    *,
    noise: tuple[float, float],
) -> tuple[list[FeatureFix], FeatureState]:
    """Return verdicts on the features that were passed, and the state to pass on.

    A feature is compared once the body's middle is `HALF_LENGTH_M` beyond it. Only distances without a slip and faster
    than 1 m/s count: heading and pitch are integrals, and a break restarts them. `facing`: 1 where the front points to
    rising arc length, else -1; `sigma_m`: of the place by the wheel; `noise`: standard deviations of gradient and
    curvature in one metre.
    """
    distances = np.concatenate([[0.0], rates.distance_m]) + state.distance_m
    heading, pitch = (
        np.concatenate([[0.0], np.cumsum(turns)]) + begin
        for turns, begin in zip((rates.turned_rad, rates.climbed_rad), state.angles, strict=True)
    )
    usable = rates.rolls & (np.abs(rates.speed_mps) > SLOWEST_MPS) & np.isfinite(heading[1:] + pitch[1:])
    fixes: list[FeatureFix] = []
    metre, headings, pitches = state.metre, state.heading_rad, state.pitch_rad
    kept, last, done = int(2.5 * HALF_LENGTH_M), state.last, state.done_m
    breaks = np.flatnonzero(~usable)
    # stretches of usable ticks, each closed by one that is not
    edges = np.concatenate([[-1], breaks, [len(usable)]])
    for begin, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if begin >= 0:
            metre, headings, pitches = metre[:0], headings[:0], pitches[:0]
        if end - begin < 2:
            continue
        rows = slice(begin + 1, end + 1)  # ticks begin + 1 .. end - 1, with the one before them at index begin + 1
        distance = distances[rows]
        whole = _whole_metres(distance)
        if len(metre) and len(whole) and whole[0] != metre[-1] + np.sign(distance[-1] - distance[0]):
            metre, headings, pitches = metre[:0], headings[:0], pitches[:0]
        rising = distance if distance[-1] >= distance[0] else distance[::-1]
        turned, climbed = (v[rows] if distance[-1] >= distance[0] else v[rows][::-1] for v in (heading, pitch))
        metre = np.concatenate([metre, whole])
        headings = np.concatenate([headings, np.interp(whole, rising, turned)])
        pitches = np.concatenate([pitches, np.interp(whole, rising, climbed)])
        body = line.body_at(rates.arc_m[begin + 1 : end])
        if not np.isfinite(body[-1]) or len(metre) < _LEAST_POINTS:
            continue
        sense = 1.0 if metre[-1] > metre[0] else -1.0
        behind = body - sense * HALF_LENGTH_M
        passed = float(behind[-1])
        stretch = _Stretch(begin + 1, sense, distances, body, behind, metre, headings, pitches)
        known = done if done == done else float(behind[0])
        for feature in line.features[:: int(sense)]:
            if not 0.0 < sense * (feature.arc_m - known) <= sense * (passed - known):
                continue
            fix = _fix_feature(feature, stretch, line, (sigma_m, noise), facing, last)
            if fix is None:
                continue
            fixes.append(fix)
            if fix.located.verdict == "accepted":
                last = (fix.located.arc_m, fix.located.sigma_m, feature.arc_m - stretch.shift_m(fix.tick))
        # a place corrected backward passes nothing twice
        done = passed if not sense * (passed - done) < 0.0 or abs(passed - done) > HALF_LENGTH_M else done
    metre, headings, pitches = metre[-kept:], headings[-kept:], pitches[-kept:]
    angles = (float(np.nan_to_num(heading[-1])), float(np.nan_to_num(pitch[-1])))
    return fixes, replace(
        state, distance_m=float(distances[-1]), angles=angles, metre=metre, heading_rad=headings, pitch_rad=pitches,
        last=last, done_m=done,
    )  # fmt: skip


def _whole_metres(distance_m: Floats) -> Integers:
    """Return the whole metres between the first value and the last, in the order of travel."""
    first, last = float(distance_m[0]), float(distance_m[-1])
    if last >= first:
        return np.arange(np.floor(first) + 1, np.floor(last) + 1).astype(np.int64)
    return np.arange(np.ceil(first) - 1, np.ceil(last) - 1, -1).astype(np.int64)


def _compare(
    profile: tuple[Floats, Floats, Floats],
    feature: Feature,
    line: LineFeatures,
    sigma_m: float,
    last: tuple[float, float, float] | None,
    noise: tuple[float, float],
) -> LocatedFeature | None:
    """Verdict on one feature by arc lengths, headings and pitches; None where it was not passed without a break."""
    arc_m, heading_rad, pitch_rad = profile
    about = arc_m - feature.arc_m
    near = np.flatnonzero(np.abs(about) <= HALF_LENGTH_M)
    if len(near) < 1.8 * HALF_LENGTH_M or len(near) < 3:
        return None
    heading, pitch = heading_rad[near], pitch_rad[near]
    measured = LineSeries(
        arc_m=np.asarray(about[near][1:-1], dtype=np.float64),
        gradient=np.tan(pitch[1:-1]),
        curvature_1pm=0.5 * (heading[2:] - heading[:-2]),
    )
    return locate(measured, line.series, feature.arc_m, sigma_m, quantity=feature.quantity, noise=noise, last=last)


#: Spacing of the samples of the slip detection, at multiples of it in GPS time [ns].
_TICK_NS: Final = 20_000_000
#: Accelerations of the wheel and means of the inertial unit are over this [ns].
_MEAN_NS: Final = 200_000_000
#: A lost or doubled pulse is in the acceleration for so long [ns].
_FAULT_NS: Final = _MEAN_NS + 150_000_000
#: Samples before the last epoch that the next chunk needs [ns].
REACH: Final = np.timedelta64(_MEAN_NS + 200_000_000, "ns")
#: States whose distance is that of the inertial unit.
CARRIED: Final = (
    MotionState.STANDING, MotionState.LOW_SPEED, MotionState.INERTIAL_SPIN, MotionState.INERTIAL_SLIDE,
    MotionState.ROLLING,
)  # fmt: skip
#: The state of an interval is the one that says most.
_RANK: Final = np.array(
    [
        {
            MotionState.INIT: 0, MotionState.NORMAL: 1, MotionState.STANDING: 2, MotionState.LOW_SPEED: 3,
            MotionState.ROLLING: 4, MotionState.INERTIAL_SPIN: 5, MotionState.INERTIAL_SLIDE: 5,
            MotionState.EXPIRED: 6,
        }[state]
        for state in MotionState
    ]
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class SensedMotion:
    """Motion of T intervals between epochs; forward is that of the vehicle."""

    state: Codes  #: `railfix.motion.slip.MotionState`; INIT without both sensors; shape (T,).
    distance_m: Floats  #: Forward by inertia where the state is one of `CARRIED`, NaN elsewhere; shape (T,).
    doubt_mps: Floats  #: Speed that a slip not detected yet may have had, shape (T,).
    #: Part of the mean specific force forward that the pitching of the body makes, 0 without a gyro; shape (T,).
    swing_mps2: Floats
    #: Of the line under the body, toward rising arc length (P2 2.3): climb over distance by wheel and accelerometer (an
    #: offset of 0.01 m/s2 is 0.001), curvature by the yaw rate, + to the right, lean of the body over the contact
    #: points of the wheels, + with the left rail higher; and chainage of the body's middle then. NaN where the wheel
    #: does not roll faster than `SLOWEST_MPS`; cant without a vehicle; shape (T,).
    gradient: Floats
    curvature_1pm: Floats
    cant_m: Floats
    under_m: Floats


@dataclass(frozen=True, kw_only=True)
class SensedState:
    """What one chunk leaves to the next."""

    tick: int = 0  #: Number of the last sample since the beginning of GPS time; 0 before the first.
    #: Place of the antenna then, by the wheel since the last one of the filter; NaN where it is not known.
    arc_m: float = float("nan")
    sigma_m: float = float("nan")  #: Standard deviation of that place of the filter.
    slip: SlipState | None = None

    @property
    def time(self) -> np.datetime64:
        """Of the last sample."""
        return np.datetime64(self.tick * _TICK_NS, "ns")


def nothing_sensed(intervals: int) -> SensedMotion:
    """Return the motion without a sensor."""
    distance, gradient, curvature, cant, under = np.full((5, intervals), np.nan)
    doubt, swing = np.zeros((2, intervals))
    return SensedMotion(
        state=np.zeros(intervals, dtype=np.int8), distance_m=distance, doubt_mps=doubt, swing_mps2=swing,
        gradient=gradient, curvature_1pm=curvature, cant_m=cant, under_m=under,
    )  # fmt: skip


def sensed_motion(
    pulses: TachometerPulses,
    inertial: InertialSamples,
    edges: Datetimes,
    trajectory: Trajectory,
    sine_at: Callable[[Floats], Floats],
    state: SensedState,
    *,
    tachometer: TachometerLimits,
    limits: SlipLimits,
) -> tuple[SensedMotion, RateSeries | None, SensedState]:
    """Return the motion between instants, the rates of the body (None without a sample), and the state to pass on.

    Pulses with a direction and inertial samples are from `REACH` before the first of the T + 1 `edges` on. `sine_at`
    gives the sine of the gradient in rising arc length at arc lengths; the trajectory of the antenna shows which way
    the front points, and where the body is.
    """
    facing = trajectory.front_sign
    ends = edges.astype("datetime64[ns]").astype(np.int64)
    begin = state.tick or max(int(ends[0]), int(inertial.time[0].astype(np.int64))) // _TICK_NS
    ticks = np.arange(begin + 1, int(ends[-1]) // _TICK_NS + 1)
    if not len(ticks):
        return nothing_sensed(len(edges) - 1), None, state
    when = (ticks * _TICK_NS).astype("datetime64[ns]")
    earlier = ((ticks * _TICK_NS) - _MEAN_NS).astype("datetime64[ns]")
    speed = pulse_speeds(pulses, when, limits=tachometer)
    acceleration = _wheel_acceleration(pulses, ticks, speed, tachometer)
    last = np.searchsorted(pulses.time, when, side="right") - 1
    since = np.full(len(when), np.nan)
    since[last >= 0] = seconds(when[last >= 0] - pulses.time[last[last >= 0]])
    means = _means(inertial, earlier, when)
    force, rates = means[:, :3], means[:, 3:]
    known_speed = np.nan_to_num(speed.speed_mps)
    turning = pitch_rate_radps(force, rates, known_speed)
    start = np.datetime64(begin * _TICK_NS, "ns")
    distances = distance_m(pulses, np.concatenate([[start], when]), limits=tachometer)
    arc = state.arc_m + facing * (distances[1:] - distances[0])
    line_sine = facing * sine_at(arc)
    # the speed by pulses is that of the middle of their time: 0.065 s ago, 0.2 m after a slip of 3 s begun at 1 m/s2
    ago = seconds(when - speed.time)
    found, slip = find_slips(
        MotionSamples(
            time_s=np.asarray(1e-9 * _TICK_NS * ticks, dtype=np.float64),
            wheel_mps=speed.speed_mps + np.nan_to_num(acceleration * ago),
            wheel_mps2=acceleration,
            force_mps2=force[:, 0],
            line_sine=line_sine,
            body=np.stack([force[:, 1], rates[:, 1], rates[:, 2]], axis=1),
            since_pulse_s=since,
        ),
        limits=limits,
        state=state.slip,
    )
    swing = np.nan_to_num(GRAVITY_MPS2 * (found.pitch - line_sine))
    lag = LOOK_BACK_S + limits.confirm_s + SMOOTHING_S
    doubt = GRAVITY_MPS2 * lag * np.abs(found.smooth)
    at = np.searchsorted(ticks * _TICK_NS, ends, side="right")
    turned, rolls = heading_rate_radps(force, rates, known_speed), found.state == MotionState.NORMAL
    # mean rates are those of the middle of their time
    middle = (ticks * _TICK_NS - _MEAN_NS // 2).astype("datetime64[ns]")
    passed = distance_m(
        pulses, np.concatenate([[start - np.timedelta64(_MEAN_NS // 2, "ns")], middle]), limits=tachometer
    )
    passed_m = state.arc_m + facing * (passed[1:] - distances[0])
    sine, cant = found.metric + found.pitch, roll_sine(force, rates, known_speed) * (trajectory.contact_m or np.nan)
    under = np.stack([*_slope_and_bend(facing * sine, facing * turned, known_speed), facing * cant, passed_m])
    under[:, ~(rolls & (np.abs(known_speed) > SLOWEST_MPS))] = np.nan
    sensed = _by_interval(found.state, found.speed_mps, doubt, swing, under, at, seconds(np.diff(edges)))
    along = trajectory.body_at if trajectory.body_chainage_m is not None else trajectory.chainage_at
    sensed = replace(sensed, under_m=along(sensed.under_m))
    step = 1e-9 * _TICK_NS
    series = RateSeries(
        time=middle, known=when, distance_m=facing * (passed[1:] - passed[0]), arc_m=passed_m, turned_rad=step * turned,
        climbed_rad=step * (turning - found.gyro_bias_radps), speed_mps=facing * speed.speed_mps, rolls=rolls,
    )  # fmt: skip
    return sensed, series, replace(state, tick=int(ticks[-1]), arc_m=float(arc[-1]), slip=slip)


def _slope_and_bend(sine: Floats, turned_radps: Floats, speed_mps: Floats) -> tuple[Floats, Floats]:
    """Return gradient and curvature of the line by the sine of the gradient and the rate of turn."""
    gradient = sine / np.sqrt(1.0 - np.clip(sine, -0.5, 0.5) ** 2)
    return gradient, turned_radps / np.where(speed_mps == 0.0, np.nan, speed_mps)


def _wheel_acceleration(
    pulses: TachometerPulses, ticks: Integers, speed: PulseSpeeds, limits: TachometerLimits
) -> Floats:
    """Return the acceleration by the wheel at the ticks; NaN by a lost tooth, which is no slip."""
    when, earlier, before = ((ticks * _TICK_NS - ago).astype("datetime64[ns]") for ago in (0, _MEAN_NS, _FAULT_NS))
    acceleration = pulse_acceleration(pulse_speeds(pulses, earlier, limits=limits), speed)
    return np.where(faults_until(pulses, when) > faults_until(pulses, before), np.nan, acceleration)


def _means(inertial: InertialSamples, begin: Datetimes, end: Datetimes) -> Floats:
    """Return the mean force and rate between instants, shape (N, 6)."""
    values = np.concatenate([inertial.force_mps2, inertial.rate_radps], axis=1)
    total = np.concatenate([np.zeros((1, 6)), np.cumsum(values, axis=0)])
    first, last = (np.searchsorted(inertial.time, at, side="right") for at in (begin, end))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((total[last] - total[first]) / (last - first)[:, None])


def _by_interval(
    state: Codes, speed_mps: Floats, doubt_mps: Floats, swing_mps2: Floats, under: Floats, at: Integers, span_s: Floats
) -> SensedMotion:
    """Return samples brought together by interval: `at` is the first sample after each instant, 0 after the first.

    `under` has gradient, curvature, cant and the antenna's arc length, shape (4, N).
    """
    count = np.diff(at)
    some = np.flatnonzero(count > 0)
    result = nothing_sensed(len(count))
    first, end = at[some], int(at[-1])
    rank = _RANK[state[:end]]
    # the last sample of the highest rank names the interval
    top = rank == np.repeat(np.maximum.reduceat(rank, first), count[some])
    named = state[np.maximum.reduceat(np.where(top, np.arange(end), -1), first)]
    mean = np.add.reduceat(speed_mps[:end], first) / count[some]
    result.state[some] = named
    result.distance_m[some] = np.where(np.isin(named, CARRIED), mean * span_s[some], np.nan)
    result.doubt_mps[some] = np.maximum.reduceat(doubt_mps[:end], first)
    result.swing_mps2[some] = np.add.reduceat(swing_mps2[:end], first) / count[some]
    outs = (result.gradient, result.curvature_1pm, result.cant_m, result.under_m)
    for values, out in zip(under[:, :end], outs, strict=True):
        there = np.add.reduceat(np.isfinite(values).astype(np.float64), first)
        with np.errstate(invalid="ignore"):
            out[some] = np.add.reduceat(np.nan_to_num(values), first) / np.where(there > 0.0, there, np.nan)
    return result
