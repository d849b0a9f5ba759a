"""Least squares along a chain of instants: the Kalman smoother without a loop over epochs.

A block-tridiagonal information matrix is solved by cyclic reduction: every second instant is eliminated, down to one,
and on the way back gets its value and covariance from its two neighbours, in log2(N) passes (R. A. Sweet 1977,
doi:10.1137/0714050; the result is that of H. E. Rauch, F. Tung, C. T. Striebel 1965, doi:10.2514/3.3166).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Normal equations of N instants with n unknowns each; terms are added by copies."""

    diagonal: Floats  #: Information of each instant, shape (N, n, n).
    upper: Floats  #: Of each instant with the next, shape (N - 1, n, n).
    right: Floats  #: Shape (N, n).

    @classmethod
    def empty(cls, instants: int, unknowns: int) -> Chain:
        """Return the chain without information."""
        square = (unknowns, unknowns)
        return cls(
            diagonal=np.zeros((instants, *square)),
            upper=np.zeros((max(instants - 1, 0), *square)),
            right=np.zeros((instants, unknowns)),
        )

    def with_observations(self, rows: Indices, coefficients: Floats, value: Floats, weight: Floats) -> Chain:
        """Return the chain with scalar observations ``coefficients . x_row = value`` added, weights inverse variances.

        `coefficients`, shape (n,) or (m, n); a row may come several times.
        """
        a = np.broadcast_to(coefficients, (len(rows), self.right.shape[1]))
        diagonal, right = self.diagonal.copy(), self.right.copy()
        np.add.at(diagonal, rows, weight[:, None, None] * a[:, :, None] * a[:, None, :])
        np.add.at(right, rows, (weight * value)[:, None] * a)
        return replace(self, diagonal=diagonal, right=right)

    def with_steps(self, before: Floats, after: Floats, value: Floats, weight: Floats) -> Chain:
        """Return the chain with conditions ``before x_k + after x_{k+1} = value`` on every step added.

        Shapes (N - 1, m, n); `weight`, shape (N - 1, m, m), is the inverse covariance.
        """
        weighed_before, weighed_after = (np.swapaxes(a, 1, 2) @ weight for a in (before, after))
        diagonal, right = self.diagonal.copy(), self.right.copy()
        diagonal[:-1] += weighed_before @ before
        diagonal[1:] += weighed_after @ after
        right[:-1] += np.einsum("kij,kj->ki", weighed_before, value)
        right[1:] += np.einsum("kij,kj->ki", weighed_after, value)
        return replace(self, diagonal=diagonal, upper=self.upper + weighed_before @ after, right=right)

    def solve(self) -> tuple[Floats, Floats]:
        """Return values (N, n) and covariances (N, n, n) of every instant; LinAlgError where undetermined."""
        value, covariance, _ = _reduce(self.diagonal, self.upper, self.right)
        return value, covariance


def _reduce(diagonal: Floats, upper: Floats, right: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the values, covariances, and covariances of neighbours."""
    count = len(diagonal)
    if count == 1:
        covariance = np.asarray(np.linalg.inv(diagonal), dtype=np.float64)
        return np.einsum("kij,kj->ki", covariance, right), covariance, np.zeros((0, *diagonal.shape[1:]))
    # Every odd instant has a left neighbour, and all but perhaps the last a right one.
    odd = np.arange(1, count, 2)
    inner = odd[odd + 1 < count]
    inverse = np.asarray(np.linalg.inv(diagonal[odd]), dtype=np.float64)
    left = upper[odd - 1]
    rightward = np.zeros_like(left)
    rightward[: len(inner)] = upper[inner]
    to_left = inverse @ np.swapaxes(left, 1, 2)
    to_right = inverse @ rightward
    part = np.einsum("kij,kj->ki", inverse, right[odd])
    evens = (count + 1) // 2
    fewer, driven = diagonal[::2].copy(), right[::2].copy()
    m = len(inner)
    fewer[: len(odd)] -= left @ to_left
    fewer[1 : m + 1] -= np.swapaxes(rightward[:m], 1, 2) @ to_right[:m]
    driven[: len(odd)] -= np.einsum("kij,kj->ki", left, part)
    driven[1 : m + 1] -= np.einsum("kji,kj->ki", rightward[:m], part[:m])
    joined = -(left[:m] @ to_right[:m])
    fewer = 0.5 * (fewer + np.swapaxes(fewer, 1, 2))
    value_even, covariance_even, across = _reduce(fewer, joined[: evens - 1], driven)
    # Back: x = D^-1 b - (D^-1 U_l^T) x_l - (D^-1 U_r) x_r. Beyond the end x_r has no part.
    value = np.empty_like(right)
    covariance, beside = np.empty_like(diagonal), np.empty_like(upper)
    value[::2], covariance[::2] = value_even, covariance_even
    at_left, at_right = np.arange(len(odd)), np.minimum(np.arange(len(odd)) + 1, evens - 1)
    value[odd] = (
        part
        - np.einsum("kij,kj->ki", to_left, value_even[at_left])
        - np.einsum("kij,kj->ki", to_right, value_even[at_right])
    )
    between = np.zeros_like(left)
    between[:m] = across[:m]
    with_left = -(covariance_even[at_left] @ np.swapaxes(to_left, 1, 2) + between @ np.swapaxes(to_right, 1, 2))
    with_right = -(to_left @ between + to_right @ covariance_even[at_right])
    covariance[odd] = inverse - to_left @ with_left - to_right @ np.swapaxes(with_right, 1, 2)
    beside[odd - 1] = with_left
    beside[inner] = with_right[:m]
    return value, covariance, beside


#: Below this dt / tau the closed forms cancel, and their power series are summed.
_SERIES_BELOW: Final = 1.0
_ORDERS: Final = np.arange(32)
_FACTORIALS: Final = np.cumprod(np.maximum(_ORDERS, 1).astype(np.float64))
#: Coefficients of exp(-x); of exp(-2 x); of x exp(-x).
_ONCE: Final = (-1.0) ** _ORDERS / _FACTORIALS
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
    """Compute the transition of position, speed and acceleration, and the covariance of its noise, shapes (K, 3, 3).

    The acceleration is a first-order Gauss-Markov process (R. A. Singer 1970, doi:10.1109/TAES.1970.310128): the noise
    is the integral of f f' 2 sigma^2 / tau over the step, where f is the response to an impulse of the acceleration.
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
