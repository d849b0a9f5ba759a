"""Chainage and speed of the train over time, and true positions of its antennas.

The motion is a shuttle between two points, or a run curve: stops at stations, and the highest speed that line, curves
and train permit between stops. Antennas are on a rigid body with both bogie centres on the continuous line; their
positions are computed by Newton's method and Rodrigues' rotation, independently of `railfix.track.vehicle`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from railfix.core.arrays import Floats
from railfix.core.constants import GRAVITY_MPS2
from railfix.core.geodesy import axes_at
from railfix.simulate.alignment import Alignment
from railfix.simulate.errors import RandomFunction
from railfix.simulate.scenario import RunSettings, Scenario, Station, VehicleSettings

if TYPE_CHECKING:
    from railfix.simulate.scenario import Scenario


_ROUNDS: Final = 20  #: Maximum number of rounds that increase the averaging time until the jerk is within its limit.


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Motion of the train in P pieces of constant jerk, or of constant acceleration if the jerk is not limited.

    Speed, acceleration and jerk are positive toward rising chainage. The last piece has no end.
    """

    time_s: Floats  #: Start of each piece, from 0, in ascending order, shape (P,).
    chainage_m: Floats  #: Chainage at the start of each piece, shape (P,).
    speed_mps: Floats  #: Speed at the start of each piece, shape (P,).
    acceleration_mps2: Floats  #: Acceleration at the start of each piece, shape (P,).
    jerk_mps3: Floats | float = 0.0  #: Jerk of each piece, shape (P,) [m/s^3].

    def at(self, time_s: ArrayLike) -> tuple[Floats, Floats]:
        """Return the chainage [m] and speed [m/s] at times; before time 0, the values at time 0."""
        time = np.asarray(time_s, dtype=np.float64)
        piece = np.maximum(np.searchsorted(self.time_s, time, side="right") - 1, 0)
        since = np.maximum(time - self.time_s[piece], 0.0)
        speed = self.speed_mps[piece] + self.acceleration_mps2[piece] * since
        chainage = self.chainage_m[piece] + (self.speed_mps[piece] + speed) / 2.0 * since
        if not np.any(self.jerk_mps3):
            return chainage, speed
        jerk = np.asarray(self.jerk_mps3)[piece]
        return chainage + jerk * since**3 / 6.0, speed + jerk * since**2 / 2.0

    def acceleration_at(self, time_s: ArrayLike) -> Floats:
        """Return the acceleration along the line at times [m/s^2]; 0 before time 0."""
        time = np.asarray(time_s, dtype=np.float64)
        piece = np.searchsorted(self.time_s, time, side="right") - 1
        at = np.maximum(piece, 0)
        acceleration = self.acceleration_mps2[at]
        if np.any(self.jerk_mps3):
            acceleration = acceleration + np.asarray(self.jerk_mps3)[at] * (time - self.time_s[at])
        return np.where(piece < 0, 0.0, acceleration)


def limit_jerk(motion: Motion, jerk_mps3: float) -> Motion:
    """Return the motion averaged over a time T, which is chosen so that the jerk is within its limit.

    The speed becomes ``(s(t) - s(t - T)) / T`` with the chainage s, so that the motion is delayed by T / 2 on average.
    """
    start = motion.time_s
    duration = float(np.abs(np.diff(motion.acceleration_mps2, prepend=0.0)).max()) / jerk_mps3
    if duration == 0.0:
        return motion
    for _ in range(_ROUNDS):
        change = float(np.abs(_acceleration_change(motion, _breakpoints(start, duration), duration)).max())
        if change <= jerk_mps3 * duration * (1.0 + 1e-9):
            break
        duration = change / jerk_mps3
    time = _breakpoints(start, duration)
    chainage, speed = motion.at(time)
    earlier_chainage, earlier_speed = motion.at(time - duration)
    new_speed = (chainage - earlier_chainage) / duration
    new_acceleration = (speed - earlier_speed) / duration
    new_jerk = _acceleration_change(motion, time, duration) / duration
    step = np.diff(time)
    way = new_speed[:-1] * step + new_acceleration[:-1] * step**2 / 2.0 + new_jerk[:-1] * step**3 / 6.0
    return Motion(
        time_s=time,
        chainage_m=motion.chainage_m[0] + np.concatenate([[0.0], np.cumsum(way)]),
        speed_mps=new_speed,
        acceleration_mps2=new_acceleration,
        jerk_mps3=new_jerk,
    )


def _breakpoints(start_s: Floats, duration_s: float) -> Floats:
    return np.unique(np.concatenate([start_s, start_s + duration_s]))


def _acceleration_change(motion: Motion, time_s: Floats, duration_s: float) -> Floats:
    """Return the acceleration just after breakpoints minus the acceleration earlier by `duration_s` [m/s^2]."""
    after = time_s + 1e-9
    return np.asarray(motion.acceleration_at(after) - motion.acceleration_at(after - duration_s))


_STEP_M: Final = 2.0  #: Spacing of the positions at which the speed limits of a run curve are evaluated [m].
_RAIL_HEAD_M: Final = 0.070  #: Distance between a wheelset's contact points, minus the gauge [m].


def build_motion(line: Alignment, scenario: Scenario, *, duration_s: float | None = None) -> Motion:
    """Return the motion of the middle of the vehicle: a run curve if the scenario specifies one, otherwise a shuttle.

    The motion covers `duration_s`, by default the duration of the scenario; with a duration of 0, the motion ends at
    the last stop of the first leg. Raise SettingsError if the train does not fit on the line.
    """
    settings = scenario.run
    scenario.check_room(line.length_m)
    lasting = scenario.duration_s if duration_s is None else duration_s
    margin = settings.end_margin_m
    usual = RunSettings()
    plain = ("stations", "limits", "cant_deficiency_m", "direction", "at_end")
    if all(getattr(settings, name) == getattr(usual, name) for name in plain):
        motion = shuttle(margin, line.length_m - margin, lasting, settings)
    else:
        motion = run_curve(line, settings, lasting, contact_m=scenario.vehicle.gauge_m + _RAIL_HEAD_M)
    return motion if settings.jerk_mps3 is None else limit_jerk(motion, settings.jerk_mps3)


def shuttle(first_m: float, last_m: float, duration_s: float, settings: RunSettings) -> Motion:
    """Return the motion back and forth between two chainages for at least `duration_s`, with standstill at each end."""
    length = last_m - first_m
    up, down = settings.acceleration_mps2, settings.deceleration_mps2
    top = min(settings.cruise_mps, float(np.sqrt(2.0 * length * up * down / (up + down))))
    cruise_s = max(0.0, (length - top**2 / (2.0 * up) - top**2 / (2.0 * down)) / top)
    # Phases of a leg, with signs relative to the direction of travel: acceleration, cruising, braking, standstill.
    steps = np.array([top / up, cruise_s, top / down, settings.stand_s])
    offsets = np.array([0.0, top**2 / (2.0 * up), length - top**2 / (2.0 * down), length])
    speeds, accelerations = np.array([0.0, top, top, 0.0]), np.array([up, 0.0, -down, 0.0])
    legs = max(1, int(np.ceil((duration_s - settings.first_stand_s) / steps.sum())))
    outward = (np.arange(legs) % 2 == 0)[:, None]
    sign = np.where(outward, 1.0, -1.0)
    chainage = np.where(outward, first_m + offsets, last_m - offsets).ravel()
    ends = settings.first_stand_s + np.cumsum(np.tile(steps, legs))
    return Motion(
        time_s=np.concatenate([[0.0, settings.first_stand_s], ends[:-1]]),
        chainage_m=np.concatenate([[first_m], chainage]),
        speed_mps=np.concatenate([[0.0], (sign * speeds).ravel()]),
        acceleration_mps2=np.concatenate([[0.0], (sign * accelerations).ravel()]),
    )


def run_curve(line: Alignment, settings: RunSettings, duration_s: float, *, contact_m: float) -> Motion:
    """Return the motion from stop to stop at the highest permitted speed. It lasts at least `duration_s` and ends at
    the last stop of a leg.

    `contact_m` is the distance between the contact points of a wheelset, which determines the speed in canted curves.
    """
    margin = settings.end_margin_m
    ends = (
        Station(at_m=margin, dwell_s=settings.stand_s),
        Station(at_m=line.length_m - margin, dwell_s=settings.stand_s),
    )
    stops = settings.stations or ends
    if settings.direction == "falling":
        stops = stops[::-1]
    time, pieces = settings.first_stand_s, [np.array([[0.0], [stops[0].at_m], [0.0], [0.0]])]
    while True:
        for start, stop in pairwise(stops):
            leg = _leg(line, settings, start.at_m, stop.at_m, contact_m)
            leg[0] += time
            time = float(leg[0, -1]) + stop.dwell_s
            pieces.append(leg)
        if time >= duration_s or settings.at_end == "stand":
            break
        stops = stops[::-1]
    table = np.concatenate(pieces, axis=1)
    return Motion(time_s=table[0], chainage_m=table[1], speed_mps=table[2], acceleration_mps2=table[3])


def _leg(line: Alignment, settings: RunSettings, first_m: float, last_m: float, contact_m: float) -> Floats:
    """Return the motion from one standstill to the next, shape (4, P).

    The rows are time since the start, chainage, speed and acceleration. The square of the speed at a position is at
    most the square of each speed limit plus ``2 a`` times the distance to this limit, where ``a`` is the acceleration
    for limits behind the position, and the deceleration for limits ahead.
    """
    cells = max(2, int(np.ceil(abs(last_m - first_m) / _STEP_M)))
    way = np.linspace(0.0, abs(last_m - first_m), cells + 1)
    sign = 1.0 if last_m > first_m else -1.0
    square = _limits(line, settings, first_m + sign * way, contact_m) ** 2
    # A speed limit applies to the cells on both sides of the position at which it was evaluated.
    square = np.minimum(square, np.minimum(np.append(square[1:], np.inf), np.append(np.inf, square[:-1])))
    square[[0, -1]] = 0.0
    up, down = 2.0 * settings.acceleration_mps2 * way, 2.0 * settings.deceleration_mps2 * way
    square = np.minimum(square, np.minimum.accumulate(square - up) + up)
    square = np.maximum(np.minimum(square, np.minimum.accumulate((square + down)[::-1])[::-1] - down), 0.0)
    square[[0, -1]] = 0.0
    # Neighbouring cells of equal acceleration are combined into one piece.
    acceleration = np.diff(square) / (2.0 * np.diff(way))
    change = np.flatnonzero(np.abs(np.diff(acceleration)) > 1e-6) + 1
    corner = np.concatenate([[0], change, [cells]])
    way, speed = way[corner], np.sqrt(square[corner])
    acceleration = np.diff(square[corner]) / (2.0 * np.diff(way))
    lasting = 2.0 * np.diff(way) / (speed[:-1] + speed[1:])
    return np.stack(
        [
            np.concatenate([[0.0], np.cumsum(lasting)]),
            np.append(first_m + sign * way[:-1], last_m),
            sign * speed,
            np.append(sign * acceleration, 0.0),
        ]
    )


def _limits(line: Alignment, settings: RunSettings, chainage_m: Floats, contact_m: float) -> Floats:
    """Return the highest speed [m/s] that cruising speed, speed limits and cant deficiency permit at chainages."""
    limit = np.full(chainage_m.shape, settings.cruise_mps)
    for part in settings.limits:
        inside = (chainage_m >= part.from_m) & (chainage_m <= part.to_m)
        limit[inside] = np.minimum(limit[inside], part.limit_mps)
    if settings.cant_deficiency_m is not None:
        bend = np.abs(line.curvature_at(chainage_m))
        cant = np.abs(line.lean_at(chainage_m)) + settings.cant_deficiency_m
        # Equilibrium: v^2 curvature / g = cant / distance between the contact points.
        limit = np.minimum(limit, np.sqrt(GRAVITY_MPS2 * cant / (contact_m * np.maximum(bend, 1e-9))))
    return limit


@dataclass(frozen=True, kw_only=True)
class AntennaTruth:
    """True positions of an antenna at n positions of the vehicle."""

    ecef_m: Floats  #: Position of the antenna, shape (n, 3).
    #: Chainage of the centreline point abeam the antenna, in the plane perpendicular to the straight line through the
    #: bogie centres, shape (n,).
    chainage_m: Floats
    forward: Floats  #: Unit vector of the longitudinal axis of the body, shape (n, 3).


def antenna_truth(
    line: Alignment,
    vehicle: VehicleSettings,
    offset_m: tuple[float, float, float],
    middle_m: Floats,
    sway_rad: Floats | float = 0.0,
    pitch_rad: Floats | None = None,
) -> AntennaTruth:
    """Return the true positions of an antenna at n positions of the vehicle.

    Parameters
    ----------
    offset_m : tuple of float [m]
        Position of the antenna in the body: along, across to the right, above the rail tops.
    middle_m : ndarray, shape (n,) [m]
        Chainage midway between the chainages of the two bogie centres.
    sway_rad : ndarray, shape (n,), or float [rad]
        Lean of the body to the right in addition to the cant.
    pitch_rad : ndarray, shape (n,), optional [rad]
        Rotation in addition to the gradient, about the point between the bogies at the rail tops, positive where the
        front rises.
    """
    middle = np.asarray(middle_m, dtype=np.float64)
    half = np.full(middle.shape, vehicle.bogie_distance_m / 2.0)
    for _ in range(5):
        between = line.at(middle + half) - line.at(middle - half)
        length = np.linalg.norm(between, axis=-1)
        rate = np.einsum("ni,ni->n", between, line.tangent_at(middle + half) + line.tangent_at(middle - half)) / length
        half = half - (length - vehicle.bogie_distance_m) / rate
    rear, front = line.at(middle - half), line.at(middle + half)
    forward = front - rear
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    origin = 0.5 * (rear + front)
    vertical = axes_at(origin)[:, 2]
    upright = vertical - np.einsum("ni,ni->n", vertical, forward)[:, None] * forward
    upright /= np.linalg.norm(upright, axis=-1, keepdims=True)
    contact = vehicle.gauge_m + _RAIL_HEAD_M
    lean = 0.5 * (np.arcsin(line.lean_at(middle - half) / contact) + np.arcsin(line.lean_at(middle + half) / contact))
    lean = lean + sway_rad
    along, across, up = offset_m
    chord = forward
    if pitch_rad is not None:
        cosine, sine = np.cos(pitch_rad)[:, None], np.sin(pitch_rad)[:, None]
        forward, upright = cosine * forward + sine * upright, cosine * upright - sine * forward
    arm = across * np.cross(forward, upright) + up * upright
    # A lean to the right is a rotation about the forward axis of the body.
    turned = np.cos(lean)[:, None] * arm + np.sin(lean)[:, None] * np.cross(forward, arm)
    place = origin + along * forward + turned
    abeam = middle + along
    for _ in range(5):
        ahead = np.einsum("ni,ni->n", line.at(abeam) - place, chord)
        abeam = abeam - ahead / np.einsum("ni,ni->n", line.tangent_at(abeam), chord)
    return AntennaTruth(ecef_m=place, chainage_m=abeam, forward=forward)


FULL_SPEED_MPS: Final = 20.0  #: From this speed on, random motions of the body have full amplitude [m/s].
_STEP_S: Final = 0.01  #: Time step of the computation of pitch due to accelerations [s].
_DAMPING: Final = 0.3  #: Damping ratio of the suspension.
_MARGIN_S: Final = 2.0  #: Pitch is also computed for this time before and after the run [s].


class BodyMotion:
    """Roll and pitch of the vehicle of a scenario over time, drawn from the seed of the scenario."""

    def __init__(self, scenario: Scenario, motion: Motion) -> None:
        vehicle = self._vehicle = scenario.vehicle
        self._motion, self._duration_s = motion, scenario.duration_s
        sway, pitch = np.radians(vehicle.sway_sigma_deg), np.radians(vehicle.pitch_sigma_deg)
        rng = np.random.default_rng([scenario.seed, 13])
        self._roll = RandomFunction.periodic(rng, sigma=float(sway), period=vehicle.sway_period_s)
        rng = np.random.default_rng([scenario.seed, 17])
        self._pitch = RandomFunction.periodic(rng, sigma=float(pitch), period=vehicle.pitch_period_s)

    def roll_rad(self, time_s: Floats, speed_mps: Floats) -> Floats:
        """Return the lean to the right in addition to the cant at times and speeds [rad]; 0 at standstill."""
        return self._roll.at(time_s) * np.minimum(np.abs(speed_mps) / FULL_SPEED_MPS, 1.0)

    def pitch_rad(self, time_s: Floats, speed_mps: Floats) -> Floats | None:
        """Return the pitch at times and speeds [rad], positive where the front rises; None if no pitch is set."""
        vehicle = self._vehicle
        if vehicle.pitch_sigma_deg == 0.0 and vehicle.pitch_deg_per_mps2 == 0.0:
            return None
        random = self._pitch.at(time_s) * np.minimum(np.abs(speed_mps) / FULL_SPEED_MPS, 1.0)
        return random if vehicle.pitch_deg_per_mps2 == 0.0 else random + self._response(np.asarray(time_s))

    @cached_property
    def _response(self) -> CubicSpline[np.float64]:
        """Pitch caused by acceleration [rad], as a function of time [s]: response of a damped oscillator."""
        from scipy.signal import cont2discrete, lfilter

        last = max(self._duration_s, float(self._motion.time_s[-1])) + _MARGIN_S
        time = np.arange(-_MARGIN_S, last + _STEP_S, _STEP_S)
        omega = 2.0 * np.pi / self._vehicle.pitch_period_s
        gain = np.radians(self._vehicle.pitch_deg_per_mps2)
        system = ([gain * omega**2], [1.0, 2.0 * _DAMPING * omega, omega**2])
        numerator, denominator, _ = cont2discrete(system, _STEP_S, method="foh")
        return CubicSpline(time, lfilter(numerator.ravel(), denominator, self._motion.acceleration_at(time)))
