"""GPS time as ``datetime64[ns]``, the internal time scale, and conversions to and from other time scales."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railfix.core.arrays import Datetimes, Floats, Integers
from railfix.core.constants import BDT_MINUS_GPST_S

GPS_EPOCH: Final = np.datetime64("1980-01-06T00:00:00", "ns")  #: Origin of GPS time (IS-GPS-200, 3.3.4).
#: Origin of BeiDou time, expressed in BDT (BDS-SIS-ICD-B1I 3.0, 3.3).
BDT_EPOCH: Final = np.datetime64("2006-01-01T00:00:00", "ns")

SECONDS_PER_WEEK: Final = 604_800
SECONDS_PER_DAY: Final = 86_400
_NS: Final = 1_000_000_000
_NAT: Final = np.iinfo(np.int64).min

#: UTC instants at which GPST - UTC changes: the difference is 0 s from the first instant on, and increases by 1 s at
#: each later instant (IERS Bulletin C).
LEAP_UTC: Final = np.array(
    [
        "1980-01-06", "1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01",
        "1990-01-01", "1991-01-01", "1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01",
        "1997-07-01", "1999-01-01", "2006-01-01", "2009-01-01", "2012-07-01", "2015-07-01",
        "2017-01-01",
    ],
    dtype="datetime64[ns]",
)  # fmt: skip


def gps_time(value: str | datetime | np.datetime64) -> np.datetime64:
    """Parse a GPS time; raise ValueError if the value is not a time or has a time zone."""
    text = str(value).strip().replace(" ", "T")
    if re.search(r":.*([Zz]|[+-][\d:]+)$", text):
        raise ValueError(f"{value} has a time zone; GPS time has none, and UTC is behind GPS time by the leap seconds")
    return np.datetime64(text, "ns")


def seconds(delta: ArrayLike) -> Floats:
    """Convert time differences to seconds; NaT becomes NaN."""
    count = np.asarray(delta, dtype="timedelta64[ns]").view(np.int64)
    whole, rest = np.divmod(count, _NS)
    return np.where(count == _NAT, np.nan, whole + rest / _NS)


def timedelta(seconds_s: ArrayLike) -> NDArray[np.timedelta64]:
    """Convert seconds to ``timedelta64[ns]``, rounded to the nanosecond; NaN becomes NaT."""
    value = np.asarray(seconds_s, dtype=np.float64)
    finite = np.isfinite(value)
    filled = np.where(finite, value, 0.0)
    full_s = np.floor(filled)
    ns = full_s.astype(np.int64) * _NS + np.rint((filled - full_s) * _NS).astype(np.int64)
    result = ns.astype("timedelta64[ns]")
    return np.where(finite, result, np.timedelta64("NaT", "ns"))


def from_week(week: ArrayLike, seconds_of_week: ArrayLike) -> Datetimes:
    """Convert full GPS week (no roll-over) and seconds of week to GPS time."""
    weeks = np.asarray(week, dtype=np.int64) * SECONDS_PER_WEEK
    result = GPS_EPOCH + weeks.astype("timedelta64[s]") + timedelta(seconds_of_week)
    return np.asarray(result, dtype="datetime64[ns]")


def to_week(time: ArrayLike) -> tuple[Integers, Floats]:
    """Convert GPS time to the full week number and seconds of week [s]."""
    ns = (np.asarray(time, dtype="datetime64[ns]") - GPS_EPOCH).astype(np.int64)
    week = ns // (SECONDS_PER_WEEK * _NS)
    rest = ns - week * (SECONDS_PER_WEEK * _NS)
    return week, (rest // _NS).astype(np.float64) + (rest % _NS) / _NS


def bdt_to_gpst(time: ArrayLike) -> Datetimes:
    """Convert BeiDou time to GPS time: GPST = BDT + 14 s."""
    shift = timedelta(-BDT_MINUS_GPST_S)
    return np.asarray(np.asarray(time, dtype="datetime64[ns]") + shift, dtype="datetime64[ns]")


def gpst_minus_utc(utc: ArrayLike) -> Integers:
    """Return the leap seconds GPST - UTC [s] that are in force at UTC instants."""
    at = np.asarray(utc, dtype="datetime64[ns]")
    return np.asarray(np.searchsorted(LEAP_UTC, at, side="right") - 1, dtype=np.int64)


def utc_to_gpst(utc: ArrayLike) -> Datetimes:
    """Convert UTC to GPS time with the table of leap seconds."""
    at = np.asarray(utc, dtype="datetime64[ns]")
    leap = gpst_minus_utc(at).astype("timedelta64[s]")
    return np.asarray(at + leap, dtype="datetime64[ns]")
