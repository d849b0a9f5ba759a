"""Code and phase in one least squares: against a dense solution with all unknowns, and its properties."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import carrier_cases
import synthetic
from phase_run import phase_run
from railfix.core.geodesy import range_with_rotation
from railfix.positioning.carrier import PhaseLimits, PhasePositions, Phases, PhaseState, phase_positions
from railfix.positioning.carrier.ambiguities import FREE_AMBIGUITY_M, number_hops
from railfix.positioning.normal_equations import position_on_line
from railfix.positioning.range_arrays import InterSystemBiases, Ranges
from railfix.track.trajectory import Trajectory

LINE = carrier_cases.straight()
CONSTANT = PhaseLimits(drift_m=0.0, correlation_s=0.0)
WALKING = PhaseLimits(drift_m=0.02, hop_s=2.0, correlation_s=0.0)


def moving(epochs: int, speed_mps: float = 15.0) -> np.ndarray:
    return 100.0 + speed_mps * np.arange(epochs)


def broken_arcs(epochs: int, channels: int) -> np.ndarray:
    """Arcs that begin and end inside the run, and phases that are missing."""
    ids = np.repeat((np.arange(channels, dtype=np.int64) << 23)[None], epochs, axis=0)
    ids[epochs // 2 :, 0] += 1
    ids[epochs // 3 :, 1] += 1
    ids[2 * epochs // 3 :, 1] += 1
    ids[:, 2] = -1
    ids[: epochs // 4, 3] = -1
    return ids


def dense(
    ranges: Ranges, phases: Phases, time: np.ndarray, start: np.ndarray, line: Trajectory, limits: PhaseLimits
) -> tuple[np.ndarray, np.ndarray]:
    """All unknowns in one matrix, QR by lstsq, Gauss-Newton: distances and ambiguities (by arc, hop)."""
    epochs, channels = ranges.code_m.shape
    used = phases.weight > 0
    hops = number_hops(time, limits) if limits.drift_m > 0 else np.zeros(epochs, int)
    keys = sorted({(int(phases.arc_id[t, i]), int(hops[t])) for t, i in np.argwhere(used)})
    groups, own = len(ranges.groups), int(limits.clocks == "own")
    per = 3 + groups + own
    group_of = np.empty(channels, int)
    for g, group in enumerate(ranges.groups):
        group_of[group] = g
    first = {
        k: phases.phase_m[used & (phases.arc_id == k[0])][0] - ranges.code_m[used & (phases.arc_id == k[0])][0]
        for k in keys
    }
    x = np.zeros(epochs * per + len(keys))
    arc = start.copy()
    for _ in range(6):
        rows, right = [], []
        section, along = line.segment_at(arc)
        axes = np.stack([line.tangent[section], line.across[section], line.up[section]], axis=1)
        for t in range(epochs):
            place = line.ecef_m[section[t]] + along[t] * axes[t, 0]
            distance, los = range_with_rotation(ranges.sat_ecef_m[t], place)
            step = -los @ axes[t].T
            for i in range(channels):
                base = np.zeros(len(x))
                base[t * per : t * per + 3] = step[i]
                if ranges.weight[t, i] > 0:
                    row = base.copy()
                    row[t * per + 3 + group_of[i]] = 1.0
                    rows.append(row * ranges.weight[t, i] ** 0.5)
                    right.append((ranges.code_m[t, i] - distance[i] - 300.0) * ranges.weight[t, i] ** 0.5)
                if used[t, i]:
                    row, key = base.copy(), (int(phases.arc_id[t, i]), int(hops[t]))
                    row[t * per + 3 + (groups if own else group_of[i])] = 1.0
                    row[epochs * per + keys.index(key)] = 1.0
                    value = phases.phase_m[t, i] - distance[i] - 300.0 - first[key]
                    rows.append(row * phases.weight[t, i] ** 0.5)
                    right.append(value * phases.weight[t, i] ** 0.5)
            for k, sigma in ((1, line.sigma_plan_m), (2, line.sigma_height_m)):
                row = np.zeros(len(x))
                row[t * per + k] = 1.0 / sigma
                rows.append(row)
                right.append(0.0)
            if ranges.ties is not None:
                # A common clock, eliminated by hand: each clock less the weighted mean of all.
                sigma = np.maximum(ranges.ties.sigma_m[t], 1e-2)
                mean = sigma**-2.0 / np.sum(sigma**-2.0)
                for g in range(groups):
                    row = np.zeros(len(x))
                    row[t * per + 3 : t * per + 3 + groups] = -mean
                    row[t * per + 3 + g] += 1.0
                    rows.append(row / sigma[g])
                    right.append((ranges.ties.offset_m[t, g] - mean @ ranges.ties.offset_m[t]) / sigma[g])
        for one, two in pairwise(keys):
            if one[0] == two[0]:
                row = np.zeros(len(x))
                sigma = limits.drift_m * ((two[1] - one[1]) * limits.hop_s) ** 0.5
                row[epochs * per + keys.index(one)], row[epochs * per + keys.index(two)] = -1 / sigma, 1 / sigma
                rows.append(row)
                right.append(0.0)
        for k in range(len(keys)):
            row = np.zeros(len(x))
            row[epochs * per + k] = 1.0 / FREE_AMBIGUITY_M
            rows.append(row)
            right.append(0.0)
        x = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
        arc = arc + x[: epochs * per].reshape(epochs, per)[:, 0]
    return arc, x[epochs * per :] + np.array([first[k] for k in keys])


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("limits", [CONSTANT, WALKING])
@pytest.mark.parametrize("clocks", ["own", "shared"])
@pytest.mark.parametrize("tied", [False, True])
def test_equals_a_dense_least_squares(limits, clocks, tied):
    limits = limits.replaced(clocks=clocks)
    arc, time = moving(6), carrier_cases.times(6)
    ranges, phases = carrier_cases.observed(LINE, arc, arc_id=broken_arcs(6, 8))
    if tied:
        sigma = np.tile([0.0, 1.0], (6, 1))
        ranges = replace(ranges, ties=InterSystemBiases(offset_m=np.tile([0.0, 5.5], (6, 1)), sigma_m=sigma))
    got = phase_run(time, ranges, phases, LINE, arc + 4.0, limits=limits)
    expected, ambiguities = dense(ranges, phases, time, arc + 4.0, LINE, limits)
    assert np.abs(got.arc_m - expected).max() < 1e-6
    if limits.clocks == "shared":
        assert np.abs(got.arcs.ambiguity_m - ambiguities).max() < 1e-5
    else:
        assert np.abs(np.diff(got.arcs.ambiguity_m) - np.diff(ambiguities)).max() < 1e-5


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("gap_s", [0, 9])
def test_ambiguities_walk_on_through_a_gap(gap_s: int):
    """The position after a gap, of the past alone, and its noise are those of a dense solution of all epochs."""
    arc, time = moving(8), carrier_cases.times(8)
    time = time + np.where(np.arange(8) < 5, 0, gap_s).astype("timedelta64[s]")
    ranges, phases = carrier_cases.observed(LINE, arc, noise=0.3)
    live, _ = phase_positions(time, ranges, phases, LINE, arc + 4.0, limits=WALKING)
    expected, _ = dense(ranges, phases, time, arc + 4.0, LINE, WALKING)
    assert live.arc_m[-1] == pytest.approx(expected[-1], abs=1e-5)


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("limits", [CONSTANT, WALKING])
def test_the_last_epoch_of_a_run_is_that_of_the_past_alone(limits):
    arc, time = moving(20), carrier_cases.times(20)
    ranges, phases = carrier_cases.observed(LINE, arc, arc_id=broken_arcs(20, 8))
    live, _ = phase_positions(time, ranges, phases, LINE, arc + 3.0, limits=limits)
    for last in (1, 5, 12, 20):
        rows = np.arange(last)
        run = phase_run(time[rows], ranges.take(rows), phases.take(rows), LINE, arc[rows] + 3.0, limits=limits)
        assert live.arc_m[last - 1] == pytest.approx(run.arc_m[-1], abs=1e-5)
        assert live.sigma_m[last - 1] == pytest.approx(run.sigma_m[-1], rel=1e-5)
        assert live.noise_sigma_m[last - 1] == pytest.approx(run.noise_sigma_m[-1], rel=1e-5)


@pytest.mark.requirement("A5")
@given(seed=st.integers(0, 2**32 - 1), clocks=st.sampled_from(["own", "shared"]))
@settings(max_examples=15)
def test_exact_ranges_and_any_whole_cycles_give_the_place(seed, clocks):
    arc, time = moving(12), carrier_cases.times(12)
    cycles = np.random.default_rng(seed).integers(-50_000_000, 50_000_000, 64).astype(float)
    ranges, phases = carrier_cases.observed(
        LINE, arc, noise=0.0, seed=seed, cycles=cycles, arc_id=broken_arcs(12, 8),
        own_clock_m=300.0 if clocks == "own" else 0.0,
    )  # fmt: skip
    limits = PhaseLimits(clocks=clocks)
    live, _ = phase_positions(time, ranges, phases, LINE, arc + 8.0, limits=limits)
    run = phase_run(time, ranges, phases, LINE, arc + 8.0, limits=limits)
    for found in (live, run):
        assert np.abs(found.arc_m - arc).max() < 1e-4
        assert np.nanmax(np.abs(found.phase_residual_m)) < 1e-4
        assert np.nanmax(np.abs(found.code_residual_m)) < 1e-4
    if clocks == "shared":
        names = np.unique(phases.arc_id)
        expected = dict(zip(names.tolist(), carrier_cases.WAVELENGTH_M * cycles, strict=False))
        whole = [expected[int(i)] for i in run.arcs.arc_id]
        assert np.abs(run.arcs.ambiguity_m - whole).max() < 1e-3


@pytest.mark.requirement("A5")
def test_exact_on_a_curved_line():
    line = synthetic.line(spacing_m=5.0)
    arc, time = moving(30, 20.0), carrier_cases.times(30)
    ranges, phases = carrier_cases.observed(line, arc, noise=0.0)
    found = phase_run(time, ranges, phases, line, arc + 5.0)
    assert np.abs(found.arc_m - arc).max() < 1e-4


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("tied", [False, True])
@pytest.mark.every(2)
def test_without_phases_it_is_the_position_of_the_codes(tied):
    arc, time = moving(40), carrier_cases.times(40)
    ranges, phases = carrier_cases.observed(LINE, arc)
    if tied:
        ties = InterSystemBiases(offset_m=np.tile([0.0, 5.5], (40, 1)), sigma_m=np.tile([0.0, 1.0], (40, 1)))
        ranges = replace(ranges, ties=ties)
    none = replace(phases, weight=np.zeros_like(phases.weight), arc_id=np.full(phases.arc_id.shape, -1))
    code = position_on_line(ranges, LINE, np.clip(np.rint(arc / 50).astype(int), 0, 19))
    live, state = phase_positions(time, ranges, none, LINE, arc + 6.0)
    run = phase_run(time, ranges, none, LINE, arc + 6.0)
    for found in (live, run):
        assert np.abs(found.arc_m - code.arc_m).max() < 1e-4
        assert found.sigma_m == pytest.approx(code.sigma_m, rel=1e-3)
        assert np.isnan(found.phase_residual_m).all()
        assert (found.n_phases == 0).all()
    assert len(state.memories[-1].arc_id) == 0


@pytest.mark.requirement("A5")
def test_order_of_satellites_changes_nothing():
    arc, time = moving(20), carrier_cases.times(20)
    ranges, phases = carrier_cases.observed(LINE, arc, systems="GGGGGGG", arc_id=broken_arcs(20, 7))
    order = np.random.default_rng(1).permutation(7)
    turned = replace(
        ranges, sat_ecef_m=ranges.sat_ecef_m[:, order], code_m=ranges.code_m[:, order], weight=ranges.weight[:, order]
    )
    other = Phases(phase_m=phases.phase_m[:, order], weight=phases.weight[:, order], arc_id=phases.arc_id[:, order])
    for form in (phase_run, lambda *a: phase_positions(*a)[0]):
        one, two = form(time, ranges, phases, LINE, arc), form(time, turned, other, LINE, arc)
        assert np.abs(one.arc_m - two.arc_m).max() < 1e-6
        assert two.sigma_m == pytest.approx(one.sigma_m, rel=1e-6)


def cut(time: np.ndarray, ranges: Ranges, phases: Phases, start: np.ndarray, size: int) -> PhasePositions:
    state: PhaseState | None = None
    parts = []
    for first in range(0, len(time), size):
        rows = np.arange(first, min(first + size, len(time)))
        part, state = phase_positions(time[rows], ranges.take(rows), phases.take(rows), LINE, start[rows], state)
        parts.append(part)
    names = ("arc_m", "sigma_m", "noise_sigma_m", "code_residual_m", "phase_residual_m", "ambiguity_sigma_m")
    return replace(parts[-1], **{n: np.concatenate([getattr(p, n) for p in parts]) for n in names})


@pytest.mark.requirement("A5")
@pytest.mark.parametrize("interval_s", [0.2, 30.0])
@pytest.mark.every(2)
def test_chunks_give_the_same(interval_s):
    epochs = 200
    arc, time = moving(epochs, 3.0), carrier_cases.times(epochs, interval_s)
    rng = np.random.default_rng(4)
    ids = broken_arcs(epochs, 8)
    begins = rng.random(ids.shape) < 0.05
    ids = np.where(ids >= 0, ids + np.cumsum(begins, axis=0), -1)
    ranges, phases = carrier_cases.observed(LINE, arc, arc_id=ids)
    start = arc + rng.normal(0.0, 3.0, epochs)
    start[50:53] = np.nan
    whole, _ = phase_positions(time, ranges, phases, LINE, start)
    assert np.isnan(whole.arc_m[50:53]).all()
    assert np.isfinite(np.delete(whole.arc_m, [50, 51, 52])).all()
    for size in (1, 7, 64, 150):
        pieces = cut(time, ranges, phases, start, size)
        assert np.nanmax(np.abs(pieces.arc_m - whole.arc_m)) < 1e-9
        assert np.nanmax(np.abs(pieces.sigma_m - whole.sigma_m)) < 1e-9
        assert np.nanmax(np.abs(pieces.phase_residual_m - whole.phase_residual_m)) < 1e-9


def in_town(cycles: float) -> tuple[np.ndarray, Ranges, Phases, np.ndarray]:
    """A telephone in a town: poor codes, arcs of a few epochs, ambiguities up to `cycles`, a clock of the phases."""
    epochs, rng = 160, np.random.default_rng(2)
    arc, time = moving(epochs, 5.0), carrier_cases.times(epochs)
    ids = np.repeat((np.arange(7, dtype=np.int64) << 23)[None], epochs, axis=0)
    ids += np.cumsum(rng.random(ids.shape) < 0.25, axis=0)
    ids[rng.random(ids.shape) < 0.2] = -1
    whole = np.round(cycles * rng.uniform(-1.0, 1.0, 4096))
    ranges, phases = carrier_cases.observed(
        LINE, arc, systems="GGGGEER", code_sigma_m=10.0, cycles=whole, arc_id=ids, own_clock_m=100.0
    )
    return time, ranges, phases, arc + rng.normal(0.0, 10.0, epochs)


@pytest.mark.requirement("A5")
def test_chunks_give_the_same_with_arcs_of_seconds():
    time, ranges, phases, start = in_town(8e7)
    whole, _ = phase_positions(time, ranges, phases, LINE, start)
    for size in (1, 7, 50):
        pieces = cut(time, ranges, phases, start, size)
        assert np.abs(pieces.arc_m - whole.arc_m).max() < 1e-9
        assert np.abs(pieces.sigma_m - whole.sigma_m).max() < 1e-9


def test_an_arc_that_goes_on_after_a_newer_one_of_its_channel_is_an_error():
    time, ranges, phases, start = in_town(0.0)
    again = phases.arc_id.copy()
    again[150:] = again[:10]
    again = np.where(phases.arc_id >= 0, np.maximum(again, 0), -1)
    with pytest.raises(ValueError, match="an arc has phases after the start of a newer arc of its channel; assign"):
        phase_positions(time, ranges, replace(phases, arc_id=again), LINE, start)


@pytest.mark.requirement("A5")
def test_many_whole_cycles_give_the_same_with_arcs_of_seconds():
    """Right-hand sides with 1e7 m times the weight of a phase in them would be off by centimetres of position."""
    none, many = (phase_positions(*case[:3], LINE, case[3])[0] for case in (in_town(0.0), in_town(8e7)))
    assert np.abs(many.arc_m - none.arc_m).max() < 1e-3


@pytest.mark.requirement("A5")
def test_noise_falls_and_the_sigma_tells_it():
    """White noise, the map exact: errors over their noise sigma have rms 1, a run of 60 epochs averages by 5."""
    errors, sigmas, codes = [], [], []
    for seed in range(40):
        arc, time = moving(60, 5.0), carrier_cases.times(60)
        ranges, phases = carrier_cases.observed(LINE, arc, seed=seed)
        found, _ = phase_positions(time, ranges, phases, LINE, arc, limits=CONSTANT)
        errors.append(found.arc_m - arc)
        sigmas.append(found.noise_sigma_m)
        codes.append(position_on_line(ranges, LINE, np.rint(arc / 50).astype(int)).arc_m - arc)
    error, sigma, code = np.array(errors), np.array(sigmas), np.array(codes)
    assert np.std(error[:, -1]) < 0.25 * np.std(code[:, -1])
    assert 0.85 < np.sqrt(np.mean((error[:, 5:] / sigma[:, 5:]) ** 2)) < 1.15
    assert 0.85 < np.sqrt(np.mean((error[:, 0] / sigma[:, 0]) ** 2)) < 1.25


@pytest.mark.requirement("A5")
def test_a_map_that_is_off_does_not_average():
    """Antenna 0.3 m aside all the way: the error stays, and the sigma with the map covers it."""
    arc, time = moving(60, 2.0), carrier_cases.times(60)
    section, _ = LINE.segment_at(arc)
    ratios = []
    for seed in range(12):
        ranges, phases = carrier_cases.observed(LINE, arc, noise=0.0, seed=seed)
        aside = LINE.at_arc(arc) + LINE.sigma_plan_m * LINE.across[section]
        off = synthetic.travelled_range(ranges.sat_ecef_m, aside[:, None, :]) - synthetic.travelled_range(
            ranges.sat_ecef_m, LINE.at_arc(arc)[:, None, :]
        )
        found = phase_run(
            time, replace(ranges, code_m=ranges.code_m + off), replace(phases, phase_m=phases.phase_m + off), LINE, arc
        )
        error, map_sigma = found.arc_m - arc, np.sqrt(found.sigma_m**2 - found.noise_sigma_m**2)
        assert (np.abs(error) < map_sigma + 0.01).all()
        ratios.append(np.mean(np.abs(error) / map_sigma))
    assert 0.2 < np.mean(ratios) <= 1.0


@pytest.mark.requirement("A5")
def test_few_codes_are_carried_by_the_phases():
    """After a minute two satellites' codes are left, all phases go on: the position stays."""
    arc, time = moving(70, 8.0), carrier_cases.times(70)
    ranges, phases = carrier_cases.observed(LINE, arc, systems="GGGGGGGG")
    weight = ranges.weight.copy()
    weight[60:, 2:] = 0.0
    found, _ = phase_positions(time, replace(ranges, weight=weight), phases, LINE, arc + 2.0)
    assert np.abs(found.arc_m - arc)[60:].max() < 0.7
    assert (found.n_codes[60:] == 2).all()


def test_an_arc_unseen_for_long_begins_anew_however_the_log_is_cut():
    time = np.r_[carrier_cases.times(30), carrier_cases.times(30) + np.timedelta64(700, "s")]
    arc = np.full(60, 300.0)
    ranges, phases = carrier_cases.observed(LINE, arc)
    whole, _ = phase_positions(time, ranges, phases, LINE, arc)
    alone, _ = phase_positions(
        time[30:], ranges.take(np.arange(30, 60)), phases.take(np.arange(30, 60)), LINE, arc[30:]
    )
    assert np.abs(whole.arc_m[30:] - alone.arc_m).max() < 1e-6
    assert np.abs(cut(time, ranges, phases, arc, 7).arc_m - whole.arc_m).max() < 1e-9


def test_the_end_of_the_line_is_not_passed():
    arc = np.full(5, LINE.arc_m[-1])
    ranges, phases = carrier_cases.observed(LINE, arc)
    found, _ = phase_positions(carrier_cases.times(5), ranges, phases, LINE, arc - 1.0)
    assert (found.arc_m <= LINE.arc_m[-1]).all()


def test_no_epochs_and_wrong_shapes():
    ranges, phases = carrier_cases.observed(LINE, moving(4))
    none = np.arange(0)
    found, _ = phase_positions(carrier_cases.times(0), ranges.take(none), phases.take(none), LINE, np.empty(0))
    assert len(found.arc_m) == 0
    with pytest.raises(ValueError, match="shape"):
        phase_run(carrier_cases.times(4), ranges, phases.take(np.arange(3)), LINE, moving(4))
    lost = replace(phases, arc_id=np.full(phases.arc_id.shape, -1))
    with pytest.raises(ValueError, match="arc"):
        phase_run(carrier_cases.times(4), ranges, lost, LINE, moving(4))
