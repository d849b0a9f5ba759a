"""Compiled functions of `railfix.integrity.raim`: the linear model of ranges, its used channels side by side."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.kernels.compiling import inner, kernel
from railfix.kernels.ranges import invert
from railfix.kernels.sight import sight


@inner
def _clock_covariance(totals: Floats, sigma_m: Floats, covariance: Floats) -> None:
    """Compute the covariance of the clocks of one epoch; `sigma_m` of length 0 without ties."""
    groups, mass = len(totals), 0.0
    covariance[:] = 0.0
    if not len(sigma_m):
        for g in range(groups):
            if totals[g] > 0.0:
                covariance[g, g] = 1.0 / totals[g]
        return
    rho = np.zeros(groups)
    for g in range(groups):
        if totals[g] > 0.0:
            rho[g] = 1.0 / (1.0 + sigma_m[g] ** 2 * totals[g])
            mass += totals[g] * rho[g]
    for g in range(groups):
        for h in range(groups):
            covariance[g, h] = rho[g] * rho[h] / (mass if mass > 0.0 else 1.0)
        covariance[g, g] += sigma_m[g] ** 2 * rho[g]


@inner
def _regular_inverse(matrix: Floats, inverse: Floats) -> None:
    """Invert a symmetric matrix scaled to a unit diagonal; NaN where it is singular."""
    scale = np.empty(3)
    for a in range(3):
        scale[a] = 1.0 / math.sqrt(matrix[a, a]) if matrix[a, a] > 0.0 else math.nan
    for a in range(3):
        for b in range(3):
            matrix[a, b] *= scale[a] * scale[b]
    invert(matrix, inverse)
    for a in range(3):
        for b in range(3):
            inverse[a, b] *= scale[a] * scale[b]


@kernel
def linearised(
    ranges: Any, place_ecef_m: Floats, axes: Floats, prior: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return root weight, covariance of the clocks, design, covariance of the place, and misfit, epoch by epoch."""
    sat_ecef_m, code_m, weight, starts, offset_m, sigma_m = ranges
    epochs, channels = weight.shape
    groups, no = len(starts), np.empty(0)
    tied = len(offset_m) == epochs
    root, misfit, design = np.sqrt(weight), np.empty((epochs, channels)), np.empty((epochs, channels, 3))
    clocks, covariance = np.empty((epochs, groups, groups)), np.empty((epochs, 3, 3))
    clock, totals, sums, asked = np.empty(channels, dtype=np.intp), np.empty(groups), np.empty((groups, 3)), np.empty(3)
    rows, normal = np.empty((channels, 3)), np.empty((3, 3))
    for g in range(groups):
        clock[starts[g] : starts[g + 1] if g + 1 < groups else channels] = g
    for t in range(epochs):
        x, y, z = place_ecef_m[t, 0], place_ecef_m[t, 1], place_ecef_m[t, 2]
        totals[:] = 0.0
        sums[:] = 0.0
        total, mean = 0.0, 0.0
        for m in range(channels):
            g = clock[m]
            distance, ux, uy, uz = sight(sat_ecef_m[t, m, 0], sat_ecef_m[t, m, 1], sat_ecef_m[t, m, 2], x, y, z)
            misfit[t, m] = code_m[t, m] - distance - (offset_m[t, g] if tied else 0.0)
            total += weight[t, m]
            mean += weight[t, m] * misfit[t, m]
            totals[g] += weight[t, m]
            for a in range(3):
                rows[m, a] = -root[t, m] * (ux * axes[t, a, 0] + uy * axes[t, a, 1] + uz * axes[t, a, 2])
                sums[g, a] += root[t, m] * rows[m, a]
        if total > 0.0:
            mean /= total
        _clock_covariance(totals, sigma_m[t] if tied else no, clocks[t])
        normal[:] = 0.0
        for m in range(channels):
            g = clock[m]
            misfit[t, m] = root[t, m] * (misfit[t, m] - mean)
            asked[:] = 0.0
            for h in range(groups):
                for a in range(3):
                    asked[a] += clocks[t, g, h] * sums[h, a]
            for a in range(3):
                design[t, m, a] = rows[m, a] - root[t, m] * asked[a]
            for a in range(3):
                for b in range(3):
                    normal[a, b] += rows[m, a] * design[t, m, b]
        _regular_inverse((normal + normal.T) / 2.0 + prior, covariance[t])
    return root, clocks, design, covariance, misfit


@kernel
def side_by_side(
    root_weight: Floats,
    design: Floats,
    covariance_m2: Floats,
    clock: Indices,
    clock_covariance_m2: Floats,
    residual: Floats,
    gain_m: Floats,
) -> tuple[Indices, Masks, Floats, Floats, Floats, Floats]:
    """Return channel, used, projector, residual, sigma and gain of the used channels, epoch by epoch."""
    epochs, channels = root_weight.shape
    wanted = gain_m.shape[2]
    n = 0
    for t in range(epochs):
        count = 0
        for m in range(channels):
            if root_weight[t, m] > 0.0:
                count += 1
        n = max(n, count)
    channel, used = np.empty((epochs, n), dtype=np.intp), np.zeros((epochs, n), dtype=np.bool_)
    projector, left = np.zeros((epochs, n, n)), np.empty((epochs, n))
    sigma, gain = np.zeros((epochs, n)), np.empty((epochs, n, wanted))
    spread = np.empty(3)
    for t in range(epochs):
        count = 0
        for m in range(channels):
            if root_weight[t, m] > 0.0:
                channel[t, count], used[t, count] = m, True
                sigma[t, count] = 1.0 / root_weight[t, m]
                count += 1
        beyond = count
        for m in range(channels):
            if beyond >= n:
                break
            if not root_weight[t, m] > 0.0:
                channel[t, beyond] = m
                beyond += 1
        for i in range(n):
            m = channel[t, i]
            left[t, i] = residual[t, m]
            for a in range(wanted):
                gain[t, i, a] = gain_m[t, m, a]
        for i in range(count):
            m = channel[t, i]
            for a in range(3):
                spread[a] = (
                    design[t, m, 0] * covariance_m2[t, 0, a]
                    + design[t, m, 1] * covariance_m2[t, 1, a]
                    + design[t, m, 2] * covariance_m2[t, 2, a]
                )
            for j in range(i, count):
                k = channel[t, j]
                value = -root_weight[t, m] * root_weight[t, k] * clock_covariance_m2[t, clock[m], clock[k]]
                value -= spread[0] * design[t, k, 0] + spread[1] * design[t, k, 1] + spread[2] * design[t, k, 2]
                if i == j:
                    value += 1.0
                projector[t, i, j], projector[t, j, i] = value, value
    return channel, used, projector, left, sigma, gain
