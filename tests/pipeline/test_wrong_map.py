"""Off the map, and maps that are wrong: beside the line, on the next track, without the geoid (requirements B6, C4)."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from pipeline_cases import clean_trajectories, demo_observations
from railfix.core.errors import NoPositionError
from railfix.core.reasons import Status
from railfix.integrity.protection import LevelStatus
from railfix.io.rinex import read_navigation
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.results import AntennaResult
from railfix.run.driver import run_files
from railfix.run.inputs import RunInputs
from railfix.simulate.demonstration import demo_files
from railfix.track import Track, read_track, write_track_csv
from railfix.track.trajectory import Trajectory


def moved(trajectory: Trajectory, *, across_m: float = 0.0, up_m: float = 0.0) -> Trajectory:
    """The same line beside or above its place."""
    across = np.concatenate([trajectory.across, trajectory.across[-1:]])
    up = np.concatenate([trajectory.up, trajectory.up[-1:]])
    return replace(trajectory, ecef_m=trajectory.ecef_m + across_m * across + up_m * up)


@cache
def on_a_map(*, across_m: float = 0.0, up_m: float = 0.0, map_prior: float = 1e-4, every: int = 2) -> AntennaResult:
    """The front antenna of the demonstration on a moved map, every second epoch."""
    line = moved(clean_trajectories()["front"], across_m=across_m, up_m=up_m)
    config = parse_config({"filter": "off", "risk": {"map_prior": map_prior}})
    processor = EpochProcessor(config, {"front": line}, navigation=read_navigation(demo_files()["nav"]))
    return processor.process({"front": demo_observations()["front"][::every]})[0].antennas["front"]


def in_the_middle(result: AntennaResult) -> np.ndarray:
    """Epochs with a position that is not clamped to an end of the line."""
    return np.isfinite(result.fix.constrained.arc_m) & (result.fix.constrained.overshoot_m == 0.0)


@pytest.fixture(scope="module")
def right() -> AntennaResult:
    return on_a_map()


def test_the_right_map_is_neither_off_nor_offset(right: AntennaResult) -> None:
    assert not np.isin(right.status, [Status.OFF_MAP, Status.MAP_OFFSET]).any()
    assert np.nanmax(right.map_offset.statistic) < 9.2


@pytest.mark.requirement("C4")
@pytest.mark.parametrize(("across_m", "least"), [(50.0, 0.97), (200.0, 0.97), (2000.0, 0.97)])
@pytest.mark.every(3)
def test_off_the_map_in_the_middle_of_a_line(across_m: float, least: float) -> None:
    """The nearest point is within the line: no end that clamps tells it."""
    result = on_a_map(across_m=across_m)
    middle = in_the_middle(result)
    assert middle.sum() > 250
    told = np.isin(result.status, [Status.OFF_MAP, Status.MAP_OFFSET])
    assert told[middle].mean() > least
    assert not (result.protection.status[told] == LevelStatus.AVAILABLE).any()


@pytest.mark.requirement("C4")
@pytest.mark.parametrize(("across_m", "most"), [(20.0, 0.019), (50.0, 0.0)])
def test_a_map_beside_the_line_is_not_ok(across_m: float, most: float) -> None:
    result = on_a_map(across_m=across_m, every=1)
    observed = result.status != Status.NO_OBSERVATION
    assert (result.status[observed] == Status.OK).mean() <= most


@pytest.mark.requirement("C4")
def test_a_forgotten_geoid_is_not_ok(right: AntennaResult) -> None:
    result = on_a_map(up_m=37.0)
    assert (result.status == Status.OK).sum() < 0.1 * (right.status == Status.OK).sum()
    offset = result.map_offset
    assert np.nanmax(offset.statistic) > 13.8
    assert np.nanmedian(offset.up_m) == pytest.approx(-37.0, abs=3.0 * float(np.nanmedian(offset.up_sigma_m)))


@pytest.mark.requirement("C2")
@pytest.mark.parametrize("offset", [{"up_m": 10.0}, {"across_m": 5.0}], ids=["10 m above", "5 m beside"])
def test_a_small_offset_is_a_term_of_the_level(right: AntennaResult, offset: dict[str, float]) -> None:
    """Satellites and atmosphere can do as much, so it is no verdict; the level grows by what is beyond one sigma."""
    result = on_a_map(**offset)
    late = np.arange(len(right)) > 750
    assert right.protection is not None
    assert result.protection is not None
    before, after = (r.protection.level.level_m[late] for r in (right, result))
    assert np.nanmedian(after) > np.nanmedian(before) + 0.3
    across, up = result.map_offset.beyond_m
    assert max(np.median(np.abs(across[late])), np.median(np.abs(up[late]))) > 1.0


@pytest.mark.requirement("C4")
@pytest.mark.parametrize("part", [0, 1], ids=["across", "up"])
def test_the_status_names_what_is_detectable(right: AntennaResult, part: int) -> None:
    """The right map shows its own offset, so that one of the detectable size counts from there."""
    late = np.arange(len(right)) > 750
    offset = right.map_offset
    shown = float(np.nanmedian((offset.across_m, offset.up_m)[part][late]))
    size = float(np.nanmedian(offset.detectable_m[late, part]))
    names = ("across_m", "up_m")
    for factor, least, most in ((1.3, 0.95, 1.0), (0.4, 0.0, 0.01)):
        result = on_a_map(**{names[part]: -np.copysign(factor * size - abs(shown), shown)})
        observed = late & (result.status != Status.NO_OBSERVATION)
        told = np.isin(result.status[observed], [Status.MAP_OFFSET, Status.OFF_MAP])
        assert least <= told.mean() <= most, (factor, size, told.mean())


@pytest.mark.requirement("C2")
def test_a_map_that_is_not_found_wrong_is_within_the_level(right: AntennaResult) -> None:
    """The position without the map, at the prior of a wrong map, with and without a faulty satellite."""
    wrong = on_a_map(up_m=20.0)
    free = on_a_map(up_m=20.0, map_prior=0.0)
    with_it, without_it = wrong.protection.level.level_m, free.protection.level.level_m
    has = np.isfinite(without_it)
    assert (with_it[has] >= without_it[has] * (1.0 - 1e-3)).all()
    assert np.percentile(with_it[has] / without_it[has], 95) > 1.02
    # A prior of one in a hundred counts more.
    more = on_a_map(up_m=20.0, map_prior=1e-2).protection
    has &= np.isfinite(with_it)
    assert np.median(more.level.level_m[has] / with_it[has]) > 1.01
    clean = right.protection.level.level_m
    covered = on_a_map(map_prior=0.0).protection
    finite = np.isfinite(clean)
    assert np.median(clean[finite] / covered.level.level_m[finite]) < 1.01


@pytest.mark.requirement("C4")
def test_a_run_on_a_map_without_the_geoid_says_so(tmp_path: Path) -> None:
    """``railfix run`` with every height 37 m too low: an error with the size and the likely cause."""
    files = demo_files()
    track = read_track(files["track"])
    lower = track.ecef_m - 37.0 * (track.ecef_m / np.linalg.norm(track.ecef_m, axis=1, keepdims=True))
    write_track_csv(Track.from_ecef(lower, name="without geoid"), tmp_path / "low.csv")
    inputs = RunInputs(front=(files["front"],), nav=(files["nav"],), track=(tmp_path / "low.csv",))
    # no antenna has a position that is promised: the run ends with its cause, and nothing is written
    with pytest.raises(NoPositionError, match=r"likely cause: .*above the geoid, not the ellipsoid"):
        run_files(inputs, out=tmp_path / "results")
    assert not (tmp_path / "results" / "run.json").exists()
