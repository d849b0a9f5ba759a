"""Phase jumps against the line: slips that Dopplers cannot see, false alarms, chunks."""

from __future__ import annotations

import numpy as np
import pytest

import carrier_cases
import synthetic
from railfix.core.errors import SettingsError
from railfix.positioning.carrier import ContinuityLimits, ContinuityState, TrackedPhases, track_jumps
from railfix.positioning.carrier.continuity import TrackJumps

LINE = synthetic.line()
EPOCHS, SYSTEMS = 40, "GGGGJEEE"
NAMES = np.array([f"{s}{i + 1:02d}" for i, s in enumerate(SYSTEMS)])
SIGNAL = np.full(len(SYSTEMS), "1C")


def drive(
    seed: int = 2, *, noise: float = 0.5, start_sigma_m: float = 3.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time, place, place as codes see it, phases and satellites of a drive at 1 Hz along curves of 400 m radius."""
    arc = 100.0 + 15.0 * np.arange(EPOCHS) + 3.0 * np.sin(np.arange(EPOCHS) / 4.0)
    ranges, phases = carrier_cases.observed(LINE, arc, systems=SYSTEMS, noise=noise, seed=seed)
    near = arc + np.random.default_rng(seed).normal(0.0, start_sigma_m, EPOCHS)
    return carrier_cases.times(EPOCHS), arc, near, phases.phase_m, ranges.sat_ecef_m


def judged(time, near, phase, sats, state=None, slip=None, **limits) -> tuple[TrackJumps, ContinuityState]:
    none = np.zeros(phase.shape, dtype=bool) if slip is None else slip
    phases = TrackedPhases(phase, sats, none)
    return track_jumps(time, NAMES, SIGNAL, phases, LINE, near, state, limits=ContinuityLimits(**limits))


@pytest.mark.requirement("A5")
def test_a_clean_drive_has_none_and_tells_the_way():
    for seed in range(5):
        time, arc, near, phase, sats = drive(seed)
        found, _ = judged(time, near, phase, sats)
        assert not found.jump.any()
        assert found.judged[1:].all()
        assert not found.judged[0].any()
        assert np.abs(found.moved_m[1:] - np.diff(arc)).max() < 0.15


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("cycles", [1, 2, 10, 1000])
@pytest.mark.parametrize("channels", [[3], [0, 6], [1, 4, 5]])
def test_slips_are_found_without_dopplers(cycles, channels):
    time, _, near, phase, sats = drive()
    slipped = phase.copy()
    for k, m in enumerate(channels):
        slipped[20:, m] += cycles * (1 + k) * carrier_cases.WAVELENGTH_M
    found, _ = judged(time, near, slipped, sats)
    expected = np.zeros(phase.shape, dtype=bool)
    expected[20, channels] = True
    assert np.array_equal(found.jump, expected)


@pytest.mark.requirement("A5")
def test_a_clock_step_is_no_jump():
    time, _, near, phase, sats = drive()
    stepped = phase.copy()
    stepped[20:] += 299_792.458
    assert not judged(time, near, stepped, sats)[0].jump.any()


@pytest.mark.requirement("A5")
def test_what_cannot_be_judged_is_left():
    """No place, a slip already known, a gap; and with two satellites nothing checks the other."""
    time, _, near, phase, sats = drive()
    slip = np.zeros(phase.shape, dtype=bool)
    slip[10, 2] = True
    near, time = near.copy(), time.copy()
    near[15] = np.nan
    time[30:] += np.timedelta64(60, "s")
    found, _ = judged(time, near, phase, sats, slip=slip)
    assert not found.judged[10, 2]
    assert not found.judged[[15, 16, 30]].any()
    assert np.isnan(found.moved_m[[0, 15, 16, 30]]).all()
    assert np.isnan(found.metric_m[~found.judged]).all()
    two = phase.copy()
    two[:, 2:] = np.nan
    two[20:, 0] += 1.0
    assert not judged(time, near, two, sats)[0].jump.any()


@pytest.mark.requirement("A5")
def test_more_slips_than_may_be_taken_out_keep_none():
    time, _, near, phase, sats = drive()
    slipped = phase.copy()
    slipped[20:] += np.arange(8) ** 2 * 3.0
    found, _ = judged(time, near, slipped, sats, max_rejected=2)
    assert found.jump[20].all()
    assert not np.delete(found.jump, 20, axis=0).any()
    assert np.isnan(found.moved_m[20])


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("cut", [1, 7])
def test_chunks_give_the_same_bits(cut):
    time, _, near, phase, sats = drive()
    slipped = phase.copy()
    slipped[14:, 3] += 0.4
    whole, _ = judged(time, near, slipped, sats)
    state, parts = None, []
    for first in range(0, EPOCHS, cut):
        rows = slice(first, first + cut)
        part, state = judged(time[rows], near[rows], slipped[rows], sats[rows], state)
        parts.append(part)
    for name in ("jump", "judged"):
        assert np.array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name))
    for name in ("metric_m", "moved_m", "moved_sigma_m"):
        joined = np.concatenate([getattr(p, name) for p in parts])
        assert joined == pytest.approx(getattr(whole, name), abs=1e-9, nan_ok=True)


@pytest.mark.parametrize("name", ["phase_m", "drift_mps", "aside_m", "across_share", "up_share", "sigmas", "max_gap_s"])
def test_limits_must_be_positive(name):
    with pytest.raises(SettingsError, match=name):
        ContinuityLimits(**{name: 0.0})
