"""Signs of interference: arrays against loops over epochs, least squares against numpy's, any cutting into chunks."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import fields

import numpy as np
import pytest

from helpers import synthetic
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.timescale import timedelta
from railfix.integrity.interference import (
    HeldState,
    InterferenceLimits,
    MotionSignState,
    PowerState,
    Sign,
    Suspicion,
    cause_text,
    hold_signs,
    motion_signs,
    power_signs,
    suspicion,
)
from railfix.integrity.interference.motion import MotionSigns
from railfix.integrity.interference.range_fits import MotionInputs
from railfix.integrity.interference.time_tags import _explains_more
from railfix.positioning.search_index import SearchIndex

LIMITS = InterferenceLimits()
START = np.datetime64("2024-03-05T03:10:00", "ns")
EDGES = (0, 1, 7, 20, 21, 40)


def times(count: int) -> np.ndarray:
    return START + timedelta(np.arange(count, dtype=float))


@pytest.mark.requirement("B8")
def test_falls_of_cn0_are_those_of_a_loop_over_satellites_whatever_the_chunks() -> None:
    rng = np.random.default_rng(3)
    cn0 = 44.0 + rng.standard_normal((40, 9)).round(2)
    cn0[rng.random(cn0.shape) < 0.1] = np.nan
    cn0[25:, :] -= 7.0
    gain = np.where(np.arange(40) < 25, 5000.0, 3000.0)
    channel, time = np.array([f"G{k:02d}1C" for k in range(9)]), times(40)
    expected = np.full((40, 2), np.nan)
    for k in range(40):
        falls = []
        for m in range(9):
            seen = [i for i in range(k + 1) if np.isfinite(cn0[i, m])]
            if np.isfinite(cn0[k, m]) and k - seen[0] >= LIMITS.known_after_s:
                peak = max(cn0[i, m] - (k - i) * LIMITS.peak_decay_db_per_min / 60.0 for i in seen)
                falls.append(peak - cn0[k, m])
        if len(falls) >= LIMITS.least_satellites:
            expected[k] = np.median(falls), np.std(falls)
    state, parts = PowerState(), []
    for a, b in itertools.pairwise(EDGES):
        signs, state = power_signs(time[a:b], channel, cn0[a:b], gain[a:b], state, LIMITS)
        parts.append(signs)
    whole, _ = power_signs(time, channel, cn0, gain, PowerState(), LIMITS)
    for item in fields(whole):
        cut = np.concatenate([getattr(part, item.name) for part in parts])
        np.testing.assert_array_equal(cut, getattr(whole, item.name), err_msg=item.name)
    np.testing.assert_allclose(np.stack([whole.fall_db, whole.spread_db], axis=1), expected, atol=1e-6)
    assert np.isfinite(expected[20:]).sum() > 30
    assert whole.gain_fall[30] == pytest.approx(0.4, abs=0.001)


@pytest.mark.requirement("B8")
def test_what_holds_and_what_stays_are_those_of_a_loop_whatever_the_chunks() -> None:
    rng = np.random.default_rng(5)
    step = rng.choice([0.2, 1.0, 30.0], 200)
    time = START + timedelta(np.cumsum(step))
    signs = rng.random((200, 2)) < 0.8
    hold, release = np.array([3.0, 0.0]), np.array([4.0, 10.0])
    expected = np.zeros((2, 200, 2), dtype=bool)
    for c in range(2):
        run, last = 0.0, -np.inf
        for k in range(200):
            passed = float((time[k] - time[max(k - 1, 0)]) / np.timedelta64(1, "s"))
            run = run + min(passed, hold[c] / 2.0) if signs[k, c] else 0.0
            now = float((time[k] - START) / np.timedelta64(1, "s"))
            if signs[k, c] and run >= hold[c] - 1e-9:
                expected[0, k, c], last = True, now
            expected[1, k, c] = now - last <= release[c]
    state, parts = HeldState(), []
    for a, b in zip([0, 1, 50, 51, 120], [1, 50, 51, 120, 200], strict=True):
        *found, state = hold_signs(time[a:b], signs[a:b], state, hold_s=hold, release_s=release)
        parts.append(found)
    for k in range(2):
        np.testing.assert_array_equal(np.concatenate([part[k] for part in parts]), expected[k])
    assert expected[0, :, 0].any()
    assert not expected[0, :, 0].all()


def scene(*, epochs: int = 40, jump: float = 0.0, clock: float = 0.0, parted: float = 0.0) -> MotionInputs:
    """Twelve satellites of two constellations seen by an antenna at 20 m/s; from epoch 25 on something jumps."""
    rng = np.random.default_rng(11)
    sight = rng.standard_normal((12, 3))
    sight[:, 0] = np.abs(sight[:, 0]) + 0.3
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    time, now = times(epochs), np.arange(epochs, dtype=float)
    later = now >= 25
    velocity = np.array([0.0, 20.0, 0.0])
    ecef = np.array([6.378e6, 0.0, 0.0]) + now[:, None] * velocity + later[:, None] * np.array([0.0, 0.0, jump])
    sat = ecef[:1, None, :] + 2.2e7 * sight + now[:, None, None] * np.array([0.0, 300.0, 2000.0])
    sat = np.broadcast_to(sat, (epochs, 12, 3))
    to_satellite = sat - ecef[:, None, :]
    distance = np.linalg.norm(to_satellite, axis=2)
    turn = 7.2921151467e-5 / SPEED_OF_LIGHT * (sat[..., 0] * ecef[:, None, 1] - sat[..., 1] * ecef[:, None, 0])
    group = np.arange(12) // 6
    corrected = distance + turn + 100.0 + group * 8.0 + 0.5 * rng.standard_normal(distance.shape)
    corrected += later[:, None] * (group == 1) * (sight[:, 1] * parted)
    unit = to_satellite / distance[..., None]
    rate = (unit * (np.array([0.0, 300.0, 2000.0]) - velocity)).sum(axis=2) + 3.0
    return MotionInputs(
        time=time, break_before=np.zeros(epochs, dtype=bool),
        channel=np.array([f"{'GE'[k // 6]}{k:02d}1C" for k in range(12)]), group=group, near_ecef_m=ecef + 5.0,
        sat_ecef_m=sat, sat_velocity_mps=np.broadcast_to(np.array([0.0, 300.0, 2000.0]), sat.shape),
        code_m=corrected + later[:, None] * clock, rate_mps=rate + 0.05 * rng.standard_normal(rate.shape),
        corrected_code_m=corrected, sigma_m=np.full(distance.shape, 0.5), used=np.ones(distance.shape, dtype=bool),
        named=np.zeros(distance.shape, dtype=bool), noise_scale=np.ones(epochs),
        clock_offset_m=np.broadcast_to(np.array([0.0, 8.0]), (epochs, 2)),
        clock_sigma_m=np.broadcast_to(np.array([0.0, 1.0]), (epochs, 2)), off_line_m=np.full(epochs, 1.0),
        doubted=np.zeros(epochs, dtype=bool), antenna=np.zeros(epochs, dtype=np.intp),
        lines=(SearchIndex(synthetic.line()),),
    )  # fmt: skip


@pytest.mark.requirement("B8")
@pytest.mark.parametrize(
    ("change", "name", "least"),
    [
        ({"jump": 80.0}, "position_jump_m", 60.0),
        ({"clock": 200.0}, "clock_jump_m", 190.0),
        ({"parted": 60.0}, "part_sigmas", 15.0),
    ],
)
def test_a_jump_shows_in_its_own_statistic_alone_at_its_epoch(
    change: dict[str, float], name: str, least: float
) -> None:
    quiet, _ = motion_signs(scene(), MotionSignState(), LIMITS)
    found, _ = motion_signs(scene(**change), MotionSignState(), LIMITS)
    assert np.nanmax(np.abs(getattr(quiet, name))) < 0.3 * least
    assert abs(getattr(found, name)[25]) > least
    assert not (np.abs(getattr(found, name)[:25]) > 0.3 * least).any()
    others = {"position_jump_sigmas", "speed_jump_sigmas", "drift_jump_sigmas"} - {name.replace("_m", "_sigmas")}
    for other in others:
        assert not (getattr(found, other) > LIMITS.jump_sigmas).any(), other


@pytest.mark.requirement("B8")
def test_a_clock_that_steps_by_milliseconds_does_not_count() -> None:
    found, _ = motion_signs(scene(clock=2e-3 * SPEED_OF_LIGHT), MotionSignState(), LIMITS)
    assert np.nanmax(np.abs(found.clock_jump_m)) < 5.0


def check_chunks(inputs: MotionInputs, edges: Iterable[int], whole: MotionSigns) -> None:
    """Signs of chunks that end at these epochs equal those of the whole."""
    state, parts = MotionSignState(), []
    for a, b in itertools.pairwise(edges):
        part = MotionInputs(*(v if n in ("channel", "group") else v[a:b] for n, v in inputs._asdict().items()))
        signs, state = motion_signs(part, state, LIMITS)
        parts.append(signs)
    for item in fields(whole):
        cut = np.concatenate([getattr(part, item.name) for part in parts])
        np.testing.assert_allclose(cut, getattr(whole, item.name), rtol=1e-9, atol=1e-6, err_msg=item.name)


@pytest.mark.requirement("B8")
def test_statistics_of_motion_are_the_same_whatever_the_chunks() -> None:
    inputs = scene(jump=80.0, clock=200.0, parted=60.0)
    whole, _ = motion_signs(inputs, MotionSignState(), LIMITS)
    check_chunks(inputs, EDGES, whole)


@pytest.mark.requirement("B8")
def test_an_epoch_without_a_position_is_compared_with_nothing_whatever_the_chunks() -> None:
    """Live epochs one by one, two of them with two satellites: those after are compared with the last good one."""
    inputs = scene(jump=80.0)
    used = inputs.used.copy()
    used[[24, 31], 2:] = False
    inputs = inputs._replace(used=used)
    whole, _ = motion_signs(inputs, MotionSignState(), LIMITS)
    assert np.isnan(whole.position_jump_m[[24, 31]]).all()
    assert whole.position_jump_m[25] > 60.0
    check_chunks(inputs, range(len(inputs.time) + 1), whole)


@pytest.mark.requirement("B8")
@pytest.mark.parametrize("edges", [(0, 40), (0, 25, 40), (0, 24, 26, 40)])
def test_nothing_is_compared_across_a_break(edges: tuple[int, ...]) -> None:
    breaks = np.arange(40) == 25
    inputs, state, found = scene(clock=200.0)._replace(break_before=breaks), MotionSignState(), []
    for a, b in itertools.pairwise(edges):
        part = (v if n in ("channel", "group") else v[a:b] for n, v in inputs._asdict().items())
        signs, state = motion_signs(MotionInputs(*part), state, LIMITS)
        found.append(signs.clock_jump_m)
    jump = np.concatenate(found)
    assert np.isnan(jump).tolist() == [k in (0, 25) for k in range(40)]
    assert np.nanmax(np.abs(jump)) < 5.0


@pytest.mark.requirement("B8")
@pytest.mark.parametrize("cut", [40, 95])
def test_a_satellite_that_was_away_for_long_is_compared_after_its_known_time(cut: int) -> None:
    """Eight satellites, seven of them away for 70 s and 5 dB weaker then: no fall until they are known again."""
    time, channel = times(130), np.array([f"G{k:02d}1C" for k in range(8)])
    cn0 = np.full((130, 8), 45.0)
    cn0[20:91, 1:], cn0[91:, :] = np.nan, 40.0
    state, parts = PowerState(), []
    for rows in (slice(0, cut), slice(cut, None)):
        signs, state = power_signs(time[rows], channel, cn0[rows], np.full(len(time[rows]), np.nan), state, LIMITS)
        parts.append(signs.fall_db)
    known = round(LIMITS.known_after_s)
    assert np.isfinite(np.concatenate(parts)).tolist() == [known <= k < 20 or k >= 91 + known for k in range(130)]


@pytest.mark.requirement("B8")
def test_the_clock_is_compared_channel_by_channel_when_their_order_changes() -> None:
    """The median of twelve, of which a chunk has ten in another order; two were not there at its last epoch."""
    inputs = scene(clock=200.0)
    code = inputs.code_m.copy()
    code[24, [2, 9]] = np.nan
    inputs = inputs._replace(code_m=code)
    order = np.array([9, 1, 7, 2, 4, 0, 11, 5, 3, 6])
    turned = MotionInputs(*(
        v if n == "lines" else v[order] if n in ("channel", "group") else v[25:, order] if np.shape(v)[1:2] == (12,)
        else v[25:]
        for n, v in inputs._asdict().items()
    ))  # fmt: skip
    _, state = motion_signs(inputs._replace(**{
        n: v[:25] for n, v in inputs._asdict().items() if n not in ("channel", "group")
    }), MotionSignState(), LIMITS)  # fmt: skip
    found, _ = motion_signs(turned, state, LIMITS)
    seconds = np.where(np.isin(order, [2, 9]), 2, 1)
    before = (inputs.code_m[25 - seconds, order], inputs.rate_mps[25 - seconds, order])
    change = inputs.code_m[25, order] - before[0] - (inputs.rate_mps[25, order] + before[1]) / 2.0 * seconds
    assert found.clock_jump_m[0] == pytest.approx(np.median(change), abs=1e-6)
    assert abs(found.clock_jump_m[0]) > 190.0


@pytest.mark.requirement("B8")
def test_parted_constellations_are_those_of_two_fits_by_numpy() -> None:
    inputs = scene(parted=60.0)
    found, _ = motion_signs(inputs, MotionSignState(), LIMITS)
    k, solved = 30, []
    near = inputs.near_ecef_m[k]
    for g in range(2):
        own = inputs.group == g
        los = inputs.sat_ecef_m[k, own] - near
        distance = np.linalg.norm(los, axis=1)
        turn = (
            7.2921151467e-5
            / SPEED_OF_LIGHT
            * (inputs.sat_ecef_m[k, own, 0] * near[1] - inputs.sat_ecef_m[k, own, 1] * near[0])
        )
        design = np.column_stack([-los / distance[:, None], np.ones(own.sum())])
        misfit = inputs.corrected_code_m[k, own] - distance - turn
        x, left, *_ = np.linalg.lstsq(design, misfit, rcond=None)
        scale = max(np.sqrt(left[0] / 0.25 / (own.sum() - 4)), 1.0)
        covariance = np.linalg.inv(design.T @ design / 0.25) * scale**2
        covariance[3, 3] += inputs.clock_sigma_m[k, g] ** 2
        solved.append((x - np.array([0.0, 0.0, 0.0, inputs.clock_offset_m[k, g]]), covariance))
    difference, both = solved[0][0] - solved[1][0], solved[0][1] + solved[1][1]
    assert found.part_sigmas[k] == pytest.approx(np.sqrt(difference @ np.linalg.solve(both, difference)), rel=1e-6)


def few_satellites(
    *, late_s: float = 0.0, wrong_m: dict[int, float] | None = None, aside_m: float = 0.0, seed: int = 4
) -> MotionInputs:
    """Seven satellites of one constellation, each with a velocity of its own, seen by an antenna at rest for 15 s."""
    rng, epochs = np.random.default_rng(seed), 15
    line, time = synthetic.line(), times(epochs)
    antenna = line.at_arc(500.0) + aside_m * line.get_axes(line.segment_at(np.array([500.0]))[0])[0, 1]
    first = synthetic.satellites(rng, 1, "G" * 7)[0]
    velocity = np.cross(first, rng.standard_normal((7, 3)))
    velocity *= 3900.0 / np.linalg.norm(velocity, axis=1, keepdims=True)
    now = np.arange(epochs, dtype=float)[:, None, None]
    tagged, true = first + velocity * now, first + velocity * (now - late_s)
    code = synthetic.travelled_range(true, antenna) + 500.0 + 2.0 * rng.standard_normal((epochs, 7))
    for channel, size in (wrong_m or {}).items():
        code[:, channel] += size
    nothing, every = np.full((epochs, 7), np.nan), np.ones((epochs, 7), dtype=bool)
    return MotionInputs(
        time=time, break_before=np.zeros(epochs, dtype=bool), channel=np.array([f"G{k:02d}1C" for k in range(7)]),
        group=np.zeros(7, dtype=np.intp), near_ecef_m=np.broadcast_to(antenna + 50.0, (epochs, 3)),
        sat_ecef_m=tagged, sat_velocity_mps=np.broadcast_to(velocity, tagged.shape), code_m=code, rate_mps=nothing,
        corrected_code_m=code, sigma_m=np.full((epochs, 7), 4.0), used=every, named=~every,
        noise_scale=np.ones(epochs), clock_offset_m=np.zeros((epochs, 1)), clock_sigma_m=np.zeros((epochs, 1)),
        off_line_m=np.zeros(epochs), doubted=np.ones(epochs, dtype=bool), antenna=np.zeros(epochs, dtype=np.intp),
        lines=(SearchIndex(line),),
    )  # fmt: skip


@pytest.mark.requirement("C6")
@pytest.mark.parametrize("named", [(), (0, 3, 5)])
def test_an_error_of_the_time_tags_is_found_with_seven_satellites_though_some_are_named_as_wrong(
    named: tuple[int, ...],
) -> None:
    inputs = few_satellites(late_s=1.0)
    wrong = np.isin(np.arange(7), named) & inputs.used
    found, _ = motion_signs(inputs._replace(used=~wrong, named=wrong), MotionSignState(), LIMITS)
    assert np.abs(found.tag_error_s[3:] - 1.0).max() < 0.05
    assert (found.tag_error_sigmas[3:] > LIMITS.tag_sigmas).all()


@pytest.mark.requirement("C6")
@pytest.mark.parametrize("size_m", [200.0, -1e3, 3e5])
@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("known", [False, True])
def test_bad_codes_of_seven_satellites_are_no_error_of_the_time_tags(size_m: float, count: int, known: bool) -> None:
    for bad in itertools.combinations(range(7), count):
        inputs = few_satellites(wrong_m=dict.fromkeys(bad, size_m))
        named = np.isin(np.arange(7), bad) & inputs.used & known
        found, _ = motion_signs(inputs._replace(used=~named, named=named), MotionSignState(), LIMITS)
        shown = (np.abs(found.tag_error_s) > LIMITS.tag_error_s) & (found.tag_error_sigmas > LIMITS.tag_sigmas)
        assert not shown.any(), bad


@pytest.mark.requirement("C6")
@pytest.mark.parametrize("aside_m", [60.0, 150.0, 400.0, 3000.0])
def test_a_train_off_its_map_has_no_error_of_the_time_tags(aside_m: float) -> None:
    for seed in range(30):
        found, _ = motion_signs(few_satellites(aside_m=aside_m, seed=seed), MotionSignState(), LIMITS)
        shown = (np.abs(found.tag_error_s) > LIMITS.tag_error_s) & (found.tag_error_sigmas > LIMITS.tag_sigmas)
        assert not shown.any(), seed


@pytest.mark.requirement("C6")
def test_an_error_of_the_time_tags_has_to_explain_more_than_one_bad_code_with_two_redundant_rows() -> None:
    """Seven codes and two rows of the line, five unknowns; each row costs the square of five sigmas at most."""
    inputs = few_satellites().take(np.arange(6))
    named = np.zeros((6, 7), dtype=bool)
    named[4, :2] = True
    bad = {0: (3, 0), 1: (1, 0), 2: (2, 0), 3: (9, 3), 4: (0, 0), 5: (0, 0)}
    without, with_error = (np.array([[10.0] * n[k] + [0.0] * (9 - n[k]) for n in bad.values()]) for k in (0, 1))
    without[4:] = np.nan
    found = _explains_more(inputs._replace(used=~named, named=named), with_error, without)
    # three bad codes and two are explained, one is not; three of nine rows that still disagree leave one redundant;
    # where nothing is redundant the two that are named count, and nothing where none is
    assert found.tolist() == [True, False, True, False, True, False]


@pytest.mark.requirement("B8")
def test_causes_have_words_and_spoofing_outranks_jamming() -> None:
    causes = np.array([0, int(Sign.CN0_FALL), int(Sign.CN0_FALL | Sign.EQUAL_CN0)])
    assert cause_text(causes).tolist() == ["", "cn0_fall", "cn0_fall+equal_cn0"]
    assert suspicion(causes).tolist() == [Suspicion.NONE, Suspicion.JAMMING_SUSPECTED, Suspicion.SPOOFING_SUSPECTED]


@pytest.mark.requirement("B8")
def test_causes_are_decided_in_their_order() -> None:
    jumped, left, tags, failed = Sign.POSITION_JUMP, Sign.LEFT_MAP, Sign.TIME_TAGS, Sign.CONTRADICTED
    causes = np.array([int(s) for s in (jumped | tags, jumped | left, left | failed, failed | Sign.CN0_FALL)])
    expected = [Suspicion.TIME_TAGS, Suspicion.SPOOFING_SUSPECTED, Suspicion.LEFT_MAP, Suspicion.CONTRADICTED]
    assert suspicion(causes).tolist() == expected
