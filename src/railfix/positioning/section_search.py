"""Section search: the point of the trajectory that fits the ranges best.

P1 2.2(2) compares ranges with distances by between-satellite single differences. With their full
covariance these give the weighted sum of squared residuals after the clock of each constellation
is eliminated (`normal_equations.fit`), so no reference satellite has to be chosen. `search` returns the
point with the least such ``q``, in a time that does not grow with the line:

* where a 3-D position exists, ``q`` grows from it as a quadratic form, so the point lies in a ball
  whose radius follows from the ``q`` of any one point; a k-d tree returns its points;
* where it does not (two or three satellites), coarse to fine: the square root of ``q`` cannot
  change faster than the square root of the summed weights times the distance moved, so a stretch
  of line whose middle fits too badly is dropped.

Both are exact, not heuristic: tests compare them with ``q`` at every point of the line.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Final

import numpy as np
from pydantic import Field
from scipy.spatial import cKDTree
from scipy.special import chdtri

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.core.settings import Settings
from railfix.positioning.normal_equations import Ranges, fit, normal_equations
from railfix.positioning.single_point import SinglePoint
from railfix.track.trajectory import Trajectory

#: Shortest range from the Earth's surface to a navigation satellite [m], rounded down (GLONASS at the zenith).
_SHORTEST_RANGE: Final = 1.9e7
#: Gradient of the Earth-rotation term of a range over the receiver's place, rounded up (see `geodesy`).
_ROTATION_GRADIENT: Final = 1.1e-5
#: Children of a stretch of line in the coarse-to-fine search.
_FAN_OUT: Final = 8


class SectionLimits(Settings):
    """Limits of ambiguous sections.

    Attributes
    ----------
    ambiguity_risk : float
        Probability that noise alone makes the true place fit this much worse than the best one
        (chi-square, one degree of freedom). P1 3.2: wrong sections on sharp curves.
    reach_risk : float
        Other places are looked for as far as noise makes them fit worse with this probability: further than they are
        ambiguous, for a fault of one range can hide that much.
    separation_m : float
        Least distance along the line between two distinct places.
    redundancy : int
        Ranges beyond the unknowns (clocks and distance) below which a section is doubtful: on real
        recordings of two constellations a quarter of the sections were wrong with one redundant
        range, 3 to 4 % with two.
    predicted_sigmas : float
        Points further from a predicted place than this many of its sigmas are left out where nearer ones
        remain (`PredictedPlace`).
    """

    ambiguity_risk: float = Field(default=1e-3, gt=0, lt=1)
    reach_risk: float = Field(default=1e-16, gt=0, lt=1)
    separation_m: float = Field(default=30.0, ge=0)
    redundancy: int = Field(default=2, ge=0)
    predicted_sigmas: float = Field(default=6.0, gt=0)

    @cached_property
    def threshold(self) -> float:
        """Excess of q that noise of unit variance explains."""
        return float(chdtri(1, self.ambiguity_risk))

    @cached_property
    def reach(self) -> float:
        """Excess of q up to which other places are found."""
        return float(chdtri(1, min(self.reach_risk, self.ambiguity_risk)))


@dataclass(frozen=True, kw_only=True)
class PredictedPlace:
    """Place on the trajectory predicted without the ranges, by a filter along the track: T epochs.

    Attributes
    ----------
    arc_m, sigma_m : ndarray, shape (T,) [m]
        NaN where there is no prediction.
    """

    arc_m: Floats
    sigma_m: Floats

    def take(self, epochs: Indices) -> PredictedPlace:
        """Return the predictions of some epochs, by index."""
        return PredictedPlace(arc_m=self.arc_m[epochs], sigma_m=self.sigma_m[epochs])


@dataclass(frozen=True, kw_only=True)
class Section:
    """The best point of the trajectory, T epochs.

    Attributes
    ----------
    vertex : ndarray of int, shape (T,)
        Point with the least q; -1 where no range is redundant with the clocks.
    q : ndarray, shape (T,)
        Its weighted sum of squared residuals.
    excess : ndarray, shape (T,)
        How much worse the best other place fits, in q at its own best point between the points of
        the trajectory, in variances estimated from the fit of the best place (never
        below the variance of the weights); negative when it fits better, infinite when there is none.
    other_vertex : ndarray of int, shape (T,)
        Where that other place is; -1 when there is none.
    evaluations : ndarray of int, shape (T,)
        Points whose q was computed.
    """

    vertex: Indices
    q: Floats
    excess: Floats
    other_vertex: Indices
    evaluations: Integers


@dataclass(frozen=True)
class _Stretches:
    """Stretches of line of one level: middle point and the radius that covers the rest."""

    middle: Indices
    radius_m: Floats


class SearchIndex:
    """Search structures of a trajectory, built once: a k-d tree, and stretches of rising length.

    Attributes
    ----------
    trajectory : Trajectory
    tree : cKDTree
        Of its points.
    off_tangent_m : ndarray, shape (V - 1,) [m]
        Distance of each section from the parts of the line off its tangent, filled in where a train comes along
        (`pipeline.open_places`); NaN elsewhere.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        self.off_tangent_m = np.full(len(trajectory.length_m), np.nan)
        points = trajectory.ecef_m
        self.tree = cKDTree(points)
        self.levels: list[_Stretches] = []
        count, size = len(points), 1
        while True:
            starts = np.arange(0, count, size)
            middle = np.minimum(starts + size // 2, count - 1)
            away = np.linalg.norm(points - points[np.repeat(middle, size)[:count]], axis=1)
            self.levels.append(_Stretches(middle, np.maximum.reduceat(away, starts)))
            if len(starts) <= _FAN_OUT:
                break
            size *= _FAN_OUT


@dataclass
class _Candidates:
    """Pairs of epoch and point, sorted by both, with q and its slope there."""

    epoch: Indices
    vertex: Indices
    q: Floats
    half_gradient: Floats
    matrix: Floats


def _searchable(ranges: Ranges) -> Masks:
    return np.asarray(ranges.n_used > ranges.n_clocks)


def search(
    ranges: Ranges,
    index: SearchIndex,
    point: SinglePoint,
    *,
    limits: SectionLimits | None = None,
    predicted: PredictedPlace | None = None,
) -> Section:
    """Return the point of the trajectory with the least q at each epoch, and the best other place.

    Parameters
    ----------
    ranges : Ranges
        T epochs.
    index : SearchIndex
    point : SinglePoint
        3-D position from the same ranges and weights; NaN where there is none.
    limits : SectionLimits, optional
    predicted : PredictedPlace, optional
        Of the points that fit as well as noise allows, only those near the predicted place are kept; where none
        of them is near it, the ranges contradict the prediction and it is not used.

    Returns
    -------
    Section
    """
    limits = limits or SectionLimits()
    epochs = len(ranges)
    weight_norm = np.sqrt(ranges.weight.sum(axis=1))
    freedom = np.maximum(ranges.n_used - ranges.n_clocks - 1, 1)
    candidates: list[_Candidates] = []
    evaluations = np.zeros(epochs, dtype=np.int64)

    radius = _ball(index, point, weight_norm, freedom, limits)
    in_ball = np.flatnonzero(np.isfinite(radius))
    if len(in_ball):
        part = _in_ball(ranges, index, point, weight_norm, in_ball, radius[in_ball])
        candidates.append(part)
    coarse = np.flatnonzero(~np.isfinite(radius) & _searchable(ranges))
    if len(coarse):
        part, tried = _coarse_to_fine(ranges, index, weight_norm, freedom, limits, coarse)
        evaluations[coarse] += tried
        candidates.append(part)
    for part in candidates:
        np.add.at(evaluations, part.epoch, 1)
    if predicted is not None:
        candidates = [_near(part, index.trajectory, predicted, limits) for part in candidates]
    return _decide(epochs, candidates, index.trajectory, freedom, limits, evaluations)


def _near(
    candidates: _Candidates, trajectory: Trajectory, predicted: PredictedPlace, limits: SectionLimits
) -> _Candidates:
    """Return the candidates near the predicted place, and all candidates of the epochs that have none there."""
    epoch = candidates.epoch
    away = np.abs(trajectory.arc_m[candidates.vertex] - predicted.arc_m[epoch])
    near = away <= limits.predicted_sigmas * predicted.sigma_m[epoch] + trajectory.length_m.max()
    any_near = np.zeros(len(predicted.arc_m), dtype=bool)
    any_near[epoch[near]] = True
    keep = near | ~any_near[epoch]
    return _Candidates(
        epoch[keep],
        candidates.vertex[keep],
        candidates.q[keep],
        candidates.half_gradient[keep],
        candidates.matrix[keep],
    )


def _ball(
    index: SearchIndex, point: SinglePoint, weight_norm: Floats, freedom: Integers, limits: SectionLimits
) -> Floats:
    """Radius around the 3-D position that holds every point worth looking at; NaN where unknown."""
    radius = np.full(len(point.ecef_m), np.nan)
    at = np.flatnonzero(np.isfinite(point.ecef_m[:, 0]))
    if not len(at):
        return radius
    nearest_m, vertex = index.tree.query(point.ecef_m[at])
    distance = np.asarray(nearest_m, dtype=np.float64)
    delta = index.trajectory.ecef_m[vertex] - point.ecef_m[at]
    form = np.einsum("ti,tij,tj->t", delta, point.matrix[at], delta)
    bend = weight_norm[at] * _bend(distance)
    q0 = np.maximum(point.wsse[at], 0.0)
    best = (np.sqrt(q0 + form) + bend) ** 2
    reach = np.sqrt(best + limits.reach * np.maximum(1.0, best / freedom[at]))
    # 1/trace(N^-1) is below the least eigenvalue of N: q grows at least that fast in every direction.
    growth = 1.0 / np.trace(point.covariance_m2[at], axis1=1, axis2=2)
    size = np.maximum(distance, np.sqrt(np.maximum(reach**2 - q0, 0.0) / growth))
    for _ in range(3):
        size = np.maximum(size, np.sqrt(np.maximum((reach + weight_norm[at] * _bend(size)) ** 2 - q0, 0.0) / growth))
    # The bound holds where curvature stays small against growth; otherwise the search goes coarse to fine.
    holds = weight_norm[at] * _bend(2.0 * size) < 0.5 * np.sqrt(growth) * size
    radius[at] = np.where(holds, 1.001 * size + 1e-3, np.nan)
    return radius


def _bend(distance_m: Floats) -> Floats:
    """Return the largest error of the linear model of a range at a distance from its expansion point [m]."""
    return np.asarray(distance_m**2 / (2.0 * _SHORTEST_RANGE) + _ROTATION_GRADIENT * distance_m)


def _in_ball(
    ranges: Ranges,
    index: SearchIndex,
    point: SinglePoint,
    weight_norm: Floats,
    epochs: Indices,
    radius: Floats,
) -> _Candidates:
    """Points in the ball of each epoch with q from the quadratic form; exact where that leaves a choice."""
    lists = index.tree.query_ball_point(point.ecef_m[epochs], radius, return_sorted=True)
    count = np.fromiter(map(len, lists), dtype=np.intp, count=len(lists))
    vertex = np.fromiter(chain.from_iterable(lists), dtype=np.intp, count=int(count.sum()))
    if not np.all(count):
        raise AssertionError(f"an empty ball at epochs {epochs[count == 0]}: the radius is below the nearest point")
    epoch = np.repeat(epochs, count)
    delta = index.trajectory.ecef_m[vertex] - point.ecef_m[epoch]
    matrix = point.matrix[epoch]
    half_gradient = np.einsum("pij,pj->pi", matrix, delta)
    q = np.maximum(point.wsse, 0.0)[epoch] + np.einsum("pi,pi->p", delta, half_gradient)
    bend = weight_norm[epoch] * _bend(np.sqrt(np.einsum("pi,pi->p", delta, delta)))
    root = np.sqrt(q)
    starts = np.cumsum(count) - count
    least = np.repeat(np.minimum.reduceat(root + bend, starts), count)
    close = root - bend <= least
    unsure = close & (np.repeat(np.add.reduceat(close, starts), count) > 1)
    q[unsure] = fit(ranges.take(epoch[unsure]), index.trajectory.ecef_m[vertex[unsure]])
    return _Candidates(epoch, vertex, q, half_gradient, matrix)


def _coarse_to_fine(
    ranges: Ranges,
    index: SearchIndex,
    weight_norm: Floats,
    freedom: Integers,
    limits: SectionLimits,
    epochs: Indices,
) -> tuple[_Candidates, Integers]:
    """Return the points that fit as well as noise allows, by dropping stretches of line that fit too badly."""
    points = index.trajectory.ecef_m
    upper = np.full(len(ranges), np.inf)
    tried = np.zeros(len(ranges), dtype=np.int64)
    top = len(index.levels[-1].middle)
    epoch, node = np.repeat(epochs, top), np.tile(np.arange(top), len(epochs))
    q = np.empty(0)
    for level in reversed(range(len(index.levels))):
        stretches = index.levels[level]
        q = fit(ranges.take(epoch), points[stretches.middle[node]])
        np.minimum.at(upper, epoch, q)
        np.add.at(tried, epoch, 1)
        reach = upper + limits.reach * np.maximum(1.0, upper / freedom)
        nearest = np.maximum(
            np.sqrt(q) - weight_norm[epoch] * (1.0 + 2.0 * _ROTATION_GRADIENT) * stretches.radius_m[node], 0.0
        )
        keep = nearest**2 <= reach[epoch]
        epoch, node, q = epoch[keep], node[keep], q[keep]
        if level:
            below = len(index.levels[level - 1].middle)
            node = (node[:, None] * _FAN_OUT + np.arange(_FAN_OUT)).ravel()
            epoch = np.repeat(epoch, _FAN_OUT)
            exists = node < below
            epoch, node = epoch[exists], node[exists]
    equations = normal_equations(ranges.take(epoch), points[node])
    return _Candidates(epoch, node, q, -equations.vector, equations.matrix), tried[epochs]


def _floor(candidates: _Candidates, trajectory: Trajectory, which: Indices) -> Floats:
    """Least q on the two sections that meet at a candidate, by its quadratic form."""
    vertex, q = candidates.vertex[which], candidates.q[which]
    slope, matrix = candidates.half_gradient[which], candidates.matrix[which]
    last = len(trajectory.length_m) - 1
    floor = q.copy()
    for section, sign, exists in (
        (np.minimum(vertex, last), 1.0, vertex <= last),
        (np.maximum(vertex - 1, 0), -1.0, vertex > 0),
    ):
        direction = sign * trajectory.tangent[section]
        along = np.einsum("pi,pi->p", direction, slope)
        growth = np.einsum("pi,pij,pj->p", direction, matrix, direction)
        step = np.clip(-along / np.where(growth > 0, growth, np.inf), 0.0, trajectory.length_m[section])
        floor = np.where(exists, np.minimum(floor, q + 2.0 * step * along + step**2 * growth), floor)
    return floor


def _decide(
    epochs: int,
    parts: list[_Candidates],
    trajectory: Trajectory,
    freedom: Integers,
    limits: SectionLimits,
    evaluations: Integers,
) -> Section:
    """The best point of each epoch, and the best of the other places."""
    vertex = np.full(epochs, -1, dtype=np.intp)
    other = np.full(epochs, -1, dtype=np.intp)
    q, excess = np.full(epochs, np.nan), np.full(epochs, np.inf)
    for part in parts:
        starts = np.flatnonzero(np.concatenate([[True], part.epoch[1:] != part.epoch[:-1]]))
        count = np.diff(np.concatenate([starts, [len(part.epoch)]]))
        at = part.epoch[starts]
        least = np.minimum.reduceat(part.q, starts)
        # First of equals, as argmin picks.
        is_best = part.q == np.repeat(least, count)
        best = np.minimum.reduceat(np.where(is_best, np.arange(len(part.q)), len(part.q)), starts)
        vertex[at], q[at] = part.vertex[best], least

        joined = (part.epoch[1:] == part.epoch[:-1]) & (part.vertex[1:] == part.vertex[:-1] + 1)
        before = np.concatenate([[np.inf], np.where(joined, part.q[:-1], np.inf)])
        after = np.concatenate([np.where(joined, part.q[1:], np.inf), [np.inf]])
        apart = np.abs(trajectory.arc_m[part.vertex] - np.repeat(trajectory.arc_m[part.vertex[best]], count))
        minimum = np.flatnonzero((part.q <= before) & (part.q <= after) & (apart > limits.separation_m))
        if not len(minimum):
            continue
        floor = np.full(len(part.q), np.inf)
        floor[minimum] = _floor(part, trajectory, minimum)
        lowest = np.minimum.reduceat(floor, starts)
        has = np.isfinite(lowest)
        second = np.minimum.reduceat(
            np.where(floor == np.repeat(lowest, count), np.arange(len(floor)), len(floor)), starts
        )[has]
        own = _floor(part, trajectory, best[has])
        variance = np.maximum(1.0, own / freedom[at[has]])
        excess[at[has]] = (lowest[has] - own) / variance
        other[at[has]] = part.vertex[second]
    return Section(vertex=vertex, q=q, excess=excess, other_vertex=other, evaluations=evaluations)
