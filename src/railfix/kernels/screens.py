"""Levels of satellites after jumps of their codes; medians over the channels of a clock."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.kernels.compiling import kernel

#: A suspicion that there is none of: NaT as a number.
NEVER = np.iinfo(np.int64).min


@kernel
def suspicions(
    time_ns: Integers, metric: Floats, limit: Floats, level_before: Floats, since_before: Integers, hold_ns: int
) -> tuple[Masks, Floats, Integers]:
    """Follow the levels of satellites after jumps: each is summed from the jump on, so that a cut does not show.

    `metric` and `limit`, shape (T, M), in C order; level and start of suspicions before, shape (M,), `NEVER` for none.
    Returns the rejections, the levels (0 without suspicion, NaN without a metric), and the starts at the end.
    """
    epochs, channels = metric.shape
    reject, level = np.zeros((epochs, channels), dtype=np.bool_), np.empty((epochs, channels))
    since = np.full(channels, NEVER)
    for m in range(channels):
        start, total = since_before[m], level_before[m]
        suspected = start != NEVER
        for t in range(epochs):
            value = metric[t, m]
            level[t, m] = math.nan if math.isnan(value) else 0.0
            suspected = suspected and not math.isnan(value) and time_ns[t] <= start + hold_ns
            if suspected:
                total += value
                suspected = abs(total) > limit[t, m]  # the epoch of coming back is not judged again
            elif abs(value) > limit[t, m]:
                start, total, suspected = time_ns[t], value, True
            if suspected:
                reject[t, m], level[t, m] = True, total
        if suspected:
            since[m] = start
    return reject, level, since


@kernel
def clock_medians(values: Floats, clock: Indices, satellite: Indices, least: int) -> Floats:
    """Return the median of the values (T, M) of each clock at its channels; NaN is left out.

    NaN below `least` satellites with a finite value; clock and satellite of each channel are numbers, shape (M,).
    """
    epochs, channels = values.shape
    result = np.full(values.shape, math.nan)
    ordered, last_seen = np.empty(channels), np.full(channels, -1)
    for t in range(epochs):
        for c in range(clock.max() + 1 if channels else 0):
            count = satellites = 0
            for m in range(channels):
                value = values[t, m]
                if clock[m] != c or math.isnan(value):
                    continue
                at = count
                while at > 0 and ordered[at - 1] > value:
                    ordered[at] = ordered[at - 1]
                    at -= 1
                ordered[at], count = value, count + 1
                if last_seen[satellite[m]] != t and not math.isinf(value):
                    last_seen[satellite[m]], satellites = t, satellites + 1
            if count > 0 and satellites >= least:
                median = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2.0
                for m in range(channels):
                    if clock[m] == c:
                        result[t, m] = median
    return result
