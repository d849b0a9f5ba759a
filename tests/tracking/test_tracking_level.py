"""Level of the filtered position: sub-filters without one source, faults that last."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

import belief_campaign
from plain_kernels import given, kernel_state, plain
from railfix.core.geodesy import enu_axes, geodetic_from_ecef, range_with_rotation
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking import layout
from railfix.kernels.tracking.constants import (
    LEVEL_DOUBT_S,
    LEVEL_HOLD_S,
    LEVEL_START_S,
    LOST_CODE_WEIGHT,
    LOST_MOTION_WEIGHT,
    MAP_ABSOLUTE_M,
)
from railfix.tracking import GnssEpochs, Line, Tracked, TrackingLimits, TrackStatus, track
from railfix.tracking.bank import OTHERS, budget
from railfix.tracking.line import TILT_M
from railfix.tracking.result import EPOCH_RESULT
from railfix.tracking.state import TrackState
from tracking_cases import bent_line, part, ride, wheel, without_epochs

LIMITS = TrackingLimits()


def level_of(
    names: list[str],
    place_m: list[float],
    sigma_m: list[float],
    *,
    branch: tuple[float, float, float, float] | None = None,
    weak_s: float = 0.0,
    in_view: tuple[float, float] | None = None,
    slow: tuple[float, float, float] | None = None,
    scale: float = 1.0,
) -> dict[str, float]:
    """Levels of a place at 100 m with a standard deviation of 1 m, by sub-filters and at most one other branch.

    The branch has a probability, a distance along the line, a straight one, and a standard deviation; `in_view` is
    place and standard deviation of the sub-filter with all satellites in view, where it runs; `slow` is the slow code
    error of each Gaussian, its variance and its covariance with the place: the ionosphere may be tilted.
    """
    probability, apart, ground, sigma = branch or (0.0, 0.0, 0.0, 0.0)
    count = 1 if branch is None else 2
    limits = LIMITS.replaced(level_tilt_prior=0.0 if slow is None else LIMITS.level_tilt_prior)
    state = kernel_state(
        [100.0, 100.0 + apart][:count] + place_m,
        [1.0, sigma][:count] + sigma_m,
        np.log(np.maximum([1.0 - probability, probability], 1e-300))[:count],
        LIMITS,
        names,
    )
    state.source["contradicted_s"][: len(names)] = weak_s
    if slow is not None:
        state.x[:, ix.SLOW_CODE], state.P[:, ix.SLOW_CODE, ix.SLOW_CODE] = slow[:2]
        state.P[:, ix.SLOW_CODE, ix.ARC] = state.P[:, ix.ARC, ix.SLOW_CODE] = slow[2]
    if in_view is not None:
        state.source["running"][-1], state.x[-1, 0], state.P[-1, 0, 0] = True, in_view[0], in_view[1] ** 2
    far, level = probability if apart > LIMITS.start_separation_m else 0.0, plain("tracking.level")
    branches = level.Alternatives(
        *np.array([[0.0 if far else apart], [ground], [0.6 * ground], [sigma], [probability]])[:, : count - 1]
    )
    result = np.zeros(1, dtype=EPOCH_RESULT)
    settings = given(limits)
    settings.line["tilt_m"], settings.epoch["tilt_scale"] = TILT_M[0], scale
    level.write_level(settings, 0, state, branches, far, result[0])
    fields = ("level_m", "ground_level_m", "level_noise_m", "separation_m")
    return {name: float(result[name][0]) for name in fields}


@pytest.mark.requirement("C2")
def test_the_level_spends_the_risk_over_all_hypotheses() -> None:
    """Against the equation by quadrature, with sources of every kind; not a multiple of each that is alike."""
    risks = budget(LIMITS)
    assert risks.risk == pytest.approx(1e-7 / 60.0)
    place, sigma = np.array([0.4, -2.0, 0.1, 1.0]), np.array([1.6, 2.5, 1.1, 3.0])
    found = level_of(["G01", "E", "G", "wheel"], list(100.0 + place), list(sigma))
    level, noise, apart = found["level_m"], found["level_noise_m"], found["separation_m"]
    assert found["ground_level_m"] == level
    prior = np.array([risks.prior[kind] for kind in (0, 1, 1, 2)])
    spent = 2.0 * norm.sf(level) + prior @ (norm.sf((level - place) / sigma) + norm.sf((level + place) / sigma))
    assert spent == pytest.approx(risks.risk, rel=1e-6)
    assert apart == pytest.approx(2.0)
    assert noise == pytest.approx(norm.isf(0.5 * risks.risk))


@pytest.mark.requirement("C6")
@pytest.mark.parametrize("scale", [0.0, 0.4, 1.0, 1.01, 1.5, 3.0])
def test_the_ionosphere_of_the_epoch_and_a_tilted_one_are_hypotheses_of_the_level(scale: float) -> None:
    """Against the equation, with the place of a larger slow code error by inverting the information of both."""
    risks, slow = budget(LIMITS), (0.4, 0.9, -0.8)
    found = level_of(["G01"], [100.4], [1.1], slow=slow, scale=scale)["level_m"]
    hypotheses = [(1.0, 0.0, 1.0), (risks.prior[0], 0.4, 1.1)]
    for prior, size in ((1.0, scale * LIMITS.slow_code_m), (LIMITS.level_tilt_prior, scale * TILT_M[0])):
        information = np.linalg.inv([[1.0, slow[2]], [slow[2], slow[1]]])
        vector = information @ [0.0, slow[0]]
        if size > LIMITS.slow_code_m:
            information[1, 1] += 1.0 / size**2 - 1.0 / LIMITS.slow_code_m**2
            tilted = np.linalg.inv(information)
            hypotheses.append((prior, (tilted @ vector)[0], tilted[0, 0] ** 0.5))
    assert len(hypotheses) == 2 + (scale > 0.5) + (scale > 1.0)
    prior, place, sigma = np.array(hypotheses).T
    parts = prior * (norm.sf((found - place) / sigma) + norm.sf((found + place) / sigma))
    assert parts.sum() == pytest.approx(risks.risk, rel=1e-6)


@pytest.mark.requirement("C6")
def test_an_active_ionosphere_widens_sigma_as_a_larger_slow_code_error_would() -> None:
    """Against the filter with that prior from its start; epochs as in the piece alone, whatever the pieces."""
    train = ride(60.0, noise=0.3)
    scale = np.where(np.arange(len(train.epochs)) < 30, 1.0, 3.0)
    epochs = replace(train.epochs, tilt_scale=scale)
    quiet, found = track(train.epochs, train.line, levels=True)[0], track(epochs, train.line, levels=True)[0]
    larger = track(train.epochs, train.line, limits=TrackingLimits(slow_code_m=3.0), levels=True)[0]
    np.testing.assert_array_equal(found.arc_m, quiet.arc_m)
    np.testing.assert_array_equal(found.level_m[:30], quiet.level_m[:30])
    np.testing.assert_array_equal(found.sigma_m[:30], quiet.sigma_m[:30])
    assert found.sigma_m[40:] == pytest.approx(np.hypot(larger.sigma_m, found.arc_m - larger.arc_m)[40:], rel=0.05)
    first, state = track(epochs.take(slice(0, 37)), train.line, levels=True)
    second = track(epochs.take(slice(37, None)), train.line, state, levels=True)[0]
    np.testing.assert_array_equal(np.append(first.level_m, second.level_m), found.level_m)
    np.testing.assert_array_equal(np.append(first.sigma_m, second.sigma_m), found.sigma_m)


@pytest.mark.requirement("C6")
@pytest.mark.parametrize("probability", [1e-12, 1e-9, 1e-6, 1e-3, 0.4])
def test_other_branches_are_hypotheses_of_the_level(probability: float) -> None:
    """Against the equation: near along the line, or at another place of it that is near on the ground; with a fault of
    the satellite, which shifts the place on the other branch, too."""
    risks = budget(LIMITS)
    for apart, ground in ((40.0, 35.0), (1815.0, 3.0), (900.0, 18.0)):
        found = level_of(["G01"], [101.0], [2.0], branch=(probability, apart, ground, 2.0))

        def spent(level: float, distance: float, shifted: float) -> float:
            places = ((risks.prior[0], 1.0), (probability, distance), (risks.prior[0] * probability, shifted))
            parts = [p * (norm.sf((level - at) / 2.0) + norm.sf((level + at) / 2.0)) for p, at in places]
            return float(2.0 * norm.sf(level) + sum(parts))

        shifted = np.hypot(0.8 * ground, 0.6 * ground + 1.0)
        assert spent(found["ground_level_m"], ground, shifted) == pytest.approx(risks.risk, rel=2e-3)
        if apart > LIMITS.start_separation_m and probability > risks.risk:
            assert found["level_m"] == np.inf
        else:
            distance = apart if apart <= LIMITS.start_separation_m else 0.0
            shifted = distance + 1.0 if distance else 0.0
            assert spent(found["level_m"], distance, shifted) == pytest.approx(risks.risk, rel=2e-3)


@pytest.mark.requirement("C2")
@pytest.mark.parametrize("in_view", [None, (103.0, 1.1)])
def test_two_faulty_satellites_are_a_hypothesis_of_the_level(in_view: tuple[float, float] | None) -> None:
    """Against the equation, with what is known without both by information that adds up; the pair asks for most."""
    risks = budget(LIMITS)
    shift, sigma = np.array([1.5, -2.5, 0.1]), np.array([1.25, 1.3, 1.01])
    found = level_of(["G01", "G02", "G03"], list(100.0 + shift), list(sigma), in_view=in_view)
    one, other = (0, 0, 1), (1, 2, 2)
    with_all, own = in_view or (100.0, 1.0)
    known, whole = sigma**-2.0, own**-2.0
    left = known[[*one]] + known[[*other]] - whole
    apart = ((known * shift)[[*one]] + (known * shift)[[*other]] - whole * (with_all - 100.0)) / left
    place, spread = np.append(shift, apart), np.append(sigma, left**-0.5)
    prior = np.append(np.full(3, risks.prior[0]), np.full(3, risks.prior[0] ** 2))
    level = found["level_m"]
    parts = prior * (norm.sf((level - place) / spread) + norm.sf((level + place) / spread))
    assert parts.argmax() == 3
    assert found["separation_m"] == pytest.approx(2.5)
    assert 2.0 * norm.sf(level) + parts.sum() == pytest.approx(risks.risk, rel=5e-3)


@pytest.mark.requirement("C2")
def test_many_pairs_that_ask_for_little_spend_no_more_than_is_taken_off_for_them() -> None:
    risks, sigma = budget(LIMITS), 1.05
    level = level_of([f"G{k:02d}" for k in range(20)], [100.0] * 20, [sigma] * 20)["level_m"]
    pair = (2.0 * sigma**-2.0 - 1.0) ** -0.5
    parts = [
        norm.sf(level),
        20 * risks.prior[0] * norm.sf(level / sigma),
        190 * risks.prior[0] ** 2 * norm.sf(level / pair),
    ]
    assert 0.9 * risks.risk < 2.0 * sum(parts) <= risks.risk


@pytest.mark.requirement("C2")
def test_two_satellites_without_which_nothing_is_known_leave_no_level() -> None:
    assert level_of(["G01", "G02"], [100.0, 100.0], [1.5, 1.4])["level_m"] == np.inf
    assert np.isfinite(level_of(["G01", "G02"], [100.0, 100.0], [1.5, 1.3])["level_m"])


@pytest.mark.requirement("C2")
@pytest.mark.parametrize(("one", "other"), [(0, 5), (2, 7), (8, 3)])
def test_what_is_known_without_two_satellites_is_that_of_a_filter_without_them(one: int, other: int) -> None:
    case = ride(120, noise=1.0, seed=7, code_sigma_m=3.0)
    _, state = track(case.epochs, case.line, limits=LIMITS, levels=True)
    rows = [state.bank.without.index(str(case.epochs.satellite[k])) for k in (one, other)]
    known = 1.0 / state.bank.covariance[rows, 0, 0]
    left = known.sum() - 1.0 / state.covariance[0, 0, 0]
    shift = known @ (state.bank.mean[rows, 0] - state.mean[0, 0]) / left
    fields = ("code_m", "phase_m", "rate_mps")
    without = {name: getattr(case.epochs, name).copy() for name in fields}
    for values in without.values():
        values[:, [one, other]] = np.nan
    _, expected = track(replace(case.epochs, **without), case.line, limits=LIMITS)
    sigma = np.sqrt(expected.covariance[0, 0, 0])
    assert left**-0.5 == pytest.approx(sigma, rel=0.1)
    assert state.mean[0, 0] + shift == pytest.approx(expected.mean[0, 0], abs=0.3 * sigma)


@pytest.mark.requirement("C2")
def test_a_satellite_that_rises_after_a_switch_brings_no_older_knowledge() -> None:
    """What the filter knows from before a switch has every satellite in it: no pair goes by it, nor by a copy of it."""
    case = ride(40, noise=1.0, code_sigma_m=3.0, seed=7)
    measured = {name: getattr(case.epochs, name).copy() for name in ("code_m", "phase_m", "rate_mps")}
    for values in measured.values():
        values[:33, 3] = np.nan
    epochs = replace(case.epochs, **measured)
    _, state = track(part(epochs, slice(0, 30)), case.line, limits=LIMITS, levels=True)
    _, state = track(part(epochs, slice(30, 34)), case.line, replace(state, bank=None), limits=LIMITS, levels=True)
    sigma = dict(zip(state.bank.without, np.sqrt(state.bank.covariance[:, 0, 0]), strict=True))
    assert sigma["all in view"] > 1.1 * np.sqrt(state.covariance[0, 0, 0])
    assert sigma[str(epochs.satellite[3])] >= sigma["all in view"]


@pytest.mark.requirement("C2")
def test_the_sub_filter_with_all_in_view_begins_without_codes_too_and_ends_beside_the_filter() -> None:
    case = ride(100, noise=1.0, code_sigma_m=3.0, seed=7)
    _, state = track(part(case.epochs, slice(0, 30)), case.line, limits=LIMITS, levels=True)
    code = case.epochs.code_m.copy()
    code[30:32] = np.nan
    epochs, state, there = replace(case.epochs, code_m=code), replace(state, bank=None), []
    for begin, end in ((30, 31), (31, 34), (34, 100)):
        _, state = track(part(epochs, slice(begin, end)), case.line, state, limits=LIMITS, levels=True)
        there.append("all in view" in state.bank.without)
    assert there == [True, True, False]


@pytest.mark.requirement("C6")
def test_what_a_map_is_off_across_is_off_along_after_a_bend() -> None:
    """By hand, 60 degrees to the left: the way on the map has it, what the phases measure has not."""
    random, turn = np.random.default_rng(3), np.radians(60.0)
    mean, root = random.normal(size=ix.SATELLITES), random.normal(size=(ix.SATELLITES, ix.SATELLITES))
    mean[ix.ARC], mean[ix.PREVIOUS_ARC] = 100.0, 0.0
    vertex = np.zeros(3, dtype=layout.VERTEX)
    vertex["arc_m"], vertex["axes"] = [0.0, 100.0, 200.0], np.eye(3)
    vertex["axes"][1:, 0] = np.cos(turn), -np.sin(turn), 0.0
    vertex["axes"][1:, 1] = np.sin(turn), np.cos(turn), 0.0
    x, P = mean.copy(), root @ root.T
    plain("tracking.subfilters").rotate_map_error(given(LIMITS)._replace(vertex=vertex), x, P)
    step = np.eye(ix.SATELLITES)
    right = ix.MAP_RIGHT
    step[ix.ARC, right] = -np.sin(turn)
    step[ix.MAP_LENGTH_ERROR, right] = np.sin(turn)
    step[right, right] = np.cos(turn)
    expected = step @ root @ root.T @ step.T
    expected[right, right] += (LIMITS.level_map_m * np.sin(turn)) ** 2
    np.testing.assert_allclose(x, step @ mean, rtol=0, atol=1e-12)
    np.testing.assert_allclose(P, expected, rtol=0, atol=1e-9)


@pytest.mark.requirement("C6")
@pytest.mark.parametrize("name", OTHERS)
def test_only_the_map_that_lies_aside_withholds_the_level(name: str) -> None:
    """A displacement of 9 m does in the sub-filter of the map, in no other."""
    state = kernel_state([100.0], [1.0], [0.0], LIMITS, ["G"], branch_s=LEVEL_START_S)
    at, right = 1 + list(OTHERS).index(name), ix.MAP_RIGHT
    state.source["running"][at], state.x[1 + at, right], state.P[1 + at, right, right] = True, 9.0, 1.0
    plain("tracking.monitors").update_monitors(state, np.nan, 0.0, 0.0, 1.0, 1.0)
    assert state.monitors["level_hold_s"][0] == (LEVEL_HOLD_S if name == "map" else 0.0)


@pytest.mark.requirement("C6")
def test_a_map_that_may_be_wrong_is_so_where_nothing_is_measured() -> None:
    """In a gap too its displacement across changes with the way: by 30 m of the map that may be wrong, by no other."""
    case = ride(120, noise=1.0)
    gap = np.arange(120) >= 60
    _, before = track(part(case.epochs, slice(0, 60)), case.line, limits=LIMITS, levels=True)
    _, after = track(without_epochs(case.epochs, gap), case.line, limits=LIMITS, levels=True)
    assert before.bank is not None
    assert after.bank is not None
    kept = np.exp(-2.0 * after.monitors.distance_since_code_m / MAP_ABSOLUTE_M)
    assert kept < 0.5
    for name, wrong_m in (("map", LIMITS.level_map_m), ("G", 0.0)):
        old, new = (
            bank.covariance[bank.without.index(name), ix.MAP_RIGHT, ix.MAP_RIGHT] for bank in (before.bank, after.bank)
        )
        walked = (case.line.sigma_plan_m**2 + wrong_m**2) * (1.0 - kept)
        assert new == pytest.approx(kept * old + walked, rel=0.05)


@pytest.mark.requirement("C6")
@pytest.mark.parametrize("start", [0, 75, 150])
def test_a_map_off_to_the_north_is_in_the_level_beyond_the_corners_of_a_recording(recordings: Path, start: int) -> None:
    case = belief_campaign.cases(recordings)["japan"]().part(start, start + 150)
    shift = 10.0 * enu_axes(*geodetic_from_ecef(case.trajectory.ecef_m[0])[:2])[1]
    found = belief_campaign.run(belief_campaign.on_line(case, np.asarray(case.trajectory.ecef_m) + shift), {})
    assert np.isfinite(found.ground_level_m).sum() > 15
    assert not found.over_ground.any()


@pytest.mark.requirement("C2")
def test_only_a_contradiction_that_lasts_takes_the_level_away() -> None:
    for weak_s, told in ((0.0, True), (1.0, True), (LEVEL_DOUBT_S, True), (LEVEL_DOUBT_S + 0.1, False)):
        assert np.isfinite(level_of(["G01"], [100.0], [1.0], weak_s=weak_s)["level_m"]) == told
    # half of the codes 60 m late: the filter's own weights are those of a lost track, for 2 s and for 5 s
    case = ride(60, noise=1.0, seed=5)
    code = case.epochs.code_m.copy()
    for begin, end in ((20, 22), (40, 45)):
        code[begin:end, ::2] += 60.0
    result, _ = track(replace(case.epochs, code_m=code), case.line, limits=LIMITS, levels=True)
    assert (result.code_weight[[20, 21, 40, 44]] < LOST_CODE_WEIGHT).all()
    assert np.isfinite(result.level_m[15:40]).all()
    assert not np.isfinite(result.level_m[43:45]).any()
    told = np.isfinite(result.level_m)
    assert (np.abs(result.arc_m - case.arc_m) <= result.level_m)[told][5:].all()


@pytest.mark.requirement("C2", "C6")
def test_dopplers_that_agree_on_no_speed_leave_the_place_in_doubt_unless_a_wheel_has_it() -> None:
    case = ride(75, noise=1.0, seed=5)
    rate, joined = case.epochs.rate_mps.copy(), np.array(case.epochs.phase_joined)
    joined[40:55] = False
    rate[40:55] += np.where(np.arange(10) < 5, 0.0, 0.8 * np.random.default_rng(4).normal(size=(15, 10)))
    epochs = replace(case.epochs, rate_mps=rate, phase_joined=joined)
    alone, _ = track(epochs, case.line, limits=LIMITS, levels=True)
    sensed, _ = track(epochs, case.line, limits=LIMITS, levels=True, sensors=wheel(case))
    assert (alone.motion_weight[40:55] > LOST_MOTION_WEIGHT).all()  # no epoch by itself is that of a lost track
    assert (alone.status[20:41] == TrackStatus.TRACKING).all()
    assert (alone.status[48:55] == TrackStatus.DOUBTFUL).all()
    assert (alone.status[65:] == TrackStatus.TRACKING).all()
    assert (sensed.status[20:] == TrackStatus.TRACKING).all()


@pytest.mark.requirement("C2")
def test_a_source_that_is_never_faulty_needs_no_sub_filter() -> None:
    case = ride(20, noise=1.0)
    limits = TrackingLimits(level_constellation_prior=0.0)
    _, state = track(case.epochs, case.line, limits=limits, levels=True)
    assert set(state.bank.without) == {*case.epochs.satellite, *OTHERS} - {"all in view"}
    rare = budget(TrackingLimits(level_constellation_prior=1e-13, level_fault_prior=1e-3))
    assert rare.prior[1] == 0.0
    assert rare.risk < budget(LIMITS).risk


@pytest.mark.requirement("C2")
def test_a_satellite_behind_a_bridge_keeps_its_sub_filter_and_one_long_gone_has_none() -> None:
    case = ride(190, noise=1.0, seed=3)
    names = ("code_m", "phase_m", "rate_mps")
    blank = {name: getattr(case.epochs, name).copy() for name in names}
    for name in names:
        blank[name][40:45, 2] = np.nan
        blank[name][20:, 5] = np.nan
    code = blank["code_m"]
    code[20:40, 2] += 25.0
    code[45:, 2] += 25.0
    result, state = track(replace(case.epochs, **blank), case.line, limits=LIMITS, levels=True)
    assert str(case.epochs.satellite[2]) in state.bank.without
    assert str(case.epochs.satellite[5]) not in state.bank.without
    # A sub-filter that had restarted would ask for K1 times what codes of one epoch tell.
    assert result.level_m[45:50].max() < 1.5 * result.level_m[35:40].max()


@pytest.mark.requirement("C6")
def test_without_the_other_constellation_the_level_names_the_risk_that_nothing_bounds() -> None:
    """The sub-filter without the last constellation has nothing to measure: it goes, and comes back with the other."""
    case = ride(240, noise=1.0, seed=3)
    lost = (case.epochs.clock == "E") & ((np.arange(240) >= 60) & (np.arange(240) < 180))[:, None]
    blank = {name: np.where(lost, np.nan, getattr(case.epochs, name)) for name in ("code_m", "phase_m", "rate_mps")}
    found, state = track(replace(case.epochs, **blank), case.line, limits=LIMITS, levels=True)
    prior = budget(LIMITS).prior[1]
    np.testing.assert_array_equal(found.unchecked_prior[50:60], 0.0)
    np.testing.assert_array_equal(found.unchecked_prior[90:180], prior)
    assert found.level_m[60:90].max() > 100.0
    alone = (case.epochs.clock == "E") & np.full((240, 1), True)
    blank = {name: np.where(alone, np.nan, getattr(case.epochs, name)) for name in blank}
    one, _ = track(replace(case.epochs, **blank), case.line, limits=LIMITS, levels=True)
    np.testing.assert_array_equal(one.unchecked_prior[50:], prior)
    np.testing.assert_allclose(found.level_m[150:180], one.level_m[150:180], rtol=0.2)
    assert {"E", "G"} < set(state.bank.without)
    assert found.unchecked_prior[-1] == 0.0


@pytest.mark.requirement("C2")
@pytest.mark.parametrize("side", ["ahead", "behind"])
def test_the_sub_filter_without_the_satellites_of_a_side_keeps_the_place(side: str) -> None:
    case = ride(100, noise=1.0, seed=2)
    point, axes = case.line.at(case.arc_m)[:2]
    _, sight = range_with_rotation(case.epochs.sat_ecef_m, point[:, None])
    along = (sight * axes[:, :1]).sum(axis=-1) * (1.0 if side == "ahead" else -1.0)
    code = case.epochs.code_m + np.where(along > 0.2, np.clip(0.2 * (np.arange(100.0) - 20.0), 0.0, 14.0)[:, None], 0.0)
    found, state = track(replace(case.epochs, code_m=code), case.line, limits=LIMITS, levels=True)
    k = state.bank.without.index(side)
    sigma = np.sqrt(state.bank.covariance[k, 0, 0])
    assert abs(found.arc_m[-1] - case.arc_m[-1]) > 3.0
    assert abs(state.bank.mean[k, 0] - case.arc_m[-1]) < min(2.0 * sigma, 2.0)


@pytest.mark.requirement("C2")
@pytest.mark.parametrize(("name", "start", "side"), [("pixel", 800, "ahead"), ("f9p", 200, "behind")])
def test_late_codes_of_all_satellites_of_a_side_are_in_the_level(
    recordings: Path, name: str, start: int, side: str
) -> None:
    case = belief_campaign.cases(recordings)[name]().part(start, start + 150)
    along, _ = belief_campaign.sights(case)
    late = 25.0 * (along < -0.2 if side == "ahead" else along > 0.2)
    nothing = np.zeros(late.shape)
    found = belief_campaign.run(
        belief_campaign.with_fault(case, belief_campaign.Fault(side, late, nothing, nothing)), {}
    )
    assert np.nanmax(found.straight_m) > 15.0
    assert np.isfinite(found.ground_level_m).sum() > 15
    assert not found.over_ground.any()


@pytest.mark.requirement("C2")
def test_cutting_after_a_switch_changes_no_level(recordings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the deep city another place takes over after some seconds, and all sub-filters restart."""
    given = []

    def kept(epochs: GnssEpochs, line: Line, state: TrackState | None, **settings: Any) -> tuple[Tracked, TrackState]:
        given.append((epochs, line))
        return track(epochs, line, state, **settings)

    monkeypatch.setattr("railfix.tracking.levels.track", kept)
    belief_campaign.run(belief_campaign.cases(recordings)["berlin"]().part(0, 300), {})
    epochs, line = given[0]
    whole, _ = track(epochs, line, limits=LIMITS, levels=True)
    assert abs(whole.arc_m[11] - whole.arc_m[10]) > 1000.0
    for cut in (11, 12, 15, 24):
        _, state = track(epochs.take(slice(0, cut)), line, limits=LIMITS, levels=True)
        assert cut == 11 or "all in view" in state.bank.without
        found, _ = track(epochs.take(slice(cut, None)), line, state, limits=LIMITS, levels=True)
        for name in ("level_m", "ground_level_m", "separation_m"):
            np.testing.assert_allclose(getattr(found, name), getattr(whole, name)[cut:], rtol=1e-6)
    assert np.isfinite(whole.ground_level_m[12:]).any()


@pytest.mark.requirement("C2")
def test_amounts_grow_with_the_way_since_codes_and_sensors_are_left_out_too() -> None:
    case = ride(120, noise=1.0)
    gap = np.zeros(120, dtype=bool)
    gap[80:] = True
    result, state = track(without_epochs(case.epochs, gap), case.line, limits=LIMITS, sensors=wheel(case), levels=True)
    assert "wheel" in state.bank.without
    error = np.abs(result.arc_m - case.arc_m)
    assert (error <= result.amount_m)[10:].all()
    assert (result.amount_m >= 0.02 * (case.arc_m - case.arc_m[79]) * 0.9)[80:].all()


@pytest.mark.requirement("C2")
def test_off_there_is_no_level() -> None:
    case = ride(20)
    result, state = track(case.epochs, case.line)
    assert np.isnan(result.level_m).all()
    assert state.bank is None


@pytest.mark.requirement("C2")
def test_a_sub_filter_follows_the_line_where_a_fault_has_led_the_filter_away() -> None:
    """Four codes on a line that bends, a ramp in one of them."""
    case = ride(110, trajectory=bent_line(1500.0, turn_deg=170.0), noise=1.0, code_sigma_m=3.0, seed=4)
    few = np.isin(np.arange(10), (0, 2, 5, 8)) | (np.arange(110) < 5)[:, None]
    code = np.where(few, case.epochs.code_m, np.nan)
    code[30:, 2] += 1.5 * np.arange(80.0)
    nothing = np.full(code.shape, np.nan)
    epochs = replace(case.epochs, code_m=code, phase_m=nothing, rate_mps=nothing)
    result, state = track(epochs, case.line, limits=TrackingLimits(late_degrees_of_freedom=4.0), levels=True)
    k = state.bank.without.index(str(case.epochs.satellite[2]))
    assert abs(state.bank.mean[k, 0] - case.arc_m[-1]) < 3.0
    assert (np.abs(result.arc_m - case.arc_m) <= result.level_m)[5:].all()
