"""Stanford diagram: regions by hand, counts by a loop, continuity by walking every window."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.integrity.stanford import Region, stanford

pytestmark = pytest.mark.requirement("C4")

START = np.datetime64("2024-05-01T00:00:00", "ns")


def seconds(values: np.ndarray) -> np.ndarray:
    return START + np.round(np.asarray(values) * 1e9).astype("timedelta64[ns]")


def test_regions_by_hand():
    nan, inf = np.nan, np.inf
    rows = [  # error, level, region at an alarm limit of 10 m
        (1.0, 5.0, Region.NOMINAL),
        (-5.0, 5.0, Region.NOMINAL),
        (-6.0, 5.0, Region.MISLEADING),
        (10.0, 9.0, Region.MISLEADING),
        (10.1, 9.0, Region.HAZARDOUS),
        (-11.0, 10.0, Region.HAZARDOUS),
        (10.5, 11.0, Region.UNAVAILABLE),
        (12.0, 11.0, Region.UNAVAILABLE_MISLEADING),
        (99.0, inf, Region.UNAVAILABLE),
        (99.0, nan, Region.UNAVAILABLE),
        (nan, 5.0, Region.UNJUDGED),
        (nan, inf, Region.UNJUDGED),
        (nan, nan, Region.NO_POSITION),
    ]
    error, level, region = (np.array(column) for column in zip(*rows, strict=True))
    for array in (error, level):
        array.flags.writeable = False
    got = stanford(seconds(np.arange(len(rows))), error, level, alarm_limit_m=10.0)
    assert got.region.tolist() == region.tolist()
    assert got.counts == {r: region.tolist().count(r) for r in Region}
    assert sum(got.counts.values()) == len(rows)
    assert got.available_rate == 7 / 13
    # Excess: 6-5, 10-9, 10.1-9, 11-10, 12-11.
    assert got.beyond.tolist() == [4, 2, 3, 5, 7]
    assert got.histogram.sum() == 10
    assert got.histogram[5, 25] == 1  # error 1, level 5, in bins of 0.2 m
    assert got.histogram[50, 45] == 2  # errors 10 and 10.1, level 9
    assert got.histogram[60, 55] == 1  # 12 over 11
    assert got.histogram[99, 99] == 2  # without a bound: in the last bins
    assert got.edges_m[0] == 0
    assert np.isinf(got.edges_m[-1])
    assert len(got.edges_m) == 101


def walked(time: np.ndarray, available: np.ndarray, window_s: float, step_s: float) -> tuple[int, int]:
    """Windows and those kept, one by one: every moment of the grid must be an available epoch."""
    at = {int(t): bool(a) for t, a in zip((time - START).astype(np.int64), available, strict=True)}
    last, windows, kept = max(at), 0, 0
    for t, a in at.items():
        if a and t + window_s * 1e9 <= last:
            windows += 1
            grid = range(t, t + round(window_s * 1e9) + 1, round(step_s * 1e9))
            kept += all(at.get(g, False) for g in grid)
    return windows, kept


@pytest.mark.parametrize("seed", range(6))
def test_continuity_is_what_walking_every_window_finds(seed):
    rng = np.random.default_rng(seed)
    step = (1.0, 0.2)[seed % 2]
    time = np.arange(400) * step
    keep = rng.random(400) > 0.01  # epochs missing from the log: gaps
    keep[[0, -1]] = True
    level = np.where(rng.random(400) < 0.03, 30.0, 5.0)[keep]
    level[rng.random(len(level)) < 0.01] = np.nan
    got = stanford(seconds(time[keep]), np.zeros(len(level)), level, alarm_limit_m=20.0, windows_s=(2.0, 15.0, 60.0))
    for window in got.continuity:
        windows, kept = walked(seconds(time[keep]), level <= 20.0, window.window_s, step)
        assert (window.windows, window.kept) == (windows, kept)
        assert window.probability == pytest.approx(kept / windows)
    assert 0 < got.continuity[0].kept < got.continuity[0].windows


def test_blocks_add_up():
    rng = np.random.default_rng(3)
    time = np.sort(rng.choice(3600, 900, replace=False)).astype(float)
    time = time[(time < 1000) | (time > 1500)]  # a hole of whole blocks
    error, level = rng.normal(0.0, 8.0, len(time)), rng.uniform(2.0, 30.0, len(time))
    got = stanford(seconds(time), error, level, alarm_limit_m=20.0, block_s=60.0)
    minute = ((time - time[0]) // 60.0).astype(int)
    assert round(got.available_rate * len(time)) == np.count_nonzero(level <= 20.0)
    assert len(got.beyond) == np.count_nonzero(np.abs(error) > level)
    assert got.blocks == len(set(minute.tolist())) < (time[-1] - time[0]) / 60.0
    assert got.misleading_blocks == len(set(minute[np.abs(error) > level].tolist()))
    worst = np.argmax(np.abs(error) - level)
    assert got.beyond[0] == worst
    assert (np.abs(error)[got.beyond] > level[got.beyond]).all()


def test_histogram_counts_as_numpy_does():
    rng = np.random.default_rng(5)
    error, level = rng.normal(0.0, 6.0, 5000), rng.uniform(0.0, 50.0, 5000)
    got = stanford(seconds(np.arange(5000)), error, level, alarm_limit_m=20.0)
    edges = np.append(got.edges_m[:-1], 1e9)
    assert np.array_equal(got.histogram, np.histogram2d(np.abs(error), level, bins=[edges, edges])[0])
    assert got.edges_m[1] == pytest.approx(0.4)


def test_empty_and_single():
    none = stanford(seconds(np.zeros(0)), [], [], alarm_limit_m=20.0)
    assert np.isnan(none.available_rate)
    assert (none.blocks, none.misleading_blocks) == (0, 0)
    one = stanford(seconds(np.zeros(1)), [1.0], [2.0], alarm_limit_m=20.0)
    assert one.available_rate == 1.0
    assert np.isnan(one.continuity[0].probability)


def test_refusals():
    time = seconds(np.arange(3))
    with pytest.raises(ValueError, match="got 3, 2 and 3"):
        stanford(time, [1.0, 2.0], [1.0, 2.0, 3.0], alarm_limit_m=20.0)
    with pytest.raises(ValueError, match="ascend"):
        stanford(time[::-1], np.zeros(3), np.ones(3), alarm_limit_m=20.0)
    with pytest.raises(ValueError, match="negative"):
        stanford(time, np.zeros(3), -np.ones(3), alarm_limit_m=20.0)
    with pytest.raises(ValueError, match="positive"):
        stanford(time, np.zeros(3), np.ones(3), alarm_limit_m=0.0)


def test_the_unit_of_the_times_changes_nothing() -> None:
    time = np.datetime64("2024-01-01T00:00:00") + np.arange(100) * np.timedelta64(1, "s")
    fine = time.astype("datetime64[ns]")
    one, other = (stanford(t, np.zeros(100), np.ones(100), alarm_limit_m=5.0) for t in (time, fine))
    assert one.continuity == other.continuity
    assert one.continuity[0].kept > 0
