"""Smoothed positions: filter estimates combined with all later measurements (docs/filter-equations.md).

The smoother has the adjoint form of G. J. Bierman, Fixed interval smoothing with discrete measurements, 1973,
doi:10.1080/00207177308932424. It uses the measurement weights of the filter, and follows the hypothesis reported at the
last epoch backward to its beginning. Information of later epochs is not propagated beyond this beginning.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Floats, Strings
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import EPOCH
from railfix.tracking.chunk import compute_singer_step
from railfix.tracking.filter import Step
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.state import TrackState


def _carry_through_measurements(step: Step, h: int, vector: Floats, matrix: Floats) -> tuple[Floats, Floats]:
    """Propagate later information on hypothesis `h` backward through the measurements of an epoch."""
    from railfix.kernels.tracking.backward import before_measurements

    made = step.trace
    if made is not None:
        vector, matrix = before_measurements(
            made.prior[h], made.row[h], made.value[h], made.variance[h], vector, matrix
        )
    part = None if step.splits is None else step.splits[h]
    if part is not None:
        # A split acts as a position measurement: density of the narrow hypothesis divided by density of the wide one.
        place = ix.ARC
        wide = part.covariance[place, place]
        back = np.eye(len(vector))
        share = (1.0 - constants.START_SIGMA_M**2 / wide) / wide
        back[place] -= share * part.covariance[place]
        vector, matrix = back @ vector, back @ matrix @ back.T
        vector[place] += (part.place_m - part.mean[place]) / wide
        matrix[place, place] += share
    return vector, matrix


def transition(mean: Floats, dt: float, limits: TrackingLimits) -> Floats:
    """Return the transition matrix over the interval `dt` [s], shape (N, N), for the state `mean`, shape (N,)."""
    from railfix.kernels.tracking.backward import transition_matrix

    epoch = np.zeros(1, dtype=EPOCH)
    epoch["interval_s"], epoch["step"] = dt, compute_singer_step(dt, limits.acceleration_mps2, limits.acceleration_s)[0]
    return transition_matrix(float(mean[ix.SPEED]), epoch[0], len(mean))


@dataclass(frozen=True, kw_only=True)
class BackwardInformation:
    """Information from all later epochs about the unknowns at the end of an epoch."""

    place_m: float  #: Arc length of the hypothesis that continues in later epochs; NaN if there is none.
    vector: Floats  #: Information vector of the unknowns, shape (N,).
    matrix: Floats  #: Information matrix of the unknowns, shape (N, N).
    satellite: Strings  #: Satellites whose errors are among the unknowns, shape (N - ix.SATELLITES,).


@dataclass(frozen=True, kw_only=True)
class Smoothed:
    """Smoothed positions of T epochs; NaN where the filter has no position."""

    arc_m: Floats  #: Arc length, shape (T,).
    sigma_m: Floats  #: Standard deviation of the arc length, shape (T,).
    speed_mps: Floats  #: Speed along the line, shape (T,).


def smooth_steps(
    steps: list[Step], before: TrackState, later: BackwardInformation | None, limits: TrackingLimits
) -> tuple[Smoothed, BackwardInformation]:
    """Return the smoothed positions of a chunk, and information to pass to the previous chunk (G. J. Bierman, 1973).

    Parameters
    ----------
    steps : list of Step
        Trace of `railfix.tracking.track`, one step per epoch.
    before : TrackState
        State before the chunk.
    later : BackwardInformation or None
        Information from the next chunk; None for the last chunk.
    limits : TrackingLimits
    """
    size = len(steps)
    satellite = steps[-1].satellite if size else before.satellite
    width = ix.SATELLITES + len(satellite)
    arc, sigma, speed = np.full(size, np.nan), np.full(size, np.nan), np.full(size, np.nan)
    vector, matrix, index = np.zeros(width), np.zeros((width, width)), 0
    last = steps[-1].mean if size else before.mean
    if later is not None and np.isfinite(later.place_m) and len(last):
        index = int(np.argmin(np.abs(last[:, ix.ARC] - later.place_m)))
        vector, matrix = _arrange(later, satellite)
    for t in range(size - 1, -1, -1):
        step = steps[t]
        if step.trace is None:
            vector, matrix, index = np.zeros(width), np.zeros((width, width)), 0
            continue
        mean, covariance = step.mean[index], step.covariance[index]
        row = covariance[ix.ARC]
        variance = row[ix.ARC] - row @ matrix @ row + _ionosphere_m2(step, index, vector, matrix, limits.slow_code_m)
        if covariance[ix.ARC, ix.ARC] <= constants.EXPIRED_SIGMA_M**2:
            arc[t], sigma[t] = mean[ix.ARC] + row @ vector, np.sqrt(max(variance, 0.0))
            speed[t] = mean[ix.SPEED] + covariance[ix.SPEED] @ vector
        vector, matrix = _carry_through_measurements(step, index, vector, matrix)
        parent, restarted = int(step.parent[index]), step.trace.restarted[index]
        earlier = steps[t - 1].mean if t else before.mean
        if parent < 0 or parent >= len(earlier):
            vector, matrix, index = np.zeros(width), np.zeros((width, width)), 0
            continue
        start = np.zeros(width)
        start[: earlier.shape[1]] = earlier[parent]
        move = transition(start, step.dt, limits)
        move[restarted] = 0.0
        vector, matrix, index = move.T @ vector, move.T @ matrix @ move, parent
    place = float(before.mean[index, ix.ARC]) if len(before.mean) > index else float("nan")
    known = len(before.satellite)
    return Smoothed(arc_m=arc, sigma_m=sigma, speed_mps=speed), BackwardInformation(
        place_m=place, vector=vector[: ix.SATELLITES + known],
        matrix=matrix[: ix.SATELLITES + known, : ix.SATELLITES + known], satellite=before.satellite,
    )  # fmt: skip


def _ionosphere_m2(step: Step, h: int, vector: Floats, matrix: Floats, quiet_m: float) -> float:
    """Return the increase of the variance along the line [m^2] by a disturbed ionosphere; 0 for a quiet ionosphere."""
    both = step.covariance[h][[ix.ARC, ix.SLOW_CODE]]
    P = both[:, [ix.ARC, ix.SLOW_CODE]] - both @ matrix @ both.T
    less = (1.0 - max(step.tilt_scale, 1.0) ** -2) / quiet_m**2
    gain = P[0, 1] * less / (1.0 - less * P[1, 1])  # as in `widen_slow_code` of the filter
    return float(gain * P[0, 1] + (gain * (step.mean[h, ix.SLOW_CODE] + both[1] @ vector)) ** 2)


def _arrange(later: BackwardInformation, satellite: Strings) -> tuple[Floats, Floats]:
    """Return information vector and matrix in the order of given satellites, zero for satellites not in `later`."""
    _, here, there = np.intersect1d(satellite, later.satellite, return_indices=True)
    to = np.concatenate([np.arange(ix.SATELLITES), ix.SATELLITES + here])
    of = np.concatenate([np.arange(ix.SATELLITES), ix.SATELLITES + there])
    width = ix.SATELLITES + len(satellite)
    vector, matrix = np.zeros(width), np.zeros((width, width))
    vector[to] = later.vector[of]
    matrix[np.ix_(to, to)] = later.matrix[np.ix_(of, of)]
    return vector, matrix
