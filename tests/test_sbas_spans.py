"""Spans in which nothing changes: every edge is told apart, and what is asked once is the same as asked each time."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.ranges.sbas.grid import Spans, distinct_lookups, looked_up

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

    found = looked_up(answer, spans.number(time), point, time, 2664)
    np.testing.assert_array_equal(found, answer(point, time))
    assert asked[0] < 400
    first, which = distinct_lookups(spans.number(time), point, 2664)
    np.testing.assert_array_equal(point[first][which], point)
    np.testing.assert_array_equal(spans.number(time)[first][which], spans.number(time))
