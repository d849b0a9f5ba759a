"""Linearised and whitened ranges at a position, after elimination of the clocks, and residuals of these ranges."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from railfix.core.arrays import Floats
from railfix.kernels.compiling import inner, kernel
from railfix.kernels.ranges import invert
from railfix.kernels.sight import sight


@inner
def _write_clock_covariance(totals: Floats, tie_sigma_m: Floats, rho: Floats, covariance: Floats) -> None:
    """Write the covariance of one epoch's clocks at a known position, shape (G, G).

    T is the summed weight of a clock's satellites. A separate clock has the variance 1/T. Clocks whose offset from a
    common clock is known with the standard deviation sigma have the covariance ``diag(sigma^2 rho) + rho rho^T / sum(T
    rho)``, with ``rho = 1/(1 + sigma^2 T)``. Clocks without satellites have the covariance 0.
    """
    groups, mass = len(totals), 0.0
    if not len(tie_sigma_m):
        for g in range(groups):
            if totals[g] > 0.0:
                covariance[g, g] = 1.0 / totals[g]
        return
    for g in range(groups):
        rho[g] = 1.0 / (1.0 + tie_sigma_m[g] ** 2 * totals[g]) if totals[g] > 0.0 else 0.0
        mass += totals[g] * rho[g]
    for g in range(groups):
        for k in range(groups):
            covariance[g, k] = rho[g] * rho[k] / mass if mass > 0.0 else rho[g] * rho[k]
        covariance[g, g] += tie_sigma_m[g] ** 2 * rho[g]


@inner
def _invert_scaled(matrix: Floats, scale: Floats, inverse: Floats) -> None:
    """Invert a symmetric 3 x 3 matrix; NaN if it is singular. `matrix` is overwritten by its scaled form."""
    for i in range(3):
        scale[i] = 1.0 / math.sqrt(matrix[i, i]) if matrix[i, i] > 0.0 else math.nan
    for i in range(3):
        for j in range(3):
            matrix[i, j] *= scale[i] * scale[j]
    invert(matrix, inverse)
    for i in range(3):
        for j in range(3):
            inverse[i, j] *= scale[i] * scale[j]


@kernel
def linearise_ranges(
    ranges: Any, place_ecef_m: Floats, axes: Floats, prior: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Linearise and whiten ranges at positions, with the clocks eliminated.

    Parameters
    ----------
    ranges : RangeArrays
    place_ecef_m : ndarray, shape (T, 3) [m]
        Linearisation points; NaN if there is no position (design, misfit and covariance are then NaN).
    axes : ndarray, shape (T, 3, 3)
        Unit vectors along which the position unknowns are measured.
    prior : ndarray, shape (3, 3) [1/m^2]
        Prior information on the position.

    Returns
    -------
    root_weight, clock_covariance_m2, design, covariance_m2, misfit
        Fields of `LinearModel`.
    """
    sat_ecef_m, code_m, weight, starts, offset_m, sigma_m = ranges
    epochs, channels = weight.shape
    groups, tied, no = len(starts), len(offset_m) == epochs, np.empty(0)
    root, misfit = np.zeros((epochs, channels)), np.zeros((epochs, channels))
    design, covariance = np.zeros((epochs, channels, 3)), np.empty((epochs, 3, 3))
    clocks = np.zeros((epochs, groups, groups))
    totals, rho, sums, of_clock = np.empty(groups), np.empty(groups), np.empty((3, groups)), np.empty((3, groups))
    rows, normal, scale = np.empty((channels, 3)), np.empty((3, 3)), np.empty(3)
    for t in range(epochs):
        x, y, z = place_ecef_m[t, 0], place_ecef_m[t, 1], place_ecef_m[t, 2]
        total = common = 0.0
        for g in range(groups):
            totals[g] = sums[0, g] = sums[1, g] = sums[2, g] = 0.0
            offset, stop = offset_m[t, g] if tied else 0.0, starts[g + 1] if g + 1 < groups else channels
            for m in range(starts[g], stop):
                w = weight[t, m]
                if not w > 0.0:
                    continue
                distance, u0, u1, u2 = sight(sat_ecef_m[t, m, 0], sat_ecef_m[t, m, 1], sat_ecef_m[t, m, 2], x, y, z)
                misfit[t, m] = code_m[t, m] - distance - offset
                root[t, m] = math.sqrt(w)
                totals[g] += w
                common += w * misfit[t, m]
                for i in range(3):
                    rows[m, i] = -(u0 * axes[t, i, 0] + u1 * axes[t, i, 1] + u2 * axes[t, i, 2])
                    sums[i, g] += w * rows[m, i]
            total += totals[g]
        # A constant is subtracted from all ranges, which preserves digits of the sums and changes no residual.
        common = common / total if total > 0.0 else 0.0
        _write_clock_covariance(totals, sigma_m[t] if tied else no, rho, clocks[t])
        for i in range(3):
            for j in range(3):
                normal[i, j] = prior[i, j]
            for g in range(groups):
                of_clock[i, g] = 0.0
                for k in range(groups):
                    of_clock[i, g] += clocks[t, g, k] * sums[i, k]
        for g in range(groups):
            stop = starts[g + 1] if g + 1 < groups else channels
            for m in range(starts[g], stop):
                if not weight[t, m] > 0.0:
                    continue
                misfit[t, m] = root[t, m] * (misfit[t, m] - common)
                for i in range(3):
                    design[t, m, i] = root[t, m] * (rows[m, i] - of_clock[i, g])
                for i in range(3):
                    for j in range(i, 3):
                        normal[i, j] += weight[t, m] * rows[m, i] * (rows[m, j] - of_clock[j, g])
        normal[1, 0], normal[2, 0], normal[2, 1] = normal[0, 1], normal[0, 2], normal[1, 2]
        _invert_scaled(normal, scale, covariance[t])
        if not math.isfinite(x):
            for m in range(channels):
                misfit[t, m] = math.nan
                for i in range(3):
                    design[t, m, i] = math.nan
    return root, clocks, design, covariance, misfit


@kernel
def residuals(model: Any) -> tuple[Floats, Floats, Floats]:
    """Compute position step, residuals and redundancies of the best fit to the misfits (fields of `LinearModel`)."""
    root_weight, clock, clock_covariance_m2, design, covariance_m2, _, misfit = model
    epochs, channels = root_weight.shape
    groups = clock_covariance_m2.shape[1]
    step, residual, redundancy = np.empty((epochs, 3)), np.empty((epochs, channels)), np.empty((epochs, channels))
    sums, of_clock, pull = np.empty(groups), np.empty(groups), np.empty(3)
    for t in range(epochs):
        for g in range(groups):
            sums[g] = of_clock[g] = 0.0
        for i in range(3):
            pull[i] = step[t, i] = 0.0
        for m in range(channels):
            sums[clock[m]] += root_weight[t, m] * misfit[t, m]
            for i in range(3):
                pull[i] += misfit[t, m] * design[t, m, i]
        for i in range(3):
            for j in range(3):
                step[t, i] += covariance_m2[t, i, j] * pull[j]
        for g in range(groups):
            for k in range(groups):
                of_clock[g] += clock_covariance_m2[t, g, k] * sums[k]
        for m in range(channels):
            root, g, place = root_weight[t, m], clock[m], 0.0
            residual[t, m] = misfit[t, m] - root * of_clock[g]
            for i in range(3):
                residual[t, m] -= design[t, m, i] * step[t, i]
                for j in range(3):
                    place += design[t, m, i] * covariance_m2[t, i, j] * design[t, m, j]
            redundancy[t, m] = (1.0 - root * root * clock_covariance_m2[t, g, g] if root > 0.0 else 0.0) - place
    return step, residual, redundancy
