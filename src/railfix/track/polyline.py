"""Exact nearest points of a polyline for many positions, and joins of lines that close on themselves."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from railfix.core.arrays import Floats, Indices, Masks

#: Samples examined in the first round; four times as many for positions not yet proven.
_FIRST_CANDIDATES = 6
#: Positions times candidates processed at once.
_CHUNK = 2_000_000


def short_way_m(difference_m: Floats, turn_m: float) -> Floats:
    """Difference of places the short way round a closed line of the length `turn_m`; as it is where that is infinite.

    NaN stay NaN.
    """
    return difference_m - turn_m * np.round(difference_m / turn_m) if np.isfinite(turn_m) else difference_m


def project_on_segments(points_m: Floats, start_m: Floats, step_m: Floats) -> tuple[Floats, Floats]:
    """Find the nearest point of segments: its fraction of the segment in [0, 1], and the distance.

    Position, first point of the segment, and first to last point are of shapes that broadcast to (..., 3).
    """
    offset = points_m - start_m
    squared = np.einsum("...i,...i->...", step_m, step_m)
    share = np.clip(np.einsum("...i,...i->...", offset, step_m) / squared, 0.0, 1.0)
    rest = offset - share[..., None] * step_m
    return share, np.sqrt(np.einsum("...i,...i->...", rest, rest))


class NearestOnPolyline:
    """Search structure for nearest points of a polyline of V points, shape (V, 3).

    The polyline is sampled so that each of its points is within `reach_m` of a sample of the same
    segment. The segment of the nearest point therefore has a sample within the best distance found
    plus `reach_m`, which either proves the result or requires more candidates.
    """

    def __init__(self, points_m: Floats) -> None:
        self._start = points_m[:-1]
        self._step = np.diff(points_m, axis=0)
        self._length = np.linalg.norm(self._step, axis=1)
        spacing = max(float(np.median(self._length)), float(self._length.sum()) / (4 * len(points_m)), 1e-3)
        pieces = np.maximum(np.ceil(self._length / spacing).astype(np.int64), 1)
        first = np.cumsum(pieces) - pieces
        self._segment = np.repeat(np.arange(len(pieces)), pieces)
        share = (np.arange(pieces.sum()) - first[self._segment] + 0.5) / pieces[self._segment]
        #: Half the spacing of the samples, which lie in the middle of their pieces [m].
        self.reach_m = float((self._length / pieces).max()) / 2.0 * (1.0 + 1e-9)
        self._tree = cKDTree(self._start[self._segment] + share[:, None] * self._step[self._segment])

    def __call__(self, ecef_m: ArrayLike) -> tuple[Indices, Floats, Floats]:
        """Segment, distance along it and distance from it, shapes (n,); -1 and NaN for NaN."""
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
        """Find the best among the segments of the nearest samples, and whether no other can be better."""
        nearest = self._tree.query(points, k=np.arange(1, candidates + 1))
        distance, sample = np.asarray(nearest[0], dtype=np.float64), np.asarray(nearest[1], dtype=np.intp)
        chosen, share, best = nearest_segments(points, self._segment[sample], self._start, self._step)
        proven = (distance[:, -1] > best + self.reach_m) | (candidates == len(self._segment))
        return chosen, share * self._length[chosen], best, proven


def nearest_segments(
    points_m: Floats, segment: Indices, start_m: Floats, step_m: Floats
) -> tuple[Indices, Floats, Floats]:
    """Find the nearest of some segments to each point; of equally near ones the one earlier on the line.

    Parameters
    ----------
    points_m : ndarray, shape (n, 3) [m]
    segment : ndarray of int, shape (n, C)
        Segments to look at, for each point.
    start_m, step_m : ndarray, shape (V - 1, 3) [m]
        First point of each segment, and from there to its last.

    Returns
    -------
    segment : ndarray of int, shape (n,)
    share : ndarray, shape (n,)
        Place on it, 0 to 1.
    offset_m : ndarray, shape (n,) [m]
        Distance from it.
    """
    share, offset = project_on_segments(points_m[:, None], start_m[segment], step_m[segment])
    best = offset.min(axis=1)
    # independent of the order of the tree that has named the segments
    place = np.where(offset <= best[:, None] * (1 + 1e-12) + 1e-9, segment + share, np.inf)
    column = np.argmin(place, axis=1)[:, None]
    return (
        np.take_along_axis(segment, column, axis=1)[:, 0],
        np.take_along_axis(share, column, axis=1)[:, 0],
        best,
    )


#: A line goes on where its end comes this close to another place of it [m]: no other track is as near.
_CLOSED_M: Final = 3.0
#: In the same direction: cosine of the angle between them.
_SAME_WAY: Final = 0.9
#: Places this near along the line are the end itself [m].
_END_M: Final = 100.0


def joins_m(arc_m: Floats, ecef_m: Floats) -> tuple[float, float]:
    """Return the arc lengths at which a closed line goes on before its start and after its end; NaN at an open end.

    From the rising arc lengths of V points and the points, shape (V, 3).
    """
    segment = np.diff(ecef_m, axis=0)
    segment /= np.linalg.norm(segment, axis=1, keepdims=True)
    return _beside(arc_m, ecef_m, segment, 0), _beside(arc_m, ecef_m, segment, -1)


def _beside(arc_m: Floats, ecef_m: Floats, segment: Floats, end: int) -> float:
    """Arc length of the nearest other place of the line to one of its ends, in the same direction; NaN without."""
    from_end = ecef_m[end] - ecef_m[:-1]
    length = np.diff(arc_m)
    along = np.clip((from_end * segment).sum(axis=1), 0.0, length)
    apart = np.linalg.norm(from_end - along[:, None] * segment, axis=1)
    arc = arc_m[:-1] + along
    other = np.abs(arc - arc_m[end]) > _END_M
    other &= (apart < _CLOSED_M) & (segment @ segment[end] > _SAME_WAY)
    return float(arc[other][np.argmin(apart[other])]) if other.any() else float("nan")
