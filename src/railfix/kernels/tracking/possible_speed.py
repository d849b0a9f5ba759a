"""Speeds that a train can have after those measured so far (`railfix.tracking.possible_speed`)."""

from __future__ import annotations

import math

from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.layout import HYPOTHESES, LEAST_SPEED, MOST_SPEED, SPEED, Memory, Numbers, Rows, Work


@borrowing
def possible(numbers: Numbers, memory: Memory, rows: Rows, work: Work, dt: float, measured: bool) -> bool:
    """Return whether the speed after an epoch is possible, and narrow its range to it."""
    scalars, counts = memory.scalars, rows.counts
    low, high = -math.inf, math.inf
    if int(scalars[HYPOTHESES]) == 1:
        change = numbers.service_acceleration_mps2 * dt
        low, high = scalars[LEAST_SPEED] - change, scalars[MOST_SPEED] + change
        if measured:
            satellites = max(counts[1], counts[2])
            if not 0 < satellites < numbers.trusted_satellites or counts[3] > 0:
                low, high = -math.inf, math.inf
            speed = work.new_mean[0, SPEED]
            reach = numbers.speed_sigmas * math.sqrt(work.new_covariance[0, SPEED, SPEED])
            if speed + reach < low or speed - reach > high:
                return False
            low, high = max(low, speed - reach), min(high, speed + reach)
    scalars[LEAST_SPEED], scalars[MOST_SPEED] = low, high
    return True
