"""Compiled functions of `railfix.positioning.forgetting`: ages of epochs and decayed sums."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Integers
from railfix.kernels.compiling import kernel

_NS, _NEVER = 1_000_000_000, np.iinfo(np.int64).min
#: `railfix.positioning.forgetting._SPAN`.
_SPAN = 50.0


@kernel
def steps_of(time_ns: Integers, last_ns: int) -> Floats:
    """Return the time since the epoch before, epoch by epoch."""
    steps = np.zeros(len(time_ns))
    before = last_ns
    for t in range(len(time_ns)):
        if before != _NEVER and time_ns[t] != _NEVER:
            step = time_ns[t] - before
            steps[t] = max((step // _NS) + (step % _NS) / _NS, 0.0)
        before = time_ns[t]
    return steps


@kernel
def decayed(age: Floats, values: Floats, start: Floats, last_age: float) -> tuple[Floats, Floats]:
    """Return the decayed sums at each epoch and the running sums after the last one, epoch by epoch."""
    epochs, width = values.shape
    before, current = np.empty((epochs, width)), start.copy()
    of_current = math.floor(last_age / _SPAN)
    for t in range(epochs):
        span = math.floor(age[t] / _SPAN)
        if t == 0 or span != of_current:
            decay = math.exp(-_SPAN * (span - of_current))
            for k in range(width):
                current[k] *= decay
            of_current = span
        growth = math.exp(age[t] - _SPAN * of_current)
        for k in range(width):
            before[t, k] = current[k] / growth
            current[k] += growth * values[t, k]
    return before, current
