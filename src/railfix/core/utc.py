"""Conversion of GPS time to UTC, and the GPS time now."""

from __future__ import annotations

import time as clock

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Datetimes
from railfix.core.timescale import GPS_EPOCH, LEAP_UTC, utc_to_gpst


def gps_now_ns() -> int:
    """Return the time of the computer's clock as GPS time since `GPS_EPOCH` [ns]."""
    return int((utc_to_gpst(np.datetime64(clock.time_ns(), "ns")) - GPS_EPOCH).astype(np.int64))


def gpst_to_utc(time: ArrayLike) -> Datetimes:
    """Convert GPS time to UTC; a time in an inserted leap second is mapped to the second after it."""
    at = np.asarray(time, dtype="datetime64[ns]")
    leap = np.searchsorted(utc_to_gpst(LEAP_UTC), at, side="right") - 1
    return np.asarray(at - leap.astype("timedelta64[s]"), dtype="datetime64[ns]")
