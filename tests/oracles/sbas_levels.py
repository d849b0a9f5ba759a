"""Levels without a fault: along the track, and in space after RTCA DO-229D appendix J.

Both take the variances of the ranges from their weights, ``1/weight = sigma_flt^2 + sigma_UIRE^2 +
sigma_tropo^2 + sigma_rail^2``: the railway model of multipath and receiver noise
stands where appendix J has the airborne one (P1 2.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Floats
from railfix.integrity.protection.risk import K_H_PA, K_V
from railfix.integrity.raim import LinearModel
from railfix.positioning.range_arrays import Ranges
from raim_oracle import point_model


def sbas_level(model: LinearModel, *, k: float, scale: ArrayLike = 1.0) -> Floats:
    """Fault-free level along the track, ``K sigma_s``, shape (T,) [m]; NaN where there is no position.

    Parameters
    ----------
    model : LinearModel
        On the line; weights from the variances of the corrected ranges.
    k : float
        `RiskBudget.sample_k`, or one of DO-229's.
    scale : array_like, shape (T,) or ()
        Noise scale, as in `raim.reliability`.
    """
    scale = np.broadcast_to(np.asarray(scale, dtype=np.float64), (len(model),))
    return np.asarray(k * np.sqrt(model.position_covariance_m2(scale)[:, 0, 0]))


@dataclass(frozen=True, kw_only=True)
class LevelsInSpace:
    """DO-229D appendix J, T epochs; NaN where the ranges do not determine the position.

    Attributes
    ----------
    horizontal_m : ndarray, shape (T,) [m]
        HPL: K_H d_major.
    vertical_m : ndarray, shape (T,) [m]
        VPL: K_V d_U.
    major_m : ndarray, shape (T,) [m]
        d_major: the longer half-axis of the horizontal error ellipse.
    up_m : ndarray, shape (T,) [m]
        d_U.
    """

    horizontal_m: Floats
    vertical_m: Floats
    major_m: Floats
    up_m: Floats


def levels_in_space(
    ranges: Ranges, ecef_m: Floats, *, k_horizontal: float = K_H_PA, k_vertical: float = K_V
) -> LevelsInSpace:
    """HPL and VPL of the unconstrained position, of the same variances, to compare with.

    Parameters
    ----------
    ranges : Ranges
        T epochs; weights from the variances of the corrected ranges.
    ecef_m : ndarray, shape (T, 3) [m]
        Positions; NaN where there is none.
    k_horizontal, k_vertical : float
        `K_H_PA` or `K_H_NPA`; `K_V`.
    """
    covariance = point_model(ranges, ecef_m).covariance_m2
    east, north, mixed = covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 0, 1]
    major = np.sqrt((east + north) / 2.0 + np.hypot((east - north) / 2.0, mixed))
    up = np.sqrt(covariance[:, 2, 2])
    return LevelsInSpace(horizontal_m=k_horizontal * major, vertical_m=k_vertical * up, major_m=major, up_m=up)
