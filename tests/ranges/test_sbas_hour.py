"""Levels over Japan from an hour of messages: the geometry by hand, and the figures that the document tells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sbas_hour
from railfix.core.geodesy import elevation_azimuth, enu_axes, geodetic_from_ecef
from railfix.pipeline.config import parse_config
from railfix.pipeline.level_stage import get_risk_budget
from railfix.ranges.sbas import SatelliteState
from railfix.track.trajectory import Trajectory

pytestmark = pytest.mark.requirement("C2")


@pytest.fixture(scope="module")
def above(recordings: Path) -> sbas_hour.Sky:
    return sbas_hour.sky(recordings, step_s=60)


@pytest.fixture(scope="module")
def line() -> Trajectory:
    return sbas_hour.great_circle((35.681, 139.767), (34.733, 135.500), spacing_m=100_000.0)


@pytest.fixture(scope="module")
def found(above: sbas_hour.Sky, line: Trajectory) -> dict[float, sbas_hour.Levels]:
    return {one.mask_deg: one for one in sbas_hour.levels(above, line, {"noise settings": sbas_hour.by_noise})}


def test_k_sigma_is_the_textbooks(above: sbas_hour.Sky, line: Trajectory, found: dict[float, sbas_hour.Levels]):
    """(G^T W G)^-1 with a column along the track, two of the map with their prior, and the clock, at one instant."""
    point, t, one = 2, 40, found[15.0]
    place = line.ecef_m[point]
    up = enu_axes(*geodetic_from_ecef(place)[:2])[2]
    tangent = line.ecef_m[point + 1] - place
    tangent = tangent / np.linalg.norm(tangent)
    across = np.cross(up, tangent)
    across = across / np.linalg.norm(across)
    sight = above.position_ecef_m[t] - place
    sight = sight / np.linalg.norm(sight, axis=1, keepdims=True)
    elevation = np.degrees(np.arcsin(sight @ up))
    used = above.good[t] & (elevation >= 15.0)
    whole = np.broadcast_to(place, (len(above.time), 3))
    all_of = elevation_azimuth(above.position_ecef_m, whole)
    flt, uire, tropo = (part[t, used] for part in sbas_hour.sigmas_of_sbas(above, whole, *all_of))
    local = np.hypot(1.0 / np.sin(np.radians(elevation[used])), 1.0)
    variance = flt**2 + uire**2 + tropo**2 + local**2
    axes = np.stack([tangent, across, np.cross(tangent, across)])
    design = np.concatenate([-sight[used] @ axes.T, np.ones((used.sum(), 1))], axis=1)
    normal = design.T @ (design / variance[:, None])
    normal += np.diag([0.0, line.sigma_plan_m**-2, line.sigma_height_m**-2, 0.0])
    sigma = np.sqrt(np.linalg.inv(normal)[0, 0])
    k = get_risk_budget(parse_config({"sbas": ["messages"]})).sample_k
    assert one.used[point, t] == used.sum()
    # The line's own tangent at a point of 100 km spacing leans into the Earth by half a degree.
    assert one.fault_free_m[point, t] == pytest.approx(k * sigma, rel=1e-3)
    assert one.variance_m2[point, t].sum() == pytest.approx(sigma**2, rel=2e-3)
    assert (one.variance_m2[point, t] >= -1e-9).all()


def test_levels_over_the_hour(above: sbas_hour.Sky, found: dict[float, sbas_hour.Levels]):
    """docs/level-results.md shows them."""
    late = sbas_hour.warm(above)
    corrected = (above.fixes.state[late] == SatelliteState.OK).sum(axis=1)
    assert 7 <= corrected.min() <= corrected.max() <= 10
    assert not np.isfinite(found[5.0].level_m[:, :2]).any()  # the masks have to come first
    for mask, one in found.items():
        level, alone = one.level_m[:, late], one.fault_free_m[:, late]
        assert (level >= alone).all(), mask
        assert np.mean(level <= 40.0) == 1.0
        assert np.mean(level <= 10.0) == 0.0
        assert 10.0 < np.median(alone) < 20.0
    # A higher mask leaves fewer satellites and wider levels.
    assert np.median(found[5.0].level_m[:, late]) < np.median(found[20.0].level_m[:, late])
    assert (found[20.0].fault_free_m[:, late] >= found[5.0].fault_free_m[:, late] - 1e-9).all()
    # No single cause dominates: corrections, ionosphere and local errors, the troposphere and the map next to nothing.
    share = found[15.0].variance_m2[:, late].sum(axis=(0, 1))
    share = share / share.sum()
    assert 0.3 < share[0] < 0.5
    assert 0.1 < share[1] < 0.3
    assert 0.3 < share[3] < 0.5
    assert share[2] + share[4] < 0.02
