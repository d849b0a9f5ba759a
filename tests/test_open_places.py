"""Other places of the line that the level must reach or the status must name (requirement C2)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import integrity_tables
from integrity_recordings import ranges_of
from railfix.core.reasons import Status
from railfix.integrity.protection import RiskBudget
from railfix.integrity.raim import constrained_model
from railfix.pipeline.open_places import places_beyond_the_level
from railfix.pipeline.solve import Place
from railfix.positioning.constrained import constrained_position


@pytest.fixture(scope="module")
def pixel(recordings: Path) -> integrity_tables.Case:
    """Four to seven GPS satellites on a course whose passes lie some 16 m beside each other."""
    assert recordings.is_dir()
    return integrity_tables.cases()["Pixel"]


@pytest.mark.requirement("C2")
def test_hardly_any_ok_position_is_over_its_level_with_a_large_fault(pixel: integrity_tables.Case) -> None:
    """Each satellite in turn 100 m too long from the middle on: one epoch, where another satellite is off, too."""
    clean = pixel.solved()
    start, judged, over = len(clean) // 2, 0, 0
    for channel in np.flatnonzero((clean.reason == 0).mean(axis=0) > 0.2).tolist():
        bias = np.zeros(pixel.observations.code_m.shape)
        bias[start:, pixel.observations.satellite == pixel.observations.satellite[channel]] = 100.0
        result = pixel.solved(bias_m=bias)
        error, _ = pixel.errors(result)
        level, calm = integrity_tables.bounds(result)
        ok = (result.status == Status.OK) & calm & np.isfinite(error)
        judged += int(ok[start:].sum())
        over += int((ok & (error > level))[start:].sum())
    assert judged > 200
    assert over <= 1


@pytest.mark.requirement("C2")
def test_open_places_are_those_that_solving_again_leaves_open(pixel: integrity_tables.Case) -> None:
    """Every satellite left out at both places, the places kept, and fitted anew."""
    result, line, risk = pixel.solved(), pixel.trajectory, RiskBudget()
    ranges = ranges_of(result)
    some = (result.section.other_vertex >= 0) & np.isfinite(result.constrained.arc_m)
    rows = np.flatnonzero(some & (ranges.n_used >= 5))[::25]
    ranges = ranges.take(rows)
    arc, section = result.constrained.arc_m[rows], result.constrained.section[rows]
    other = constrained_position(ranges, line, result.section.other_vertex[rows])
    systems = [name[0] for name in result.satellite[result.columns].tolist()]
    model = constrained_model(ranges, line, arc, section=section)
    take = {name: getattr(result.section, name)[rows] for name in result.section.__dataclass_fields__}
    place = Place(
        point=result.single_point.take(rows),
        section=replace(result.section, **take),
        constrained=replace(
            result.constrained,
            **{name: getattr(result.constrained, name)[rows] for name in result.constrained.__dataclass_fields__},
        ),
    )
    level, scale = np.zeros(len(rows)), np.ones(len(rows))
    found = places_beyond_the_level(ranges, line, place, model, level, scale, systems, risk, integrity_tables.SETTINGS)
    expected = np.zeros(len(rows), dtype=bool)
    prior = risk.prior(systems)
    for left_out in [None, *range(ranges.weight.shape[1])]:
        weight = ranges.weight.copy()
        used = np.ones(len(rows), dtype=bool)
        if left_out is not None:
            used = weight[:, left_out] > 0
            weight[:, left_out] = 0.0
        part = replace(ranges, weight=weight)
        here = constrained_model(part, line, arc, section=section).wsse
        there = constrained_model(part, line, other.arc_m, section=np.maximum(other.section, 0)).wsse
        share = 1.0 if left_out is None else float(prior[left_out])
        expected |= used & (there - here <= chi2.isf(risk.risk_per_sample / share, 1))
    assert expected.any()
    assert not expected.all()
    assert np.array_equal(found, expected)
