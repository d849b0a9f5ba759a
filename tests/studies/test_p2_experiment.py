"""P2's experiments on simulated sensors print what the references show, and P2's rule is blind where it must be."""

from __future__ import annotations

import numpy as np
import pytest

import p2_experiment
from conftest import ROOT
from test_p4_experiment import assert_same


@pytest.mark.slow
@pytest.mark.requirement("E1")
@pytest.mark.requirement("E2")
@pytest.mark.requirement("E3")
@pytest.mark.requirement("E4")
def test_all_of_it_is_as_it_was() -> None:
    shown = (ROOT / "tests" / "references" / "results" / "p2.txt").read_text(encoding="utf-8")
    assert_same("\n".join(p2_experiment.report()).splitlines(), shown.splitlines())


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
