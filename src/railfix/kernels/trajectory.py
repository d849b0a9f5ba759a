"""Compiled function of `railfix.track.trajectory`: values between the points of a trajectory."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats
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
