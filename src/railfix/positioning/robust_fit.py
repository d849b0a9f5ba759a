"""Robust fit of single epochs: which ranges agree with each other, whatever the noise of the receiver.

Iteratively reweighted least squares with the IGG-III weights (Y. Yang, L. Song and T. Xu, Robust estimator for
correlated observations based on bifactor equivalent weights, Journal of Geodesy 76, 2002) and the median of the
absolute residuals as scale: a range whose residual passes `reject` scales has no part in the fit at all. No
noise level is assumed, so that the noise of a receiver can be learnt from what is kept.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import Field

from railfix import kernels
from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.core.settings import Settings
from railfix.positioning.normal_equations import Ranges
from railfix.track.trajectory import Trajectory

#: Median of the absolute value of a standard normal variable.
_NORMAL_MEDIAN: Final = 0.6745


class RobustFitLimits(Settings):
    """Limits of the robust fit.

    Attributes
    ----------
    keep : float
        Residuals up to this many scales keep their weight (IGG-III: 1.5 to 2).
    reject : float
        Residuals from this many scales on have no weight (IGG-III: 3 to 8.5).
    iterations : int
        Reweightings. On the demonstration with 20 m on one satellite the fifth one changes no verdict.
    """

    keep: float = Field(default=1.5, gt=0)
    reject: float = Field(default=4.0, gt=0)
    iterations: int = Field(default=5, ge=1)


@dataclass(frozen=True, kw_only=True)
class RobustFit:
    """Ranges that agree with each other, T epochs by M channels.

    Attributes
    ----------
    kept : ndarray of bool, shape (T, M)
        Used ranges whose residual is below `RobustFitLimits.reject` scales.
    variance : ndarray, shape (T,)
        Weighted sum of the squared residuals of the kept ranges over their degrees of freedom; NaN without any.
    freedom : ndarray of int, shape (T,)
        Kept ranges beyond clocks and unknowns of the place.
    """

    kept: Masks
    variance: Floats
    freedom: Integers


def map_information(trajectory: Trajectory, section: Indices) -> Floats:
    """Inverse covariance of the place across and above sections of the line, shape (T, 3, 3) [1/m^2] in ECEF."""
    across, up = trajectory.across[section], trajectory.up[section]
    return np.asarray(
        across[:, :, None] * across[:, None, :] / trajectory.sigma_plan_m**2
        + up[:, :, None] * up[:, None, :] / trajectory.sigma_height_m**2
    )


def robust_fit(
    ranges: Ranges,
    place_ecef_m: Floats,
    *,
    information: Floats | None = None,
    limits: RobustFitLimits | None = None,
) -> RobustFit:
    """Fit each epoch with IGG-III weights around a place.

    Parameters
    ----------
    ranges : Ranges
        T epochs.
    place_ecef_m : ndarray, shape (T, 3) [m]
        Solution of the plain fit; steps from it are linear.
    information : ndarray, shape (T, 3, 3) [1/m^2], optional
        Known of the place beforehand (`map_information`: one unknown is left); none: three unknowns.
    limits : RobustFitLimits, optional

    Returns
    -------
    RobustFit
    """
    limits = limits or RobustFitLimits()
    used = ranges.weight > 0
    if not used.shape[1]:
        nothing = np.zeros(len(ranges), dtype=np.int64)
        return RobustFit(kept=used, variance=np.full(len(ranges), np.nan), freedom=nothing)
    freedom = ranges.n_used - ranges.n_clocks - (3 if information is None else 1)
    kept, wsse, solved = kernels.robust.reweighted(
        ranges.arrays,
        np.ascontiguousarray(place_ecef_m, dtype=np.float64),
        np.empty((0, 3, 3)) if information is None else np.ascontiguousarray(information),
        np.sqrt(ranges.n_used / np.maximum(freedom, 1)) / _NORMAL_MEDIAN,
        limits.keep,
        limits.reject,
        limits.iterations,
    )
    left = np.asarray(np.count_nonzero(kept, axis=1) - (ranges.n_used - freedom), dtype=np.int64)
    some = (left > 0) & solved
    return RobustFit(
        kept=kept, variance=np.where(some, wsse / np.maximum(left, 1), np.nan), freedom=np.where(some, left, 0)
    )
