"""Section search by definition: the fit of every point of the trajectory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from railfix.positioning.range_arrays import Ranges
from railfix.track.trajectory import Trajectory
from raim_oracle import range_on_turning_earth


def exhaustive_search(ranges: Ranges, trajectory: Trajectory) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return q at every point of the trajectory: the least weighted sum of squares over all clocks.

    Returns
    -------
    vertex : ndarray of int, shape (T,)
        Point with the least q, -1 where no range is redundant with the clocks.
    q : ndarray, shape (T, V)
    """
    points = trajectory.ecef_m
    q = np.empty((len(ranges), len(points)))
    vertex = np.full(len(ranges), -1)
    for t in range(len(ranges)):
        used = np.flatnonzero(ranges.weight[t] > 0)
        if not len(used):
            q[t] = 0.0
            continue
        weight = ranges.weight[t, used]
        clock = np.array([next(g for g, s in enumerate(ranges.groups) if s.start <= c < s.stop) for c in used])
        distance = np.stack([range_on_turning_earth(sat, points)[0] for sat in ranges.sat_ecef_m[t, used]], axis=1)
        misfit = ranges.code_m[t, used] - distance
        design = (clock[:, None] == np.unique(clock)).astype(float)
        prior = np.zeros(design.shape[1])
        if ranges.ties is not None:  # one clock, and offsets with a prior, in units of their standard deviations
            misfit -= ranges.ties.offset_m[t, clock]
            design = np.column_stack([design * ranges.ties.sigma_m[t, np.unique(clock)], np.ones(len(used))])
            prior = np.array([*np.ones(design.shape[1] - 1), 0.0])
        misfit -= misfit.mean(axis=1, keepdims=True)
        normal = np.linalg.pinv(design.T @ (design * weight[:, None]) + np.diag(prior), hermitian=True)
        of_clocks = misfit @ (design * weight[:, None])
        q[t] = (weight * misfit**2).sum(axis=1) - np.einsum("vi,ij,vj->v", of_clocks, normal, of_clocks)
        if ranges.n_used[t] > ranges.n_clocks[t]:
            vertex[t] = np.argmin(q[t])
    return vertex, q
