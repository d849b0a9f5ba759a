"""GLONASS: integration of the equations of motion from a broadcast state (GLONASS ICD 5.1, A.3.1.2)."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.constants import EARTH_ROTATION_RATE_GLONASS, GM_GLONASS, PZ90_J2, PZ90_SEMI_MAJOR_AXIS

Floats = NDArray[np.float64]

#: Longest step of the integration [s]; the ICD's own accuracy statement is for 60 s.
LONGEST_STEP_S: Final = 60.0


def acceleration(position: Floats, velocity: Floats, luni_solar: Floats) -> Floats:
    """Acceleration in the Earth-fixed frame: central force, J2, rotation, Moon and Sun, shape (n, 3) [m/s^2]."""
    omega = EARTH_ROTATION_RATE_GLONASS
    r2 = np.einsum("ni,ni->n", position, position)
    r3 = r2 * np.sqrt(r2)
    flat = 1.5 * PZ90_J2 * GM_GLONASS * PZ90_SEMI_MAJOR_AXIS**2 / (r2 * r3)
    z2 = 5.0 * position[:, 2] ** 2 / r2
    central = -GM_GLONASS / r3
    result = luni_solar.copy()
    result[:, 0] += (central - flat * (1.0 - z2) + omega**2) * position[:, 0] + 2.0 * omega * velocity[:, 1]
    result[:, 1] += (central - flat * (1.0 - z2) + omega**2) * position[:, 1] - 2.0 * omega * velocity[:, 0]
    result[:, 2] += (central - flat * (3.0 - z2)) * position[:, 2]
    return result


def propagate(position: Floats, velocity: Floats, luni_solar: Floats, duration_s: Floats) -> tuple[Floats, Floats]:
    """States carried over durations, forward or backward, by Runge-Kutta of fourth order.

    Each state takes its own number of equal steps of at most `LONGEST_STEP_S`, so that what it
    becomes does not depend on the others.

    Parameters
    ----------
    position, velocity, luni_solar : ndarray, shape (n, 3)
        Earth-fixed [m, m/s, m/s^2].
    duration_s : ndarray, shape (n,) [s]

    Returns
    -------
    position, velocity : ndarray, shape (n, 3)
    """
    x, v = position.copy(), velocity.copy()
    steps = np.ceil(np.abs(duration_s) / LONGEST_STEP_S).astype(np.int64)
    step = duration_s / np.maximum(steps, 1)
    for done in range(int(steps.max(initial=0))):
        at = np.flatnonzero(steps > done)
        h, force = step[at, None], luni_solar[at]
        x0, v0 = x[at], v[at]
        a1 = acceleration(x0, v0, force)
        v1 = v0 + 0.5 * h * a1
        a2 = acceleration(x0 + 0.5 * h * v0, v1, force)
        v2 = v0 + 0.5 * h * a2
        a3 = acceleration(x0 + 0.5 * h * v1, v2, force)
        v3 = v0 + h * a3
        a4 = acceleration(x0 + h * v2, v3, force)
        x[at] = x0 + h / 6.0 * (v0 + 2.0 * v1 + 2.0 * v2 + v3)
        v[at] = v0 + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
    return x, v
