"""Satellites whose codes are wrong for long: found, left out, and named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import belief_campaign
from plain_kernels import plain
from railfix.core.geodesy import enu_axes
from railfix.core.timescale import seconds
from railfix.kernels.tracking.constants import BIAS_FAULTY, BIAS_SHORT
from railfix.pipeline.config import parse_config
from railfix.run.processor_setup import make_processor
from railfix.run.tally import Tally
from railfix.track import Track
from railfix.track.trajectory import Trajectory
from railfix.tracking import Kind, Line, TrackState, track
from tracking_cases import LATITUDE, LONGITUDE, bent_line, part, ride


@pytest.mark.requirement("E5")
def test_the_mean_of_clipped_innovations_by_hand() -> None:
    adaptation = plain("tracking.adaptation")
    before, innovations = (0.0, 0.345, 0.5, -0.345, -0.545), (-4.0, 3.0, 3.0, -3.0, -3.0)
    found = [
        adaptation.update_bias(bias, innovation, 1.0) for bias, innovation in zip(before, innovations, strict=True)
    ]
    share = 1.0 - np.exp(-1.0 / 60.0)
    after = [-share, 0.345 + share * 0.655, 0.5 + share * 0.5, -0.345 - share * 0.655, -0.545 - share * 0.455]
    np.testing.assert_allclose(found, after)
    assert found[1] > BIAS_FAULTY
    assert BIAS_SHORT < found[3] < -BIAS_FAULTY
    assert found[4] < BIAS_SHORT
    assert [adaptation.is_faulty(bias) for bias in before] == [False, False, True, False, False]
    assert [adaptation.is_faulty(bias) for bias in found] == [False, True, True, False, True]


@pytest.mark.requirement("E5", "C6")
@pytest.mark.parametrize("size_m", [-40.0, 25.0])
def test_a_code_that_stays_wrong_is_left_out_and_comes_back(size_m: float) -> None:
    case = ride(400, noise=1.0, seed=3, code_sigma_m=4.0, speed_mps=lambda t: np.clip(0.5 * (t - 10.0), 0.0, 5.0))
    code = case.epochs.code_m.copy()
    code[30:230, 4] += size_m
    epochs = replace(case.epochs, code_m=code)
    found, _ = track(epochs, case.line)
    left_out = found.faulty[:, 4]
    assert 30 < np.argmax(left_out) < 130
    assert left_out[200:230].all()
    assert not left_out[330:].any()
    assert not np.delete(found.faulty, 4, axis=1).any()
    assert (found.weight[left_out, Kind.CODE, 4] == 0.0).all()
    assert np.abs(found.arc_m - case.arc_m)[150:].max() < 4.0
    # cut anywhere, the same
    state: TrackState | None = None
    pieces = []
    for begin, end in ((0, 70), (70, 71), (71, 400)):
        some, state = track(part(epochs, slice(begin, end)), case.line, state)
        pieces.append(some.faulty)
    np.testing.assert_array_equal(np.concatenate(pieces), found.faulty)


@pytest.mark.requirement("C6", "E5")
def test_errors_of_orbits_clocks_and_the_ionosphere_are_no_faults() -> None:
    """Under an open sky they are larger than the noise of a code, and last for the whole run."""
    case = ride(400, noise=1.0, seed=3, code_sigma_m=0.5, speed_mps=lambda t: np.clip(0.5 * (t - 10.0), 0.0, 5.0))
    nominal = np.random.default_rng(3).normal(0.0, 1.0, case.epochs.code_m.shape[1])
    found, _ = track(replace(case.epochs, code_m=case.epochs.code_m + nominal), case.line, levels=True)
    assert np.isfinite(found.level_m[60:]).all()
    assert (np.abs(found.arc_m - case.arc_m) < found.level_m)[60:].all()


@pytest.mark.requirement("C6", "E5")
def test_a_right_code_among_late_ones_counts() -> None:
    """Reflections of most satellites pull the clock: codes of the highest, which has none, seem too short."""
    case = ride(400, noise=1.0, seed=3, code_sigma_m=4.0, speed_mps=lambda t: np.full(len(t), 5.0))
    generator = np.random.default_rng(11)
    late = np.abs(generator.normal(0.0, 6.0, (400 // 40, case.epochs.code_m.shape[1]))).repeat(40, axis=0)
    late[:, 0] = 0.0
    found, _ = track(replace(case.epochs, code_m=case.epochs.code_m + late), case.line)
    assert not found.faulty[:, 0].any()


@pytest.mark.requirement("C6", "E5")
def test_three_late_codes_are_reflections_and_no_wrong_map() -> None:
    case = ride(400, noise=1.0, seed=3, code_sigma_m=2.0, speed_mps=lambda t: np.clip(0.5 * (t - 10.0), 0.0, 5.0))
    code = case.epochs.code_m.copy()
    code[30:, [1, 4, 7]] += 15.0
    found, _ = track(replace(case.epochs, code_m=code), case.line, levels=True)
    several = found.faulty.sum(axis=1) > 2
    assert several.sum() > 100
    assert np.isfinite(found.level_m[several]).mean() > 0.9
    assert (np.abs(found.arc_m - case.arc_m) < found.level_m)[5:].all()


@pytest.mark.requirement("C6")
def test_many_faulty_satellites_are_a_wrong_map() -> None:
    """10 m aside in curves: each satellite contradicts the map by itself, and without them nothing does."""
    turning = bent_line(2000.0, turn_deg=300.0)
    case = ride(
        160, trajectory=turning, start_m=100.0, noise=1.0, code_sigma_m=1.0, speed_mps=lambda t: np.full(len(t), 10.0)
    )
    north = enu_axes(np.array(LATITUDE), np.array(LONGITUDE))[1]
    aside = Track.from_ecef(np.asarray(turning.ecef_m) + 10.0 * north)
    line = Line(Trajectory.from_antenna_path(aside))
    wrong, _ = track(case.epochs, line, levels=True)
    many = wrong.faulty.sum(axis=1) > 2
    assert many.sum() > 50
    assert np.isfinite(wrong.ground_level_m[many]).mean() < 0.7
    apart_m = np.linalg.norm(line.at(wrong.arc_m)[0] - case.line.at(case.arc_m)[0], axis=1)
    assert (apart_m < wrong.ground_level_m)[20:].all()
    right, _ = track(case.epochs, case.line, levels=True)
    assert np.isfinite(right.ground_level_m[30:]).all()


@pytest.mark.requirement("B4", "E5", "C6")
@pytest.mark.parametrize("satellite", ["C27", "G21"])
@pytest.mark.parametrize("by", ["single epochs", "the filter"])
def test_a_faulty_satellite_of_a_recording_is_named_within_150_s(recordings: Path, satellite: str, by: str) -> None:
    """The filter takes over what single epochs have found, and finds it alone where these do not look for it."""
    case = belief_campaign.cases(recordings)["f9p"]().part(0, 200)
    obs = case.observations
    obs = replace(obs, code_m=obs.code_m + 20.0 * (obs.satellite == satellite))
    alone = {"lasting_errors": {"most_satellites": 0}} if by == "the filter" else {}
    processor = make_processor(parse_config({"filter": "track", **alone}), case.navigation, {"front": case.trajectory})
    result, _ = processor.process({"front": obs})
    tally = Tally()
    tally.add(result)
    antenna = tally.antennas["front"]
    count, first = (antenna.left_out if alone else antenna.lasting)[satellite]
    assert count > 40
    assert float(seconds(first - obs.time[0])) <= 150.0
    judged = belief_campaign.judged(replace(case, observations=obs), result.fusion["front"].tracked)
    assert not (judged.over | judged.over_chainage).any()
