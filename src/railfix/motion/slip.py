r"""Detection, from the vehicle's pitch, of slip, slide, low speed and rolling away (P2 2.1); speed in these states.

While the wheel rolls, ``sin(theta_T) = (f_x - a_T) / g`` from accelerometer and tachometer is the sine of the pitch.
During a slip, this sine exceeds the gradient of any line. There are two rules:

* ``"p2"`` detects a slip where ``|sin(theta_T)|`` exceeds the steepest gradient plus an allowance for the pitch of the
  body. This rule detects only changes of the slip speed. The distance error of a long slide at constant slip remains.
* ``"map"`` compares the pitch with the gradient of the line at the present position. Here, a slip ends only when the
  wheel speed agrees with the inertial speed and the pitch agrees with the gradient, or when wheel and train are at rest
  (latch).

During a slip, speed and distance are integrated from the accelerometer, corrected for pitch and offset. With "map", the
integration starts before the detection (`LOOK_BACK_S`). The offset is estimated while the wheel rolls. Without a gyro,
the pitch is the slope of the line where the position is known. With a gyro, the pitch is the integral of the pitch rate
(P2 2.1(3)). It is slowly corrected to the slope of the line or, where the slope is unknown, to the pitch from wheel and
accelerometer.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from enum import IntEnum
from itertools import pairwise
from typing import Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from railfix.core.arrays import Codes, Floats
from railfix.core.constants import GRAVITY_MPS2
from railfix.core.settings import Settings


class MotionState(IntEnum):
    """State of motion, which determines the source of the speed."""

    INIT = 0  #: Not yet initialised; there is no speed.
    STANDING = 1  #: At rest: there was no pulse for a second, and the inertial speed is small.
    LOW_SPEED = 2  #: The train moves too slowly for the tachometer; the inertial speed is used.
    NORMAL = 3  #: The wheel rolls without slip; the speed is the wheel speed.
    INERTIAL_SPIN = 4  #: The wheel is faster than the train; the inertial speed is used.
    INERTIAL_SLIDE = 5  #: The wheel is slower than the train; the inertial speed is used.
    ROLLING = 6  #: The train rolls away from rest, too slowly for the tachometer; the inertial speed is used.
    EXPIRED = 7  #: The inertial speed is too old or implausible; there is no speed.


#: A larger difference between the sine of the pitch from wheel and accelerometer and the sine of the reference pitch
#: indicates a slip. The limit is equivalent to 0.15 m/s2.
_MAP_LIMIT: Final = 0.015
#: As `_MAP_LIMIT`, in sigmas of the difference while the wheel rolls; the larger of the two limits is used. This limit
#: is required because a pitching body accelerates an accelerometer that is mounted high.
_NOISE_SIGMAS: Final = 5.0
_NOISE_S: Final = 30.0  #: Time constant with which the sigma of the difference of the pitch sines is estimated.
_LATCH_MPS: Final = 0.15  #: Largest difference of wheel and inertial speeds at which a slip can end.
_LATCH_SHARE: Final = 0.01  #: As `_LATCH_MPS`, but a fraction of the speed; the larger of the two limits is used.
_LATCH_S: Final = 0.5  #: Time for which the speeds must agree before a slip ends.
#: Integration of a slip's inertial speed starts before the detection, by this time + `confirm_s` + `SMOOTHING_S`.
LOOK_BACK_S: Final = 0.3
#: An inertial speed expires after this time; with the drift `carry_drift_mps2`, its error has then grown to 0.3 m/s.
_LONGEST_CARRY_S: Final = 30.0
#: Time constant of the low-pass filter of the pitch. It suppresses pitching of the body (about 1 Hz) and vibration.
SMOOTHING_S: Final = 0.2
_STANDING_S: Final = 1.0  #: Time without a pulse after which the vehicle is assumed to be at rest.
_STANDING_MPS: Final = 0.5  #: Largest inertial speed at which a train without pulses is assumed to be at rest.
_PITCH_S: Final = 20.0  #: Time constant of the correction of a pitch integrated from the gyro.
#: A larger sine of the pitch from wheel and accelerometer is not used: 0.035 for the line, and a margin.
_STEEPEST: Final = 0.1
_FASTEST_MPS: Final = 100.0  #: A larger inertial speed is implausible; there is then no speed.
#: Time for which the body pitches after a stop. After this time, the measured pitch is the pitch at standstill.
_SETTLING_S: Final = 2.0
_ROLLING_LIMIT: Final = 0.002  #: Change of the pitch sine since standstill that indicates rolling away.
_ROLLING_S: Final = 0.3  #: Time for which a change must persist to indicate rolling away.
_ROLLING_MPS: Final = 0.05  #: Rolling away is declared only if the inertial speed exceeds this.


class SlipLimits(Settings):
    """Limits of the slip detection."""

    #: "map" to compare the pitch with the gradient of the line, "p2" to compare it with the constant `p2_limit`,
    #: without latch and look-back.
    rule: Literal["map", "p2"] = "map"
    #: Largest sine of the pitch without a slip: 35 permille for the line (P2 2.1) and 10 permille for the body. It is
    #: used by the rule "p2", and by "map" where neither the line nor a gyro is available.
    p2_limit: float = Field(default=0.045, gt=0)
    confirm_s: float = Field(default=0.1, ge=0)  #: Time for which the limit must be exceeded before a slip is declared.
    #: Assumed drift of the inertial speed; the speed tolerance of the latch grows at this rate. 1e-3 of gravity covers
    #: accelerometer offset and pitch error together.
    carry_drift_mps2: float = Field(default=0.01, ge=0)
    offset_s: float = Field(default=60.0, gt=0)  #: Time constant with which the accelerometer offset is estimated.
    #: Time constant with which the gyro bias is estimated.
    bias_s: float = Field(default=200.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class SlipResult:
    """Speed, distance and state of motion at N samples."""

    state: Codes  #: Values of `MotionState`, shape (N,).
    #: Speed, shape (N,): wheel speed in NORMAL, NaN in INIT and EXPIRED, inertial speed (0 at rest) in other states.
    speed_mps: Floats
    #: Integral of the speed from the first sample, shape (N,); the inertial speed of a slip begins before its detection
    #: (`LOOK_BACK_S`). At the end of a slip, the distance is corrected for the difference of wheel and inertial speeds,
    #: which is assumed to have grown linearly.
    distance_m: Floats
    #: Sine of the pitch from wheel and accelerometer, minus `pitch`; NaN without pulses; shape (N,).
    metric: Floats
    smooth: Floats  #: `metric` minus the accelerometer offset, low-pass filtered with `SMOOTHING_S`; shape (N,).
    pitch: Floats  #: Sine of the reference pitch; NaN before the first estimate; shape (N,).
    gyro_bias_radps: Floats  #: Estimated bias of the pitch rate; 0 without a gyro; shape (N,).


@dataclass(frozen=True, kw_only=True)
class SlipState:
    """State of `find_slips` after a call."""

    time_s: float  #: Time of the last sample.
    automaton: _Automaton


def pitch_rate_radps(force_mps2: Floats, rate_radps: Floats, speed_mps: Floats) -> Floats:
    """Compute the rate of the pitch angle [rad/s], shape (N,), from body forces and rates, shape (N, 3).

    The rate is ``w_y cos(phi) - w_z sin(phi)`` with the roll ``sin(phi) = (v w_z - f_y) / g``, which results from the
    cant. Without the roll, the rate would be wrong by 3.4 mrad/s in a curve of 400 m radius at 17 m/s.
    """
    sine = roll_sine(force_mps2, rate_radps, speed_mps)
    return np.asarray(rate_radps[:, 1] * np.sqrt(1.0 - sine**2) - rate_radps[:, 2] * sine)


def heading_rate_radps(force_mps2: Floats, rate_radps: Floats, speed_mps: Floats) -> Floats:
    """Compute the rate of the heading [rad/s], shape (N,): ``w_z cos(phi) + w_y sin(phi)``, with the roll phi."""
    sine = roll_sine(force_mps2, rate_radps, speed_mps)
    return np.asarray(rate_radps[:, 2] * np.sqrt(1.0 - sine**2) + rate_radps[:, 1] * sine)


def roll_sine(force_mps2: Floats, rate_radps: Floats, speed_mps: Floats) -> Floats:
    """Compute the sine of the roll to the right, ``(v w_z - f_y) / g`` limited to +-0.5, shape (N,)."""
    return np.clip((speed_mps * rate_radps[:, 2] - force_mps2[:, 1]) / GRAVITY_MPS2, -0.5, 0.5)


class MotionSamples(NamedTuple):
    """N samples of wheel and body motion, at 10 to 100 Hz."""

    time_s: Floats  #: Times in ascending order, shape (N,).
    wheel_mps: Floats  #: Speed of the wheel, NaN without pulses; shape (N,).
    wheel_mps2: Floats  #: Acceleration of the wheel, NaN without pulses; shape (N,).
    force_mps2: Floats  #: Specific force in the forward direction of the vehicle, shape (N,).
    #: Sine of the line's slope angle at the vehicle, shape (N,), positive if the line rises forward; NaN if unknown.
    line_sine: Floats
    #: Specific force to the right [m/s2], pitch rate and yaw rate of the body [rad/s], shape (N, 3); NaN if missing.
    #: `find_slips` computes the rate of the pitch angle with the inertial speed during a slip, because the speed of a
    #: slipping wheel would result in a wrong roll.
    body: Floats | None = None
    #: Time since the last pulse, shape (N,); if missing, the time since the last wheel speed is used instead. A very
    #: slow train has pulses, but no wheel speed.
    since_pulse_s: Floats | None = None


def find_slips(
    samples: MotionSamples, *, limits: SlipLimits | None = None, state: SlipState | None = None
) -> tuple[SlipResult, SlipState | None]:
    """Compute state of motion, speed and distance at each sample from samples up to this sample.

    `state` is the state returned by the previous call, None at the start. Also return the state for the next call.
    """
    limits, (time_s, *given, body, since_pulse_s) = limits or SlipLimits(), samples
    size = len(time_s)
    automaton = _Automaton(limits) if state is None else state.automaton.copy(limits)
    steps = np.diff(time_s, prepend=time_s[:1] if state is None else state.time_s).tolist()
    turning = np.full((size, 3), np.nan) if body is None else body
    since = np.full(size, np.nan) if since_pulse_s is None else since_pulse_s
    columns = (*given, turning, since)
    rows = np.empty((size, 7))
    for k, (dt, *values) in enumerate(zip(steps, *(column.tolist() for column in columns), strict=True)):
        automaton.step(dt, *values)
        rows[k] = automaton.row()
    states, speed, distance, metric, smooth, pitch, bias = rows.T
    result = SlipResult(
        state=states.astype(np.int8),
        speed_mps=speed,
        distance_m=distance,
        metric=metric,
        smooth=smooth,
        pitch=pitch,
        gyro_bias_radps=bias,
    )
    return result, SlipState(time_s=float(time_s[-1]), automaton=automaton) if size else state


@dataclass
class _Automaton:
    """State machine of the motion, updated sample by sample."""

    limits: SlipLimits
    state: MotionState = MotionState.INIT
    speed: float = float("nan")
    distance: float = 0.0
    metric: float = float("nan")
    offset: float = 0.0
    pitch: float = float("nan")
    bias: float = 0.0
    _smooth: float = 0.0
    _limit: float = _MAP_LIMIT
    _square: float = 0.0
    _over: float = 0.0
    _fits: float = 0.0
    _gap: float = 0.0
    _silent: float = 0.0
    _carried: float = 0.0
    _apart: float = 0.0
    _age: float = 0.0
    _stood: float = 0.0
    _learnt: float = 0.0
    _rest: float = float("nan")
    #: Time, speed and inertial acceleration of past samples, for `_look_back`.
    _past: deque[tuple[float, float, float]] = field(default_factory=lambda: deque(maxlen=200))

    def copy(self, limits: SlipLimits) -> _Automaton:
        """Return a copy with the given limits; a `SlipState` that was already returned must stay unchanged."""
        return replace(self, limits=limits, _past=self._past.copy())

    def row(self) -> tuple[float, ...]:
        """Return the values of `SlipResult` at the last sample, in the order of its fields."""
        return self.state, self.speed, self.distance, self.metric, self._smooth, self.pitch, self.bias

    def step(
        self, dt: float, wheel: float, acceleration: float, force: float, sine: float, body: list[float], since: float
    ) -> None:
        limits, heard = self.limits, wheel == wheel
        rate = self._pitch_rate(wheel, *body)
        self._age += dt
        self._silent = 0.0 if heard else self._silent + dt
        if since == since:
            self._silent = since
        measured = heard and acceleration == acceleration
        rests = self.state == MotionState.STANDING and self._stood >= _SETTLING_S
        own = 0.0 if rests else acceleration if measured else float("nan")
        by_wheel = (force - own - self.offset) / GRAVITY_MPS2
        known = rests or self.pitch != self.pitch or (self.state == MotionState.NORMAL and self._over == 0.0)
        self._follow(dt, sine, by_wheel if known and abs(by_wheel) <= _STEEPEST else float("nan"), rate, rests=rests)
        reference = self.pitch
        inertial = force - GRAVITY_MPS2 * reference - self.offset
        self.metric = (force - acceleration) / GRAVITY_MPS2 - reference if measured else float("nan")
        if self.metric == self.metric:
            share = min(dt / SMOOTHING_S, 1.0)
            self._smooth += share * (self.metric - self.offset / GRAVITY_MPS2 - self._smooth)
        # without line and gyro, the reference pitch remains constant and belongs to an earlier position
        least = _MAP_LIMIT if sine == sine or rate == rate else limits.p2_limit
        self._limit = max(least, _NOISE_SIGMAS * self._square**0.5)
        if self.state in (MotionState.INERTIAL_SPIN, MotionState.INERTIAL_SLIDE):
            self._carry(dt, inertial)
            self._release(dt, wheel, force, heard=heard)
        elif heard:
            self._roll(dt, wheel, acceleration, inertial, sine)
        else:
            self._quiet(dt, force, inertial)
        if self.speed == self.speed:
            self.distance += self.speed * dt
        self._past.append((self._age, self.speed, inertial))

    def _pitch_rate(self, wheel: float, right: float, pitching: float, yawing: float) -> float:
        """Return the rate of the pitch angle at a sample; during a slip, the inertial speed is used."""
        slips = self.state in (MotionState.INERTIAL_SPIN, MotionState.INERTIAL_SLIDE)
        speed = self.speed if slips or wheel != wheel else wheel
        lean = min(max(((speed if speed == speed else 0.0) * yawing - right) / GRAVITY_MPS2, -0.5), 0.5)
        return float(pitching * (1.0 - lean * lean) ** 0.5 - yawing * lean)

    def _follow(self, dt: float, sine: float, by_wheel: float, rate: float, *, rests: bool) -> None:
        """Update the reference pitch and the gyro bias.

        At rest, the gyro bias is the mean rate over `bias_s`.
        """
        limits, known = self.limits, sine == sine
        target = sine if known else by_wheel
        if self.pitch != self.pitch:
            self.pitch = target
            return
        turning = rate == rate
        if turning:
            self.pitch += (rate - self.bias) * dt
            self._learnt += dt
            if rests:
                self.bias += dt / min(max(self._learnt, dt), limits.bias_s) * (rate - self.bias)
        elif known:
            self.pitch = sine
            return
        if target == target:
            gap = target - self.pitch
            self.pitch += min(dt / _PITCH_S, 1.0) * gap
            if turning and not rests:
                self.bias -= gap * dt / (_PITCH_S * limits.bias_s)

    def _carry(self, dt: float, inertial: float) -> None:
        self.speed += inertial * dt
        self._carried += dt
        if self._carried > _LONGEST_CARRY_S or abs(self.speed) > _FASTEST_MPS:
            self.state, self.speed = MotionState.EXPIRED, float("nan")

    def _stand(self, force: float) -> None:
        """Start a standstill, with the present force as the force at rest."""
        self.state, self.speed, self._rest = MotionState.STANDING, 0.0, force
        self._apart = self._carried = self._stood = 0.0

    def _release(self, dt: float, wheel: float, force: float, *, heard: bool) -> None:
        """End a slip if wheel and train are at rest, or if wheel speed and pitch are plausible again."""
        limits = self.limits
        if self._silent >= _STANDING_S and abs(self.speed) < _STANDING_MPS:
            self._stand(force)
            return
        if limits.rule == "p2":
            back = heard and abs(self.metric) <= limits.p2_limit
            if back:
                self.state, self.speed = MotionState.NORMAL, wheel
            return
        near = max(_LATCH_MPS, _LATCH_SHARE * abs(self.speed)) + limits.carry_drift_mps2 * self._carried
        fits = heard and abs(wheel - self.speed) < near and abs(self._smooth) < self._limit
        self._gap = self._gap + (wheel - self.speed) * dt if fits else 0.0
        self._fits = self._fits + dt if fits else 0.0
        if self._fits >= _LATCH_S:
            lasted = self._carried + LOOK_BACK_S + limits.confirm_s + SMOOTHING_S
            self.distance += 0.5 * lasted * (self._gap / self._fits if self._fits else 0.0)
            self.state, self.speed, self._over = MotionState.NORMAL, wheel, 0.0

    def _roll(self, dt: float, wheel: float, acceleration: float, inertial: float, sine: float) -> None:
        """Use the wheel speed, or declare a slip if the pitch has contradicted the wheel speed for `confirm_s`."""
        limits = self.limits
        self.state, self._carried = MotionState.NORMAL, 0.0
        self._rest = float("nan")
        if limits.rule == "p2":
            value = self.metric + self.pitch
            over = acceleration == acceleration and abs(value) > limits.p2_limit
        else:
            over, value = abs(self._smooth) > self._limit, self._smooth
        self._over = self._over + dt if over else 0.0
        self.speed = wheel
        if not over:
            self._square += min(dt / _NOISE_S, 1.0) * (self._smooth**2 - self._square)
        if not over and sine == sine:
            share = min(dt / limits.offset_s, 1.0)
            self.offset += share * GRAVITY_MPS2 * self._smooth
        if self._over > 0.0 and self._over >= limits.confirm_s:
            self.state = MotionState.INERTIAL_SPIN if value < 0 else MotionState.INERTIAL_SLIDE
            self._fits = self._gap = self._over = 0.0
            if limits.rule == "map":
                self._look_back(inertial, dt)

    def _look_back(self, inertial: float, dt: float) -> None:
        """Recompute speed and distance from the inertial acceleration, beginning shortly before the detection."""
        begin = self._age - LOOK_BACK_S - self.limits.confirm_s - SMOOTHING_S
        past = [entry for entry in self._past if entry[0] >= begin and entry[1] == entry[1]]
        if not past:
            return
        speed, old_distance, new_distance = past[0][1], 0.0, 0.0
        for before, after in pairwise(past):
            step = after[0] - before[0]
            speed += after[2] * step
            old_distance += after[1] * step
            new_distance += speed * step
        self.speed = speed + inertial * dt
        self.distance += new_distance - old_distance

    def _quiet(self, dt: float, force: float, inertial: float) -> None:
        """Update state and speed of a train without pulses: low speed, standstill or rolling away."""
        if self.state == MotionState.NORMAL:
            self.state = MotionState.LOW_SPEED
        if self.state == MotionState.LOW_SPEED:
            self.speed = max(self.speed + inertial * dt, 0.0) if self.speed >= 0 else min(self.speed + inertial * dt, 0)
            self._carried += dt
        if self.state in (MotionState.STANDING, MotionState.ROLLING):
            self._watch(dt, force)
        elif self.state == MotionState.INIT:
            return  # a tachometer that has never sent a pulse may be defective
        elif self._silent >= _STANDING_S and not abs(self.speed) > _STANDING_MPS:
            self._stand(force)
        elif self._carried > _LONGEST_CARRY_S:
            self.state, self.speed = MotionState.EXPIRED, float("nan")

    def _watch(self, dt: float, force: float) -> None:
        """Detect rolling away by comparing the forward force with its value at standstill, a component of gravity."""
        limits = self.limits
        self._stood += dt
        if self.state == MotionState.STANDING and self._stood < _SETTLING_S:
            self._rest = force
        change = force - self._rest
        moved = abs(change) > _ROLLING_LIMIT * GRAVITY_MPS2
        if self.state == MotionState.STANDING:
            self._apart = self._apart + dt if moved else 0.0
            if not moved:
                self._rest += min(dt / limits.offset_s, 1.0) * change
                self.speed = 0.0
                return
            # On a freely rolling train, the forward force is 0: its change since standstill equals the acceleration.
            self.speed += change * dt
            if self._apart >= _ROLLING_S and abs(self.speed) > _ROLLING_MPS:
                self.state = MotionState.ROLLING
        else:
            self._carry(dt, change)
