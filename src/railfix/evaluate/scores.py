"""Figures of merit of one series of errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Floats, Masks

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


def score(error_m: Floats, observed: Masks) -> Score:
    """Figures of merit from signed errors, NaN where there is no position, at the epochs that are observed.

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
