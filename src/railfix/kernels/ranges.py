"""Pseudorange residuals at a position with the clocks eliminated, and positions from pseudoranges."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.kernels.compiling import inner, kernel
from railfix.kernels.sight import sight


class _Epoch(NamedTuple):
    """One epoch of `RangeArrays`; `offset_m` has length 0 if no clock offsets are known."""

    sat_ecef_m: Floats
    code_m: Floats
    weight: Floats
    starts: Indices
    offset_m: Floats
    sigma_m: Floats


class _Equations(NamedTuple):
    """Results of `reduced_equations` for one epoch, and total weights of the clock groups."""

    system: Floats
    means: Floats
    rows: Floats
    totals: Floats
    apart: Floats  # (5, G), work space


@inner
def reduce_epoch(epoch: _Epoch, place_ecef_m: Floats, equations: _Equations) -> None:
    """Compute the normal equations of one epoch.

    The vectorised loops have no branches; unused channels must therefore have finite values, too.
    """
    sat_ecef_m, code_m, weight, starts, offset_m, _ = epoch
    system, means, rows, totals, _ = equations
    channels, groups = len(weight), len(starts)
    x, y, z = place_ecef_m[0], place_ecef_m[1], place_ecef_m[2]
    of_x, of_y, of_z, residual = rows[0], rows[1], rows[2], rows[3]
    for m in range(channels):
        distance, of_x[m], of_y[m], of_z[m] = sight(sat_ecef_m[m, 0], sat_ecef_m[m, 1], sat_ecef_m[m, 2], x, y, z)
        residual[m] = distance - code_m[m]
    for g in range(groups):
        stop = starts[g + 1] if g + 1 < groups else channels
        total = mean_x = mean_y = mean_z = mean_r = 0.0
        for m in range(starts[g], stop):
            w = weight[m]
            total += w
            mean_x += w * of_x[m]
            mean_y += w * of_y[m]
            mean_z += w * of_z[m]
            mean_r += w * residual[m]
        totals[g] = total
        if total > 0.0:
            mean_x, mean_y, mean_z, mean_r = mean_x / total, mean_y / total, mean_z / total, mean_r / total
        means[0, g], means[1, g], means[2, g], means[3, g] = -mean_x, -mean_y, -mean_z, -mean_r
        for m in range(starts[g], stop):
            used = 1.0 if weight[m] > 0.0 else 0.0
            of_x[m], of_y[m] = used * (mean_x - of_x[m]), used * (mean_y - of_y[m])
            of_z[m], residual[m] = used * (mean_z - of_z[m]), used * (mean_r - residual[m])
    xx = xy = xz = xr = yy = yz = yr = zz = zr = rr = 0.0
    for m in range(channels):
        a, b, c, d = weight[m] * of_x[m], weight[m] * of_y[m], weight[m] * of_z[m], residual[m]
        xx, xy, xz, xr = xx + a * of_x[m], xy + a * of_y[m], xz + a * of_z[m], xr + a * d
        yy, yz, yr = yy + b * of_y[m], yz + b * of_z[m], yr + b * d
        zz, zr, rr = zz + c * of_z[m], zr + c * d, rr + weight[m] * d * d
    system[0, 0], system[0, 1], system[0, 2], system[0, 3] = xx, xy, xz, xr
    system[1, 1], system[1, 2], system[1, 3] = yy, yz, yr
    system[2, 2], system[2, 3], system[3, 3] = zz, zr, rr
    if len(offset_m):
        _tie(epoch, equations)
    for i in range(4):
        for j in range(i):
            system[i, j] = system[j, i]


@inner
def _tie(epoch: _Epoch, equations: _Equations) -> None:
    """Add the information of the known clock offsets to the equations of one epoch."""
    weight, starts, offset_m, sigma_m = epoch.weight, epoch.starts, epoch.offset_m, epoch.sigma_m
    system, means, rows, totals, apart = equations
    channels, groups, all_mass = len(weight), len(starts), 0.0
    mass = apart[4]
    for g in range(groups):
        mass[g] = 1.0 / (1.0 / totals[g] + sigma_m[g] ** 2) if totals[g] > 0.0 else 0.0
        all_mass += mass[g]
    for i in range(4):
        common = 0.0
        for g in range(groups):
            apart[i, g] = means[i, g] - (offset_m[g] if i == 3 else 0.0)
            common += mass[g] * apart[i, g]
        for g in range(groups):
            apart[i, g] -= common / all_mass if all_mass > 0.0 else 0.0
    for g in range(groups):
        if not totals[g] > 0.0:
            continue
        stop = starts[g + 1] if g + 1 < groups else channels
        own = 1.0 / (totals[g] * sigma_m[g] ** 2 + 1.0)
        for i in range(4):
            for j in range(i, 4):
                system[i, j] += mass[g] * apart[i, g] * apart[j, g]
            shift = apart[i, g] * own
            means[i, g] -= shift
            for m in range(starts[g], stop):
                if weight[m] > 0.0:
                    rows[i, m] += shift


@kernel
def reduced_equations(ranges: Any, place_ecef_m: Floats) -> tuple[Floats, Floats, Floats, Masks]:
    """Compute the normal equations of position and residual after elimination of the clocks.

    Parameters
    ----------
    ranges : RangeArrays
        T epochs.
    place_ecef_m : ndarray, shape (T, 3) [m]
        Linearisation points, in C order.

    Returns
    -------
    system : ndarray, shape (T, 4, 4)
        Normal matrix of the three axes and the residual.
    means : ndarray, shape (T, 4, G)
        Weighted means of design and residual in each clock group.
    rows : ndarray, shape (T, 4, M)
        Design and residual minus the means of the clock group; 0 where the weight is 0.
    seen : ndarray of bool, shape (T, G)
        True for clock groups with a weight above 0.
    """
    sat_ecef_m, code_m, weight, starts, offset_m, sigma_m = ranges
    epochs, channels = weight.shape
    groups, no = len(starts), np.empty(0)
    tied = len(offset_m) == epochs
    system, means = np.empty((epochs, 4, 4)), np.empty((epochs, 4, groups))
    rows, totals, apart = np.empty((epochs, 4, channels)), np.empty(groups), np.empty((5, groups))
    seen = np.empty((epochs, groups), dtype=np.bool_)
    for t in range(epochs):
        offset, spread = (offset_m[t], sigma_m[t]) if tied else (no, no)
        epoch = _Epoch(sat_ecef_m[t], code_m[t], weight[t], starts, offset, spread)
        reduce_epoch(epoch, place_ecef_m[t], _Equations(system[t], means[t], rows[t], totals, apart))
        for g in range(groups):
            seen[t, g] = totals[g] > 0.0
    return system, means, rows, seen


@kernel
def misfits(ranges: Any, place_ecef_m: Floats, epochs: Indices) -> Floats:
    """Compute `normal_equations.misfit` at one position per epoch in `epochs`, for arrays in C order."""
    sat_ecef_m, code_m, weight, starts, offset_m, sigma_m = ranges
    channels, groups = weight.shape[1], len(starts)
    tied = len(offset_m) == len(code_m)
    result, residual = np.zeros(len(epochs)), np.empty(channels)
    totals, means = np.empty(groups), np.empty(groups)
    for p in range(len(epochs)):
        t = epochs[p]
        x, y, z = place_ecef_m[p, 0], place_ecef_m[p, 1], place_ecef_m[p, 2]
        mass, common = 0.0, 0.0
        for g in range(groups):
            stop = starts[g + 1] if g + 1 < groups else channels
            total, mean = 0.0, 0.0
            for m in range(starts[g], stop):
                w = weight[t, m]
                if not w > 0.0:
                    continue
                distance = sight(sat_ecef_m[t, m, 0], sat_ecef_m[t, m, 1], sat_ecef_m[t, m, 2], x, y, z)[0]
                residual[m] = code_m[t, m] - distance
                total += w
                mean += w * residual[m]
            if total > 0.0:
                mean /= total
                for m in range(starts[g], stop):
                    if weight[t, m] > 0.0:
                        result[p] += weight[t, m] * (residual[m] - mean) ** 2
                if tied:
                    own = 1.0 / (1.0 / total + sigma_m[t, g] ** 2)
                    mass += own
                    common += own * (mean - offset_m[t, g])
            totals[g], means[g] = total, mean
        if mass > 0.0:
            common /= mass
            for g in range(groups):
                if totals[g] > 0.0:
                    own = 1.0 / (1.0 / totals[g] + sigma_m[t, g] ** 2)
                    result[p] += own * (means[g] - offset_m[t, g] - common) ** 2
    return result


@inner
def _settle(step: Floats, means: Floats, rows: Floats, totals: Floats, clock_m: Floats, residual_m: Floats) -> None:
    """Compute the clocks and residuals of one epoch after a step of the position, to first order.

    For a step of 5 m, neglecting the gradient of the Earth rotation correction causes an error of 0.03 mm.
    """
    for g in range(len(totals)):
        moved = means[3, g] - (step[0] * means[0, g] + step[1] * means[1, g] + step[2] * means[2, g])
        clock_m[g] = moved if totals[g] > 0.0 else math.nan
    for m in range(rows.shape[1]):
        residual_m[m] = rows[3, m] - (step[0] * rows[0, m] + step[1] * rows[1, m] + step[2] * rows[2, m])


@inner
def invert(matrix: Floats, inverse: Floats) -> None:
    """Invert a symmetric 3 x 3 matrix by its cofactors; NaN where the scaled determinant is below 1e-12."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    c00, c11, c22 = d * f - e * e, a * f - c * c, a * d - b * b
    c01, c02, c12 = c * e - b * f, b * e - c * d, b * c - a * e
    determinant = a * c00 + b * c01 + c * c02
    if not determinant > 1e-12 * ((a + d + f) / 3.0) ** 3:
        determinant = math.nan
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = c00 / determinant, c11 / determinant, c22 / determinant
    inverse[0, 1], inverse[0, 2], inverse[1, 2] = c01 / determinant, c02 / determinant, c12 / determinant
    inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]


@kernel
def iterate_points(
    ranges: Any, start_ecef_m: Floats, enough: Masks, tolerance_m: float, most: int
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Compute 3-D least-squares positions by Newton steps.

    Parameters
    ----------
    ranges : RangeArrays
    start_ecef_m : ndarray, shape (T, 3) [m]
    enough : ndarray of bool, shape (T,)
        Epochs with enough satellites for a position; results of other epochs are NaN.
    tolerance_m, most
        Step [m] below which the iteration has converged, and largest number of steps.

    Returns
    -------
    ecef_m, clock_m, matrix, covariance_m2, wsse, residual_m
        Fields of `SinglePoint`.
    """
    sat_ecef_m, code_m, weight, starts, offset_m, sigma_m = ranges
    epochs, channels = weight.shape
    groups, no = len(starts), np.empty(0)
    tied = len(offset_m) == epochs
    place, clock = np.full((epochs, 3), np.nan), np.full((epochs, groups), np.nan)
    matrix, covariance = np.full((epochs, 3, 3), np.nan), np.full((epochs, 3, 3), np.nan)
    wsse, residual = np.full(epochs, np.nan), np.full((epochs, channels), np.nan)
    system, means = np.empty((4, 4)), np.empty((4, groups))
    rows, totals = np.empty((4, channels)), np.empty(groups)
    equations = _Equations(system, means, rows, totals, np.empty((5, groups)))
    current, step, inverse = np.empty(3), np.empty(3), np.empty((3, 3))
    for t in range(epochs):
        if not enough[t]:
            continue
        for i in range(3):
            current[i] = start_ecef_m[t, i]
        offset, spread = (offset_m[t], sigma_m[t]) if tied else (no, no)
        epoch = _Epoch(sat_ecef_m[t], code_m[t], weight[t], starts, offset, spread)
        for _ in range(most):
            reduce_epoch(epoch, current, equations)
            invert(system, inverse)
            gain = 0.0
            for i in range(3):
                step[i] = 0.0
                for j in range(3):
                    step[i] += inverse[i, j] * system[j, 3]
                gain += step[i] * system[i, 3]
            length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            for i in range(3):
                current[i] += step[i]
            if length < tolerance_m:
                wsse[t] = system[3, 3] - gain
                for i in range(3):
                    place[t, i] = current[i]
                    for j in range(3):
                        matrix[t, i, j], covariance[t, i, j] = system[i, j], inverse[i, j]
                _settle(step, means, rows, totals, clock[t], residual[t])
                break
            if not length < 1e8:
                break
    return place, clock, matrix, covariance, wsse, residual


@kernel
def dilutions(ranges: Any, place_ecef_m: Floats) -> Floats:
    """Return the dilutions of precision, shape (T,), at positions, shape (T, 3); NaN where the geometry is singular."""
    sat_ecef_m, code_m, weight, starts, offset_m, sigma_m = ranges
    epochs, channels = weight.shape
    groups, no, tied = len(starts), np.empty(0), len(offset_m) == epochs
    result, unit, inverse, system = np.empty(epochs), np.empty(channels), np.empty((3, 3)), np.empty((4, 4))
    means, apart = np.empty((4, groups)), np.empty((5, groups))
    equations = _Equations(system, means, np.empty((4, channels)), np.empty(groups), apart)
    for t in range(epochs):
        for m in range(channels):
            unit[m] = 1.0 if weight[t, m] > 0.0 else 0.0
        offset, spread = (offset_m[t], sigma_m[t]) if tied else (no, no)
        epoch = _Epoch(sat_ecef_m[t], code_m[t], unit, starts, offset, spread)
        reduce_epoch(epoch, place_ecef_m[t], equations)
        invert(system, inverse)
        result[t] = math.sqrt(inverse[0, 0] + inverse[1, 1] + inverse[2, 2])
    return result


@inner
def _form(system: Floats, a: Floats, b: Floats) -> float:
    """Return the bilinear form ``a' system b`` of the normal matrix."""
    form = 0.0
    for i in range(3):
        form += a[i] * (system[i, 0] * b[0] + system[i, 1] * b[1] + system[i, 2] * b[2])
    return form


@inner
def _along(
    system: Floats, tangent: Floats, across: Floats, up: Floats, plan: float, height: float
) -> tuple[float, float, float, float]:
    """Return the step, its sigma with and without the map error, and the minimum WSSE along a section.

    The map error across the section is eliminated with the Schur complement.
    """
    own, a, c = _form(system, tangent, tangent), _form(system, across, across), _form(system, up, up)
    to_plan, to_height, b = _form(system, tangent, across), _form(system, tangent, up), _form(system, across, up)
    a, c = a + 1.0 / plan**2, c + 1.0 / height**2
    ahead = aside = above = 0.0
    for k in range(3):
        ahead += tangent[k] * system[k, 3]
        aside += across[k] * system[k, 3]
        above += up[k] * system[k, 3]
    determinant = a * c - b * b
    if not determinant > 0.0:
        determinant = math.nan
    first, second = (c * to_plan - b * to_height) / determinant, (a * to_height - b * to_plan) / determinant
    information = own - (to_plan * first + to_height * second)
    gradient = ahead - (first * aside + second * above)
    step = sigma = math.nan
    if information > 1e-12 * own:
        step, sigma = gradient / information, 1.0 / math.sqrt(information)
    of_map = (c * aside * aside - 2.0 * b * aside * above + a * above * above) / determinant
    least = system[3, 3] - of_map - gradient * step
    return step, sigma, (1.0 / math.sqrt(own) if own > 0.0 else math.nan), least


@kernel
def iterate_along(
    ranges: Any, line: Any, vertex: Indices, tolerance_m: float, most: int
) -> tuple[Indices, Floats, Floats, Floats, Integers]:
    """Compute constrained least-squares positions along the line by Newton steps.

    Parameters
    ----------
    ranges : RangeArrays
    line : SectionArrays
    vertex : ndarray of int, shape (T,)
        Start point on the line; -1 for none.
    tolerance_m, most
        Step [m] below which the iteration has converged, and largest number of steps.

    Returns
    -------
    section : ndarray of int, shape (T,)
    solved : ndarray, shape (6, T)
        Distance along the section [m], and fields `sigma_m`, `exact_map_sigma_m`, `wsse`, `overshoot_m`, `dilution`.
    clock_m, residual_m, iterations
        Fields of `Constrained`.
    """
    sat_ecef_m, code_m, weight, starts, offset_m, sigma_m = ranges
    start_ecef_m, tangent, across, up, length_m, plan_m, height_m = line
    epochs, channels = weight.shape
    groups, no, last = len(starts), np.empty(0), len(length_m) - 1
    tied = len(offset_m) == epochs
    chosen, iterations = np.full(epochs, -1, dtype=np.intp), np.zeros(epochs, dtype=np.int64)
    solved = np.full((6, epochs), np.nan)
    clock, residual = np.full((epochs, groups), np.nan), np.full((epochs, channels), np.nan)
    system, means = np.empty((4, 4)), np.empty((4, groups))
    rows, totals = np.empty((4, channels)), np.empty(groups)
    equations = _Equations(system, means, rows, totals, np.empty((5, groups)))
    place, jump, unit = np.empty(3), np.empty(3), np.empty(channels)
    for t in range(epochs):
        solved[4, t] = 0.0
        if vertex[t] < 0:
            continue
        section = min(vertex[t], last)
        along, entered = (length_m[section] if vertex[t] > last else 0.0), 0
        offset, spread = (offset_m[t], sigma_m[t]) if tied else (no, no)
        epoch = _Epoch(sat_ecef_m[t], code_m[t], weight[t], starts, offset, spread)
        for _ in range(most):
            for i in range(3):
                place[i] = start_ecef_m[section, i] + along * tangent[section, i]
            reduce_epoch(epoch, place, equations)
            step, sigma, exact, least = _along(system, tangent[section], across[section], up[section], plan_m, height_m)
            target, length = along + step, length_m[section]
            below, above = target < 0.0, target > length
            inside = not (below or above)
            ended = (below and section == 0 and along == 0.0) or (above and section == last and along == length)
            iterations[t] += 1
            settled = (inside and not abs(step) > tolerance_m) or ended
            if settled or (below and entered < 0) or (above and entered > 0):
                final = target if inside else along
                solved[0, t], solved[1, t], solved[2, t], solved[3, t] = final, sigma, exact, least
                solved[4, t] = abs(step) if ended else 0.0
                for i in range(3):
                    jump[i] = step * tangent[section, i] if inside else 0.0
                    place[i] = start_ecef_m[section, i] + final * tangent[section, i]
                _settle(jump, means, rows, totals, clock[t], residual[t])
                if math.isfinite(final):
                    chosen[t] = section
                    for m in range(channels):
                        unit[m] = 1.0 if weight[t, m] > 0.0 else 0.0
                    reduce_epoch(_Epoch(sat_ecef_m[t], code_m[t], unit, starts, offset, spread), place, equations)
                    information = 0.0
                    for i in range(3):
                        for j in range(3):
                            information += tangent[section, i] * system[i, j] * tangent[section, j]
                    solved[5, t] = 1.0 / math.sqrt(max(information, 0.0))
                break
            if below and section > 0:
                section -= 1
                along, entered = length_m[section], 1
            elif above and section < last:
                section += 1
                along, entered = 0.0, -1
            else:
                along, entered = min(max(target, 0.0), length), 0
    return chosen, solved, clock, residual, iterations
