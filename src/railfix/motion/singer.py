"""Motion with an acceleration that is a first-order Gauss-Markov process."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats


def singer_steps(dt: Floats, sigma_mps2: float, tau_s: float) -> tuple[Floats, Floats]:
    """Transition of position, speed and acceleration, and the covariance of its noise, shapes (K, 3, 3).

    The acceleration is a first-order Gauss-Markov process (R. A. Singer, Estimating optimal tracking filter
    performance for manned maneuvering targets, 1970, doi:10.1109/TAES.1970.310128). Steps of less than a tenth
    of the time of correlation take the limit of white jerk, for the full expressions cancel there.

    Parameters
    ----------
    dt : ndarray, shape (K,) [s]
    sigma_mps2, tau_s : float [m/s2], [s]
    """
    x = dt / tau_s
    once, twice = np.exp(-x), np.exp(-2.0 * x)
    step = np.zeros((len(dt), 3, 3))
    step[:, [0, 1], [0, 1]] = 1.0
    step[:, 0, 1], step[:, 2, 2] = dt, once
    step[:, 0, 2], step[:, 1, 2] = tau_s**2 * (x - 1.0 + once), tau_s * (1.0 - once)
    density = 2.0 * sigma_mps2**2 / tau_s
    full = {
        (0, 0): tau_s**5 * (1.0 - twice + 2.0 * x + 2.0 * x**3 / 3.0 - 2.0 * x**2 - 4.0 * x * once),
        (0, 1): tau_s**4 * (twice + 1.0 - 2.0 * once + 2.0 * x * once - 2.0 * x + x**2),
        (0, 2): tau_s**3 * (1.0 - twice - 2.0 * x * once),
        (1, 1): tau_s**3 * (4.0 * once - 3.0 - twice + 2.0 * x),
        (1, 2): tau_s**2 * (twice + 1.0 - 2.0 * once),
        (2, 2): tau_s * (1.0 - twice),
    }
    limit = {(0, 0): dt**5 / 20, (0, 1): dt**4 / 8, (0, 2): dt**3 / 6, (1, 1): dt**3 / 3, (1, 2): dt**2 / 2, (2, 2): dt}
    noise = np.empty((len(dt), 3, 3))
    for (i, j), value in full.items():
        noise[:, i, j] = noise[:, j, i] = density * np.where(x < 0.1, limit[i, j], value / 2.0)
    return step, noise
