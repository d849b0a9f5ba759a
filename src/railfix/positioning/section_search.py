"""Section search: find the trajectory point that fits the ranges best.

P1 2.2(2) compares differences of ranges between satellites with the differences of computed distances. The weighted sum
of squares ``q`` of these comparisons equals the weighted sum of squared residuals after elimination of the clocks.
`find_section` finds the point with the least ``q`` in a time that hardly depends on the length of the line. If a 3-D
position exists, ``q`` is nearly a quadratic form with its minimum there, so that only points inside a ball around it
are evaluated. Otherwise, the search is coarse to fine. It uses a bound: between two points, the root of ``q`` changes
by at most the distance times the root of the summed weights. Both searches are exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
import scipy
from pydantic import Field

from railfix import kernels
from railfix.core.arrays import Floats, Indices, Integers
from railfix.core.constants import FAN_OUT, ROTATION_GRADIENT
from railfix.core.settings import Settings
from railfix.positioning.antenna_rows import AntennaRows, Line
from railfix.positioning.normal_equations import SinglePoint, misfit, normal_equations
from railfix.positioning.range_arrays import Ranges
from railfix.positioning.search_index import SearchIndex

#: Probability that noise alone causes an excess of q above `reach`, up to which alternative positions are searched.
#: `reach` is larger than the ambiguity threshold, because a range fault can increase q at the true position.
_REACH_RISK: Final = 1e-16


class SectionLimits(Settings):
    """Limits for ambiguous sections."""

    #: Probability that noise makes the true position fit worse than the best position by more than `threshold`
    #: (chi-square, one degree of freedom). P1 3.2 describes wrong sections on sharp curves.
    ambiguity_risk: float = Field(default=1e-3, gt=0, lt=1)
    separation_m: float = Field(default=30.0, ge=0)  #: Minimum arc length between the best and an alternative position.
    #: A section with fewer redundant ranges than this is not reliable. On recordings with two constellations, a quarter
    #: of the sections were wrong with one redundant range, but 3 to 4 % with two.
    redundancy: int = Field(default=2, ge=0)

    @cached_property
    def threshold(self) -> float:
        """Excess of q up to which an alternative makes a section ambiguous, for noise of unit variance."""
        return float(scipy.special.chdtri(1, self.ambiguity_risk))

    @cached_property
    def reach(self) -> float:
        """Excess of q up to which alternative positions are searched, for noise of unit variance."""
        return float(scipy.special.chdtri(1, min(_REACH_RISK, self.ambiguity_risk)))


@dataclass(frozen=True, kw_only=True)
class Section:
    """Best-fitting trajectory points, T epochs."""

    #: Index of the point with the least q, shape (T,); -1 where there are no more ranges than clocks.
    vertex: Indices
    q: Floats  #: Weighted sum of squared residuals at `vertex`, shape (T,); NaN without a point.
    #: Excess of q at the best alternative position over q at the best position, divided by the variance factor of the
    #: best fit (at least 1), shape (T,); infinite without an alternative. Because both values of q are interpolated
    #: between points, the excess can be negative.
    excess: Floats
    other_vertex: Indices  #: Index of the point nearest to the alternative position, shape (T,); -1 if none.
    evaluations: Integers  #: Number of points at which q was computed, shape (T,).


class SectionCandidates(NamedTuple):
    """Evaluated points of n epochs, p points in total, sorted by epoch and point."""

    at: Indices  #: Index of each epoch, shape (n,).
    points: Indices  #: Number of points of each epoch, at least 1, shape (n,).
    vertex: Indices  #: Trajectory index of each point, shape (p,).
    q: Floats  #: Weighted sum of squared residuals at each point, shape (p,).
    half_gradient: Floats  #: Half the gradient of `q` at each point, shape (p, 3).
    matrix: Floats  #: Normal matrices, shape (m, 3, 3).
    matrix_of: Indices  #: Index of each point's normal matrix, shape (p,).


def find_section(ranges: Ranges, line: Line, point: SinglePoint, *, limits: SectionLimits | None = None) -> Section:
    """Find, from between-satellite single differences, the point of the line that fits the ranges best (P1 2.2(2)).

    At a point r, the residuals are ``v_i = P_i - |s_i - r|``. Weighted with the full covariance, the sum of squares of
    their single differences is ``q = sum_i w_i (v_i - mean)^2``. The mean is the weighted mean over the satellites of a
    clock.

    Parameters
    ----------
    ranges : Ranges
        Returned by `weighted_ranges`.
    line : Trajectory, SearchIndex or AntennaRows
        Trajectory of the antenna. A `SearchIndex(trajectory)` that is built once saves time in repeated calls.
    point : SinglePoint
        3-D positions from the same ranges (`point_position`), NaN where missing. They shorten the search, but do not
        change the result.
    limits : SectionLimits, optional
        Limits of ambiguous sections (P1 3.2).

    Returns
    -------
    Section
        Best-fitting points.
    """
    limits, antennas = limits or SectionLimits(), AntennaRows.on(line)
    epochs = len(ranges)
    weight_norm = np.sqrt(ranges.weight.sum(axis=1))
    freedom = np.maximum(ranges.redundancy, 1)
    vertex, other = np.full((2, epochs), -1, dtype=np.intp)
    q, excess = np.full(epochs, np.nan), np.full(epochs, np.inf)
    evaluations = np.zeros(epochs, dtype=np.int64)
    every = np.arange(epochs)
    for index, rows in zip(antennas.indices, antennas.parts, strict=True):
        own, trajectory = every[rows], index.trajectory
        candidates: list[SectionCandidates] = []
        radius = _ball(index, point, weight_norm, freedom, own, limits)
        known = np.isfinite(radius)
        if known.any():
            in_ball = own[known]
            candidates.append(_in_ball(ranges, index, point, weight_norm, in_ball, radius[known]))
        coarse = own[~known & (ranges.n_used > ranges.n_clocks)[own]]
        if len(coarse):
            part, tried = _coarse_to_fine(ranges, index, weight_norm, freedom, limits, coarse)
            evaluations[coarse] += tried
            candidates.append(part)
        sections = (trajectory.arc_m, trajectory.tangent, trajectory.length_m)
        for part in candidates:
            at = part.at
            evaluations[at] += part.points
            vertex[at], q[at], excess[at], other[at] = kernels.search.best_points(
                part, freedom[at], sections, limits.separation_m, trajectory.turn_m
            )
    return Section(vertex=vertex, q=q, excess=excess, other_vertex=other, evaluations=evaluations)


def _ball(
    index: SearchIndex,
    point: SinglePoint,
    weight_norm: Floats,
    freedom: Integers,
    epochs: Indices,
    limits: SectionLimits,
) -> Floats:
    """Return the radius of a ball around each 3-D position that contains all candidate points [m]; NaN if unknown."""
    radius = np.full(len(epochs), np.nan)
    known = np.isfinite(point.ecef_m[epochs, 0])
    at = epochs[known]
    if not len(at):
        return radius
    place = point.ecef_m[at]
    nearest_m, vertex = index.tree.query(place)
    radius[known] = kernels.search.radii_of_balls(
        np.asarray(nearest_m, dtype=np.float64), index.trajectory.ecef_m[vertex] - place, point.matrix[at],
        point.covariance_m2[at], point.wsse[at], weight_norm[at], freedom[at], limits.reach,
    )  # fmt: skip
    return radius


def _in_ball(
    ranges: Ranges, index: SearchIndex, point: SinglePoint, weight_norm: Floats, epochs: Indices, radius: Floats
) -> SectionCandidates:
    """Return the points in each epoch's ball, with q recomputed where the quadratic form is not accurate enough."""
    count, vertex, q, half_gradient, unsure = kernels.search.points_in_balls(
        index.trajectory.ecef_m, index.stretches, point.ecef_m[epochs], radius, point.matrix[epochs],
        point.wsse[epochs], weight_norm[epochs],
    )  # fmt: skip
    if not np.all(count):
        raise AssertionError(f"no point of the line within the search radius at epochs {epochs[count == 0]}")
    if unsure.any():
        q[unsure] = misfit(ranges, index.trajectory.ecef_m[vertex[unsure]], np.repeat(epochs, count)[unsure])
    matrix = np.ascontiguousarray(point.matrix)
    return SectionCandidates(epochs, count, vertex, q, half_gradient, matrix, epochs.repeat(count))


def _coarse_to_fine(
    ranges: Ranges, index: SearchIndex, weight_norm: Floats, freedom: Integers, limits: SectionLimits, epochs: Indices
) -> tuple[SectionCandidates, Integers]:
    """Return the candidate points, and the number of points evaluated at each epoch.

    Stretches of the line are skipped if noise cannot explain the residuals at any of their points.
    """
    points = index.trajectory.ecef_m
    upper = np.full(len(ranges), np.inf)
    tried = np.zeros(len(ranges), dtype=np.int64)
    top = len(index.levels[-1][0])
    epoch, node = np.repeat(epochs, top), np.tile(np.arange(top), len(epochs))
    q = np.empty(0)
    for level in reversed(range(len(index.levels))):
        middle, radius = index.levels[level]
        q = misfit(ranges, points[middle[node]], epoch)
        np.minimum.at(upper, epoch, q)
        np.add.at(tried, epoch, 1)
        reach = upper + limits.reach * np.maximum(1.0, upper / freedom)
        nearest = np.maximum(np.sqrt(q) - weight_norm[epoch] * (1.0 + 2.0 * ROTATION_GRADIENT) * radius[node], 0.0)
        keep = nearest**2 <= reach[epoch]
        epoch, node, q = epoch[keep], node[keep], q[keep]
        if level:
            below = len(index.levels[level - 1][0])
            node = (node[:, None] * FAN_OUT + np.arange(FAN_OUT)).ravel()
            epoch = np.repeat(epoch, FAN_OUT)
            exists = node < below
            epoch, node = epoch[exists], node[exists]
    equations = normal_equations(ranges.take(epoch), points[node])
    count = np.bincount(epoch, minlength=len(ranges))[epochs]
    found, every = count > 0, np.arange(len(epoch))
    slope, matrix = np.ascontiguousarray(-equations.vector), np.ascontiguousarray(equations.matrix)
    return SectionCandidates(epochs[found], count[found], node, q, slope, matrix, every), tried[epochs]
