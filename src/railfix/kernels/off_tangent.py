"""Probability that the true position is on a part of the line that deviates from the tangent at the estimate."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.constants import LEAST_REDUNDANCY
from railfix.kernels.compiling import inner, kernel


@inner
def _inverse(matrix: Floats) -> Floats:
    """Return the inverse of a symmetric 3 x 3 matrix; the inverse is not finite if the matrix is singular."""
    inverse = np.empty((3, 3))
    for a in range(3):
        i, j = (a + 1) % 3, (a + 2) % 3
        for b in range(3):
            k, m = (b + 1) % 3, (b + 2) % 3
            inverse[a, b] = matrix[i, k] * matrix[j, m] - matrix[i, m] * matrix[j, k]
    determinant = matrix[0, 0] * inverse[0, 0] + matrix[0, 1] * inverse[0, 1] + matrix[0, 2] * inverse[0, 2]
    for a in range(3):
        for b in range(3):
            inverse[a, b] /= determinant
    return inverse


@inner
def _tail(clear_m: float, spread: float, start: float, misfit: float, tau: float) -> float:
    """Return an upper bound of the tail if the matrix is at least ``1 - tau`` times the matrix of all channels."""
    if not tau < 1.0:
        return 1.0
    form = (start + math.sqrt(max(tau, 0.0)) * misfit) ** 2 / (1.0 - tau)
    gap = max(clear_m - math.sqrt(spread / (1.0 - tau) * form), 0.0)
    excess = gap * gap * (1.0 - tau) / spread - form
    return 0.5 * math.erfc(math.sqrt(0.5 * excess)) if excess > 0.0 else 1.0


@inner
def _lowest(form: Floats) -> tuple[float, float, float, float, float, float, float]:
    """Return a quadratic form's minimum point, and the diagonal cofactors and inverse determinant of its matrix.

    A form is an array of a constant, three elements of the slope, and the matrix elements xx, xy, xz, yy, yz, zz. All
    returned numbers are 0 if the matrix is singular.
    """
    sx, sy, sz = form[1], form[2], form[3]
    xx, xy, xz, yy, yz, zz = form[4], form[5], form[6], form[7], form[8], form[9]
    c_xx, c_yy, c_zz = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    c_xy, c_xz, c_yz = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
    det = xx * c_xx + xy * c_xy + xz * c_xz
    mean = (xx + yy + zz) / 3.0
    if not det > 1e-12 * mean * mean * mean:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    inverse = 1.0 / det
    x = (c_xx * sx + c_xy * sy + c_xz * sz) * inverse
    y = (c_xy * sx + c_yy * sy + c_yz * sz) * inverse
    z = (c_xz * sx + c_yz * sy + c_zz * sz) * inverse
    return x, y, z, c_xx, c_yy, c_zz, inverse


@inner
def _compute_tail(form: Floats, clear_m: float) -> float:
    """Return the tail of a quadratic form."""
    x, y, z, c_xx, c_yy, _, inverse = _lowest(form)
    if inverse == 0.0:
        return 1.0
    gap = max(clear_m - math.sqrt(x * x + y * y), 0.0)
    excess = gap * gap / ((c_xx + c_yy) * inverse) - max(x * form[1] + y * form[2] + z * form[3], 0.0)
    if excess > 1400.0:
        return 0.0
    return 0.5 * math.erfc(math.sqrt(0.5 * excess)) if excess > 0.0 else 1.0


class _Residuals(NamedTuple):
    """Projector of the used channels, their residuals, and the gradients of the residuals (`rows`)."""

    projector: Floats  # (M, M)
    residual: Floats  # (M,)
    rows: Floats  # (3, M)
    whitened: Floats  # (4, M): square root of the weight, and design; work space
    clock: Indices  # (M,), work space


@inner
def _work_space(channels: int) -> _Residuals:
    """Allocate work arrays."""
    clock = np.empty(channels, dtype=np.intp)
    projector, whitened = np.empty((channels, channels)), np.empty((4, channels))
    return _Residuals(projector, np.empty(channels), np.empty((3, channels)), whitened, clock)


@inner
def _without(i: int, j: int, residuals: Any, every: Floats, form: Floats) -> None:
    """Write the quadratic form without channels i and j (-1: no channel), from `every`, the form of all channels."""
    projector, residual, rows, _, _ = residuals
    for k in range(10):
        form[k] = every[k]
    if i < 0:
        return
    a = projector[i, i]
    fx, fy, fz = rows[0, i], rows[1, i], rows[2, i]
    if j < 0:
        w = 1.0 / a if a > LEAST_REDUNDANCY else 0.0
        own = w * residual[i]
        form[0] -= own * residual[i]
        form[1] -= own * fx
        form[2] -= own * fy
        form[3] -= own * fz
        form[4] -= w * fx * fx
        form[5] -= w * fx * fy
        form[6] -= w * fx * fz
        form[7] -= w * fy * fy
        form[8] -= w * fy * fz
        form[9] -= w * fz * fz
        return
    b, c = projector[j, i], projector[j, j]
    det = a * c - b * b
    if not (min(a, c) > LEAST_REDUNDANCY and det > LEAST_REDUNDANCY * a * c):
        return
    gx, gy, gz = rows[0, j], rows[1, j], rows[2, j]
    w = 1.0 / det
    a, b, c = a * w, b * w, c * w
    one, two = residual[i], residual[j]
    own_i, own_j = c * one - b * two, a * two - b * one
    form[0] -= own_i * one + own_j * two
    form[1] -= own_i * fx + own_j * gx
    form[2] -= own_i * fy + own_j * gy
    form[3] -= own_i * fz + own_j * gz
    ix, iy, iz = c * fx - b * gx, c * fy - b * gy, c * fz - b * gz
    jx, jy, jz = a * gx - b * fx, a * gy - b * fy, a * gz - b * fz
    form[4] -= ix * fx + jx * gx
    form[5] -= ix * fy + jx * gy
    form[6] -= ix * fz + jx * gz
    form[7] -= iy * fy + jy * gy
    form[8] -= iy * fz + jy * gz
    form[9] -= iz * fz + jz * gz


@inner
def _without_side(side: Masks, used: Indices, residuals: Any, every: Floats, form: Floats) -> bool:
    """Write the quadratic form without the channels of a side; return True if the side has at least two channels."""
    projector, residual, rows, _, _ = residuals
    n, count = len(used), 0
    member, work = np.empty(n, dtype=np.intp), np.empty((n, n + 4))
    for k in range(10):
        form[k] = every[k]
    for i in range(n):
        if side[used[i]]:
            member[count] = i
            count += 1
    for a in range(count):
        for b in range(count):
            work[a, b] = projector[max(member[a], member[b]), min(member[a], member[b])]
        work[a, count] = residual[member[a]]
        for b in range(3):
            work[a, count + 1 + b] = rows[b, member[a]]
    for a in range(count):
        if not work[a, a] > LEAST_REDUNDANCY:
            continue
        x, y, z = work[a, count + 1] / work[a, a], work[a, count + 2] / work[a, a], work[a, count + 3] / work[a, a]
        form[0] -= work[a, count] * (work[a, count] / work[a, a])
        form[1] -= work[a, count] * x
        form[2] -= work[a, count] * y
        form[3] -= work[a, count] * z
        form[4] -= work[a, count + 1] * x
        form[5] -= work[a, count + 1] * y
        form[6] -= work[a, count + 1] * z
        form[7] -= work[a, count + 2] * y
        form[8] -= work[a, count + 2] * z
        form[9] -= work[a, count + 3] * z
        for later in range(a + 1, count):
            ratio = work[later, a] / work[a, a]
            for column in range(a, count + 4):
                work[later, column] -= ratio * work[a, column]
    return count > 1


@inner
def _whiten(
    model: Any, t: int, noise: float, sigma_m: tuple[float, float], used: Indices, residuals: Any, every: Floats
) -> int:
    """Write the used channels, their residuals, and their quadratic form; return the number of these channels.

    The map error is assumed equal in all horizontal directions, because the tangent turns along the line.
    """
    root_weight, clock, clock_covariance_m2, design, covariance_m2, map_prior, misfit = model
    projector, residual, rows, whitened, group = residuals
    roots, along, across, up = whitened[0], whitened[1], whitened[2], whitened[3]
    n, asked, of_map, with_map = 0, np.zeros(clock_covariance_m2.shape[1]), np.zeros(3), np.empty((3, 3))
    x = y = z = 0.0
    for m in range(root_weight.shape[1]):
        if root_weight[t, m] > 0.0:
            used[n], group[n], roots[n] = m, clock[m], root_weight[t, m]
            along[n], across[n], up[n] = design[t, m, 0], design[t, m, 1], design[t, m, 2]
            asked[clock[m]] += roots[n] * misfit[t, m]
            x, y, z = x + misfit[t, m] * along[n], y + misfit[t, m] * across[n], z + misfit[t, m] * up[n]
            n += 1
    # Information of the map, isotropic in the horizontal plane, and position implied by the residuals.
    normal = _inverse(covariance_m2[t])
    of_map[0] = of_map[1] = (noise / sigma_m[0]) ** 2
    of_map[2] = (noise / sigma_m[1]) ** 2
    for a in range(3):
        for b in range(3):
            normal[a, b] -= map_prior[a, b]
            with_map[a, b] = normal[a, b] + (of_map[a] if a == b else 0.0)
    covariance = _inverse(with_map)
    for a in range(4):
        every[a] = 0.0
    for i in range(n):
        m, of_clock, clocks = used[i], 0.0, clock_covariance_m2[t, group[i]]
        for g in range(len(asked)):
            of_clock += clocks[g] * asked[g]
        for a in range(3):
            rows[a, i] = along[i] * covariance[0, a] + across[i] * covariance[1, a] + up[i] * covariance[2, a]
        s0, s1, s2 = rows[0, i], rows[1, i], rows[2, i]
        residual[i] = (misfit[t, m] - roots[i] * of_clock - (x * s0 + y * s1 + z * s2)) / noise
        every[0] += residual[i] * misfit[t, m] / noise
        for a in range(3):
            rows[a, i] *= of_map[a] / noise
            every[1 + a] += rows[a, i] * misfit[t, m] / noise
        for j in range(n):
            of_place = s0 * along[j] + s1 * across[j] + s2 * up[j]
            projector[i, j] = -roots[i] * roots[j] * clocks[group[j]] - of_place
        projector[i, i] += 1.0
    at = 4
    for a in range(3):
        for b in range(a, 3):
            value = 0.0
            for k in range(3):
                value += normal[a, k] * covariance[k, b]
            every[at] = value * of_map[b] / noise**2
            at += 1
    return n


@kernel
def risk_off_tangent(
    model: Any,
    scale: Floats,
    likely: Floats,
    sides: Masks,
    side_prior: float,
    clear_m: Floats,
    sigma_m: tuple[float, float],
    enough: float,
) -> Floats:
    """Return an upper bound of the probability that the true position is farther than `clear_m` away.

    At a horizontal distance D, a quadratic form exceeds its value at the position by at least ``(D - |c|)^2 / trace(C)
    - c . s``. Here c and C are the horizontal parts of the quadratic form's minimum point and inverse matrix, and s is
      the slope.
    Without the channels J, whose rows of the design are F_J, the matrix is at least ``1 - tau`` times the matrix of all
    channels, with ``tau = trace(F_J C F_J^T S_JJ^-1)``. In most epochs, the bound with the largest tau of all single
    channels and pairs is sufficient. In other epochs, each subset is bounded separately.

    Parameters
    ----------
    model : ModelArrays
        T epochs by M channels.
    scale : ndarray, shape (T,)
    likely : ndarray, shape (M,)
        Prior fault probability of each channel.
    sides : ndarray of bool, shape (T, S, M)
        Groups of channels that are assumed to be faulty together.
    side_prior : float
        Prior fault probability of a whole side.
    clear_m : ndarray, shape (T,) [m]
        Distance from the position within which the line does not deviate from the tangent.
    sigma_m : tuple of float [m]
        Map sigmas in plan and height.
    enough : float
        A loose bound is sufficient if it is at most this probability.

    Returns
    -------
    ndarray, shape (T,)
        Sum over the hypotheses of no fault, of one or two faulty satellites, and of a faulty side.
    """
    epochs, channels = model.root_weight.shape
    used, total, leverage = np.empty(channels, dtype=np.intp), np.empty(epochs), np.empty(channels)
    own, taus, effect = np.empty(channels), np.empty(channels), np.empty((channels, channels))
    matrix, every, form = np.empty((3, 3)), np.empty(10), np.empty(10)
    residuals = _work_space(channels)
    projector, rows = residuals.projector, residuals.rows
    for t in range(epochs):
        n = _whiten(model, t, scale[t], sigma_m, used, residuals, every)
        at = 4
        for a in range(3):
            for b in range(a, 3):
                matrix[a, b] = matrix[b, a] = every[at]
                at += 1
        # Largest tau of single channels and of pairs.
        of_all = _inverse(matrix)
        spread, start, one, two = of_all[0, 0] + of_all[1, 1], 0.0, 0.0, 0.0
        for a in range(3):
            for b in range(3):
                start += every[1 + a] * of_all[a, b] * every[1 + b]
        start = math.sqrt(max(start, 0.0))
        singles, squares = 0.0, 0.0
        for i in range(n):
            x = rows[0, i] * of_all[0, 0] + rows[1, i] * of_all[1, 0] + rows[2, i] * of_all[2, 0]
            y = rows[0, i] * of_all[0, 1] + rows[1, i] * of_all[1, 1] + rows[2, i] * of_all[2, 1]
            z = rows[0, i] * of_all[0, 2] + rows[1, i] * of_all[1, 2] + rows[2, i] * of_all[2, 2]
            for j in range(i + 1):
                effect[i, j] = x * rows[0, j] + y * rows[1, j] + z * rows[2, j]
            leverage[i], own[i] = effect[i, i], projector[i, i]
            singles += likely[used[i]]
            squares += likely[used[i]] * likely[used[i]]
            if own[i] > LEAST_REDUNDANCY:
                one = max(one, leverage[i] / own[i])
        for i in range(n):
            a = own[i]
            for j in range(i):
                b, c = projector[i, j], own[j]
                det = a * c - b * b
                tau = (c * leverage[i] + a * leverage[j] - 2.0 * b * effect[i, j]) / det
                taus[j] = tau if det > LEAST_REDUNDANCY * a * c and min(a, c) > LEAST_REDUNDANCY else 0.0
            for j in range(i):
                two = max(two, taus[j])
        root, of_sides = math.sqrt(max(every[0], 0.0)), 0.0
        for c in range(sides.shape[1]):
            if side_prior > 0.0 and _without_side(sides[t, c], used[:n], residuals, every, form):
                of_sides += side_prior * _compute_tail(form, clear_m[t])
        total[t] = of_sides + 2.0 * _tail(clear_m[t], spread, start, root, 0.0)
        total[t] += singles * _tail(clear_m[t], spread, start, root, one)
        total[t] += 0.5 * (singles * singles - squares) * _tail(clear_m[t], spread, start, root, two)
        if total[t] <= enough:
            continue
        spent = of_sides + 2.0 * _compute_tail(every, clear_m[t])
        for i in range(n):
            for j in range(-1, i):
                p = likely[used[i]] * (likely[used[j]] if j >= 0 else 1.0)
                if p > 0.0:
                    _without(i, j, residuals, every, form)
                    spent += p * _compute_tail(form, clear_m[t])
        total[t] = spent
    return total


@kernel
def forms_of_hypotheses(
    model: Any, scale: Floats, likely: Floats, sides: Masks, side_prior: float, sigma_m: tuple[float, float]
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return the quadratic forms of K hypotheses: no fault, or a fault of one channel, of one pair or of one side.

    Parameters are those of `risk_off_tangent`.

    Returns
    -------
    prior : ndarray, shape (T, K)
        Probability of each hypothesis; 0 for unused entries.
    form : ndarray, shape (T, K, 10)
        Quadratic forms, as in `_lowest`.
    lowest_m, depth, widest_m2 : ndarray, shape (T, K)
        Distance to the minimum (NaN for a singular matrix), decrease to it, and trace of the inverse matrix.
    """
    epochs, channels = model.root_weight.shape
    most = 0
    for t in range(epochs):
        count = 0
        for m in range(channels):
            count += model.root_weight[t, m] > 0.0
        most = max(most, count)
    width = 1 + most * (most + 1) // 2 + sides.shape[1]
    prior, form = np.zeros((epochs, width)), np.zeros((epochs, width, 10))
    lowest, depth, widest = np.empty((epochs, width)), np.empty((epochs, width)), np.empty((epochs, width))
    used, every = np.empty(channels, dtype=np.intp), np.empty(10)
    residuals = _work_space(channels)
    for t in range(epochs):
        n = _whiten(model, t, scale[t], sigma_m, used, residuals, every)
        prior[t, 0], at = 2.0, 1  # 2, because noise has either sign
        _without(-1, -1, residuals, every, form[t, 0])
        for i in range(n):
            for j in range(-1, i):
                prior[t, at] = likely[used[i]] * (likely[used[j]] if j >= 0 else 1.0)
                _without(i, j, residuals, every, form[t, at])
                at += 1
        for c in range(sides.shape[1]):
            if _without_side(sides[t, c], used[:n], residuals, every, form[t, at]):
                prior[t, at] = side_prior
            at += 1
        for k in range(width):
            one = form[t, k]
            x, y, z, c_xx, c_yy, c_zz, inverse = _lowest(one)
            singular = np.nan if inverse == 0.0 else 0.0
            lowest[t, k], widest[t, k] = math.sqrt(x * x + y * y + z * z) + singular, (c_xx + c_yy + c_zz) * inverse
            depth[t, k] = max(x * one[1] + y * one[2] + z * one[3], 0.0)
    return prior, form, lowest, depth, widest


@kernel
def risk_beyond(
    prior: Floats,
    form: Floats,
    radius_m: Floats,
    first: Indices,
    start_m: Floats,
    tangent: Floats,
    length_m: Floats,
    beyond_m: Floats,
) -> Floats:
    """Return the probability that the true position is off the tangent and beyond a protection level, shape (T,).

    Parameters
    ----------
    prior, form : ndarray
        Results of `forms_of_hypotheses`: ``q(d) = constant - 2 d . slope + d^T matrix d`` at the displacement d.
    radius_m : ndarray, shape (T, K)
        A hypothesis is included if a section beyond the level is nearer to the position than this.
    first : ndarray of int, shape (T + 1,)
        Index of the first section of each epoch; the last entry is the number of sections P.
    start_m, tangent : ndarray, shape (P, 3)
    length_m : ndarray, shape (P,)
    beyond_m : ndarray, shape (P,)
        Distance of each section that is beyond the level; infinite for sections within the level.
    """
    epochs, hypotheses = prior.shape
    spent = np.zeros(epochs)
    for t in range(epochs):
        nearest = np.inf
        for p in range(first[t], first[t + 1]):
            nearest = min(nearest, beyond_m[p])
        for k in range(hypotheses):
            if not (prior[t, k] > 0.0 and radius_m[t, k] > nearest):
                continue
            sx, sy, sz = form[t, k, 1], form[t, k, 2], form[t, k, 3]
            xx, xy, xz = form[t, k, 4], form[t, k, 5], form[t, k, 6]
            yy, yz, zz = form[t, k, 7], form[t, k, 8], form[t, k, 9]
            least, beyond = np.inf, np.inf
            for p in range(first[t], first[t + 1]):
                x, y, z = start_m[p, 0], start_m[p, 1], start_m[p, 2]
                a, b, c = tangent[p, 0], tangent[p, 1], tangent[p, 2]
                gx = xx * x + xy * y + xz * z - sx
                gy = xy * x + yy * y + yz * z - sy
                gz = xz * x + yz * y + zz * z - sz
                value = form[t, k, 0] + x * (gx - sx) + y * (gy - sy) + z * (gz - sz)
                rise = 2.0 * (a * gx + b * gy + c * gz)
                curvature = a * (xx * a + xy * b + xz * c) + b * (xy * a + yy * b)
                curvature += b * yz * c + c * (xz * a + yz * b + zz * c)
                step = min(max(-0.5 * rise / curvature, 0.0), length_m[p]) if curvature > 0.0 else 0.0
                value += step * (rise + step * curvature)
                least = min(least, value)
                if beyond_m[p] < np.inf:
                    beyond = min(beyond, value)
            excess = beyond - least
            spent[t] += prior[t, k] * (0.5 * math.erfc(math.sqrt(0.5 * excess)) if excess > 0.0 else 1.0)
    return spent
