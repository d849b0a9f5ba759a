"""Search for the line points near a position and the best of these points; distance within which a line is straight."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.core.constants import ALONG, CLEAR_M, FAN_OUT, ON_TANGENT_M, ROTATION_GRADIENT
from railfix.kernels.compiling import inner, kernel

#: Half the inverse [1/m] of the shortest satellite range: GLONASS at the zenith, rounded down to 1.9e7 m.
_CURVATURE = 1.0 / (2.0 * 1.9e7)
#: Allowance for rounding errors in the radius of a stretch of line [m].
_SLACK_M = 1e-6


@inner
def _bend_m(distance_m: float) -> float:
    """Return the largest error [m] of a linearised range at a given distance [m] from the linearisation point."""
    return distance_m * distance_m * _CURVATURE + ROTATION_GRADIENT * distance_m


@kernel
def radii_of_balls(
    distance_m: Floats,
    away_m: Floats,
    matrix: Floats,
    covariance_m2: Floats,
    wsse: Floats,
    weight_norm: Floats,
    freedom: Integers,
    limit: float,
) -> Floats:
    """Return the radii [m] of balls around 3-D positions that contain all candidate points of the line, shape (n,).

    A radius is NaN where linearisation errors are too large.

    Parameters
    ----------
    distance_m, away_m : ndarray, shapes (n,), (n, 3) [m]
        Distance from the 3-D position to the nearest point of the line, and vector to this point.
    matrix, covariance_m2, wsse : ndarray, shapes (n, 3, 3), (n, 3, 3), (n,)
        Normal matrix, covariance and WSSE of the 3-D positions.
    weight_norm : ndarray, shape (n,)
        Square root of the summed weights.
    freedom : ndarray of int, shape (n,)
        Redundancy of a position on the line, at least 1.
    limit : float
        `SectionLimits.reach`.
    """
    result = np.empty(len(distance_m))
    for t in range(len(distance_m)):
        form, norm, q0 = 0.0, weight_norm[t], max(wsse[t], 0.0)
        for i in range(3):
            for j in range(3):
                form += away_m[t, i] * matrix[t, i, j] * away_m[t, j]
        best = (math.sqrt(q0 + form) + norm * _bend_m(distance_m[t])) ** 2
        reach = math.sqrt(best + limit * max(1.0, best / freedom[t]))
        growth = 1.0 / (covariance_m2[t, 0, 0] + covariance_m2[t, 1, 1] + covariance_m2[t, 2, 2])
        size = max(distance_m[t], math.sqrt(max(reach**2 - q0, 0.0) / growth))
        for _ in range(3):
            size = max(size, math.sqrt(max((reach + norm * _bend_m(size)) ** 2 - q0, 0.0) / growth))
        holds = norm * _bend_m(2.0 * size) < 0.5 * math.sqrt(growth) * size
        result[t] = 1.001 * size + 1e-3 if holds else math.nan
    return result


@inner
def points_within(
    points_m: Floats,
    stretches: tuple[Indices, Floats, Indices],
    centre_m: tuple[float, float, float],
    radius_m: float,
    nodes: Indices,
    below: Indices,
) -> tuple[Indices, Indices, int]:
    """Find the points of a line that are within a ball; `stretches` is a field of `SearchIndex`.

    Return the work array with the indices of the points, the other work array, and the number of points.
    """
    middle, reach_m, first = stretches
    x, y, z = centre_m
    top = len(first) - 2
    held = first[top + 1] - first[top]
    for i in range(held):
        nodes[i] = i
    for level in range(top, -1, -1):
        kept, size = 0, first[level] - first[level - 1] if level else 0
        for i in range(held):
            at = first[level] + nodes[i]
            p = middle[at]
            dx, dy, dz = points_m[p, 0] - x, points_m[p, 1] - y, points_m[p, 2] - z
            reach = radius_m + (reach_m[at] + _SLACK_M if level else 0.0)
            if dx * dx + dy * dy + dz * dz > reach * reach:
                continue
            if not level:
                below[kept] = nodes[i]
                kept += 1
            for child in range(FAN_OUT * nodes[i], min(FAN_OUT * nodes[i] + FAN_OUT, size)):
                below[kept] = child
                kept += 1
        nodes, below, held = below, nodes, kept
    return nodes, below, held


@kernel
def points_in_balls(
    points_m: Floats,
    stretches: tuple[Indices, Floats, Indices],
    centre_m: Floats,
    radius_m: Floats,
    matrix: Floats,
    least: Floats,
    weight_norm: Floats,
) -> tuple[Indices, Indices, Floats, Floats, Masks]:
    """Find the points of a line in one ball per epoch, and compute the WSSE q at each point by a quadratic form.

    Parameters
    ----------
    points_m : ndarray, shape (V, 3) [m]
    stretches
        `SearchIndex.stretches`.
    centre_m, radius_m : ndarray, shapes (n, 3), (n,) [m]
    matrix, least : ndarray, shapes (n, 3, 3), (n,)
        Coefficients of the quadratic form about the centre: normal matrix, and q at the centre.
    weight_norm : ndarray, shape (n,)
        Square root of the summed weights.

    Returns
    -------
    count : ndarray of int, shape (n,)
    vertex : ndarray of int, shape (p,)
        Indices of the points, sorted by epoch and point.
    q, half_gradient : ndarray, shapes (p,), (p, 3)
    unsure : ndarray of bool, shape (p,)
        True for points that may be the best of their epoch within the error of the quadratic form.
    """
    epochs = len(radius_m)
    count, found = np.zeros(epochs, dtype=np.intp), 0
    vertex, values, unsure = np.empty(1024, dtype=np.intp), np.empty((1024, 6)), np.empty(1024, dtype=np.bool_)
    nodes, below = np.empty(len(points_m) + FAN_OUT, dtype=np.intp), np.empty(len(points_m) + FAN_OUT, dtype=np.intp)
    for t in range(epochs):
        x, y, z = centre_m[t, 0], centre_m[t, 1], centre_m[t, 2]
        nodes, below, held = points_within(points_m, stretches, (x, y, z), radius_m[t], nodes, below)
        count[t] = held
        if found + held > len(vertex):
            room, old_vertex, old_values, old_unsure = 2 * (found + held), vertex, values, unsure
            vertex, values, unsure = np.empty(room, dtype=np.intp), np.empty((room, 6)), np.empty(room, dtype=np.bool_)
            for at in range(found):
                vertex[at], unsure[at] = old_vertex[at], old_unsure[at]
                for k in range(6):
                    values[at, k] = old_values[at, k]
        best, close = math.inf, 0
        for i in range(held):
            p, at = nodes[i], found + i
            dx, dy, dz = points_m[p, 0] - x, points_m[p, 1] - y, points_m[p, 2] - z
            for k in range(3):
                values[at, 1 + k] = matrix[t, k, 0] * dx + matrix[t, k, 1] * dy + matrix[t, k, 2] * dz
            q = max(least[t], 0.0) + dx * values[at, 1] + dy * values[at, 2] + dz * values[at, 3]
            square = dx * dx + dy * dy + dz * dz
            bend = weight_norm[t] * _bend_m(math.sqrt(square))
            root = math.sqrt(q)
            vertex[at], values[at, 0], values[at, 4], values[at, 5] = p, q, root - bend, root + bend
            best = min(best, root + bend)
        for at in range(found, found + held):
            unsure[at] = values[at, 4] <= best
            close += unsure[at]
        for at in range(found, found + held):
            unsure[at] = unsure[at] and close > 1
        found += held
    return count, vertex[:found], values[:found, 0].copy(), values[:found, 1:4].copy(), unsure[:found]


@inner
def _floor(vertex: int, q: float, slope: Floats, matrix: Floats, tangent: Floats, length_m: Floats) -> float:
    """Return the minimum of the quadratic form on the two sections that meet at the point `vertex`, where the form is
    `q`.
    """
    floor = q
    for side in range(2):
        section, sign = vertex - side, 1.0 - 2.0 * side
        if section < 0 or section >= len(length_m):
            continue
        along, growth = 0.0, 0.0
        for i in range(3):
            along += sign * tangent[section, i] * slope[i]
            for j in range(3):
                growth += tangent[section, i] * matrix[i, j] * tangent[section, j]
        step = min(max(-along / growth, 0.0), length_m[section]) if growth > 0.0 else 0.0
        floor = min(floor, q + 2.0 * step * along + step**2 * growth)
    return floor


@kernel
def best_points(
    candidates: Any,
    freedom: Integers,
    line: tuple[Floats, Floats, Floats],
    separation_m: float,
    turn_m: float,
) -> tuple[Indices, Floats, Floats, Indices]:
    """For each epoch, select the best point, and the best of the points that do not count as the same position.

    Parameters
    ----------
    candidates : SectionCandidates
    freedom : ndarray of int, shape (n,)
    line : tuple of ndarray
        `arc_m`, `tangent` and `length_m` of the trajectory.
    separation_m : float
        Points up to this distance apart along the line count as one position.
    turn_m : float
        Length of a closed line; infinite for an open line.

    Returns
    -------
    vertex, q, excess, other_vertex : ndarray, shape (n,)
        Fields of `Section`.
    """
    _, count, vertex, q, half_gradient, matrix, matrix_of = candidates
    arc_m, tangent, length_m = line
    epochs, begin = len(count), 0
    chosen, other = np.empty(epochs, dtype=np.intp), np.full(epochs, -1, dtype=np.intp)
    least, excess = np.empty(epochs), np.full(epochs, np.inf)
    for t in range(epochs):
        end = begin + count[t]
        best = begin
        for p in range(begin, end):
            if q[p] < q[best]:
                best = p
        chosen[t], least[t] = vertex[best], q[best]
        lowest = math.inf
        for p in range(begin, end):
            apart = abs(arc_m[vertex[p]] - arc_m[vertex[best]])
            if not (apart > separation_m and abs(turn_m - apart) > separation_m):
                continue
            if p > begin and vertex[p] == vertex[p - 1] + 1 and q[p] > q[p - 1]:
                continue
            if p + 1 < end and vertex[p + 1] == vertex[p] + 1 and q[p] > q[p + 1]:
                continue
            floor = _floor(vertex[p], q[p], half_gradient[p], matrix[matrix_of[p]], tangent, length_m)
            if floor < lowest:
                lowest, other[t] = floor, vertex[p]
        if lowest < math.inf:
            own = _floor(vertex[best], q[best], half_gradient[best], matrix[matrix_of[best]], tangent, length_m)
            excess[t] = (lowest - own) / max(1.0, own / freedom[t])
        begin = end
    return chosen, least, excess, other


@kernel
def clear_of_sections(
    ecef_m: Floats,
    tangent: Floats,
    across: Floats,
    length_m: Floats,
    stretches: tuple[Indices, Floats, Indices],
    section: Indices,
) -> Floats:
    """For each of S sections, return the horizontal distance [m] within which the line follows the section's tangent.

    `ecef_m`, shape (P, 3), are the points of the line; `tangent`, `across` and `length_m` describe its sections.
    `section` are the indices of the S sections. `stretches` is a field of `SearchIndex`.
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
