"""P2's experiments on simulated sensors print what the references show, and P2's rule is blind where it must be."""

from __future__ import annotations

import re

import numpy as np
import pytest

import p2_experiment
from conftest import ROOT
from test_p4_experiment import assert_same


@pytest.fixture(scope="module")
def shown() -> list[str]:
    return "\n".join(p2_experiment.report()).splitlines()


def numbers(shown: list[str], row: str) -> list[float]:
    """Numbers after the name of the only row that begins so."""
    (line,) = [line.strip() for line in shown if line.strip().startswith(row)]
    return [float(text) for text in re.findall(r"[-+]?\d+\.?\d*", line.removeprefix(row))]


@pytest.mark.slow
@pytest.mark.requirement("E1")
@pytest.mark.requirement("E2")
@pytest.mark.requirement("E3")
@pytest.mark.requirement("E4")
def test_all_of_it_is_as_it_was(shown: list[str]) -> None:
    kept = (ROOT / "tests" / "references" / "results" / "p2.txt").read_text(encoding="utf-8")
    assert_same(shown, kept.splitlines())


@pytest.mark.slow
@pytest.mark.requirement("E1")
def test_seven_slides_of_figure_3_leave_a_metre_where_wheel_and_paper_lose_forty(shown: list[str]) -> None:
    for rule in ("rule of railfix, no map", "rule of railfix "):
        speed, way = numbers([line for line in shown if "m/s " in line], rule)
        assert abs(speed) < 1.5
        assert abs(way) < 1.5
    assert numbers(shown, "the wheel ")[1] < -35.0
    assert numbers([line for line in shown if " m/s  -" in line], "P2's rule")[1] < -35.0


@pytest.mark.slow
@pytest.mark.requirement("E1")
def test_a_start_as_in_figure_5_has_a_speed_before_the_first_pulse(shown: list[str]) -> None:
    for gyro in ("accelerometer alone, as P2's prototype", "with the gyro"):
        silent_s, _, share, error = numbers(shown, gyro)
        assert silent_s > 1.0
        assert share == 100.0
        assert error < 0.1


@pytest.mark.slow
@pytest.mark.requirement("E2")
def test_gaps_of_curves_in_two_runs_differ_no_more_than_in_table_1(shown: list[str]) -> None:
    paper = numbers(shown, "P2 table 1:")[-1]
    assert numbers([line for line in shown if "gaps" in line], "curvature")[-1] <= paper


@pytest.mark.slow
@pytest.mark.requirement("E4")
def test_a_radar_in_the_tachometers_place_slips_less_than_it(shown: list[str]) -> None:
    _, radar, largest = numbers(shown, "radar in the tachometer's place")
    assert radar < numbers(shown, "tachometer  ")[1]
    assert largest < 3.0


@pytest.mark.requirement("E1")
def test_the_curve_of_blindness_is_the_closed_form_for_slips_of_a_second_and_more() -> None:
    rows = list(p2_experiment.blind_lines())
    count = len(p2_experiment.DURATIONS_S)
    measured, closed, of_railfix = (
        np.array([row.split()[2:] for row in rows[1 + k * (count + 1) : (k + 1) * (count + 1)]], dtype=float)
        for k in range(3)
    )
    assert measured.shape == (count, len(p2_experiment.EXCESS_MPS))
    assert np.abs(measured - closed)[1:].max() <= 3.0
    assert (measured[closed == 100.0] == 100.0).all()
    assert (of_railfix <= measured).all()
