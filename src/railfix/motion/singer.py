"""Motion with an acceleration that is a first-order Gauss-Markov process."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats

#: Below this dt / tau the closed forms cancel, and their power series are summed.
_SERIES_BELOW: Final = 1.0
_ORDERS: Final = np.arange(32)
_FACTORIALS: Final = np.cumprod(np.maximum(_ORDERS, 1).astype(np.float64))
_ONCE: Final = (-1.0) ** _ORDERS / _FACTORIALS
"""Coefficients of exp(-x); of exp(-2 x); of x exp(-x)."""
_TWICE: Final = (-2.0) ** _ORDERS / _FACTORIALS
_X_ONCE: Final = -_ORDERS * _ONCE
#: Coefficients of the closed forms below from their first power of x on; all lower ones are zero.
_SERIES: Final = {
    (0, 0): (5, -_TWICE / 2.0 - 2.0 * _X_ONCE),
    (0, 1): (4, _TWICE / 2.0 - _ONCE + _X_ONCE),
    (0, 2): (3, -_TWICE / 2.0 - _X_ONCE),
    (1, 1): (3, 2.0 * _ONCE - _TWICE / 2.0),
    (1, 2): (2, _TWICE / 2.0 - _ONCE),
    (2, 2): (1, -_TWICE / 2.0),
}


def singer_steps(dt: Floats, sigma_mps2: float, tau_s: float) -> tuple[Floats, Floats]:
    """Compute the transition of position, speed and acceleration, and the covariance of its noise.

    The acceleration is a first-order Gauss-Markov process (R. A. Singer, Estimating optimal tracking filter
    performance for manned maneuvering targets, 1970, doi:10.1109/TAES.1970.310128): the noise is the integral of
    f f' 2 sigma^2 / tau over the step, where f is the response to an impulse of the acceleration.

    Parameters
    ----------
    dt : ndarray, shape (K,) [s]
    sigma_mps2, tau_s : float [m/s2], [s]
        Standard deviation and correlation time of the acceleration.

    Returns
    -------
    step, noise : ndarray, shape (K, 3, 3)
    """
    x = dt / tau_s
    once, twice = np.exp(-x), np.exp(-2.0 * x)
    closed = {
        (0, 0): (1.0 - twice) / 2.0 + x + x**3 / 3.0 - x**2 - 2.0 * x * once,
        (0, 1): (twice + 1.0 + x**2) / 2.0 - once + x * once - x,
        (0, 2): (1.0 - twice) / 2.0 - x * once,
        (1, 1): 2.0 * once - (3.0 + twice) / 2.0 + x,
        (1, 2): (twice + 1.0) / 2.0 - once,
        (2, 2): (1.0 - twice) / 2.0,
    }
    small = x < _SERIES_BELOW
    powers = np.where(small, x, 0.0)[:, None] ** _ORDERS
    density = 2.0 * sigma_mps2**2 / tau_s
    noise = np.empty((len(dt), 3, 3))
    for (i, j), (first, series) in _SERIES.items():
        value = np.where(small, powers[:, first:] @ series[first:], closed[i, j])
        noise[:, i, j] = noise[:, j, i] = density * tau_s ** (5 - i - j) * value
    step = np.zeros((len(dt), 3, 3))
    step[:, [0, 1], [0, 1]] = 1.0
    step[:, 0, 1], step[:, 2, 2] = dt, once
    step[:, 0, 2] = tau_s**2 * np.where(small, powers[:, 2:] @ _ONCE[2:], x - 1.0 + once)
    step[:, 1, 2] = -tau_s * np.expm1(-x)
    return step, noise
