"""Trajectory of an antenna as a polyline in ECEF, and search for the nearest points of the polyline."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from railfix.core.arrays import Floats, FrozenArrays, Indices, Masks, freeze_arrays, places_in_groups, read_only
from railfix.core.errors import check_type
from railfix.core.geodesy import axes_at
from railfix.core.notebook import NotebookTable, plural
from railfix.track.track import SIGMA_HEIGHT_M, SIGMA_PLAN_M, Track, interpolate_kilometrage

#: Number of candidate samples per position in the first round of the search. Each further round uses four times as many
#: candidates as the previous round, for positions whose nearest point is not yet certain.
_FIRST_CANDIDATES = 6
_CHUNK = 2_000_000  #: Largest number of pairs of a position and a candidate in one array.


def project_on_segments(points_m: Floats, start_m: Floats, step_m: Floats) -> tuple[Floats, Floats]:
    """Project points on segments, and return the fractions (0 to 1) along the segments and the distances from them."""
    offset = points_m - start_m
    squared = np.einsum("...i,...i->...", step_m, step_m)
    share = np.minimum(np.maximum(np.einsum("...i,...i->...", offset, step_m) / squared, 0.0), 1.0)
    rest = offset - share[..., None] * step_m
    return share, np.sqrt(np.einsum("...i,...i->...", rest, rest))


class NearestOnPolyline:
    """Search for nearest points of a polyline, shape (V, 3), by samples along the segments."""

    def __init__(self, points_m: Floats) -> None:
        self._start = points_m[:-1]
        self._step = np.diff(points_m, axis=0)
        self._length = np.linalg.norm(self._step, axis=1)
        spacing = max(float(np.median(self._length)), float(self._length.sum()) / (4 * len(points_m)), 1e-3)
        pieces = np.maximum(np.ceil(self._length / spacing).astype(np.int64), 1)
        self._segment, piece = places_in_groups(pieces)
        share = (piece + 0.5) / pieces[self._segment]
        #: Largest distance of a point of the polyline from the nearest sample of its segment [m].
        self.reach_m = float((self._length / pieces).max()) / 2.0 * (1.0 + 1e-9)
        self._tree = scipy.spatial.cKDTree(self._start[self._segment] + share[:, None] * self._step[self._segment])

    def __call__(self, ecef_m: ArrayLike) -> tuple[Indices, Floats, Floats]:
        """Return each position's nearest segment, and the position's distances along and from this segment.

        Positions have shape (n, 3); the results have shape (n,). For NaN, the segment is -1 and the distances are NaN.
        """
        points = np.asarray(ecef_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"ecef_m has shape {points.shape}, expected (n, 3)")
        index = np.full(len(points), -1, dtype=np.intp)
        along = np.full(len(points), np.nan)
        offset = np.full(len(points), np.nan)
        pending = np.flatnonzero(np.isfinite(points).all(axis=1))
        candidates = min(_FIRST_CANDIDATES, len(self._segment))
        while pending.size:
            unproven = []
            rows = max(1, _CHUNK // candidates)
            for part in (pending[i : i + rows] for i in range(0, pending.size, rows)):
                index[part], along[part], offset[part], proven = self._among(points[part], candidates)
                unproven.append(part[~proven])
            pending = np.concatenate(unproven)
            candidates = min(candidates * 4, len(self._segment))
        return index, along, offset

    def _among(self, points: Floats, candidates: int) -> tuple[Indices, Floats, Floats, Masks]:
        """Find the nearest of the segments with the nearest samples, and whether no other segment can be nearer."""
        nearest = self._tree.query(points, k=np.arange(1, candidates + 1))
        distance, sample = np.asarray(nearest[0], dtype=np.float64), np.asarray(nearest[1], dtype=np.intp)
        chosen, share, best = nearest_segments(points, self._segment[sample], self._start, self._step)
        proven = (distance[:, -1] > best + self.reach_m) | (candidates == len(self._segment))
        return chosen, share * self._length[chosen], best, proven


def nearest_segments(
    points_m: Floats, segment: Indices, start_m: Floats, step_m: Floats
) -> tuple[Indices, Floats, Floats]:
    """Return each point's nearest segment among C candidates (n, C), the fraction along it, and its distance."""
    share, offset = project_on_segments(points_m[:, None], start_m[segment], step_m[segment])
    best = offset.min(axis=1)
    # of equally near segments, return the first on the line, whatever the order of the candidates
    place = np.where(offset <= best[:, None] * (1 + 1e-12) + 1e-9, segment + share, np.inf)
    row, column = np.arange(len(points_m)), place.argmin(axis=1)
    return segment[row, column], share[row, column], best


#: A line is closed if its end is within this distance of another part [m]; parallel tracks are farther apart.
_CLOSED_M: Final = 3.0
_SAME_WAY: Final = 0.9  #: Cosine of the largest angle between two parts that count as parallel.
_END_M: Final = 100.0  #: Parts of the line within this length of its end are not searched [m].


def joins_m(arc_m: Floats, ecef_m: Floats) -> tuple[float, float]:
    """Return the arc lengths at which a closed line passes its start and its end again [m]; NaN at an open end."""
    segment = np.diff(ecef_m, axis=0)
    segment /= np.linalg.norm(segment, axis=1, keepdims=True)
    return _beside(arc_m, ecef_m, segment, 0), _beside(arc_m, ecef_m, segment, -1)


def _beside(arc_m: Floats, ecef_m: Floats, segment: Floats, end: int) -> float:
    """Return the arc length of the nearest part of the line that is parallel to an end [m]; NaN if no part is."""
    from_end = ecef_m[end] - ecef_m[:-1]
    length = np.diff(arc_m)
    along = np.clip((from_end * segment).sum(axis=1), 0.0, length)
    apart = np.linalg.norm(from_end - along[:, None] * segment, axis=1)
    arc = arc_m[:-1] + along
    other = np.abs(arc - arc_m[end]) > _END_M
    other &= (apart < _CLOSED_M) & (segment @ segment[end] > _SAME_WAY)
    return float(arc[other][np.argmin(apart[other])]) if other.any() else float("nan")


#: Note in every output of a run without a vehicle file.
TRACK_AS_PATH = "no vehicle file: the track is assumed to be the antenna's own path"
_END_TOLERANCE_M = 1e-6  #: Accepted distance beyond the ends of a trajectory, for rounding errors [m].


@dataclass(frozen=True, kw_only=True)
class Trajectory(FrozenArrays, NotebookTable):
    """Trajectory of one antenna, given by V points.

    Lateral offsets are positive to the right, seen in the direction of rising chainage.
    """

    name: str  #: Name of the antenna, or of the track that is used as its path.
    ecef_m: Floats  #: ECEF coordinates of the points, shape (V, 3).
    chainage_m: Floats  #: Chainage of the reference point of the vehicle on the track, strictly rising, shape (V,).
    kilometrage_m: Floats  #: Kilometrage at the reference point, shape (V,); NaN where unknown.
    cant_m: Floats  #: Cant of the track at the reference point, shape (V,); NaN where unknown.
    #: Roll of the car body, positive to the right, shape (V,); 0 if the track itself is used as the path.
    roll_deg: Floats
    reference: str = "antenna"  #: Reference point of the vehicle, to which `chainage_m` refers.
    #: Chainage of the midpoint between the bogies when the antenna is at the point, strictly rising, shape (V,). It
    #: relates the positions of two antennas on one vehicle. It is None without a vehicle.
    body_chainage_m: Floats | None = None
    facing: Literal["rising", "falling"] = "rising"  #: Whether the front points to rising or falling chainage.
    #: Distance from the midpoint between the bogies to the antenna, positive toward the vehicle's front.
    antenna_ahead_m: float = 0.0
    #: Distance from the midpoint between the bogies to the vehicle's front end; None if unknown.
    front_end_m: float | None = None
    #: Distance from the midpoint of the bogies to the vehicle's rear end; None if unknown.
    rear_end_m: float | None = None
    #: Distance between the wheels' contact points, over which cant is measured; None without a vehicle.
    contact_m: float | None = None
    sigma_plan_m: float = SIGMA_PLAN_M  #: Standard deviation of the map's error in plan, which the solution assumes.
    sigma_height_m: float = SIGMA_HEIGHT_M  #: Standard deviation of the map in height, used in the solution.
    notes: tuple[str, ...] = ()  #: Notes that are copied to every result.

    def __post_init__(self) -> None:
        points = len(self.ecef_m)
        if points < 2 or self.ecef_m.shape != (points, 3):
            raise ValueError(f"ecef_m has shape {self.ecef_m.shape}, expected (V, 3) with V of at least 2")
        for name in ("chainage_m", "kilometrage_m", "cant_m", "roll_deg"):
            if getattr(self, name).shape != (points,):
                raise ValueError(f"{name} has shape {getattr(self, name).shape}, expected ({points},)")
        if not np.isfinite(self.ecef_m).all():
            raise ValueError("ecef_m must be finite")
        freeze_arrays(self)
        if not (np.diff(self.chainage_m) > 0).all():
            i = int(np.argmin(np.diff(self.chainage_m)))
            raise ValueError(f"chainage_m must rise strictly; point {i + 1} at {self.chainage_m[i]:.3f} m does not")
        if not (self.length_m > 0).all():
            raise ValueError(f"point {int(np.argmin(self.length_m))} and the next point are equal")

    @classmethod
    def from_antenna_path(cls, track: Track) -> Trajectory:
        """Create a trajectory from a map that is itself the path of an antenna; a note states this assumption.

        In curves, the antenna's path differs from the track. `antenna_trajectory` computes the antenna's path.
        """
        check_type(track, Track, "track")
        return cls(
            name=track.name, ecef_m=track.ecef_m, chainage_m=track.chainage_m, kilometrage_m=track.kilometrage_m,
            cant_m=track.cant_m, roll_deg=read_only(np.zeros(len(track))), sigma_plan_m=track.sigma_plan_m,
            sigma_height_m=track.sigma_height_m, notes=(TRACK_AS_PATH, *track.provenance.notes),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.ecef_m)

    def __repr__(self) -> str:
        span = f"chainage {self.chainage_m[0]:,.1f} to {self.chainage_m[-1]:,.1f} m"
        return f'<Trajectory "{self.name}": {plural(self, "point")}, {span} of the {self.reference}>'

    @cached_property
    def length_m(self) -> Floats:
        """Length of each segment, shape (V - 1,) [m]."""
        return read_only(np.linalg.norm(np.diff(self.ecef_m, axis=0), axis=1))

    @cached_property
    def arc_m(self) -> Floats:
        """Arc length from the first point to each point, shape (V,) [m]."""
        return read_only(np.concatenate([[0.0], np.cumsum(self.length_m)]))

    @cached_property
    def joins_m(self) -> tuple[float, float]:
        """Arc lengths at which a closed line passes its start again, and its end again [m]; NaN at an open end."""
        return joins_m(self.arc_m, self.ecef_m)

    @cached_property
    def turn_m(self) -> float:
        """Length of a closed line [m]; infinite for an open line."""
        before, after = self.joins_m
        turns = (self.arc_m[-1] - after, before - self.arc_m[0])
        return float(np.nan_to_num(np.fmin(*turns), nan=np.inf))

    @cached_property
    def tangent(self) -> Floats:
        """Unit vector along each segment, shape (V - 1, 3)."""
        return read_only(np.diff(self.ecef_m, axis=0) / self.length_m[:, None])

    @cached_property
    def _axes(self) -> Floats:
        """Unit vectors east, north and up at the middle of each segment, shape (V - 1, 3, 3)."""
        return axes_at((self.ecef_m[1:] + self.ecef_m[:-1]) / 2.0)

    @cached_property
    def up(self) -> Floats:
        """Unit normal of the ellipsoid at the middle of each segment, shape (V - 1, 3)."""
        return read_only(np.ascontiguousarray(self._axes[:, 2]))

    @cached_property
    def across(self) -> Floats:
        """Horizontal unit vector to the right of each segment, shape (V - 1, 3)."""
        right = np.cross(self.tangent, self.up)
        return read_only(right / np.linalg.norm(right, axis=1, keepdims=True))

    def get_axes(self, segment: Indices) -> Floats:
        """Return the unit vectors along, across (to the right) and up of given segments, shape (n, 3, 3)."""
        return np.stack([self.tangent[segment], self.across[segment], self.up[segment]], axis=1)

    @cached_property
    def heading_deg(self) -> Floats:
        """Azimuth of each segment in the direction of rising chainage, clockwise from north, shape (V - 1,) [deg]."""
        enu = np.einsum("vij,vj->vi", self._axes, self.tangent)
        return read_only(np.degrees(np.arctan2(enu[:, 0], enu[:, 1])) % 360.0)

    @cached_property
    def gradient_permille(self) -> Floats:
        """Gradient of each segment in the direction of rising chainage, shape (V - 1,) [permille]."""
        enu = np.einsum("vij,vj->vi", self._axes, self.tangent)
        return read_only(1e3 * enu[:, 2] / np.hypot(enu[:, 0], enu[:, 1]))

    @property
    def front_sign(self) -> float:
        """Direction of the vehicle's front: 1 toward rising chainage, -1 toward falling chainage."""
        return 1.0 if self.facing == "rising" else -1.0

    def body_azimuth_deg(self, arc_m: ArrayLike) -> Floats:
        """Return the azimuth to which the vehicle's front points, clockwise from north [deg]; NaN if `arc_m` is NaN."""
        heading = self.heading_deg[self.segment_at(arc_m)[0]] + (0.0 if self.facing == "rising" else 180.0)
        return np.where(np.isfinite(np.asarray(arc_m, dtype=np.float64)), heading % 360.0, np.nan)

    @cached_property
    def _nearest(self) -> NearestOnPolyline:
        return NearestOnPolyline(self.ecef_m)

    def segment_at(self, arc_m: ArrayLike) -> tuple[Indices, Floats]:
        """Return the segments at arc lengths of any shape, and the distances along these segments [m].

        A point shared by two segments belongs to the later one. Before the start, the first segment and a negative
        distance are returned; beyond the end, the last segment; for NaN, the last segment and NaN.
        """
        arc = np.asarray(arc_m, dtype=np.float64)
        index = np.minimum(np.maximum(self.arc_m.searchsorted(arc, side="right") - 1, 0), len(self) - 2)
        return np.asarray(index, dtype=np.intp), arc - self.arc_m[index]

    def _interpolate(self, arc_m: ArrayLike, values: Floats) -> Floats:
        """Interpolate values, shape (V, ...), at arc lengths of any shape; NaN beyond the ends and for NaN input."""
        arc = np.asarray(arc_m, dtype=np.float64)
        return between_points(arc, self.arc_m, self.length_m, values, self.segment_at(arc)[0])

    def at_arc(self, arc_m: ArrayLike) -> Floats:
        """Interpolate the ECEF position at arc lengths, shape (..., 3) [m]; NaN beyond the ends and for NaN input."""
        return self._interpolate(arc_m, self.ecef_m)

    def chainage_at(self, arc_m: ArrayLike) -> Floats:
        """Interpolate the chainage of the reference point at arc lengths [m]; NaN beyond the ends and for NaN input."""
        return self._interpolate(arc_m, self.chainage_m)

    def body_at(self, arc_m: ArrayLike) -> Floats:
        """Interpolate the chainage of the midpoint between the bogies [m] at antenna arc lengths [m].

        The result is NaN without a vehicle, beyond the ends, and for NaN input.
        """
        if self.body_chainage_m is None:
            return np.full(np.shape(arc_m), np.nan)
        return self._interpolate(arc_m, self.body_chainage_m)

    def arc_of_body(self, body_chainage_m: ArrayLike) -> Floats:
        """Interpolate the antenna's arc length [m] at chainages of the midpoint between the bogies [m].

        The result is NaN without a vehicle, beyond the ends, and for NaN input.
        """
        if self.body_chainage_m is None:
            return np.full(np.shape(body_chainage_m), np.nan)
        return np.interp(
            np.asarray(body_chainage_m, dtype=np.float64), self.body_chainage_m, self.arc_m, left=np.nan, right=np.nan
        )

    def arc_at_chainage(self, chainage_m: ArrayLike) -> Floats:
        """Interpolate the arc length at chainages of the reference point [m]; NaN beyond the ends and for NaN input."""
        chainage = np.asarray(chainage_m, dtype=np.float64)
        first, last = self.chainage_m[0] - _END_TOLERANCE_M, self.chainage_m[-1] + _END_TOLERANCE_M
        inside = (chainage >= first) & (chainage <= last)
        return np.where(inside, np.interp(chainage, self.chainage_m, self.arc_m), np.nan)

    def kilometrage_at(self, arc_m: ArrayLike) -> Floats:
        """Interpolate the kilometrage at arc lengths [m], but not across breaks; NaN where unknown."""
        return interpolate_kilometrage(self.chainage_at(arc_m), self.chainage_m, self.kilometrage_m)

    def nearest(self, ecef_m: ArrayLike) -> tuple[Floats, Floats]:
        """Return each position's nearest point as an arc length, and the distance to this point, shape (n,) each [m].

        Positions have shape (n, 3). The search is exact: a k-d tree provides candidates, and a bound excludes all other
        segments. Of equally near points, the first on the line is returned. Both results are NaN where the position is
        NaN.
        """
        index, along, offset = self._nearest(ecef_m)
        return self.arc_m[np.maximum(index, 0)] + along, offset  # `along` is NaN where no segment was found


def between_points(arc: Floats, arc_m: Floats, length_m: Floats, values: Floats, section: Indices) -> Floats:
    """Interpolate values (V, ...) at arc lengths on the segments `section`; NaN beyond the ends of these segments."""
    length = length_m[section]
    share, beyond = (arc - arc_m[section]) / length, _END_TOLERANCE_M / length
    share = np.where((share < -beyond) | (share > 1.0 + beyond), np.nan, share)
    if values.ndim > 1:
        share = share[..., None]
    # this form is exact at both ends of a segment
    return np.asarray((1.0 - share) * values[section] + share * values[section + 1])
