"""Validation of conventional single-point positions (RTKLIB: `valsol` in pntpos.c)."""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache

import numpy as np

from railfix import kernels
from railfix.core.arrays import Codes, Floats, kernel_array
from railfix.integrity.raim import RaimLimits, detect
from railfix.positioning.normal_equations import SinglePoint, SinglePointLimits
from railfix.positioning.range_arrays import Ranges


class PointStatus(IntEnum):
    """Validation result of a conventional single-point position."""

    #: The residuals and the dilution of precision are within their limits. Residuals are not tested without redundancy.
    VALID = 0
    #: No position.
    NO_POSITION = 1
    #: The test statistic of the residuals reaches its threshold.
    RESIDUALS = 2
    #: The dilution of precision exceeds its limit, or the geometry is singular.
    DILUTION = 3


@lru_cache
def _of_residuals(limits: SinglePointLimits) -> RaimLimits:
    return RaimLimits(false_alarm=limits.false_alarm)


def validate_point(point: SinglePoint, ranges: Ranges, noise_scale: Floats, *, limits: SinglePointLimits) -> Codes:
    """Return the `PointStatus` of each conventional position, shape (T,).

    `noise_scale`, shape (T,), is the ratio of the receiver's range standard deviation to the standard deviation assumed
    in the weights. The checks are the same as in pntpos.c (RTKLIB: `valsol`); one clock per constellation is assumed.
    """
    test = detect(
        point.wsse, point.residual_m, ranges.space_redundancy, scale=noise_scale,
        limits=_of_residuals(limits),
    )  # fmt: skip
    located = np.asarray(np.isfinite(point.ecef_m).all(axis=1))
    over = ~(position_dilution(ranges, point.ecef_m) <= limits.dilution_limit)
    status = np.where(over, int(PointStatus.DILUTION), int(PointStatus.VALID))
    status = np.where(test.detected, int(PointStatus.RESIDUALS), status)
    return np.where(located, status, int(PointStatus.NO_POSITION)).astype(np.int8)


def position_dilution(ranges: Ranges, ecef_m: Floats) -> Floats:
    """Return the position dilution of precision (PDOP), shape (T,), with one clock per constellation.

    PDOP is the square root of the trace of the position covariance for ranges of unit sigma (RTKLIB: `dops`). It is NaN
    where the geometry is singular.
    """
    return kernels.ranges.dilutions(ranges.arrays, kernel_array(ecef_m))
