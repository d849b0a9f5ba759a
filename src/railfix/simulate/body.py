"""True positions of the antennas: a rigid body with both bogie centres on the continuous line.

Computed independently of `railfix.track.vehicle`, which works on the polyline of the map: here by Newton's method
on the curve and by rotation about the body's axis (Rodrigues).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import cont2discrete, lfilter

from railfix.core.arrays import Floats
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.simulate.alignment import Alignment
from railfix.simulate.errors.processes import RandomFunction
from railfix.simulate.scenario import VehicleSettings

if TYPE_CHECKING:
    from railfix.simulate.motion import Motion
    from railfix.simulate.scenario import Scenario

#: Contact points of the wheels lie further apart than the gauge [m].
_RAIL_HEAD_M = 0.070


@dataclass(frozen=True, kw_only=True)
class AntennaTruth:
    """True positions of one antenna at n positions of the vehicle's middle."""

    ecef_m: Floats  #: Shape (n, 3).
    #: Centreline point in the plane through the antenna perpendicular to the line between the bogie centres, shape
    #: (n,).
    chainage_m: Floats
    forward: Floats  #: Unit vector of the body's long axis, shape (n, 3).


def antenna_truth(
    line: Alignment,
    vehicle: VehicleSettings,
    offset_m: tuple[float, float, float],
    middle_m: Floats,
    sway_rad: Floats | float = 0.0,
    pitch_rad: Floats | None = None,
) -> AntennaTruth:
    """True position of an antenna at n positions of the vehicle's middle.

    Parameters
    ----------
    offset_m : tuple of float
        Along, across to the right, above the rail tops [m].
    middle_m : ndarray, shape (n,) [m]
        Chainage midway between the bogies' chainages.
    sway_rad, pitch_rad : ndarray, shape (n,), or float [rad]
        Lean to the right beyond that of the cant; pitch beyond that of the gradient, about the point between the
        bogies at the rail tops, positive where the front rises.
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
    latitude, longitude, _ = geodetic_from_ecef(origin)
    vertical = enu_axes(latitude, longitude)[:, 2]
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
    # A lean to the right turns the body about its forward axis.
    turned = np.cos(lean)[:, None] * arm + np.sin(lean)[:, None] * np.cross(forward, arm)
    place = origin + along * forward + turned
    abeam = middle + along
    for _ in range(5):
        ahead = np.einsum("ni,ni->n", line.at(abeam) - place, chord)
        abeam = abeam - ahead / np.einsum("ni,ni->n", line.tangent_at(abeam), chord)
    return AntennaTruth(ecef_m=place, chainage_m=abeam, forward=forward)


#: Speed at and above which the random motions of the body have their full size [m/s].
FULL_SPEED_MPS: Final = 20.0
#: Step of the response to accelerations [s], and damping ratio of the suspension.
_STEP_S: Final = 0.01
_DAMPING: Final = 0.3
#: Time before the start and after the end of the run over which the motion is given [s].
_MARGIN_S: Final = 2.0


class BodyMotion:
    """Roll and pitch of a scenario's vehicle over time; the seed of the scenario decides."""

    def __init__(self, scenario: Scenario, motion: Motion) -> None:
        vehicle = self._vehicle = scenario.vehicle
        self._motion, self._duration_s = motion, scenario.duration_s
        sway, pitch = np.radians(vehicle.sway_sigma_deg), np.radians(vehicle.pitch_sigma_deg)
        rng = np.random.default_rng([scenario.seed, 13])
        self._roll = RandomFunction.periodic(rng, sigma=float(sway), period=vehicle.sway_period_s)
        rng = np.random.default_rng([scenario.seed, 17])
        self._pitch = RandomFunction.periodic(rng, sigma=float(pitch), period=vehicle.pitch_period_s)

    def roll_rad(self, time_s: Floats, speed_mps: Floats) -> Floats:
        """Lean to the right [rad] at times and speeds; none while the train stands."""
        return self._roll.at(time_s) * np.minimum(np.abs(speed_mps) / FULL_SPEED_MPS, 1.0)

    def pitch_rad(self, time_s: Floats, speed_mps: Floats) -> Floats | None:
        """Pitch [rad] at times and speeds, positive where the front rises; None where the vehicle does not pitch."""
        vehicle = self._vehicle
        if vehicle.pitch_sigma_deg == 0.0 and vehicle.pitch_deg_per_mps2 == 0.0:
            return None
        random = self._pitch.at(time_s) * np.minimum(np.abs(speed_mps) / FULL_SPEED_MPS, 1.0)
        return random if vehicle.pitch_deg_per_mps2 == 0.0 else random + self._response(np.asarray(time_s))

    @cached_property
    def _response(self) -> CubicSpline[np.float64]:
        """Pitch under the train's acceleration: a damped oscillator of the suspension's period."""
        last = max(self._duration_s, float(self._motion.time_s[-1])) + _MARGIN_S
        time = np.arange(-_MARGIN_S, last + _STEP_S, _STEP_S)
        omega = 2.0 * np.pi / self._vehicle.pitch_period_s
        gain = np.radians(self._vehicle.pitch_deg_per_mps2)
        system = ([gain * omega**2], [1.0, 2.0 * _DAMPING * omega, omega**2])
        numerator, denominator, _ = cont2discrete(system, _STEP_S, method="foh")
        return CubicSpline(time, lfilter(numerator.ravel(), denominator, self._motion.acceleration_at(time)))
