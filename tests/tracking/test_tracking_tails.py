"""Weights of Student's t with a heavier tail for codes that come late (requirement E5)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.differentiate import derivative
from scipy.stats import t as student

from railfix.tracking import TrackingLimits, track
from railfix.tracking.limits import Tails
from tracking_cases import ride

RESIDUAL = np.linspace(-6.0, 6.0, 25)[None]


@pytest.mark.requirement("E5")
def test_equal_tails_are_student_t() -> None:
    tails = Tails(4.0, 4.0)
    expected = student.logpdf(RESIDUAL, 4.0) - student.logpdf(0.0, 4.0)
    np.testing.assert_allclose(tails.log_density(RESIDUAL, RESIDUAL**2), expected, atol=1e-12)
    np.testing.assert_allclose(tails.weight(RESIDUAL, RESIDUAL**2), 5.0 / (4.0 + RESIDUAL**2), rtol=1e-12)


@pytest.mark.requirement("E5")
def test_the_weight_is_the_slope_of_the_density_over_the_residual() -> None:
    tails = Tails(4.0, 1.0)
    apart = RESIDUAL[np.abs(RESIDUAL) > 0.1]
    slope = derivative(lambda residual: tails.log_density(residual, residual**2), apart).df
    np.testing.assert_allclose(-slope / apart, tails.weight(apart, apart**2), rtol=1e-6)


@pytest.mark.requirement("E5")
def test_late_codes_have_the_heavier_tail() -> None:
    weight = Tails(4.0, 1.0).weight(np.array([3.0, -3.0]), np.full(2, 9.0))
    np.testing.assert_allclose(weight, [1.25 / 10.0, 5.0 / 13.0])


@pytest.mark.requirement("E5")
def test_reflections_pull_less() -> None:
    """Exponential delays of 15 m on every other satellite, of half a minute each: codes alone, no motion measured."""
    random = np.random.default_rng(11)
    errors: dict[float, list[np.ndarray]] = {1.0: [], 4.0: []}
    for seed in range(6):
        case = ride(180, noise=1.0, seed=seed)
        shape = case.epochs.code_m.shape
        delay = np.repeat(random.exponential(15.0, (6, shape[1])), 30, axis=0) * (np.arange(shape[1]) % 2)
        nothing = np.full(shape, np.nan)
        epochs = replace(case.epochs, code_m=case.epochs.code_m + delay, phase_m=nothing, rate_mps=nothing)
        for late, found in errors.items():
            placed, _ = track(epochs, case.line, limits=TrackingLimits(late_degrees_of_freedom=late))
            found.append(np.abs(placed.arc_m - case.arc_m)[30:])
    late_tail, same = (np.concatenate(errors[late]) for late in (1.0, 4.0))
    both = np.isfinite(late_tail) & np.isfinite(same)
    assert both.mean() > 0.95
    assert np.median(late_tail[both]) < 0.9 * np.median(same[both])
    assert np.percentile(late_tail[both], 95) < 0.96 * np.percentile(same[both], 95)
