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
def reweight_ranges(
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
    u, misfit, root, factor = np.empty((3, channels)), np.empty(channels), np.empty(channels), np.empty(channels)
    base, w, rows, white = np.empty(channels), np.empty(channels), np.empty((4, channels)), np.empty(channels)
    order, channel = np.empty(channels, dtype=np.int64), np.empty(channels, dtype=np.int64)
    ux, uy, uz, of_x, of_y, of_z, rest = u[0], u[1], u[2], rows[0], rows[1], rows[2], rows[3]
    begin = np.zeros(groups + 1, dtype=np.int64)
    totals, mass, means, apart = np.empty(groups), np.empty(groups), np.empty((4, groups)), np.empty((4, groups))
    for t in range(epochs):
        x, y, z = place_ecef_m[t, 0], place_ecef_m[t, 1], place_ecef_m[t, 2]
        # The used channels side by side, those of group g from begin[g] on.
        count = 0
        for g in range(groups):
            begin[g], stop = count, starts[g + 1] if g + 1 < groups else channels
            for m in range(starts[g], stop):
                if weight[t, m] > 0.0:
                    base[count], channel[count], order[count] = weight[t, m], m, count
                    count += 1
        begin[groups] = count
        for k in range(count):
            m = channel[k]
            distance, ux[k], uy[k], uz[k] = sight(
                sat_ecef_m[t, m, 0], sat_ecef_m[t, m, 1], sat_ecef_m[t, m, 2], x, y, z
            )
            misfit[k], root[k], factor[k] = code_m[t, m] - distance, math.sqrt(base[k]), 1.0
        finite, scale = False, 1.0
        for _ in range(iterations):
            for k in range(count):
                w[k] = base[k] * factor[k]
            for g in range(groups):
                total = mean_x = mean_y = mean_z = mean_r = 0.0
                for k in range(begin[g], begin[g + 1]):
                    total += w[k]
                    mean_x += w[k] * ux[k]
                    mean_y += w[k] * uy[k]
                    mean_z += w[k] * uz[k]
                    mean_r += w[k] * misfit[k]
                if total > 0.0:
                    mean_x, mean_y, mean_z, mean_r = mean_x / total, mean_y / total, mean_z / total, mean_r / total
                totals[g], means[0, g], means[1, g], means[2, g], means[3, g] = total, -mean_x, -mean_y, -mean_z, mean_r
                for k in range(begin[g], begin[g + 1]):
                    of_x[k], of_y[k], of_z[k] = mean_x - ux[k], mean_y - uy[k], mean_z - uz[k]
                    rest[k] = misfit[k] - mean_r
            a = b = c = d = e = f = v0 = v1 = v2 = 0.0
            for k in range(count):
                wx, wy, wz = w[k] * of_x[k], w[k] * of_y[k], w[k] * of_z[k]
                a, b, c, d = a + wx * of_x[k], b + wx * of_y[k], c + wx * of_z[k], d + wy * of_y[k]
                e, f, v0 = e + wy * of_z[k], f + wz * of_z[k], v0 + wx * rest[k]
                v1, v2 = v1 + wy * rest[k], v2 + wz * rest[k]
            if tied:
                all_mass = 0.0
                for g in range(groups):
                    mass[g] = 1.0 / (1.0 / totals[g] + sigma_m[t, g] ** 2) if totals[g] > 0.0 else 0.0
                    all_mass += mass[g]
                for i in range(4):
                    common = 0.0
                    for g in range(groups):
                        apart[i, g] = means[i, g] - (offset_m[t, g] if i == 3 else 0.0)
                        common += mass[g] * apart[i, g]
                    for g in range(groups):
                        apart[i, g] -= common / all_mass if all_mass > 0.0 else 0.0
                for g in range(groups):
                    if not totals[g] > 0.0:
                        continue
                    own, ax, ay, az, ar = mass[g], apart[0, g], apart[1, g], apart[2, g], apart[3, g]
                    a, b, c, d = a + own * ax * ax, b + own * ax * ay, c + own * ax * az, d + own * ay * ay
                    e, f, v0 = e + own * ay * az, f + own * az * az, v0 + own * ax * ar
                    v1, v2 = v1 + own * ay * ar, v2 + own * az * ar
                    own = 1.0 / (totals[g] * sigma_m[t, g] ** 2 + 1.0)
                    for i in range(4):
                        means[i, g] -= apart[i, g] * own
            if informed:
                a, b, c = a + information[t, 0, 0], b + information[t, 0, 1], c + information[t, 0, 2]
                d, e, f = d + information[t, 1, 1], e + information[t, 1, 2], f + information[t, 2, 2]
            c00, c11, c22 = d * f - e * e, a * f - c * c, a * d - b * b
            c01, c02, c12 = c * e - b * f, b * e - c * d, b * c - a * e
            determinant = a * c00 + b * c01 + c * c02
            mean = (a + d + f) / 3.0
            finite = determinant > 1e-12 * mean * mean * mean
            s0 = s1 = s2 = 0.0
            if finite:
                s0 = (c00 * v0 + c01 * v1 + c02 * v2) / determinant
                s1 = (c01 * v0 + c11 * v1 + c12 * v2) / determinant
                s2 = (c02 * v0 + c12 * v1 + c22 * v2) / determinant
            for g in range(groups):
                known = 1.0 if finite and totals[g] > 0.0 else 0.0
                clock = means[3, g] - (s0 * means[0, g] + s1 * means[1, g] + s2 * means[2, g])
                for k in range(begin[g], begin[g + 1]):
                    moved = ux[k] * s0 + uy[k] * s1 + uz[k] * s2
                    white[k] = known * root[k] * abs(misfit[k] + moved - clock)
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
