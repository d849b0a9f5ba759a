"""Robust fits of an epoch's ranges.

The fits are iteratively reweighted least squares with IGG-III weights (Yang, Song and Xu, Journal of Geodesy 76, 2002).
The scale is the median of the absolute residuals, so that no noise level is assumed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import Field

from railfix import kernels
from railfix.core.arrays import Floats, Indices, Integers, Masks, kernel_array
from railfix.core.settings import Settings
from railfix.positioning.antenna_rows import AntennaRows, Line
from railfix.positioning.normal_equations import Constrained
from railfix.positioning.range_arrays import Ranges
from railfix.track.trajectory import Trajectory

_NORMAL_MEDIAN: Final = 0.6745  #: Median of the absolute value of a standard normal variable.


class RobustFitLimits(Settings):
    """Limits of the robust fit."""

    keep: float = Field(default=1.5, gt=0)  #: Residuals up to this multiple of the scale have full weight.
    reject: float = Field(default=4.0, gt=0)  #: Residuals above this multiple of the scale have zero weight.
    #: Number of reweightings. For the demonstration with an error of 20 m on one satellite, the fifth reweighting
    #: changes no decision.
    iterations: int = Field(default=5, ge=1)


@dataclass(frozen=True, kw_only=True)
class RobustFit:
    """Ranges that agree with each other, T epochs by M channels."""

    kept: Masks  #: True for used ranges with a residual below `RobustFitLimits.reject` scales, shape (T, M).
    #: Weighted sum of squared residuals of the kept ranges, divided by `freedom`, shape (T,); NaN where `freedom` is 0.
    variance: Floats
    freedom: Integers  #: Kept ranges minus clock and position unknowns, shape (T,); 0 without a fit.


def map_information(trajectory: Trajectory, section: Indices) -> Floats:
    """Return the inverse ECEF covariance of the map error at sections of the line, shape (T, 3, 3) [1/m^2]."""
    return compute_information(trajectory.get_axes(section), trajectory.sigma_plan_m, trajectory.sigma_height_m)


def compute_information(axes: Floats, sigma_plan_m: float, sigma_height_m: float) -> Floats:
    """Compute the inverse ECEF covariance of the map error, shape (T, 3, 3); `axes` point along, across and up."""
    across, up = axes[:, 1], axes[:, 2]
    return np.asarray(
        across[:, :, None] * across[:, None, :] / sigma_plan_m**2 + up[:, :, None] * up[:, None, :] / sigma_height_m**2
    )


def robust_fit(
    ranges: Ranges, place_ecef_m: Floats, *, information: Floats | None = None, limits: RobustFitLimits | None = None
) -> RobustFit:
    """Find, with IGG-III weights (Yang, Song and Xu, 2002), the ranges of each epoch that agree with each other.

    `place_ecef_m`, shape (T, 3), are the positions at which the ranges are linearised.

    `information`, shape (T, 3, 3) [1/m^2], is prior information on the position (`map_information`). The redundancy is
    computed with one position unknown if `information` is given, otherwise with three.
    """
    limits = limits or RobustFitLimits()
    used = ranges.weight > 0
    if not used.shape[1]:
        nothing = np.zeros(len(ranges), dtype=np.int64)
        return RobustFit(kept=used, variance=np.full(len(ranges), np.nan), freedom=nothing)
    freedom = ranges.space_redundancy if information is None else ranges.redundancy
    kept, wsse, solved = kernels.robust.reweight_ranges(
        ranges.arrays, kernel_array(place_ecef_m),
        kernel_array(np.empty((0, 3, 3)) if information is None else information),
        np.sqrt(ranges.n_used / np.maximum(freedom, 1)) / _NORMAL_MEDIAN, limits.keep, limits.reject,
        limits.iterations,
    )  # fmt: skip
    left = np.asarray(kept.sum(axis=1) - (ranges.n_used - freedom), dtype=np.int64)
    some = (left > 0) & solved
    return RobustFit(
        kept=kept, variance=np.where(some, wsse / np.maximum(left, 1), np.nan), freedom=np.where(some, left, 0)
    )


def robust_on_line(
    ranges: Ranges,
    line: Line,
    position: Constrained,
    *,
    near_ecef_m: Floats | None = None,
    limits: RobustFitLimits | None = None,
) -> RobustFit:
    """Find, with IGG-III weights (Yang, Song and Xu, 2002), the ranges that agree at positions on the line.

    Without a position, ranges are linearised at `near_ecef_m`, shape (T, 3) [m]; default: the middle of the line.
    """
    antennas, arc = AntennaRows.on(line), position.arc_m
    if near_ecef_m is None:
        near_ecef_m = antennas.each(lambda index, rows: index.middle_ecef_m[None].repeat(len(arc[rows]), axis=0))
    at = np.where(np.isfinite(arc)[:, None], antennas.at_arc(arc), near_ecef_m)
    axes = antennas.get_axes(np.maximum(position.section, 0))
    information = compute_information(axes, antennas.sigma_plan_m, antennas.sigma_height_m)
    return robust_fit(ranges, at, information=information, limits=limits)
