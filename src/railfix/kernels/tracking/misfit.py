"""Error of the map's lengths learnt from codes that ask for another place."""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.algebra import factorise
from railfix.kernels.tracking.constants import (
    MISFIT_CLIPPED,
    MISFIT_CODES,
    MISFIT_LARGEST,
    MISFIT_LEARNT_S,
    MISFIT_MOST,
    STEP_SIGMAS,
)
from railfix.kernels.tracking.layout import MAP_LOG_VARIANCE, SHIFT, SHIFT_VARIANCE, Parameters, Rows, Work


@borrowing
def code_shift(rows: Rows, work: Work, h: int) -> float:
    """Shift of the place that the codes of an epoch ask for, over its standard deviation; 0 with too few codes.

    The score of the innovations against a shift: standard normal and white over epochs where the model holds.
    """
    if rows.counts[0] < MISFIT_CODES:
        return 0.0
    nc, root, own, design, value = rows.counts[0], work.root, work.own, work.design, work.value
    system, factor, right = work.system, work.factor, work.right
    clock = root[h, nc]
    for i in range(nc):
        for j in range(i, nc):
            system[h, i, j] = (
                root[h, i] * root[h, j] * own[h, i, j]
                + clock * (root[h, i] * own[h, i, nc] + root[h, j] * own[h, j, nc])
                + clock * clock
            )
        system[h, i, i] += work.variance[i] / min(work.weight[h, i], 1.0)
    factorise(system, h, nc, factor)
    # both solved forward: the products of U'^-1 by the design with itself and with the values are what is wanted
    score, information = 0.0, 0.0
    for i in range(nc):
        right[i] = design[h, i, 0]
        work.ordered[i] = value[h, i]
    for i in range(nc):
        solved, other = right[i] / factor[i, i], work.ordered[i] / factor[i, i]
        score += solved * other
        information += solved * solved
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
