"""P4's experiment prints what its document shows, and its picture is drawn; injected faults as they were."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import fault_injection
import p4_experiment
from conftest import ROOT
from railfix.core.geodesy import enu_axes, geodetic_from_ecef

pytestmark = pytest.mark.requirement("B6")
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")


def shown() -> list[str]:
    kept = ROOT / "tests" / "references" / "results" / "p4-experiment.txt"
    return kept.read_text(encoding="utf-8").rstrip().splitlines()


def assert_same(printed: list[str], document: list[str]) -> None:
    """The same words, and numbers to a unit of their last digit."""
    assert [NUMBER.sub("#", line).split() for line in printed] == [NUMBER.sub("#", line).split() for line in document]
    for one, two in zip(printed, document, strict=True):
        for a, b in zip(NUMBER.findall(one), NUMBER.findall(two), strict=True):
            unit = 10.0 ** -len(b.partition(".")[2])
            assert abs(float(a) - float(b)) <= 1.01 * unit, (one, two)


def test_the_printed_points_of_p4() -> None:
    """Two points of a line, and a station that lies 1433 m along its 2874 m, 2.67 m beside it."""
    length, along, right, azimuth = p4_experiment.p4_line()
    assert (length, along, right) == pytest.approx((2874.31, 1433.23, -2.67), abs=0.01)
    latitude, longitude, height = geodetic_from_ecef(p4_experiment.P4_POINTS_M[0])
    assert (latitude, longitude, height) == pytest.approx((34.9396, 135.9062, 130.37), abs=0.01)
    # worked by hand: 0.02 deg of latitude and of longitude at 34.94 deg
    assert azimuth == pytest.approx(180.0 + np.degrees(np.arctan2(1827.1, 2218.8)), abs=0.01)


def test_the_station_is_where_p4_has_it() -> None:
    place = np.array([3582105.0, 532589.0, 5232754.0])
    for beside in (0.0, 2.7):
        first, last = p4_experiment.two_points(place, beside)
        trajectory = p4_experiment.line_between(first, last)
        arc, offset = trajectory.nearest(place[None])
        assert arc[0] == pytest.approx(1433.23, abs=0.01)
        assert offset[0] == pytest.approx(beside, abs=0.02)
        assert trajectory.arc_m[-1] == pytest.approx(2874.31, abs=0.01)
    latitude, longitude, _ = geodetic_from_ecef(first)
    east, north, _ = enu_axes(latitude, longitude) @ (last - first)
    assert np.degrees(np.arctan2(east, north)) % 360.0 == pytest.approx(219.47, abs=0.1)


def test_the_kept_output_is_what_is_measured(recordings: Path, tmp_path: Path) -> None:
    station, document = p4_experiment.STATIONS[0], shown()
    day = p4_experiment.play(recordings, station, *p4_experiment.LINES[0])
    assert_same([f"{station.name:12s} {0.0:6.1f} {0.3:7.1f} {p4_experiment.row(day)}"], document[2:3])
    p4_experiment.draw(day, tmp_path / "p4.png")
    assert (tmp_path / "p4.png").stat().st_size > 20_000


@pytest.mark.slow
def test_the_whole_kept_output_is_what_is_measured(recordings: Path) -> None:
    assert_same(list(p4_experiment.report(recordings)), shown())


@pytest.mark.slow
@pytest.mark.requirement("B4")
def test_the_tables_of_faults_are_what_is_measured(recordings: Path) -> None:
    before = (ROOT / "tests" / "references" / "results" / "fault-injection.txt").read_text(encoding="utf-8")
    assert_same("\n".join(fault_injection.tables(recordings)).rstrip().splitlines(), before.rstrip().splitlines())
