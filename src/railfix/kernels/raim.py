"""Ranges linearised at a place."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from railfix.core.arrays import Floats
from railfix.kernels.compiling import inner, kernel
from railfix.kernels.ranges import invert
from railfix.kernels.sight import sight


@inner
def _clock_covariance(totals: Floats, tie_sigma_m: Floats, covariance: Floats) -> None:
    """Write the covariance of the clocks at a known place [m^2], by the summed weights of their satellites.

    Of a clock on its own 1/T. Clocks that keep an offset to a common one to sigma (`tie_sigma_m`, of length 0 without):
    ``diag(sigma^2 rho) + rho rho^T / sum(T rho)``, ``rho = 1/(1 + sigma^2 T)``. 0 for clocks without satellites.
    """
    groups, mass = len(totals), 0.0
    for g in range(len(tie_sigma_m)):
        mass += totals[g] / (1.0 + tie_sigma_m[g] ** 2 * totals[g])
    for g in range(groups):
        for h in range(groups):
            covariance[g, h] = 0.0
            if len(tie_sigma_m) and totals[g] > 0.0 and totals[h] > 0.0:
                own, other = 1.0 + tie_sigma_m[g] ** 2 * totals[g], 1.0 + tie_sigma_m[h] ** 2 * totals[h]
                covariance[g, h] = 1.0 / (own * other * mass) + (tie_sigma_m[g] ** 2 / own if g == h else 0.0)
        if totals[g] > 0.0 and not len(tie_sigma_m):
            covariance[g, g] = 1.0 / totals[g]


@inner
def regular_inverse(matrix: Floats, scale: Floats, inverse: Floats) -> None:
    """Write the inverse of a symmetric 3 x 3 matrix, of which the upper half is read and scaled to a unit diagonal.

    NaN where it is singular.
    """
    for a in range(3):
        scale[a] = 1.0 / math.sqrt(matrix[a, a]) if matrix[a, a] > 0.0 else math.nan
    for a in range(3):
        for b in range(a, 3):
            matrix[a, b] *= scale[a] * scale[b]
    invert(matrix, inverse)
    for a in range(3):
        for b in range(3):
            inverse[a, b] *= scale[a] * scale[b]


@kernel
def whitened_ranges(
    ranges: Any, place_ecef_m: Floats, axes: Floats, prior: Floats
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Whiten ranges at places (T, 3), take the clocks out, invert; NaN where a place is.

    Parameters
    ----------
    ranges : RangeArrays
    axes : ndarray, shape (T, 3, 3)
        Unit vectors of the unknowns.
    prior : ndarray, shape (3, 3) [1/m^2]

    Returns
    -------
    root_weight, clock_covariance_m2, design, covariance_m2, misfit
        Of `LinearModel`.
    """
    sat_ecef_m, code_m, weight, starts, offset_m, sigma_m = ranges
    epochs, channels = weight.shape
    groups, no, tied = len(starts), np.empty(0), len(offset_m) == epochs
    root, misfit, design = np.sqrt(weight), np.zeros((epochs, channels)), np.zeros((epochs, channels, 3))
    clocks, inverse = np.zeros((epochs, groups, groups)), np.empty((epochs, 3, 3))
    totals, sums, asked = np.empty(groups), np.empty((groups, 3)), np.empty((groups, 3))
    normal, scale, row = np.empty((3, 3)), np.empty(3), np.empty(3)
    for t in range(epochs):
        x, y, z = place_ecef_m[t, 0], place_ecef_m[t, 1], place_ecef_m[t, 2]
        all_mass, mean = 0.0, 0.0
        for g in range(groups):
            stop, known = starts[g + 1] if g + 1 < groups else channels, offset_m[t, g] if tied else 0.0
            totals[g] = 0.0
            for a in range(3):
                sums[g, a] = 0.0
            for m in range(starts[g], stop):
                w = weight[t, m]
                if not w > 0.0:
                    continue
                distance, ux, uy, uz = sight(sat_ecef_m[t, m, 0], sat_ecef_m[t, m, 1], sat_ecef_m[t, m, 2], x, y, z)
                misfit[t, m] = code_m[t, m] - distance - known
                totals[g] += w
                mean += w * misfit[t, m]
                for a in range(3):
                    design[t, m, a] = -root[t, m] * (ux * axes[t, a, 0] + uy * axes[t, a, 1] + uz * axes[t, a, 2])
                    sums[g, a] += root[t, m] * design[t, m, a]
            all_mass += totals[g]
        # A constant common to all ranges is no residual; subtracting it keeps the digits of the sums.
        mean /= all_mass if all_mass > 0.0 else 1.0
        _clock_covariance(totals, sigma_m[t] if tied else no, clocks[t])
        for a in range(3):
            for b in range(3):
                normal[a, b] = prior[a, b]
            for g in range(groups):
                asked[g, a] = 0.0
                for h in range(groups):
                    asked[g, a] += clocks[t, g, h] * sums[h, a]
        for g in range(groups):
            for m in range(starts[g], starts[g + 1] if g + 1 < groups else channels):
                if not weight[t, m] > 0.0:
                    continue
                misfit[t, m] = root[t, m] * (misfit[t, m] - mean)
                for b in range(3):
                    row[b] = design[t, m, b]
                    design[t, m, b] -= root[t, m] * asked[g, b]
                    for a in range(b + 1):
                        normal[a, b] += row[a] * design[t, m, b]
        regular_inverse(normal, scale, inverse[t])
    return root, clocks, design, inverse, misfit
