"""Observation arrays, reasons and errors: what every stage relies on."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from railfix.core import errors
from railfix.core.arrays import read_only
from railfix.core.reason_names import first_reason, reason_text
from railfix.core.reasons import POSITIONED, Reason, Status
from railfix.gnss import concatenate
from railfix.gnss.joined_observations import MAX_PROBLEMS, first_problems
from railfix.gnss.observations import ObservationHeader, Observations

START = np.datetime64("2024-03-13T08:00:00", "ns")


def observations(epochs: int, channels: list[tuple[str, str]], begin: int = 0, **changes: Any) -> Observations:
    shape = (epochs, len(channels))
    numbers = 1e7 + 1e3 * (begin + np.arange(epochs))[:, None] + np.arange(len(channels))
    arrays: dict[str, Any] = {
        "time": START + (begin + np.arange(epochs)) * np.timedelta64(1, "s"),
        "satellite": np.array([c[0] for c in channels]),
        "signal": np.array([c[1] for c in channels]),
        "code_m": numbers,
        "phase_cycles": numbers * 5.25,
        "doppler_hz": numbers * 1e-4,
        "cn0_dbhz": np.full(shape, 45.0),
        "loss_of_lock": np.ones(shape, dtype=np.uint8),
        "break_before": np.arange(epochs) == 0,
    }
    return Observations(**{**arrays, **changes})


# ---------------------------------------------------------------- Observations


def test_arrays_are_read_only_and_the_callers_stay_writable() -> None:
    mine = np.zeros((2, 1))
    log = observations(2, [("G01", "1C")], code_m=mine)
    with pytest.raises(ValueError, match="read-only"):
        log.code_m[0, 0] = 1.0
    mine[0, 0] = 1.0
    assert read_only(mine).base is mine
    with pytest.raises(AttributeError):
        log.code_m = mine  # type: ignore[misc]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("code_m", np.zeros((2, 3)), r"code_m has shape \(2, 3\), expected \(2, 2\)"),
        ("loss_of_lock", np.zeros((3, 2), dtype=np.uint8), "loss_of_lock has shape"),
        ("signal", np.array(["1C"]), "signal has 1 channels, satellite has 2"),
        ("break_before", np.zeros(3, dtype=bool), "break_before has 3 epochs, time has 2"),
    ],
)
def test_shapes_that_do_not_match_are_named(name: str, value: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        observations(2, [("G01", "1C"), ("G02", "1C")], **{name: value})


def test_a_run_of_epochs() -> None:
    log = observations(5, [("G01", "1C"), ("E02", "5Q")], problems=("one",), problem_count=1)
    part = log[1:3]
    assert len(part) == 2
    assert np.shares_memory(part.code_m, log.code_m)
    np.testing.assert_array_equal(part.time, log.time[1:3])
    assert part.system.tolist() == ["G", "E"]
    assert part.problems == ()


def test_concatenate_unites_the_channels() -> None:
    first = observations(2, [("G05", "1C"), ("E02", "1C")])
    second = observations(3, [("G05", "1C"), ("G05", "2W"), ("C11", "2I")], begin=2)
    whole = concatenate([first, second])
    channels = list(zip(whole.satellite.tolist(), whole.signal.tolist(), strict=True))
    assert channels == [("C11", "2I"), ("E02", "1C"), ("G05", "1C"), ("G05", "2W")]
    assert len(whole) == 5
    assert (np.diff(whole.time) == np.timedelta64(1, "s")).all()
    for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz"):
        array = getattr(whole, name)
        assert np.isnan(array[:2, 0]).all(), name
        assert np.isnan(array[:2, 3]).all(), name
        assert np.isnan(array[2:, 1]).all(), name
        np.testing.assert_array_equal(array[:2, [2, 1]], getattr(first, name))
        np.testing.assert_array_equal(array[2:, [2, 3, 0]], getattr(second, name))
    assert whole.loss_of_lock[:2].tolist() == [[0, 1, 1, 0]] * 2
    assert whole.break_before.tolist() == [True, False, True, False, False]


def test_concatenate_joins_headers_and_problems() -> None:
    one = ObservationHeader(marker="A", signals={"G": ("1C",)}, glonass_channel={"R01": 1, "R02": -4})
    two = ObservationHeader(marker="B", signals={"G": ("2W",), "E": ("1C",)}, glonass_channel={"R01": 5, "R03": 6})
    parts = [
        observations(1, [("G05", "1C")], header=one, problems=("p",), problem_count=1, skipped={"events": 2}),
        observations(1, [("G05", "1C")], 1, header=two, problems=("q",), problem_count=1, skipped={"events": 1}),
    ]
    whole = concatenate(parts)
    assert whole.header.marker == "A"
    assert whole.header.signals == {"G": ("1C", "2W"), "E": ("1C",)}
    assert whole.header.glonass_channel == {"R01": 1, "R02": -4, "R03": 6}
    assert whole.problems == ("p", "q")
    assert whole.problem_count == 2
    assert whole.skipped == {"events": 3}


def test_concatenate_of_nothing_is_an_error_and_of_one_the_same() -> None:
    with pytest.raises(ValueError, match="at least one"):
        concatenate([])
    one = observations(2, [("G01", "1C")])
    np.testing.assert_array_equal(concatenate([one]).code_m, one.code_m)


def test_parts_in_the_wrong_order_are_named_with_their_times() -> None:
    first, second = observations(3, [("G01", "1C")]), observations(2, [("G05", "1C")], begin=3)
    assert len(concatenate([first, first[:0], second])) == 5
    words = r"part 2 begins at 2024-03-13T08:00:00.*, part 0 before it ends at 2024-03-13T08:00:04.*; give the parts of"
    with pytest.raises(ValueError, match=words):
        concatenate([second, first[:0], first])
    with pytest.raises(ValueError, match=r"part 1 begins at .*, part 0 before it ends at"):
        concatenate([first, first[2:]])


def test_problems_are_kept_up_to_a_number_and_all_counted() -> None:
    sentences = [str(k) for k in range(MAX_PROBLEMS + 7)]
    kept = first_problems(sentences, count=len(sentences))
    assert kept[:MAX_PROBLEMS] == tuple(sentences[:MAX_PROBLEMS])
    assert kept[MAX_PROBLEMS:] == ("and 7 more problems",)
    assert first_problems(["a"], count=1) == ("a",)


# ---------------------------------------------------------------- reasons


@pytest.mark.requirement("B7")
def test_every_reason_has_one_bit_and_a_word_of_its_own() -> None:
    bits = [int(r) for r in Reason]
    assert all(b & (b - 1) == 0 for b in bits)
    assert len(set(bits)) == len(bits)
    for reason in Reason:
        assert reason_text(reason) == reason.name.lower()  # type: ignore[union-attr]
    assert reason_text(0) == "used"


@pytest.mark.requirement("B7")
def test_reasons_of_an_array() -> None:
    both = Reason.UNHEALTHY | Reason.ELEVATION_MASK
    reasons = np.array([[0, int(both)], [int(Reason.UNHEALTHY), 0]])
    assert [reason_text(int(r)) for r in reasons.ravel()] == ["used", "unhealthy+elevation_mask", "unhealthy", "used"]
    assert first_reason(reasons).tolist() == [[0, int(Reason.UNHEALTHY)], [int(Reason.UNHEALTHY), 0]]


@pytest.mark.requirement("B7")
def test_statuses_that_come_with_coordinates() -> None:
    assert set(POSITIONED) < set(Status)
    assert [s.text for s in (Status.OK, Status.TOO_FEW_SATELLITES)] == ["ok", "too_few_satellites"]
    assert Status.NO_OBSERVATION not in POSITIONED


# ---------------------------------------------------------------- errors


def test_exit_codes_are_different_and_those_of_the_table() -> None:
    kinds = errors.RailfixError.__subclasses__()
    codes = {kind.__name__: kind.exit_code for kind in kinds}
    assert len(set(codes.values())) == len(codes)
    assert not set(codes.values()) & {0, 1, 2}
    table = [line.split()[0] for line in str(errors.__doc__).splitlines() if line[:1].isdigit()]
    assert {str(c) for c in codes.values()} == set(table) - {"0", "1", "2"}


def test_error_of_a_file_names_file_and_line() -> None:
    error = errors.InputFileError("logs/a.obs", "is empty")
    assert (str(error), error.line, error.path) == ("logs/a.obs: is empty", None, "logs/a.obs")
    assert str(errors.InputFileError("a.obs", "broken", line=7)) == "a.obs, line 7: broken"
    assert error.exit_code == 3
