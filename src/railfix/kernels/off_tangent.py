"""Distance to parts of a line off a tangent, risk there."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.constants import ALONG, CLEAR_M, FAN_OUT, LEAST_REDUNDANCY, ON_TANGENT_M
from railfix.kernels.compiling import inner, kernel
from railfix.kernels.search import points_within


@kernel
def clear_of_sections(
    ecef_m: Floats,
    tangent: Floats,
    across: Floats,
    length_m: Floats,
    stretches: tuple[Indices, Floats, Indices],
    section: Indices,
) -> Floats:
    """Return a distance within which no part of a line lies off the tangents of its sections, shape (S,) [m].

    Parameters
    ----------
    ecef_m, tangent, across, length_m : ndarray
        Of the line: points (P, 3), the others of its sections.
    stretches
        `SearchIndex.stretches`.
    section : ndarray of int, shape (S,)
    """
    clear, sections, longest = np.full(len(section), CLEAR_M), len(length_m), length_m.max()
    nodes, below = np.empty(len(ecef_m) + FAN_OUT, dtype=np.intp), np.empty(len(ecef_m) + FAN_OUT, dtype=np.intp)
    middle = np.empty(3)
    for s in range(len(section)):
        here, length = section[s], length_m[section[s]]
        for a in range(3):
            middle[a] = ecef_m[here, a] + 0.5 * length * tangent[here, a]
        reach = CLEAR_M + 0.5 * length + longest
        centre = middle[0], middle[1], middle[2]
        nodes, below, held = points_within(ecef_m, stretches, centre, reach, nodes, below)
        for at in range(held):
            v = nodes[at]
            if v >= sections or v == here:
                continue
            off, nearest, low, high = False, np.inf, np.inf, -np.inf
            for end in (v, v + 1):
                ahead, aside, square = 0.0, 0.0, 0.0
                for a in range(3):
                    away = ecef_m[end, a] - ecef_m[here, a]
                    ahead += away * tangent[here, a]
                    aside += away * across[here, a]
                for a in range(3):
                    square += (ecef_m[end, a] - ecef_m[here, a] - ahead * tangent[here, a]) ** 2
                beside, least = math.sqrt(square), max(max(ahead - length, -ahead), 0.0)
                nearest = min(nearest, math.sqrt(least * least + aside * aside))
                off |= least < ALONG * math.sqrt(least * least + square) and beside > ON_TANGENT_M
                low, high = min(low, ahead), max(high, ahead)
            if off or min(high, length) - max(low, 0.0) > ON_TANGENT_M:
                clear[s] = min(clear[s], nearest - length_m[v])
        clear[s] = max(clear[s], 0.0)
    return clear


@inner
def _inverse(matrix: Floats) -> Floats:
    """Return the inverse of a symmetric 3 x 3 matrix; not finite where it is singular."""
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
    """Return the tail of the form that is ``1 - tau`` times that of all at least."""
    if not tau < 1.0:
        return 1.0
    form = (start + math.sqrt(max(tau, 0.0)) * misfit) ** 2 / (1.0 - tau)
    gap = max(clear_m - math.sqrt(spread / (1.0 - tau) * form), 0.0)
    excess = gap * gap * (1.0 - tau) / spread - form
    return 0.5 * math.erfc(math.sqrt(0.5 * excess)) if excess > 0.0 else 1.0


@inner
def _tail_of(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, slope: Floats, clear_m: float) -> float:
    """Return the tail of a form by its own matrix and slope."""
    sx, sy, sz = slope[0], slope[1], slope[2]
    c_xx, c_yy, c_zz = yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy
    c_xy, c_xz, c_yz = xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - xx * yz
    det = xx * c_xx + xy * c_xy + xz * c_xz
    mean = (xx + yy + zz) / 3.0
    if not det > 1e-12 * mean * mean * mean:
        return 1.0
    inverse = 1.0 / det
    x = (c_xx * sx + c_xy * sy + c_xz * sz) * inverse
    y = (c_xy * sx + c_yy * sy + c_yz * sz) * inverse
    z = (c_xz * sx + c_yz * sy + c_zz * sz) * inverse
    gap = max(clear_m - math.sqrt(x * x + y * y), 0.0)
    excess = gap * gap / ((c_xx + c_yy) * inverse) - max(x * sx + y * sy + z * sz, 0.0)
    if excess > 1400.0:
        return 0.0
    return 0.5 * math.erfc(math.sqrt(0.5 * excess)) if excess > 0.0 else 1.0


class _Residuals(NamedTuple):
    """Residuals of the channels in use, their projector, and their change with the place."""

    projector: Floats
    residual: Floats
    rows: Floats


@inner
def _of_sides(
    used: Indices,
    sides: Masks,
    side_prior: float,
    residuals: _Residuals,
    slope: Floats,
    matrix: Floats,
    clear_m: float,
) -> float:
    """Return the sum of the tails with the channels of each side left out, one after the other."""
    projector, residual, rows = residuals
    total, n = 0.0, len(used)
    member, work = np.empty(n, dtype=np.intp), np.empty((n, n + 4))
    left, s, m = np.empty(3), np.empty(3), np.empty((3, 3))
    for c in range(len(sides)):
        count = 0
        for i in range(n):
            if sides[c, used[i]]:
                member[count] = i
                count += 1
        if count < 2 or side_prior == 0.0:
            continue
        for a in range(3):
            s[a] = slope[a]
            for b in range(3):
                m[a, b] = matrix[a, b]
        for a in range(count):
            for b in range(count):
                work[a, b] = projector[max(member[a], member[b]), min(member[a], member[b])]
            work[a, count] = residual[member[a]]
            for b in range(3):
                work[a, count + 1 + b] = rows[member[a], b]
        for a in range(count):
            if not work[a, a] > LEAST_REDUNDANCY:
                continue
            for b in range(3):
                left[b] = work[a, count + 1 + b] / work[a, a]
            for b in range(3):
                s[b] -= work[a, count] * left[b]
                for d in range(3):
                    m[b, d] -= work[a, count + 1 + b] * left[d]
            for later in range(a + 1, count):
                ratio = work[later, a] / work[a, a]
                for column in range(a, count + 4):
                    work[later, column] -= ratio * work[a, column]
        total += side_prior * _tail_of(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2], s, clear_m)
    return total


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
    """Return an upper bound of the probability that the true place lies off the tangent beyond a distance.

    At a distance D along and across a form exceeds its value at the position by ``(D - |c|)^2 / trace(C) - c . s`` at
    least: c its lowest place and C the inverse of its matrix, both along and across, and s its slope. Without the
    channels J the matrix is at least ``1 - tau`` times that of all, ``tau = trace(F_J C F_J^T S_JJ^-1)`` with their
    rows F_J of the design: the largest tau of one channel and of two decides most epochs. In the others each subset has
    its own bound.

    Parameters
    ----------
    model : ModelArrays
        T epochs by M channels.
    scale : ndarray, shape (T,)
    likely : ndarray, shape (M,)
        Probability of a fault of each channel.
    sides : ndarray of bool, shape (T, S, M)
        Channels that are faulty together.
    side_prior : float
        Probability of that.
    clear_m : ndarray, shape (T,) [m]
        Distance within which no place is off the tangent.
    sigma_m : tuple of float [m]
        Of the map in plan and height.
    enough : float
        Probability up to which a loose bound will do.

    Returns
    -------
    ndarray, shape (T,)
        Summed over no fault, one faulty satellite, two and those of a side.
    """
    root_weight, clock, clock_covariance_m2, design, covariance_m2, map_prior, misfit = model
    epochs, channels = root_weight.shape
    clocks, total = clock_covariance_m2.shape[1], np.empty(epochs)
    used, prior, leverage = np.empty(channels, dtype=np.intp), np.empty(channels), np.empty(channels)
    projector, effect, residual = np.empty((channels, channels)), np.empty((channels, channels)), np.empty(channels)
    rows, spread_of, asked = np.empty((channels, 3)), np.empty((channels, 3)), np.empty(clocks)
    pull, step, slope, of_map, form = np.empty(3), np.empty(3), np.empty(3), np.zeros(3), np.empty(3)
    with_map = np.empty((3, 3))
    for t in range(epochs):
        n, noise = 0, scale[t]
        for m in range(channels):
            if root_weight[t, m] > 0.0:
                used[n], prior[n] = m, likely[m]
                n += 1
        # The map error alike in all horizontal directions, and the place that the residuals ask for then.
        normal = _inverse(covariance_m2[t])
        of_map[0] = of_map[1] = (noise / sigma_m[0]) ** 2
        of_map[2] = (noise / sigma_m[1]) ** 2
        for a in range(3):
            for b in range(3):
                normal[a, b] -= map_prior[a, b]
                with_map[a, b] = normal[a, b] + (of_map[a] if a == b else 0.0)
        covariance = _inverse(with_map)
        for g in range(clocks):
            asked[g] = 0.0
        for a in range(3):
            pull[a] = slope[a] = 0.0
        for i in range(n):
            m = used[i]
            asked[clock[m]] += root_weight[t, m] * misfit[t, m]
            for a in range(3):
                pull[a] += misfit[t, m] * design[t, m, a]
        for a in range(3):
            step[a] = pull[0] * covariance[0, a] + pull[1] * covariance[1, a] + pull[2] * covariance[2, a]
        constant = 0.0
        for i in range(n):
            m = used[i]
            of_clock = 0.0
            for g in range(clocks):
                of_clock += clock_covariance_m2[t, clock[m], g] * asked[g]
            residual[i] = misfit[t, m] - root_weight[t, m] * of_clock
            for a in range(3):
                residual[i] -= design[t, m, a] * step[a]
                value = 0.0
                for b in range(3):
                    value += design[t, m, b] * covariance[b, a]
                spread_of[i, a] = value
                rows[i, a] = value * of_map[a] / noise
                slope[a] += rows[i, a] * misfit[t, m] / noise
            residual[i] /= noise
            constant += residual[i] * misfit[t, m] / noise
            for j in range(i + 1):
                k = used[j]
                value = -root_weight[t, m] * root_weight[t, k] * clock_covariance_m2[t, clock[m], clock[k]]
                for a in range(3):
                    value -= spread_of[i, a] * design[t, k, a]
                projector[i, j], projector[j, i] = value, value
            projector[i, i] += 1.0
        matrix = np.empty((3, 3))
        for a in range(3):
            for b in range(3):
                value = 0.0
                for k in range(3):
                    value += normal[a, k] * covariance[k, b]
                matrix[a, b] = value * of_map[b] / noise**2

        # The largest tau of one channel and of two.
        of_all = _inverse(matrix)
        spread, start, one, two = of_all[0, 0] + of_all[1, 1], 0.0, 0.0, 0.0
        for a in range(3):
            for b in range(3):
                start += slope[a] * of_all[a, b] * slope[b]
        start = math.sqrt(max(start, 0.0))
        singles, squares = 0.0, 0.0
        for i in range(n):
            x = rows[i, 0] * of_all[0, 0] + rows[i, 1] * of_all[1, 0] + rows[i, 2] * of_all[2, 0]
            y = rows[i, 0] * of_all[0, 1] + rows[i, 1] * of_all[1, 1] + rows[i, 2] * of_all[2, 1]
            z = rows[i, 0] * of_all[0, 2] + rows[i, 1] * of_all[1, 2] + rows[i, 2] * of_all[2, 2]
            for j in range(i + 1):
                effect[i, j] = x * rows[j, 0] + y * rows[j, 1] + z * rows[j, 2]
            leverage[i] = effect[i, i]
            singles += prior[i]
            squares += prior[i] * prior[i]
            if projector[i, i] > LEAST_REDUNDANCY:
                one = max(one, leverage[i] / projector[i, i])
        for i in range(n):
            a = projector[i, i]
            for j in range(i):
                b, c = projector[i, j], projector[j, j]
                det = a * c - b * b
                tau = (c * leverage[i] + a * leverage[j] - 2.0 * b * effect[i, j]) / det
                regular = det > LEAST_REDUNDANCY * a * c and min(a, c) > LEAST_REDUNDANCY
                two = max(two, tau if regular else 0.0)
        root, residuals = math.sqrt(max(constant, 0.0)), _Residuals(projector, residual, rows)
        of_sides = _of_sides(used[:n], sides[t], side_prior, residuals, slope, matrix, clear_m[t])
        total[t] = of_sides + 2.0 * _tail(clear_m[t], spread, start, root, 0.0)
        total[t] += singles * _tail(clear_m[t], spread, start, root, one)
        total[t] += 0.5 * (singles * singles - squares) * _tail(clear_m[t], spread, start, root, two)
        if total[t] <= enough:
            continue
        s, r, u = slope[0], slope[1], slope[2]
        m_xx, m_xy, m_xz = matrix[0, 0], matrix[0, 1], matrix[0, 2]
        m_yy, m_yz, m_zz = matrix[1, 1], matrix[1, 2], matrix[2, 2]
        spent = of_sides
        # One hypothesis after the other: none, each channel (j = -1), each pair.
        for i in range(-1, n):
            for j in range(-1, i if i >= 0 else 0):
                if i < 0:
                    p = 2.0
                elif j < 0:
                    p = prior[i]
                else:
                    p = prior[i] * prior[j]
                if p == 0.0:
                    continue
                sx, sy, sz = s, r, u
                xx, xy, xz, yy, yz, zz = m_xx, m_xy, m_xz, m_yy, m_yz, m_zz
                if i >= 0:
                    a = projector[i, i]
                    fx, fy, fz = rows[i, 0], rows[i, 1], rows[i, 2]
                    if j < 0:
                        w = 1.0 / a if a > LEAST_REDUNDANCY else 0.0
                        own = w * residual[i]
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
                        b, c = projector[j, i], projector[j, j]
                        gx, gy, gz = rows[j, 0], rows[j, 1], rows[j, 2]
                        det = a * c - b * b
                        if min(a, c) > LEAST_REDUNDANCY and det > LEAST_REDUNDANCY * a * c:
                            w = 1.0 / det
                            a, b, c = a * w, b * w, c * w
                            one, two = residual[i], residual[j]
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
                form[0], form[1], form[2] = sx, sy, sz
                spent += p * _tail_of(xx, xy, xz, yy, yz, zz, form, clear_m[t])
        total[t] = spent
    return total


@kernel
def risk_beyond(
    forms: Any,
    radius_m: Floats,
    first: Indices,
    start_m: Floats,
    tangent: Floats,
    length_m: Floats,
    beyond_m: Floats,
) -> Floats:
    """Return the probability that the true place lies beyond a level off the tangent, over K hypotheses, shape (T,).

    Parameters
    ----------
    forms : Forms
        Sums of squared residuals over the place d, ``q(d) = constant - 2 d . slope + d^T matrix d``, with their priors.
    radius_m : ndarray, shape (T, K)
        A hypothesis counts where a place beyond the level is nearer.
    first : ndarray of int, shape (T + 1,)
        First section of each epoch.
    start_m, tangent : ndarray, shape (P, 3)
    length_m : ndarray, shape (P,)
    beyond_m : ndarray, shape (P,)
        Distance of the sections beyond the level; others infinite.
    """
    prior, constant, slope, matrix = forms
    epochs, hypotheses = prior.shape
    spent = np.zeros(epochs)
    for t in range(epochs):
        nearest = np.inf
        for p in range(first[t], first[t + 1]):
            nearest = min(nearest, beyond_m[p])
        for k in range(hypotheses):
            if not (prior[t, k] > 0.0 and radius_m[t, k] > nearest):
                continue
            sx, sy, sz, m = slope[t, k, 0], slope[t, k, 1], slope[t, k, 2], matrix[t, k]
            least, beyond = np.inf, np.inf
            for p in range(first[t], first[t + 1]):
                x, y, z = start_m[p, 0], start_m[p, 1], start_m[p, 2]
                a, b, c = tangent[p, 0], tangent[p, 1], tangent[p, 2]
                gx = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z - sx
                gy = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z - sy
                gz = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z - sz
                value = constant[t, k] + x * (gx - sx) + y * (gy - sy) + z * (gz - sz)
                rise = 2.0 * (a * gx + b * gy + c * gz)
                curvature = a * (m[0, 0] * a + m[0, 1] * b + m[0, 2] * c) + b * (m[1, 0] * a + m[1, 1] * b)
                curvature += b * m[1, 2] * c + c * (m[2, 0] * a + m[2, 1] * b + m[2, 2] * c)
                step = min(max(-0.5 * rise / curvature, 0.0), length_m[p]) if curvature > 0.0 else 0.0
                value += step * (rise + step * curvature)
                least = min(least, value)
                if beyond_m[p] < np.inf:
                    beyond = min(beyond, value)
            excess = beyond - least
            spent[t] += prior[t, k] * (0.5 * math.erfc(math.sqrt(0.5 * excess)) if excess > 0.0 else 1.0)
    return spent
