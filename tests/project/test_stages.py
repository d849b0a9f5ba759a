"""Stages by hand: the notebook that composes them reaches the pipeline's numbers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import synthetic
from conftest import ROOT
from railfix import integrity, positioning
from test_site import cells


@pytest.fixture(scope="module")
def names() -> dict[str, Any]:
    """Names of the notebook after its cells have run."""
    found: dict[str, Any] = {}
    for cell in cells((ROOT / "docs" / "notebooks" / "stages.md").read_text(encoding="utf-8")):
        exec(compile(cell, "stages.md", "exec"), found)
    return found


@pytest.mark.requirement("G2")
@pytest.mark.requirement("S1")
def test_five_stages_by_hand_are_the_pipeline_to_a_millimetre(names: dict[str, Any]) -> None:
    text = (ROOT / "docs" / "notebooks" / "stages.md").read_text(encoding="utf-8")
    by_hand = [line for cell in cells(text)[:3] for line in cell.splitlines() if line.strip()]
    assert len(by_hand) <= 25
    found, place = names["result"].antennas["front"], names["place"]
    both = np.isfinite(found.arc_m)
    assert both.sum() > 1800
    np.testing.assert_allclose(place.arc_m[both], found.arc_m[both], rtol=0.0, atol=1e-3)
    np.testing.assert_array_equal(names["section"].vertex[both], found.section.vertex[both])
    code, sigma = (getattr(found, name)[:, found.columns] for name in ("corrected_code_m", "sigma_m"))
    used = np.isfinite(names["sight"][1]) & (found.reason[:, found.columns] == 0)
    assert used.sum() > 10_000
    np.testing.assert_allclose(names["codes"].code_m[used], code[used], rtol=0.0, atol=3e-3)
    np.testing.assert_allclose(names["codes"].sigma_m[used], sigma[used], rtol=1e-3)


@pytest.mark.requirement("A3")
@pytest.mark.requirement("A4")
def test_a_range_that_is_nan_is_not_used_and_a_faulty_one_is_excluded() -> None:
    """Nine satellites of two constellations on a simulated line, one 60 m too long at half of the epochs."""
    line, arc = synthetic.line(), np.linspace(200.0, 800.0, 20)
    ranges = synthetic.ranges(line, arc, systems="GGGGGEEEE", sigma_m=0.5)
    clock = np.array(list("GGGGGEEEE"))
    sigma = np.full(ranges.code_m.shape, 0.5)
    faulty = ranges.code_m + np.where((np.arange(9) == 2) & (np.arange(20) % 2 == 0)[:, None], 60.0, 0.0)
    given = (ranges.sat_ecef_m, faulty, sigma, clock)
    section = positioning.find_section(*given, line)
    place = positioning.position_on_line(*given, line, section.vertex)
    found = integrity.exclude_faults(positioning.weighted_ranges(*given), line, place.arc_m)
    assert found.excluded[::2, 2].all()
    assert found.excluded.sum() == 10
    clean = (ranges.sat_ecef_m, np.where(found.excluded, np.nan, faulty), sigma, clock)
    place = positioning.position_on_line(
        *clean, line, positioning.find_section(*clean, positioning.SearchIndex(line)).vertex
    )
    assert np.abs(place.arc_m - arc).max() < 3.0
    names = np.array([f"{letter}{k + 1:02d}" for k, letter in enumerate(clock)])
    level = integrity.protection_level(
        positioning.weighted_ranges(*clean), line, place.arc_m, satellite=names, n_excluded=found.excluded.sum(axis=1)
    )
    assert (level.level_m > np.abs(place.arc_m - arc)).all()
    space = positioning.point_position(*clean, line.ecef_m[0])
    assert np.linalg.norm(space.ecef_m - line.at_arc(arc), axis=1).max() < 5.0
    with pytest.raises(ValueError, match="side by side"):
        positioning.weighted_ranges(*given[:3], np.array(list("GEGGGEEEE")))
