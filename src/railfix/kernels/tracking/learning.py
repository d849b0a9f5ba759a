"""What an epoch teaches: noise of phases and Dopplers, doubt, the map's lengths, faulty satellites."""

from __future__ import annotations

import math

from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.layout import (
    SCALE_DOPPLER,
    SCALE_PHASE,
    WEAK_CODE,
    WEAK_MOTION,
    Answers,
    Epochs,
    Memory,
    Numbers,
    Rows,
    Work,
)
from railfix.kernels.tracking.misfit import learn_map
from railfix.kernels.tracking.update import mean_weights


@borrowing
def learn(
    epochs: Epochs,
    numbers: Numbers,
    memory: Memory,
    answers: Answers,
    rows: Rows,
    work: Work,
    t: int,
    best: int,
    shift: float,
    dt: float,
    code_s: float,
) -> bool:
    """Learn the noise of phases and Dopplers and the error of the map; write weights and innovations.

    Returns whether another satellite's codes are left out from here on.
    """
    found = False
    scalars, weight, innovation = memory.scalars, work.weight, work.innovation
    nc, nph, nd = rows.counts[0], rows.counts[1], rows.counts[2]
    gnss = nc + nph + nd
    share = 1.0 - math.exp(-min(dt, 1.0) / numbers.scale_s)
    for kind in range(2):
        begin, end = (nc, nc + nph) if kind == 1 else (nc + nph, gnss)
        scalar = SCALE_PHASE if kind == 1 else SCALE_DOPPLER
        if end - begin > 3:
            total = 0.0
            for i in range(begin, end):
                square = work.residual[best, i] ** 2 + work.fitted[best, i]
                total += weight[best, i] * square / work.variance[i]
            scalars[scalar] += share * math.log(total / (end - begin))
        scalars[scalar] = min(max(scalars[scalar], numbers.least_scale), numbers.largest_scale)
    code, motion = mean_weights(rows, work.variance, work, best)
    weak = motion < numbers.lost_motion_weight
    scalars[WEAK_MOTION] = (
        scalars[WEAK_MOTION] + dt if weak else max(scalars[WEAK_MOTION] - numbers.motion_leak * dt, 0.0)
    )
    if code_s > 0.0:
        weak = code < numbers.lost_code_weight
        gone = max(scalars[WEAK_CODE] - numbers.code_leak * code_s, 0.0)
        scalars[WEAK_CODE] = scalars[WEAK_CODE] + code_s if weak else gone
    learn_map(scalars, 0.0 if best else shift, code_s, numbers)
    answers.code_weight[t], answers.motion_weight[t] = code, motion
    for i in range(gnss):
        kind = 0 if i < nc else (1 if i < nc + nph else 2)
        k = rows.codes[i] if kind == 0 else (rows.phases[i - nc] if kind == 1 else rows.dopplers[i - nc - nph])
        answers.innovation[t, kind, k] = innovation[best, i]
        left_out = kind == 0 and answers.faulty[t, k]
        answers.weight[t, kind, k] = 0.0 if left_out else weight[best, i]
        answers.used[t, kind] += weight[best, i] > 0.5 and not left_out
        if kind == 0:
            slot, sigma = epochs.slot[k], epochs.code_sigma_m[t, k] * math.sqrt(1.0 + numbers.code_white_share**2)
            away = min(max(innovation[best, i] / sigma, -numbers.bias_most), numbers.bias_most)
            share = 1.0 - math.exp(-min(code_s, 1.0) / numbers.bias_memory_s)
            before = abs(memory.code_bias[slot])
            memory.code_bias[slot] += share * (away - memory.code_bias[slot])
            found = found or before <= numbers.bias_faulty < abs(memory.code_bias[slot])
    for j in range(rows.counts[3]):
        answers.used[t, 3 + rows.sensors[j]] += weight[best, gnss + j] > 0.5
        answers.sensed[t, rows.sensors[j]] = innovation[best, gnss + j]
    return found
