"""Sequential correction of Gaussians by the measurements of an epoch, whose errors have Student's t distribution.

The measurements depend on the state N(x, P) through the quantities ``q = H x`` (docs/filter-equations.md). The fits
correct the Gaussian of the quantities, N(0, H P H'), instead of the state. All phases and Dopplers are compressed to
six rows. Measurements are processed one by one, so that no matrix is inverted.

Each Gaussian has two named tuples of arrays: `Equations` for the measurements, `Fit` for the results.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.kernels.compiling import inlined, inner
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Rows


class Equations(NamedTuple):
    """Measurement equations of one Gaussian with N unknowns: Q quantities and M measurements."""

    #: Quantity q is the sum over k of ``coefficient[q, k] x[unknown[q, k]]``, with the clock last; shapes (Q, TERMS).
    unknown: Indices
    coefficient: Floats
    #: Coefficients of phases and Dopplers for the six motion quantities; 0 for other rows; shape (M, MOTION).
    design: Floats
    value: Floats  #: Innovations y [m, m/s, units of the sensors]; shape (M,).


class Fit(NamedTuple):
    """Fit of one Gaussian to an epoch's measurements. Fields have shape (M,), the last two have shape (1,)."""

    #: Weight from Student's t distribution: 1 for an error of one standard deviation; delayed codes have lower weights.
    weight: Floats
    residual: Floats  #: Innovation minus its fitted value, in the unit of the measurement.
    fitted: Floats  #: Variance of the fitted value, in the squared unit.
    log_determinant: Floats  #: ``log det(I + R^-1 H P H')``.
    distance: Floats  #: ``q' (H P H')^-1 q``, with the corrected mean q of the quantities.


class Correction(NamedTuple):
    """Correction of one hypothesis with N unknowns by M measurements of an epoch."""

    #: Predicted mean and covariance with initialised clocks; shapes (N,) and (N, N).
    x_prior: Floats
    P_prior: Floats
    equations: Equations
    #: Prior covariance of the quantities, shape (Q, Q), and prior variances for a known clock, shape (Q,).
    covariance: Floats
    without_clock: Floats
    fit: Fit
    innovation: Floats  #: Innovations at the predicted mean; shape (M,).
    restarted: Masks  #: Unknowns (clocks) that restarted at this epoch; shape (N,).
    #: Corrected mean and covariance; shapes (N,) and (N, N).
    x: Floats
    P: Floats


@inlined
def find_row(rows: Rows, q: int) -> int:
    """Return the row of a code or sensor quantity; motion quantities have no row."""
    return q if q < rows.code.stop else q - rows.code.stop - ix.MOTION + rows.sensor.start


@inlined
def find_quantity(rows: Rows, j: int) -> int:
    """Return the quantity of a code or sensor row. The order is codes, six motion quantities, sensors."""
    return j if j < rows.code.stop else j - rows.sensor.start + rows.code.stop + ix.MOTION


@inner
def new_fit(rows: Rows) -> Fit:
    """Allocate the fit of an epoch's measurements."""
    count = len(rows.variance)
    return Fit(np.ones(count), np.zeros(count), np.zeros(count), np.zeros(1), np.zeros(1))


@inlined
def add_row(target: Floats, factor: float, matrix: Floats, i: int) -> None:
    """Add a multiple of row i of a matrix to a vector; a view of the row would cost more time than the sum."""
    for a in range(len(target)):
        target[a] += factor * matrix[i, a]


@inlined
def correct(x: Floats, P: Floats, g: Floats, innovation: float, variance: float, gain: Floats) -> None:
    """Correct a Gaussian by one measurement: ``K = g / S``, ``x = x + K y``, ``P = P - K g'``.

    x, shape (N,), and P, shape (N, N), are changed in place. g, shape (N,), is P h. `innovation` is y, `variance` is
    ``S = h' P h + r``. K is written into `gain`, shape (N,).
    """
    for a in range(len(g)):
        gain[a] = g[a] / variance
        x[a] += gain[a] * innovation
    for a in range(len(g)):
        k = gain[a]
        if k != 0.0:
            for b in range(len(g)):
                P[a, b] -= k * g[b]


@inner
def predict_quantities(P: Floats, equations: Equations) -> tuple[Floats, Floats]:
    """Return the covariance H P H' of the quantities, shape (Q, Q), and variances for a known clock, shape (Q,)."""
    unknown, coefficient = equations.unknown, equations.coefficient
    size = len(unknown)
    covariance, without_clock, g = np.empty((size, size)), np.empty(size), np.empty(len(P))
    for q in range(size):
        g[:] = 0.0
        for k in range(ix.TERMS):
            if k == ix.CLOCK_TERM:
                without_clock[q] = _project(equations, q, g) - coefficient[q, k] * g[unknown[q, k]]
            if coefficient[q, k] != 0.0:
                add_row(g, coefficient[q, k], P, unknown[q, k])
        for i in range(q + 1):
            total = 0.0
            for k in range(ix.TERMS):  # a constant number of terms compiles to faster code
                total += coefficient[i, k] * g[unknown[i, k]]
            covariance[i, q] = covariance[q, i] = total
    return covariance, without_clock


@inner
def compress(rows: Rows, equations: Equations, variance: Floats, weight: Floats, T: Floats, z: Floats) -> None:
    """Write the six rows ``T q_motion = z + N(0, I)`` that are equivalent to all weighted phases and Dopplers.

    T is the upper triangular Cholesky factor of the normal matrix ``T' T``. Rows of unmeasured quantities are 0.
    """
    design, value = equations.design, equations.value
    diagonal = np.empty(ix.MOTION)
    T[:], z[:] = 0.0, 0.0
    for j in range(rows.phase.start, rows.doppler.stop):
        information = weight[j] / variance[j]
        for a in range(ix.MOTION):
            f = information * design[j, a]
            if f != 0.0:
                z[a] += f * value[j]
                for b in range(a, ix.MOTION):
                    T[a, b] += f * design[j, b]
    for a in range(ix.MOTION):
        diagonal[a] = T[a, a]
    for a in range(ix.MOTION):
        if T[a, a] <= constants.LEAST_PIVOT * diagonal[a]:
            z[a], T[a] = 0.0, 0.0
            continue
        scale = 1.0 / math.sqrt(T[a, a])
        z[a] *= scale
        for b in range(a, ix.MOTION):
            T[a, b] *= scale
        for c in range(a + 1, ix.MOTION):
            z[c] -= T[a, c] * z[a]
            for b in range(c, ix.MOTION):
                T[c, b] -= T[a, c] * T[a, b]


@inner
def compute_weight(rows: Rows, square: float, late: bool) -> float:
    """Return the weight for a normalised squared residual, as in `railfix.tracking.limits.Tails`."""
    own = rows.late_degrees if late else rows.degrees
    return float((rows.degrees + 1.0) / rows.degrees * own / (own + square))


@inner
def median(values: Floats) -> float:
    """Return the median; NaN if there are no values."""
    return float(np.median(values)) if len(values) else math.nan


@inner
def write_first_weights(
    rows: Rows, equations: Equations, expected: tuple[Floats, Floats], variance: Floats, weight: Floats
) -> None:
    """Write the initial weights, computed from innovations minus the median for each kind of GNSS measurement.

    The predicted variances are computed without the clocks, whose large prior variances would hide every outlier.
    """
    covariance, without_clock = expected
    design, value, codes = equations.design, equations.value, rows.code.stop
    for kind in range(2):
        own = rows.phase if kind == 0 else rows.doppler
        clock, middle = ix.M_CLOCK if kind == 0 else ix.M_DRIFT, median(value[own])
        for j in range(own.start, own.stop):
            spread = 0.0
            for a in range(ix.MOTION):
                for b in range(ix.MOTION):
                    if a != clock and b != clock:
                        spread += design[j, a] * design[j, b] * covariance[codes + a, codes + b]
            away = value[j] - middle
            weight[j] = compute_weight(rows, away * away / (spread + variance[j]), False)
    middle = median(value[rows.code])
    for j in range(codes):
        away = value[j] - middle
        weight[j] = compute_weight(rows, away * away / (without_clock[j] + variance[j]), away > 0.0)
    for j in range(rows.sensor.start, rows.sensor.stop):
        spread = without_clock[find_quantity(rows, j)]
        weight[j] = compute_weight(rows, value[j] * value[j] / (spread + variance[j]), False)


@inner
def fit(rows: Rows, equations: Equations, covariance: Floats, variance: Floats, found: Fit) -> None:
    """Correct the quantities, ``N(0, covariance)``, with the weights in `found`; write the results into `found`."""
    size, codes, value, weight = len(covariance), rows.code.stop, equations.value, found.weight
    mean, C, g, gain = np.zeros(size), covariance.copy(), np.empty(size), np.empty(size)
    T, z = np.empty((ix.MOTION, ix.MOTION)), np.empty(ix.MOTION)
    compress(rows, equations, variance, weight, T, z)
    log_determinant = square = 0.0
    for q in range(size):
        if codes <= q < codes + ix.MOTION:
            r = q - codes
            if T[r, r] == 0.0:
                continue
            g[:], y, S, noise = 0.0, z[r], 1.0, 1.0
            for c in range(r, ix.MOTION):
                add_row(g, T[r, c], C, codes + c)
                y -= T[r, c] * mean[codes + c]
            for c in range(r, ix.MOTION):
                S += T[r, c] * g[codes + c]
        else:
            j = find_row(rows, q)
            if variance[j] == math.inf:
                continue
            g[:], noise = C[q], variance[j] / weight[j]
            y, S = value[j] - mean[q], g[q] + noise
        correct(mean, C, g, y, S, gain)
        log_determinant += math.log(S / noise)
        square += y * y / S
    for r in range(ix.MOTION):
        rest = z[r]
        for c in range(r, ix.MOTION):
            rest -= T[r, c] * mean[codes + c]
        square -= rest * rest
    square -= _write_residuals(rows, equations, mean, C, variance, found)
    found.log_determinant[0], found.distance[0] = log_determinant, square


@inner
def _write_residuals(rows: Rows, equations: Equations, mean: Floats, C: Floats, variance: Floats, found: Fit) -> float:
    """Write the residuals and `Fit.fitted`; return the weighted sum of squared residuals of codes and sensors."""
    design, value, codes, square = equations.design, equations.value, rows.code.stop, 0.0
    for j in range(len(rows.variance)):
        residual, fitted = value[j], 0.0
        if codes <= j < rows.sensor.start:
            for a in range(ix.MOTION):
                residual -= design[j, a] * mean[codes + a]
                for b in range(ix.MOTION):
                    fitted += design[j, a] * design[j, b] * C[codes + a, codes + b]
        else:
            q = find_quantity(rows, j)
            residual, fitted = residual - mean[q], C[q, q]
            if variance[j] < math.inf:
                square += found.weight[j] * residual * residual / variance[j]
        found.residual[j], found.fitted[j] = residual, fitted
    return square


@inner
def write_weights(rows: Rows, variance: Floats, found: Fit) -> None:
    """Write the weights that follow from `Fit.residual` and `Fit.fitted`."""
    for j in range(len(rows.variance)):
        relative = (found.residual[j] ** 2 + found.fitted[j]) / variance[j]
        late = j < rows.code.stop and found.residual[j] > 0.0
        found.weight[j] = compute_weight(rows, relative, late)


@inner
def reweight(rows: Rows, equations: Equations, covariance: Floats, variance: Floats, found: Fit) -> None:
    """Make `PASSES` fits with new weights between them, starting from the weights of `found`.

    `found` has the weights and residuals of the last fit.
    """
    fit(rows, equations, covariance, variance, found)
    for _ in range(constants.PASSES - 1):
        write_weights(rows, variance, found)
        fit(rows, equations, covariance, variance, found)


@inner
def correct_state(rows: Rows, equations: Equations, variance: Floats, weight: Floats, x: Floats, P: Floats) -> None:
    """Correct the state by all weighted measurements of finite variance, one after another."""
    codes, value = rows.code.stop, equations.value
    change, g, gain = np.zeros(len(x)), np.empty(len(x)), np.empty(len(x))
    T, z = np.empty((ix.MOTION, ix.MOTION)), np.empty(ix.MOTION)
    compress(rows, equations, variance, weight, T, z)
    for q in range(len(equations.unknown)):
        g[:] = 0.0
        if codes <= q < codes + ix.MOTION:
            r = q - codes
            if T[r, r] == 0.0:
                continue
            y, S = z[r], 1.0
            for c in range(r, ix.MOTION):
                y -= _add_quantity(equations, codes + c, T[r, c], P, change, g)
            for c in range(r, ix.MOTION):
                S += T[r, c] * _project(equations, codes + c, g)
        else:
            j = find_row(rows, q)
            if variance[j] == math.inf:
                continue
            y = value[j] - _add_quantity(equations, q, 1.0, P, change, g)
            S = variance[j] / weight[j] + _project(equations, q, g)
        correct(change, P, g, y, S, gain)
    for a in range(len(x)):
        x[a] += change[a]


@inlined
def _project(equations: Equations, q: int, vector: Floats) -> float:
    """Return ``h' vector``, where h is row q of H."""
    total = 0.0
    for k in range(ix.TERMS):
        total += equations.coefficient[q, k] * vector[equations.unknown[q, k]]
    return total


@inlined
def _add_quantity(equations: Equations, q: int, factor: float, P: Floats, mean: Floats, g: Floats) -> float:
    """Add ``factor P h`` to g, and return ``factor h' mean``, where h is row q of H."""
    total = 0.0
    for k in range(ix.TERMS):
        f = factor * equations.coefficient[q, k]
        if f != 0.0:
            total += f * mean[equations.unknown[q, k]]
            add_row(g, f, P, equations.unknown[q, k])
    return total


@inner
def compute_log_evidence(rows: Rows, variance: Floats, found: Fit) -> float:
    """Return the log evidence of the measurements of finite variance (Laplace's method for Student's t errors)."""
    usual, density = rows.degrees, 0.0
    for j in range(len(rows.variance)):
        own = rows.late_degrees if j < rows.code.stop and found.residual[j] > 0.0 else usual
        density += own * math.log1p(found.residual[j] ** 2 / (own * variance[j]))
    return float(-0.5 * (usual + 1.0) / usual * density - 0.5 * found.distance[0] - 0.5 * found.log_determinant[0])


@inner
def mean_weights(rows: Rows, variance: Floats, weight: Floats) -> tuple[float, float]:
    """Return the mean weight of codes that are not excluded, and the mean weight of phases and Dopplers.

    Only measurements of finite variance are included. A mean weight is NaN if there are no measurements.
    """
    code, motion, codes, motions = 0.0, 0.0, 0, 0
    for j in range(rows.doppler.stop):
        if variance[j] < math.inf and not rows.left_out[j]:
            if j < rows.code.stop:
                code, codes = code + weight[j], codes + 1
            else:
                motion, motions = motion + weight[j], motions + 1
    return code / codes if codes else math.nan, motion / motions if motions else math.nan


@inner
def compute_evidence(rows: Rows, one: Correction) -> tuple[float, float]:
    """Return the log evidence of all measurements except codes, and the log evidence of codes given all others.

    An evidence is set to 0 if there are too few measurements, because they fit any speed and position.
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
    """Fit again with first weights for an inflated prior (position, speed); keep the fit with the larger evidence."""
    inflated, found = one.P_prior.copy(), new_fit(rows)
    inflated[ix.ARC, ix.ARC] += constants.FREEDOM_PLACE_M2
    inflated[ix.SPEED, ix.SPEED] += constants.FREEDOM_SPEED_M2PS2
    expected = predict_quantities(inflated, one.equations)
    write_first_weights(rows, one.equations, expected, rows.variance, found.weight)
    reweight(rows, one.equations, expected[0], rows.variance, found)
    reweight(rows, one.equations, one.covariance, rows.variance, found)
    first = compute_log_evidence(rows, rows.variance, one.fit)
    if compute_log_evidence(rows, rows.variance, found) > first:
        for k in range(len(found)):
            one.fit[k][:] = found[k]
