"""Velocities of the antenna without the line."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.kernels.compiling import inner, kernel
from railfix.kernels.tracking.update import median

#: Standard deviation of the vertical velocity [m/s].
CLIMB_MPS = 0.3
#: Loose prior for conditioning: standard deviations of the velocity and the clock [m/s].
PRIOR_MPS = (1e3, 1e3, 1e3, 1e6)
#: Degrees of freedom of the errors, rounds of reweighting, rows beyond the unknowns that are needed, and least mean
#: weight: with less the measurements do not agree with each other.
DEGREES = 4.0
PASSES = 8
REDUNDANT = 2
AGREEING = 0.9


@inner
def _invert(matrix: Floats) -> None:
    """Invert a positive definite matrix of 4 rows in its place."""
    for k in range(4):
        pivot = 1.0 / matrix[k, k]
        matrix[k, k] = 1.0
        for c in range(4):
            matrix[k, c] *= pivot
        for a in range(4):
            if a != k:
                share = matrix[a, k]
                matrix[a, k] = 0.0
                for c in range(4):
                    matrix[a, c] -= share * matrix[k, c]


@kernel
def fitted_velocities(
    gradient: Floats, value: Floats, variance: Floats, has: Masks, up: Floats
) -> tuple[Floats, Floats]:
    """Fit velocity and clock to the rows of each epoch, ``value = gradient . v + clock``, with Student's t errors.

    Parameters
    ----------
    gradient : ndarray, shape (T, K, 3)
    value, variance : ndarray, shape (T, K)
    has : ndarray of bool, shape (T, K)
    up : ndarray, shape (T, 3)
        Vertical direction.

    Returns
    -------
    velocity : ndarray, shape (T, 3) [m/s]
        NaN where the rows are too few, or do not agree.
    covariance : ndarray, shape (T, 3, 3)
        By the variances, larger where the residuals are.
    """
    epochs, channels = has.shape
    velocity, covariance = np.full((epochs, 3), np.nan), np.full((epochs, 3, 3), np.nan)
    row, rest, information = np.empty((channels, 4)), np.empty(channels), np.empty(channels)
    weight, square = np.empty(channels), np.empty(channels)
    prior, normal, right, solved = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty(4)
    for t in range(epochs):
        count = 0
        for k in range(channels):
            if has[t, k]:
                for a in range(3):
                    row[count, a] = gradient[t, k, a]
                row[count, 3] = 1.0
                rest[count], information[count], weight[count] = value[t, k], 1.0 / variance[t, k], 1.0
                count += 1
        if count - 3 < REDUNDANT:
            continue
        clock = median(rest[:count])
        for a in range(4):
            for b in range(4):
                vertical = up[t, a] * up[t, b] / CLIMB_MPS**2 if a < 3 and b < 3 else 0.0
                prior[a, b] = vertical + (PRIOR_MPS[a] ** -2.0 if a == b else 0.0)
        for _ in range(PASSES):
            for a in range(4):
                right[a] = 0.0
                for b in range(4):
                    normal[a, b] = prior[a, b]
            for k in range(count):
                for a in range(4):
                    scaled = row[k, a] * weight[k] * information[k]
                    right[a] += scaled * (rest[k] - clock)
                    for b in range(4):
                        normal[a, b] += scaled * row[k, b]
            _invert(normal)
            for a in range(4):
                solved[a] = 0.0
                for b in range(4):
                    solved[a] += normal[a, b] * right[b]
            for k in range(count):
                misfit = rest[k] - clock
                for a in range(4):
                    misfit -= row[k, a] * solved[a]
                square[k] = misfit * misfit * information[k]
                weight[k] = (DEGREES + 1.0) / (DEGREES + square[k])
        size, agreeing = 0.0, 0.0
        for k in range(count):
            size += weight[k] * square[k]
            agreeing += weight[k]
        if agreeing < AGREEING * count:
            continue
        for a in range(3):
            velocity[t, a] = solved[a]
            for b in range(3):
                covariance[t, a, b] = normal[a, b] * max(size / (count - 3), 1.0)
    return velocity, covariance
