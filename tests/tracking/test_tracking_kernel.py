"""The recursion of the filter: compiled and as plain Python, epoch by epoch, against Kalman's update and densities."""

from __future__ import annotations

from dataclasses import fields, replace
from inspect import unwrap
from typing import Any

import numpy as np
import pytest

from plain_kernels import named_tuple, parameters, plain, work_space
from railfix.core.arrays import copy_with
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, range_with_rotation
from railfix.kernels.tracking import layout
from railfix.kernels.tracking.constants import (
    FORCE_WALK_MPS2,
    FREEDOM_PLACE_M2,
    FREEDOM_SPEED_M2PS2,
    RADAR_WALK,
    WHEEL_WALK,
)
from railfix.tracking import GnssEpochs, Line, RangeEpochs, SensorEpochs, Tracked, TrackingLimits, TrackStatus, track
from railfix.tracking.chunk import prepare_chunk
from railfix.tracking.filter import Recursion
from railfix.tracking.handover import Handover
from railfix.tracking.state import CLOCKS, OFFSETS, StateIndex
from railfix.tracking.velocity import compute_velocity
from tracking_cases import Ride, bent_line, part, reflected, ride, without_epochs


def _case(name: str) -> tuple[GnssEpochs, Line, SensorEpochs | None]:
    """Rides that take every branch: outliers, slips, clock steps, gaps, branches, sensors, ends, new satellites."""
    random = np.random.default_rng(8)
    if name == "branches":
        case = ride(120, trajectory=bent_line(1500.0, turn_deg=190.0), noise=1.0, code_sigma_m=8.0)
        return case.epochs, case.line, None
    case = ride(60 if name == "10 Hz" else 140, rate_hz=10.0 if name == "10 Hz" else 1.0, noise=1.0, seed=5)
    epochs, sensors = case.epochs, None
    if name == "sensors":
        size = len(case.arc_m)
        way = np.diff(case.arc_m, prepend=np.nan)
        sensors = SensorEpochs(
            wheel_m=way / 1.01, wheel_sigma_m=np.full(size, 0.02), wheel_sign="unknown",
            radar_m=np.where(random.random(size) < 0.5, way, np.nan), radar_sigma_m=np.full(size, 0.1),
            force_mps2=np.diff(case.speed_mps, prepend=np.nan) + 0.02 * random.normal(size=size),
            force_sigma_mps2=np.full(size, 0.05),
            place_m=np.where(np.arange(size) == 60, case.arc_m, np.nan), place_sigma_m=np.full(size, 0.2),
        )  # fmt: skip
        gap = np.zeros(size, dtype=bool)
        gap[80:100] = True
        return without_epochs(epochs, gap), case.line, sensors
    if name == "faults":
        code, rate, joined = epochs.code_m.copy(), epochs.rate_mps.copy(), epochs.phase_joined.copy()
        code[random.random(code.shape) < 0.1] += 60.0
        rate[70:80, ::2] += 8.0
        code[100:, :4] = np.nan
        code[:, 6:][:40] = np.nan
        joined[random.random(code.shape) < 0.1] = False
        step = 299_792.458 * (np.arange(len(code)) >= 50)[:, None]
        epochs = replace(epochs, code_m=code + step, phase_m=epochs.phase_m + step, phase_joined=joined, rate_mps=rate)
    if name == "one wall":
        epochs = reflected(case, 80)
    if name == "off map":
        away = np.zeros(len(case.arc_m), dtype=bool)
        away[40:60] = away[:3] = True
        epochs = replace(epochs, off_map=away)
    if name == "gap":
        gap = np.zeros(len(case.arc_m), dtype=bool)
        gap[40:43] = gap[60:95] = True
        epochs = without_epochs(epochs, gap)
    return epochs, case.line, sensors


def _sensors_of(sensors: SensorEpochs | None, cut: slice) -> SensorEpochs | None:
    """Sensors at some of the epochs."""
    if sensors is None:
        return None
    values = {f.name: getattr(sensors, f.name) for f in fields(sensors)}
    return SensorEpochs(**{n: v[cut] if isinstance(v, np.ndarray) else v for n, v in values.items()})


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("name", ["sensors", "faults", "branches", "off map", "gap"])
@pytest.mark.every(3)
def test_epochs_one_by_one_give_what_the_whole_gives(name: str) -> None:
    epochs, line, sensors = _case(name)
    whole, _ = track(epochs, line, sensors=sensors, levels=True)
    state, parts = None, []
    for k in range(len(epochs)):
        one = slice(k, k + 1)
        result, state = track(part(epochs, one), line, state, sensors=_sensors_of(sensors, one), levels=True)
        parts.append(result)
    for name_of in ("arc_m", "sigma_m", "speed_mps", "probability", "wheel_scale", "level_m"):
        joined = np.concatenate([getattr(result, name_of) for result in parts])
        np.testing.assert_allclose(joined, getattr(whole, name_of), rtol=1e-6, atol=1e-9, err_msg=name_of)
    np.testing.assert_array_equal(np.concatenate([result.status for result in parts]), whole.status)


@pytest.mark.requirement("E5")
@pytest.mark.parametrize(("name", "first"), [("sensors", 55), ("faults", 67)])
@pytest.mark.every(2)
def test_as_plain_python_the_recursion_gives_the_same(name: str, first: int, monkeypatch: pytest.MonkeyPatch) -> None:
    epochs, line, sensors = _case(name)
    before, cut = slice(0, first), slice(first, first + 7)
    _, state = track(part(epochs, before), line, sensors=_sensors_of(sensors, before), levels=True)
    own = _sensors_of(sensors, cut)
    compiled, _ = track(part(epochs, cut), line, state, sensors=own, levels=True)
    monkeypatch.setattr("railfix.tracking.filter._kernel", lambda: plain("tracking.recursion").advance)
    found, _ = track(part(epochs, cut), line, state, sensors=own, levels=True)
    for field in fields(Tracked):
        one, other = getattr(found, field.name), getattr(compiled, field.name)
        if other.dtype.kind == "f":
            # a range of 2e7 m is rounded to 4e-9 m: 1e-7 of a weight
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6, err_msg=field.name)
        else:
            np.testing.assert_array_equal(one, other, err_msg=field.name)


def _design(rows: Any, work: Any, h: int) -> np.ndarray:
    """Design of codes, phases and Dopplers over the unknowns in use and those of an epoch."""
    nc, nph, nd, _ = (int(count) for count in rows.counts)
    width, size = work.mean.shape[1], nc + layout.COMBINED
    combine = np.zeros((size, width))
    share = work.share[h, :size] * work.root[h, :size, None]
    np.add.at(combine, (np.arange(size)[:, None], work.unknown[h, :size]), share)
    design = np.zeros((nc + nph + nd, size))
    design[np.arange(nc), np.arange(nc)] = design[:nc, nc] = 1.0
    for kind, first, count in ((layout.C_WAY, nc, nph), (layout.C_RIGHT, nc + nph, nd)):
        at = slice(first, first + count)
        design[at, nc + kind : nc + kind + 4] = work.design[h, at]
    return np.asarray(design @ combine)


def _dense_update(handed: Handover, recursion: Recursion, t: int, h: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of a hypothesis, innovations and variances."""
    rows, work = handed.rows, handed.work
    nc, nph, nd, _ = rows.counts.tolist()
    kinds = [(0, rows.codes[:nc]), (1, rows.phases[:nph]), (2, rows.dopplers[:nd])]
    variance = np.concatenate([recursion.epochs.variance[kind, t, channels] for kind, channels in kinds])
    return _design(rows, work, h), work.innovation[h, : nc + nph + nd], variance


@pytest.mark.requirement("E5", "C2")
@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="this machine has no numbers of 80 bits")
def test_the_update_of_each_sub_filter_keeps_its_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against 80 bits, from the start: without Dopplers the phase of one satellite alone tells of the drift."""
    case = ride(40, noise=1.0, seed=5)
    phase = np.where(np.arange(case.epochs.phase_m.shape[1]) == 0, case.epochs.phase_m, np.nan)
    advance = plain("tracking.recursion").advance
    names: dict[str, Any] = unwrap(advance).__globals__["advance_subfilters"].__globals__
    update, errors = names["_update"], list[float]()

    def updated(inputs: Any, t: int, rows: Any, best: int, work: Any, h: int) -> None:
        update(inputs, t, rows, best, work, h)
        design, prior = (a.astype(np.longdouble) for a in (_design(rows, work, h), work.spread[h]))
        variance = (work.masked[: len(design)] / work.weight[h, : len(design)]).astype(np.longdouble)
        prior, n = prior[: design.shape[1], : design.shape[1]], work.new_mean.shape[1] - 1
        for row, own in zip(design[np.isfinite(variance)], variance[np.isfinite(variance)], strict=True):
            gain = prior @ row  # one after the other: nothing is inverted
            prior = prior - np.outer(gain, gain) / (row @ gain + own)
        sigma = np.sqrt(np.diag(prior)[:n])
        difference = work.new_covariance[h][:n, :n] - prior[:n, :n]
        errors.append(float(np.abs(difference / np.outer(sigma, sigma)).max()))

    monkeypatch.setitem(names, "_update", updated)
    monkeypatch.setattr("railfix.tracking.filter._kernel", lambda: advance)
    track(part(replace(case.epochs, phase_m=phase), slice(0, 4)), case.line, levels=True)
    assert len(errors) > 20
    assert max(errors) < 1e-8


@pytest.mark.requirement("E5", "C6")
def test_with_normal_errors_the_update_is_kalmans_and_its_evidence_the_density() -> None:
    """Two hypotheses 5 m apart, one epoch of codes, phases and Dopplers."""
    limits = TrackingLimits(degrees_of_freedom=1e9, late_degrees_of_freedom=1e9)
    case = ride(30, noise=1.0, seed=3)
    _, state = track(part(case.epochs, slice(0, 20)), case.line, limits=limits)
    state.mean, state.covariance = np.repeat(state.mean, 2, axis=0), np.repeat(state.covariance, 2, axis=0)
    state.mean[1, 0] += 5.0
    state.covariance[:, :, 0] *= 0.3
    state.covariance[:, 0] *= 0.3
    state.log_scale = (0.0, 0.0)
    for name in ("log_probability", "log_code", "log_least", "log_recent", "origin_m"):
        setattr(state, name, np.repeat(getattr(state, name), 2) + np.log(0.5) * (name == "log_probability"))
    epochs = part(case.epochs, slice(20, 21))
    chunk = prepare_chunk(epochs, state, limits)
    recursion = Recursion(chunk, case.line, SensorEpochs(), limits, Tracked.empty(epochs.time, 10), levels=False)
    handed = Handover(recursion, state, 0, 1)
    assert handed.run(layout.WHOLE) == 1
    density, work = [], handed.work
    for h in range(2):
        design, value, variance = _dense_update(handed, recursion, 0, h)
        assert len(value) == 30
        prior = work.spread[h]
        innovation = design @ prior @ design.T + np.diag(variance)
        gain = prior @ design.T @ np.linalg.inv(innovation)
        n = len(handed.full)
        row = int(np.flatnonzero(work.kept[:2] == h)[0])
        np.testing.assert_allclose(handed.memory.mean[row], (work.mean[h] + gain @ value)[:n], rtol=1e-6, atol=1e-6)
        after = (prior - gain @ design @ prior)[:n, :n]
        np.testing.assert_allclose(handed.memory.covariance[row], after, rtol=1e-5, atol=1e-6)
        fitted = gain @ value, prior - gain @ design @ prior
        np.testing.assert_allclose(work.residual[h, :30], value - design @ fitted[0], atol=1e-5)
        np.testing.assert_allclose(work.fitted[h, :30], np.diagonal(design @ fitted[1] @ design.T), rtol=1e-4)
        density.append(-0.5 * (value @ np.linalg.solve(innovation, value) + np.linalg.slogdet(innovation)[1]))
    evidence = work.evidence[:2] + work.code_evidence[:2]
    assert abs(density[0] - density[1]) > 0.3
    assert evidence[0] - evidence[1] == pytest.approx(density[0] - density[1], abs=1e-4)


def _ranged(case: Ride, *, kept: float) -> SensorEpochs:
    """Ranges to two units beside the line, a share of them there."""
    random, size = np.random.default_rng(4), len(case.epochs)
    lever, age = np.array([1.0, 0.5, -1.0]), random.uniform(0.0, 0.5, (size, 2))
    points, axes = case.line.at(np.array([300.0, 600.0]))
    units = points + 10.0 * axes[:, 1]
    there, axes_there = case.line.at((case.arc_m[:, None] - age * case.speed_mps[:, None] + lever[0]).reshape(-1))
    antenna = there + lever[1] * axes_there[:, 1] + lever[2] * axes_there[:, 2]
    distance = np.linalg.norm(antenna.reshape(size, 2, 3) - units, axis=2) + 0.1 * random.normal(size=(size, 2))
    ranges = RangeEpochs(
        range_m=np.where(random.random((size, 2)) < kept, distance, np.nan),
        sigma_m=np.full((size, 2), 0.2),
        age_s=age,
        unit_ecef_m=np.repeat(units[None], size, axis=0),
        lever_m=lever,
    )
    return SensorEpochs(ranges=ranges)


@pytest.mark.requirement("E5", "E4")
def test_ranges_to_ground_units_give_the_place_to_decimetres() -> None:
    case = ride(60, noise=1.0, seed=5)
    found, state = track(case.epochs, case.line, sensors=_ranged(case, kept=0.6), levels=True)
    assert found.used[:, 3 + layout.RANGE_ROW].sum() > 40
    assert np.abs(found.arc_m - case.arc_m)[10:].max() < 0.4
    assert state.bank is not None
    assert "range" in state.bank.without
    alone, _ = track(case.epochs, case.line)
    assert found.sigma_m[20:].max() < 0.5 * alone.sigma_m[20:].min()


@pytest.mark.requirement("E5")
def test_a_wheel_and_phases_before_the_speed_is_known_are_regular() -> None:
    """Both measure the way, of which nothing is known beforehand, to centimetres."""
    case = ride(12, noise=1.0)
    way = np.diff(case.arc_m, prepend=np.nan)
    sensors = SensorEpochs(wheel_m=way, wheel_sigma_m=np.full(12, 0.02))
    found, state = track(case.epochs, case.line, sensors=sensors, levels=True)
    assert state.bank is not None
    assert np.isfinite(state.bank.mean).all()
    assert (found.level_m[2:] > found.level_noise_m[2:]).all()


@pytest.mark.requirement("E5", "C2")
def test_what_is_no_number_in_a_sub_filter_bounds_nothing_and_in_the_filter_begins_anew() -> None:
    case = ride(60, noise=1.0)
    _, state = track(part(case.epochs, slice(0, 30)), case.line, levels=True)
    assert state.bank is not None
    mean = state.bank.mean.copy()
    mean[2] = np.nan
    broken = replace(state, bank=replace(state.bank, mean=mean))
    found, _ = track(part(case.epochs, slice(30, 60)), case.line, broken, levels=True)
    assert found.level_m[0] == np.inf
    assert np.isfinite(found.level_m[20:]).all()
    lost = replace(state, mean=state.mean * np.nan)
    found, _ = track(part(case.epochs, slice(30, 60)), case.line, lost, levels=True)
    assert np.abs(found.arc_m - case.arc_m[30:])[-10:].max() < 4.0
    assert TrackStatus.TRACKING in found.status


def _made_epoch(counts: tuple[int, int, int, int]) -> tuple[layout.Rows, layout.Work, np.ndarray]:
    """Random measurements of an epoch in work space, and the covariance of what they are combinations of."""
    random, work = np.random.default_rng(7), work_space(1)
    rows = named_tuple(layout.Rows, counts=np.array(counts))
    size = counts[0] + layout.COMBINED + counts[3]
    mixed = random.normal(size=(size, 2 * size))
    covariance = mixed @ mixed.T
    work.root[0, :size] = np.sqrt(np.diagonal(covariance))
    work.own[0, :size, :size] = covariance / np.outer(work.root[0, :size], work.root[0, :size])
    work.information[0, :size, :size] = np.linalg.inv(work.own[0, :size, :size])
    work.design[:] = random.normal(size=work.design.shape)
    work.sensed[:] = random.normal(size=work.sensed.shape)
    work.value[:] = 20.0 * random.normal(size=work.value.shape) + 7.0
    work.variance[:] = random.uniform(1.0, 4.0, work.variance.shape)
    return rows, work, covariance


def _expected_weights(
    rows: layout.Rows,
    work: layout.Work,
    covariance: np.ndarray,
    degrees: tuple[float, float],
    free: tuple[float, float],
) -> np.ndarray:
    """Student's weights of innovations less the median of their kind, the clock of the kind known."""
    (nc, nph, nd, ns), (usual, late) = rows.counts.tolist(), degrees
    shift, d = work.value[0].copy(), work.design[0]
    kinds, first = np.split(np.arange(nc + nph + nd), [nc, nc + nph]), nc + 1
    for kind in kinds:
        shift[kind] -= np.median(shift[kind])
    way_right_up, right_up_speed = first + np.array([0, 2, 3]), first + np.array([2, 3, 4])
    spread = np.concatenate([
        np.diagonal(covariance)[:nc] + free[0] * d[kinds[0], 0] ** 2,
        [x[[0, 2, 3]] @ covariance[np.ix_(way_right_up, way_right_up)] @ x[[0, 2, 3]] + free[0] * x[0] ** 2
         for x in d[kinds[1]]],
        [x[:3] @ covariance[np.ix_(right_up_speed, right_up_speed)] @ x[:3] + free[1] * x[2] ** 2 for x in d[kinds[2]]],
        np.diagonal(covariance)[len(covariance) - ns :]
        + free[0] * work.sensed[0, :ns, 0] ** 2 + free[1] * work.sensed[0, :ns, 2] ** 2,
    ])  # fmt: skip
    size = len(spread)
    own = np.where((np.arange(size) < nc) & (shift[:size] > 0.0), late, usual)
    return (usual + 1.0) / usual * own / (own + shift[:size] ** 2 / (spread + work.variance[:size]))


@pytest.mark.requirement("E5")
def test_first_weights_are_students_with_the_clock_of_each_kind_known() -> None:
    rows, work, covariance = _made_epoch((4, 3, 4, 2))
    plain("tracking.update").first_weights(rows, work.variance, (4.0, 1.5), 50.0, 3.0, work, 0, 1)
    expected = _expected_weights(rows, work, covariance, (4.0, 1.5), (50.0, 3.0))
    np.testing.assert_allclose(work.weight[1, :13], expected, rtol=1e-9)


@pytest.mark.requirement("E5")
def test_a_second_start_sets_place_and_speed_free_by_their_own_variances(monkeypatch: pytest.MonkeyPatch) -> None:
    update, given, weights = plain("tracking.update"), parameters(TrackingLimits()), list[np.ndarray]()
    rows, work, covariance = _made_epoch((4, 3, 4, 2))
    reweight = update.reweight
    update.first_weights(rows, work.variance, given.degrees, 0.0, 0.0, work, 0, 0)
    work.log_after[0] = reweight(rows, work.variance, given.degrees, given.passes, work, 0, 0, 0)

    def reweighted(*arguments: Any) -> Any:
        weights.append(work.weight[1, :13].copy())
        return reweight(*arguments)

    monkeypatch.setattr(update, "reweight", reweighted)
    update.second_start(given, rows, work, 0, 1)
    free = FREEDOM_PLACE_M2, FREEDOM_SPEED_M2PS2
    np.testing.assert_allclose(weights[0], _expected_weights(rows, work, covariance, given.degrees, free), rtol=1e-9)
    place, speed = np.zeros(len(covariance)), np.zeros(len(covariance))
    place[:4], place[4 + layout.C_WAY], place[-2:] = work.design[0, :4, 0], 1.0, work.sensed[0, :2, 0]
    speed[4 + layout.C_SPEED], speed[-2:] = 1.0, work.sensed[0, :2, 2]
    freed = covariance + free[0] * np.outer(place, place) + free[1] * np.outer(speed, speed)
    root, found = work.root[0, : len(freed)], work.own[1, : len(freed), : len(freed)]
    upper = np.triu_indices(len(freed))
    np.testing.assert_allclose((found * np.outer(root, root))[upper], freed[upper], rtol=1e-9, atol=1e-9)


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("size", range(1, 12))
def test_factors_in_whole_vectors_are_those_of_numpy(size: int) -> None:
    algebra: Any = plain("tracking.algebra")
    random = np.random.default_rng(size)
    root, right = random.normal(size=(size, size)), random.normal(size=(size, 5))
    wide = np.zeros((2, size, 16))
    matrix = wide[1, :, :size] = root @ root.T + np.eye(size)
    factor, inverse, pivots = np.full((12, 16), np.nan), np.full((1, 12, 16), np.nan), np.ones((3, 16))
    lower = np.concatenate([np.zeros((16, 16)), np.eye(17, 16)])
    algebra.invert(wide, 1, size, factor, pivots, lower, inverse, 0)
    solved = np.zeros((size, 8))
    solved[:, :5] = right
    algebra.solve_forward(factor, size, pivots, solved)
    determinant = algebra.log_determinant(pivots, size)
    np.testing.assert_allclose(determinant, np.linalg.slogdet(matrix)[1], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(inverse[0, :size, :size], np.linalg.inv(matrix), rtol=1e-9, atol=1e-12)
    back = np.triu(factor[:size, :size]).T @ (pivots[0, :size, None] * solved[:, :5])
    np.testing.assert_allclose(back, right, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size", [1, 2, 5, 8])
def test_the_median_of_a_part_of_a_row_is_that_of_numpy(size: int) -> None:
    values = np.random.default_rng(size).normal(size=(3, 12))
    found = plain("tracking.algebra").median(values, 1, 2, size, np.empty(12))
    assert found == pytest.approx(np.median(values[1, 2 : 2 + size]), abs=1e-15)


@pytest.mark.requirement("E5")
def test_unknowns_that_nothing_measures_walk_all_the_time() -> None:
    """Clocks without a satellite and sensors that are not on board: their variances grow as those in use would."""
    case, limits = ride(60), TrackingLimits()
    _, before = track(part(case.epochs, slice(0, 30)), case.line)
    _, after = track(part(case.epochs, slice(30, 60)), case.line, before)
    growth = np.diagonal(after.covariance[0] - before.covariance[0])
    walks = {
        StateIndex.WHEEL: WHEEL_WALK, StateIndex.RADAR: RADAR_WALK, StateIndex.FORCE_OFFSET: FORCE_WALK_MPS2,
    } | {OFFSETS + CLOCKS.index(letter): limits.offset_walk_m for letter in "CRI"}  # fmt: skip
    for unknown, walk in walks.items():
        assert growth[unknown] == pytest.approx(30.0 * walk**2, rel=1e-6)


@pytest.mark.requirement("C6")
def test_sub_filters_coast_with_the_scale_of_the_map_too() -> None:
    """Lengths along a map that was found to be wrong add as much variance to each of them as to the filter."""
    case = ride(60)
    _, state = track(part(case.epochs, slice(0, 50)), case.line, levels=True)
    nothing = without_epochs(part(case.epochs, slice(50, 60)), np.ones(10, dtype=bool))
    own, banks = [], []
    for log_variance in (0.0, 5.0):
        _, after = track(nothing, case.line, copy_with(state, map_log_variance=log_variance), levels=True)
        assert after.bank is not None
        assert len(after.bank.without) > 10
        own.append(after.covariance[0, StateIndex.ARC, StateIndex.ARC])
        banks.append(after.bank.covariance[:, StateIndex.ARC, StateIndex.ARC])
    assert own[1] - own[0] > 0.5
    np.testing.assert_allclose(banks[1] - banks[0], own[1] - own[0], rtol=0.02)


@pytest.mark.requirement("E5")
def test_velocities_by_phases_or_dopplers_are_those_of_each_epoch_alone() -> None:
    """Eight places of the Earth; phases at every second epoch, Dopplers at all."""
    random, count = np.random.default_rng(6), 8
    latitude, longitude = np.full(count, 35.0), np.linspace(-150.0, 150.0, count)
    near, axes = ecef_from_geodetic(latitude, longitude, 40.0), enu_axes(latitude, longitude)
    local = random.normal(size=(count, 9, 3))
    local[..., 2] = np.abs(local[..., 2]) + 0.3
    local /= np.linalg.norm(local, axis=2, keepdims=True)
    sat = near[:, None] + 2.3e7 * local @ axes
    motion = 12.0 * axes[:, 0] + 5.0 * axes[:, 1]
    ranges = [range_with_rotation(sat, (near + ahead * motion)[:, None])[0] for ahead in (-0.5, 0.0, 1e-3)]
    measured = np.stack([ranges[1], ranges[1] - ranges[0] + 3.0, (ranges[2] - ranges[1]) / 1e-3 + 6.0])
    has = np.ones(measured.shape, dtype=bool)
    has[1, 1::2] = False
    variance = np.full(measured.shape, 1e-4)
    given = [near, sat, np.zeros(sat.shape), sat, measured, has, variance, np.full(count, 0.5)]
    whole = compute_velocity(*given)  # type: ignore[arg-type]
    np.testing.assert_allclose(whole.velocity_mps, motion, atol=0.02)
    np.testing.assert_array_equal(whole.age_s, [0.25, 0.0] * 4)
    for t in range(count):
        rows = [slice(t, t + 1) if len(a) == count else np.s_[:, t : t + 1] for a in given]
        alone = compute_velocity(*(a[row] for a, row in zip(given, rows, strict=True)))  # type: ignore[arg-type]
        np.testing.assert_allclose(alone.velocity_mps[0], whole.velocity_mps[t], atol=1e-9)
        np.testing.assert_allclose(alone.covariance[0], whole.covariance[t], rtol=1e-9)
