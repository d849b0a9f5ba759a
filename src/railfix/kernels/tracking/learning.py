"""Learning from an epoch: noise of phases and Dopplers, doubt, the map's lengths, faulty satellites.

The innovation of a code over its standard deviation has a mean near 0 over a minute, reflections included: they come
and go. A clock record that is wrong, or a reflection that lasts, keeps its sign. The mean of the innovations, each
clipped to a standard deviation, so that single large ones count little, distinguishes them: such a satellite's
codes are left out (`is_faulty`).
"""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.algebra import factorise
from railfix.kernels.tracking.constants import (
    BIAS_FAULTY,
    BIAS_MEMORY_S,
    BIAS_MOST,
    BIAS_SATELLITES,
    BIAS_SHORT,
    CODE_LEAK,
    LARGEST_SCALE,
    LEAST_SCALE,
    MISFIT_CLIPPED,
    MISFIT_CODES,
    MISFIT_LARGEST,
    MISFIT_LEARNT_S,
    MISFIT_MOST,
    MOTION_FIT_S,
    MOTION_LEAK,
    NOMINAL_M,
    SCALE_S,
    STEP_SIGMAS,
)
from railfix.kernels.tracking.layout import (
    FORCE_ROW,
    MAP_LOG_VARIANCE,
    MOTION_MISFIT,
    RANGE_ROW,
    SCALE_DOPPLER,
    SCALE_PHASE,
    SHIFT,
    SHIFT_VARIANCE,
    WEAK_CODE,
    WEAK_MOTION,
    WITHHELD,
    Inputs,
    KernelState,
    Outputs,
    Parameters,
    Rows,
    Work,
)
from railfix.kernels.tracking.update import mean_weights


@borrowing
def learn(
    inputs: Inputs, t: int, state: KernelState, rows: Rows, work: Work, best: int, shift: float, code_s: float
) -> bool:
    """Learn the noise of phases and Dopplers, doubt, the error of the map, and wrong codes.

    Returns whether another satellite's codes are left out from here on.
    """
    epochs, parameters, dt, found = inputs.epochs, inputs.parameters, inputs.epochs.interval_s[t], False
    scalars, weight, innovation = state.scalars, work.weight, work.innovation
    nc, nph, nd = rows.counts[0], rows.counts[1], rows.counts[2]
    gnss = nc + nph + nd
    share = 1.0 - math.exp(-min(dt, 1.0) / SCALE_S)
    for kind in range(2):
        begin, end = (nc, nc + nph) if kind == 1 else (nc + nph, gnss)
        scalar = SCALE_PHASE if kind == 1 else SCALE_DOPPLER
        if end - begin > 3:
            total = 0.0
            for i in range(begin, end):
                square = work.residual[best, i] ** 2 + work.fitted[best, i]
                total += weight[best, i] * square / work.variance[i]
            scalars[scalar] += share * math.log(total / (end - begin))
        scalars[scalar] = min(max(scalars[scalar], LEAST_SCALE), LARGEST_SCALE)
    code, motion = mean_weights(rows, work.variance, work, best)
    weak = motion < parameters.lost_motion_weight
    scalars[WEAK_MOTION] = scalars[WEAK_MOTION] + dt if weak else max(scalars[WEAK_MOTION] - MOTION_LEAK * dt, 0.0)
    misfit = 0.0 if math.isnan(motion) else 1.0 - motion
    for j in range(rows.counts[3]):
        misfit = 0.0 if rows.sensors[j] < FORCE_ROW else misfit
    scalars[MOTION_MISFIT] += (1.0 - math.exp(-dt / MOTION_FIT_S)) * (misfit - scalars[MOTION_MISFIT])
    if code_s > 0.0:
        weak = code < parameters.lost_code_weight
        gone = max(scalars[WEAK_CODE] - CODE_LEAK * code_s, 0.0)
        scalars[WEAK_CODE] = scalars[WEAK_CODE] + code_s if weak else gone
    learn_map(scalars, 0.0 if best else shift, code_s, parameters)
    beyond = early = 0
    for i in range(nc):
        k = rows.codes[i]
        sigma = epochs.code_sigma_m[t, k] * math.sqrt(1.0 + parameters.code_white_share**2)
        bias = state.code_bias[epochs.slot[k]]
        if abs(bias) > BIAS_FAULTY and abs(bias) * sigma > NOMINAL_M:
            beyond += 1
            early += bias < 0.0
        now = update_bias(state.code_bias, epochs.slot[k], innovation[best, i] / sigma, code_s)
        found = found or now
    if early and beyond > BIAS_SATELLITES:
        scalars[WITHHELD] = max(scalars[WITHHELD], parameters.level_hold_s)
    return found


@borrowing
def update_bias(code_bias: Floats, slot: int, innovation: float, code_s: float) -> bool:
    """Take a code's innovation over its standard deviation into the satellite's mean.

    Returns whether its codes are left out from here on.
    """
    before = is_faulty(code_bias[slot])
    share = 1.0 - math.exp(-min(code_s, 1.0) / BIAS_MEMORY_S)
    code_bias[slot] += share * (min(max(innovation, -BIAS_MOST), BIAS_MOST) - code_bias[slot])
    return is_faulty(code_bias[slot]) and not before


@borrowing
def is_faulty(code_bias: float) -> bool:
    """Return whether a mean of innovations is that of a satellite whose codes are left out."""
    return bool(code_bias > BIAS_FAULTY or code_bias < BIAS_SHORT)


@borrowing
def write_rows(outputs: Outputs, rows: Rows, work: Work, t: int, best: int, believed: float) -> None:
    """Write innovations and weights of the measurements; `believed` is 0 where none of them counts, 1 otherwise."""
    weight, innovation = work.weight, work.innovation
    nc, nph = rows.counts[0], rows.counts[1]
    gnss = nc + nph + rows.counts[2]
    code, motion = mean_weights(rows, work.variance, work, best)
    outputs.code_weight[t], outputs.motion_weight[t] = believed * code, believed * motion
    for i in range(gnss):
        kind = 0 if i < nc else (1 if i < nc + nph else 2)
        k = rows.codes[i] if kind == 0 else (rows.phases[i - nc] if kind == 1 else rows.dopplers[i - nc - nph])
        outputs.innovation[t, kind, k] = innovation[best, i]
        left_out = kind == 0 and outputs.faulty[t, k]
        outputs.weight[t, kind, k] = 0.0 if left_out else believed * weight[best, i]
        outputs.used[t, kind] += believed * weight[best, i] > 0.5 and not left_out
    for j in range(rows.counts[3]):
        kind = min(rows.sensors[j], RANGE_ROW)
        outputs.used[t, 3 + kind] += believed * weight[best, gnss + j] > 0.5
        outputs.sensed[t, kind] = innovation[best, gnss + j]


@borrowing
def code_shift(rows: Rows, work: Work, h: int) -> float:
    """Return the shift of the place that the codes of an epoch imply, over its standard deviation; 0 with few codes.

    The score of the innovations against a shift: standard normal and white over epochs where the model holds.
    """
    if rows.counts[0] < MISFIT_CODES:
        return 0.0
    nc, root, own, design, value = rows.counts[0], work.root, work.own, work.design, work.value
    system, factor, right = work.system, work.factor, work.right
    clock = root[h, nc]
    for i in range(nc):
        for j in range(i, nc):
            system[0, i, j] = (
                root[h, i] * root[h, j] * own[h, i, j]
                + clock * (root[h, i] * own[h, i, nc] + root[h, j] * own[h, j, nc])
                + clock * clock
            )
        system[0, i, i] += work.variance[i] / min(work.weight[h, i], 1.0)
    factorise(system, 0, nc, factor, work.pivots)
    # both solved forward: the products of L^-1 by the design with itself and with the values are what is wanted
    score, information = 0.0, 0.0
    for i in range(nc):
        right[i] = design[h, i, 0]
        work.ordered[i] = value[h, i]
    for i in range(nc):
        solved, other = work.pivots[0, i] * right[i], work.pivots[0, i] * work.ordered[i]
        score += right[i] * other
        information += right[i] * solved
        for j in range(i + 1, nc):
            right[j] -= factor[i, j] * solved
            work.ordered[j] -= factor[i, j] * other
    if not information > 0.0:
        return 0.0
    return float(min(max(score / math.sqrt(information), -MISFIT_MOST), MISFIT_MOST))


@borrowing
def learn_map(scalars: Floats, shift: float, dt: float, parameters: Parameters) -> None:
    """Take an epoch's shift into the running mean, and raise or lower the error of the map's lengths."""
    dt = min(dt, 1.0)
    share = 1.0 - math.exp(-dt / parameters.map_misfit_s)
    shift = 0.0 if abs(shift) > STEP_SIGMAS else min(max(shift, -MISFIT_CLIPPED), MISFIT_CLIPPED)
    mean = (1.0 - share) * scalars[SHIFT] + share * shift
    variance = (1.0 - share) ** 2 * scalars[SHIFT_VARIANCE] + share**2
    scalars[SHIFT], scalars[SHIFT_VARIANCE] = mean, variance
    beyond = abs(mean) / (math.sqrt(variance) * parameters.map_misfit_sigmas)
    scale = scalars[MAP_LOG_VARIANCE] * math.exp(-dt / parameters.map_misfit_kept_s)
    if beyond > 1.0:
        scale += 2.0 * math.log(beyond) * dt / MISFIT_LEARNT_S
    scalars[MAP_LOG_VARIANCE] = min(scale, MISFIT_LARGEST)
