"""Antenna velocities from carrier-phase changes or Dopplers alone, without the line.

Velocity and clock drift are fitted by reweighted least squares (Student's t errors), with the vertical velocity assumed
near 0. If the velocity points across the line, the position, the branch or the map is wrong.
"""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats
from railfix.kernels.compiling import inner, kernel
from railfix.kernels.sight import sight
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.equations import write_range_rate
from railfix.kernels.tracking.layout import Records
from railfix.kernels.tracking.update import correct, median

#: Assumed standard deviation of the vertical velocity [m/s], for gradients of a few per cent.
CLIMB_MPS = 0.3
#: Standard deviation of the loose prior of velocity and clock drift [m/s], for conditioning.
PRIOR_MPS = 1e3
#: Degrees of freedom of Student's t errors; number of fits; least redundancy; least mean weight of a consistent fit.
DEGREES = 4.0
PASSES = 8
REDUNDANT = 2
AGREEING = 0.9


@kernel
def write_velocities(epoch: Records, channel: Records, near_ecef_m: Floats, up: Floats) -> None:
    """Write velocities, covariances and ages from phases, or from Dopplers where phases give no velocity.

    The velocity is NaN where the measurements are too few or inconsistent. A velocity from phases refers to a time half
    an interval before the epoch. `epoch`, shape (T,), and `channel`, shape (T, K), are records `EPOCH` and `CHANNEL`.
    `near_ecef_m`, shape (T, 3), are positions accurate to hundreds of metres, NaN if unknown. `up`, shape (T, 3), are
    the vertical unit vectors at these positions.
    """
    epochs, channels = channel.shape
    h, y, r, u = np.empty((channels + 1, 4)), np.empty(channels + 1), np.empty(channels + 1), np.empty(3)
    for t in range(epochs):
        one, point = epoch[t], near_ecef_m[t]
        one.velocity_mps[:] = math.nan
        if not math.isfinite(point[0]):
            continue
        for kind in (ix.PHASE, ix.DOPPLER):
            count, dt = 0, one.interval_s
            for k in range(channels):
                from_ = channel[t, k]
                if not from_.has[kind]:
                    continue
                sat, before = from_.sat_ecef_m, from_.before_ecef_m
                distance, u[0], u[1], u[2] = sight(sat[0], sat[1], sat[2], point[0], point[1], point[2])
                if kind == ix.PHASE:
                    distance -= sight(before[0], before[1], before[2], point[0], point[1], point[2])[0]
                    h[count, :3], y[count] = -u, (from_.measured[kind] - distance) / dt
                    r[count] = from_.variance[kind] / dt**2
                else:
                    y[count] = from_.measured[kind] - write_range_rate(from_, point, u, h[count, :3])
                    r[count] = from_.variance[kind]
                count += 1
            if fit_velocity(h, y, r, count, up[t], one.velocity_mps, one.velocity_covariance):
                one.velocity_age_s = 0.5 * dt if kind == ix.PHASE else 0.0
                break


@inner
def fit_velocity(h: Floats, y: Floats, r: Floats, count: int, up: Floats, velocity: Floats, covariance: Floats) -> bool:
    """Fit velocity and clock drift; return False if measurements are too few or inconsistent.

    The first `count` rows are measurements ``y = h . v + drift``: coefficients h, shape (M, 4), range rates y [m/s] and
    their variances r, both of shape (M,). y is changed, and a vertical velocity of 0 is appended. The results are
    written into `velocity`, shape (3,), and, scaled by the residuals, `covariance`, shape (3, 3).
    """
    if count - 3 < REDUNDANT:
        return False
    y[:count] -= median(y[:count])
    h[:count, 3], h[count, :3], h[count, 3], y[count], r[count] = 1.0, up, 0.0, 0.0, CLIMB_MPS**2
    weight, square, x, P = np.ones(count + 1), np.empty(count), np.empty(4), np.empty((4, 4))
    g, gain = np.empty(4), np.empty(4)
    for _ in range(PASSES):
        x[:], P[:] = 0.0, 0.0
        for a in range(4):
            P[a, a] = PRIOR_MPS**2
        for j in range(count + 1):
            innovation, total = y[j], r[j] / weight[j]
            for a in range(4):
                g[a] = 0.0
                for b in range(4):
                    g[a] += P[a, b] * h[j, b]
                innovation, total = innovation - h[j, a] * x[a], total + h[j, a] * g[a]
            correct(x, P, g, innovation, total, gain)
        for j in range(count):
            residual = y[j]
            for a in range(4):
                residual -= h[j, a] * x[a]
            square[j] = residual**2 / r[j]
            weight[j] = (DEGREES + 1.0) / (DEGREES + square[j])
    if weight[:count].sum() < AGREEING * count:
        return False
    velocity[:], covariance[:] = x[:3], P[:3, :3] * max((weight[:count] * square).sum() / (count - 3), 1.0)
    return True
