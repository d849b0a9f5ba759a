"""Exponentially weighted sums over earlier epochs of several antennas, whose epochs are stored one after another."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers
from railfix.kernels.compiling import kernel

#: Length of a span, in windows: terms of at most exp(50) = 5e21 neither overflow nor lose digits.
SPAN: Final = 50.0
_NAT: Final = np.iinfo(np.int64).min
_NS: Final = 1_000_000_000


@kernel
def window_ages(
    time_ns: Integers, last_ns: Integers, last_age: Floats, ends: Indices, window_s: float, least_epochs: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the ages (elapsed times in units of `window_s`) of T epochs of A antennas.

    `ends` has the index after each antenna's last row. `last_ns`, shape (A,), is the time of each antenna's previous
    epoch, or NaT. Return three arrays of shape (T,): time since the previous epoch [s], age within the current span of
    `SPAN` windows, and number of spans begun since the previous epoch. Also return each antenna's last age, shape (A,).
    """
    epochs = len(time_ns)
    step, in_span, begun, end_age = np.zeros(epochs), np.empty(epochs), np.empty(epochs), last_age.copy()
    first = 0
    for a in range(len(ends)):
        last, span = last_ns[a], math.floor(last_age[a] / SPAN)
        for t in range(first, ends[a]):
            if last != _NAT and time_ns[t] > last:
                passed = time_ns[t] - last
                step[t] = passed // _NS + (passed % _NS) / _NS
            end_age[a] += min(step[t] / window_s, 1.0 / least_epochs)
            own = math.floor(end_age[a] / SPAN)
            in_span[t], begun[t] = end_age[a] - SPAN * own, own - span
            last, span = time_ns[t], own
        first = ends[a]
    return step, in_span, begun, end_age


@kernel
def decayed_sums(values: Floats, growth: Floats, decay: Floats, current: Floats, ends: Indices) -> Floats:
    """Return for each epoch the sum of the values of earlier epochs with the weights ``exp(-difference of ages)``.

    `values`, shape (T, K), are already multiplied by `growth`. The running sums `current`, shape (A, K), are updated in
    place. Values and sums refer to the start of a span, so that the division into chunks has no effect on results.
    """
    before, first = np.empty(values.shape), 0
    for a in range(len(ends)):
        for t in range(first, ends[a]):
            if decay[t] != 1.0:
                for k in range(values.shape[1]):
                    current[a, k] *= decay[t]
            for k in range(values.shape[1]):
                before[t, k] = current[a, k] / growth[t]
                current[a, k] += values[t, k]
        first = ends[a]
    return before
