"""Find nearest times, and complete times of day or of week to full dates near a reference time."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Datetimes, Indices
from railfix.core.timescale import SECONDS_PER_DAY, SECONDS_PER_WEEK, from_week, seconds, timedelta, to_week


def nearest_rows(time: ArrayLike, wanted: ArrayLike, *, within_ns: int) -> Indices:
    """Return the index of the time nearest to each wanted time; -1 if none is within `within_ns` [ns].

    `time` is in ascending order. Of two equally near times, the earlier time is returned.
    """
    have, want = (np.asarray(each, dtype="datetime64[ns]").astype(np.int64) for each in (time, wanted))
    if not len(have):
        return np.full(len(want), -1, dtype=np.intp)
    after = np.minimum(have.searchsorted(want), len(have) - 1)
    before = np.maximum(after - 1, 0)
    row = np.where(np.abs(have[before] - want) <= np.abs(have[after] - want), before, after)
    return np.where(np.abs(have[row] - want) <= within_ns, row, -1)


def nearest_day(second_of_day: ArrayLike, near: ArrayLike) -> Datetimes:
    """Return, for each second of day [s], the time nearest to a reference time in the same time scale."""
    other = np.asarray(near, dtype="datetime64[ns]")
    same_day = other.astype("datetime64[D]").astype("datetime64[ns]") + timedelta(second_of_day)
    days = np.rint(seconds(other - same_day) / SECONDS_PER_DAY).astype(np.int64)
    return np.asarray(same_day + days.astype("timedelta64[D]"))


def nearest_week(seconds_of_week: ArrayLike, near: ArrayLike) -> Datetimes:
    """Return, for each second of week [s], the GPS time within half a week of a reference time."""
    week, sow = to_week(near)
    shift = np.rint((sow - np.asarray(seconds_of_week, dtype=np.float64)) / SECONDS_PER_WEEK)
    return from_week(week + shift.astype(np.int64), seconds_of_week)
