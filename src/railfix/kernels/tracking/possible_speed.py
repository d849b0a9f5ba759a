"""Speeds that a train can have after those measured so far.

Reflections off one wall can agree with each other on a speed and a place that are wrong; with few satellites in view
the measurements do not show it. The speed does: no train goes from 11 m/s to rest in a second.
The prediction's own standard deviation does not, as it grows with every epoch without redundancy.
"""

from __future__ import annotations

import math

from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.constants import (
    SPEED_SIGMAS,
)
from railfix.kernels.tracking.layout import (
    HYPOTHESES,
    LEAST_SPEED,
    MOST_SPEED,
    SPEED,
    KernelState,
    Parameters,
    Rows,
    Work,
)


@borrowing
def possible(parameters: Parameters, state: KernelState, rows: Rows, work: Work, dt: float, measured: bool) -> bool:
    """Return whether the speed after an epoch is possible, and narrow its range to it; no bounds on several branches.

    Enough satellites, or a sensor on board too, are believed whatever the range. Where the speed is not, the range
    grows by emergency braking, so that braking is followed from the next epoch.
    """
    scalars, counts = state.scalars, rows.counts
    low, high = -math.inf, math.inf
    if int(scalars[HYPOTHESES]) == 1:
        change = parameters.service_acceleration_mps2 * dt
        low, high = scalars[LEAST_SPEED] - change, scalars[MOST_SPEED] + change
        if measured:
            satellites = max(counts[1], counts[2])
            if not 0 < satellites < parameters.trusted_satellites or counts[3] > 0:
                low, high = -math.inf, math.inf
            speed = work.new_mean[0, SPEED]
            reach = SPEED_SIGMAS * math.sqrt(work.new_covariance[0, SPEED, SPEED])
            if speed + reach < low or speed - reach > high:
                change = parameters.level_acceleration_mps2 * dt
                scalars[LEAST_SPEED], scalars[MOST_SPEED] = low - change, high + change
                return False
            low, high = max(low, speed - reach), min(high, speed + reach)
    scalars[LEAST_SPEED], scalars[MOST_SPEED] = low, high
    return True
