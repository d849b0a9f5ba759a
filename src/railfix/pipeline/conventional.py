"""Validation of the conventional position: chi-square test of its residuals, dilution of precision.

The checks that single-point programs make of each position (RTKLIB: `valsol` of pntpos.c). A position that fails one
keeps its coordinates.
"""

from __future__ import annotations

from dataclasses import replace
from enum import IntEnum

import numpy as np

from railfix.core.arrays import Codes, Floats
from railfix.integrity.raim import RaimLimits, detect
from railfix.positioning.normal_equations import Ranges, inverse_3x3, normal_equations
from railfix.positioning.single_point import SinglePoint, SinglePointLimits


class PointStatus(IntEnum):
    """Result of the validation of a conventional position."""

    #: Both checks passed; residuals without a redundant range pass.
    VALID = 0
    #: There is no position.
    NO_POSITION = 1
    #: The residuals exceed what noise explains.
    RESIDUALS = 2
    #: The dilution of precision is over its limit.
    DILUTION = 3


def validate_point(point: SinglePoint, ranges: Ranges, noise_scale: Floats, *, limits: SinglePointLimits) -> Codes:
    """Return the `PointStatus` of each position, shape (T,).

    Parameters
    ----------
    point : SinglePoint
        Every constellation with a clock of its own.
    ranges : Ranges
        From which it was computed.
    noise_scale : ndarray, shape (T,)
        Standard deviation of this receiver's ranges over the sigmas of the weights.
    limits : SinglePointLimits
    """
    test = detect(
        point.wsse,
        point.residual_m,
        ranges.n_used - ranges.n_clocks - 3,
        scale=noise_scale,
        limits=RaimLimits(false_alarm=limits.false_alarm),
    )
    located = np.asarray(np.isfinite(point.ecef_m).all(axis=1))
    over = np.zeros(len(ranges), dtype=np.bool_)
    over[located] = ~(position_dilution(ranges.take(located), point.ecef_m[located]) <= limits.dilution_limit)
    conditions = [~located, test.detected, over]
    return np.select(conditions, [PointStatus.NO_POSITION, PointStatus.RESIDUALS, PointStatus.DILUTION]).astype(np.int8)


def position_dilution(ranges: Ranges, ecef_m: Floats) -> Floats:
    """Return the position dilution of precision, every constellation with a clock of its own, shape (T,).

    Root of the trace of the position's covariance for ranges of unit sigma; NaN where the geometry is singular.
    """
    alike = replace(ranges, weight=(ranges.weight > 0).astype(np.float64))
    inverse = inverse_3x3(normal_equations(alike, ecef_m).matrix)
    return np.asarray(np.sqrt(np.einsum("tii->t", inverse)))
