"""Speed along the track from Dopplers: simulated truth, put-in faults, hand-made geometry, real recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import reference_gaps
from railfix.core.errors import SettingsError
from railfix.core.timescale import seconds
from railfix.gnss import concatenate
from railfix.pipeline.config import DEFAULT_SIGNALS
from railfix.positioning.doppler_speed import Dopplers, DopplerSpeed, DopplerSpeedLimits, doppler_speed, dopplers_of_log
from railfix.simulate.scenario import ReceiverSettings, RunSettings, Scenario
from railfix.simulate.signals import Simulation

pytestmark = pytest.mark.requirement("D1")

SYSTEMS = ("G", "J", "E", "C", "R")


class Simulated:
    """A made-up run: Dopplers, true places and speeds."""

    def __init__(self, noise_hz: float) -> None:
        scenario = Scenario(
            duration_s=150.0,
            rate_hz=2.0,
            run=RunSettings(first_stand_s=10.0),
            receiver=ReceiverSettings(doppler_sigma_hz=noise_hz),
        )
        simulation = Simulation(scenario)
        obs = concatenate(list(simulation.observations("front")))
        tags = seconds(obs.time - scenario.start)
        true = tags - simulation.clocks.bias_s("front", tags)
        place, train_mps = simulation.truth("front", true)
        # The antenna is beyond the bogie: in curves its path is not the body's axis. Hence by difference.
        step = simulation.truth("front", true + 0.01)[0].ecef_m - simulation.truth("front", true - 0.01)[0].ecef_m
        length = np.linalg.norm(step, axis=1)
        self.ecef_m, self.speed_mps = place.ecef_m, np.copysign(length / 0.02, train_mps)
        self.tangent = np.where(
            (length > 1e-3)[:, None],
            np.sign(train_mps)[:, None] * step / np.maximum(length, 1e-3)[:, None],
            place.forward,
        )
        self.drift_mps = 299792458.0 * simulation.scenario.receiver.clock_drift
        self.dopplers = dopplers_of_log(obs, simulation.navigation, systems=SYSTEMS, signals=DEFAULT_SIGNALS)

    def solve(self, dopplers: Dopplers | None = None, limits: DopplerSpeedLimits | None = None) -> DopplerSpeed:
        return doppler_speed(dopplers or self.dopplers, self.ecef_m, self.tangent, limits=limits)


@pytest.fixture(scope="module")
def quiet() -> Simulated:
    return Simulated(0.0)


@pytest.fixture(scope="module")
def noisy() -> Simulated:
    return Simulated(0.2)


def test_without_noise_the_speed_is_the_true_one(quiet: Simulated) -> None:
    """The simulator differences ranges of its own; what is left is the ionosphere's change and RINEX rounding."""
    found = quiet.solve(limits=DopplerSpeedLimits(most_rejected=0))
    assert np.ptp(quiet.speed_mps) > 15.0
    np.testing.assert_allclose(found.speed_mps, quiet.speed_mps, atol=0.002)
    np.testing.assert_allclose(found.clock_drift_mps, quiet.drift_mps, atol=0.002)


def test_with_noise_the_errors_are_as_large_as_their_standard_deviations(noisy: Simulated) -> None:
    found = noisy.solve()
    ratio = (found.speed_mps - noisy.speed_mps) / found.sigma_mps
    assert len(ratio) == 300
    assert 0.8 < np.sqrt(np.mean(ratio**2)) < 1.25
    # 0.2 Hz on L1 are 38 mm/s of range rate; about ten satellites leave less
    assert 0.01 < np.median(found.sigma_mps) < 0.05
    assert (found.rejected.sum() / found.used.sum()) < 0.015


def test_false_dopplers_are_left_out_and_named(noisy: Simulated) -> None:
    rate = noisy.dopplers.rate_mps.copy()
    column = np.flatnonzero(noisy.solve().used.all(axis=0))[[0, 2]]
    rate[50:150, column[0]] += 1.5
    rate[100:200, column[1]] -= 0.8
    found = noisy.solve(replace(noisy.dopplers, rate_mps=rate))
    assert found.rejected[50:150, column[0]].all()
    assert found.rejected[100:200, column[1]].mean() > 0.98
    np.testing.assert_allclose(found.residual_mps[50:100, column[0]], 1.5, atol=0.4)
    assert np.abs(found.speed_mps - noisy.speed_mps).max() < 0.2
    kept = noisy.solve(replace(noisy.dopplers, rate_mps=rate), DopplerSpeedLimits(most_rejected=0))
    assert np.abs(kept.speed_mps - noisy.speed_mps).max() > 0.2


def test_too_few_satellites_give_no_speed(noisy: Simulated) -> None:
    rate = noisy.dopplers.rate_mps.copy()
    for epoch, left in ((10, 3), (11, 4), (12, 0)):
        seen = np.flatnonzero(noisy.solve().used[epoch])
        rate[epoch] = np.nan
        rate[epoch, seen[:left]] = noisy.dopplers.rate_mps[epoch, seen[:left]]
    found = noisy.solve(replace(noisy.dopplers, rate_mps=rate))
    np.testing.assert_array_equal(np.isnan(found.speed_mps[10:13]), [True, False, True])
    np.testing.assert_array_equal(found.n_used[10:13], [0, 4, 0])
    assert np.isnan(found.residual_mps[10]).all()


def test_an_unknown_place_gives_no_speed(noisy: Simulated) -> None:
    place = noisy.ecef_m.copy()
    place[7] = np.nan
    found = doppler_speed(noisy.dopplers, place, noisy.tangent)
    assert np.flatnonzero(np.isnan(found.speed_mps)).tolist() == [7]
    assert found.n_used[7] == 0


def test_epochs_do_not_touch_each_other_but_by_the_scale(quiet: Simulated) -> None:
    rate = quiet.dopplers.rate_mps.copy()
    rate[20] += np.linspace(-3.0, 3.0, rate.shape[1])
    found = quiet.solve(replace(quiet.dopplers, rate_mps=rate), DopplerSpeedLimits(most_rejected=0))
    others = np.arange(len(rate)) != 20
    np.testing.assert_array_equal(
        found.speed_mps[others], quiet.solve(limits=DopplerSpeedLimits(most_rejected=0)).speed_mps[others]
    )
    assert found.sigma_mps[20] > 5.0 * np.median(found.sigma_mps)


def test_limits_are_checked() -> None:
    with pytest.raises(SettingsError, match="greater than or equal to 3"):
        DopplerSpeedLimits(min_satellites=2)
    with pytest.raises(SettingsError, match="greater than 0"):
        DopplerSpeedLimits(zenith_mps=0.0)


#: Recording; bounds of the absolute error [m/s], median and 95th percentile, a fifth over what
#: ``python tests/studies/reference_gaps.py`` prints.
RECORDED = [("gsdc", 0.042, 0.63), ("urbannav", 0.105, 0.43)]


@pytest.mark.parametrize(("name", "p50", "p95"), RECORDED)
def test_speed_of_recordings(name: str, p50: float, p95: float, recordings: Path) -> None:
    recording = reference_gaps.RECORDINGS[name][0](recordings)
    error, _ = reference_gaps.speed_errors(recording)
    assert len(error) > 400
    assert np.median(np.abs(error)) < p50
    assert np.percentile(np.abs(error), 95) < p95
    assert abs(np.median(error)) < 0.02
