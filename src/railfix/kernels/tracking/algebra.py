"""Inverses of small matrices, medians, and probabilities by their logarithms."""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing


@borrowing
def factorise(matrix: Floats, m: int, size: int, factor: Floats) -> float:
    """Write the upper Cholesky factor U of a symmetric matrix, U' U = `matrix[m]`; return log det of the matrix.

    Of `matrix[m]` the upper half is read. Four rows at a time are taken off: half the time of one by one.
    """
    log_determinant, pivots = 0.0, 1.0
    for i in range(size):
        for j in range(i, size):
            factor[i, j] = matrix[m, i, j]
        for k in range(0, i - 3, 4):
            a, b, c, d = factor[k, i], factor[k + 1, i], factor[k + 2, i], factor[k + 3, i]
            for j in range(i, size):
                factor[i, j] -= a * factor[k, j] + b * factor[k + 1, j] + c * factor[k + 2, j] + d * factor[k + 3, j]
        for k in range(i // 4 * 4, i):
            a = factor[k, i]
            for j in range(i, size):
                factor[i, j] -= a * factor[k, j]
        pivot = math.sqrt(max(factor[i, i], 1e-300))
        pivots *= pivot
        if i % 2 or i == size - 1:
            log_determinant += math.log(pivots)
            pivots = 1.0
        scale = 1.0 / pivot
        for j in range(i, size):
            factor[i, j] *= scale
    return 2.0 * log_determinant


@borrowing
def invert_factor(factor: Floats, size: int, lower: Floats) -> None:
    """Write L, the inverse of U', into `lower`, whose upper half is 0: the inverse of U' U is L' L."""
    for k in range(size):
        for i in range(k):
            lower[k, i] = 0.0
        for j in range(0, k - 3, 4):
            a, b, c, d = factor[j, k], factor[j + 1, k], factor[j + 2, k], factor[j + 3, k]
            for i in range(j + 4):
                lower[k, i] += a * lower[j, i] + b * lower[j + 1, i] + c * lower[j + 2, i] + d * lower[j + 3, i]
        for j in range(k // 4 * 4, k):
            a = factor[j, k]
            for i in range(j + 1):
                lower[k, i] += a * lower[j, i]
        scale = 1.0 / factor[k, k]
        for i in range(k):
            lower[k, i] *= -scale
        lower[k, k] = scale


@borrowing
def square(lower: Floats, size: int, result: Floats, to: int) -> None:
    """Write L' L into `result[to]`."""
    for i in range(size):
        for j in range(i + 1):
            result[to, i, j] = 0.0
        for k in range(i, size - 3, 4):
            a, b, c, d = lower[k, i], lower[k + 1, i], lower[k + 2, i], lower[k + 3, i]
            for j in range(i + 1):
                result[to, i, j] += a * lower[k, j] + b * lower[k + 1, j] + c * lower[k + 2, j] + d * lower[k + 3, j]
        for k in range(i + (size - i) // 4 * 4, size):
            a = lower[k, i]
            for j in range(i + 1):
                result[to, i, j] += a * lower[k, j]
        for j in range(i):
            result[to, j, i] = result[to, i, j]


@borrowing
def multiply(left: Floats, l: int, right: Floats, size: int, width: int, result: Floats) -> None:  # noqa: E741
    """Write the product of `left[l]`, `size` squared, and the first `width` columns of `right` into `result`.

    Two rows at a time, the last two again where `size` is odd: what is read of `right` counts twice.
    """
    for pair in range((size + 1) // 2):
        i = min(2 * pair, size - 2)
        for c in range(width):
            result[i, c] = result[i + 1, c] = 0.0
        for j in range(0, size - 3, 4):
            a, b, d, e = left[l, i, j], left[l, i, j + 1], left[l, i, j + 2], left[l, i, j + 3]
            p, q, r, s = left[l, i + 1, j], left[l, i + 1, j + 1], left[l, i + 1, j + 2], left[l, i + 1, j + 3]
            for c in range(width):
                w, x, y, z = right[j, c], right[j + 1, c], right[j + 2, c], right[j + 3, c]
                result[i, c] += a * w + b * x + d * y + e * z
                result[i + 1, c] += p * w + q * x + r * y + s * z
        for j in range(size // 4 * 4, size):
            a, p = left[l, i, j], left[l, i + 1, j]
            for c in range(width):
                result[i, c] += a * right[j, c]
                result[i + 1, c] += p * right[j, c]


@borrowing
def invert(matrix: Floats, m: int, size: int, factor: Floats, lower: Floats, result: Floats, to: int) -> float:
    """Write the inverse of a symmetric matrix into `result[to]`; return log det of the matrix.

    Of `matrix[m]` the upper half is read; `factor` and `lower` are work space, the upper half of `lower` is 0.
    """
    log_determinant = factorise(matrix, m, size, factor)
    invert_factor(factor, size, lower)
    square(lower, size, result, to)
    return log_determinant


@borrowing
def insert(ordered: Floats, size: int, value: float) -> None:
    """Insert a value among `size` others in rising order."""
    j = size
    while j > 0 and ordered[j - 1] > value:
        ordered[j] = ordered[j - 1]
        j -= 1
    ordered[j] = value


@borrowing
def middle(ordered: Floats, size: int) -> float:
    """Median of values in rising order."""
    if size % 2:
        return float(ordered[size // 2])
    return float(0.5 * (ordered[size // 2 - 1] + ordered[size // 2]))


@borrowing
def median(values: Floats, h: int, first: int, size: int, ordered: Floats) -> float:
    """Median of a part of a row; `ordered` is work space."""
    for i in range(size):
        insert(ordered, i, values[h, first + i])
    return middle(ordered, size)


@borrowing
def restart(spread: Floats, unknown: int, variance: float, h: int) -> None:
    """Make an unknown independent of all else."""
    for c in range(spread.shape[1]):
        spread[h, unknown, c] = 0.0
        spread[h, c, unknown] = 0.0
    spread[h, unknown, unknown] = variance


@borrowing
def log_sum(values: Floats, size: int) -> float:
    """Logarithm of the sum of exponentials."""
    largest = values[0]
    for i in range(1, size):
        largest = max(largest, values[i])
    total = 0.0
    for i in range(size):
        total += math.exp(values[i] - largest)
    return float(largest + math.log(total))
