"""Validation of the conventional position: chi-square test and dilution against second formulas, the position kept."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binomtest

import synthetic
from pipeline_cases import channel, clean_observations, front_alone, with_code
from railfix.integrity.point_validation import PointStatus, position_dilution, validate_point
from railfix.positioning.normal_equations import SinglePointLimits, point_position

pytestmark = pytest.mark.requirement("A6")
LINE = synthetic.line()


@pytest.mark.slow
def test_the_dilution_is_that_of_the_whole_design_matrix() -> None:
    arc = np.linspace(50.0, 900.0, 6)
    ranges = synthetic.ranges(LINE, arc)
    place = LINE.at_arc(arc)
    for t, dilution in enumerate(position_dilution(ranges, place)):
        away = ranges.sat_ecef_m[t] - place[t]
        clocks = np.array([[1.0, 0.0]] * 5 + [[0.0, 1.0]] * 3)
        design = np.hstack([away / np.linalg.norm(away, axis=1, keepdims=True), clocks])
        assert dilution == pytest.approx(np.sqrt(np.trace(np.linalg.inv(design.T @ design)[:3, :3])), rel=1e-4)


@pytest.mark.parametrize("scale", [1.0, 2.5])
@pytest.mark.slow
def test_noise_alone_fails_as_often_as_set(scale: float) -> None:
    arc = np.linspace(50.0, 900.0, 3000)
    ranges = synthetic.ranges(LINE, arc, systems="GGGGGGG", seed=4)
    sigma = 1.0 / np.sqrt(ranges.weight)
    noise = np.random.default_rng(5).normal(size=sigma.shape) * sigma * scale
    place = LINE.at_arc(arc)
    object.__setattr__(ranges, "code_m", synthetic.travelled_range(ranges.sat_ecef_m, place[:, None]) + noise)
    limits = SinglePointLimits(false_alarm=0.02, dilution_limit=1e3)
    point = point_position(ranges, np.broadcast_to(LINE.ecef_m.mean(axis=0), place.shape))
    status = validate_point(point, ranges, np.full(len(arc), scale), limits=limits)
    failed = int(np.count_nonzero(status == PointStatus.RESIDUALS))
    assert binomtest(failed, len(arc), 0.02).pvalue > 1e-3
    strict = SinglePointLimits(false_alarm=0.02, dilution_limit=float(np.median(position_dilution(ranges, place))))
    status = validate_point(point, ranges, np.full(len(arc), scale), limits=strict)
    assert np.count_nonzero(status == PointStatus.DILUTION) == pytest.approx(0.49 * len(arc), abs=0.03 * len(arc))


def test_a_position_that_fails_is_kept_with_its_status() -> None:
    observations = clean_observations()["front"][:120]
    settings = {"filter": "off", "systems": ["G"], "screens": ["elevation"]}
    before = front_alone(observations, settings)
    assert np.mean(before.conventional_status == PointStatus.VALID) > 0.98
    step = np.zeros(observations.code_m.shape)
    step[60:, channel(observations, str(before.satellite[np.argmax(before.reason[0] == 0)]))] = 60.0
    after = front_alone(with_code(observations, step), settings)
    assert (after.conventional_status[60:] == PointStatus.RESIDUALS).mean() > 0.9
    np.testing.assert_array_equal(after.conventional_status[:60], before.conventional_status[:60])
    assert np.isfinite(after.point.ecef_m).all()
    none = with_code(observations, np.full(observations.code_m.shape, np.nan))
    assert (front_alone(none, settings).conventional_status == PointStatus.NO_POSITION).all()
