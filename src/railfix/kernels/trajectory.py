"""Compiled functions of `railfix.track`: values between the points of a trajectory, nearest segments of a polyline."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.kernels.compiling import kernel


@kernel
def interpolated(arc: Floats, arc_m: Floats, length_m: Floats, values: Floats, tolerance_m: float) -> Floats:
    """Return the values at arc lengths, one by one."""
    width, last = values.shape[1], len(length_m) - 1
    result = np.full((len(arc), width), np.nan)
    for p in range(len(arc)):
        if np.isnan(arc[p]):
            continue
        index = min(max(np.searchsorted(arc_m, arc[p], side="right") - 1, 0), last)
        share = (arc[p] - arc_m[index]) / length_m[index]
        beyond = tolerance_m / length_m[index]
        if share < -beyond or share > 1.0 + beyond:
            continue
        for k in range(width):
            result[p, k] = (1.0 - share) * values[index, k] + share * values[index + 1, k]
    return result


@kernel
def nearest_segments(
    points_m: Floats, segment: Indices, start_m: Floats, step_m: Floats
) -> tuple[Indices, Floats, Floats]:
    """Return the nearest of some segments to each point, one by one."""
    points, candidates = segment.shape
    chosen, share, best = np.empty(points, dtype=np.intp), np.empty(points), np.full(points, np.inf)
    shares, offsets = np.empty(candidates), np.empty(candidates)
    for p in range(points):
        for c in range(candidates):
            s, along, squared = segment[p, c], 0.0, 0.0
            for k in range(3):
                along += (points_m[p, k] - start_m[s, k]) * step_m[s, k]
                squared += step_m[s, k] * step_m[s, k]
            shares[c], rest = min(max(along / squared, 0.0), 1.0), 0.0
            for k in range(3):
                rest += (points_m[p, k] - start_m[s, k] - shares[c] * step_m[s, k]) ** 2
            offsets[c] = math.sqrt(rest)
            best[p] = min(best[p], offsets[c])
        first = math.inf
        for c in range(candidates):
            place = segment[p, c] + shares[c]
            if offsets[c] <= best[p] * (1 + 1e-12) + 1e-9 and place < first:
                first, chosen[p], share[p] = place, segment[p, c], shares[c]
    return chosen, share, best
