"""Kernels of the screens: code offsets after jumps, medians per receiver clock, and signs of interference."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.kernels.compiling import inner, kernel

#: Integer value of NaT, which stands for the time of an event that has not occurred.
NEVER = np.iinfo(np.int64).min
_NS = 1_000_000_000


@inner
def insert(ordered: Floats, size: int, value: float) -> None:
    """Insert a value into `size` sorted values."""
    j = size
    while j > 0 and ordered[j - 1] > value:
        ordered[j] = ordered[j - 1]
        j -= 1
    ordered[j] = value


@inner
def middle(ordered: Floats, size: int) -> float:
    """Return the median of sorted values."""
    if size % 2:
        return float(ordered[size // 2])
    return float(0.5 * (ordered[size // 2 - 1] + ordered[size // 2]))


@kernel
def suspicions(
    time_ns: Integers, metric: Floats, limit: Floats, level_before: Floats, since_before: Integers, hold_ns: int
) -> tuple[Masks, Floats, Integers]:
    """Track the offset of each channel's code after a jump.

    An offset is the sum of the metric since the jump, so that chunk boundaries have no effect. `metric` and `limit`
    have shape (T, M), in C order. `level_before` and `since_before`, shape (M,), are offsets and starts of suspicions
    before the chunk; the start is `NEVER` if there is no suspicion. Return a mask of rejected codes; offsets, 0 where
    there is no suspicion and NaN where the metric is NaN; and the starts of suspicions at the end of the chunk.
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
                suspected = abs(total) > limit[t, m]  # an epoch at which a suspicion ends is not tested for a new jump
            elif abs(value) > limit[t, m]:
                start, total, suspected = time_ns[t], value, True
            if suspected:
                reject[t, m], level[t, m] = True, total
        if suspected:
            since[m] = start
    return reject, level, since


@kernel
def clock_medians(values: Floats, clock: Indices, satellite: Indices, least: int) -> Floats:
    """For each channel, return the median of the values of all channels with the same clock, shape (T, M).

    NaN values are ignored. A median is NaN if fewer than `least` satellites have finite values. `clock` and `satellite`
    are the indices of each channel's clock and satellite, shape (M,).
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


@inner
def _deviation(values: Floats, count: int) -> float:
    """Return the standard deviation of the first `count` values."""
    total = square = 0.0
    for k in range(count):
        total += values[k]
    for k in range(count):
        square += (values[k] - total / count) ** 2
    return math.sqrt(square / count)


@kernel
def falls_of_cn0(
    now_s: Floats,
    cn0_dbhz: Floats,
    before: tuple[Floats, Floats, Floats],
    decay: float,
    silence_s: float,
    known_after_s: float,
    least: int,
) -> tuple[Floats, Floats, Floats, tuple[Floats, Floats, Floats]]:
    """Return statistics of falls of C/N0 below recent peaks (`PowerSigns`), shape (T,), and `before` of the next chunk.

    `before` are peaks, start times and last observation times of `PowerState`, shape (K,). `decay` is in dB/s.
    """
    epochs, channels = cn0_dbhz.shape
    peak, first, last = before[0].copy(), before[1].copy(), before[2].copy()
    fall, spread, difference = np.full(epochs, math.nan), np.full(epochs, math.nan), np.full(epochs, math.nan)
    seen, falls = np.empty(channels), np.empty(channels)
    for t in range(epochs):
        count = compared = 0
        now = now_s[t]
        for m in range(channels):
            value = cn0_dbhz[t, m]
            if not math.isfinite(value):
                continue
            seen[count], count = value, count + 1
            peak[m] = max(peak[m], value + decay * now)
            if not now - last[m] <= silence_s:
                first[m] = now
            last[m] = now
            if now - first[m] >= known_after_s:
                insert(falls, compared, peak[m] - decay * now - value)
                compared += 1
        if compared >= least:
            fall[t] = middle(falls, compared)
            spread[t] = _deviation(falls, compared)
        if count >= least:
            difference[t] = _deviation(seen, count)
    return fall, spread, difference, (peak, first, last)


@kernel
def clock_steps(
    time_ns: Integers,
    break_before: Masks,
    code_m: Floats,
    rate_mps: Floats,
    before: tuple[Floats, Floats, Integers],
    longest_s: float,
    least: int,
) -> tuple[Floats, tuple[Floats, Floats, Integers]]:
    """Return the median over channels of code change minus integrated Doppler, shape (T,), and the next `before`.

    `before` has the last code, Doppler and time of each channel, shape (K,). Values are not compared across a break or
    after more than `longest_s`. The median is NaN if there are fewer than `least` channels.
    """
    epochs, channels = code_m.shape
    code, rate, since = before[0].copy(), before[1].copy(), before[2].copy()
    step, changes = np.full(epochs, math.nan), np.empty(channels)
    for t in range(epochs):
        count = finite = 0
        for m in range(channels):
            if break_before[t]:
                code[m] = math.nan
            if not (math.isfinite(code_m[t, m]) and math.isfinite(rate_mps[t, m])):
                continue
            passed = time_ns[t] - since[m] if since[m] != NEVER else 0
            dt = passed // _NS + (passed % _NS) / _NS
            change = code_m[t, m] - code[m] - (rate_mps[t, m] + rate[m]) / 2.0 * dt
            if since[m] != NEVER and dt <= longest_s and not math.isnan(change):
                insert(changes, count, change)
                count += 1
                finite += math.isfinite(change)
            code[m], rate[m], since[m] = code_m[t, m], rate_mps[t, m], time_ns[t]
        if count > 0 and finite >= least:
            step[t] = middle(changes, count)
    return step, (code, rate, since)


@kernel
def holds(
    time_ns: Integers,
    signs: Masks,
    time_before: int,
    before: tuple[Integers, Integers],
    hold_ns: Integers,
    release_s: Floats,
) -> tuple[Masks, Masks, tuple[Integers, Integers]]:
    """Return two masks, shape (T, C), of conditions that have been true for `hold_ns`, and of active conditions.

    A condition that has counted as true stays active for `release_s` (`integrity.interference.limits.hold_signs`).
    `before` has each condition's duration and last time as true, shape (C,). Also return the next `before`.
    """
    epochs, conditions = signs.shape
    run, last, previous = before[0].copy(), before[1].copy(), time_before
    counts, stays = np.zeros((epochs, conditions), dtype=np.bool_), np.zeros((epochs, conditions), dtype=np.bool_)
    for t in range(epochs):
        for c in range(conditions):
            run[c] = run[c] + min(time_ns[t] - previous, max(hold_ns[c] // 2, 0)) if signs[t, c] else 0
            counts[t, c] = signs[t, c] and run[c] >= hold_ns[c]
            if counts[t, c]:
                last[c] = time_ns[t]
            passed = time_ns[t] - last[c] if last[c] != NEVER else 0
            stays[t, c] = last[c] != NEVER and passed // _NS + (passed % _NS) / _NS <= release_s[c]
        previous = time_ns[t]
    return counts, stays, (run, last)
