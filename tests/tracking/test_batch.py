"""The robust fit of a whole log, the filter's second opinion."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from railfix.core.settings import write_toml
from railfix.pipeline.along_track import gnss_epochs
from railfix.pipeline.config import parse_config
from railfix.run.processor import make_processor
from railfix.simulate.run import vehicle_table
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from railfix.tracking import GnssEpochs
from railfix.tracking.batch import fit_batch, joined_epochs
from sensed_ride import Ride, ride


@pytest.fixture(scope="module")
def case() -> Ride:
    return ride('{"duration_s": 120.0, "rate_hz": 1.0, "sensors": None}')


@pytest.fixture(scope="module")
def trajectory(case: Ride) -> Trajectory:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "vehicle.toml"
        write_toml(path, vehicle_table(case.simulation.scenario.vehicle))
        return antenna_trajectory(case.simulation.line.track(), read_vehicle(path), "front")


@pytest.fixture(scope="module")
def epochs(case: Ride, trajectory: Trajectory) -> GnssEpochs:
    config = parse_config({"filter": "off", "protection": "off"})
    processor = make_processor(config, case.simulation.navigation, {"front": trajectory})
    solved, _ = processor.position(*processor.screen({"front": case.observations}))
    result = solved.results["front"]
    found, _ = gnss_epochs(solved.corrected, result.noise_scale, config, None)
    return replace(found, near_ecef_m=result.conventional_ecef_m)


@pytest.mark.requirement("E5")
def test_places_and_speeds_are_those_of_the_ground_truth_within_their_sigmas(
    case: Ride, trajectory: Trajectory, epochs: GnssEpochs
) -> None:
    batch = fit_batch(epochs, trajectory)
    error = trajectory.chainage_at(batch.arc_m) - case.chainage_m
    assert np.abs(error).max() < 3.0
    assert np.sqrt(((error / batch.sigma_m) ** 2).mean()) < 1.5
    assert np.abs(batch.speed_mps - case.speed_mps).max() < 0.5
    tunnel = ~np.isfinite(epochs.code_m).any(axis=1)
    assert batch.sigma_m[tunnel].max() > 1.2 * np.median(batch.sigma_m[~tunnel])


def test_a_satellite_that_is_wrong_does_not_move_the_places(trajectory: Trajectory, epochs: GnssEpochs) -> None:
    code = epochs.code_m.copy()
    code[:, 0] += 80.0
    right, wrong = (fit_batch(e, trajectory) for e in (epochs, replace(epochs, code_m=code)))
    assert np.abs(right.arc_m - wrong.arc_m).max() < 0.5 * np.median(right.sigma_m)
    code = epochs.code_m + 80.0  # a common error is that of the clock
    common = fit_batch(replace(epochs, code_m=code), trajectory)
    np.testing.assert_allclose(common.arc_m, right.arc_m, atol=0.01)


def test_the_start_does_not_matter(trajectory: Trajectory, epochs: GnssEpochs) -> None:
    whole = fit_batch(epochs, trajectory)
    off = fit_batch(replace(epochs, near_ecef_m=None), trajectory, whole.arc_m + 60.0)
    np.testing.assert_allclose(off.arc_m, whole.arc_m, atol=0.05)
    blind = fit_batch(replace(epochs, near_ecef_m=None), trajectory)
    assert np.isnan(blind.arc_m).all()


def test_chunks_with_other_satellites_are_joined_by_their_names(epochs: GnssEpochs) -> None:
    order = np.arange(len(epochs.satellite))[::-1][:-3]
    late = epochs.take(slice(60, None))
    channels = {
        name: getattr(late, name)[:, order]
        for name in ("sat_ecef_m", "sat_velocity_mps", "code_m", "code_sigma_m", "phase_m", "phase_joined", "rate_mps",
                     "cn0_dbhz")
    }  # fmt: skip
    late = replace(late, satellite=late.satellite[order], clock=late.clock[order], **channels)
    joined = joined_epochs([epochs.take(slice(0, 60)), late])
    column = {name: k for k, name in enumerate(joined.satellite.tolist())}
    kept = epochs.satellite[order].tolist()
    assert len(joined) == len(epochs)
    for k, name in enumerate(epochs.satellite.tolist()):
        np.testing.assert_array_equal(joined.code_m[:60, column[name]], epochs.code_m[:60, k])
        if name in kept:
            np.testing.assert_array_equal(joined.code_m[60:, column[name]], epochs.code_m[60:, k])
        else:
            assert np.isnan(joined.code_m[60:, column[name]]).all()
