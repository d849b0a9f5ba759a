"""Exponentially weighted sums over earlier epochs, for estimates of noise, biases and map offsets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from railfix import kernels
from railfix.core.arrays import Datetimes, Floats, Indices

#: Time of an epoch (NaT if there is none), and time since the start of the log in window lengths (`Windows.of`).
Dated = tuple[np.datetime64, float]


class Windows(NamedTuple):
    """Ages of T epochs of A antennas: times since the start of the log in window lengths."""

    step_s: Floats  #: Time since the previous epoch, shape (T,); 0 at the first epoch.
    growth: Floats  #: Exponential of the age since the start of the epoch's span (`kernels.windows.SPAN`), shape (T,).
    decay: Floats  #: Decay factor of the running sums, shape (T,); 1 unless a new span has begun.
    ends: Indices  #: Row after each antenna's last row, shape (A,).
    last: list[Dated]  #: Last epoch of each antenna.

    @classmethod
    def of(
        cls, time: Datetimes, parts: Sequence[slice], before: Sequence[Dated], *, window_s: float, least_epochs: float
    ) -> Windows:
        """Compute the ages. `parts` contains the rows of each antenna, and `before` contains the last epoch of each
        antenna in the previous chunk.

        A window has the length `window_s` or `least_epochs` epochs, whichever is longer. The time between two epochs,
        even after a gap, therefore counts as at most 1 / `least_epochs` of a window.
        """
        times, ages = zip(*before, strict=True)
        ends = np.array([len(time) if rows.stop is None else rows.stop for rows in parts], dtype=np.intp)
        step, in_span, begun, age = kernels.windows.window_ages(
            time.astype(np.int64), np.array(times, dtype="datetime64[ns]").view(np.int64),
            np.array(ages, dtype=np.float64), ends, float(window_s), float(least_epochs),
        )  # fmt: skip
        own = [time[rows] for rows in parts]
        last = [(new[-1] if len(new) else old, now) for new, old, now in zip(own, times, age.tolist(), strict=True)]
        return cls(step, np.exp(in_span), np.exp(-kernels.windows.SPAN * begun), ends, last)

    def sums(self, values: Floats, start: Floats) -> tuple[Floats, Floats]:
        """Return sums of `values` (T, K) over all earlier epochs with the weights ``exp(-age difference)``.

        `start`, shape (A, K), are the running sums of the previous chunk. The new running sums are also returned.
        """
        after, grown = np.array(start, dtype=np.float64), np.ascontiguousarray(self.growth[:, None] * values)
        return kernels.windows.decayed_sums(grown, self.growth, self.decay, after, self.ends), after


def correlated_sums(
    time: Datetimes,
    values: Floats,
    start: Floats,
    parts: Sequence[slice],
    before: Sequence[Dated],
    *,
    window_s: float,
    correlation_s: float,
) -> tuple[Floats, Floats, Floats, list[Dated]]:
    """Compute exponentially weighted sums over epochs with errors that are correlated over `correlation_s`.

    The weight of an epoch is the time since the previous epoch divided by `correlation_s`, but at most 1. For the other
    arguments, see `Windows.of` and `Windows.sums`. Return the sums before each epoch (T, K), the weighted values of
    each epoch (T, K), the running sums after the last epochs (A, K), and the last epoch of each antenna.
    """
    windows = Windows.of(time, parts, before, window_s=window_s, least_epochs=window_s / correlation_s)
    own = np.minimum(windows.step_s / correlation_s, 1.0)[:, None] * values
    sums, after = windows.sums(own, start)
    return sums, own, after, windows.last
