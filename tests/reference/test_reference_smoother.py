"""The smoother of a reference against dense least squares, and what it must be where nothing is measured."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from railfix.core.timescale import timedelta
from railfix.motion.singer import singer_steps
from railfix.reference.build import Speeds, _ReferenceBuilder
from railfix.reference.fixes import ACCELERATION_BIAS_MPS2, MOTION_MPS2, MOTION_S, ReferenceSettings
from railfix.reference.smoother import Evidence, SmoothedReference, closings, smooth

pytestmark = pytest.mark.requirement("D1")
SETTINGS = ReferenceSettings()


def made(count: int, dt: float, *, gap_s: tuple[float, float] = (4.0, 7.0), **changes: Any) -> Evidence:
    """A ride with all sensors, whose fixes are missing for a while."""
    rng, t = np.random.default_rng(5), np.arange(count) * dt
    speed = 15.0 + 10.0 * np.sin(t / 40.0)
    place = 5000.0 + np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt)])
    missing = (t > gap_s[0]) & (t < gap_s[1])
    doppler = speed + 0.03 + rng.normal(size=count) * 0.05
    doppler[rng.random(count) < 0.2] = np.nan
    wheel = 1.002 * place + rng.normal(size=count) * 0.01
    wheel[:3] = np.nan
    acceleration = np.diff(speed) / dt + 0.02 + rng.normal(size=count - 1) * 0.05
    acceleration[rng.random(count - 1) < 0.1] = np.nan
    values: dict[str, Any] = {
        "time": np.datetime64("2026-05-12", "ns") + (t * 1e9).astype("timedelta64[ns]"),
        "fix_m": np.where(missing, np.nan, place + rng.normal(size=count) * 0.02),
        "fix_sigma_m": np.where(missing, np.nan, 0.02),
        "doppler_mps": doppler,
        "doppler_sigma_mps": np.full(count, 0.5),  # so large that none weighs less
        "wheel_m": wheel,
        "wheel_sigma_m": 0.02,
        "acceleration_mps2": acceleration,
    }
    return Evidence(**{**values, **changes})


def dense(evidence: Evidence, *, place_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions and their standard deviations by one least squares of all instants together, equation by equation."""
    count, dt = len(evidence.time), np.diff(evidence.time) / np.timedelta64(1, "s")
    s, v, a, doppler, difference, scale, offset = range(7)
    rows: list[tuple[list[tuple[int, int, float]], float, float]] = []

    def add(terms: list[tuple[int, int, float]], value: float, sigma: float) -> None:
        if np.isfinite(value):
            rows.append((terms, value, sigma))

    first = {v: 100.0, a: MOTION_MPS2, doppler: SETTINGS.doppler_bias_mps, scale: SETTINGS.wheel_scale}
    first |= {difference: 1e4, offset: ACCELERATION_BIAS_MPS2, s: 1e4}
    for unknown, sigma in first.items():
        add([(0, unknown, 1.0)], 0.0, sigma)
    step, noise = singer_steps(dt, MOTION_MPS2, MOTION_S)
    wheel = evidence.wheel_m - evidence.wheel_m[np.isfinite(evidence.wheel_m)][0]
    for k in range(count):
        add([(k, s, 1.0)], evidence.fix_m[k] - place_m, evidence.fix_sigma_m[k])
        add([(k, v, 1.0), (k, doppler, 1.0)], evidence.doppler_mps[k], evidence.doppler_sigma_mps[k])
        add([(k, s, 1.0), (k, difference, 1.0)], wheel[k], evidence.wheel_sigma_m)
        if k == 0:
            continue
        own = noise[k - 1] + np.diag([1e-8, 1e-8, 0.0])
        root = np.linalg.inv(np.linalg.cholesky(own))
        for i in range(3):  # whitened: each has the variance 1
            terms = [(k, j, root[i, j]) for j in range(3)]
            terms += [(k - 1, j, -float(root[i] @ step[k - 1][:, j])) for j in range(3)]
            add(terms, 0.0, 1.0)
        kept = np.exp(-dt[k - 1] / SETTINGS.doppler_bias_s)
        add([(k, doppler, 1.0), (k - 1, doppler, -kept)], 0.0, SETTINGS.doppler_bias_mps * np.sqrt(1.0 - kept**2))
        moved = wheel[k] - wheel[k - 1]
        terms = [(k, difference, 1.0), (k - 1, difference, -1.0)]
        if np.isfinite(moved):
            add([*terms, (k - 1, scale, -moved)], 0.0, float(np.sqrt(SETTINGS.slip_m**2 * abs(moved) + 1e-8)))
        else:
            add(terms, 0.0, 1e4)
        add([(k, scale, 1.0), (k - 1, scale, -1.0)], 0.0, 3e-6 * np.sqrt(dt[k - 1]))
        add([(k, offset, 1.0), (k - 1, offset, -1.0)], 0.0, 1e-3 * np.sqrt(dt[k - 1]))
        gained = evidence.acceleration_mps2[k - 1] * dt[k - 1]
        terms = [(k, v, 1.0), (k - 1, v, -1.0), (k, offset, dt[k - 1])]
        add(terms, gained, SETTINGS.acceleration_mps2 * np.sqrt(dt[k - 1]))
    design, value = np.zeros((len(rows), 7 * count)), np.zeros(len(rows))
    for i, (terms, right, sigma) in enumerate(rows):
        value[i] = right / sigma
        for k, unknown, coefficient in terms:
            design[i, 7 * k + unknown] += coefficient / sigma
    q, r = np.linalg.qr(design)
    inverse = np.linalg.inv(r)
    sigma = np.sqrt((inverse**2).sum(axis=1))
    return place_m + (inverse @ (q.T @ value))[0::7], sigma[0::7]


def test_all_sensors_together_are_one_least_squares() -> None:
    evidence = made(50, 0.2)
    smoothed = smooth(evidence, SETTINGS)
    place, sigma = dense(evidence, place_m=float(evidence.fix_m[0]))
    np.testing.assert_allclose(smoothed.arc_m, place, atol=1e-6)
    np.testing.assert_allclose(smoothed.sigma_m, sigma, rtol=1e-5)


def without(evidence: Evidence, *names: str) -> Evidence:
    values = vars(evidence) | {name: np.full_like(getattr(evidence, name), np.nan) for name in names}
    return Evidence(**values)


def alone() -> SmoothedReference:
    evidence = made(121, 0.2, gap_s=(4.0, 20.0))
    return smooth(without(evidence, "doppler_mps", "wheel_m", "acceleration_mps2"), SETTINGS)


def test_a_gap_without_a_sensor_is_least_known_in_its_middle() -> None:
    found = alone()
    inside = slice(21, 100)
    worst = 21 + int(found.sigma_m[inside].argmax())
    assert abs(worst - 60) <= 1
    np.testing.assert_allclose(found.sigma_m[inside], found.sigma_m[inside][::-1], rtol=0.02)
    assert np.isnan(found.wheel_scale).all()


def test_a_sensor_makes_a_gap_better_known_and_its_errors_are_estimated() -> None:
    evidence = made(300, 0.2, gap_s=(20.0, 40.0))
    both = smooth(without(evidence, "doppler_mps", "acceleration_mps2"), SETTINGS)
    none = smooth(without(evidence, "doppler_mps", "acceleration_mps2", "wheel_m"), SETTINGS)
    assert both.sigma_m.max() < 0.1 * none.sigma_m.max()
    assert both.wheel_scale[-1] == pytest.approx(0.002, abs=3e-4)


def test_an_outlier_of_the_doppler_speed_weighs_less() -> None:
    evidence = made(200, 0.2, doppler_sigma_mps=np.full(200, 0.05))
    wrong = evidence.doppler_mps.copy()
    k = int(np.flatnonzero(np.isfinite(wrong))[60])
    wrong[k] += 5.0
    evidence = without(evidence, "wheel_m", "acceleration_mps2")
    good, bad = smooth(evidence, SETTINGS), smooth(Evidence(**vars(evidence) | {"doppler_mps": wrong}), SETTINGS)
    assert abs(bad.speed_mps[k] - good.speed_mps[k]) < 0.05


@pytest.mark.slow
def test_an_hour_at_ten_hertz_takes_less_than_half_a_minute() -> None:
    evidence, begin = made(36_000, 0.1), time.process_time()
    smooth(evidence, SETTINGS)
    assert time.process_time() - begin < 30.0


def test_closing_errors_and_directions_count_in_sigmas_of_the_fixes_on_both_sides() -> None:
    """Speeds without an error; the closing error of the first gap, and two of three steps, are within the noise."""
    t, sigma, each = np.array([0.0, 10.0, 20.0, 30.0]), np.array([1.0, 0.1, 2.0, 0.5]), np.arange(31)
    start, arc = np.datetime64("2026-05-12", "ns"), np.array([0.0, 101.0, 211.0, 321.0])
    fixes = SimpleNamespace(good=np.arange(4), time=start + timedelta(t), arc_m=arc, sigma_m=sigma)
    builder: Any = object.__new__(_ReferenceBuilder)
    builder._join = lambda _: Speeds(time=start + timedelta(each), speed_mps=each * 0.0 + 10.0, sigma_mps=each * 0.0)
    found = builder._excess({}, None, None, fixes.time, fixes, ReferenceSettings(doppler_bias_mps=1e-6))
    np.testing.assert_allclose(found, [1.0, 10.0 / np.hypot(0.1, 2.0), 10.0 / np.hypot(2.0, 0.5)], rtol=1e-6)
    windows = closings(fixes.time, 10.0 * t, 0.3 * t, arc, sigma, window_s=10.0)
    np.testing.assert_allclose(windows.error_m, [-1.0, -10.0, -10.0])
    np.testing.assert_allclose(windows.white_m2, sigma[1:] ** 2 + sigma[:-1] ** 2 + 3.0)
    fixes.time, fixes.arc_m = start + timedelta(t / 10.0), np.cumsum([0.0, 4.01, 8.02, 8.1])
    none = Speeds(time=fixes.time[:0], speed_mps=arc[:0], sigma_mps=arc[:0])
    np.testing.assert_allclose(builder._hint(fixes.time, none, fixes), [np.nan, 8.02, np.nan, np.nan])
