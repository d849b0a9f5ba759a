"""Evidence of an epoch's measurements for a hypothesis, and a second fit where the first one is doubtful."""

from __future__ import annotations

import math

from railfix.kernels.compiling import inner
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Rows
from railfix.kernels.tracking.update import (
    Correction,
    compute_log_evidence,
    new_fit,
    predict_quantities,
    reweight,
    write_first_weights,
)


@inner
def compute_evidence(rows: Rows, one: Correction) -> tuple[float, float]:
    """Return the logarithms of the evidence of all measurements but the codes, and of the codes beside them.

    0 for too few of them: they fit any speed and place.
    """
    joint = compute_log_evidence(rows, rows.variance, one.fit)
    without_codes, found = rows.variance.copy(), new_fit(rows)
    without_codes[rows.code] = math.inf
    found.weight[:] = one.fit.weight
    reweight(rows, one.equations, one.covariance, without_codes, found)
    motion = compute_log_evidence(rows, without_codes, found)
    codes = joint - motion if rows.code.stop >= constants.MOTION_SATELLITES else 0.0
    satellites = max(rows.phase.stop - rows.phase.start, rows.doppler.stop - rows.doppler.start)
    if satellites < constants.MOTION_SATELLITES and rows.sensor.stop == rows.sensor.start:
        motion = 0.0
    return motion, codes


@inner
def refit_inflated_prior(rows: Rows, one: Correction) -> None:
    """Fit again with weights from innovations with place and speed set free; keep the fit with more evidence."""
    inflated, found = one.P_prior.copy(), new_fit(rows)
    inflated[ix.ARC, ix.ARC] += constants.FREEDOM_PLACE_M2
    inflated[ix.SPEED, ix.SPEED] += constants.FREEDOM_SPEED_M2PS2
    expected = predict_quantities(inflated, one.equations)
    write_first_weights(rows, one.equations, expected, rows.variance, found.weight)
    reweight(rows, one.equations, expected[0], rows.variance, found)
    reweight(rows, one.equations, one.covariance, rows.variance, found)
    first = compute_log_evidence(rows, rows.variance, one.fit)
    if compute_log_evidence(rows, rows.variance, found) > first:
        one.fit.weight[:], one.fit.residual[:] = found.weight, found.residual
        one.fit.fitted[:], one.fit.distance[:] = found.fitted, found.distance
        one.fit.log_determinant[:] = found.log_determinant
