"""How good were the positions: the error along the line against a reference.

The error is the distance on the map between the answer and the reference's own point on it,
positive toward the end of the line (P1 3.3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


def along_track_error(arc_m: Floats, reference_ecef_m: Floats, trajectory: Trajectory) -> Floats:
    """Signed distance on the map from the reference's point to the answer, shape (T,) [m].

    The reference's point is the nearest one of the trajectory. The size is the straight distance
    between the two points - along the line on any stretch of railway, and the metres between the
    branches where a line passes the same place twice and the answer is on the other branch. The
    sign is that of the distance along the line, + toward its end (P1 3.3).

    Parameters
    ----------
    arc_m : ndarray, shape (T,) [m]
        Answers along the trajectory; NaN where there is none.
    reference_ecef_m : ndarray, shape (T, 3) [m]
    trajectory : Trajectory

    Returns
    -------
    ndarray, shape (T,) [m]
        NaN where either is missing.
    """
    reference_arc, _ = trajectory.nearest(reference_ecef_m)
    apart = np.linalg.norm(trajectory.at_arc(arc_m) - trajectory.at_arc(reference_arc), axis=1)
    return np.copysign(apart, arc_m - reference_arc)


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
