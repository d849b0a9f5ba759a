"""Epochs of one log in order of time: sorted, merged, rejected, whatever the runs in which they come."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.core.errors import InputFileError
from railfix.gnss.observations import Observations
from railfix.io.epoch_order import MOST_PASSED, EpochOrder

pytestmark = pytest.mark.requirement("G5")

START = np.datetime64("2024-01-01", "ns")
WRONG = 10**7


def observations(seconds: list[int], *, system: str = "G") -> Observations:
    """One satellite whose code is the second of its epoch."""
    count = len(seconds)
    at = np.array(seconds)
    blank = np.full((count, 1), np.nan)
    return Observations(
        time=START + at.astype("timedelta64[s]"), satellite=np.array([f"{system}01"]), signal=np.array(["1C"]),
        code_m=at[:, None] * 1.0, phase_cycles=blank, doppler_hz=blank, cn0_dbhz=blank,
        loss_of_lock=np.zeros((count, 1), np.uint8), break_before=np.zeros(count, dtype=bool),
    )  # fmt: skip


def in_order(seconds: list[int], size: int) -> tuple[list[float], Observations]:
    runs = [
        ("log", observations(seconds[k : k + size]), np.arange(len(seconds))[k : k + size] + 1)
        for k in range(0, len(seconds), size)
    ]
    parts = list(EpochOrder("count").ordered(runs))
    time = np.concatenate([part.time for part in parts])
    assert (np.diff(time) > np.timedelta64(0, "ns")).all()
    return np.concatenate([part.code_m[:, 0] for part in parts if len(part)]).tolist(), parts[-1]


@pytest.mark.parametrize("seed", range(60))
def test_nothing_is_lost_and_runs_of_any_length_give_the_same(seed: int) -> None:
    """Exchanged, doubled and overlapping epochs are all there once; a tag of another year is left out."""
    rng = np.random.default_rng(seed)
    seconds = list(range(200))
    for _ in range(rng.integers(0, 4)):
        first = int(rng.integers(0, 190))
        other = first + int(rng.integers(1, 6))
        seconds[first], seconds[other] = seconds[other], seconds[first]
    for _ in range(rng.integers(0, 3)):
        again = int(rng.integers(0, 150))
        seconds.insert(again + int(rng.integers(0, 40)), seconds[again])
    wrong = int(rng.integers(0, 2))
    seconds = [*seconds[:120], *[WRONG] * wrong, *seconds[120:]]
    if rng.random() < 0.3:
        seconds += range(100, 230)
    answers = [in_order(seconds, size) for size in (1, 7, 50, 1000)]
    for codes, notes in answers:
        assert codes == sorted({second for second in seconds if second != WRONG})
        assert notes.problems == answers[0][1].problems
        assert notes.skipped == answers[0][1].skipped
        assert notes.skipped.get("epochs out of order", 0) == wrong


def test_epochs_of_one_time_in_two_records_are_one() -> None:
    """Programs write one record for each constellation: the satellites of both are kept."""
    runs = [("log", observations([second], system=system), np.array([1])) for second in range(50) for system in "GE"]
    parts = [part for part in EpochOrder("stop").ordered(runs) if len(part)]
    assert sum(len(part) for part in parts) == 50
    for part in parts:
        assert part.satellite.tolist() == ["E01", "G01"]
        np.testing.assert_array_equal(part.code_m[:, 0], part.code_m[:, 1])


def test_a_tag_far_from_its_place_names_its_line_and_the_way_on() -> None:
    seconds = [*range(100), 50 - MOST_PASSED - 100, *range(100, 150)]
    run = ("log", observations(seconds), np.arange(len(seconds)) + 1)
    with pytest.raises(InputFileError, match=r"log, line 101: the time tag .* --lenient"):
        list(EpochOrder("stop").ordered([run]))
    *_, notes = EpochOrder("count").ordered([run])
    assert notes.skipped == {"epochs out of order": 1}
