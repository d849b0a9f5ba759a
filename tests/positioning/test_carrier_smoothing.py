"""Hatch smoothing against the recursion written out, and its properties."""

from __future__ import annotations

import numpy as np
import pytest

import carrier_cases
from railfix.core.errors import SettingsError
from railfix.gnss.observations import Observations
from railfix.positioning.carrier import SmoothingLimits, SmoothingState, find_slips, smooth_codes
from railfix.positioning.carrier.code_smoothing import linear_recursion


def smoothed(obs: Observations, slip: np.ndarray | None = None, **limits: object) -> np.ndarray:
    slips, _ = find_slips(obs)
    begins = slips.slip if slip is None else slip
    return smooth_codes(
        obs.time, obs.satellite, obs.signal, obs.code_m, slips.phase_m, begins, limits=SmoothingLimits(**limits)
    )[0]


def written_out(code: np.ndarray, phase: np.ndarray, slip: np.ndarray, dt: float, window: float) -> np.ndarray:
    """Hatch's filter as the textbooks write it, one channel, epoch by epoch."""
    result, before, count = np.empty(len(code)), 0.0, 0
    for k in range(len(code)):
        if slip[k]:
            count, before = 1, code[k]
        else:
            count += 1
            gain = max(1.0 / count, dt / window)
            before = gain * code[k] + (1.0 - gain) * (before + phase[k] - phase[k - 1])
        result[k] = before
    return result


def test_linear_recursion_is_the_loop():
    rng = np.random.default_rng(1)
    gain, drive = rng.uniform(0, 1, (37, 3)), rng.normal(size=(37, 3))
    x, expected = np.zeros(3), []
    for g, d in zip(gain, drive, strict=True):
        x = g * x + d
        expected.append(x)
    assert linear_recursion(gain, drive) == pytest.approx(np.array(expected), abs=1e-12)


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("window_s", [10.0, 100.0])
@pytest.mark.parametrize("epochs", [1, 2, 400])
def test_equals_the_recursion_written_out(window_s, epochs):
    obs = carrier_cases.log(epochs)
    slip = np.zeros(obs.code_m.shape, dtype=bool)
    slip[0] = True
    slip[epochs // 2, 2] = True
    got = smoothed(obs, slip, window_s=window_s, clocks="shared")
    phase = find_slips(obs)[0].phase_m
    for m in range(obs.code_m.shape[1]):
        expected = written_out(obs.code_m[:, m], phase[:, m], slip[:, m], 1.0, window_s)
        assert got[:, m] == pytest.approx(expected, abs=1e-6)
    assert np.array_equal(got[slip], obs.code_m[slip])


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("clocks", ["own", "shared"])
def test_noise_falls_by_the_number_of_codes_averaged(clocks):
    obs = carrier_cases.log(300, channels=40)
    clean = carrier_cases.log(300, channels=40, code_sigma_m=0.0)
    truth = find_slips(clean)[0].phase_m
    got = smoothed(obs, window_s=50.0, clocks=clocks)
    apart = got - truth
    constant = (clean.code_m - truth).mean(axis=0)
    error = apart - constant
    error -= error.mean(axis=1, keepdims=True)  # what is common is a clock
    for k, factor in ((1, 2**-0.5), (10, 11**-0.5), (49, 50**-0.5), (200, (2 * 50 - 1) ** -0.5)):
        assert np.std(error[k]) / 0.5 == pytest.approx(factor, rel=0.3)


@pytest.mark.requirement("A5")
def test_codes_that_jump_together_are_smoothed_all_the_same():
    """As telephones do: 30 m of noise common to all codes of an epoch, absent from the phases."""
    obs = carrier_cases.log(200, channels=20)
    common = np.random.default_rng(8).normal(0.0, 30.0, (200, 1))
    jumping = carrier_cases.changed(obs, code_m=obs.code_m + common)

    def spread(result: np.ndarray) -> float:
        apart = result - obs.phase_cycles * carrier_cases.WAVELENGTH_M
        late = (apart - apart.mean(axis=1, keepdims=True))[100:]
        return float(np.std(late - late.mean(axis=0)))

    slips = find_slips(obs)[0].slip
    slips[150, :10] = True  # arcs of different ages: otherwise what is common stays common
    calm = spread(smoothed(obs, slips, window_s=50.0))
    assert spread(smoothed(jumping, slips, window_s=50.0)) == pytest.approx(calm, rel=0.2)
    assert spread(smoothed(jumping, slips, window_s=50.0, clocks="shared")) > 5.0 * calm


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("cut", [1, 7, 100])
@pytest.mark.parametrize("clocks", ["own", "shared"])
def test_chunks_give_the_same(cut, clocks):
    obs = carrier_cases.log(400)
    code, phase = obs.code_m.copy(), obs.phase_cycles.copy()
    code[50:60, 1], phase[100:103, 2], phase[200:, 3] = np.nan, np.nan, phase[200:, 3] + 50
    code[300, :] = np.nan
    obs = carrier_cases.changed(obs, code_m=code, phase_cycles=phase)
    slips, _ = find_slips(obs)
    limits = SmoothingLimits(window_s=60.0, clocks=clocks)
    names = obs.satellite, obs.signal
    whole, _ = smooth_codes(obs.time, *names, code, slips.phase_m, slips.slip, limits=limits)
    state: SmoothingState | None = None
    parts = []
    for first in range(0, 400, cut):
        rows = slice(first, first + cut)
        part, state = smooth_codes(
            obs.time[rows], *names, code[rows], slips.phase_m[rows], slips.slip[rows], state, limits=limits
        )
        parts.append(part)
    joined = np.concatenate(parts)
    assert np.array_equal(np.isnan(joined), np.isnan(whole))
    assert np.nanmax(np.abs(joined - whole)) < 1e-7  # codes of 2.5e7 m step by 4e-9 m
    assert np.nanmax(np.abs((joined - code) - (whole - code))) < 2e-8


@pytest.mark.requirement("A5")
def test_what_absent_observations_do():
    obs = carrier_cases.log(40)
    code, phase = obs.code_m.copy(), obs.phase_cycles.copy()
    code[20:23, 0], phase[20:23, 1], code[:5, 2] = np.nan, np.nan, np.nan
    obs = carrier_cases.changed(obs, code_m=code, phase_cycles=phase)
    got = smoothed(obs)
    assert np.isfinite(got[20:23, 0]).all()  # the arc runs on in the phase
    assert np.array_equal(got[20:24, 1], code[20:24, 1])  # raw where no phase is, and where the arc begins
    assert np.isnan(got[:5, 2]).all()
    assert got[5, 2] == code[5, 2]  # the first code of an arc that began without one


@pytest.mark.requirement("A5")
def test_a_millisecond_in_the_codes_alone_passes_through():
    obs = carrier_cases.log(100)
    code, time = obs.code_m.copy(), obs.time.copy()
    code[50:] += 299_792.458
    time[50:] += np.timedelta64(1, "ms")
    got = smoothed(carrier_cases.changed(obs, code_m=code, time=time), clocks="shared")
    calm = smoothed(obs, clocks="shared")
    assert got[50:] - calm[50:] == pytest.approx(np.full((50, 8), 299_792.458), abs=1e-4)


def test_a_day_keeps_its_digits():
    """Ranges that run over 1e8 m, phases 1e9 cycles: the offset is still right to a micrometre."""
    epochs = 86_400 // 30
    t = np.arange(epochs)[:, None] * 30.0
    phase = np.repeat(2.0e7 + 4.0e3 * t, 2, axis=1)
    code = phase + 1.25e8
    time = carrier_cases.times(epochs, 30.0)
    slip = np.zeros(phase.shape, dtype=bool)
    slip[0] = True
    got, _ = smooth_codes(time, np.array(["G01", "G02"]), np.array(["1C", "1C"]), code, phase, slip)
    assert np.abs(got - code).max() < 2e-7


@pytest.mark.parametrize("wrong", [{"window_s": 0.0}, {"window_s": float("nan")}, {"clocks": "none"}])
def test_limits_are_checked(wrong):
    with pytest.raises(SettingsError, match=next(iter(wrong))):
        SmoothingLimits(**wrong)
