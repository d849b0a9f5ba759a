"""Segments of a trajectory near positions."""

from __future__ import annotations

from itertools import chain
from typing import NamedTuple

import numpy as np
import scipy

from railfix.core.arrays import Floats, Indices, Masks
from railfix.track.trajectory import Trajectory


class Passes(NamedTuple):
    """P pairs of a position and a segment near it, sorted by position and segment; shapes (P,) unless stated."""

    position: Indices  #: Index of the position.
    segment: Indices  #: Index of the segment.
    #: Distance from the start of the segment to the position's projection on the extended segment.
    along_m: Floats
    foot_m: Floats  #: Distance from the start of the segment to the point of the segment nearest to the position.
    offset_m: Floats  #: Vector from the segment's nearest point to the position, shape (P, 3).
    lowest: Masks  #: True if neither the previous nor the next segment is nearer to the position.
    again: Masks  #: True if the previous segment has the same nearest point.


def find_segments_near(ecef_m: Floats, trajectory: Trajectory, reach_m: Floats | float) -> Passes:
    """Find the segments within `reach_m` of each position, shape (n, 3).

    A segment is found if its middle is within `reach_m` plus half the length of the longest segment. Some segments are
    therefore farther away than `reach_m`.
    """
    length, tangent = trajectory.length_m, trajectory.tangent
    middle = 0.5 * (trajectory.ecef_m[1:] + trajectory.ecef_m[:-1])
    reach = np.broadcast_to(reach_m + 0.5 * length.max(), len(ecef_m))
    lists = scipy.spatial.cKDTree(middle).query_ball_point(ecef_m, reach, return_sorted=True)
    position = np.repeat(np.arange(len(ecef_m)), [len(x) for x in lists])
    segment = np.fromiter(chain.from_iterable(lists), dtype=np.intp, count=len(position))
    delta = ecef_m[position] - trajectory.ecef_m[segment]
    along = np.einsum("pi,pi->p", delta, tangent[segment])
    foot = np.clip(along, 0.0, length[segment])
    offset = delta - foot[:, None] * tangent[segment]
    away = np.linalg.norm(offset, axis=1)
    joined = (position[1:] == position[:-1]) & (segment[1:] == segment[:-1] + 1)
    lowest, again = np.ones(len(position), dtype=np.bool_), np.zeros(len(position), dtype=np.bool_)
    lowest[1:] &= ~joined | (away[1:] <= away[:-1])
    lowest[:-1] &= ~joined | (away[:-1] <= away[1:])
    again[1:] = joined & (away[1:] == away[:-1])
    return Passes(position, segment, along, foot, offset, lowest, again)


def short_distance_m(difference_m: Floats, turn_m: float) -> Floats:
    """Return differences of arc length along the shorter part of a closed line.

    `turn_m` is the length of the closed line. For an open line, `turn_m` is infinite, and differences are unchanged.
    """
    return difference_m - turn_m * np.round(difference_m / turn_m) if np.isfinite(turn_m) else difference_m
