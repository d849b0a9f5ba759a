"""How good were the positions: the error along the line against a reference.

The error is the distance along the map between the answer and the reference's own point on it,
positive toward the end of the line (P1 3.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

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
    arc_m: Floats, reference_ecef_m: Floats, trajectory: Trajectory, *, same_place_m: float = 30.0
) -> Floats:
    """Signed distance on the map from the reference's point to the answer, shape (T,) [m].

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
    trajectory : Trajectory
    same_place_m : float
        Passes of the map up to this far from the reference are its place.

    Returns
    -------
    ndarray, shape (T,) [m]
        + toward the end of the line (P1 3.3); NaN where either is missing.
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
    passing[1:] &= ~joined | (away[1:] <= away[:-1])
    passing[:-1] &= ~joined | (away[:-1] <= away[1:])
    signed = np.concatenate([arc_m[at] - nearest_arc, (arc_m[at][which] - trajectory.arc_m[section] - foot)[passing]])
    owner = np.concatenate([np.arange(len(at)), which[passing]])
    order = np.lexsort((np.abs(signed), owner))
    first = order[np.flatnonzero(np.r_[True, owner[order][1:] != owner[order][:-1]])]
    error[at[owner[first]]] = signed[first]
    straight = np.linalg.norm(trajectory.at_arc(arc_m[at]) - trajectory.at_arc(nearest_arc), axis=1)
    error[at] = np.copysign(np.minimum(np.abs(error[at]), straight), error[at])
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
