"""Exponentially weighted sums over earlier epochs, for several antennas whose epochs are stored one after another."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers
from railfix.kernels.compiling import kernel

#: Length of a span, in windows; exp(50) = 5e21 neither overflows nor loses digits of the terms.
SPAN: Final = 50.0
_NAT: Final = np.iinfo(np.int64).min
_NS: Final = 1_000_000_000


@kernel
def window_ages(
    time_ns: Integers, last_ns: Integers, last_age: Floats, ends: Indices, window_s: float, least_epochs: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return ages of T epochs of A antennas; each antenna's rows end at `ends`, the epoch before is `last_ns` or NaT.

    Three arrays have shape (T,): time since the previous epoch [s], age within the current span of `SPAN` windows, and
    number of spans begun since the previous epoch. The fourth has the ages after the last epochs, shape (A,) [windows].
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
    """Return for each epoch the sum of the values (T, K) of all earlier epochs, weighted by ``exp(-difference of
    ages)``.

    `values` are already multiplied by `growth`. The running sums `current`, shape (A, K), are multiplied by the growth
    since the start of a span, so that the order of additions does not depend on where a chunk begins; the new sums
    replace them.
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
