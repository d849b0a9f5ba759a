"""Robust weights."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.kernels.compiling import kernel
from railfix.kernels.sight import sight

#: Least scale of whitened residuals: ranges do not agree better than that by their own merit.
_LEAST_SCALE = 0.05


@kernel
def reweighted(
    ranges: Any,
    place_ecef_m: Floats,
    information: Floats,
    correction: Floats,
    keep: float,
    reject: float,
    iterations: int,
) -> tuple[Masks, Floats, Masks]:
    """Reweight ranges by their residuals.

    Parameters
    ----------
    ranges : RangeArrays
    place_ecef_m : ndarray, shape (T, 3) [m]
        In C order.
    information : ndarray, shape (T, 3, 3) [1/m^2], or (0, 3, 3)
    correction : ndarray, shape (T,)
        Scale of the residuals over their median.
    keep, reject : float
    iterations : int

    Returns
    -------
    kept : ndarray of bool, shape (T, M)
    wsse : ndarray, shape (T,)
        Weighted sum of the squared residuals of the kept ranges.
    solved : ndarray of bool, shape (T,)
        False where the last step was not determined.
    """
    sat_ecef_m, code_m, weight, starts, offset_m, sigma_m = ranges
    epochs, channels = weight.shape
    groups = len(starts)
    tied, informed = len(offset_m) == epochs, len(information) == epochs
    kept, wsse = np.zeros((epochs, channels), dtype=np.bool_), np.zeros(epochs)
    solved = np.zeros(epochs, dtype=np.bool_)
    u = np.empty((3, channels))
    misfit, root, base, factor = np.empty(channels), np.empty(channels), np.empty(channels), np.empty(channels)
    white, order, group_of = np.empty(channels), np.empty(channels, dtype=np.int64), np.empty(channels, dtype=np.int64)
    channel = np.empty(channels, dtype=np.int64)
    totals, mass, means, apart = np.empty(groups), np.empty(groups), np.empty((4, groups)), np.empty((4, groups))
    common, n, v, row = np.empty(4), np.empty((3, 3)), np.empty(3), np.empty(4)
    for t in range(epochs):
        x, y, z = place_ecef_m[t, 0], place_ecef_m[t, 1], place_ecef_m[t, 2]
        # The used channels side by side.
        count = 0
        for g in range(groups):
            stop = starts[g + 1] if g + 1 < groups else channels
            for m in range(starts[g], stop):
                w = weight[t, m]
                if not w > 0.0:
                    continue
                distance, u[0, count], u[1, count], u[2, count] = sight(
                    sat_ecef_m[t, m, 0], sat_ecef_m[t, m, 1], sat_ecef_m[t, m, 2], x, y, z
                )
                misfit[count] = code_m[t, m] - distance
                base[count], root[count], factor[count] = w, math.sqrt(w), 1.0
                channel[count], group_of[count], order[count] = m, g, count
                count += 1
        finite, scale = False, 1.0
        for _ in range(iterations):
            for g in range(groups):
                totals[g] = 0.0
                for i in range(4):
                    means[i, g] = 0.0
            for k in range(count):
                w, g = base[k] * factor[k], group_of[k]
                totals[g] += w
                means[0, g] -= w * u[0, k]
                means[1, g] -= w * u[1, k]
                means[2, g] -= w * u[2, k]
                means[3, g] += w * misfit[k]
            for g in range(groups):
                if totals[g] > 0.0:
                    for i in range(4):
                        means[i, g] /= totals[g]
            for i in range(3):
                v[i] = 0.0
                for j in range(3):
                    n[i, j] = 0.0
            for k in range(count):
                w, g = base[k] * factor[k], group_of[k]
                if not w > 0.0:
                    continue
                for i in range(3):
                    row[i] = -u[i, k] - means[i, g]
                row[3] = misfit[k] - means[3, g]
                for i in range(3):
                    wi = w * row[i]
                    for j in range(i, 3):
                        n[i, j] += wi * row[j]
                    v[i] += wi * row[3]
            if tied:
                all_mass = 0.0
                for g in range(groups):
                    mass[g] = 1.0 / (1.0 / totals[g] + sigma_m[t, g] ** 2) if totals[g] > 0.0 else 0.0
                    all_mass += mass[g]
                for i in range(4):
                    common[i] = 0.0
                    for g in range(groups):
                        apart[i, g] = means[i, g] - (offset_m[t, g] if i == 3 else 0.0)
                        common[i] += mass[g] * apart[i, g]
                    if all_mass > 0.0:
                        common[i] /= all_mass
                for g in range(groups):
                    if not totals[g] > 0.0:
                        continue
                    for i in range(4):
                        apart[i, g] -= common[i]
                    own = 1.0 / (totals[g] * sigma_m[t, g] ** 2 + 1.0)
                    for i in range(3):
                        for j in range(i, 3):
                            n[i, j] += mass[g] * apart[i, g] * apart[j, g]
                        v[i] += mass[g] * apart[i, g] * apart[3, g]
                    for i in range(4):
                        means[i, g] -= apart[i, g] * own
            if informed:
                for i in range(3):
                    for j in range(i, 3):
                        n[i, j] += information[t, i, j]
            a, b, c, d, e, f = n[0, 0], n[0, 1], n[0, 2], n[1, 1], n[1, 2], n[2, 2]
            c00, c11, c22 = d * f - e * e, a * f - c * c, a * d - b * b
            c01, c02, c12 = c * e - b * f, b * e - c * d, b * c - a * e
            determinant = a * c00 + b * c01 + c * c02
            mean = (a + d + f) / 3.0
            finite = determinant > 1e-12 * mean * mean * mean
            s0, s1, s2 = 0.0, 0.0, 0.0
            if finite:
                s0 = (c00 * v[0] + c01 * v[1] + c02 * v[2]) / determinant
                s1 = (c01 * v[0] + c11 * v[1] + c12 * v[2]) / determinant
                s2 = (c02 * v[0] + c12 * v[1] + c22 * v[2]) / determinant
            for k in range(count):
                g = group_of[k]
                white[k] = 0.0
                if finite and totals[g] > 0.0:
                    clock = means[3, g] - (s0 * means[0, g] + s1 * means[1, g] + s2 * means[2, g])
                    moved = u[0, k] * s0 + u[1, k] * s1 + u[2, k] * s2
                    white[k] = root[k] * abs(misfit[k] + moved - clock)
            for k in range(count):  # nearly in order from the second step on
                at, one = k, order[k]
                while at > 0 and white[order[at - 1]] > white[one]:
                    order[at] = order[at - 1]
                    at -= 1
                order[at] = one
            middle = min(count // 2, channels - 1)
            median = white[order[middle]] if middle < count else 0.0
            scale = max(median * correction[t], _LEAST_SCALE)
            changed = False
            for k in range(count):
                size, before = white[k] / scale, factor[k]
                if not size < reject:
                    factor[k] = 0.0
                elif size <= keep:
                    factor[k] = 1.0
                else:
                    factor[k] = ((reject - size) / (reject - keep)) ** 2 * keep / max(size, 1e-9)
                changed |= factor[k] != before
            if not changed:
                break  # every further step would be this one
        for k in range(count):
            if white[k] / scale < reject:
                kept[t, channel[k]] = True
                wsse[t] += white[k] * white[k]
        solved[t] = finite
    return kept, wsse, solved
