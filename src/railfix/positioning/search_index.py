"""Search structures of a trajectory: k-d tree of its points, and stretches of different lengths."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import scipy

from railfix import kernels
from railfix.core.arrays import Floats, Indices
from railfix.core.constants import FAN_OUT
from railfix.track.trajectory import Trajectory


class SearchIndex:
    """K-d tree and stretches of a trajectory."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        self.middle_ecef_m = trajectory.ecef_m.mean(axis=0)  #: Mean of the trajectory points, shape (3,).
        self._clear_m = np.full(len(trajectory.length_m), np.nan)
        points = trajectory.ecef_m
        self.tree = scipy.spatial.cKDTree(points)  #: k-d tree of the trajectory points.
        #: For each stretch length: index of the middle point of each stretch, and radius [m] around it that contains
        #: the stretch.
        self.levels: list[tuple[Indices, Floats]] = []
        count, size = len(points), 1
        while True:
            starts = np.arange(0, count, size)
            middle = np.minimum(starts + size // 2, count - 1)
            away = np.linalg.norm(points - points[np.repeat(middle, size)[:count]], axis=1)
            self.levels.append((middle, np.maximum.reduceat(away, starts)))
            if len(starts) <= FAN_OUT:
                break
            size *= FAN_OUT

    @cached_property
    def stretches(self) -> tuple[Indices, Floats, Indices]:
        """Middle points and radii [m] of all stretches, shape (S,), and index of the first stretch of each length."""
        middles, radii = zip(*self.levels, strict=True)
        return np.concatenate(middles), np.concatenate(radii), np.cumsum([0, *map(len, middles)])

    @cached_property
    def arc_of_points_m(self) -> Floats:
        """Arc length of each point, shape (V,) [m]; the smallest if the line passes the point several times."""
        return self.trajectory.nearest(self.trajectory.ecef_m)[0]

    def clear_of_tangent_m(self, arc_m: Floats) -> Floats:
        """Return the horizontal distance from each position within which the line follows its tangent, shape (T,) [m].

        The distance is at most `CLEAR_M`, and equal for all positions on a section.
        """
        line = self.trajectory
        section = line.segment_at(arc_m)[0]
        unknown = np.isnan(self._clear_m[section])
        if unknown.any():
            new = np.unique(section[unknown])
            self._clear_m[new] = kernels.search.clear_of_sections(
                line.ecef_m, line.tangent, line.across, line.length_m, self.stretches, new
            )
        return np.asarray(self._clear_m[section])
