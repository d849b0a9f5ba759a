"""How good were the positions: the error along the line against a reference.

The error is the distance along the map between the answer and the reference's own point on it,
positive toward the end of the line (P1 3.3). Where the map passes the reference several times
(laps, loops), the pass nearest to the answer counts: which lap it is, ranges cannot tell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from railfix.antenna import Trajectory
from railfix.timescale import seconds

Floats = NDArray[np.float64]

#: Distance on the map from which on an answer is in the wrong place [m].
WRONG_PLACE_M = 50.0


@dataclass(frozen=True, kw_only=True)
class Score:
    """Figures of merit of a run.

    Attributes
    ----------
    epochs : int
        Epochs with observations inside the time of the reference.
    positions : int
        Those with coordinates.
    rate : float
        positions / epochs.
    mean_m, std_m : float [m]
        Of the signed error.
    p50_m, p95_m, max_m : float [m]
        Of the absolute error.
    wrong_place : float
        Share of the positions more than `WRONG_PLACE_M` from the reference.
    """

    epochs: int
    positions: int
    rate: float
    mean_m: float
    std_m: float
    p50_m: float
    p95_m: float
    max_m: float
    wrong_place: float


def interpolate_reference(
    time: NDArray[np.datetime64],
    reference_time: NDArray[np.datetime64],
    reference_ecef_m: Floats,
    *,
    largest_gap_s: float = 2.5,
) -> Floats:
    """Reference positions at other times, linearly; NaN outside and in gaps.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    reference_time : ndarray of datetime64[ns], shape (R,)
        Rising.
    reference_ecef_m : ndarray, shape (R, 3) [m]
    largest_gap_s : float
        Longest step of the reference that is bridged.

    Returns
    -------
    ndarray, shape (T, 3) [m]
    """
    after = np.searchsorted(reference_time, time, side="left")
    exact = (after < len(reference_time)) & (reference_time[np.minimum(after, len(reference_time) - 1)] == time)
    inside = (after > 0) & (after < len(reference_time))
    right = np.clip(after, 1, len(reference_time) - 1)
    left = right - 1
    step = seconds(reference_time[right] - reference_time[left])
    part = seconds(time - reference_time[left]) / step
    between = reference_ecef_m[left] + part[:, None] * (reference_ecef_m[right] - reference_ecef_m[left])
    between[~(inside & (step <= largest_gap_s))] = np.nan
    between[exact] = reference_ecef_m[after[exact]]
    return between


def along_track_error(
    arc_m: Floats, reference_ecef_m: Floats, trajectory: Trajectory, *, same_place_m: float = 10.0
) -> Floats:
    """Signed distance along the trajectory from the reference's point to the answer, shape (T,) [m].

    Parameters
    ----------
    arc_m : ndarray, shape (T,) [m]
        Answers along the trajectory; NaN where there is none.
    reference_ecef_m : ndarray, shape (T, 3) [m]
    trajectory : Trajectory
    same_place_m : float
        Passes of the map no further from the reference than its nearest point plus this are the
        reference's place too.

    Returns
    -------
    ndarray, shape (T,) [m]
        NaN where either is missing.
    """
    error = np.full(len(arc_m), np.nan)
    at = np.flatnonzero(np.isfinite(arc_m) & np.isfinite(reference_ecef_m[:, 0]))
    if not len(at):
        return error
    points, length = trajectory.ecef_m, trajectory.length_m
    _, offset = trajectory.nearest(reference_ecef_m[at])
    reach = offset + same_place_m
    middle = 0.5 * (points[1:] + points[:-1])
    lists = cKDTree(middle).query_ball_point(reference_ecef_m[at], reach + 0.5 * length.max())
    which = np.repeat(np.arange(len(at)), [len(x) for x in lists])
    section = np.concatenate([np.asarray(x, dtype=np.intp) for x in lists])
    delta = reference_ecef_m[at][which] - points[section]
    foot = np.clip(np.einsum("pi,pi->p", delta, trajectory.tangent[section]), 0.0, length[section])
    away = np.linalg.norm(delta - foot[:, None] * trajectory.tangent[section], axis=1)
    signed = arc_m[at][which] - (trajectory.arc_m[section] + foot)
    size = np.where(away <= reach[which] + 1e-6, np.abs(signed), np.inf)
    order = np.lexsort((size, which))
    first = order[np.flatnonzero(np.r_[True, which[order][1:] != which[order][:-1]])]
    error[at[which[first]]] = signed[first]
    return error


def score(error_m: Floats, observed: NDArray[np.bool_]) -> Score:
    """Figures of merit from signed errors.

    Parameters
    ----------
    error_m : ndarray, shape (T,) [m]
        NaN where there is no position.
    observed : ndarray of bool, shape (T,)
        Epochs with observations inside the time of the reference.

    Raises
    ------
    ValueError
        No epoch is observed.
    """
    if not observed.any():
        raise ValueError("no epoch with observations lies inside the time of the reference")
    values = error_m[observed & np.isfinite(error_m)]
    size = np.abs(values) if len(values) else np.array([np.nan])
    return Score(
        epochs=int(observed.sum()),
        positions=len(values),
        rate=len(values) / int(observed.sum()),
        mean_m=float(values.mean()) if len(values) else float("nan"),
        std_m=float(values.std()) if len(values) else float("nan"),
        p50_m=float(np.median(size)),
        p95_m=float(np.percentile(size, 95)),
        max_m=float(size.max()),
        wrong_place=float(np.mean(size > WRONG_PLACE_M)),
    )
