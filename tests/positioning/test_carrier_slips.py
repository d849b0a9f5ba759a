"""Cycle slips: truth tables, clock steps, chunks, injected slips on made and recorded logs."""

from __future__ import annotations

import numpy as np
import pytest

import carrier_cases
from railfix.core.errors import SettingsError
from railfix.gnss.observations import Observations
from railfix.positioning.carrier import CycleSlipLimits, SlipReason, find_slips, number_arcs
from railfix.positioning.carrier.continuity import NO_ARC, decode_channel

MILLISECOND_M = 299_792.458


def with_cycles(obs: Observations, epoch: int, channel: int, cycles: float) -> Observations:
    phase = obs.phase_cycles.copy()
    phase[epoch:, channel] += cycles
    return carrier_cases.changed(obs, phase_cycles=phase)


def flagged(obs: Observations, **limits: float) -> np.ndarray:
    """Slips after the first epoch."""
    return find_slips(obs, limits=CycleSlipLimits(**limits))[0].slip[1:]


@pytest.mark.requirement("A5")
def test_first_epoch_begins_all_arcs_and_a_clean_log_no_other():
    slips, _ = find_slips(carrier_cases.log())
    assert slips.slip[0].all()
    assert (slips.reason[0] == SlipReason.FIRST).all()
    assert not slips.slip[1:].any()
    assert np.isfinite(slips.doppler_metric_m[1:]).all()
    assert np.isnan(slips.doppler_metric_m[0]).all()


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("cycles", [1, -1, 2, 10, 1000])
@pytest.mark.parametrize("interval_s", [0.1, 1.0])
def test_a_slip_is_found_where_it_is_and_nowhere_else(cycles, interval_s):
    obs = with_cycles(carrier_cases.log(interval_s=interval_s), 20, 3, cycles)
    slips, _ = find_slips(obs)
    expected = np.zeros(obs.code_m.shape, dtype=bool)
    expected[0], expected[20, 3] = True, True
    assert np.array_equal(slips.slip, expected)
    assert slips.reason[20, 3] == SlipReason.DOPPLER
    assert abs(slips.doppler_metric_m[20, 3]) == pytest.approx(abs(cycles) * carrier_cases.WAVELENGTH_M, abs=0.1)


@pytest.mark.requirement("A5")
def test_without_dopplers_only_what_the_code_can_see():
    """The limit of 10 m is 52 cycles; smaller slips are `track_jumps`' to find."""
    log = carrier_cases.log(doppler=False)
    found = {n: bool(flagged(with_cycles(log, 20, 3, n))[19, 3]) for n in (1, 10, 45, 60, 1000)}
    assert found == {1: False, 10: False, 45: False, 60: True, 1000: True}
    assert (find_slips(with_cycles(log, 20, 3, 1000))[0].reason[20, 3]) == SlipReason.CODE


@pytest.mark.requirement("A5")
def test_exactly_at_the_limit_is_no_slip():
    obs = with_cycles(carrier_cases.log(), 20, 3, 1)
    metric = abs(find_slips(obs)[0].doppler_metric_m[20, 3])
    wide = {"doppler_mps": 1e-12, "jerk_mps3": 1e-300}
    at = find_slips(obs, limits=CycleSlipLimits(doppler_m=metric, **wide))[0].doppler_limit_m[20]
    assert flagged(obs, doppler_m=metric + (metric - at) + 1e-9, **wide)[19, 3] == np.False_
    assert flagged(obs, doppler_m=metric - 1e-9, **wide)[19, 3] == np.True_


@pytest.mark.requirement("A5")
def test_what_the_receiver_and_the_log_say():
    log = carrier_cases.log()
    lock, phase, breaks = log.loss_of_lock.copy(), log.phase_cycles.copy(), log.break_before.copy()
    lock[10, 0], lock[20:23, 1], lock[30, 2], lock[35, 3] = 1, 2, 3, 4
    phase[40:43, 4], breaks[50] = np.nan, True
    slips, _ = find_slips(carrier_cases.changed(log, loss_of_lock=lock, phase_cycles=phase, break_before=breaks))
    rows = {
        (10, 0): SlipReason.LOSS_OF_LOCK,
        (11, 0): SlipReason.JOINED,
        (20, 1): SlipReason.HALF_CYCLE,
        (21, 1): SlipReason.JOINED,
        (23, 1): SlipReason.HALF_CYCLE,
        (30, 2): SlipReason.LOSS_OF_LOCK | SlipReason.HALF_CYCLE,
        (31, 2): SlipReason.HALF_CYCLE,
        (35, 3): SlipReason.JOINED,  # bit 2 is anti-spoofing
        (40, 4): SlipReason.NO_PHASE,
        (43, 4): SlipReason.FIRST,
        (50, 5): SlipReason.BREAK,
    }
    assert {key: SlipReason(int(slips.reason[key])) for key in rows} == rows
    assert not slips.slip[40:43, 4].any()
    assert slips.half_cycle[21, 1]
    assert np.isnan(slips.phase_m[40, 4])


@pytest.mark.requirement("A5")
@pytest.mark.parametrize(("gap_s", "reason"), [(30.0, SlipReason.JOINED), (32.0, SlipReason.GAP)])
def test_a_gap_longer_than_the_limit_ends_all_arcs(gap_s, reason):
    log = carrier_cases.log()
    kept = np.r_[0:10, 10 + round(gap_s) : 60]
    part = Observations(
        time=log.time[kept], satellite=log.satellite, signal=log.signal, code_m=log.code_m[kept],
        phase_cycles=log.phase_cycles[kept], doppler_hz=log.doppler_hz[kept], cn0_dbhz=log.cn0_dbhz[kept],
        loss_of_lock=log.loss_of_lock[kept], break_before=log.break_before[kept],
    )  # fmt: skip
    assert (find_slips(part)[0].reason[10] == reason).all()


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("phases_step", [True, False])
@pytest.mark.parametrize("tags_step", [True, False])
@pytest.mark.parametrize("milliseconds", [1, -3])
def test_clock_steps_are_no_slips(phases_step, tags_step, milliseconds):
    """Codes follow the tags; phases step with the codes or run on; tags stay regular or step too."""
    log = carrier_cases.log()
    step_s, rows = milliseconds * 1e-3, np.arange(len(log)) >= 30
    code, phase, time = log.code_m.copy(), log.phase_cycles.copy(), log.time.copy()
    code[rows] += milliseconds * MILLISECOND_M
    if phases_step:
        phase[rows] += milliseconds * MILLISECOND_M / carrier_cases.WAVELENGTH_M
    if tags_step:
        time[rows] += np.timedelta64(round(step_s * 1e9), "ns")
    else:  # Measured earlier by the step than the regular tags say: ranges are of then.
        early = step_s * -log.doppler_hz[rows] * carrier_cases.WAVELENGTH_M
        code[rows] -= early
        phase[rows] -= early / carrier_cases.WAVELENGTH_M
    obs = carrier_cases.changed(log, code_m=code, phase_cycles=phase, time=time)
    slips, state = find_slips(obs)
    assert not slips.slip[1:].any()
    assert slips.clock_step_m[30] == pytest.approx(milliseconds * MILLISECOND_M, abs=70.0)
    assert not np.any(np.delete(slips.clock_step_m, 30))
    assert state.step_ms == (0 if phases_step else milliseconds)
    # The phases are on the codes' clock: code less phase is as constant as without the step.
    apart = code - slips.phase_m
    assert np.abs(apart - apart.mean(axis=0)).max() < 3.0
    # And a slip beside the step is still seen.
    assert find_slips(with_cycles(obs, 30, 2, 2))[0].slip[30].nonzero()[0].tolist() == [2]


@pytest.mark.requirement("A5")
def test_two_channels_cannot_tell_a_clock_step_from_slips():
    log = carrier_cases.log(channels=2)
    code = log.code_m.copy()
    code[30:] += MILLISECOND_M
    assert find_slips(carrier_cases.changed(log, code_m=code))[0].slip[1:].sum() == 0  # Dopplers and phases agree
    bare = carrier_cases.changed(log, code_m=code, doppler_hz=np.full(code.shape, np.nan))
    assert find_slips(bare)[0].slip[30].all()


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("cut", [1, 7, 25])
def test_chunks_give_the_same_bits(cut):
    obs = with_cycles(carrier_cases.log(), 20, 3, 5)
    lock, code = obs.loss_of_lock.copy(), obs.code_m.copy()
    lock[25:28, 1] = 2
    code[40:] += MILLISECOND_M
    obs = carrier_cases.changed(obs, loss_of_lock=lock, code_m=code)
    whole, _ = find_slips(obs)
    state, arcs, parts, numbered = None, None, [], []
    for first in range(0, len(obs), cut):
        part, state = find_slips(obs[first : first + cut], state)
        ids, arcs = number_arcs(part.slip, np.isfinite(part.phase_m), obs.satellite, obs.signal, arcs)
        parts.append(part)
        numbered.append(ids)
    for name in ("slip", "reason", "phase_m", "doppler_metric_m", "code_metric_m", "clock_step_m", "half_cycle"):
        joined = np.concatenate([getattr(p, name) for p in parts])
        assert np.array_equal(joined, getattr(whole, name), equal_nan=joined.dtype.kind == "f"), name
    expected, _ = number_arcs(whole.slip, np.isfinite(whole.phase_m), obs.satellite, obs.signal)
    assert np.array_equal(np.concatenate(numbered), expected)


def test_channels_may_change_between_chunks():
    """A new channel begins; the others are joined whatever their order."""
    obs = carrier_cases.log(channels=5)
    order = [4, 2, 0, 1]
    first = Observations(
        time=obs.time[:30], satellite=obs.satellite[order], signal=obs.signal[order],
        code_m=obs.code_m[:30][:, order], phase_cycles=obs.phase_cycles[:30][:, order],
        doppler_hz=obs.doppler_hz[:30][:, order], cn0_dbhz=obs.cn0_dbhz[:30][:, order],
        loss_of_lock=obs.loss_of_lock[:30][:, order], break_before=obs.break_before[:30],
    )  # fmt: skip
    _, state = find_slips(first)
    slips, _ = find_slips(obs[30:], state)
    assert np.flatnonzero(slips.slip[0]).tolist() == [3]


def test_a_carrier_of_unknown_frequency_has_no_phase():
    obs = carrier_cases.log(5, channels=4)
    frequency = np.full(4, 1_575.42e6)
    frequency[1] = np.nan
    slips, _ = find_slips(obs, frequency_hz=frequency)
    assert (slips.reason[:, 1] == SlipReason.NO_PHASE).all()
    assert np.isfinite(slips.phase_m[:, [0, 2, 3]]).all()


def test_arcs_have_names_of_their_own():
    slip = np.zeros((4, 2), dtype=bool)
    slip[0], slip[2, 0] = True, True
    has = np.ones((4, 2), dtype=bool)
    has[3, 1] = False
    ids, _ = number_arcs(slip, has, np.array(["G05", "R12"]), np.array(["1C", "1C"]))
    assert ids[0, 0] == ids[1, 0] != ids[2, 0] == ids[3, 0]
    assert ids[3, 1] == NO_ARC
    assert len({*decode_channel(ids[:3]).ravel().tolist()}) == 2
    assert (ids[:3] > 0).all()


@pytest.mark.parametrize("name", ["max_gap_s", "doppler_m", "doppler_mps", "jerk_mps3", "code_m"])
def test_limits_must_be_positive(name):
    with pytest.raises(SettingsError, match=name):
        CycleSlipLimits(**{name: 0.0})
