"""Compiled functions of `railfix.screens`: medians of receiver clocks, suspicions after jumps, ambiguity of angles."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers, Masks
from railfix.kernels.compiling import inner, kernel


@inner
def insert(ordered: Floats, count: int, value: float) -> None:
    """Put a value in its place among the first `count` of a rising array."""
    at = count
    while at > 0 and ordered[at - 1] > value:
        ordered[at] = ordered[at - 1]
        at -= 1
    ordered[at] = value


@kernel
def medians_of_clocks(values: Floats, clock: Indices, satellite: Indices, least: int) -> Floats:
    """Return the median of each clock at each of its channels, epoch by epoch."""
    epochs, channels = values.shape
    result = np.full((epochs, channels), np.nan)
    ordered, seen = np.empty(channels), np.empty(channels + 1, dtype=np.int64)
    clocks = 0
    for m in range(channels):
        clocks = max(clocks, clock[m] + 1)
    for t in range(epochs):
        for c in range(clocks):
            count, different = 0, 0
            for m in range(channels):
                value = values[t, m]
                if clock[m] != c or math.isnan(value):
                    continue
                insert(ordered, count, value)
                count += 1
                if different < least and math.isfinite(value):
                    known = False
                    for k in range(different):
                        known |= seen[k] == satellite[m]
                    if not known:
                        seen[different] = satellite[m]
                        different += 1
            if not count or different < least:
                continue
            median = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2.0
            for m in range(channels):
                if clock[m] == c:
                    result[t, m] = median
    return result


@kernel
def suspicions(
    time_ns: Integers, metric: Floats, limit: Floats, level_before: Floats, since_before: Integers, hold_ns: int
) -> tuple[Masks, Floats, Integers]:
    """Return rejections, levels, and the start of the suspicions at the end, channel by channel."""
    epochs, channels = metric.shape
    never = np.iinfo(np.int64).min
    reject, level = np.zeros((epochs, channels), dtype=np.bool_), np.zeros((epochs, channels))
    since = np.full(channels, never)
    for m in range(channels):
        start, total = since_before[m], level_before[m]
        for t in range(epochs):
            value = metric[t, m]
            if math.isnan(value):
                level[t, m] = np.nan
            if start != never:
                if math.isnan(value) or time_ns[t] > start + hold_ns:
                    start = never
                else:
                    total += value
                    if abs(total) <= limit[t, m]:
                        start = never
                        continue
                    reject[t, m], level[t, m] = True, total
                    continue
            if abs(value) > limit[t, m]:
                start, total = time_ns[t], value
                reject[t, m], level[t, m] = True, total
        since[m] = start
    return reject, level, since


@kernel
def largest_changes(elevation: Floats, azimuth: Floats, elevation_error: float, azimuth_error: float) -> Floats:
    """Return the largest change of the product of the cosines within errors of both angles, element by element."""
    epochs, channels = elevation.shape
    result = np.empty((epochs, channels))
    turn = 2.0 * math.pi
    ends = np.empty((2, 2))
    for t in range(epochs):
        for m in range(channels):
            product = 1.0
            for k in range(2):
                angle, error = (elevation[t, m], elevation_error) if k == 0 else (azimuth[t, m], azimuth_error)
                cosine, sine = math.cos(angle), math.sin(angle)
                product *= cosine
                one = cosine * math.cos(error) + sine * math.sin(error)
                other = cosine * math.cos(error) - sine * math.sin(error)
                ends[k, 0], ends[k, 1] = min(one, other), max(one, other)
                if abs(angle % turn - math.pi) <= error:
                    ends[k, 0] = -1.0
                if abs((angle + math.pi) % turn - math.pi) <= error:
                    ends[k, 1] = 1.0
            largest = 0.0 if math.isfinite(product) else np.nan
            for i in range(2):
                for j in range(2):
                    largest = max(largest, abs(ends[0, i] * ends[1, j] - product))
            result[t, m] = largest
    return result
