"""Spans in which nothing changes: every edge is told apart, and what is asked once is the same as asked each time."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.ranges.sbas.ionosphere import Spans, distinct_lookups, look_up
from railfix.ranges.sbas.tables import Series, _with_other

pytestmark = pytest.mark.requirement("C1")
START = np.datetime64("2025-02-15T12:00:00", "ns")


def at(*seconds: float) -> np.ndarray:
    return START + np.array([round(s * 1e9) for s in seconds], dtype="timedelta64[ns]")


def test_a_reception_and_a_time_out_are_edges_to_the_nanosecond() -> None:
    spans = Spans(at(0.0, 7.0), [60.0])
    instants = at(-1.0, 0.0, 0.5, 6.999999999, 7.0, 7.000000001, 59.9, 60.0, 60.000000001, 67.0, 67.1)
    number = spans.number(instants)
    expected = [0, 1, 2, 2, 3, 4, 4, 5, 6, 7, 8]
    assert number.tolist() == expected
    assert (Spans(at()[:0], [60.0]).number(instants) == 0).all()


def test_each_combination_is_asked_once_and_answered_everywhere() -> None:
    rng = np.random.default_rng(2)
    time = at(*np.sort(rng.uniform(0.0, 100.0, 400)))
    spans = Spans(at(*range(0, 100, 5)), [12.0])
    point = rng.integers(-1, 30, (400, 4)) // 10 * 10 - 1
    asked = []

    def answer(points: np.ndarray, when: np.ndarray) -> np.ndarray:
        asked.append(len(points))
        return points * 1000 + spans.number(when)[:, None]

    found = look_up(answer, spans.number(time), point, time, 2664)
    np.testing.assert_array_equal(found, answer(point, time))
    assert asked[0] < 400
    first, which = distinct_lookups(spans.number(time), point, 2664)
    np.testing.assert_array_equal(point[first][which], point)
    np.testing.assert_array_equal(spans.number(time)[first][which], spans.number(time))


def test_rows_of_a_series_are_looked_up_by_the_newest_that_was_received() -> None:
    table = Series.of(np.array([5, 3, 5, -1]), at(7.0, 1.0, 2.0, 0.0), {"value": np.array([70, 10, 20, 0])})
    assert table.series.tolist() == [3, 5, 5]
    instants = at(0.9, 1.0, 2.0, 6.999, 7.0)
    assert table.newest(5, instants).tolist() == [-1, -1, 1, 1, 2]
    assert table.newest(np.array([[3], [4], [-1]]), instants).tolist() == [[-1, 0, 0, 0, 0], [-1] * 5, [-1] * 5]
    assert table["value"][table.newest(5, instants)[2:]].tolist() == [20, 20, 70]
    assert (table.received(np.array([-1, 2])) == np.array([np.datetime64("1980-01-06"), at(7.0)[0]])).all()
    none = Series.of(np.zeros(0, dtype=np.int64), at()[:0], {"value": np.zeros((0, 3))})
    assert (none.empty, table.empty) == (True, False)
    assert (none.newest(0, instants) == -1).all()
    assert none["value"][none.newest(0, instants)].shape == (5, 3)


def test_the_other_issue_is_that_of_the_same_satellite() -> None:
    """Last row with another issue of data: satellite 1 has 5, 6, 6; satellite 2 has 6, 6, 7, 6."""
    number, iode = np.array([1, 1, 1, 2, 2, 2, 2]), np.array([5, 6, 6, 6, 6, 7, 6])
    table = _with_other(Series.of(number, at(*range(7)), {"iode": iode}))
    assert table["other"].tolist() == [-1, 0, 0, -1, -1, 4, 5]
