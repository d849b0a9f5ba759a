"""Compiled functions of `railfix.positioning.map_offset`: terms of the sums of a window, and its mean offset."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from railfix.core.arrays import Floats
from railfix.kernels.compiling import kernel
from railfix.kernels.ranges import reduce_epoch


@kernel
def terms_of_epochs(
    ranges: Any,
    ecef_m: Floats,
    covariance_m2: Floats,
    place_ecef_m: Floats,
    axes: Floats,
    nominal_m: Floats,
    variance: Floats,
) -> Floats:
    """Return the terms of a window's sums, epoch by epoch."""
    sat_ecef_m, code_m, weight, starts, offset_m, sigma_m = ranges
    epochs, channels = weight.shape
    groups, no = len(starts), np.empty(0)
    tied = len(offset_m) == epochs
    system, means = np.empty((4, 4)), np.empty((4, groups))
    rows, totals = np.empty((4, channels)), np.empty(groups)
    terms, offset, spread = np.empty((epochs, 9)), np.empty(2), np.empty((2, 3))
    for t in range(epochs):
        of_clocks, of_ties = (offset_m[t], sigma_m[t]) if tied else (no, no)
        reduce_epoch(
            sat_ecef_m[t], code_m[t], weight[t], ecef_m[t], starts, of_clocks, of_ties, system, means, rows, totals
        )
        for a in range(2):
            offset[a] = 0.0
            for i in range(3):
                offset[a] += axes[t, a, i] * (ecef_m[t, i] - place_ecef_m[t, i])
                spread[a, i] = 0.0
                for j in range(3):
                    spread[a, i] += axes[t, a, j] * covariance_m2[t, j, i]
        across, mixed, up = 0.0, 0.0, 0.0
        for i in range(3):
            across += spread[0, i] * axes[t, 0, i] * variance[t]
            mixed += spread[0, i] * axes[t, 1, i] * variance[t]
            up += spread[1, i] * axes[t, 1, i] * variance[t]
        determinant = max(across * up - mixed * mixed, 1e-300)
        across, mixed, up = up / determinant, -mixed / determinant, across / determinant
        terms[t, 0], terms[t, 1], terms[t, 2] = across, mixed, up
        terms[t, 3], terms[t, 4] = across * offset[0] + mixed * offset[1], mixed * offset[0] + up * offset[1]
        terms[t, 5:8] = 0.0
        for m in range(channels):
            if not (weight[t, m] > 0.0 and nominal_m[t, m] > 0.0):
                continue
            one, two = 0.0, 0.0
            for i in range(3):
                one += spread[0, i] * rows[i, m] * weight[t, m] * nominal_m[t, m]
                two += spread[1, i] * rows[i, m] * weight[t, m] * nominal_m[t, m]
            terms[t, 5] += one * one
            terms[t, 6] += one * two
            terms[t, 7] += two * two
        terms[t, 8] = 1.0
    return terms


@kernel
def means_of_windows(
    sums: Floats, sigma_plan_m: float, sigma_height_m: float, detectable_sigmas: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return mean offset, its covariance, statistic and smallest offsets found, epoch by epoch."""
    epochs = len(sums)
    mean, covariance = np.empty((epochs, 2)), np.empty((epochs, 2, 2))
    statistic, detectable = np.empty(epochs), np.empty((epochs, 2))
    for t in range(epochs):
        a, b, d = sums[t, 0], sums[t, 1], sums[t, 2]
        determinant = max(a * d - b * b, 1e-300)
        a, b, d = d / determinant, -b / determinant, a / determinant
        x, y = a * sums[t, 3] + b * sums[t, 4], b * sums[t, 3] + d * sums[t, 4]
        a += sums[t, 5] / sums[t, 8] + sigma_plan_m**2
        b += sums[t, 6] / sums[t, 8]
        d += sums[t, 7] / sums[t, 8] + sigma_height_m**2
        mean[t, 0], mean[t, 1] = x, y
        covariance[t, 0, 0], covariance[t, 0, 1], covariance[t, 1, 0], covariance[t, 1, 1] = a, b, b, d
        determinant = max(a * d - b * b, 1e-300)
        a, b, d = d / determinant, -b / determinant, a / determinant
        statistic[t] = a * x * x + 2.0 * b * x * y + d * y * y
        detectable[t, 0], detectable[t, 1] = detectable_sigmas / math.sqrt(a), detectable_sigmas / math.sqrt(d)
    return mean, covariance, statistic, detectable
