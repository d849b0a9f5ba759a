"""Curve of a centreline between the points of a track; it follows arcs and clothoids in plan, and parabolas in height.

Between two points, the curve is a cubic over their chord, defined by the directions at both ends. The curvature is
assumed to be linear between points, so that each chord implies a direction at each of its ends. The direction at a
point is the mean of the directions implied by both adjacent chords. The curvature at a point is taken from the map's
radius, or from the circle through the point and its neighbours. The curve passes through every point, and follows arcs,
clothoids and parabolas within millimetres. Chainages are measured along the chords.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, places_in_groups
from railfix.core.geodesy import axes_at
from railfix.track.track import Track
from railfix.track.trajectory import Trajectory

#: A radius of the map is not used if a chord's middle ordinate with this radius differs by more than this from the
#: middle ordinates of neighbouring points [m]: such a radius is for another point or has the wrong sign.
_AGREES_M: Final = 0.03
_CORNER_RAD: Final = 0.25  #: Change of direction above which a point is a corner, which the curve does not round [rad].
#: A ramp's end is inserted only if it is farther from both neighbouring points than this fraction of the distance
#: between them.
_BREAK_SHARE: Final = 1e-3
#: A ramp's end is inserted only if the change of slope, times the distance between both neighbours, exceeds this.
_LEAST_BREAK: Final = 1e-4
_CHORD_M: Final = 2e-3  #: Largest distance of the curve from the chords of `curved_line` [m].


@dataclass(frozen=True, kw_only=True)
class CentreCurve:
    """Curve through the V points of a track."""

    chainage_m: Floats  #: Chainages of the points, shape (V,).
    points_m: Floats  #: ECEF coordinates of the points, shape (V, 3).
    #: Horizontal angles from chord to curve at start and end of each segment, positive right, shape (V - 1, 2) [rad].
    to_right: Floats
    to_top: Floats  #: Vertical angles from chord to curve, positive up, shape (V - 1, 2) [rad].

    @cached_property
    def length_m(self) -> Floats:
        """Length of each chord, shape (V - 1,)."""
        return np.diff(self.chainage_m)

    @cached_property
    def _axes(self) -> Floats:
        """Unit vectors of each chord: along the chord, to the right, and upward, shape (V - 1, 3, 3)."""
        along = np.diff(self.points_m, axis=0) / self.length_m[:, None]
        right = np.cross(along, axes_at((self.points_m[1:] + self.points_m[:-1]) / 2.0)[:, 2])
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        return np.stack([along, right, np.cross(right, along)], axis=1)

    def at(self, chainage_m: Floats) -> Floats:
        """Return points of the curve at chainages, shape (n, 3) ECEF [m]; beyond the ends, the outermost chords are
        extended.
        """
        last = len(self.length_m) - 1
        segment = np.clip(np.searchsorted(self.chainage_m, chainage_m, side="right") - 1, 0, last)
        along = chainage_m - self.chainage_m[segment]
        parts = np.stack([along, *(self._offset(v, segment, along) for v in (self.to_right, self.to_top))], axis=-1)
        return np.asarray(self.points_m[segment] + np.einsum("ni,nij->nj", parts, self._axes[segment]))

    def _offset(self, slopes: Floats, segment: Indices, along_m: Floats) -> Floats:
        """Return the distance of the curve from the chord [m], given the directions at both ends of the segments."""
        share = np.clip(along_m / self.length_m[segment], 0.0, 1.0)
        first, last = slopes[segment].T
        return np.asarray(self.length_m[segment] * share * (1.0 - share) * (first * (1.0 - share) - last * share))

    def chords_m(self, within_m: float) -> Floats:
        """Return chainages [m] such that the chords between them are within `within_m` of the curve.

        The chainages of all points are included.
        """
        # A cubic deviates from its chord by an eighth of the length times the change of direction. It deviates by more
        # if the slopes at both ends differ in size.
        turn = np.abs(self.to_right).sum(axis=1) + np.abs(self.to_top).sum(axis=1)
        pieces = np.maximum(np.ceil(np.sqrt(self.length_m * turn / (6.0 * within_m))), 1.0).astype(np.int64)
        start, piece = places_in_groups(pieces)
        return np.append(self.chainage_m[start] + piece / pieces[start] * self.length_m[start], self.chainage_m[-1])


def centre_curve(track: Track) -> CentreCurve:
    """Compute the curve through the points of a track, which must have no duplicate points."""
    step = np.diff(track.ecef_m, axis=0)
    axes = axes_at(track.ecef_m)
    before, after = (np.einsum("vij,vj->vi", axes[1:-1], part) for part in (step[:-1], step[1:]))
    (x0, y0, z0), (x1, y1, z1) = before.T, after.T
    flat_before, flat_after = np.hypot(x0, y0), np.hypot(x1, y1)
    turn = np.arctan2(y0 * x1 - x0 * y1, x0 * x1 + y0 * y1)
    circle = 2.0 * np.sin(turn) / np.maximum(np.hypot(x0 + x1, y0 + y1), 1e-9)
    rise = z1 / np.maximum(flat_after, 1e-9) - z0 / np.maximum(flat_before, 1e-9)
    corner = (np.abs(turn) > _CORNER_RAD) | (np.abs(rise) > _CORNER_RAD)
    bend = _with_radii(track, _to_ends(np.where(corner, 0.0, circle)))
    sag = _to_ends(np.where(corner, 0.0, 2.0 * rise / (flat_before + flat_after)))
    length = np.diff(track.chainage_m)
    return CentreCurve(
        chainage_m=track.chainage_m,
        points_m=track.ecef_m,
        to_right=_slopes(bend, turn, length, corner),
        to_top=_slopes(sag, rise, length, corner),
    )


def _to_ends(inner: Floats) -> Floats:
    """Return the values of the inner points, with the first and the last value repeated for the ends, shape (V,)."""
    return np.concatenate([inner[:1], inner, inner[-1:]]) if len(inner) else np.zeros(2)


def _with_radii(track: Track, of_points: Floats) -> Floats:
    """Return the curvature at each point: from the map's radius where it agrees with the points, otherwise from the
    points.
    """
    with np.errstate(divide="ignore"):
        of_map = np.where(np.isinf(track.radius_m), 0.0, 1.0 / track.radius_m)
    around = np.stack([np.roll(of_points, 1), of_points, np.roll(of_points, -1)])
    around[0, 0], around[2, -1] = of_points[0], of_points[-1]
    step = np.diff(track.chainage_m)
    margin = 8.0 * _AGREES_M / np.maximum(np.append(step, 0.0), np.append(0.0, step)) ** 2
    agrees = (of_map > around.min(axis=0) - margin) & (of_map < around.max(axis=0) + margin)
    return np.where(agrees, of_map, of_points)


def _slopes(curvature: Floats, turn: Floats, length_m: Floats, corner: Floats) -> Floats:
    """Compute the directions of the curve relative to the chord at both ends of each segment, shape (V - 1, 2) [rad].

    `curvature` (V,) is linear between points. `turn` (V - 2,) is the change of direction of the chords at inner points.
    At an inner point that is not a corner, both segments have the same direction.
    """
    first, last = curvature[:-1], curvature[1:]
    start, end = -length_m * (2.0 * first + last) / 6.0, length_m * (first + 2.0 * last) / 6.0
    gap = np.where(corner, 0.0, turn + start[1:] - end[:-1]) / 2.0
    start[1:] -= gap
    end[:-1] += gap
    start[1:][corner], end[:-1][corner] = 0.0, 0.0
    return np.stack([start, end], axis=-1)


def with_breaks(place_m: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Insert the ends of ramps that lie between two points into a piecewise linear function.

    A ramp ends between two points if the line through the two points before them and the line through the two points
    after them intersect there. Chainages `place_m` and `values` have shape (V,).
    """
    if len(place_m) < 4:
        return place_m, values
    slope = np.diff(values) / np.diff(place_m)
    before, after, low, high = slope[:-2], slope[2:], place_m[1:-2], place_m[2:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        meet = (values[2:-1] - values[1:-2] + before * low - after * high) / (before - after)
        inside = (meet > low + _BREAK_SHARE * (high - low)) & (meet < high - _BREAK_SHARE * (high - low))
    inside &= np.abs(before - after) * (high - low) > _LEAST_BREAK
    where = np.flatnonzero(inside)
    return (
        np.insert(place_m, where + 2, meet[where]),
        np.insert(values, where + 2, values[where + 1] + before[where] * (meet[where] - low[where])),
    )


def curved_line(track: Track) -> Trajectory:
    """Compute the centreline of a track as a trajectory whose chords are within 2 mm of the curve.

    Unknown cant is replaced by 0. If the cant of all points is unknown, it remains NaN.
    """
    curve = centre_curve(track)
    chainage = curve.chords_m(_CHORD_M)
    cant = np.interp(chainage, track.chainage_m, np.where(np.isnan(track.cant_m), 0.0, track.cant_m))
    return Trajectory(
        name=track.name,
        ecef_m=curve.at(chainage),
        chainage_m=chainage,
        kilometrage_m=track.kilometrage_at(chainage),
        cant_m=np.full_like(cant, np.nan) if np.isnan(track.cant_m).all() else cant,
        roll_deg=np.zeros(len(chainage)),
        sigma_plan_m=track.sigma_plan_m,
        sigma_height_m=track.sigma_height_m,
        notes=track.provenance.notes,
    )
