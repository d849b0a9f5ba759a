"""The recursion of the filter: compiled and as plain Python, epoch by epoch, against Kalman's update and densities."""

from __future__ import annotations

from dataclasses import fields, replace
from inspect import unwrap
from typing import Any

import numpy as np
import pytest

from plain_kernels import named_tuple, plain
from railfix.core.arrays import copy_with
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, range_with_rotation
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking import layout, velocity
from railfix.kernels.tracking.constants import (
    FORCE_WALK_MPS2,
    FREEDOM_PLACE_M2,
    FREEDOM_SPEED_M2PS2,
    OFFSET_WALK_M,
    RADAR_WALK,
    WHEEL_WALK,
)
from railfix.tracking import GnssEpochs, Line, RangeEpochs, SensorEpochs, Tracked, TrackingLimits, TrackStatus, track
from railfix.tracking.chunk import prepare_chunk
from railfix.tracking.filter import Recursion
from railfix.tracking.packing import pack_state
from railfix.tracking.state import Monitors
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
@pytest.mark.every(5)
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
@pytest.mark.every(4)
def test_as_plain_python_the_recursion_gives_the_same(name: str, first: int, monkeypatch: pytest.MonkeyPatch) -> None:
    epochs, line, sensors = _case(name)
    before, cut = slice(0, first), slice(first, first + 7)
    _, state = track(part(epochs, before), line, sensors=_sensors_of(sensors, before), levels=True)
    own = _sensors_of(sensors, cut)
    compiled, _ = track(part(epochs, cut), line, state, sensors=own, levels=True)
    monkeypatch.setattr("railfix.kernels.tracking.recursion.advance", plain("tracking.recursion").advance)
    found, _ = track(part(epochs, cut), line, state, sensors=own, levels=True)
    for field in fields(Tracked):
        one, other = getattr(found, field.name), getattr(compiled, field.name)
        if other.dtype.kind == "f":
            # a range of 2e7 m is rounded to 4e-9 m: 1e-7 of a weight
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6, err_msg=field.name)
        else:
            np.testing.assert_array_equal(one, other, err_msg=field.name)


def _design(rows: Any, equations: Any, unknowns: int) -> np.ndarray:
    """Measurement matrix of all measurements over the unknowns."""
    codes, size = rows.code.stop, len(equations.unknown)
    quantities = np.zeros((size, unknowns))
    np.add.at(quantities, (np.arange(size)[:, None], equations.unknown), equations.coefficient)
    moving = equations.design[codes : rows.sensor.start] @ quantities[codes : codes + ix.MOTION]
    return np.concatenate([quantities[:codes], moving, quantities[codes + ix.MOTION :]])


@pytest.mark.requirement("E5", "C2")
@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="this machine has no numbers of 80 bits")
def test_the_update_of_each_sub_filter_keeps_its_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against 80 bits, from the start: without Dopplers the phase of one satellite alone tells of the drift."""
    case = ride(40, noise=1.0, seed=5)
    phase = np.where(np.arange(case.epochs.phase_m.shape[1]) == 0, case.epochs.phase_m, np.nan)
    advance = plain("tracking.recursion").advance
    names: dict[str, Any] = unwrap(advance).__globals__["advance_subfilters"].__globals__
    correct_state, errors = names["correct_state"], list[float]()

    def corrected(rows: Any, equations: Any, variance: Any, weight: Any, x: Any, P: Any) -> None:
        design, prior = (a.astype(np.longdouble) for a in (_design(rows, equations, len(x)), P))
        correct_state(rows, equations, variance, weight, x, P)
        own = (variance / weight).astype(np.longdouble)
        for row, noise in zip(design[np.isfinite(own)], own[np.isfinite(own)], strict=True):
            gain = prior @ row  # one after the other, without phases and Dopplers compressed
            prior = prior - np.outer(gain, gain) / (row @ gain + noise)
        sigma = np.sqrt(np.diag(prior))
        errors.append(float(np.abs((P - prior) / np.outer(sigma, sigma)).max()))

    monkeypatch.setitem(names, "correct_state", corrected)
    monkeypatch.setattr("railfix.kernels.tracking.recursion.advance", advance)
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
    state.monitors = replace(state.monitors, log_doppler_scale=0.0, log_phase_scale=0.0)
    state.hypothesis = np.repeat(state.hypothesis, 2)
    state.hypothesis["log_probability"] += np.log(0.5)
    epochs, recursion = part(case.epochs, slice(20, 21)), plain("tracking.recursion")
    chunk = prepare_chunk(epochs, state, limits)
    given = Recursion(chunk, case.line, SensorEpochs(), limits, state, levels=False).given
    packed = pack_state(state, limits, levels=False)
    recursion._predict_all(given, 0, packed)
    rows = plain("tracking.measurements").choose_measurements(given, 0, packed)
    assert rows.sensor.stop == 30
    density, evidence = [], []
    for one in recursion._correct_hypotheses(given, 0, packed, rows)[0]:
        design, prior, value = _design(rows, one.equations, len(one.x)), one.P_prior, one.innovation
        innovation = design @ prior @ design.T + np.diag(rows.variance)
        gain = prior @ design.T @ np.linalg.inv(innovation)
        np.testing.assert_allclose(one.x, one.x_prior + gain @ value, rtol=1e-6, atol=1e-6)
        left = np.eye(len(prior)) - gain @ design
        after = left @ prior @ left.T + gain * rows.variance @ gain.T  # Joseph's form keeps its digits
        np.testing.assert_allclose(one.P, after, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(one.fit.residual, value - design @ gain @ value, atol=1e-5)
        np.testing.assert_allclose(one.fit.fitted, np.diagonal(design @ after @ design.T), rtol=1e-4)
        density.append(-0.5 * (value @ np.linalg.solve(innovation, value) + np.linalg.slogdet(innovation)[1]))
        evidence.append(sum(recursion.compute_evidence(rows, one)))
    assert abs(density[0] - density[1]) > 0.3
    assert evidence[0] - evidence[1] == pytest.approx(density[0] - density[1], abs=1e-4)


@pytest.mark.requirement("E5", "C2")
def test_an_innovation_falls_by_what_its_row_gives_to_a_change_of_the_mean() -> None:
    """All measurements, the error of a length of the map among the unknowns: a map aside turns into it in a bend."""
    epochs, line, sensors = _case("sensors")
    before, cut, limits = slice(0, 55), slice(55, 56), TrackingLimits()
    _, state = track(part(epochs, before), line, sensors=_sensors_of(sensors, before))
    own = _sensors_of(sensors, cut)
    assert own is not None
    chunk = prepare_chunk(part(epochs, cut), state, limits)
    given = Recursion(chunk, line, own, limits, state, levels=False).given
    packed = pack_state(state, limits, levels=False)
    plain("tracking.recursion")._predict_all(given, 0, packed)
    rows, module = plain("tracking.measurements").choose_measurements(given, 0, packed), plain("tracking.equations")
    assert rows.sensor.stop > rows.sensor.start
    x, step = packed.x[0], 0.01
    at, found = (x[ix.ARC], x[ix.PREVIOUS_ARC]), module.new_equations(rows)
    module.linearise(given, 0, rows, x, at, 1.0, found)
    design = _design(rows, found, len(x))
    for unknown in range(len(x)):
        moved, other = x.copy(), module.new_equations(rows)
        moved[unknown] += step
        module.linearise(given, 0, rows, moved, at, 1.0, other)
        change = -step * design[:, unknown]
        np.testing.assert_allclose(other.value - found.value, change, rtol=1e-4, atol=2e-8, err_msg=str(unknown))


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
    assert found.used[:, 3 + ix.RANGE_COLUMN].sum() > 40
    assert np.abs(found.arc_m - case.arc_m)[10:].max() < 0.4
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
    assert np.isfinite(state.bank.mean).all()
    assert (found.level_m[2:] > found.level_noise_m[2:]).all()


@pytest.mark.requirement("E5", "C2")
def test_what_is_no_number_in_a_sub_filter_bounds_nothing_and_in_the_filter_begins_anew() -> None:
    case = ride(60, noise=1.0)
    _, state = track(part(case.epochs, slice(0, 30)), case.line, levels=True)
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


#: Degrees of freedom of the errors of made measurements, and of late codes.
DEGREES = (4.0, 1.5)


def _made_epoch() -> tuple[Any, Any]:
    """Random measurements, 4 codes, 3 phases, 4 Dopplers, 2 sensors, and a correction without weights."""
    random, update, size = np.random.default_rng(7), plain("tracking.update"), 4 + ix.MOTION + 2
    rows = named_tuple(
        layout.Rows, code=slice(0, 4), phase=slice(4, 7), doppler=slice(7, 11), sensor=slice(11, 13),
        variance=random.uniform(1.0, 4.0, 13), degrees=DEGREES[0], late_degrees=DEGREES[1],
    )  # fmt: skip
    index = np.full((size, ix.TERMS), ix.WHEEL)
    index[:, 0], index[:, 1] = ix.ARC, ix.SPEED
    coefficient, design = random.normal(size=index.shape), np.zeros((13, ix.MOTION))
    design[4:7, :4], design[7:11, 2:] = random.normal(size=(3, 4)), random.normal(size=(4, 4))
    equations = update.Equations(index, coefficient, design, 20.0 * random.normal(size=13) + 7.0)
    mixed = random.normal(size=(30, 60))
    prior = mixed @ mixed.T
    covariance, without_clock = update.predict_quantities(prior, equations)
    one = named_tuple(
        update.Correction, equations=equations, P_prior=prior, covariance=covariance, fit=update.new_fit(rows),
        without_clock=without_clock,
    )  # fmt: skip
    return rows, one


def _expected_weights(rows: Any, one: Any, covariance: np.ndarray, without_clock: np.ndarray) -> np.ndarray:
    """Student's weights of innovations less the median of their kind, the clock of the kind known."""
    shift, (usual, late) = one.equations.value.copy(), DEGREES
    for kind in (rows.code, rows.phase, rows.doppler):
        shift[kind] -= np.median(shift[kind])
    spread = np.concatenate([without_clock[:4], np.zeros(7), without_clock[-2:]])
    for kind, clock in ((rows.phase, ix.M_CLOCK), (rows.doppler, ix.M_DRIFT)):
        known = np.delete(np.arange(ix.MOTION), clock)
        design = one.equations.design[kind][:, known]
        spread[kind] = np.diagonal(design @ covariance[np.ix_(4 + known, 4 + known)] @ design.T)
    own = np.where((np.arange(13) < 4) & (shift > 0.0), late, usual)
    return np.asarray((usual + 1.0) / usual * own / (own + shift**2 / (spread + rows.variance)))


@pytest.mark.requirement("E5")
def test_first_weights_are_students_with_the_clock_of_each_kind_known() -> None:
    rows, one = _made_epoch()
    expected = one.covariance, one.without_clock
    plain("tracking.update").write_first_weights(rows, one.equations, expected, rows.variance, one.fit.weight)
    np.testing.assert_allclose(one.fit.weight, _expected_weights(rows, one, *expected), rtol=1e-9)


@pytest.mark.requirement("E5")
def test_a_second_fit_sets_place_and_speed_free_by_their_own_variances(monkeypatch: pytest.MonkeyPatch) -> None:
    (rows, one), evidence = _made_epoch(), plain("tracking.update")
    weights, covariances, reweight = list[np.ndarray](), list[np.ndarray](), evidence.reweight
    reweight(rows, one.equations, one.covariance, rows.variance, one.fit)

    def reweighted(rows: Any, equations: Any, covariance: Any, *others: Any) -> None:
        weights.append(others[-1].weight.copy())
        covariances.append(covariance)
        reweight(rows, equations, covariance, *others)

    monkeypatch.setattr(evidence, "reweight", reweighted)
    evidence.refit_inflated_prior(rows, one)
    place, speed = one.equations.coefficient[:, 0], one.equations.coefficient[:, 1]
    inflated = one.covariance + FREEDOM_PLACE_M2 * np.outer(place, place) + FREEDOM_SPEED_M2PS2 * np.outer(speed, speed)
    without_clock = one.without_clock + FREEDOM_PLACE_M2 * place**2 + FREEDOM_SPEED_M2PS2 * speed**2
    np.testing.assert_allclose(covariances[0], inflated, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(covariances[1], one.covariance)
    np.testing.assert_allclose(weights[0], _expected_weights(rows, one, inflated, without_clock), rtol=1e-9)


@pytest.mark.requirement("E5")
def test_six_rows_are_equivalent_to_all_phases_and_dopplers() -> None:
    """Corrected quantities, determinant and distance against one system of all measurements, not compressed."""
    rows, one = _made_epoch()
    plain("tracking.update").fit(rows, one.equations, one.covariance, rows.variance, one.fit)
    design = np.zeros((13, 4 + ix.MOTION + 2))
    design[:4, :4], design[4:11, 4:10], design[11:, 10:] = np.eye(4), one.equations.design[4:11], np.eye(2)
    innovation = design @ one.covariance @ design.T + np.diag(rows.variance)
    fitted = one.covariance @ design.T @ np.linalg.solve(innovation, one.equations.value)
    np.testing.assert_allclose(one.fit.residual, one.equations.value - design @ fitted, rtol=0, atol=1e-9)
    after = one.covariance - one.covariance @ design.T @ np.linalg.solve(innovation, design @ one.covariance)
    np.testing.assert_allclose(one.fit.fitted, np.diagonal(design @ after @ design.T), rtol=1e-9)
    determinant = np.linalg.slogdet(innovation)[1] - np.log(rows.variance).sum()
    distance = fitted @ np.linalg.solve(one.covariance, fitted)
    np.testing.assert_allclose([one.fit.log_determinant[0], one.fit.distance[0]], [determinant, distance], rtol=1e-9)


@pytest.mark.requirement("E5")
def test_unknowns_that_nothing_measures_walk_all_the_time() -> None:
    """Clocks without a satellite and sensors that are not on board: their variances grow as those in use would."""
    case = ride(60)
    _, before = track(part(case.epochs, slice(0, 30)), case.line)
    _, after = track(part(case.epochs, slice(30, 60)), case.line, before)
    growth = np.diagonal(after.covariance[0] - before.covariance[0])
    walks = {
        ix.WHEEL: WHEEL_WALK, ix.RADAR: RADAR_WALK, ix.FORCE_OFFSET: FORCE_WALK_MPS2,
    } | {ix.OFFSETS + ix.CLOCKS.index(letter): OFFSET_WALK_M for letter in "CRI"}  # fmt: skip
    for unknown, walk in walks.items():
        assert growth[unknown] == pytest.approx(30.0 * walk**2, rel=1e-6)


@pytest.mark.requirement("C6")
def test_codes_that_are_left_out_do_not_hide_that_the_others_contradict_the_position() -> None:
    """Five of ten codes are left out, with the weight of a perfect fit; the others have almost none."""
    left_out = np.arange(12) % 2 == 0
    left_out[10:] = False
    rows = named_tuple(layout.Rows, code=slice(0, 10), doppler=slice(11, 12), left_out=left_out)
    weight = np.where(left_out, 1.25, 0.1)
    weight[10:] = 0.7, 0.9
    variance = np.ones(12)
    code, motion = plain("tracking.update").mean_weights(rows, variance, weight)
    assert (code, motion) == pytest.approx((0.1, 0.8))
    variance[1:10:2] = np.inf
    assert np.isnan(plain("tracking.update").mean_weights(rows, variance, weight)[0])


@pytest.mark.requirement("E5")
def test_a_position_off_in_a_curve_displaces_across() -> None:
    """10 m of travel on a radius of 573 m: the tangents differ by 10 / 573 to the right, for each metre."""
    line = Line(bent_line(1800.0, turn_deg=60.0))  # 60 degrees on 600 m
    vertex, whole = line.records
    for sigma_m, counted_m in ((4.0, 4.0), (500.0, 30.0)):  # a position is never more uncertain than at a start
        P = np.diag(np.full(ix.SATELLITES, 1e-8))
        P[ix.ARC, ix.ARC] = sigma_m**2
        given = named_tuple(layout.Given, vertex=vertex, line=whole)
        plain("tracking.model").add_bend(given, (910.0, 900.0), P)
        assert np.sqrt(P[ix.STEP_RIGHT, ix.STEP_RIGHT]) == pytest.approx(counted_m * 10.0 * np.pi / 1800.0, rel=0.01)
        assert np.sqrt(P[ix.STEP_UP, ix.STEP_UP]) < 2e-3


@pytest.mark.requirement("C6")
def test_sub_filters_coast_with_the_scale_of_the_map_too() -> None:
    """Lengths along a map that was found to be wrong add as much variance to each of them as to the filter."""
    case = ride(60)
    _, state = track(part(case.epochs, slice(0, 50)), case.line, levels=True)
    nothing = without_epochs(part(case.epochs, slice(50, 60)), np.ones(10, dtype=bool))
    own, banks = [], []
    for log_variance in (0.0, 5.0):
        before = copy_with(state, monitors=Monitors(map_log_variance=log_variance))
        _, after = track(nothing, case.line, before, levels=True)
        assert len(after.bank.without) > 10
        own.append(after.covariance[0, ix.ARC, ix.ARC])
        banks.append(after.bank.covariance[:, ix.ARC, ix.ARC])
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
    measured = np.stack([ranges[1], ranges[1] - ranges[0] + 3.0, (ranges[2] - ranges[1]) / 1e-3 + 6.0], axis=-1)
    made = []
    for module in (velocity, plain("tracking.velocity")):
        epoch, channel = np.zeros(count, dtype=layout.EPOCH), np.zeros((count, 9), dtype=layout.CHANNEL)
        channel["sat_ecef_m"] = channel["before_ecef_m"] = sat
        channel["measured"], channel["has"], channel["variance"], epoch["interval_s"] = measured, 1, 1e-4, 0.5
        channel["has"][1::2, :, 1] = 0
        module.write_velocities(epoch, channel, near, np.ascontiguousarray(axes[:, 2]))
        made.append(epoch)
    np.testing.assert_allclose(made[0]["velocity_mps"], motion, atol=0.02)
    np.testing.assert_array_equal(made[0]["velocity_age_s"], [0.25, 0.0] * 4)
    for name in ("velocity_mps", "velocity_covariance"):
        np.testing.assert_allclose(made[0][name], made[1][name], rtol=1e-6, atol=1e-9)  # from a prior of 1e6 (m/s)2


def _coming_and_going(case: Ride) -> GnssEpochs:
    """Each satellite is there at three of five epochs, drawn anew at every epoch, phases at half of them."""
    random = np.random.default_rng(11)
    there, joined = random.random(case.epochs.code_m.shape) < 0.6, random.random(case.epochs.code_m.shape) < 0.5
    values = {name: np.where(there, getattr(case.epochs, name), np.nan) for name in ("code_m", "phase_m", "rate_mps")}
    return replace(case.epochs, **values, phase_joined=case.epochs.phase_joined & joined)


@pytest.mark.requirement("E5", "A8")
@pytest.mark.parametrize("how", ["one by one", "in chunks", "permuted"])
def test_satellites_that_come_and_go_at_every_epoch_give_the_same_however_they_are_handed_over(how: str) -> None:
    case = ride(90, noise=1.0, seed=12)
    epochs = _coming_and_going(case)
    whole, _ = track(epochs, case.line, levels=True)
    order, sizes = np.arange(10), {"one by one": 1, "in chunks": 7, "permuted": 90}[how]
    if how == "permuted":
        order = np.random.default_rng(2).permutation(10)
        values = {f.name: getattr(epochs, f.name) for f in fields(epochs)}
        values = {
            name: value[order] if name in ("satellite", "clock") else value[:, order]
            for name, value in values.items()
            if name in ("satellite", "clock") or (value is not None and value.shape[1:2] == (10,))
        }
        epochs = replace(epochs, **values)
    state, parts = None, []
    for first in range(0, 90, sizes):
        result, state = track(part(epochs, slice(first, first + sizes)), case.line, state, levels=True)
        parts.append(result)
    for name in ("arc_m", "sigma_m", "speed_mps", "level_m", "separation_m"):
        joined = np.concatenate([getattr(result, name) for result in parts])
        np.testing.assert_allclose(joined, getattr(whole, name), rtol=0.0, atol=1e-6, err_msg=name)
    weights = np.concatenate([result.weight for result in parts])
    np.testing.assert_allclose(weights, whole.weight[:, :, order], rtol=0.0, atol=1e-6)
    np.testing.assert_array_equal(np.concatenate([result.status for result in parts]), whole.status)
    assert np.abs(whole.arc_m - case.arc_m)[30:].max() < 5.0
