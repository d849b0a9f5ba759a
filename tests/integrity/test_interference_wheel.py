"""Distances by satellites against those of a wheel: what a slow pull shows, and what it does not."""

import numpy as np
import pytest

import sensed_ride
import signal_attacks
from railfix.integrity.interference import InterferenceLimits, WheelSigns, WheelState, wheel_signs
from railfix.simulate.scenario_file import load_recipe
from railfix.tracking import TrackStatus

pytestmark = pytest.mark.requirement("B8")
LIMITS = InterferenceLimits()
START = np.datetime64("2026-04-01T08:00:00", "ns")


def ride(
    seconds: int = 900,
    *,
    speed_mps: float = 20.0,
    scale: float = 1.004,
    pull_mps: float = 0.0,
    pulled_from: int = 600,
    sigma_m: float = 1.5,
    seed: int = 5,
) -> tuple[np.ndarray, ...]:
    """Times, positions, their sigmas and the wheel's distances at 1 Hz; the wheel is larger than thought by `scale`."""
    rng, s = np.random.default_rng(seed), np.arange(seconds, dtype=np.float64)
    truth = speed_mps * s
    arc = truth + pull_mps * np.maximum(s - pulled_from, 0.0) + rng.normal(0, sigma_m, seconds)
    wheel = np.diff(truth, prepend=truth[0] - speed_mps) / scale
    return START + (s * 1e9).astype("timedelta64[ns]"), arc, np.full(seconds, sigma_m), wheel


def signs(case: tuple[np.ndarray, ...], cuts: tuple[int, ...] = (), *, signed: bool = True) -> WheelSigns:
    state, parts = WheelState(), []
    for rows in np.split(np.arange(len(case[0])), cuts):
        part, state = wheel_signs(*(values[rows] for values in case), state, LIMITS, signed=signed)
        parts.append(part)
    return WheelSigns(
        **{name: np.concatenate([getattr(p, name) for p in parts]) for name in ("difference_m", "bound_m", "parted")}
    )


@pytest.mark.parametrize("speed", [0.0, 5.0, 20.0, 60.0])
def test_a_wheel_whose_diameter_is_half_a_percent_off_is_no_sign(speed: float) -> None:
    for seed in range(20):
        assert not signs(ride(speed_mps=speed, scale=1.005, seed=seed)).parted.any()


@pytest.mark.parametrize(("pull", "latest"), [(0.5, 75), (-0.5, 75), (1.0, 50)])
def test_a_pull_is_seen_within_about_a_minute(pull: float, latest: int) -> None:
    found = signs(ride(pull_mps=pull))
    first = int(np.argmax(found.parted))
    assert found.parted.any()
    assert 600 < first <= 600 + latest
    assert not found.parted[:600].any()
    assert found.difference_m[719] == pytest.approx(pull * 119, abs=6.0)


def test_a_pull_from_the_beginning_is_taken_for_the_wheels_diameter() -> None:
    assert not signs(ride(pull_mps=0.1, pulled_from=0)).parted.any()


def test_a_wheel_without_a_sign_is_compared_by_its_distance() -> None:
    time, arc, sigma, wheel = ride(pull_mps=0.5)
    found = signs((time, -arc, sigma, wheel), signed=False)
    assert found.parted.any()
    assert not found.parted[:600].any()


@pytest.mark.parametrize("pull", [0.2, 0.5, -2.0])
def test_the_bound_holds_from_the_beginning_of_a_pull_to_its_alarm(pull: float) -> None:
    for seed in range(10):
        found, s = signs(ride(pull_mps=pull, sigma_m=0.5, seed=seed)), np.arange(900)
        error = np.abs(pull) * np.maximum(s - 600, 0)
        unseen = (s < 600 + 119) & ~found.parted
        assert (error <= found.bound_m)[unseen].all()
        assert np.median(found.bound_m[300:600]) < 8.0


def test_the_level_of_the_filter_covers_a_pull_where_asked_for() -> None:
    """On the demonstration's line, 0.5 m/s from the 70th second on, which Dopplers and phases agree with."""
    wheel = {"tachometer": {"diameter_error_m": 0.002, "jitter_s": 2e-6}, "inertial": None, "radar": None}
    ride = sensed_ride.made(load_recipe("demo").scenario().replaced(rate_hz=1.0, sensors=wheel))
    place = ride.simulation.truth("front", ride.time_s)[0].ecef_m
    scene = signal_attacks.Scene.of(ride.observations, ride.simulation.navigation, place)
    attacked = signal_attacks.pulled(scene, 70, 0.5, rng=np.random.default_rng(7))
    over = {}
    for use in ("on", "off"):
        found = ride.run(
            observations=attacked, interference={"wheel_level": use}, cuts=() if use == "off" else (50, 90)
        )
        bounded = np.isfinite(found.tracked.level_m)
        assert bounded[:140].mean() > 0.9
        over[use] = int((np.abs(ride.error_m(found)) > found.tracked.level_m)[bounded].sum())
        if use == "off":  # in one piece: once the pull is seen nothing bounds the place
            seen = found.wheel.parted
            assert seen[149:].all()
            assert (found.tracked.status[seen] == TrackStatus.SPOOFING_SUSPECTED).sum() > 20
            assert not np.isfinite(found.tracked.level_m[seen]).any()
    assert over["on"] == 0
    assert over["off"] > 20


def test_chunks_change_nothing() -> None:
    case = ride(pull_mps=0.5)
    whole, cut = signs(case), signs(case, (1, 2, 300, 601, 640, 641))
    np.testing.assert_allclose(cut.difference_m, whole.difference_m, atol=1e-9)
    np.testing.assert_allclose(cut.bound_m, whole.bound_m, atol=1e-9)
    np.testing.assert_array_equal(cut.parted, whole.parted)


def test_after_a_slip_nothing_is_compared_for_a_minute() -> None:
    """30 m of slide within three seconds are no pull."""
    time, arc, sigma, wheel = ride()
    wheel = wheel.copy()
    wheel[500:503] -= 10.0
    found = signs((time, arc, sigma, wheel))
    assert not found.parted.any()
    assert np.isnan(found.difference_m[505:560]).all()
    assert np.isfinite(found.difference_m[580:]).all()


def test_a_stop_whose_wheel_gives_no_distance_is_bridged_with_a_doubt() -> None:
    time, arc, sigma, wheel = ride(speed_mps=20.0)
    v = np.clip(20.0 - 0.8 * (np.arange(900) - 400), 0.0, 20.0)
    v = np.where(np.arange(900) >= 460, np.minimum(0.8 * (np.arange(900) - 460), 20.0), v)
    noise = arc - 20.0 * np.arange(900)
    wheel = np.where(v < 0.3, np.nan, v / 1.004)
    found = signs((time, np.cumsum(v) + noise, sigma, wheel))
    assert not found.parted.any()
    assert np.isfinite(found.difference_m[[410, 440, 455, 500, 560]]).all()


def test_poor_positions_are_not_compared() -> None:
    time, arc, _, wheel = ride(pull_mps=0.5)
    found = signs((time, arc, np.full(900, 31.0), wheel))
    assert np.isnan(found.difference_m).all()
    assert not signs((time, arc, np.full(900, 15.0), wheel)).parted.any()
