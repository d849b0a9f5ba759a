"""Time scales: leap seconds, weeks, and nothing lost below a nanosecond."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from railfix.core import nearest_times, timescale
from railfix.core.utc import gpst_to_utc

WEEK = timescale.SECONDS_PER_WEEK
NAT = np.datetime64("NaT", "ns")


def instant(text: str) -> np.datetime64:
    return np.datetime64(text, "ns")


@pytest.mark.parametrize(
    ("utc", "leap"),
    [
        ("1980-01-06T00:00:00", 0),
        ("1981-06-30T23:59:59.999999999", 0),
        ("1981-07-01T00:00:00", 1),
        ("1999-01-01T00:00:00", 13),
        ("2005-12-31T23:59:59", 13),
        ("2006-01-01T00:00:00", 14),
        ("2016-12-31T23:59:59.5", 17),
        ("2017-01-01T00:00:00", 18),
        ("2026-01-01T00:00:00", 18),
    ],
)
def test_leap_seconds_of_bulletin_c(utc: str, leap: int) -> None:
    assert timescale.gpst_minus_utc(instant(utc)) == leap
    assert timescale.utc_to_gpst(instant(utc)) - instant(utc) == np.timedelta64(leap, "s")
    assert gpst_to_utc(instant(utc) + np.timedelta64(leap, "s")) == instant(utc)


def test_weeks_against_known_dates() -> None:
    """Roll-overs of GPS weeks at 1999-08-22 and 2019-04-07 (IS-GPS-200; CGSIC notices)."""
    assert timescale.from_week(0, 0.0) == instant("1980-01-06")
    assert timescale.from_week(1024, 0.0) == instant("1999-08-22")
    assert timescale.from_week(2048, 0.0) == instant("2019-04-07")
    assert timescale.from_week(2111, 460_800.5) == instant("2020-06-26T08:00:00.5")
    week, sow = timescale.to_week(np.array([instant("2019-04-06T23:59:59.999999999"), instant("1980-01-05T00:00:00")]))
    assert week.tolist() == [2047, -1]
    np.testing.assert_array_equal(sow, [604799.999999999, 518400.0])


def test_origins_of_other_scales() -> None:
    assert timescale.bdt_to_gpst(timescale.BDT_EPOCH) == instant("2006-01-01T00:00:14")
    # GPST - UTC was 14 s when BDT was set to UTC, and 13 s at the origin of Galileo time.
    assert timescale.utc_to_gpst(timescale.BDT_EPOCH) == timescale.bdt_to_gpst(timescale.BDT_EPOCH)
    assert timescale.from_week(1024, 0.0) == instant("1999-08-22T00:00:00")


@given(week=st.integers(0, 4000), ns=st.integers(0, WEEK * 1_000_000_000 - 1))
def test_weeks_there_and_back_to_the_nanosecond(week: int, ns: int) -> None:
    time = timescale.from_week(week, 0.0) + np.timedelta64(ns, "ns")
    found, sow = timescale.to_week(time)
    assert found == week
    # A double holds a second of the week to 0.12 ns.
    assert abs(round(float(sow) * 1e9) - ns) <= 1
    assert timescale.from_week(found, sow) == time


@given(st.integers(-(2**60), 2**60))
def test_seconds_are_the_nearest_double(ns: int) -> None:
    assert timescale.seconds(np.timedelta64(ns, "ns")) == pytest.approx(ns / 1e9, rel=3e-16)


def test_short_differences_are_exact_anywhere_in_time() -> None:
    late = instant("2099-12-31T23:59:59.123456789")
    assert timescale.seconds(late + np.timedelta64(1, "ns") - late) == 1e-9


@given(st.integers(-(10**15), 10**15))
def test_timedelta_rounds_to_the_nanosecond(ns: int) -> None:
    assert abs(int(timescale.timedelta(ns / 1e9).astype(np.int64)) - ns) <= 1 + abs(ns) // 2**53


def test_absent_times_stay_absent() -> None:
    assert np.isnan(timescale.seconds(np.timedelta64("NaT", "ns")))
    assert np.isnat(timescale.timedelta([np.nan, np.inf])).all()
    assert timescale.seconds(np.array([NAT, timescale.GPS_EPOCH]) - timescale.GPS_EPOCH).tolist()[1] == 0.0


@given(
    near=st.datetimes(datetime(1980, 1, 20), datetime(2099, 1, 1)), offset_s=st.integers(-WEEK // 2 + 1, WEEK // 2 - 1)
)
def test_nearest_week_finds_any_time_within_half_a_week(near: datetime, offset_s: int) -> None:
    truth = near + timedelta(seconds=offset_s)
    sow = (truth - datetime(1980, 1, 6)).total_seconds() % WEEK
    found = nearest_times.nearest_week(sow, np.datetime64(near, "ns"))
    assert abs(found - np.datetime64(truth, "ns")) <= np.timedelta64(1, "us")


def test_functions_take_arrays_and_leave_them() -> None:
    times = np.array(["2017-01-01", "2016-01-01"], dtype="datetime64[ns]")
    times.flags.writeable = False
    assert (timescale.utc_to_gpst(times) - times).astype(int).tolist() == [18_000_000_000, 17_000_000_000]
    assert timescale.to_week(times)[0].shape == (2,)
    unix = datetime(2017, 1, 1, tzinfo=UTC).timestamp()
    assert times[0].astype(int) == unix * 1e9
