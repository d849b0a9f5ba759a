"""Update of Gaussians by measurements with Student's t errors: iterated reweighting of one epoch."""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.algebra import (
    add_rows,
    factorise,
    invert,
    invert_factor,
    log_determinant,
    median,
    solve_forward,
    square,
    whole_lanes,
)
from railfix.kernels.tracking.constants import (
    FREEDOM_PLACE_M2,
    FREEDOM_SPEED_M2PS2,
    LEAST_PIVOT,
)
from railfix.kernels.tracking.layout import (
    C_RIGHT,
    C_SPEED,
    C_WAY,
    CLOCKS_FIRST,
    COMBINED,
    MOTION,
    Parameters,
    Rows,
    Work,
)


@borrowing
def compute_weight(square: float, late: bool, degrees: tuple[float, float]) -> float:
    """Return the weight of a measurement by its square over its variance: `railfix.tracking.limits.Tails`."""
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
            weight[to, i] = compute_weight(away * away / (spread + variance[i]), away > 0.0 and kind == 0, degrees)
        first += size
    for j in range(counts[3]):
        i = gnss + j
        spread = (
            root[h, nc + COMBINED + j] ** 2
            + sensed[h, j, 0] ** 2 * freedom_place
            + sensed[h, j, 2] ** 2 * freedom_speed
        )
        weight[to, i] = compute_weight(value[h, i] * value[h, i] / (spread + variance[i]), False, degrees)


@borrowing
def _write_normal(rows: Rows, variance: Floats, work: Work, h: int, to: int) -> None:
    """Write the normal matrix of phases and Dopplers at the weights in row `to`, and behind it that of the values."""
    design, normal = work.design, work.normal
    begin = rows.counts[0]
    for k in range(MOTION):
        for c in range(MOTION + 1):
            normal[k, c] = 0.0
    for kind in range(1, 3):
        base = 0 if kind == 1 else C_RIGHT - C_WAY
        aa = ab = ac = ad = bb = bc = bd = cc = cd = dd = av = bv = cv = dv = 0.0
        for i in range(begin, begin + rows.counts[kind]):
            w, v = work.weight[to, i] / variance[i], work.value[h, i]
            a, b, c, d = design[h, i, 0], design[h, i, 1], design[h, i, 2], design[h, i, 3]
            wa, wb, wc, wd = w * a, w * b, w * c, w * d
            aa, ab, ac, ad, av = aa + wa * a, ab + wa * b, ac + wa * c, ad + wa * d, av + wa * v
            bb, bc, bd, bv = bb + wb * b, bc + wb * c, bd + wb * d, bv + wb * v
            cc, cd, cv, dd, dv = cc + wc * c, cd + wc * d, cv + wc * v, dd + wd * d, dv + wd * v
        begin += rows.counts[kind]
        sums = (aa, ab, ac, ad), (ab, bb, bc, bd), (ac, bc, cc, cd), (ad, bd, cd, dd)
        values = av, bv, cv, dv
        for k in range(4):
            normal[base + k, MOTION] += values[k]
            for q in range(4):
                normal[base + k, base + q] += sums[k][q]


@borrowing
def fit(rows: Rows, variance: Floats, work: Work, h: int, by: int, to: int) -> None:
    """Fit the combinations at the weights in row `to`: change, residuals and variances of what is fitted."""
    design, value, root, information, system = work.design, work.value, work.root, work.information, work.system
    change, weight, right, diagonal, with_clock = work.change, work.weight, work.right, work.diagonal, work.with_clock
    residual, spread, factor, lower, pivots = work.residual, work.fitted, work.factor, work.lower, work.pivots
    nc, nph, ns = rows.counts[0], rows.counts[1], rows.counts[3]
    gnss, size = nc + nph + rows.counts[2], nc + COMBINED + ns
    clock, first, normal = root[h, nc], nc + C_WAY, work.normal
    width, end = lower.shape[1], whole_lanes(size)
    for i in range(size):
        right[i] = 0.0
        for j in range(end):
            system[0, i, j] = information[by, i, j]
    for i in range(nc):
        w = weight[to, i] / variance[i]
        a = root[h, i] * w
        system[0, i, i] += a * root[h, i]
        system[0, i, nc] += a * clock
        system[0, nc, nc] += w * clock * clock
        right[i] += a * value[h, i]
        right[nc] += w * clock * value[h, i]
    _write_normal(rows, variance, work, h, to)
    for k in range(MOTION):
        a = root[h, first + k]
        right[first + k] += a * normal[k, MOTION]
        for c in range(k, MOTION):
            system[0, first + k, first + c] += a * root[h, first + c] * normal[k, c]
    for j in range(ns):
        i, k = gnss + j, nc + COMBINED + j
        a = root[h, k] * weight[to, i] / variance[i]
        system[0, k, k] += a * root[h, k]
        right[k] += a * value[h, i]
    factorise(system, 0, size, factor, pivots)
    invert_factor(factor, size, pivots, lower)
    for i in range(size):
        diagonal[i] = 0.0
    for k in range(size):
        inverse = pivots[0, k]
        solved = right[k] * inverse
        for i in range(k + 1, size):
            right[i] -= factor[k, i] * solved
        for i in range(k + 1):
            diagonal[i] += inverse * lower[k, i] * lower[k, i]
    none = (lower.shape[0] - 1) * width
    add_rows(change, lower, pivots, right, lower, (to * change.shape[1], none, 0, 0, 0), (1, width, 0, size, end))
    add_rows(with_clock, lower, pivots, lower, lower, (0, none, 0, nc, 0), (width, width, nc, size, end))
    for i in range(nc):
        residual[to, i] = value[h, i] - root[h, i] * change[to, i] - clock * change[to, nc]
        spread[to, i] = (
            root[h, i] * root[h, i] * diagonal[i]
            + 2.0 * root[h, i] * clock * with_clock[i]
            + clock * clock * with_clock[nc]
        )
    for k in range(MOTION):
        a = root[h, first + k]
        normal[k, MOTION] = a * change[to, first + k]
        for c in range(k + 1):
            total = 0.0
            for j in range(first + k, size):
                total += pivots[0, j] * lower[j, first + k] * lower[j, first + c]
            normal[c, k] = a * root[h, first + c] * total
    for i in range(nc, gnss):
        k = 0 if i < nc + nph else C_RIGHT - C_WAY
        a, b, c, d = design[h, i, 0], design[h, i, 1], design[h, i, 2], design[h, i, 3]
        residual[to, i] = value[h, i] - (
            a * normal[k, MOTION] + b * normal[k + 1, MOTION] + c * normal[k + 2, MOTION] + d * normal[k + 3, MOTION]
        )
        spread[to, i] = (
            a * (a * normal[k, k] + 2.0 * (b * normal[k, k + 1] + c * normal[k, k + 2] + d * normal[k, k + 3]))
            + b * (b * normal[k + 1, k + 1] + 2.0 * (c * normal[k + 1, k + 2] + d * normal[k + 1, k + 3]))
            + c * (c * normal[k + 2, k + 2] + 2.0 * d * normal[k + 2, k + 3])
            + d * d * normal[k + 3, k + 3]
        )
    for j in range(ns):
        i, k = gnss + j, nc + COMBINED + j
        residual[to, i] = value[h, i] - root[h, k] * change[to, k]
        spread[to, i] = root[h, k] * root[h, k] * diagonal[k]


@borrowing
def weigh_residuals(rows: Rows, variance: Floats, degrees: tuple[float, float], work: Work, to: int) -> None:
    """Write the weights that follow from the residuals of a fit and their variances."""
    weight, residual, nc = work.weight, work.residual, rows.counts[0]
    for i in range(nc + rows.counts[1] + rows.counts[2] + rows.counts[3]):
        relative = (residual[to, i] ** 2 + work.fitted[to, i]) / variance[i]
        weight[to, i] = compute_weight(relative, residual[to, i] > 0.0 and i < nc, degrees)


@borrowing
def reweight(
    rows: Rows, variance: Floats, degrees: tuple[float, float], passes: int, work: Work, h: int, by: int, to: int
) -> float:
    """Rounds of reweighting; return log det of the covariance of the combinations after the epoch."""
    size = rows.counts[0] + COMBINED + rows.counts[3]
    fit(rows, variance, work, h, by, to)
    for _ in range(passes - 1):
        weigh_residuals(rows, variance, degrees, work, to)
        fit(rows, variance, work, h, by, to)
    square(work.lower, size, work.pivots, work.after, to)
    return -log_determinant(work.pivots, size)


@borrowing
def compute_log_evidence(
    rows: Rows, variance: Floats, degrees: tuple[float, float], log_after: float, work: Work, h: int, to: int
) -> float:
    """Return the logarithm of the evidence of the measurements of finite variance, for the fit in row `to`."""
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
    """Return the logarithm of the evidence of all measurements but the codes."""
    nc, count = rows.counts[0], rows.counts[0] + rows.counts[1] + rows.counts[2] + rows.counts[3]
    for i in range(count):
        work.masked[i] = math.inf if i < nc else work.variance[i]
        work.weight[other, i] = work.weight[h, i]
    log_after = reweight(rows, work.masked, parameters.degrees, parameters.passes, work, h, h, other)
    return compute_log_evidence(rows, work.masked, parameters.degrees, log_after, work, h, other)


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
    invert(own, other, size, work.factor, work.pivots, work.lower, work.information, other)
    first_weights(rows, work.variance, parameters.degrees, FREEDOM_PLACE_M2, FREEDOM_SPEED_M2PS2, work, h, other)
    log_after = 0.0
    for by in (other, h):
        log_after = reweight(rows, work.variance, parameters.degrees, parameters.passes, work, h, by, other)
    first = compute_log_evidence(rows, work.variance, parameters.degrees, work.log_after[h], work, h, h)
    if compute_log_evidence(rows, work.variance, parameters.degrees, log_after, work, h, other) > first:
        work.log_after[h] = log_after
        for i in range(size):
            work.change[h, i] = work.change[other, i]
            for j in range(size):
                work.after[h, i, j] = work.after[other, i, j]
        for i in range(gnss + ns):
            work.weight[h, i], work.residual[h, i] = work.weight[other, i], work.residual[other, i]
            work.fitted[h, i] = work.fitted[other, i]


@borrowing
def _whiten_motion(rows: Rows, variance: Floats, work: Work, h: int) -> None:
    """Write six rows that say what phases and Dopplers say at their weights, each with a variance of 1.

    The factor of their normal matrix, over the standard deviations of the combinations, into `motion`, and behind it
    the values. Clocks come first: where one restarts, its variance is in one row alone. A row of what is not
    measured is 0.
    """
    root, motion, normal, nc = work.root, work.motion, work.normal, rows.counts[0]
    _write_normal(rows, variance, work, h, h)
    for r in range(MOTION):
        k = CLOCKS_FIRST[r]
        work.part[r] = normal[k, k]
        for c in range(MOTION + 1):
            motion[r, c] = 0.0
    for r in range(MOTION):
        k = CLOCKS_FIRST[r]
        if normal[k, k] <= LEAST_PIVOT * work.part[r]:
            continue
        scale = 1.0 / math.sqrt(normal[k, k])
        for q in range(r, MOTION):
            motion[r, CLOCKS_FIRST[q]] = scale * normal[k, CLOCKS_FIRST[q]]
        motion[r, MOTION] = scale * normal[k, MOTION]
        for q in range(r + 1, MOTION):
            a = motion[r, CLOCKS_FIRST[q]]
            for c in range(MOTION + 1):
                normal[CLOCKS_FIRST[q], c] -= a * motion[r, c]
    for r in range(MOTION):
        for c in range(MOTION):
            motion[r, c] *= root[h, nc + C_WAY + c]


@borrowing
def apply_update(rows: Rows, variance: Floats, work: Work, h: int) -> None:
    """Write mean and covariance of the compact unknowns after the epoch, and behind them the mean of the old place.

    With Y the covariance of the weighted measurements with the unknowns, S = L D L' that of their innovations without
    the clock of the codes, X = L^-1 Y, e and v what L^-1 makes of the clock's coefficients and the innovations, and q
    the information of the clock after them::

        P - X' D^-1 X + z z' / q        x + X' D^-1 v - z (e' D^-1 v) / q        z = X' D^-1 e
    """
    own, root, cross, system, motion, joint = work.own, work.root, work.cross, work.system, work.motion, work.joint
    nc, ns, n, found = rows.counts[0], rows.counts[3], work.new_covariance.shape[1], work.found
    gnss, size, scaled = nc + rows.counts[1] + rows.counts[2], nc + MOTION + ns, work.scaled
    first, sensors, width = nc + C_WAY, nc + COMBINED, found.shape[1]
    lower, pivots, end = work.lower, work.pivots, own.shape[2]
    ones, none, nothing = 2 * end, (lower.shape[0] - 1) * end, (found.shape[0] - 1) * width
    _whiten_motion(rows, variance, work, h)
    for i in range(nc):
        found[i, n + 1] = math.sqrt(work.weight[h, i] / variance[i])
        found[i, n + 2] = found[i, n + 1] * work.value[h, i]
        a = scaled[i] = found[i, n + 1] * root[h, i]
        for c in range(n + 1):
            found[i, c] = a * cross[h, i, c]
        for c in range(n + 3, width):
            found[i, c] = 0.0
        for j in range(i + 1):
            system[0, j, i] = a * scaled[j] * own[h, i, j]
        system[0, i, i] += 1.0
    for r in range(MOTION):
        i = nc + r
        of, at, row = (
            r * motion.shape[1],
            (h * own.shape[1] + first) * end,
            (h * cross.shape[1] + first) * cross.shape[2],
        )
        add_rows(joint, lower, pivots, motion, own, (r * end, none, ones, of, at), (1, end, 0, MOTION, end))
        places = i * width, nothing, ones, of, row
        add_rows(found, found, pivots, motion, cross, places, (1, cross.shape[2], 0, MOTION, width))
        for j in range(nc):
            system[0, j, i] = scaled[j] * joint[r, j]
        for q in range(r + 1):
            total = 0.0
            for k in range(MOTION):
                total += motion[q, k] * joint[r, first + k]
            system[0, nc + q, i] = total
        system[0, i, i] += 1.0
        found[i, n + 1], found[i, n + 2] = 0.0, motion[r, MOTION]
    for j in range(ns):
        i, k = nc + MOTION + j, sensors + j
        weight = math.sqrt(work.weight[h, gnss + j] / variance[gnss + j])
        found[i, n + 1], found[i, n + 2] = 0.0, weight * work.value[h, gnss + j]
        a = scaled[k] = weight * root[h, k]
        for c in range(n + 1):
            found[i, c] = a * cross[h, k, c]
        for c in range(n + 3, width):
            found[i, c] = 0.0
        for c in range(nc):
            system[0, c, i] = scaled[c] * a * own[h, k, c]
        for r in range(MOTION):
            system[0, nc + r, i] = a * joint[r, k]
        for c in range(sensors, k + 1):
            system[0, c - 1, i] = scaled[c] * a * own[h, k, c]
        system[0, i, i] += 1.0
    factorise(system, 0, size, work.factor, pivots)
    solve_forward(work.factor, size, pivots, found)
    _take_off(work, h, size, n, 1.0 / root[h, nc] ** 2)


@borrowing
def _take_off(work: Work, h: int, size: int, n: int, known: float) -> None:
    """Take off what `apply_update` has found: X, the clock of the codes and the values, not yet over D.

    `known` is the information of that clock before.
    """
    mean, spread, new_mean, new_covariance = work.mean, work.spread, work.new_mean, work.new_covariance
    found, pivots = work.found, work.pivots
    width, row, of, none = (
        found.shape[1],
        new_covariance.shape[2],
        spread.shape[1],
        (found.shape[0] - 1) * found.shape[1],
    )
    add_rows(found, found, pivots, found, found, (size * width, none, 0, n + 1, 0), (width, width, 0, size, width))
    known = known + found[size, n + 1]
    clock = found[size, n + 2] / known
    for c in range(n + 1):
        new_mean[h, c] = mean[h, c] - clock * found[size, c]
    for i in range(size):
        value = pivots[0, i] * found[i, n + 2]
        for c in range(n + 1):
            new_mean[h, c] += value * found[i, c]
    pivots[1, size] = 1.0 / known
    for c in range(n):
        places = (h * n + c) * row, (h * of + c) * of, pivots.shape[1], c, 0
        add_rows(new_covariance, spread, pivots, found, found, places, (width, width, 0, size + 1, whole_lanes(c + 1)))
        for e in range(c):
            new_covariance[h, e, c] = new_covariance[h, c, e]
