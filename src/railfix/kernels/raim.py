"""Compiled function of `railfix.integrity.raim`: residuals and projector of the used channels side by side."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.kernels.compiling import kernel


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
