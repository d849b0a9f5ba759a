"""Signs of interference in C/N0 and in the gain of the front end."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Strings
from railfix.core.timescale import GPS_EPOCH, seconds
from railfix.integrity.interference.limits import InterferenceLimits

_MINUTE_S: Final = 60.0
#: The gain's peak is forgotten by this share of it a minute.
_GAIN_DECAY_PER_MIN: Final = 0.005
#: Satellites not heard for longer are not compared with what they were [s].
_LONGEST_SILENCE_S: Final = 60.0


@dataclass(frozen=True, kw_only=True)
class PowerState:
    """State after a chunk, by channel ("G01" + "1C")."""

    channel: Strings = field(default_factory=lambda: np.zeros(0, dtype="<U5"))  #: Shape (K,).
    #: Peak of C/N0 plus the decay since the GPS epoch; -inf before the first; shape (K,).
    peak_db: Floats = field(default_factory=lambda: np.zeros(0))
    #: When its present time of tracking began, and its last observation, since the GPS epoch; NaN before; shape (K,).
    first_s: Floats = field(default_factory=lambda: np.zeros(0))
    last_s: Floats = field(default_factory=lambda: np.zeros(0))
    gain: float = -np.inf  #: Peak of the gain's logarithm plus the decay since the GPS epoch.


@dataclass(frozen=True, kw_only=True)
class PowerSigns:
    """Statistics of T epochs; NaN where too few satellites are compared."""

    #: Median and standard deviation of the falls of C/N0 below the recent peak of each satellite, shape (T,).
    fall_db: Floats
    spread_db: Floats
    difference_db: Floats  #: Standard deviation of C/N0 over the satellites, shape (T,).
    #: Fall of the gain as a share of its recent peak; NaN where the receiver does not give it; shape (T,).
    gain_fall: Floats


def power_signs(
    time: Datetimes,
    channel: Strings,
    cn0_dbhz: Floats,
    gain: Floats,
    state: PowerState,
    limits: InterferenceLimits,
) -> tuple[PowerSigns, PowerState]:
    """Return the statistics of C/N0 and gain, and the state to pass on.

    The recent peak of a satellite falls by `peak_decay_db_per_min`: a slow change of the sky passes, a jammer that
    stays is seen for minutes.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    channel : ndarray of str, shape (K,)
        Satellite and signal, one signal of each satellite at an epoch.
    cn0_dbhz : ndarray, shape (T, K)
    gain : ndarray, shape (T,)
        In the receiver's unit, + for more gain; NaN where unknown.
    """
    seen, now = np.isfinite(cn0_dbhz), seconds(time - GPS_EPOCH)[:, None]
    peak, first, last = _arranged(state, channel)
    decay = limits.peak_decay_db_per_min / _MINUTE_S
    peaks = np.maximum.accumulate(np.vstack([peak, np.where(seen, cn0_dbhz + decay * now, -np.inf)]), axis=0)[1:]
    lasts = np.fmax.accumulate(np.vstack([last, np.where(seen, now, np.nan)]), axis=0)
    begun = seen & ~(now - lasts[:-1] <= _LONGEST_SILENCE_S)
    firsts = np.fmax.accumulate(np.vstack([first, np.where(begun, now, np.nan)]), axis=0)[1:]
    compared = seen & (now - firsts >= limits.known_after_s)
    fall = np.where(compared, peaks - decay * now - cn0_dbhz, np.nan)
    enough = np.count_nonzero(compared, axis=1) >= limits.least_satellites
    forgotten = _GAIN_DECAY_PER_MIN / _MINUTE_S * now[:, 0]
    logarithm = np.log(np.where(gain > 0, gain, np.nan))
    gains = np.fmax.accumulate(np.concatenate([[state.gain], logarithm + forgotten]))[1:]
    signs = PowerSigns(
        fall_db=np.where(enough, _median(fall), np.nan),
        spread_db=np.where(enough, _deviation(fall), np.nan),
        difference_db=np.where(np.count_nonzero(seen, axis=1) >= limits.least_satellites, _deviation(cn0_dbhz), np.nan),
        gain_fall=1.0 - np.exp(logarithm + forgotten - gains),
    )
    if not len(time):
        return signs, state
    after = PowerState(channel=channel, peak_db=peaks[-1], first_s=firsts[-1], last_s=lasts[-1], gain=float(gains[-1]))
    return signs, after


def _median(values: Floats) -> Floats:
    """Return the median of each row over what is not NaN, shape (T,); NaN where nothing is."""
    if not values.shape[1]:
        return np.full(len(values), np.nan)
    ordered, count = np.sort(values, axis=1), np.count_nonzero(~np.isnan(values), axis=1)  # NaN last
    rows, last = np.arange(len(values)), values.shape[1] - 1
    return np.asarray(
        (ordered[rows, np.maximum(count - 1, 0) // 2] + ordered[rows, np.minimum(count // 2, last)]) / 2.0
    )


def _deviation(values: Floats) -> Floats:
    """Return the standard deviation of each row over what is not NaN, shape (T,)."""
    has = np.isfinite(values)
    count = np.maximum(np.count_nonzero(has, axis=1), 1)
    mean = np.where(has, values, 0.0).sum(axis=1) / count
    return np.asarray(np.sqrt(np.where(has, (values - mean[:, None]) ** 2, 0.0).sum(axis=1) / count))


def _arranged(state: PowerState, channel: Strings) -> tuple[Floats, Floats, Floats]:
    """Return peaks, beginnings and last observations on other channels."""
    peak, first, last = np.full(len(channel), -np.inf), np.full(len(channel), np.nan), np.full(len(channel), np.nan)
    _, here, there = np.intersect1d(channel, state.channel, return_indices=True)
    peak[here], first[here], last[here] = state.peak_db[there], state.first_s[there], state.last_s[there]
    return peak, first, last
