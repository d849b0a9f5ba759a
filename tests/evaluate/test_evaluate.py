"""Figures of merit against hand-worked cases."""

from __future__ import annotations

import numpy as np
import pytest

import synthetic
from railfix.core.timescale import timedelta
from railfix.evaluate import along_track_error, interpolate_reference, score, straight_distance
from railfix.track import Track
from railfix.track.trajectory import Trajectory

START = np.datetime64("2024-03-05T01:00:00", "ns")
STRAIGHT = Trajectory.from_antenna_path(
    Track.from_ecef(synthetic.enu_to_ecef(np.stack([np.arange(0, 501, 10.0), *np.zeros((2, 51))], axis=1)))
)


@pytest.mark.requirement("D2")
def test_error_is_positive_toward_the_end_of_the_line():
    reference = STRAIGHT.at_arc(np.array([100.0, 100.0, 100.0, 100.0]))
    reference[3] = np.nan
    error = along_track_error(np.array([103.0, 96.0, np.nan, 100.0]), reference, STRAIGHT)
    assert error[:2] == pytest.approx([3.0, -4.0], abs=1e-6)
    assert np.isnan(error[2:]).all()


@pytest.mark.requirement("D2")
def test_reference_beside_the_line_counts_at_its_nearest_point():
    beside = STRAIGHT.at_arc(np.array([250.0])) + 7.0 * STRAIGHT.across[0]
    assert along_track_error(np.array([252.0]), beside, STRAIGHT) == pytest.approx([2.0], abs=1e-4)


@pytest.mark.requirement("D2")
def test_other_branch_of_a_hairpin_is_the_same_place_within_its_width():
    s = np.arange(0.0, 300.0, 5.0)
    out = np.stack([s, 0 * s, 0 * s], axis=1)
    back = np.stack([s[::-1], 0 * s + 12.0, 0 * s], axis=1)
    hairpin = Trajectory.from_antenna_path(Track.from_ecef(synthetic.enu_to_ecef(np.concatenate([out, back]))))
    reference = hairpin.at_arc(np.array([100.0]))
    beside = hairpin.arc_m[-1] - 100.0
    assert along_track_error(np.array([beside + 4.0]), reference, hairpin) == pytest.approx([4.0], abs=1e-3)
    # the straight distance needs no choice of a pass: 12 m across and 4 m along
    straight = straight_distance(np.array([beside + 4.0, np.nan]), np.repeat(reference, 2, axis=0), hairpin)
    assert straight == pytest.approx([np.hypot(12.0, 4.0), np.nan], abs=1e-3, nan_ok=True)
    strict = along_track_error(np.array([beside + 4.0]), reference, hairpin, same_place_m=5.0)
    assert strict == pytest.approx([np.hypot(12.0, 4.0)], abs=1e-3)  # straight across, not round the bend


@pytest.mark.requirement("D2")
def test_score_counts_by_hand():
    error = np.array([1.0, -2.0, 3.0, np.nan, -60.0, 500.0])
    observed = np.array([True, True, True, True, True, False])
    found = score(error, observed)
    assert (found.epochs, found.positions) == (5, 4)
    assert found.rate == pytest.approx(0.8)
    assert found.p50_m == pytest.approx(2.5)
    assert found.max_m == 60.0
    assert found.wrong_place == pytest.approx(0.25)
    assert found.mean_m == pytest.approx(-14.5)
    with pytest.raises(ValueError, match="within the time span of the reference"):
        score(error, np.zeros(6, dtype=bool))


def test_reference_is_not_carried_over_gaps_or_ends():
    known = START + timedelta(np.array([0.0, 1.0, 2.0, 10.0]))
    place = np.array([[0.0, 0, 0], [2, 0, 0], [4, 0, 0], [5, 0, 0]])
    asked = START + timedelta(np.array([-0.5, 0.0, 0.25, 2.0, 5.0, 10.0, 10.5]))
    found = interpolate_reference(asked, known, place)[:, 0]
    assert found[[1, 2, 3, 5]] == pytest.approx([0.0, 0.5, 4.0, 5.0])
    assert np.isnan(found[[0, 4, 6]]).all()
