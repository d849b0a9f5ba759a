"""The error along the line against a reference.

The error is the distance along the map between the answer and the reference's own point on it,
positive toward the end of the line (P1 3.3).

Linear interpolation of a reference trajectory at other times.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy.spatial import cKDTree

from railfix.core.arrays import Datetimes, Floats, Indices, Masks
from railfix.core.timescale import seconds
from railfix.track.polyline import short_way_m
from railfix.track.trajectory import Trajectory

#: Longest gap of a reference that is interpolated over [s].
LARGEST_GAP_S = 2.5


@dataclass(frozen=True, kw_only=True)
class Bracket:
    """Neighbouring instants of the reference for each of T times."""

    #: The same where a time is one of the reference, shape (T,).
    left: Indices
    right: Indices
    share: Floats  #: 0 at left, 1 at right; shape (T,).
    inside: Masks  #: False before the first, after the last, and in gaps of the reference; shape (T,).

    def of(self, values: Floats) -> Floats:
        """Values of the reference, shape (R,) or (R, n), interpolated linearly; NaN where not inside."""
        across = (-1, *(1,) * (values.ndim - 1))
        between = values[self.left] + self.share.reshape(across) * (values[self.right] - values[self.left])
        return np.where(self.inside.reshape(across), between, np.nan)

    @property
    def nearest(self) -> Indices:
        """Index of the nearer instant, shape (T,)."""
        return np.where(self.share <= 0.5, self.left, self.right)


def bracket(time: Datetimes, reference_time: Datetimes, *, largest_gap_s: float = LARGEST_GAP_S) -> Bracket:
    """Neighbouring instants of a reference, rising and at least two, for each time.

    Raises
    ------
    ValueError
        Fewer than two instants of the reference.
    """
    if len(reference_time) < 2:
        raise ValueError(f"reference_time has {len(reference_time)} instants, at least two were expected")
    last = len(reference_time) - 1
    after = np.searchsorted(reference_time, time, side="left")
    exact = (after <= last) & (reference_time[np.minimum(after, last)] == time)
    right = np.clip(after, 1, last)
    left = right - 1
    step = seconds(reference_time[right] - reference_time[left])
    share = seconds(time - reference_time[left]) / step
    inside = (after > 0) & (after <= last) & (step <= largest_gap_s)
    at = np.minimum(after, last)
    return Bracket(
        left=np.where(exact, at, left),
        right=np.where(exact, at, right),
        share=np.where(exact, 0.0, share),
        inside=inside | exact,
    )


def interpolate_reference(
    time: Datetimes,
    reference_time: Datetimes,
    reference_ecef_m: Floats,
    *,
    largest_gap_s: float = LARGEST_GAP_S,
) -> Floats:
    """Reference positions at other times, linearly, shape (T, 3) [m]; NaN outside and in gaps.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    reference_time : ndarray of datetime64[ns], shape (R,)
        Rising.
    reference_ecef_m : ndarray, shape (R, 3) [m]
    largest_gap_s : float
        Longest step of the reference that is bridged.
    """
    return bracket(time, reference_time, largest_gap_s=largest_gap_s).of(reference_ecef_m)


def along_track_error(
    arc_m: Floats, reference_ecef_m: Floats, trajectory: Trajectory, *, same_place_m: float = 30.0
) -> Floats:
    """Signed distance on the map from the reference's point to the answer, + toward the end of the line (P1 3.3).

    The distance along the line. Where the map passes the reference's place more than once (laps, a
    road's two carriageways) the pass nearest to the answer counts: which of them it was, one epoch
    of ranges cannot tell. And where the line comes back to near itself (a crossing), the straight
    distance between the two points counts if it is shorter. On a line that passes every place once
    neither has an effect, but for the chord of a curve.

    Parameters
    ----------
    arc_m : ndarray, shape (T,) [m]
        Answers along the trajectory; NaN where there is none.
    reference_ecef_m : ndarray, shape (T, 3) [m]
    same_place_m : float
        Passes of the map up to this far from the reference are its place.

    Returns
    -------
    ndarray, shape (T,) [m]
        NaN where either is missing.
    """
    error = np.full(len(arc_m), np.nan)
    at = np.flatnonzero(np.isfinite(arc_m) & np.isfinite(reference_ecef_m[:, 0]))
    if not len(at):
        return error
    reference, length = reference_ecef_m[at], trajectory.length_m
    nearest_arc, offset = trajectory.nearest(reference)
    middle = 0.5 * (trajectory.ecef_m[1:] + trajectory.ecef_m[:-1])
    lists = cKDTree(middle).query_ball_point(
        reference, np.maximum(same_place_m, offset) + 0.5 * length.max(), return_sorted=True
    )
    which = np.repeat(np.arange(len(at)), [len(x) for x in lists])
    section = np.fromiter(chain.from_iterable(lists), dtype=np.intp, count=len(which))
    delta = reference[which] - trajectory.ecef_m[section]
    along = np.einsum("pi,pi->p", delta, trajectory.tangent[section])
    foot = np.clip(along, 0.0, length[section])
    away = np.linalg.norm(delta - foot[:, None] * trajectory.tangent[section], axis=1)
    # A pass is a local minimum of the distance along the line: no neighbouring section comes nearer.
    joined = (which[1:] == which[:-1]) & (section[1:] == section[:-1] + 1)
    passing = away <= same_place_m
    if np.isfinite(trajectory.turn_m):  # the ends of a closed line are no passes: it goes on there
        passing &= ~((section == 0) & (along <= 0.0))
        passing &= ~((section == len(length) - 1) & (along >= length[-1]))
    passing[1:] &= ~joined | (away[1:] <= away[:-1])
    passing[:-1] &= ~joined | (away[:-1] <= away[1:])
    signed = np.concatenate([arc_m[at] - nearest_arc, (arc_m[at][which] - trajectory.arc_m[section] - foot)[passing]])
    owner = np.concatenate([np.arange(len(at)), which[passing]])
    signed = short_way_m(signed, trajectory.turn_m)
    order = np.lexsort((np.abs(signed), owner))
    first = order[np.flatnonzero(np.r_[True, owner[order][1:] != owner[order][:-1]])]
    error[at[owner[first]]] = signed[first]
    straight = np.linalg.norm(trajectory.at_arc(arc_m[at]) - trajectory.at_arc(nearest_arc), axis=1)
    error[at] = np.copysign(np.minimum(np.abs(error[at]), straight), error[at])
    return error


def straight_distance(arc_m: Floats, reference_ecef_m: Floats, trajectory: Trajectory) -> Floats:
    """Straight distance between positions on the map and the reference's nearest point on the map, shape (T,) [m].

    It needs no choice between several passes of the line at one place, and never exceeds the distance along the line.
    NaN where the position or the reference, shape (T, 3), is missing.
    """
    distance = np.full(len(arc_m), np.nan)
    rows = np.flatnonzero(np.isfinite(arc_m) & np.isfinite(reference_ecef_m[:, 0]))
    if len(rows):
        nearest, _ = trajectory.nearest(reference_ecef_m[rows])
        distance[rows] = np.linalg.norm(trajectory.at_arc(arc_m[rows]) - trajectory.at_arc(nearest), axis=1)
    return distance
