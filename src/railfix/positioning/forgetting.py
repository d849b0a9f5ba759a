"""Sums over earlier epochs with exponential forgetting, bit by bit the same however a log is cut into chunks."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Integers, Strings
from railfix.core.settings import Settings
from railfix.core.timescale import seconds

#: Windows that one running sum spans; exp(50) = 5e21, so that it overflows nowhere and keeps all digits of its terms.
_SPAN: Final = 50.0


def steps_s(time: Datetimes, last: np.datetime64) -> Floats:
    """Time since the epoch before, shape (T,) [s]; 0 where there is none.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    last : datetime64[ns]
        Epoch before the first one; NaT where there is none.
    """
    return steps_of(time.astype(np.int64), int(np.asarray(last, dtype="datetime64[ns]").astype(np.int64)))


def steps_of(time_ns: Integers, last_ns: int) -> Floats:
    """Compute `steps_s` of instants as numbers of nanoseconds."""
    time = np.concatenate([[last_ns], time_ns]).astype("datetime64[ns]")
    return np.fmax(seconds(np.diff(time)), 0.0)


def ages(time: Datetimes, last: np.datetime64, last_age: float, *, window_s: float, least_epochs: float) -> Floats:
    """Age of each epoch since the start of a log, shape (T,) [windows].

    A window is `window_s` or `least_epochs` epochs, whichever is longer: a gap ages what was learnt by one epoch, and a
    log of one epoch in half a minute is not forgotten faster than new epochs come.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    last : datetime64[ns]
        Epoch before the first one; NaT before all.
    last_age : float [windows]
        Of that epoch; 0 before all.
    window_s : float [s]
    """
    step = np.minimum(steps_s(time, last) / window_s, 1.0 / least_epochs)
    return np.cumsum(np.concatenate([[last_age], step]))[1:]


def decayed_sums(age: Floats, values: Floats, start: Floats, last_age: float) -> tuple[Floats, Floats]:
    """Sums of the values of all earlier epochs, each times ``exp(-difference of the ages)``.

    Running sums are kept in units of the decay since the start of a span of 50 windows, so that the same
    numbers are added in the same order wherever a chunk begins.

    Parameters
    ----------
    age : ndarray, shape (T,) [windows]
        `ages`.
    values : ndarray, shape (T, K)
    start : ndarray, shape (K,)
        Running sums after the epoch before the first one; 0 before all.
    last_age : float [windows]
        Of that epoch.

    Returns
    -------
    before : ndarray, shape (T, K)
        Decayed sums at each epoch, its own values not included.
    after : ndarray, shape (K,)
        Running sums after the last epoch: `start` of the next chunk.
    """
    return decayed(age, np.ascontiguousarray(values), np.asarray(start, dtype=np.float64), float(last_age))


def correlated_sums(
    time: Datetimes,
    values: Floats,
    start: Floats,
    last: np.datetime64,
    last_age: float,
    *,
    window_s: float,
    correlation_s: float,
) -> tuple[Floats, Floats, Floats, float]:
    """Sums over a window of epochs whose errors are alike for a time: each counts by the time since the one before.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    values : ndarray, shape (T, K)
        Of one sample.
    start, last, last_age
        As for `decayed_sums` and `ages`.
    window_s : float [s]
    correlation_s : float [s]
        Epochs nearer to each other than this count as one sample.

    Returns
    -------
    before : ndarray, shape (T, K)
        Decayed sums at each epoch, its own values not included.
    own : ndarray, shape (T, K)
        What each epoch adds.
    after : ndarray, shape (K,)
        Running sums after the last epoch.
    age : float [windows]
        Of the last epoch.
    """
    own = np.minimum(steps_s(time, last) / correlation_s, 1.0)[:, None] * values
    age = ages(time, last, last_age, window_s=window_s, least_epochs=window_s / correlation_s)
    before, after = decayed_sums(age, own, start, last_age)
    return before, own, after, float(age[-1]) if len(time) else last_age


def decayed(age: Floats, values: Floats, start: Floats, last_age: float) -> tuple[Floats, Floats]:
    """Compute `decayed_sums`; arrays in C order."""
    span = np.floor(age / _SPAN)
    current, of_current = start, np.floor(last_age / _SPAN)
    before = np.empty(values.shape)
    edges = np.flatnonzero(np.concatenate([[True], span[1:] != span[:-1], [True]])) if len(span) else np.zeros(1, int)
    for first, end in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        current = current * np.exp(-_SPAN * (span[first] - of_current))
        of_current = span[first]
        growth = np.exp(age[first:end] - _SPAN * of_current)[:, None]
        sums = np.cumsum(np.concatenate([current[None], growth * values[first:end]]), axis=0)
        before[first:end] = sums[:-1] / growth
        current = sums[-1]
    return before, current


class LastingErrorLimits(Settings):
    """When a satellite is wrong for long."""

    #: Time constant of the mean of the residuals: a minute, as reflections on a train that moves last less.
    memory_s: float = Field(default=60.0, gt=0)
    #: Standard deviations that a residual counts with at most: those of the weights, or of the receiver's noise where
    #: that is larger.
    clipped: float = Field(default=2.0, gt=0)
    #: Mean from which on a satellite is left out, over `clipped`. On recordings in cities without a fault the largest
    #: is 0.59, but for satellites seen by reflection alone; 20 m on one satellite reach it after 75 to 115 s.
    share: float = Field(default=0.62, gt=0, le=1)
    most_satellites: int = Field(default=2, ge=0, le=4)  #: Satellites left out at a time; 0: none.


@dataclass(frozen=True, kw_only=True)
class LastingErrorState:
    """Means of the residuals after the last epoch."""

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0  #: [windows].
    channel: Strings = field(default_factory=lambda: np.empty(0, dtype="<U6"))  #: Satellite and signal, shape (S,).
    #: Sums behind the noise of the ranges, those in error included (`railfix.positioning.noise_scale.NoiseState`);
    #: shape (2,).
    noise: Floats = field(default_factory=lambda: np.zeros(2))
    #: By turn: of the residuals of all ranges, then of those without the worst satellite, and so on; shape (S, P).
    sums: Floats = field(default_factory=lambda: np.empty((0, 0)))
