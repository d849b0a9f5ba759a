"""Sums over earlier epochs with exponential forgetting, of the epochs of several antennas one after the other."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers
from railfix.kernels.compiling import kernel

#: Windows that one running sum spans; exp(50) = 5e21, so that it overflows nowhere and keeps all digits of its terms.
_SPAN: Final = 50.0
_NAT: Final = np.iinfo(np.int64).min
_NS: Final = 1_000_000_000


@kernel
def window_ages(
    time_ns: Integers, last_ns: Integers, last_age: Floats, ends: Indices, window_s: float, least_epochs: float
) -> tuple[Floats, Floats, Floats]:
    """Return the time since the epoch before (T,) [s], ages (T,) and the ages at the end (A,) [windows]; see
    `Windows`.
    """
    step, age, end_age = np.zeros(len(time_ns)), np.empty(len(time_ns)), last_age.copy()
    first = 0
    for a in range(len(ends)):
        last = last_ns[a]
        for t in range(first, ends[a]):
            if last != _NAT and time_ns[t] > last:
                passed = time_ns[t] - last
                step[t] = passed // _NS + (passed % _NS) / _NS
            end_age[a] += min(step[t] / window_s, 1.0 / least_epochs)
            age[t], last = end_age[a], time_ns[t]
        first = ends[a]
    return step, age, end_age


@kernel
def decayed_sums(age: Floats, values: Floats, current: Floats, last_age: Floats, ends: Indices) -> Floats:
    """Return sums of the values (T, K) of all earlier epochs, each times ``exp(-difference of the ages)``.

    Running sums `current`, shape (A, K), are kept in units of the decay since the start of a span of 50 windows, so
    that the same numbers are added in the same order wherever a chunk begins; those after the last epochs replace them.
    """
    before, first = np.empty(values.shape), 0
    for a in range(len(ends)):
        span = math.floor(last_age[a] / _SPAN)
        for t in range(first, ends[a]):
            own = math.floor(age[t] / _SPAN)
            if own != span:
                current[a] *= math.exp(-_SPAN * (own - span))
                span = own
            growth = math.exp(age[t] - _SPAN * span)
            for k in range(values.shape[1]):
                before[t, k] = current[a, k] / growth
                current[a, k] += growth * values[t, k]
        first = ends[a]
    return before
