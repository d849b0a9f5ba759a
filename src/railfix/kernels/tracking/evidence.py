"""Evidence of an epoch's measurements for a hypothesis, and a second fit where the first one is doubtful."""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import inner
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Rows
from railfix.kernels.tracking.update import (
    Correction,
    Equations,
    compute_log_evidence,
    new_fit,
    reweight,
    write_first_weights,
)


@inner
def compute_evidence(rows: Rows, degrees: tuple[float, float], rounds: int, one: Correction) -> tuple[float, float]:
    """Return the logarithms of the evidence of all measurements but the codes, and of the codes beside them.

    0 for too few of them: they fit any speed and place.
    """
    joint = compute_log_evidence(rows, rows.variance, degrees, one.fit)
    without_codes, found = rows.variance.copy(), new_fit(rows)
    without_codes[rows.code] = math.inf
    found.weight[:] = one.fit.weight
    reweight(rows, one.equations, one.covariance, without_codes, degrees, rounds, found)
    motion = compute_log_evidence(rows, without_codes, degrees, found)
    codes = joint - motion if rows.code.stop >= constants.MOTION_SATELLITES else 0.0
    satellites = max(rows.phase.stop - rows.phase.start, rows.doppler.stop - rows.doppler.start)
    if satellites < constants.MOTION_SATELLITES and rows.sensor.stop == rows.sensor.start:
        motion = 0.0
    return motion, codes


@inner
def _find_coefficient(equations: Equations, q: int, unknown: int) -> float:
    """Return the coefficient of an unknown in a quantity."""
    total = 0.0
    for k in range(ix.TERMS):
        if equations.unknown[q, k] == unknown:
            total += equations.coefficient[q, k]
    return total


@inner
def _inflate(one: Correction) -> tuple[Floats, Floats]:
    """Return the covariance of the quantities, and its diagonal without clocks, with place and speed set free."""
    covariance, without_clock = one.covariance.copy(), one.without_clock.copy()
    for unknown, variance in ((ix.ARC, constants.FREEDOM_PLACE_M2), (ix.SPEED, constants.FREEDOM_SPEED_M2PS2)):
        for i in range(len(covariance)):
            own = variance * _find_coefficient(one.equations, i, unknown)
            if own != 0.0:
                without_clock[i] += own * _find_coefficient(one.equations, i, unknown)
                for j in range(len(covariance)):
                    covariance[i, j] += own * _find_coefficient(one.equations, j, unknown)
    return covariance, without_clock


@inner
def refit_inflated_prior(rows: Rows, degrees: tuple[float, float], rounds: int, one: Correction) -> None:
    """Fit again with weights from innovations with place and speed set free; keep the fit with more evidence."""
    inflated, found = _inflate(one), new_fit(rows)
    write_first_weights(rows, one.equations, inflated, rows.variance, degrees, found.weight)
    reweight(rows, one.equations, inflated[0], rows.variance, degrees, rounds, found)
    reweight(rows, one.equations, one.covariance, rows.variance, degrees, rounds, found)
    first = compute_log_evidence(rows, rows.variance, degrees, one.fit)
    if compute_log_evidence(rows, rows.variance, degrees, found) > first:
        one.fit.weight[:], one.fit.residual[:] = found.weight, found.residual
        one.fit.fitted[:], one.fit.summary[:] = found.fitted, found.summary
