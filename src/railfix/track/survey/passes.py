"""Common line of several runs: the course of the line without repetitions, and the passes of the runs over the line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from scipy.spatial import cKDTree

from railfix.core.arrays import Floats, Indices, Integers
from railfix.track.survey.runs import SurveyLimits

_SAME_WAY: Final = 0.7  #: Cosine of the largest angle between two passes of one line.
#: A part of a leg can repeat an earlier part only if both are this many line widths (`same_line_m`) apart on the leg.
_APART_WIDTHS: Final = 3.0
_MOSTLY: Final = 0.8  #: Minimum fraction of points that must show a repetition, or another track.
_SEAM_M: Final = 200.0  #: The offset between two joined passes is distributed over this distance [m].
_GAP_S: Final = 10.0  #: A longer time without rows is a gap [s].
#: Longest gap within a leg [m]. At a longer gap, the leg ends.
BRIDGED_M: Final = 500.0
#: Cosine of the largest change of direction over a gap within a leg. At a larger change, the leg ends.
_GOES_ON: Final = 0.9
_NEIGHBOURS: Final = 24  #: Number of the line's nearest points that are compared with a point of a leg.


@dataclass(frozen=True, kw_only=True)
class Leg:
    """Part of a run without a reversal: m selected rows that are at least a spacing apart."""

    run: int  #: Index of the run.
    row: Indices  #: Index of each selected row in the run, shape (m,).
    arc_m: Floats  #: Distance from the first selected row to each selected row, shape (m,).
    point_m: Floats  #: East, north and up in the frame of the survey, shape (m, 3).

    def nodes_at(self, arc_m: Floats) -> tuple[Indices, Floats]:
        """Return the four rows around each of q arc lengths, and the weights of these rows, each of shape (q, 4).

        The interpolation is cubic, and linear at the ends of the leg.
        """
        count = len(self.row)
        k = np.clip(np.searchsorted(self.arc_m, arc_m, side="right") - 1, 0, count - 2)
        nodes = np.clip(k[:, None] + np.arange(-1, 3), 0, count - 1)
        at = self.arc_m[nodes]
        share = (arc_m - at[:, 1]) / (at[:, 2] - at[:, 1])
        weight = np.zeros((len(arc_m), 4))
        weight[:, 1], weight[:, 2] = 1.0 - share, share
        inner = (k > 0) & (k < count - 2)
        for i in range(4):
            product = np.ones(int(inner.sum()))
            for j in range(4):
                if j != i:
                    product *= (arc_m[inner] - at[inner, j]) / (at[inner, i] - at[inner, j])
            weight[inner, i] = product
        return self.row[nodes], weight

    def at(self, arc_m: Floats) -> Floats:
        """Interpolate the positions at arc lengths, shape (q, 3) [m]."""
        rows, weight = self.nodes_at(arc_m)
        index = np.searchsorted(self.row, rows)
        return np.asarray(np.einsum("qi,qij->qj", weight, self.point_m[index]))


@dataclass(frozen=True, kw_only=True)
class Course:
    """Line as a polyline of J points."""

    point_m: Floats  #: East, north and up of the points in the frame of the survey, shape (J, 3).
    closed: bool = False  #: Whether the last point is joined to the first point.

    def __len__(self) -> int:
        return len(self.point_m)

    @property
    def direction(self) -> Floats:
        """Horizontal unit vector along the line at each point, shape (J, 2)."""
        return directions(self.point_m, closed=self.closed)


@dataclass(frozen=True, kw_only=True)
class Pass:
    """Part of a leg that lies on the line; the part is sampled at p positions."""

    leg: int  #: Index of the leg.
    sign: int  #: 1 in the direction of the line, -1 in the opposite direction.
    arc_m: Floats  #: Rising arc lengths along the leg, shape (p,).
    #: Places on the line, as monotone fractional indices of its points, shape (p,). On a closed line, the indices
    #: continue beyond the last point.
    place: Floats


def directions(point_m: Floats, *, closed: bool = False) -> Floats:
    """Compute the horizontal direction at each point of a polyline from the neighbouring points, shape (J, 2)."""
    plan = point_m[:, :2]
    step = np.roll(plan, -1, axis=0) - np.roll(plan, 1, axis=0) if closed else np.gradient(plan, axis=0)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return np.asarray(step / np.where(length > 0.0, length, 1.0))


def find_legs(run: int, point_m: Floats, time_s: Floats, limits: SurveyLimits, turn_m: float) -> list[Leg]:
    """Divide a run into legs at reversals, and at gaps that are long or at which the direction changes.

    Reversals are found from the directions over `turn_m` / 2 before and after a point. Rows are left out if they are
    nearer to the previous selected row than the spacing.
    """
    spacing_m = limits.spacing_m
    rows = [0]
    for k in range(1, len(point_m)):
        if np.linalg.norm(point_m[k, :2] - point_m[rows[-1], :2]) >= spacing_m:
            rows.append(k)
    kept = np.array(rows, dtype=np.intp)
    plan = point_m[kept, :2]
    reach = max(1, round(turn_m / spacing_m / 2.0))
    before = plan - plan[np.maximum(np.arange(len(kept)) - reach, 0)]
    after = plan[np.minimum(np.arange(len(kept)) + reach, len(kept) - 1)] - plan
    size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    turned = (before * after).sum(axis=1) < -0.5 * size
    # the sharpest point of each turn
    sharp = np.where(turned, (before * after).sum(axis=1) / np.where(size > 0.0, size, 1.0), 1.0)
    cuts = [
        int(group[np.argmin(sharp[group])])
        for group in np.split(np.flatnonzero(turned), np.flatnonzero(np.diff(np.flatnonzero(turned)) > reach) + 1)
        if len(group)
    ]
    legs = []
    gap = np.flatnonzero((np.diff(time_s) > _GAP_S) & (np.linalg.norm(np.diff(point_m, axis=0), axis=1) > turn_m))
    gaps = [g for g in np.searchsorted(kept, gap, side="right").tolist() if not _goes_on(plan, g, reach)]
    edges = sorted([(0, 0), *((c, 0) for c in cuts), *((g, 1) for g in gaps), (len(kept) - 1, 0)])
    for (first, _), (last, broken) in pairwise(edges):
        part = kept[first : last + 1 - broken]
        if len(part) >= 2:
            step = np.linalg.norm(np.diff(point_m[part], axis=0), axis=1)
            arc = np.concatenate([[0.0], np.cumsum(step)])
            legs.append(Leg(run=run, row=part, arc_m=arc, point_m=point_m[part]))
    return legs


def _goes_on(plan_m: Floats, after: int, reach: int) -> bool:
    """Return whether the gap before point `after` is at most `BRIDGED_M` long, and the run is straight over it."""
    if not 0 < after < len(plan_m) - 1:
        return False
    gap = plan_m[after] - plan_m[after - 1]
    length = float(np.linalg.norm(gap))
    ways = (
        plan_m[after - 1] - plan_m[max(after - 1 - reach, 0)],
        plan_m[min(after + reach, len(plan_m) - 1)] - plan_m[after],
    )
    straight = all(way @ gap > _GOES_ON * length * np.linalg.norm(way) for way in ways)
    return bool(straight and length <= BRIDGED_M)


def _sample(leg: Leg, spacing_m: float) -> tuple[Floats, Floats]:
    """Sample a leg at a constant spacing, and return the arc lengths and positions."""
    arc = np.arange(0.0, leg.arc_m[-1], spacing_m)
    return arc, leg.at(arc)


def find_course(legs: Sequence[Leg], limits: SurveyLimits) -> Course:
    """Find the course of the line.

    At first, the course is the longest leg, up to the point where this leg begins to repeat itself. The other legs
    extend the course.
    """
    spacing_m, width_m = limits.spacing_m, limits.same_line_m
    order = sorted(range(len(legs)), key=lambda i: -float(legs[i].arc_m[-1]))
    first = _sample(legs[order[0]], spacing_m)[1]
    course = _until_repeated(first, spacing_m, width_m)
    grown = True
    while grown and not course.closed:
        grown = False
        for i in order:
            longer = _extend(course, _sample(legs[i], spacing_m)[1], spacing_m, width_m)
            if longer is not None:
                course, grown = longer, True
                break
    return course


def _until_repeated(points: Floats, spacing_m: float, width_m: float) -> Course:
    """Return a polyline up to where it begins to repeat an earlier part of itself over `_APART_WIDTHS` line widths."""
    least = int(_APART_WIDTHS * width_m / spacing_m)
    way = directions(points)
    tree = cKDTree(points[:, :2])
    repeated = np.zeros(len(points), dtype=np.bool_)
    earlier = np.full(len(points), -1)
    found: Any = tree.query_ball_point(points[:, :2], width_m)
    for i, near in enumerate(found):
        others = np.array([j for j in near if j < i - least], dtype=np.intp)
        others = others[np.abs(way[others] @ way[i]) > _SAME_WAY]
        if len(others):
            repeated[i] = True
            earlier[i] = others[np.argmin(np.linalg.norm(points[others, :2] - points[i, :2], axis=1))]
    for i in np.flatnonzero(repeated).tolist():
        stretch = repeated[i : i + least]
        if len(stretch) == least and stretch.mean() >= _MOSTLY:
            j = int(earlier[i])
            if j * spacing_m < 2.0 * width_m and float(way[j] @ way[i]) > 0.0:
                return _close_course(points, i, j, spacing_m)
            return Course(point_m=points[:i])
    return Course(point_m=points)


def _close_course(points: Floats, end: int, start: int, spacing_m: float) -> Course:
    """Close the course between its points `start` and `end`, which are at one location; distribute the misclosure."""
    turn = points[start : end + 1].copy()
    gap = turn[0] - turn[-1]
    along = directions(points)[start]
    gap[:2] -= along * float(along @ gap[:2])
    count = min(len(turn), int(_SEAM_M / spacing_m))
    turn[-count:] += gap * np.linspace(0.0, 1.0, count)[:, None]
    # drop points at the end so that the last point is about one spacing before the first point
    ahead = (turn[:, :2] - turn[0, :2]) @ along
    near = np.linalg.norm(turn[:, :2] - turn[0, :2], axis=1) < 4.0 * spacing_m
    past = np.flatnonzero(near & (ahead > -0.5 * spacing_m) & (np.arange(len(turn)) > len(turn) // 2))
    return Course(point_m=turn[: past[0]] if len(past) else turn, closed=True)


def _extend(course: Course, points: Floats, spacing_m: float, width_m: float) -> Course | None:
    """Extend the course by the part of a leg beyond one of the course's ends; return None if there is no such part."""
    place, sign, _ = match_points(course, points, width_m)
    least = int(_APART_WIDTHS * width_m / spacing_m)
    near_end = 2.0 * width_m / spacing_m
    on = np.isfinite(place)
    for edge in np.flatnonzero(np.diff(on.astype(np.int8))).tolist():
        leaving = bool(on[edge])
        at = edge if leaving else edge + 1
        outward = sign[at] if leaving else -sign[at]
        last = len(course) - 1
        if not ((outward > 0 and place[at] > last - near_end) or (outward < 0 and place[at] < near_end)):
            continue
        if leaving:
            ends = np.flatnonzero(on[edge + 1 :])
            piece = points[edge + 1 : edge + 1 + ends[0]] if len(ends) else points[edge + 1 :]
        else:
            begins = np.flatnonzero(on[: edge + 1])
            piece = points[(begins[-1] + 1 if len(begins) else 0) : edge + 1][::-1]
        if len(piece) < least:
            continue
        nearest = course.point_m[round(float(place[at]))]
        gap = nearest - points[at]
        along = np.append(directions(points)[at], 0.0)
        gap -= along * float(along @ gap)
        fade = np.clip(1.0 - np.arange(len(piece)) * spacing_m / _SEAM_M, 0.0, 1.0)
        piece = piece + gap * fade[:, None]
        end = round(float(place[at]))
        if outward > 0:
            joined = np.concatenate([course.point_m[: end + 1], piece])
        else:
            joined = np.concatenate([piece[::-1], course.point_m[end:]])
        longer = _until_repeated(joined, spacing_m, width_m)
        if len(longer) > len(course) or longer.closed:
            return longer
    return None


def match_points(course: Course, points: Floats, width_m: float) -> tuple[Floats, Integers, Floats]:
    """Match the q points of a polyline to the course.

    Return the fractional index of the course point (NaN off the course), the direction of travel (1 along the course,
    -1 opposite, 0 off the course), and the distance to the right of the course [m]. Each has shape (q,).
    """
    way, line_way = directions(points), course.direction
    vertices = course.point_m[:, :2]
    count = min(_NEIGHBOURS, len(course))
    distance, vertex = cKDTree(vertices).query(points[:, :2], k=np.arange(1, count + 1), distance_upper_bound=width_m)
    known = np.isfinite(distance)
    vertex = np.where(known, vertex, 0)
    cosine = np.einsum("qi,qki->qk", way, line_way[vertex])
    fits = known & (np.abs(cosine) > _SAME_WAY)
    best = np.argmin(np.where(fits, distance, np.inf), axis=1)
    index = np.arange(len(points))
    found = fits[index, best]
    at = vertex[index, best]
    offset = points[:, :2] - vertices[at]
    along = (offset * line_way[at]).sum(axis=1)
    step = float(np.mean(np.linalg.norm(np.diff(vertices, axis=0), axis=1)))
    last = len(course) - (0 if course.closed else 1)
    place = at + np.clip(along / step, -0.5, 0.5)
    place = np.where(found & (place >= -1e-9) & (place <= last), place, np.nan)
    if course.closed:
        place = np.where(found & np.isnan(place), at + 0.0, place)
    sign = np.where(found, np.sign(cosine[index, best]), 0.0).astype(np.int64)
    across = offset[:, 0] * line_way[at][:, 1] - offset[:, 1] * line_way[at][:, 0]
    return place, sign, np.where(found, across, np.nan)


def find_passes(course: Course, legs: Sequence[Leg], limits: SurveyLimits) -> tuple[list[Pass], float]:
    """Find the parts of all legs that are on the course, and the total length of the other parts [m]."""
    spacing_m, width_m = limits.spacing_m, limits.same_line_m
    passes: list[Pass] = []
    beside = 0.0
    turn = float(len(course))
    jump = _APART_WIDTHS * width_m / spacing_m
    for number, leg in enumerate(legs):
        arc, points = _sample(leg, spacing_m)
        if len(points) < 3:
            continue
        place, sign, _ = match_points(course, points, width_m)
        beside += spacing_m * int(np.isnan(place).sum())
        start = 0
        while start < len(arc):
            if np.isnan(place[start]):
                start += 1
                continue
            chain, value = [start], [float(place[start])]
            way = int(sign[start])
            for k in range(start + 1, len(arc)):
                if np.isnan(place[k]):
                    if k - chain[-1] > jump:
                        break
                    continue
                here = float(place[k])
                if course.closed:
                    here += turn * round((value[-1] - here) / turn)
                expected = value[-1] + way * (k - chain[-1])
                if sign[k] != way or abs(here - expected) > jump:
                    break
                chain.append(k)
                value.append(here)
            if len(chain) >= 3:
                ordered = way * np.maximum.accumulate(way * np.array(value))
                passes.append(Pass(leg=number, sign=way, arc_m=arc[chain], place=ordered))
            start = chain[-1] + 1
    return passes, beside


def without_other_track(
    course: Course, legs: Sequence[Leg], passes: Sequence[Pass], limits: SurveyLimits, tolerance_m: float
) -> tuple[list[Pass], float]:
    """Remove the passes of one direction if the two directions are on separate tracks.

    Tracks are separate if they are more than `tolerance_m` apart. Return the remaining passes and the distance between
    the tracks [m], which is 0 if no passes are removed.
    """
    across: dict[int, Floats] = {}
    for sign in (1, -1):
        found = [
            match_points(course, legs[each.leg].at(each.arc_m), limits.same_line_m)[2]
            for each in passes
            if each.sign == sign
        ]
        across[sign] = np.concatenate([*found, np.zeros(0)])
        across[sign] = across[sign][np.isfinite(across[sign])]
    if min(len(values) for values in across.values()) * limits.spacing_m < _SEAM_M:
        return list(passes), 0.0
    kept = 1 if len(across[1]) >= len(across[-1]) else -1
    beside = across[-kept] - np.median(across[kept])
    distance = float(np.median(beside))
    if abs(distance) <= tolerance_m or float((np.sign(beside) == np.sign(distance)).mean()) < _MOSTLY:
        return list(passes), 0.0
    return [each for each in passes if each.sign == kept], abs(distance)


@dataclass(frozen=True, kw_only=True)
class Ties:
    """Assignments of m interpolated positions of runs to points of the line."""

    run: Indices  #: Index of the run, shape (m,).
    row: Indices  #: Rows of the run from which the position is interpolated, shape (m, 4).
    weight: Floats  #: Interpolation weights of the rows, with a sum of 1, shape (m, 4).
    point: Indices  #: Index of the point of the line, shape (m,).
    number: Indices  #: Index of the pass, shape (m,).


def find_ties(course: Course, legs: Sequence[Leg], passes: Sequence[Pass]) -> Ties:
    """For each pass, interpolate the run's positions abreast of those points of the line that the pass covers."""
    parts: list[tuple[Indices, Indices, Floats, Indices, Indices]] = []
    for number, each in enumerate(passes):
        place, arc = each.sign * each.place, each.arc_m
        rising = np.concatenate([[True], np.diff(place) > 1e-9])
        place, arc = place[rising], arc[rising]
        low, high = int(np.ceil(place[0])), int(np.floor(place[-1]))
        points = np.arange(low, high + 1)
        if not len(points):
            continue
        rows, weight = legs[each.leg].nodes_at(np.interp(points, place, arc))
        run = np.full(len(points), legs[each.leg].run)
        index = np.mod(each.sign * points, len(course)) if course.closed else each.sign * points
        parts.append((run, rows, weight, index, np.full(len(points), number)))
    empty = np.zeros(0, dtype=np.intp)
    if not parts:
        return Ties(run=empty, row=np.zeros((0, 4), np.intp), weight=np.zeros((0, 4)), point=empty, number=empty)
    run, row, weight, point, number_of = (np.concatenate(items) for items in zip(*parts, strict=True))
    return Ties(run=run, row=row, weight=weight, point=point, number=number_of)
