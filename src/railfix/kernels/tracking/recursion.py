"""Recursion of the along-track filter over epochs.

The steps of an epoch are: predict, choose measurements, correct each hypothesis, reweigh hypotheses, adapt the state,
correct the sub-filters, monitor, prune, and write level and status. The position search (`railfix.tracking.search`)
takes place outside the recursion, between prediction and update of an epoch.
"""

from __future__ import annotations

import math

import numpy as np

from railfix.kernels.compiling import inner, kernel
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.adaptation import adapt, compute_code_shift
from railfix.kernels.tracking.equations import find_wheel_sign, linearise, new_equations
from railfix.kernels.tracking.hypotheses import find_leading, prune, reweigh
from railfix.kernels.tracking.layout import Given, Results, Rows, State, Trace
from railfix.kernels.tracking.level import bound_speed, find_other_positions, widen_slow_code, write_level
from railfix.kernels.tracking.line import excess_beyond_end, wrap_arc, write_point
from railfix.kernels.tracking.measurements import choose_measurements, start_clocks
from railfix.kernels.tracking.model import add_bend, narrow_speed_range, predict, restart
from railfix.kernels.tracking.monitors import compute_contradiction, update_monitors
from railfix.kernels.tracking.subfilters import advance_subfilters, find_other
from railfix.kernels.tracking.update import (
    Correction,
    compute_evidence,
    correct_state,
    mean_weights,
    new_fit,
    predict_quantities,
    refit_inflated_prior,
    reweight,
    write_first_weights,
)


@inner
def _find_search_reasons(given: Given, t: int, state: State) -> int:
    """Return the reasons for a position search before an epoch, as bits (`index.LOST_TRACK`, ...); 0 for none."""
    epoch, parameters, monitors = given.epoch[t], given.parameters[0], state.monitors[0]
    lost = monitors.weak_motion_s >= constants.LOST_MOTION_S or monitors.weak_code_s >= constants.LOST_CODE_S
    lost = lost or monitors.contradiction >= constants.CONTRADICTION_LOST
    doubtful = monitors.weak_motion_s >= constants.BESIDE_AFTER_S
    doubtful = doubtful or monitors.contradiction >= constants.CONTRADICTION_DOUBT
    doubtful = doubtful or monitors.motion_misfit > 1.0 - constants.MOTION_FIT
    doubtful = doubtful and monitors.measured_s > epoch.time_s - 1.5 * epoch.interval_s
    gap = epoch.coded and epoch.time_s - monitors.measured_s > constants.GAP_S
    doubtful = doubtful and monitors.hypotheses <= parameters.most_hypotheses // 2
    return (ix.LOST_TRACK if lost else 0) | (ix.GAP if gap else 0) | (ix.CONTRADICTED if doubtful else 0)


@inner
def _reset_code_errors(given: Given, t: int, state: State) -> None:
    """Restart the code errors of satellites that come into view."""
    for i in range(given.fresh.shape[1]):
        if given.fresh[t, i]:
            state.code_bias[i] = 0.0
            for row in range(len(state.x)):
                state.x[row, ix.SATELLITES + i] = 0.0
                restart(state.P[row], ix.SATELLITES + i, 1.0)


@inner
def _wrap_closed_line(given: Given, state: State) -> None:
    """Shift positions beyond an end of a closed line by a lap."""
    for h in range(state.monitors[0].hypotheses):
        back = wrap_arc(given.vertex, given.line[0], state.x[h, ix.ARC]) - state.x[h, ix.ARC]
        if back != 0.0:
            state.x[h, ix.ARC] += back
            state.hypothesis[h].origin_m += back
            if h == 0:
                state.x[len(state.hypothesis) :, ix.ARC] += back


@inner
def _predict_all(given: Given, t: int, state: State) -> None:
    """Predict all hypotheses and sub-filters."""
    monitors, first, scratch = state.monitors[0], len(state.hypothesis), np.empty(state.P.shape[1:])
    for h in range(monitors.hypotheses):
        predict(given, t, state.x[h], state.P[h], monitors.map_log_variance, 0.0, scratch)
    for b in range(len(state.source)):
        if state.source[b].running:
            wrong_m = given.parameters[0].level_map_m if b == find_other(state, ix.WRONG_MAP) else 0.0
            predict(given, t, state.x[first + b], state.P[first + b], monitors.map_log_variance, wrong_m, scratch)


@inner
def _start_correction(given: Given, t: int, state: State, rows: Rows, h: int) -> Correction:
    """Return the initial state of the correction of a predicted hypothesis: its equations and innovations, not yet
    fitted.
    """
    x, P, equations = state.x[h].copy(), state.P[h].copy(), new_equations(rows)
    restarted = np.zeros(len(x), dtype=np.bool_)
    sign = find_wheel_sign(x, state.monitors[0].direction)
    linearise(given, t, rows, x, (x[ix.ARC], x[ix.PREVIOUS_ARC]), sign, equations)
    add_bend(given, (x[ix.ARC], x[ix.PREVIOUS_ARC]), P)
    start_clocks(given, t, rows, state.offset_known, x, P, equations, restarted)
    covariance, without_clock = predict_quantities(P, equations)
    return Correction(
        x, P, equations, covariance, without_clock, new_fit(rows), equations.value.copy(), restarted, x.copy(), P.copy()
    )


@inner
def _correct_hypotheses(given: Given, t: int, state: State, rows: Rows) -> tuple[list[Correction], float]:
    """Return the corrections of all hypotheses, and the code shift of the one leading so far.

    Linearisation and correction are repeated while a corrected position moves by at least `MOVED_M`.
    """
    count = state.monitors[0].hypotheses
    corrections = [_start_correction(given, t, state, rows, h) for h in range(count)]
    for one in corrections:
        expected = one.covariance, one.without_clock
        write_first_weights(rows, one.equations, expected, rows.variance, one.fit.weight)
    reported = corrections[find_leading(state.hypothesis, count)]
    shift = compute_code_shift(rows, reported.equations, reported.covariance, reported.fit.weight)
    doubtful = False
    for one in corrections:
        reweight(rows, one.equations, one.covariance, rows.variance, one.fit)
        code, motion = mean_weights(rows, rows.variance, one.fit.weight)
        doubtful = doubtful or code < constants.WEAK_FIT or motion < constants.WEAK_FIT
    furthest = 0.0
    for one in corrections:
        if doubtful:
            refit_inflated_prior(rows, one)
        correct_state(rows, one.equations, rows.variance, one.fit.weight, one.x, one.P)
        furthest = max(furthest, abs(one.x[ix.ARC] - one.x_prior[ix.ARC]))
    for _ in range(constants.RELINEARISED):
        if furthest < constants.MOVED_M:
            break
        furthest = 0.0
        for one in corrections:
            furthest = max(furthest, _relinearise(given, t, state, rows, one))
    return corrections, shift


@inner
def _relinearise(given: Given, t: int, state: State, rows: Rows, one: Correction) -> float:
    """Repeat the correction, with equations linearised at the corrected position; return its change [m]."""
    arc, sign = one.x[ix.ARC], find_wheel_sign(one.x_prior, state.monitors[0].direction)
    linearise(given, t, rows, one.x_prior, (arc, one.x[ix.PREVIOUS_ARC]), sign, one.equations)
    covariance, without_clock = predict_quantities(one.P_prior, one.equations)
    one.covariance[:], one.without_clock[:] = covariance, without_clock
    reweight(rows, one.equations, covariance, rows.variance, one.fit)
    one.x[:], one.P[:] = one.x_prior, one.P_prior
    correct_state(rows, one.equations, rows.variance, one.fit.weight, one.x, one.P)
    return float(abs(one.x[ix.ARC] - arc))


@inner
def _reweigh_hypotheses(given: Given, t: int, state: State, rows: Rows, corrections: list[Correction]) -> None:
    """Update the probabilities of hypotheses with the evidence of an epoch."""
    count = len(corrections)
    motion, code, arc = np.empty(count), np.empty(count), np.empty(count)
    points, axes = np.empty((count, 3)), np.empty((3, 3))
    for h in range(count):
        motion[h], code[h] = compute_evidence(rows, corrections[h])
        arc[h] = corrections[h].x[ix.ARC]
        write_point(given.vertex, given.line[0], arc[h], points[h], axes)
    reweigh(given.parameters[0], state, motion, code, points, arc, given.epoch[t].interval_s)


@inner
def _commit_update(given: Given, t: int, state: State, rows: Rows, corrections: list[Correction], shift: float) -> int:
    """Store the corrected hypotheses, adapt the state, correct sub-filters, monitor; return the leading hypothesis."""
    monitors = state.monitors[0]
    for h, one in enumerate(corrections):
        state.x[h], state.P[h] = one.x, one.P
    monitors.measured_s = given.epoch[t].time_s
    if rows.code.stop > 0:
        monitors.coded_s = given.epoch[t].time_s
    for j in range(rows.code.start, rows.code.stop):
        state.offset_known[given.channel[t, rows.channel[j]].clock] = True
    leading = find_leading(state.hypothesis, len(corrections))
    best = corrections[leading]
    implied = 0.0 if leading != 0 else shift
    excluded = adapt(given, t, state, rows, best.fit, best.innovation, implied)
    if len(state.source):
        advance_subfilters(given, t, state, rows, best, leading)
    # the codes of the newly excluded satellite have affected the position so far
    if excluded and abs(shift) < constants.INFLATED_SIGMAS:
        state.P[:, ix.ARC, ix.ARC] += constants.INFLATED_M**2
    contradiction = compute_contradiction(given, t, state, leading)
    beyond_m = excess_beyond_end(given.line[0], best.x[ix.ARC], math.sqrt(best.P[ix.ARC, ix.ARC]))
    update_monitors(state, contradiction, implied, beyond_m, given.epoch[t].interval_s, rows.code_s)
    return leading


@inner
def _write_measurements(t: int, rows: Rows, one: Correction, believed: bool, results: Results) -> None:
    """Write innovations and weights; all weights are 0 if the measurements are rejected (`believed` is False)."""
    result, weight = results.epoch[t], one.fit.weight
    factor = 1.0 if believed else 0.0
    code, motion = mean_weights(rows, rows.variance, weight)
    result.code_weight, result.motion_weight = factor * code, factor * motion
    for kind, own in enumerate((rows.code, rows.phase, rows.doppler)):
        for j in range(own.start, own.stop):
            channel = results.channel[t, rows.channel[j]]
            channel.innovation[kind] = one.innovation[j]
            channel.weight[kind] = 0.0 if rows.left_out[j] else factor * weight[j]
            result.used[kind] += factor * weight[j] > 0.5 and not rows.left_out[j]
            if rows.left_out[j]:
                channel.faulty = True
    for j in range(rows.sensor.start, rows.sensor.stop):
        kind = min(rows.channel[j], ix.RANGE_COLUMN)
        result.used[3 + kind] += factor * weight[j] > 0.5
        result.sensed[kind] = one.innovation[j]


@inner
def _write_trace(rows: Rows, corrections: list[Correction], trace: Trace) -> None:
    """Write the record of the corrections for the smoother."""
    for h, one in enumerate(corrections):
        codes, count, equations = rows.code.stop, len(rows.variance), one.equations
        H = np.zeros((len(equations.unknown), len(one.x)))  # measurement matrix H of the quantities
        for q in range(len(H)):
            for k in range(ix.TERMS):
                H[q, equations.unknown[q, k]] += equations.coefficient[q, k]
        trace.prior[h], trace.value[h, :count] = one.P_prior, equations.value
        trace.variance[h, :count] = rows.variance / one.fit.weight
        trace.row[h, :codes], trace.row[h, rows.sensor] = H[:codes], H[codes + ix.MOTION :]
        trace.row[h, codes : rows.sensor.start] = (
            equations.design[codes : rows.sensor.start] @ H[codes : codes + ix.MOTION]
        )
        trace.restarted[h] = one.restarted


@inner
def _finish(given: Given, t: int, leading: int, state: State, trace: Trace) -> None:
    """Update direction of travel, and time and distance since the start of the hypotheses; prune the hypotheses."""
    monitors, dt = state.monitors[0], given.epoch[t].interval_s
    speed = state.x[leading, ix.SPEED]
    if abs(speed) > constants.DIRECTION_MPS:
        monitors.direction = math.copysign(1.0, speed)
    monitors.branch_s += dt
    monitors.branch_m += abs(speed) * dt
    for h in range(monitors.hypotheses):
        one = state.hypothesis[h]
        one.log_least = min(one.log_least + constants.LEAST_RISE * dt, one.log_probability)
    if monitors.hypotheses > 1:
        kept = prune(given, state)
        if len(trace.kept):
            trace.kept[: len(kept)] = kept
    if monitors.branch_s > constants.TAKEOVER_AFTER_S and state.hypothesis[0].log_least < constants.TAKEOVER:
        monitors.contradiction = constants.CONTRADICTION_TAKEN
        monitors.level_hold_s = max(monitors.level_hold_s, constants.LEVEL_HOLD_S)


@inner
def _write_place(given: Given, t: int, status: int, state: State, results: Results) -> None:
    """Write position, speed, levels and status. `status` is replaced if there are several branches or doubts."""
    parameters, monitors, result = given.parameters[0], state.monitors[0], results.epoch[t]
    x, P = state.x[0], state.P[0]
    sigma = math.sqrt(P[ix.ARC, ix.ARC])
    result.hypotheses, result.probability = monitors.hypotheses, math.exp(state.hypothesis[0].log_probability)
    if not sigma <= constants.EXPIRED_SIGMA_M:
        result.status = ix.EXPIRED
        return
    others, unbounded = find_other_positions(given, state)
    usual_m = parameters.slow_code_m * max(given.epoch[t].tilt_scale, 1.0)
    place, variance = widen_slow_code(parameters.slow_code_m, usual_m, x, P)
    spread = sigma * sigma + (variance - P[ix.ARC, ix.ARC]) + (place - x[ix.ARC]) ** 2
    for a in range(len(others.sigma_m)):
        own = others.straight_m[a] ** 2 + others.sigma_m[a] ** 2
        spread += others.probability[a] * (own - sigma * sigma)
    result.arc_m, result.sigma_m = x[ix.ARC], math.sqrt(spread)
    result.speed_mps, result.speed_sigma_mps = x[ix.SPEED], math.sqrt(P[ix.SPEED, ix.SPEED])
    result.acceleration_mps2 = x[ix.ACCELERATION]
    result.wheel_scale, result.force_offset_mps2, result.radar_scale = x[ix.WHEEL], x[ix.FORCE_OFFSET], x[ix.RADAR]
    result.map_scale = math.exp(0.5 * monitors.map_log_variance)
    held_s = max(monitors.ambiguity_hold_s - given.epoch[t].interval_s, 0.0)
    monitors.ambiguity_hold_s = constants.LEVEL_HOLD_S if unbounded > parameters.level_risk else held_s
    if len(state.source):
        write_level(given, t, state, others, unbounded, result)
        if monitors.level_hold_s > 0.0:
            result.ground_level_m = math.inf
        if monitors.level_hold_s > 0.0 or monitors.ambiguity_hold_s > 0.0:
            result.level_m = math.inf
        result.amount_m = max(result.level_m, constants.SCALE_BOUND * monitors.distance_since_code_m)
        result.level_speed_mps = bound_speed(parameters, state, result.speed_sigma_mps)
    if status != ix.LOST and monitors.ambiguity_hold_s > 0.0:
        status = ix.SEVERAL_BRANCHES
    elif status != ix.LOST and monitors.level_hold_s > 0.0:
        status = ix.DOUBTFUL
    result.status = status


@inner
def _advance_epoch(given: Given, t: int, state: State, results: Results, trace: Trace, lost: bool) -> None:
    """Process an epoch to which the state has already been predicted."""
    monitors, dt, leading = state.monitors[0], given.epoch[t].interval_s, 0
    rows = choose_measurements(given, t, state)
    believed = len(rows.variance) > 0  # without measurements, there is only the prediction
    if believed:
        corrections, shift = _correct_hypotheses(given, t, state, rows)
        if len(corrections) > 1:
            _reweigh_hypotheses(given, t, state, rows, corrections)
        first = corrections[0]
        sigma = math.sqrt(first.P[ix.SPEED, ix.SPEED])
        believed = narrow_speed_range(given.parameters[0], monitors, rows, first.x[ix.SPEED], sigma, dt)
        if believed:
            leading = _commit_update(given, t, state, rows, corrections, shift)
            if len(trace.prior):
                _write_trace(rows, corrections, trace)
        else:
            monitors.weak_motion_s += dt
        _write_measurements(t, rows, corrections[leading], believed, results)
    else:
        narrow_speed_range(given.parameters[0], monitors, rows, 0.0, math.inf, dt)
    if not believed:  # the state remains predicted
        leading = find_leading(state.hypothesis, monitors.hypotheses)
        monitors.level_hold_s = max(monitors.level_hold_s - dt, 0.0)
    monitors.distance_since_code_m += abs(state.x[leading, ix.SPEED]) * dt
    if believed and rows.code.stop > 0:
        monitors.distance_since_code_m = 0.0
    _finish(given, t, leading, state, trace)
    status = ix.TRACKING if believed else ix.COASTING
    _write_place(given, t, ix.LOST if lost else status, state, results)


@kernel
def advance(
    given: Given, state: State, results: Results, trace: Trace, span: tuple[int, int], sought: int
) -> tuple[int, int]:
    """Process a span of epochs; return the epoch at which the recursion stopped, and reasons for a position search.

    The recursion stops at an epoch that requires a position search; the state is predicted to this epoch, but not
    corrected. After the search, a call for this epoch alone with `index.SOUGHT` completes the epoch. The recursion also
    stops, with 0 as reasons, before a restart, after an epoch without a finite position, and at the end of the span.
    """
    for t in range(span[0], span[1]):
        if sought == ix.NOT_SOUGHT:
            if given.epoch[t].begins:
                return t, 0
            reasons = _find_search_reasons(given, t, state)
            _reset_code_errors(given, t, state)
            _wrap_closed_line(given, state)
            _predict_all(given, t, state)
            if reasons:
                return t, reasons
        _advance_epoch(given, t, state, results, trace, sought == ix.SOUGHT_AS_LOST)
        if not math.isfinite(state.x[0, ix.ARC]):
            return t + 1, 0
    return span[1], 0
