"""The real recordings: one setting for all, screens of health and elevation only.

The limits are those that the package must reach; ``python tests/recordings_score.py`` prints the table.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import recordings_score
from railfix.evaluate import Score


def hold(found: Score, *, rate: float, p50_m: float, p95_m: float, wrong_place: float) -> None:
    assert found.rate >= rate
    assert found.p50_m <= p50_m
    assert found.p95_m <= p95_m
    assert found.wrong_place <= wrong_place


@pytest.mark.requirement("A4")
@pytest.mark.parametrize(
    ("name", "rate", "p50_m", "p95_m", "wrong_place"),
    [
        ("urbannav_f9p", 0.995, 2.1, 12.5, 0.0),
        ("urbannav_m8t", 0.995, 2.8, 14.0, 0.02),
        ("gsdc", 0.995, 3.2, 11.5, 0.0),
        ("smartloc", 0.99, 5.7, 22.0, 0.01),
        ("japan", 0.995, 1.0, 2.0, 0.0),
    ],
)
def test_recording_reaches_its_figures(recordings: Path, name, rate, p50_m, p95_m, wrong_place):
    outcome = recordings_score.RECORDINGS[name](recordings, recordings_score.SETTINGS)
    hold(outcome.constrained, rate=rate, p50_m=p50_m, p95_m=p95_m, wrong_place=wrong_place)


@pytest.mark.requirement("A4")
def test_station_played_as_a_train_on_straight_lines(recordings: Path):
    """Two stations, lines of four azimuths through each, all epochs together."""
    outcomes = [
        recordings_score.geonet(recordings, station, azimuth)
        for station in ("0759", "3040")
        for azimuth in (0, 45, 90, 135)
    ]
    assert all(o.constrained.rate == 1.0 for o in outcomes)
    errors = np.abs(np.concatenate([o.error_m for o in outcomes]))
    assert np.median(errors) <= 0.35
    assert np.percentile(errors, 95) <= 0.9
    assert errors.max() < 50.0


@pytest.mark.requirement("A6")
@pytest.mark.parametrize("name", ["urbannav_m8t", "smartloc"])
def test_the_map_gains_most_where_ranges_are_bad(recordings: Path, name):
    """Against the conventional position of the same ranges, nearest point of the line."""
    outcome = recordings_score.RECORDINGS[name](recordings, recordings_score.SETTINGS)
    assert outcome.constrained.p95_m < 0.75 * outcome.conventional.p95_m


def test_ranges_do_not_bend_with_the_order_of_the_log(recordings: Path):
    """Offsets of the clocks come from the past alone: the first half of a log does not know the second."""
    folder = recordings / "kinematic" / "urbannav_tst"
    whole = recordings_score.urbannav_f9p(recordings).result
    observations = recordings_score.read_observations(folder / "20210517.light-urban.tste.ublox.f9p.obs")
    navigation = recordings_score.read_navigation([folder / "hksc137c.nav"])
    trajectory = recordings_score.trajectory_of(*recordings_score.recordings_truth.urbannav_truth(folder))
    processor = recordings_score.EpochProcessor(recordings_score.SETTINGS, navigation, {"front": trajectory})
    half, _ = processor.process({"front": observations[:300]})
    assert half.antennas["front"].arc_m == pytest.approx(whole.arc_m[:300], abs=1e-6, nan_ok=True)
