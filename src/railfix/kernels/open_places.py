"""Compiled function of `railfix.pipeline.open_places`: bound of the risk off the tangent."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats
from railfix.kernels.compiling import kernel

#: `railfix.integrity.raim.exclusion.LEAST_REDUNDANCY`.
_LEAST_REDUNDANCY = 1e-9


@kernel
def risk_off_tangent(
    projector: Floats,
    residual: Floats,
    design: Floats,
    prior: Floats,
    slope: Floats,
    matrix: Floats,
    clear_m: Floats,
) -> Floats:
    """Return an upper bound of the probability that the true place lies off the tangent beyond a distance."""
    epochs, n = prior.shape
    total = np.empty(epochs)
    for t in range(epochs):
        s, r, u = slope[t, 0], slope[t, 1], slope[t, 2]
        m_xx, m_xy, m_xz = matrix[t, 0, 0], matrix[t, 0, 1], matrix[t, 0, 2]
        m_yy, m_yz, m_zz = matrix[t, 1, 1], matrix[t, 1, 2], matrix[t, 2, 2]
        spent = 0.0
        # One hypothesis after the other: none, each channel (j = -1), each pair.
        for i in range(-1, n):
            for j in range(-1, i if i >= 0 else 0):
                if i < 0:
                    p = 2.0
                elif j < 0:
                    p = prior[t, i]
                else:
                    p = prior[t, i] * prior[t, j]
                if p == 0.0:
                    continue
                sx, sy, sz = s, r, u
                xx, xy, xz, yy, yz, zz = m_xx, m_xy, m_xz, m_yy, m_yz, m_zz
                if i >= 0:
                    a = projector[t, i, i]
                    fx, fy, fz = design[t, i, 0], design[t, i, 1], design[t, i, 2]
                    if j < 0:
                        w = 1.0 / a if a > _LEAST_REDUNDANCY else 0.0
                        own = w * residual[t, i]
                        sx -= own * fx
                        sy -= own * fy
                        sz -= own * fz
                        xx -= w * fx * fx
                        xy -= w * fx * fy
                        xz -= w * fx * fz
                        yy -= w * fy * fy
                        yz -= w * fy * fz
                        zz -= w * fz * fz
                    else:
                        b, c = projector[t, j, i], projector[t, j, j]
                        gx, gy, gz = design[t, j, 0], design[t, j, 1], design[t, j, 2]
                        det = a * c - b * b
                        if min(a, c) > _LEAST_REDUNDANCY and det > _LEAST_REDUNDANCY * a * c:
                            w = 1.0 / det
                            a, b, c = a * w, b * w, c * w
                            one, two = residual[t, i], residual[t, j]
                            own_i, own_j = c * one - b * two, a * two - b * one
                            sx -= own_i * fx + own_j * gx
                            sy -= own_i * fy + own_j * gy
                            sz -= own_i * fz + own_j * gz
                            ix, iy, iz = c * fx - b * gx, c * fy - b * gy, c * fz - b * gz
                            jx, jy, jz = a * gx - b * fx, a * gy - b * fy, a * gz - b * fz
                            xx -= ix * fx + jx * gx
                            xy -= ix * fy + jx * gy
                            xz -= ix * fz + jx * gz
                            yy -= iy * fy + jy * gy
                            yz -= iy * fz + jy * gz
                            zz -= iz * fz + jz * gz
                c_xx, c_yy, c_zz = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
                c_xy, c_xz, c_yz = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
                det = xx * c_xx + xy * c_xy + xz * c_xz
                mean = (xx + yy + zz) / 3.0
                tail = 1.0
                if det > 1e-12 * mean * mean * mean:
                    inverse = 1.0 / det
                    x = (c_xx * sx + c_xy * sy + c_xz * sz) * inverse
                    y = (c_xy * sx + c_yy * sy + c_yz * sz) * inverse
                    z = (c_xz * sx + c_yz * sy + c_zz * sz) * inverse
                    gap = max(clear_m[t] - math.sqrt(x * x + y * y), 0.0)
                    excess = gap * gap / ((c_xx + c_yy) * inverse) - max(x * sx + y * sy + z * sz, 0.0)
                    if excess > 1400.0:
                        tail = 0.0
                    elif excess > 0.0:
                        tail = 0.5 * math.erfc(math.sqrt(0.5 * excess))
                spent += p * tail
        total[t] = spent
    return total
