"""Compiled functions of `railfix.positioning.normal_equations`: pseudoranges at a place, clocks eliminated."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.kernels.compiling import kernel

_SAGNAC = EARTH_ROTATION_RATE / SPEED_OF_LIGHT


@kernel
def reduced_equations(
    sat_ecef_m: Floats,
    code_m: Floats,
    weight: Floats,
    place_ecef_m: Floats,
    starts: Indices,
    offset_m: Floats,
    sigma_m: Floats,
) -> tuple[Floats, Floats, Floats, Masks]:
    """Compute the normal equations of place and residual with the clocks eliminated; channel by channel."""
    epochs, channels = weight.shape
    groups = len(starts)
    tied = len(offset_m) == epochs
    system, means = np.zeros((epochs, 4, 4)), np.zeros((epochs, 4, groups))
    rows, seen = np.zeros((epochs, 4, channels)), np.zeros((epochs, groups), dtype=np.bool_)
    totals, mass, apart, common = np.empty(groups), np.empty(groups), np.empty((4, groups)), np.empty(4)
    for t in range(epochs):
        x, y, z = place_ecef_m[t, 0], place_ecef_m[t, 1], place_ecef_m[t, 2]
        for g in range(groups):
            stop = starts[g + 1] if g + 1 < groups else channels
            total, mean_x, mean_y, mean_z, mean_r = 0.0, 0.0, 0.0, 0.0, 0.0
            for m in range(starts[g], stop):
                w = weight[t, m]
                if not w > 0.0:
                    continue
                sx, sy, sz = sat_ecef_m[t, m, 0], sat_ecef_m[t, m, 1], sat_ecef_m[t, m, 2]
                dx, dy, dz = sx - x, sy - y, sz - z
                distance = math.sqrt(dx * dx + dy * dy + dz * dz)
                ux, uy, uz = -dx / distance, -dy / distance, -dz / distance
                residual = code_m[t, m] - (distance + _SAGNAC * (sx * y - sy * x))
                rows[t, 0, m], rows[t, 1, m], rows[t, 2, m], rows[t, 3, m] = ux, uy, uz, residual
                total += w
                mean_x += w * ux
                mean_y += w * uy
                mean_z += w * uz
                mean_r += w * residual
            totals[g] = total
            if total > 0.0:
                seen[t, g] = True
                mean_x, mean_y, mean_z, mean_r = mean_x / total, mean_y / total, mean_z / total, mean_r / total
            means[t, 0, g], means[t, 1, g], means[t, 2, g], means[t, 3, g] = mean_x, mean_y, mean_z, mean_r
            for m in range(starts[g], stop):
                w = weight[t, m]
                if not w > 0.0:
                    continue
                rows[t, 0, m] -= mean_x
                rows[t, 1, m] -= mean_y
                rows[t, 2, m] -= mean_z
                rows[t, 3, m] -= mean_r
                for i in range(4):
                    wi = w * rows[t, i, m]
                    for j in range(i, 4):
                        system[t, i, j] += wi * rows[t, j, m]
        if tied:
            all_mass = 0.0
            for g in range(groups):
                mass[g] = 1.0 / (1.0 / totals[g] + sigma_m[t, g] ** 2) if seen[t, g] else 0.0
                all_mass += mass[g]
            for i in range(4):
                common[i] = 0.0
                for g in range(groups):
                    apart[i, g] = means[t, i, g] - (offset_m[t, g] if i == 3 else 0.0)
                    common[i] += mass[g] * apart[i, g]
                if all_mass > 0.0:
                    common[i] /= all_mass
            for g in range(groups):
                if not seen[t, g]:
                    continue
                for i in range(4):
                    apart[i, g] -= common[i]
                stop = starts[g + 1] if g + 1 < groups else channels
                own = 1.0 / (totals[g] * sigma_m[t, g] ** 2 + 1.0)
                for i in range(4):
                    for j in range(i, 4):
                        system[t, i, j] += mass[g] * apart[i, g] * apart[j, g]
                    shift = apart[i, g] * own
                    means[t, i, g] -= shift
                    for m in range(starts[g], stop):
                        if weight[t, m] > 0.0:
                            rows[t, i, m] += shift
        for i in range(4):
            for j in range(i):
                system[t, i, j] = system[t, j, i]
    return system, means, rows, seen
