"""The filter along the track in the Gaussian limit against filterpy's Kalman filter and smoother."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from kalman_oracle import GALILEO, Kalman, Oracle, S, V
from railfix.track import Track
from railfix.track.trajectory import Trajectory
from railfix.tracking import SensorEpochs, Tracked, TrackingLimits, TrackState, smooth_steps, track
from railfix.tracking.chunk import prepare_chunk
from railfix.tracking.search import places
from tracking_cases import ORIGIN_M, Ride, part, ride

#: One hypothesis, normal errors, nothing learnt of the noise and the map, every speed believed.
NORMAL = TrackingLimits(
    degrees_of_freedom=1e12, late_degrees_of_freedom=1e12, most_hypotheses=1, start_separation_m=1e6,
    map_misfit_sigmas=1e9, trusted_satellites=0, level="off",
)  # fmt: skip
EPOCHS = 150


def straight_line(length_m: float = 3000.0) -> Trajectory:
    """Points 50 m apart, at which the filter begins."""
    along = np.arange(0.0, length_m + 1.0, 50.0)
    return Trajectory.from_antenna_path(Track.from_ecef(ORIGIN_M[0] + along[:, None] * ORIGIN_M[1]))


@pytest.fixture(scope="module")
def case() -> tuple[Ride, SensorEpochs]:
    """Codes of two constellations, phases and Dopplers of three satellites, a wheel, two known places, two gaps."""
    made = ride(EPOCHS, trajectory=straight_line(), start_m=200.0, noise=1.0, seed=4)
    random, epochs = np.random.default_rng(5), made.epochs
    code, phase, rate = (np.array(v) for v in (epochs.code_m, epochs.phase_m, epochs.rate_mps))
    phase[:, 3:] = rate[:, 3:] = np.nan
    code[70:75] = phase[70:75] = rate[70:75] = np.nan
    code[20:40, 8] = phase[90, 1] = rate[30:50, 0] = np.nan
    cn0 = random.uniform(30.0, 50.0, code.shape)
    way = np.concatenate([[np.nan], np.diff(made.arc_m)]) / 1.004 + 0.02 * random.normal(size=EPOCHS)
    way[100:120] = np.nan
    place = np.full(EPOCHS, np.nan)
    place[[60, 73]] = made.arc_m[[60, 73]] + 0.3
    sensors = SensorEpochs(
        wheel_m=way, wheel_sigma_m=np.full(EPOCHS, 0.02), place_m=place, place_sigma_m=np.full(EPOCHS, 0.5)
    )
    return replace(made, epochs=replace(epochs, code_m=code, phase_m=phase, rate_mps=rate, cn0_dbhz=cn0)), sensors


@pytest.fixture(scope="module")
def expected(case: tuple[Ride, SensorEpochs]) -> Kalman:
    ride, sensors = case
    chunk = prepare_chunk(part(ride.epochs, slice(0, 1)), TrackState(), NORMAL)
    (start,) = places(chunk, 0, ride.line, NORMAL)
    return Oracle(ride.epochs, sensors, ride.line, NORMAL).run(float(start))


def assert_equal(found: Tracked, expected: Kalman) -> None:
    """Places and speeds agree to a micrometre, their standard deviations to a millionth."""
    assert (found.hypotheses == 1).all()
    for values, unknown, sigmas in ((found.arc_m, S, found.sigma_m), (found.speed_mps, V, found.speed_sigma_mps)):
        np.testing.assert_allclose(values, expected.mean[:, unknown], rtol=0.0, atol=1e-6)
        np.testing.assert_allclose(sigmas, np.sqrt(expected.covariance[:, unknown, unknown]), rtol=1e-6)
    np.testing.assert_allclose(found.innovation[:, 0], expected.code_innovation, rtol=0.0, atol=1e-6)


@pytest.mark.requirement("E5")
def test_the_filter_is_filterpys_in_the_gaussian_limit(case: tuple[Ride, SensorEpochs], expected: Kalman) -> None:
    ride, sensors = case
    found, _ = track(ride.epochs, ride.line, limits=NORMAL, sensors=sensors)
    assert_equal(found, expected)
    settled = np.abs(found.arc_m - ride.arc_m)[20:]
    assert settled.max() < 5.0
    assert np.abs(expected.mean[-1, GALILEO] - 6.0) < 5.0


@pytest.mark.requirement("E5")
def test_the_smoother_is_filterpys_in_the_gaussian_limit(case: tuple[Ride, SensorEpochs], expected: Kalman) -> None:
    ride, sensors = case
    trace: list = []
    found, _ = track(ride.epochs, ride.line, limits=NORMAL, sensors=sensors, trace=trace)
    assert_equal(found, expected)
    both, _ = smooth_steps(trace, TrackState(), None, NORMAL)
    np.testing.assert_allclose(both.arc_m, expected.smoothed_mean[:, S], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(both.speed_mps, expected.smoothed_mean[:, V], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(both.sigma_m, np.sqrt(expected.smoothed_covariance[:, S, S]), rtol=1e-6)
    assert (both.sigma_m[65:80] < 0.9 * found.sigma_m[65:80]).any()
