"""Motion between epochs by wheel and inertial unit: slips, inertial distances, and the line under the body."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Codes, Datetimes, Floats, Integers
from railfix.core.constants import GRAVITY_MPS2
from railfix.core.timescale import seconds
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
from railfix.pipeline.passed_features import SLOWEST_MPS, RateSeries
from railfix.track.trajectory import Trajectory

#: Sample interval of the slip detection [ns]; sample times are multiples of this interval in GPS time.
_TICK_NS: Final = 20_000_000
#: Averaging time of wheel accelerations and inertial means [ns].
_MEAN_NS: Final = 200_000_000
#: The wheel acceleration is not used for this time after a lost or doubled pulse [ns].
_FAULT_NS: Final = _MEAN_NS + 150_000_000
#: The next chunk needs the samples of this interval before the last epoch.
REACH: Final = np.timedelta64(_MEAN_NS + 200_000_000, "ns")
#: Motion states in which the inertial unit provides the distance.
CARRIED: Final = (
    MotionState.STANDING,
    MotionState.LOW_SPEED,
    MotionState.INERTIAL_SPIN,
    MotionState.INERTIAL_SLIDE,
    MotionState.ROLLING,
)  # The state of an interval is the sample state with the highest `_RANK`.
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
    """Motion in T intervals between epochs; forward is the direction in which the vehicle's front points."""

    state: Codes  #: `railfix.motion.slip.MotionState`; INIT unless there are both sensors; shape (T,).
    distance_m: Floats  #: Forward distance by inertia if the state is one of `CARRIED`, else NaN; shape (T,).
    doubt_mps: Floats  #: Largest slip speed that can be undetected, shape (T,).
    #: Part of the mean forward specific force due to pitching of the body, 0 without a gyro; shape (T,).
    swing_mps2: Floats
    #: Gradient of the line under the body, positive if the line rises with arc length, from wheel and accelerometer (P2
    #: 2.3); an accelerometer offset of 0.01 m/s2 causes an error of 0.001. The gradient and the next three fields are
    #: NaN unless the wheel rolls without slip and faster than `SLOWEST_MPS`; shape (T,) each.
    gradient: Floats
    curvature_1pm: Floats  #: Curvature from the yaw rate, positive if the line turns right toward rising arc length.
    #: Cant between the wheels' contact points, from the roll of the body; positive if the left rail is higher; NaN
    #: without a vehicle.
    cant_m: Floats
    under_m: Floats  #: Chainage of the body's middle.


@dataclass(frozen=True, kw_only=True)
class SensedState:
    """State of the sensed motion after a chunk."""

    tick: int = 0  #: Time tag of the last sample (`time`) in units of `_TICK_NS`; 0 before the first sample.
    #: Antenna position at the last sample, dead-reckoned with the wheel from the last filter position; NaN if unknown.
    arc_m: float = float("nan")
    sigma_m: float = float("nan")  #: Standard deviation of the filter position where dead reckoning began.
    slip: SlipState | None = None

    @property
    def time(self) -> np.datetime64:
        """Time of the last sample."""
        return np.datetime64(self.tick * _TICK_NS, "ns")


def nothing_sensed(intervals: int) -> SensedMotion:
    """Return the result for a train without sensors."""
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
    """Return the motion between `edges`, the body rates (None without a sample), and the state for the next chunk.

    Signed pulses and inertial samples begin `REACH` before the first of the T + 1 `edges`. `sine_at` returns the sine
    of the gradient, in rising arc length, at given arc lengths. The antenna's trajectory determines the direction of
    the front and the position of the body.
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
    # the speed from pulses is valid at the middle of the pulse interval. Without the correction by `ago`, the speed
    # would be late by 0.065 s, which causes an error of 0.2 m in a slip of 3 s at 1 m/s2.
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
    # mean rates refer to the middle of the averaging interval
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
    """Return the gradient and the curvature of the line from the sine of the gradient and the rate of turn."""
    gradient = sine / np.sqrt(1.0 - np.clip(sine, -0.5, 0.5) ** 2)
    return gradient, turned_radps / np.where(speed_mps == 0.0, np.nan, speed_mps)


def _wheel_acceleration(
    pulses: TachometerPulses, ticks: Integers, speed: PulseSpeeds, limits: TachometerLimits
) -> Floats:
    """Return the wheel acceleration at the ticks; NaN after a lost tooth, which would otherwise count as a slip."""
    when, earlier, before = ((ticks * _TICK_NS - ago).astype("datetime64[ns]") for ago in (0, _MEAN_NS, _FAULT_NS))
    acceleration = pulse_acceleration(pulse_speeds(pulses, earlier, limits=limits), speed)
    return np.where(faults_until(pulses, when) > faults_until(pulses, before), np.nan, acceleration)


def _means(inertial: InertialSamples, begin: Datetimes, end: Datetimes) -> Floats:
    """Return mean forces and rates between instants, shape (N, 6)."""
    values = np.concatenate([inertial.force_mps2, inertial.rate_radps], axis=1)
    total = np.concatenate([np.zeros((1, 6)), np.cumsum(values, axis=0)])
    first, last = (np.searchsorted(inertial.time, at, side="right") for at in (begin, end))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((total[last] - total[first]) / (last - first)[:, None])


def _by_interval(
    state: Codes, speed_mps: Floats, doubt_mps: Floats, swing_mps2: Floats, under: Floats, at: Integers, span_s: Floats
) -> SensedMotion:
    """Group samples by interval; `at` has the index of the first sample after each interval limit (first value 0).

    `under` has gradient, curvature, cant and the antenna's arc length, shape (4, N).
    """
    count = np.diff(at)
    some = np.flatnonzero(count > 0)
    result = nothing_sensed(len(count))
    first, end = at[some], int(at[-1])
    rank = _RANK[state[:end]]
    # the last sample of the highest rank determines the interval's state
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
