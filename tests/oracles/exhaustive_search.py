"""Section search by definition: the fit of every point of the trajectory."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.positioning.normal_equations import misfit
from railfix.positioning.range_arrays import Ranges
from railfix.track.trajectory import Trajectory


def exhaustive_search(ranges: Ranges, trajectory: Trajectory) -> tuple[Indices, Floats]:
    """Return q at every point of the trajectory: the definition that `search` is held against.

    Returns
    -------
    vertex : ndarray of int, shape (T,)
        Point with the least q, -1 where no range is redundant with the clocks.
    q : ndarray, shape (T, V)
    """
    points = trajectory.ecef_m
    q = np.empty((len(ranges), len(points)))
    for t in range(len(ranges)):
        q[t] = misfit(ranges.take(np.full(len(points), t)), points)
    return np.where(ranges.n_used > ranges.n_clocks, np.argmin(q, axis=1), -1), q
