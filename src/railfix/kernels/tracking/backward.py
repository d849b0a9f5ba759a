"""Backward propagation of information from later epochs through one epoch, for the smoother."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats
from railfix.kernels.compiling import kernel
from railfix.kernels.tracking.layout import Record
from railfix.kernels.tracking.model import compute_transition
from railfix.kernels.tracking.update import correct


@kernel
def before_measurements(
    P: Floats, row: Floats, value: Floats, variance: Floats, vector: Floats, matrix: Floats
) -> tuple[Floats, Floats]:
    """Propagate the information from later epochs backward through an epoch's measurements.

    docs/filter-equations.md has the formula of one measurement (G. J. Bierman, 1973).

    The measurements `row`, `value` and `variance`, shapes (M, N), (M,) and (M,), are in the order of the filter. They
    are processed backward. P, shape (N, N), is the covariance before the measurements. `vector`, shape (N,), and
    `matrix`, shape (N, N), are the information j and J after the measurements. Return j and J before the measurements.
    """
    count, size = row.shape
    P, x, gain = P.copy(), np.zeros(size), np.empty(size)
    covariance, innovation, total = np.empty((count, size)), np.empty(count), np.full(count, math.inf)
    for j in range(count):
        if variance[j] < math.inf:
            covariance[j] = P @ row[j]
            innovation[j], total[j] = value[j] - row[j] @ x, row[j] @ covariance[j] + variance[j]
            correct(x, P, covariance[j], innovation[j], total[j], gain)
    vector, matrix = vector.copy(), matrix.copy()
    for j in range(count - 1, -1, -1):
        if total[j] < math.inf:
            h, g, S = row[j], covariance[j], total[j]
            vector += h * ((innovation[j] - g @ vector) / S)
            across = matrix @ g
            for a in range(size):
                matrix[a] -= (h[a] * across + across[a] * h) / S
                matrix[a] += h[a] * h * (1.0 + g @ across / S) / S
    return vector, matrix


@kernel
def transition_matrix(speed: float, epoch: Record, unknowns: int) -> Floats:
    """Return the transition F to an epoch as a matrix, shape (N, N)."""
    F, matrix = compute_transition(speed, epoch, unknowns), np.zeros((unknowns, unknowns))
    for i in range(unknowns):
        for k in range(3):
            matrix[i, F.unknown[i, k]] += F.coefficient[i, k]
    return matrix
