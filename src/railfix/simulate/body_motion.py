"""Roll and pitch of the vehicle's body on its suspension, beyond the cant and the gradient of the track."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import cont2discrete, lfilter

from railfix.core.arrays import Floats
from railfix.simulate.random_functions import RandomFunction

if TYPE_CHECKING:
    from railfix.simulate.kinematics import Motion
    from railfix.simulate.scenario import Scenario

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
