"""Points of a line near positions, and the best of them by q: array functions of the section search."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.kernels import compiled_by

#: Shortest range from the Earth's surface to a navigation satellite [m], rounded down (GLONASS at the zenith).
_SHORTEST_RANGE: Final = 1.9e7
#: Gradient of the Earth-rotation term of a range over the receiver's place, rounded up (see `geodesy`).
ROTATION_GRADIENT: Final = 1.1e-5
#: Children of a stretch of line.
FAN_OUT: Final = 8
#: Rounding allowed for in the radius of a stretch [m].
_SLACK_M: Final = 1e-6


def bend_m(distance_m: Floats) -> Floats:
    """Return the largest error of the linear model of a range at a distance from its expansion point [m]."""
    return np.asarray(distance_m**2 / (2.0 * _SHORTEST_RANGE) + ROTATION_GRADIENT * distance_m)


@compiled_by("search")
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
    """Return the radius of the ball around each 3-D position that holds every point worth looking at, shape (n,) [m].

    NaN where errors of the linear model leave it open.

    Parameters
    ----------
    distance_m, away_m : ndarray, shapes (n,), (n, 3) [m]
        To the nearest point of the line.
    matrix, covariance_m2, wsse : ndarray, shapes (n, 3, 3), (n, 3, 3), (n,)
        Of the 3-D positions.
    weight_norm : ndarray, shape (n,)
        Root of the summed weights.
    freedom : ndarray of int, shape (n,)
        Redundancy on the line, 1 at least.
    limit : float
        `SectionLimits.reach`.
    """
    form = np.einsum("ti,tij,tj->t", away_m, matrix, away_m)
    q0 = np.maximum(wsse, 0.0)
    best = (np.sqrt(q0 + form) + weight_norm * bend_m(distance_m)) ** 2
    reach = np.sqrt(best + limit * np.maximum(1.0, best / freedom))
    # 1/trace(N^-1) is below the least eigenvalue of N: q grows at least that fast in every direction.
    growth = 1.0 / np.trace(covariance_m2, axis1=1, axis2=2)
    size = np.maximum(distance_m, np.sqrt(np.maximum(reach**2 - q0, 0.0) / growth))
    for _ in range(3):
        size = np.maximum(size, np.sqrt(np.maximum((reach + weight_norm * bend_m(size)) ** 2 - q0, 0.0) / growth))
    # The bound holds where curvature stays small against growth; otherwise the search goes coarse to fine.
    holds = weight_norm * bend_m(2.0 * size) < 0.5 * np.sqrt(growth) * size
    return np.where(holds, 1.001 * size + 1e-3, np.nan)


@compiled_by("search")
def points_in_balls(
    points_m: Floats,
    middle: Indices,
    reach_m: Floats,
    first: Indices,
    centre_m: Floats,
    radius_m: Floats,
    matrix: Floats,
    least: Floats,
    weight_norm: Floats,
) -> tuple[Indices, Indices, Floats, Floats, Masks]:
    """Find the points of a line in one ball an epoch, and their q by the quadratic form around its centre.

    Parameters
    ----------
    points_m : ndarray, shape (V, 3) [m]
    middle, reach_m, first
        Of `SearchIndex.stretches`.
    centre_m, radius_m : ndarray, shapes (n, 3), (n,) [m]
    matrix, least : ndarray, shapes (n, 3, 3), (n,)
        The quadratic form: normal matrix, and q at the centre.
    weight_norm : ndarray, shape (n,)
        Root of the summed weights.

    Returns
    -------
    count : ndarray of int, shape (n,)
    vertex : ndarray of int, shape (p,)
        Sorted by epoch and point.
    q, half_gradient : ndarray, shapes (p,), (p, 3)
    unsure : ndarray of bool, shape (p,)
        The error of the quadratic form leaves open which point of the epoch is the best, and this may be it.
    """
    epochs, top = len(radius_m), len(first) - 2
    epoch, node = np.divmod(np.arange(epochs * (first[-1] - first[-2])), first[-1] - first[-2])
    for level in range(top, -1, -1):
        at = first[level] + node
        delta = points_m[middle[at]] - centre_m[epoch]
        reach = radius_m[epoch] + (reach_m[at] + _SLACK_M if level else 0.0)
        near = np.einsum("pi,pi->p", delta, delta) <= reach**2
        epoch, node = epoch[near], node[near]
        if level:
            epoch, node = np.repeat(epoch, FAN_OUT), (node[:, None] * FAN_OUT + np.arange(FAN_OUT)).ravel()
            exists = node < first[level] - first[level - 1]
            epoch, node = epoch[exists], node[exists]
    count = np.bincount(epoch, minlength=epochs)
    delta = points_m[node] - centre_m[epoch]
    half_gradient = np.einsum("pij,pj->pi", matrix[epoch], delta)
    q = np.maximum(least, 0.0)[epoch] + np.einsum("pi,pi->p", delta, half_gradient)
    bend = weight_norm[epoch] * bend_m(np.sqrt(np.einsum("pi,pi->p", delta, delta)))
    root, lowest = np.sqrt(q), np.full(epochs, np.inf)
    np.minimum.at(lowest, epoch, root + bend)
    close = root - bend <= lowest[epoch]
    return count, node, q, half_gradient, close & (np.bincount(epoch[close], minlength=epochs) > 1)[epoch]


@compiled_by("search")
def best_points(
    count: Indices,
    vertex: Indices,
    q: Floats,
    half_gradient: Floats,
    matrix: Floats,
    matrix_of: Indices,
    freedom: Integers,
    arc_m: Floats,
    tangent: Floats,
    length_m: Floats,
    separation_m: float,
    turn_m: float,
) -> tuple[Indices, Floats, Floats, Indices]:
    """Select the best point of each epoch, and the best of the other places.

    Parameters
    ----------
    count, vertex, q, half_gradient, matrix, matrix_of
        Of `_Candidates`.
    freedom : ndarray of int, shape (n,)
    arc_m, tangent, length_m
        Of the trajectory.
    separation_m : float
        Places nearer than this along the line are one.
    turn_m : float
        Once round a closed line; infinite for others.

    Returns
    -------
    vertex, q, excess, other_vertex : ndarray, shape (n,)
        As in `Section`.
    """
    starts, epoch = np.cumsum(count) - count, np.repeat(np.arange(len(count)), count)
    least = np.minimum.reduceat(q, starts)
    every = np.arange(len(q))
    # First of equals, as argmin picks.
    best = np.minimum.reduceat(np.where(q == least[epoch], every, len(q)), starts)
    excess, other = np.full(len(count), np.inf), np.full(len(count), -1, dtype=np.intp)
    joined = (epoch[1:] == epoch[:-1]) & (vertex[1:] == vertex[:-1] + 1)
    before = np.concatenate([[np.inf], np.where(joined, q[:-1], np.inf)])
    after = np.concatenate([np.where(joined, q[1:], np.inf), [np.inf]])
    apart = np.abs(arc_m[vertex] - arc_m[vertex[best]][epoch])
    apart = np.minimum(apart, np.abs(turn_m - apart))
    minimum = np.flatnonzero((q <= before) & (q <= after) & (apart > separation_m))
    if not len(minimum):
        return vertex[best], least, excess, other
    line = (tangent, length_m)
    floor = np.full(len(q), np.inf)
    floor[minimum] = _floor(vertex[minimum], q[minimum], half_gradient[minimum], matrix[matrix_of[minimum]], *line)
    lowest = np.minimum.reduceat(floor, starts)
    has = np.isfinite(lowest)
    second = np.minimum.reduceat(np.where(floor == lowest[epoch], every, len(q)), starts)[has]
    some = best[has]
    own = _floor(vertex[some], q[some], half_gradient[some], matrix[matrix_of[some]], *line)
    excess[has] = (lowest[has] - own) / np.maximum(1.0, own / freedom[has])
    other[has] = vertex[second]
    return vertex[best], least, excess, other


def _floor(vertex: Indices, q: Floats, slope: Floats, matrix: Floats, tangent: Floats, length_m: Floats) -> Floats:
    """Least q on the two sections that meet at each point, by its quadratic form."""
    last = len(length_m) - 1
    floor = q.copy()
    for section, sign, exists in (
        (np.minimum(vertex, last), 1.0, vertex <= last),
        (np.maximum(vertex - 1, 0), -1.0, vertex > 0),
    ):
        direction = sign * tangent[section]
        along = np.einsum("pi,pi->p", direction, slope)
        growth = np.einsum("pi,pij,pj->p", direction, matrix, direction)
        step = np.clip(-along / np.where(growth > 0, growth, np.inf), 0.0, length_m[section])
        floor = np.where(exists, np.minimum(floor, q + 2.0 * step * along + step**2 * growth), floor)
    return floor
