"""Inverses of small matrices, medians, and probabilities by their logarithms."""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import inner
from railfix.kernels.tracking.layout import Work


@inner
def invert(matrix: Floats, m: int, size: int, work: Work, result: Floats, to: int) -> float:
    """Write the inverse of a symmetric matrix into `result[to]` by Cholesky; return log det of the matrix.

    Of `matrix[m]` the upper half is read.
    """
    factor, lower = work.factor, work.lower
    log_determinant = 0.0
    for i in range(size):
        for j in range(i, size):
            factor[i, j] = matrix[m, i, j]
    for k in range(size):
        pivot = math.sqrt(max(factor[k, k], 1e-300))
        log_determinant += math.log(pivot)
        for j in range(k, size):
            factor[k, j] /= pivot
        for i in range(k + 1, size):
            share = factor[k, i]
            for j in range(i, size):
                factor[i, j] -= share * factor[k, j]
    for k in range(size):
        pivot = 1.0 / factor[k, k]
        for i in range(k):
            lower[k, i] = 0.0
        for j in range(k):
            share = factor[j, k] * pivot
            for i in range(j + 1):
                lower[k, i] -= share * lower[j, i]
        lower[k, k] = pivot
        for i in range(k + 1):
            result[to, k, i] = 0.0
    # result = lower' lower, its lower half first
    for k in range(size):
        for i in range(k + 1):
            share = lower[k, i]
            for j in range(i + 1):
                result[to, i, j] += share * lower[k, j]
    for i in range(size):
        for j in range(i):
            result[to, j, i] = result[to, i, j]
    return 2.0 * log_determinant


@inner
def median(values: Floats, h: int, first: int, size: int, ordered: Floats) -> float:
    """Median of a part of a row; `ordered` is work space."""
    for i in range(size):
        value = values[h, first + i]
        j = i
        while j > 0 and ordered[j - 1] > value:
            ordered[j] = ordered[j - 1]
            j -= 1
        ordered[j] = value
    if size % 2:
        return float(ordered[size // 2])
    return float(0.5 * (ordered[size // 2 - 1] + ordered[size // 2]))


@inner
def restart(spread: Floats, unknown: int, variance: float, h: int) -> None:
    """Make an unknown independent of all else."""
    for c in range(spread.shape[1]):
        spread[h, unknown, c] = 0.0
        spread[h, c, unknown] = 0.0
    spread[h, unknown, unknown] = variance


@inner
def log_sum(values: Floats, size: int) -> float:
    """Logarithm of the sum of exponentials."""
    largest = values[0]
    for i in range(1, size):
        largest = max(largest, values[i])
    total = 0.0
    for i in range(size):
        total += math.exp(values[i] - largest)
    return float(largest + math.log(total))


@inner
def most_probable(values: Floats, size: int, switch: float) -> int:
    """Return the most probable hypothesis; the first unless another is `switch` times as probable."""
    best = 0
    for i in range(1, size):
        if values[i] > values[best]:
            best = i
    return best if values[best] > values[0] + math.log(switch) else 0
