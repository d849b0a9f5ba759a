"""Detection: P4's numbers, the rate of false alarms, the limits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, chi2

import raim_cases
from railfix.core.errors import SettingsError
from railfix.integrity.raim import RaimLimits, detect, threshold

pytestmark = pytest.mark.requirement("B6")


def test_numbers_of_p4():
    """False alarm 0.001, sigma0 = 1 m, 3 degrees of freedom: T_CS = 16.27, T_D = 4.03."""
    limit = threshold(3)
    assert limit == pytest.approx(16.27, abs=0.005)
    assert np.sqrt(limit) == pytest.approx(4.03, abs=0.005)


def test_threshold_leaves_the_false_alarm_rate_to_its_right():
    freedom = np.array([[1, 2, 3], [10, 64, 200]])
    for rate in (1e-2, 1e-4, 1e-7):
        limit = threshold(freedom, limits=RaimLimits(false_alarm=rate))
        assert chi2.sf(limit, freedom) == pytest.approx(np.full((2, 3), rate), rel=1e-9)
    assert np.isnan(threshold(np.array([0, -2]))).all()
    assert threshold(np.array([], dtype=int)).shape == (0,)


@pytest.mark.parametrize(
    ("residual", "freedom", "limits", "verdict"),
    [
        # residuals of weight 1, degrees of freedom, limits -> (detected, testable)
        ([2.0, 2.0, 2.0], 3, RaimLimits(), (False, True)),
        ([4.0, 0.5, 0.0], 3, RaimLimits(), (False, True)),  # 16.25
        ([4.0, 0.6, 0.0], 3, RaimLimits(), (True, True)),  # 16.36
        ([4.0, 0.6, 0.0], 4, RaimLimits(), (False, True)),
        ([4.0, 0.6, 0.0], 0, RaimLimits(), (False, False)),
        ([4.0, 0.6, 0.0], -1, RaimLimits(), (False, False)),
        ([np.nan, 0.0, 0.0], 3, RaimLimits(), (False, False)),
        ([6.0, 8.0, 0.0], 3, RaimLimits(mode="fixed"), (True, True)),  # at the limit: P4's T >= T_D
        ([6.0, 7.9, 0.0], 3, RaimLimits(mode="fixed"), (False, True)),
        ([6.0, 8.0, 0.0], 0, RaimLimits(mode="fixed"), (False, False)),
        ([6.0, 8.0, 0.0], 3, RaimLimits(mode="fixed", fixed_limit_m2=101.0), (False, True)),
    ],
)
@pytest.mark.requirement("B4")
def test_truth_table(residual, freedom, limits, verdict):
    nu = np.array([residual])
    got = detect((nu**2).sum(axis=1), nu, np.array([freedom]), limits=limits)
    assert (bool(got.detected[0]), bool(got.testable[0])) == verdict
    assert np.isnan(got.threshold[0]) == (not verdict[1])


def test_exactly_at_the_chi_square_limit_is_a_fault():
    limit = threshold(5)
    for value, detected in ((limit, True), (np.nextafter(limit, 0.0), False)):
        assert detect([value], [[0.0]], [5]).detected[0] == detected


def test_scale_multiplies_the_sigmas():
    wsse, freedom = np.array([60.0, 60.0, 60.0]), np.array([6, 6, 6])
    got = detect(wsse, np.zeros((3, 2)), freedom, scale=np.array([1.0, 2.0, 0.7]))
    assert got.statistic == pytest.approx([60.0, 15.0, 60.0 / 0.49])
    assert got.detected.tolist() == [True, False, True]
    fixed = detect(
        wsse, np.full((3, 2), 6.0), freedom, scale=np.array([1.0, 2.0, 0.7]), limits=RaimLimits(mode="fixed")
    )
    assert fixed.statistic.tolist() == [72.0] * 3


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ({"mode": "chi"}, "setting mode: .*'chi_square' or 'fixed'"),
        ({"false_alarm": 0.0}, "false_alarm"),
        ({"missed_detection": 1.0}, "missed_detection"),
        ({"false_alarm": 0.6, "missed_detection": 0.5}, "add up to less than 1"),
        ({"separation_risk": 0.0}, "separation_risk"),
        ({"noise_risk": 2.0}, "noise_risk"),
        ({"max_excluded": 3}, "max_excluded"),
        ({"faults": 0}, "faults"),
        ({"min_redundancy": 0}, "min_redundancy"),
        ({"fixed_limit_m2": 0.0}, "fixed_limit_m2"),
        ({"alarm_limit_m": float("nan")}, "alarm_limit_m"),
        ({"same_position_m": -1.0}, "same_position_m"),
    ],
)
def test_limits_out_of_range(setting, words):
    with pytest.raises(SettingsError, match=words):
        RaimLimits(**setting)


def false_alarms_are_as_set(systems: str, ties: tuple[float, ...] | None, epochs: int, rates: list[float]) -> None:
    """Binomial interval of 99.99 % around each set rate, on the line and in space, noise and map error as assumed."""
    arc = np.random.default_rng(7).uniform(50.0, 1950.0, epochs)
    ranges = raim_cases.made(arc, systems, seed=len(systems), tie_sigma_m=ties)
    got, line = raim_cases.solved(ranges, arc)
    cases = [(got.wsse, got.residual_m, line.freedom)]
    if line.freedom[0] >= 3:
        space = raim_cases.in_space(ranges)
        cases.append((space.wsse, space.residual_m, space.freedom))
    for wsse, residual_m, freedom in cases:
        found = np.isfinite(wsse)
        assert found.mean() > 0.99
        for rate in rates:
            verdict = detect(wsse[found], residual_m[found], freedom[found], limits=RaimLimits(false_alarm=rate))
            low, high = binom.interval(0.9999, int(found.sum()), rate)
            assert low <= np.count_nonzero(verdict.detected) <= high
        assert np.mean(wsse[found] / freedom[found]) == pytest.approx(1.0, abs=6 / np.sqrt(epochs * freedom[0] / 2))


MIXES = [
    ("GGG", None),
    ("GGGG", None),
    ("GGGEE", None),
    ("GGGGEEECC", None),
    ("GGGGEC", (0.0, 1.0, 2.0)),
    ("GGGGGGGGEEEEEECCCCCRRRR", None),
]


@pytest.mark.parametrize(("systems", "ties"), MIXES)
@pytest.mark.every(3)
def test_false_alarm_rate(systems, ties):
    false_alarms_are_as_set(systems, ties, 20_000, [1e-2, 1e-3])


@pytest.mark.slow
@pytest.mark.parametrize(("systems", "ties"), [*MIXES, ("G" * 12 + "E" * 10 + "C" * 10 + "R" * 8, None)])
def test_false_alarm_rate_of_many_epochs(systems, ties):
    false_alarms_are_as_set(systems, ties, 1_200_000 // max(len(systems), 8), [1e-2, 1e-3, 1e-4])
