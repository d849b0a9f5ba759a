"""What the filter states on recordings, against what is true: cold starts and faults (`belief_campaign`)."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

import belief_campaign
import recordings_truth
from belief_campaign import Case, joined, over, run
from railfix.core.timescale import seconds
from railfix.evaluate.cases import write_case
from railfix.track import Track
from railfix.track.point_files import write_track_csv
from railfix.track.trajectory import Trajectory
from railfix.tracking import TrackStatus


@lru_cache(maxsize=2)
def _case(data: Path, name: str) -> Case:
    return belief_campaign.cases(data)[name]()


def _start(data: Path, name: str, begin_s: float, length_s: float) -> Case:
    """A recording from so many seconds after the reference's first epoch in the log."""
    case = _case(data, name)
    t = seconds(case.observations.time - case.observations.time[0])
    first = t[np.flatnonzero(np.isfinite(case.reference_ecef_m[:, 0]))[0]]
    begin, end = (int(k) for k in np.searchsorted(t, [first + begin_s, first + begin_s + length_s]))
    return case.part(begin, end)


@pytest.mark.requirement("C6")
@pytest.mark.parametrize(
    ("name", "begin_s", "mask_deg"),
    [("pixel", 300.0, 20.0), ("pixel", 0.0, 20.0), ("pixel", 40.0, 15.0), ("f9p", 0.0, 20.0), ("m8t", 240.0, 10.0)],
)
def test_no_cold_start_is_over_its_level(recordings: Path, name: str, begin_s: float, mask_deg: float) -> None:
    """Divided roads, laps of one street, a start on reflections: by straight distance and by chainage."""
    found = run(_start(recordings, name, begin_s, 150.0), {"elevation": {"mask_deg": mask_deg}})
    assert not (found.over | found.over_chainage).any()
    assert found.sure_and_wrong.mean() <= 0.01
    # one promise: a finite level along the line where the status says so, and nowhere else
    assert (np.isfinite(found.level_m) == np.isin(found.status, [TrackStatus.TRACKING, TrackStatus.COASTING])).all()
    # never from epoch to epoch
    changes = np.flatnonzero(np.diff(np.isfinite(found.level_m).astype(int)))
    assert (np.diff(changes) >= 2).all()


@pytest.mark.requirement("C6")
@pytest.mark.parametrize("fault", ["Dopplers +5 m/s", "step of all codes 30 m", "clock -100 m"])
def test_no_fault_is_over_its_level_without_an_alarm(recordings: Path, fault: str) -> None:
    case = _start(recordings, "f9p", 420.0, 120.0)
    along, _ = belief_campaign.sights(case)
    random = np.random.default_rng(5)
    for label, faulty in belief_campaign.faults(case, along, random):
        if label.removesuffix(", from the start") == fault:
            found = run(faulty, {})
            assert not over(label, found).any()
            return
    pytest.fail(f"no fault {fault}")


@pytest.mark.requirement("C6")
@pytest.mark.parametrize(("name", "begin_s", "aside_m"), [("f9p", 420.0, 20.0), ("pixel", 640.0, -20.0)])
def test_a_map_aside_is_within_the_level_on_the_ground(
    recordings: Path, name: str, begin_s: float, aside_m: float
) -> None:
    """How far aside the map lies is part of the straight distance, beside what codes tell of it."""
    found = run(belief_campaign.moved(_start(recordings, name, begin_s, 150.0), aside_m), {})
    assert not found.over_ground.any()
    assert np.isfinite(found.ground_level_m).mean() > 0.3


@pytest.mark.requirement("C6")
def test_map_drawn_to_its_stated_accuracy_is_within_the_level(recordings: Path) -> None:
    """Bends that are not there tell carriageways 20 m aside apart, unless the map's accuracy counts for its shape."""
    drawn = belief_campaign.roughened(_start(recordings, "pixel", 640.0, 150.0), 2.0, seed=2)
    found = run(drawn, {})
    assert not found.over.any()
    assert not found.over_chainage.any()
    unstated = belief_campaign.on_line(drawn, np.asarray(drawn.trajectory.ecef_m))
    assert run(unstated, {}).over_chainage.any()


@pytest.mark.requirement("C6")
def test_the_numbers_of_a_case_folder_are_those_of_its_files(recordings: Path, tmp_path: Path) -> None:
    """Anyone's log, map and reference: a folder with a case.toml."""
    folder = recordings / "kinematic" / "urbannav_tst"
    truth = recordings_truth.urbannav_truth(folder)
    recordings_truth.write_truth_csv(truth, tmp_path / "truth.csv")
    trajectory = _case(recordings, "f9p").trajectory
    write_track_csv(Track.from_ecef(np.asarray(trajectory.ecef_m)), tmp_path / "line.csv")
    log = folder / "20210517.light-urban.tste.ublox.f9p.obs"
    files = {"front": [str(log)], "nav": [str(folder / "hksc137c.nav")], "track": ["line.csv"], "truth": "truth.csv"}
    write_case(tmp_path, {"licence": "none", "fetch": "beside the checkout", "held_out": False, "files": files})
    case = belief_campaign.case_of_folder(tmp_path)
    assert isinstance(case.trajectory, Trajectory)
    np.testing.assert_allclose(case.reference_ecef_m, _case(recordings, "f9p").reference_ecef_m, atol=0.01)


@pytest.mark.slow
@pytest.mark.requirement("C6")
@pytest.mark.parametrize("name", ["m8t", "f9p", "pixel", "japan", "berlin"])
@pytest.mark.parametrize("mask_deg", [10.0, 20.0])
def test_cold_starts_every_half_minute(recordings: Path, name: str, mask_deg: float) -> None:
    settings = {"elevation": {"mask_deg": mask_deg}}
    found = joined([run(part, settings) for _, part in belief_campaign.starts(_case(recordings, name), 30.0, 150.0)])
    assert not (found.over | found.over_chainage).any()
    if name != "berlin":
        assert found.sure_and_wrong.sum() <= 0.01 * max(int(found.tracking.sum()), 1)
