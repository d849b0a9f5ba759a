"""Selection of epochs and satellites of a log, by number, time and name."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

import railfix
from pipeline_cases import demo_observations
from railfix.gnss.observations import Observations

pytestmark = pytest.mark.requirement("G1")


@pytest.fixture(scope="module")
def log() -> Observations:
    return demo_observations()["front"]


def test_times_are_bounds_as_numbers_are(log: Observations) -> None:
    at = str(log.time[40])
    for bound in (log.time[40], at, at.replace("T", " "), at[11:]):
        assert np.array_equal(log[:bound].time, log.time[:40])
        assert np.array_equal(log[bound:].time, log.time[40:])
    assert len(log[str(log.time[3])[11:] : str(log.time[9])[11:]]) == 6
    assert np.shares_memory(log[2:9].code_m, log.code_m), "a view"


def test_a_time_of_day_after_midnight_is_of_the_next_day(log: Observations) -> None:
    night = replace(log, time=np.datetime64("2024-03-05T23:59:50", "ns") + (log.time - log.time[0]))
    assert night["00:00":].time[0] == np.datetime64("2024-03-06T00:00:00", "ns")  # type: ignore[misc]


def test_satellites_and_constellations(log: Observations) -> None:
    one = log[:5, "G06"]
    assert set(one.satellite) == {"G06"}
    np.testing.assert_array_equal(one.code_m, log.code_m[:5, log.satellite == "G06"])
    some = log[:5, ["E", "G06"]]
    assert set(some.satellite) == {"G06", *log.satellite[log.system == "E"]}
    with pytest.raises(KeyError, match="no G99 among the satellites"):
        log[:5, "G99"]
    for bound in ("noon", "2024-03-05T03:11:00Z", "03:11:00+09:00", datetime(2024, 3, 5, 3, 11, tzinfo=UTC), 0.5):
        with pytest.raises(KeyError, match="is not a GPS time"):
            log[bound:]  # type: ignore[misc]
    for rows in ("G06", 5, [1, 2]):
        with pytest.raises(KeyError, match=r"is not a range of epochs such as log\[10:20\]"):
            log[rows]  # type: ignore[index]


def test_a_datetime_is_a_bound(log: Observations) -> None:
    np.testing.assert_array_equal(log[datetime(2024, 3, 5, 3, 11) :].time, log["03:11:00":].time)  # type: ignore[misc]


def test_a_result_by_its_antenna(log: Observations) -> None:
    files = railfix.demo_files()
    path = railfix.Trajectory.from_antenna_path(railfix.read_track(files["track"]))
    navigation = railfix.read_navigation(files["nav"])
    processor = railfix.EpochProcessor(railfix.Config(filter="track"), {"front": path}, navigation=navigation)
    result, _ = processor.process({"front": log[:20]})
    assert result["front"] is result.antennas["front"]
    assert railfix.train_table(result).height == 20
