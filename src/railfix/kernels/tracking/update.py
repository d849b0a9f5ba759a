"""Update of Gaussians by measurements with Student's t errors: iterated reweighting of one epoch."""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.algebra import factorise, invert, invert_factor, median, multiply, square
from railfix.kernels.tracking.constants import (
    FREEDOM_PLACE_M2,
    FREEDOM_SPEED_M2PS2,
)
from railfix.kernels.tracking.layout import C_RIGHT, C_SPEED, C_WAY, COMBINED, Parameters, Rows, Work


@borrowing
def weight_of(square: float, late: bool, degrees: tuple[float, float]) -> float:
    """Weight of a measurement by its square over its variance: `railfix.tracking.limits.Tails`."""
    own = degrees[1] if late else degrees[0]
    return (degrees[0] + 1.0) / degrees[0] * own / (own + square)


@borrowing
def first_weights(
    rows: Rows,
    variance: Floats,
    degrees: tuple[float, float],
    freedom_place: float,
    freedom_speed: float,
    work: Work,
    h: int,
    to: int,
) -> None:
    """Weights from innovations, what a clock common to a kind takes up left out as their median.

    The clocks begin at every epoch nearly unknown: with their prior in it, the variance of an innovation would
    hide every outlier.
    """
    design, value, root, own, weight = work.design, work.value, work.root, work.own, work.weight
    counts, sensed, part = rows.counts, work.sensed, work.part
    nc, gnss = counts[0], counts[0] + counts[1] + counts[2]
    first = 0
    for kind in range(3):
        size = counts[kind]
        if size == 0:
            continue
        middle = median(value, h, first, size, work.ordered)
        for i in range(first, first + size):
            if kind == 0:
                spread = root[h, i] * root[h, i] + design[h, i, 0] ** 2 * freedom_place
            else:
                base = nc + C_WAY if kind == 1 else nc + C_RIGHT
                for c in range(4):
                    part[c] = design[h, i, c] * root[h, base + c]
                part[1 if kind == 1 else 3] = 0.0
                spread = 0.0
                for c in range(4):
                    for e in range(4):
                        spread += part[c] * own[h, base + c, base + e] * part[e]
                spread += design[h, i, 0] ** 2 * freedom_place if kind == 1 else design[h, i, 2] ** 2 * freedom_speed
            away = value[h, i] - middle
            weight[to, i] = weight_of(away * away / (spread + variance[i]), away > 0.0 and kind == 0, degrees)
        first += size
    for j in range(counts[3]):
        i = gnss + j
        spread = (
            root[h, nc + COMBINED + j] ** 2
            + sensed[h, j, 0] ** 2 * freedom_place
            + sensed[h, j, 2] ** 2 * freedom_speed
        )
        weight[to, i] = weight_of(value[h, i] * value[h, i] / (spread + variance[i]), False, degrees)


@borrowing
def reweight(
    rows: Rows, variance: Floats, degrees: tuple[float, float], passes: int, work: Work, h: int, by: int, to: int
) -> float:
    """Rounds of reweighting; return log det of the covariance of the combinations after the epoch."""
    design, value, root, information, system = work.design, work.value, work.root, work.information, work.system
    change, weight, right, diagonal, with_clock = work.change, work.weight, work.right, work.diagonal, work.with_clock
    residual, spread, factor, lower = work.residual, work.fitted, work.factor, work.lower
    nc, nph, ns = rows.counts[0], rows.counts[1], rows.counts[3]
    gnss, size = nc + nph + rows.counts[2], nc + COMBINED + ns
    log_determinant = 0.0
    clock = root[h, nc]
    part = work.part
    for turn in range(passes):
        for i in range(size):
            right[i] = 0.0
            for j in range(i, size):
                system[to, i, j] = information[by, i, j]
        for i in range(nc):
            w = weight[to, i] / variance[i]
            a = root[h, i] * w
            system[to, i, i] += a * root[h, i]
            system[to, i, nc] += a * clock
            system[to, nc, nc] += w * clock * clock
            right[i] += a * value[h, i]
            right[nc] += w * clock * value[h, i]
        for i in range(nc, gnss):
            base = nc + C_WAY if i < nc + nph else nc + C_RIGHT
            w = weight[to, i] / variance[i]
            for c in range(4):
                part[c] = design[h, i, c] * root[h, base + c]
            for c in range(4):
                a = w * part[c]
                right[base + c] += a * value[h, i]
                for e in range(c, 4):
                    system[to, base + c, base + e] += a * part[e]
        for j in range(ns):
            i, k = gnss + j, nc + COMBINED + j
            a = root[h, k] * weight[to, i] / variance[i]
            system[to, k, k] += a * root[h, k]
            right[k] += a * value[h, i]
        log_determinant = -factorise(system, to, size, factor)
        invert_factor(factor, size, lower)
        for i in range(size):
            change[to, i] = 0.0
            diagonal[i] = with_clock[i] = 0.0
        for k in range(size):
            solved = right[k] / factor[k, k]
            for i in range(k + 1, size):
                right[i] -= factor[k, i] * solved
            for i in range(k + 1):
                change[to, i] += solved * lower[k, i]
                diagonal[i] += lower[k, i] * lower[k, i]
        for k in range(nc, size):
            for i in range(nc + 1):
                with_clock[i] += lower[k, nc] * lower[k, i]
        for i in range(nc):
            residual[to, i] = value[h, i] - root[h, i] * change[to, i] - clock * change[to, nc]
            spread[to, i] = (
                root[h, i] * root[h, i] * diagonal[i]
                + 2.0 * root[h, i] * clock * with_clock[i]
                + clock * clock * with_clock[nc]
            )
        for i in range(nc, gnss):
            base = nc + C_WAY if i < nc + nph else nc + C_RIGHT
            fitted, variance_of_fit = 0.0, 0.0
            for c in range(4):
                part[c] = design[h, i, c] * root[h, base + c]
                fitted += part[c] * change[to, base + c]
            for k in range(base, size):
                along = 0.0
                for c in range(4):
                    along += lower[k, base + c] * part[c]
                variance_of_fit += along * along
            residual[to, i] = value[h, i] - fitted
            spread[to, i] = variance_of_fit
        for j in range(ns):
            i, k = gnss + j, nc + COMBINED + j
            residual[to, i] = value[h, i] - root[h, k] * change[to, k]
            spread[to, i] = root[h, k] * root[h, k] * diagonal[k]
        if turn < passes - 1:
            for i in range(gnss + ns):
                relative = (residual[to, i] ** 2 + spread[to, i]) / variance[i]
                weight[to, i] = weight_of(relative, residual[to, i] > 0.0 and i < nc, degrees)
    square(lower, size, work.after, to)
    return log_determinant


@borrowing
def evidence_of(
    rows: Rows, variance: Floats, degrees: tuple[float, float], log_after: float, work: Work, h: int, to: int
) -> float:
    """Logarithm of the evidence of the measurements of finite variance, for the fit in row `to`."""
    residual, change, information = work.residual, work.change, work.information
    nc, gnss = rows.counts[0], rows.counts[0] + rows.counts[1] + rows.counts[2]
    size = nc + COMBINED + rows.counts[3]
    usual, late = degrees
    fit = 0.0
    for i in range(gnss + rows.counts[3]):
        own = late if i < nc and residual[to, i] > 0.0 else usual
        fit += own * math.log1p(residual[to, i] ** 2 / (own * variance[i]))
    away = 0.0
    for i in range(size):
        total = 0.0
        for j in range(size):
            total += information[h, i, j] * change[to, j]
        away += change[to, i] * total
    return float(-0.5 * (usual + 1.0) / usual * fit - 0.5 * away + 0.5 * (log_after - work.log_before[h]))


@borrowing
def motion_evidence(rows: Rows, parameters: Parameters, work: Work, h: int, other: int) -> float:
    """Logarithm of the evidence of all measurements but the codes."""
    nc, count = rows.counts[0], rows.counts[0] + rows.counts[1] + rows.counts[2] + rows.counts[3]
    for i in range(count):
        work.masked[i] = math.inf if i < nc else work.variance[i]
        work.weight[other, i] = work.weight[h, i]
    log_after = reweight(rows, work.masked, parameters.degrees, parameters.passes, work, h, h, other)
    return evidence_of(rows, work.masked, parameters.degrees, log_after, work, h, other)


@borrowing
def mean_weights(rows: Rows, variance: Floats, work: Work, h: int) -> tuple[float, float]:
    """Return the mean weight of codes, and of phases and Dopplers, of finite variance; NaN without any."""
    nc, gnss = rows.counts[0], rows.counts[0] + rows.counts[1] + rows.counts[2]
    code, motion, codes, motions = 0.0, 0.0, 0, 0
    for i in range(gnss):
        if variance[i] < math.inf:
            if i < nc:
                code += work.weight[h, i]
                codes += 1
            else:
                motion += work.weight[h, i]
                motions += 1
    return code / codes if codes else math.nan, motion / motions if motions else math.nan


@borrowing
def second_start(parameters: Parameters, rows: Rows, work: Work, h: int, other: int) -> None:
    """Fit again with weights from innovations with place and speed set free, in row `other`; keep the better fit."""
    own, root, sensed, share = work.own, work.root, work.sensed, work.right
    nc, ns = rows.counts[0], rows.counts[3]
    gnss, size = nc + rows.counts[1] + rows.counts[2], nc + COMBINED + ns
    for i in range(size):
        for j in range(i, size):
            own[other, i, j] = own[h, i, j]
    for kind in range(2):
        for i in range(size):
            coefficient = 0.0
            if i >= nc + COMBINED:
                coefficient = sensed[h, i - nc - COMBINED, 0 if kind == 0 else 2]
            elif kind == 0 and i < nc:
                coefficient = work.design[h, i, 0]
            elif i == (nc + C_WAY if kind == 0 else nc + C_SPEED):
                coefficient = 1.0
            share[i] = coefficient / root[h, i]
        freedom = FREEDOM_PLACE_M2 if kind == 0 else FREEDOM_SPEED_M2PS2
        for i in range(size):
            for j in range(i, size):
                own[other, i, j] += freedom * share[i] * share[j]
    invert(own, other, size, work.factor, work.lower, work.information, other)
    first_weights(rows, work.variance, parameters.degrees, FREEDOM_PLACE_M2, FREEDOM_SPEED_M2PS2, work, h, other)
    log_after = 0.0
    for by in (other, h):
        log_after = reweight(rows, work.variance, parameters.degrees, parameters.passes, work, h, by, other)
    first = evidence_of(rows, work.variance, parameters.degrees, work.log_after[h], work, h, h)
    if evidence_of(rows, work.variance, parameters.degrees, log_after, work, h, other) > first:
        work.log_after[h] = log_after
        for i in range(size):
            work.change[h, i] = work.change[other, i]
            for j in range(size):
                work.after[h, i, j] = work.after[other, i, j]
        for i in range(gnss + ns):
            work.weight[h, i], work.residual[h, i] = work.weight[other, i], work.residual[other, i]
            work.fitted[h, i] = work.fitted[other, i]


@borrowing
def apply_update(rows: Rows, work: Work, h: int) -> None:
    """Write mean and covariance of the compact unknowns after the epoch, and behind them the mean of the old place."""
    mean, spread, cross, system = work.mean, work.spread, work.cross, work.system
    own, after, change, gain, less = work.own, work.after, work.change, work.gain, work.less
    new_mean, new_covariance = work.new_mean, work.new_covariance
    size, n = rows.counts[0] + COMBINED + rows.counts[3], new_covariance.shape[1]
    multiply(work.information, h, cross[h], size, n + 1, gain)
    for i in range(size):
        for j in range(size):
            system[h, i, j] = own[h, i, j] - after[h, i, j]
    multiply(system, h, gain, size, n, less)
    for c in range(n + 1):
        new_mean[h, c] = mean[h, c]
    for i in range(size):
        for c in range(n + 1):
            new_mean[h, c] += gain[i, c] * change[h, i]
    for pair in range((n + 1) // 2):  # two rows at a time
        c = min(2 * pair, n - 2)
        for e in range(c + 2):
            new_covariance[h, c, e], new_covariance[h, c + 1, e] = spread[h, c, e], spread[h, c + 1, e]
        for i in range(0, size - 1, 2):
            p, q, r, s = gain[i, c], gain[i + 1, c], gain[i, c + 1], gain[i + 1, c + 1]
            for e in range(c + 2):
                x, y = less[i, e], less[i + 1, e]
                new_covariance[h, c, e] -= p * x + q * y
                new_covariance[h, c + 1, e] -= r * x + s * y
        if size % 2:
            p, r = gain[size - 1, c], gain[size - 1, c + 1]
            for e in range(c + 2):
                new_covariance[h, c, e] -= p * less[size - 1, e]
                new_covariance[h, c + 1, e] -= r * less[size - 1, e]
        for e in range(c + 1):
            new_covariance[h, e, c], new_covariance[h, e, c + 1] = new_covariance[h, c, e], new_covariance[h, c + 1, e]
