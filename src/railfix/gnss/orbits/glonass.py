"""GLONASS: integration of the equations of motion from a broadcast state (GLONASS ICD 5.1, A.3.1.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Integers
from railfix.core.constants import EARTH_ROTATION_RATE_GLONASS, GM_GLONASS, PZ90_J2, PZ90_SEMI_MAJOR_AXIS
from railfix.gnss.navigation import GlonassRecords

#: Step of the integration [s]; the ICD's statement of accuracy is for 60 s.
STEP_S: Final = 60.0
#: Rows integrated at once, so that the arrays stay in the cache.
_BLOCK: Final = 8192


def acceleration(position: Floats, velocity: Floats, luni_solar: Floats) -> Floats:
    """Compute the acceleration in the Earth-fixed frame: central force, J2, rotation, Moon and Sun.

    Parameters
    ----------
    position, velocity, luni_solar : ndarray, shape (3, n) [m, m/s, m/s^2]

    Returns
    -------
    ndarray, shape (3, n) [m/s^2]
    """
    omega = EARTH_ROTATION_RATE_GLONASS
    x, y, z = position
    r2 = x * x + y * y + z * z
    r3 = r2 * np.sqrt(r2)
    flat = 1.5 * PZ90_J2 * GM_GLONASS * PZ90_SEMI_MAJOR_AXIS**2 / (r2 * r3)
    z2 = 5.0 * z * z / r2
    central = -GM_GLONASS / r3
    plane = central - flat * (1.0 - z2) + omega**2
    result = np.empty_like(position)
    result[0] = luni_solar[0] + plane * x + 2.0 * omega * velocity[1]
    result[1] = luni_solar[1] + plane * y - 2.0 * omega * velocity[0]
    result[2] = luni_solar[2] + (central - flat * (3.0 - z2)) * z
    return result


def runge_kutta(position: Floats, velocity: Floats, luni_solar: Floats, step_s: Floats) -> tuple[Floats, Floats]:
    """Integrate one fourth-order step, forward or backward; arrays of shape (3, n), steps of shape (n,)."""
    h = step_s
    a1 = acceleration(position, velocity, luni_solar)
    v1 = velocity + 0.5 * h * a1
    a2 = acceleration(position + 0.5 * h * velocity, v1, luni_solar)
    v2 = velocity + 0.5 * h * a2
    a3 = acceleration(position + 0.5 * h * v1, v2, luni_solar)
    v3 = velocity + h * a3
    a4 = acceleration(position + h * v2, v3, luni_solar)
    new_position = position + h / 6.0 * (velocity + 2.0 * (v1 + v2) + v3)
    return new_position, velocity + h / 6.0 * (a1 + 2.0 * (a2 + a3) + a4)


@dataclass(frozen=True)
class GlonassStates:
    """States of all records at multiples of the step from their reference times.

    Attributes
    ----------
    position, velocity : ndarray, shape (3, records, 2 steps + 1) [m, m/s]
        The reference time is the middle column.
    luni_solar : ndarray, shape (3, records) [m/s^2]
    """

    position: Floats
    velocity: Floats
    luni_solar: Floats

    @classmethod
    def from_records(cls, records: GlonassRecords, reach_s: float) -> GlonassStates:
        """Integrate all records over `reach_s` in both directions and one step beyond."""
        steps = int(np.ceil(reach_s / STEP_S)) + 1
        luni_solar = np.ascontiguousarray(records.acceleration_ecef_mps2.T)
        position = np.empty((3, len(records), 2 * steps + 1))
        velocity = np.empty_like(position)
        for direction in (1, -1):
            x, v = records.position_ecef_m.T.copy(), records.velocity_ecef_mps.T.copy()
            for i in range(steps + 1):
                position[:, :, steps + direction * i], velocity[:, :, steps + direction * i] = x, v
                x, v = runge_kutta(x, v, luni_solar, np.full(len(records), direction * STEP_S))
        return cls(position, velocity, luni_solar)

    def state(self, row: Integers, since_toe_s: Floats) -> tuple[Floats, Floats]:
        """Compute states at times since the reference time, from the last multiple of the step.

        Parameters
        ----------
        row : ndarray of int, shape (n,)
            Row of the records.
        since_toe_s : ndarray, shape (n,) [s]
            Within `reach_s`.

        Returns
        -------
        position, velocity : ndarray, shape (3, n)
        """
        middle = self.position.shape[2] // 2
        node = np.trunc(since_toe_s / STEP_S)
        rest = since_toe_s - node * STEP_S
        at = row * self.position.shape[2] + node.astype(np.int64) + middle
        position, velocity = np.empty((3, len(row))), np.empty((3, len(row)))
        flat_position, flat_velocity = self.position.reshape(3, -1), self.velocity.reshape(3, -1)
        for begin in range(0, len(row), _BLOCK):
            part = slice(begin, begin + _BLOCK)
            position[:, part], velocity[:, part] = runge_kutta(
                flat_position[:, at[part]], flat_velocity[:, at[part]], self.luni_solar[:, row[part]], rest[part]
            )
        return position, velocity
