"""Sums over earlier epochs with exponential forgetting, bit by bit the same however a log is cut into chunks."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.core.timescale import seconds

#: Windows that one running sum spans; exp(50) = 5e21, so that it overflows nowhere and keeps all digits of its terms.
_SPAN: Final = 50


def steps_s(time: Datetimes, last: np.datetime64) -> Floats:
    """Time since the epoch before, shape (T,) [s]; 0 where there is none.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    last : datetime64[ns]
        Epoch before the first one; NaT where there is none.
    """
    before = np.concatenate([np.asarray([last], dtype="datetime64[ns]"), time])
    return np.maximum(np.nan_to_num(seconds(np.diff(before)), nan=0.0), 0.0)


def decayed_sums(
    time: Datetimes, values: Floats, start: Floats, last: np.datetime64, *, window_s: float
) -> tuple[Floats, Floats]:
    """Sums of the values of all earlier epochs, each times ``exp(-age / window)``.

    Running sums are kept in units of the decay since the start of a span of absolute time (a multiple of 50 windows),
    so that the same numbers are added in the same order wherever a chunk begins.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    values : ndarray, shape (T, K)
    start : ndarray, shape (K,)
        Running sums after the epoch before the first one; 0 before all.
    last : datetime64[ns]
        That epoch; NaT before all.
    window_s : float [s]
        Time after which a value counts for 1/e.

    Returns
    -------
    before : ndarray, shape (T, K)
        Decayed sums at each epoch, its own values not included.
    after : ndarray, shape (K,)
        Running sums after the last epoch: `start` of the next chunk.
    """
    window = round(window_s * 1e9)
    span, age = _span_and_age(time, window)
    current = np.asarray(start, dtype=np.float64)
    of_current = -1 if np.isnat(last) else int(_span_and_age(np.asarray([last], dtype="datetime64[ns]"), window)[0][0])
    before = np.empty(values.shape)
    edges = np.flatnonzero(np.concatenate([[True], span[1:] != span[:-1], [True]])) if len(span) else np.zeros(1, int)
    for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        if of_current >= 0:
            current = current * np.exp(-float(_SPAN) * (int(span[first]) - of_current))
        of_current = int(span[first])
        growth = np.exp(age[first:end])[:, None]
        sums = np.cumsum(np.concatenate([current[None], growth * values[first:end]]), axis=0)
        before[first:end] = sums[:-1] / growth
        current = sums[-1]
    return before, current


def _span_and_age(time: Datetimes, window_ns: int) -> tuple[Floats, Floats]:
    """Number of the span that each instant lies in, and windows since the start of that span."""
    instant = time.astype("datetime64[ns]").astype(np.int64)
    length = _SPAN * window_ns
    span = instant // length
    return span, (instant - span * length) / window_ns
