"""Protection levels on real recordings: what error models of other recordings hold, and what they cost.

``python tests/studies/integrity_recordings.py FOLDER`` prints the tables that the bounds here are of.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import integrity_recordings
from integrity_recordings import ALARM_LIMITS_M, Group
from railfix.integrity.raim import linear_model
from railfix.integrity.stanford import Region

pytestmark = [pytest.mark.requirement("C2"), pytest.mark.slow]


@pytest.fixture(scope="module")
def groups(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], Group]:
    names = list(integrity_recordings.MODELS)
    found = integrity_recordings.everything(recordings, tmp_path_factory.mktemp("integrity"), names)
    keys = [(name, model) for name in names for model in integrity_recordings.MODELS[name]]
    return dict(zip(keys, found, strict=True))


def available(group: Group, limit_m: float) -> float:
    return float(np.mean(np.concatenate([(one.level_m <= limit_m)[one.observed] for one in group])))


def median_level(group: Group) -> float:
    level = np.concatenate([one.level_m[one.observed] for one in group])
    return float(np.median(level[np.isfinite(level)]))


def test_no_error_passes_its_level(groups):
    total = 0
    for (name, model), group in groups.items():
        total += sum(int(np.isfinite(one.level_m).sum()) for one in group)
        assert sum(one.over for one in group) == 0, (name, model)
    assert total > 12_000


@pytest.mark.requirement("C4")
def test_the_verdict_never_lets_an_error_pass(groups):
    """What the run calls available: misleading at no alarm limit, with no model, not even one that is too narrow."""
    counts: Counter[Region] = Counter()
    for group in groups.values():
        for one in group:
            for limit in ALARM_LIMITS_M:
                counts.update(one.diagram(limit, one.verdict_m).counts)
    assert counts[Region.MISLEADING] + counts[Region.HAZARDOUS] + counts[Region.UNAVAILABLE_MISLEADING] == 0
    assert counts[Region.NOMINAL] > 3000


@pytest.mark.requirement("C4")
@pytest.mark.parametrize(
    ("name", "model", "median_m", "limit_m", "rate"),
    [
        ("urbannav_f9p", "none", 45.0, 40.0, 0.30),
        ("urbannav_f9p", "all others", 80.0, 40.0, 0.05),
        ("urbannav_m8t", "none", 80.0, 40.0, 0.16),
        ("urbannav_m8t", "all others", 120.0, 40.0, 0.04),
        ("gsdc", "none", 160.0, 700.0, 0.88),
        ("gsdc", "all others", 320.0, 1200.0, 0.88),
        ("japan", "none", 13.0, 15.0, 0.93),
        ("japan", "all others", 200.0, 250.0, 0.90),
        ("japan", "own first half", 7.0, 10.0, 0.97),
        ("japan", "own first half, base", 16.0, 20.0, 0.97),
        ("geonet2005", "none", 20.0, 20.0, 0.50),
        ("geonet2005", "same, no C/N0", 65.0, 40.0, 0.11),
    ],
)
def test_levels_and_availability(groups, name, model, median_m, limit_m, rate):
    """By levels alone: on courses that pass a place twice the verdict calls all of them ambiguous."""
    group = groups[name, model]
    assert 0.5 * median_m < median_level(group) < median_m
    assert available(group, limit_m) > rate


@pytest.mark.requirement("C3")
def test_a_model_of_open_sky_makes_no_small_levels_in_a_city(groups):
    """Far too narrow there: the receiver's own scale sets the sigmas."""
    for name in ("urbannav_f9p", "urbannav_m8t", "gsdc"):
        assert median_level(groups[name, "open sky, base"]) > 0.8 * median_level(groups[name, "none"]), name


@pytest.mark.requirement("C3")
def test_no_model_moves_a_position(groups):
    for name in ("urbannav_f9p", "urbannav_m8t", "gsdc", "japan"):
        (one,), (other,) = groups[name, "none"], groups[name, "all others"]
        assert np.array_equal(one.result.arc_m, other.result.arc_m, equal_nan=True), name


@pytest.mark.requirement("C3")
def test_levels_are_not_empty_of_meaning(groups):
    """On the phone an error comes to a third of its level: a quarter as wide and it would be passed."""
    (one,) = groups["gsdc", "none"]
    ratio = np.abs(one.error_m) / one.level_m
    assert 0.3 < np.nanmax(ratio[np.isfinite(one.level_m)]) < 1.0


@pytest.mark.requirement("C3")
def test_a_scale_of_quiet_residuals_would_be_too_small_under_open_sky(groups):
    """Residuals of six minutes do not show what moves a position by a metre all the time; the floor of 1 m does."""
    found = {}
    for model in ("none", "none, scale as estimated"):
        (one,) = groups["japan", model]
        has = np.isfinite(one.level_m) & np.isfinite(one.error_m)
        found[model] = np.percentile(np.abs(one.error_m[has]) / one.result.protection.level.sigma_m[has], 68)
    assert found["none, scale as estimated"] > 1.8
    assert found["none"] < 1.0


@pytest.mark.requirement("C3")
@pytest.mark.parametrize("name", ["urbannav_f9p", "gsdc", "japan"])
def test_errors_of_positions_are_what_the_errors_of_ranges_do(groups, name):
    """Gains of the model that the level rests on, times true errors of the ranges, against the reference."""
    (one,) = groups[name, "all others"]
    both = np.isfinite(one.error_m) & np.isfinite(one.from_ranges_m) & (np.abs(one.error_m) < 30.0)
    assert both.sum() > 300
    # Left over: the curve of the line between truth and answer, and the map's own error.
    assert np.median(np.abs(np.abs(one.from_ranges_m[both]) - np.abs(one.error_m[both]))) < 0.35


def test_the_level_follows_from_what_the_result_tells(groups):
    """Sigma of the position once more from sigmas, satellites and clocks in the result."""
    (one,) = groups["urbannav_f9p", "all others"]
    result = one.result
    arc = np.where(np.isfinite(result.arc_m), result.fix.constrained.arc_m, np.nan)
    model = linear_model(
        integrity_recordings.ranges_of(result),
        one.trajectory,
        arc,
        section=np.maximum(result.fix.constrained.section, 0),
    )
    level, scale = result.protection.level, result.noise_scale
    has = np.isfinite(level.sigma_m) & np.isfinite(result.arc_m)
    assert has.sum() > 600
    map_response = model.covariance_m2[:, 0, 1:] * np.sqrt(np.diag(model.prior)[1:])
    of_map = (map_response**2).sum(axis=1)
    bound = np.nan_to_num(result.bound_sigma_m[:, result.columns]) * model.root_weight
    beyond = np.maximum(bound**2 - scale[:, None] ** 2, 0.0) * model.used
    expected = scale**2 * (model.covariance_m2[:, 0, 0] - of_map) + of_map + (model.gain_m[..., 0] ** 2 * beyond).sum(1)
    assert np.sqrt(expected[has]) == pytest.approx(level.sigma_m[has], rel=1e-6)
