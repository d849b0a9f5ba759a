"""Navigation records chosen by their issue of data."""

from __future__ import annotations

import numpy as np
import pytest

import orbit_cases as cases
from railfix.gnss.orbits.issues import issue_records
from railfix.gnss.orbits.states import satellite_states

pytestmark = pytest.mark.requirement("C1")

HOUR = cases.HOUR
SATELLITE = np.array(["G05", "G09", "E11", "R01"])
#: G05: issues 7, 8, and 7 again a day later; sent two hours before the reference time.
RECORDS = cases.navigation(
    {"satellite": "G05", "iode": 7, "toe": cases.TOE, "transmitted": cases.TOE - 2 * HOUR},
    {"satellite": "G05", "iode": 8, "toe": cases.TOE + 2 * HOUR, "transmitted": cases.TOE, "m0": 0.4},
    {"satellite": "G05", "iode": 7, "toe": cases.TOE + 24 * HOUR, "transmitted": cases.TOE + 22 * HOUR, "m0": 0.9},
    {"satellite": "G09", "iode": 8, "toe": cases.TOE},
    {"satellite": "E11", "iode": 7, "toe": cases.TOE},
)


def rows(hours: float, *issue: int) -> list[int]:
    time = np.array([cases.TOE + np.timedelta64(round(hours * 3.6e12), "ns")])
    wanted = np.array([[*issue, *[-1] * (4 - len(issue))]])
    return issue_records(RECORDS, SATELLITE, time, wanted)[0].tolist()


def test_the_record_of_the_issue_is_found() -> None:
    assert rows(0.5, 7, 8) == [0, 3, -1, -1]
    assert rows(0.5, 8, 7) == [1, -1, -1, -1]
    assert rows(0.5, -1, 9) == [-1, -1, -1, -1]
    assert rows(0.5, 7, 7, 7, 7) == [0, -1, 4, -1]
    assert rows(0.5, 256 + 7, 7, 256 + 7) == [0, -1, -1, -1], "10 bits of Galileo, the lower 8 of GPS"


def test_of_one_issue_the_nearest_in_its_validity_counts() -> None:
    """Two hours either side of the reference time, and not a nanosecond more."""
    assert rows(2.0, 7) == [0, -1, -1, -1]
    assert rows(2.0 + 1e-12 * 300, 7) == [-1, -1, -1, -1]
    assert rows(21.9, 7) == [-1, -1, -1, -1]
    assert rows(22.0, 7) == [2, -1, -1, -1]


def test_states_are_those_of_the_record_asked_for() -> None:
    """As if the file held no other record of the satellite; -1 leaves the choice as it is, to the last bit."""
    time = np.array([cases.TOE + HOUR])
    signal, code = np.array(["1C", "1C", "1C", "1C"]), np.full((1, 4), 2.3e7)
    usual = satellite_states(time, SATELLITE, signal, code, RECORDS)
    left = satellite_states(time, SATELLITE, signal, code, RECORDS, record=np.full((1, 4), -1))
    assert usual.record[0, 0] == 1
    for name in (
        "position_ecef_m",
        "velocity_ecef_mps",
        "clock_m",
        "group_delay_m",
        "age_s",
        "record",
        "future_record",
    ):
        assert np.array_equal(getattr(usual, name), getattr(left, name), equal_nan=True), name
    asked = satellite_states(time, SATELLITE, signal, code, RECORDS, record=np.array([[0, -1, -1, -1]]))
    alone = satellite_states(time, SATELLITE, signal, code, cases.one_record(RECORDS, 0))
    assert asked.record[0].tolist() == [0, 3, 4, -1]
    assert np.array_equal(asked.position_ecef_m[0, 0], alone.position_ecef_m[0, 0])
    assert np.array_equal(asked.clock_m[0, 0], alone.clock_m[0, 0])
    assert not np.array_equal(asked.position_ecef_m[0, 0], usual.position_ecef_m[0, 0])
    old = satellite_states(time - 2 * HOUR, SATELLITE, signal, code, RECORDS, record=np.array([[1, -1, -1, -1]]))
    assert old.too_old[0, 0]


def test_a_record_not_yet_sent_is_flagged() -> None:
    late = cases.navigation({"satellite": "G05", "iode": 8, "toe": cases.TOE, "transmitted": cases.TOE + HOUR})
    time = np.array([cases.TOE + HOUR // 2, cases.TOE + HOUR])
    states = satellite_states(time, SATELLITE[:1], np.array(["1C"]), np.full((2, 1), 2.3e7), late,
                              record=np.zeros((2, 1), dtype=np.int64))  # fmt: skip
    assert states.future_record[:, 0].tolist() == [True, False]


def test_shapes_are_told() -> None:
    with pytest.raises(ValueError, match=r"record has shape \(1, 2\), expected \(1, 1\)"):
        satellite_states(np.array([cases.TOE]), SATELLITE[:1], np.array(["1C"]), np.full((1, 1), 2.3e7), RECORDS,
                         record=np.zeros((1, 2), dtype=np.int64))  # fmt: skip
