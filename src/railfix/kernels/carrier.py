"""Compiled functions of `railfix.positioning.carrier`: what slips are told by."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Integers
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.kernels.compiling import inner, kernel
from railfix.kernels.sorting import insert

#: `railfix.positioning.carrier.slips`: channels that a common step needs, least step of a clock, a light millisecond.
_COMMON, _CLOCK_STEP_M, _MILLISECOND_M = 3, 1e4, 1e-3 * SPEED_OF_LIGHT


@inner
def _median_or_zero(values: Floats, ordered: Floats) -> float:
    """Return the median of the finite values, 0 where there are fewer than three."""
    count = 0
    for m in range(len(values)):
        value = values[m]
        if not math.isfinite(value):
            continue
        insert(ordered, count, value)
        count += 1
    return 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2]) if count >= _COMMON else 0.0


@kernel
def slip_metrics(
    dt: Floats, code_m: Floats, phase_m: Floats, range_mps: Floats
) -> tuple[Floats, Integers, Floats, Floats]:
    """Return the clock steps, their milliseconds that phases lack, and both metrics, epoch by epoch."""
    epochs, channels = code_m.shape
    steps, lags = np.zeros(epochs), np.zeros(epochs, dtype=np.int64)
    doppler, apart = np.empty((epochs, channels)), np.empty((epochs, channels))
    ordered, values = np.empty(channels), np.empty(channels)
    for t in range(epochs):
        for m in range(channels):
            rate = range_mps[t, m]
            values[m] = code_m[t, m] - (0.0 if math.isnan(rate) else rate) * dt[t]
            apart[t, m] = code_m[t, m] - phase_m[t, m]
        step = _median_or_zero(values, ordered)
        if abs(step) > _CLOCK_STEP_M:
            steps[t] = step
        lags[t] = int(np.rint(_median_or_zero(apart[t], ordered) / _MILLISECOND_M))
        for m in range(channels):
            apart[t, m] -= lags[t] * _MILLISECOND_M
            doppler[t, m] = phase_m[t, m] - range_mps[t, m] * (dt[t] - steps[t] / SPEED_OF_LIGHT)
        common, of_codes = _median_or_zero(doppler[t], ordered), _median_or_zero(apart[t], ordered)
        for m in range(channels):
            doppler[t, m] -= common
            apart[t, m] -= of_codes
    return steps, lags, doppler, apart
