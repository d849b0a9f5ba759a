"""The filter along the track on the real recordings: one setting, bounds a third above what it reaches."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import belief_campaign
import recordings_score
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config
from railfix.run.processor_setup import make_processor

#: Recording: median, 95th percentile, largest error [m], 95th percentile of error over sigma.
BOUNDS = {
    "m8t": (1.9, 4.6, 22.0, 2.8),
    "f9p": (2.4, 4.8, 22.0, 3.7),
    "pixel": (1.6, 5.5, 32.0, 2.9),
    # The map cuts a bend of 10 s without a reference, beyond which laps 5 m apart are alike: it ends on another one.
    "japan": (0.6, 6.0, 6.5, 2.1),
}


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow) if n == "pixel" else n for n in BOUNDS])
@pytest.mark.every(2)
def test_errors_of_the_filter_on_a_recording(recordings: Path, name: str) -> None:
    found = belief_campaign.run(belief_campaign.cases(recordings)[name](), {})
    error = found.straight_m
    p50, p95, largest, ratio = BOUNDS[name]
    assert np.isfinite(error).all()
    assert np.median(error) < p50
    assert np.percentile(error, 95) < p95
    assert error.max() < largest
    assert np.percentile(error / found.sigma_m, 95) < ratio


@pytest.mark.requirement("E5", "C2")
@pytest.mark.parametrize(
    ("azimuth_deg", "end"),
    [
        pytest.param(0.0, "02:30", marks=pytest.mark.slow),
        pytest.param(0.0, "12:00", marks=pytest.mark.slow),
        pytest.param(90.0, "12:00", marks=pytest.mark.slow),
    ],
)
def test_half_a_day_at_rest_is_not_averaged_away(recordings: Path, azimuth_deg: float, end: str) -> None:
    """Errors of orbits and ionosphere last hours: a filter that averages over them states centimetres."""
    folder = recordings / "static" / "ESBC_2020177"
    observations = read_observations(next(folder.glob("*_MO.crx.gz")), end=f"2020-06-25T{end}")
    place = observations.header.approximate_ecef_m
    trajectory = recordings_score.straight_line(place, azimuth_deg)
    config = Config(filter="track", elevation={"mask_deg": 10.0})
    navigation = read_navigation(next(folder.glob("*_MN.rnx.gz")))
    result, _ = make_processor(config, navigation, {"front": trajectory}).process({"front": observations})
    tracked, single = result.fusion["front"].tracked, result.antennas["front"]
    station, _ = trajectory.nearest(place[None])
    error = np.abs(tracked.arc_m - float(station[0]))
    assert np.percentile(error / tracked.sigma_m, 95) < 2.5
    assert np.percentile(error, 95) < 1.25 * np.percentile(np.abs(single.arc_m - float(station[0])), 95)
    assert np.median(tracked.sigma_m) > 0.7
