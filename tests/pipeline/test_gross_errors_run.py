"""Gross errors in the pipeline: a larger one never lowers availability or accuracy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers import synthetic
from helpers.pipeline_cases import clean_observations, processor, true_chainage
from railfix.core.reasons import Reason, Status
from railfix.gnss.observations import Observations
from railfix.pipeline.processor import Result
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.gross_errors import gross_alone, gross_errors, scan_line
from railfix.positioning.normal_equations import point_position
from railfix.positioning.range_arrays import UNTIED_M, InterSystemBiases
from railfix.positioning.search_index import SearchIndex
from railfix.tracking import TrackStatus

pytestmark = pytest.mark.requirement("A6")

SIZES_M = (300.0, 1e3, 3e3, 3e4, 2.99792458e5)
GPS = ["G01", "G02", "G06", "G10", "G15"]


def second_by_second() -> Observations:
    return clean_observations()["front"][::10]


def with_errors(observations: Observations, satellites: list[str], size_m: float) -> Observations:
    wrong = np.isin(observations.satellite, satellites)
    sign = np.where(np.arange(len(wrong)) % 2 == 0, 1.0, -1.0)
    return replace(observations, code_m=observations.code_m + wrong * sign * size_m)


def run(observations: Observations) -> Result:
    return processor({"filter": "track"}).process({"front": observations})[0]


def scores(result: Result) -> tuple[float, float, float, float]:
    """Shares of `ok` and `tracking`, 95th percentiles of the errors of single epochs and of the filter [m]."""
    single, filtered = result.antennas["front"], result.fusion["front"]
    true = true_chainage("front")[::10]
    errors = (np.abs(values - true) for values in (single.chainage_m, filtered.chainage_m))
    return (
        float((single.status == Status.OK).mean()), float((filtered.tracked.status == TrackStatus.TRACKING).mean()),
        *(float(np.nanpercentile(error, 95)) if np.isfinite(error).any() else np.nan for error in errors),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("satellites", "received"),
    [
        (["G10"], []), (["E05", "G01"], []), (["E11", "G15", "J02"], []),
        # two of three of a constellation; two of four of it and one of five of the other
        (["E05", "E11"], [*GPS, "G20", "E05", "E07", "E11"]),
        (["E05", "E11", "G10"], [*GPS, "E05", "E07", "E10", "E11"]),
    ],
)  # fmt: skip
def test_a_larger_error_never_lowers_availability_or_accuracy(satellites: list[str], received: list[str]) -> None:
    without = second_by_second()
    if received:
        without = replace(without, code_m=np.where(np.isin(without.satellite, received), without.code_m, np.nan))
    mine = np.isin(without.satellite, satellites)
    ok, tracking, single_m, filter_m = scores(run(replace(without, code_m=np.where(mine, np.nan, without.code_m))))
    assert tracking > 0.9 or len(received) == 9
    for size in SIZES_M:
        result = run(with_errors(without, satellites, size))
        found = scores(result)
        assert found[0] >= ok - 0.02, size
        assert found[1] >= tracking - 0.02, size
        assert found[2] <= single_m + 0.5, size
        assert not found[3] > filter_m + 0.5, size
        assert ((result.antennas["front"].reason[:, mine] & int(Reason.GROSS_ERROR)) != 0).all(), size


def test_phase_and_doppler_of_a_wrong_code_stay_in_the_filter() -> None:
    tracked = run(with_errors(second_by_second(), ["G10"], 1e3)).fusion["front"].tracked
    column = int(np.flatnonzero(run_satellites() == "G10")[0])
    code, phase, doppler = tracked.innovation[5:, :, column].T
    assert np.isnan(code).all()
    assert np.isfinite(doppler).mean() > 0.95
    assert np.isfinite(phase).mean() > 0.9


def run_satellites() -> np.ndarray:
    found = run(second_by_second()[:3]).antennas["front"]
    return second_by_second().satellite[found.columns]


def test_scan_of_the_line_is_the_best_point_of_a_search_metre_by_metre() -> None:
    line, true = synthetic.line(2000.0), np.array([150.0, 820.0, 1490.0])
    ranges = synthetic.ranges(line, true, systems="GGGGGGEEEE", sigma_m=2.0, seed=3)
    wrong = np.zeros((3, 10))
    wrong[:, 1], wrong[:, 7] = 4e3, -1e5
    ranges = replace(ranges, code_m=ranges.code_m + wrong)
    scan = scan_line(ranges, line)
    assert (scan.agreeing == 5).all()
    assert scan.clear.all()
    assert np.array_equal(scan.gross, wrong != 0.0)
    fine = np.arange(0.0, line.arc_m[-1], 1.0)
    for k in range(3):
        delta = ranges.code_m[k] - synthetic.travelled_range(
            np.repeat(ranges.sat_ecef_m[k][None], len(fine), axis=0), np.repeat(line.at_arc(fine)[:, None], 10, axis=1)
        )
        for group in ranges.groups:
            delta[:, group] -= np.median(delta[:, group], axis=1, keepdims=True)
        best = fine[np.minimum(np.abs(delta), 100.0).sum(axis=1).argmin()]
        assert scan.arc_m[k] == pytest.approx(best, abs=10.0)


def test_epochs_without_a_clear_culprit_are_unsure() -> None:
    """Four ranges of one clock, two of them along the line: nothing tells which one is wrong."""
    line, true = synthetic.line(2000.0), np.full(30, 700.0)
    ranges = synthetic.ranges(line, true, systems="GGGG", sigma_m=1.0)
    ranges = replace(ranges, code_m=ranges.code_m + np.array([0.0, 600.0, 0.0, 0.0]))
    index = SearchIndex(line)
    point = point_position(ranges, line.at_arc(true))
    found = gross_errors(ranges, AntennaRows.on(index), point)
    accused = found.gross.any(axis=1)
    assert not found.gross[:, [0, 2, 3]].any()
    assert found.unsure.any()
    assert (found.unsure == np.isfinite(found.unsure_arc_m)).all()
    assert accused[found.unsure].all()


def test_range_alone_on_its_clock_is_checked_by_the_known_bias() -> None:
    line = synthetic.line()
    ranges = synthetic.ranges(line, np.array([300.0] * 3), systems="GGGGGE", sigma_m=1.0, clock_m=0.0)
    code = ranges.code_m.copy()
    code[1, 5] += 3e5
    code[2, 5] += 20.0
    ranges = replace(ranges, code_m=code)
    clock = point_position(ranges, line.at_arc(np.array([300.0] * 3))).clock_m
    known = InterSystemBiases(offset_m=np.zeros((3, 2)), sigma_m=np.full((3, 2), 2.0))
    assert np.array_equal(
        gross_alone(ranges.weight, ranges.groups, clock, known),
        np.eye(6, dtype=bool)[5] & np.array([[0], [1], [0]], bool),
    )
    nothing = replace(known, sigma_m=np.array([[0.0, UNTIED_M]] * 3))
    assert not gross_alone(ranges.weight, ranges.groups, clock, nothing).any()
    # without known biases: one or two ranges of a clock that is far from that of three or more
    assert np.flatnonzero(gross_alone(ranges.weight, ranges.groups, clock).any(axis=1)).tolist() == [1]
