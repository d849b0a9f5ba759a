"""Epochs one after the other: the recursion of the filter along the track.

Places are sought outside (`railfix.tracking.search`), between the prediction of an epoch and what follows it.
"""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing, borrowing_kernel
from railfix.kernels.tracking.algebra import invert, log_determinant, restart
from railfix.kernels.tracking.branches import keep_hypotheses, leading, reweigh
from railfix.kernels.tracking.constants import (
    ACROSS_DOUBT,
    ACROSS_LOST,
    ACROSS_TAKEN,
    BESIDE_AFTER_S,
    COASTING,
    DIRECTION_MPS,
    DOUBTFUL,
    EXPIRED,
    FREED_M,
    FREED_SIGMAS,
    LEAST_RISE,
    LOST,
    MOTION_FIT,
    MOVED_M,
    RELINEARISED,
    SCALE_BOUND,
    SEVERAL_BRANCHES,
    TAKEOVER,
    TAKEOVER_AFTER_S,
    TRACKING,
    WEAK_FIT,
)
from railfix.kernels.tracking.course import beyond_end, on_course
from railfix.kernels.tracking.equations import combine, write_equations
from railfix.kernels.tracking.layout import (
    ACCELERATION,
    ACROSS,
    ARC,
    BRANCH_M,
    BRANCH_S,
    CODED,
    COMBINED,
    DIRECTION,
    DISTANCE_SINCE_CODE,
    HYPOTHESES,
    MAP_LOG_VARIANCE,
    MEASURED,
    MOTION_MISFIT,
    OF_EPOCH,
    OPEN,
    OTHERS,
    PREDICTION,
    PREVIOUS_ARC,
    REST,
    REST_LOST,
    SPEED,
    WEAK_CODE,
    WEAK_MOTION,
    WHOLE,
    WITHHELD,
    WRONG_MAP,
    Active,
    Epochs,
    Inputs,
    KernelState,
    LineArrays,
    Outputs,
    Parameters,
    Rows,
    Subfilters,
    Work,
)
from railfix.kernels.tracking.learning import code_shift, learn, write_rows
from railfix.kernels.tracking.level import advance_subfilters, speed_bound, write_branches, write_level
from railfix.kernels.tracking.measurements import (
    choose_rows,
    choose_sensors,
    code_interval_s,
    start_clocks,
    write_variances,
)
from railfix.kernels.tracking.monitors import contradiction, watch
from railfix.kernels.tracking.prediction import add_bend, possible, predict
from railfix.kernels.tracking.references import by_reference
from railfix.kernels.tracking.update import apply_update, first_weights, mean_weights, reweight, second_start


@borrowing
def _wrap_closed_line(line: LineArrays, state: KernelState, bank: Subfilters) -> None:
    """Let places beyond an end of a closed line go on where it closes."""
    for h in range(int(state.scalars[HYPOTHESES])):
        back = on_course(line, state.mean[h, ARC]) - state.mean[h, ARC]
        if back != 0.0:
            state.mean[h, ARC] += back
            state.origin_m[h] += back
            for b in range(len(bank.running)):
                if h == 0 and bank.running[b]:
                    bank.mean[b, ARC] += back


@borrowing
def _needs_search(epochs: Epochs, t: int, parameters: Parameters, state: KernelState) -> bool:
    """Return whether places have to be sought before an epoch: the track is lost or in doubt, or after a gap."""
    scalars = state.scalars
    lost = scalars[WEAK_MOTION] >= parameters.lost_motion_s or scalars[WEAK_CODE] >= parameters.lost_code_s
    lost = lost or scalars[ACROSS] >= ACROSS_LOST
    beside = scalars[WEAK_MOTION] >= BESIDE_AFTER_S or scalars[ACROSS] >= ACROSS_DOUBT
    beside = beside or scalars[MOTION_MISFIT] > 1.0 - MOTION_FIT
    beside = beside and scalars[MEASURED] > epochs.time_s[t] - 1.5 * epochs.interval_s[t]
    coded = False
    for k in range(epochs.has.shape[2]):
        coded = coded or epochs.has[0, t, k]
    gap = coded and epochs.time_s[t] - scalars[MEASURED] > parameters.gap_s
    return bool(lost or gap or (beside and scalars[HYPOTHESES] <= parameters.most_hypotheses // 2))


@borrowing
def _reset_code_errors(epochs: Epochs, t: int, active: Active, state: KernelState, bank: Subfilters) -> None:
    """Make the code errors of satellites that come into view independent of all else."""
    for i in range(epochs.fresh.shape[1]):
        if epochs.fresh[t, i]:
            k = active.satellite[i]
            state.code_bias[i] = 0.0
            for h in range(int(state.scalars[HYPOTHESES])):
                state.mean[h, k] = 0.0
                restart(state.covariance, k, 1.0, h)
            for b in range(len(bank.running)):
                if bank.running[b]:
                    bank.mean[b, k] = 0.0
                    restart(bank.covariance, k, 1.0, b)


@borrowing
def _take(mean: Floats, covariance: Floats, to: int, new_mean: Floats, new_covariance: Floats, h: int) -> None:
    """Copy a row of the compact unknowns."""
    for c in range(mean.shape[1]):
        mean[to, c] = new_mean[h, c]
        for e in range(mean.shape[1]):
            covariance[to, c, e] = new_covariance[h, c, e]


@borrowing
def _predict_all(inputs: Inputs, t: int, state: KernelState, work: Work) -> None:
    """Predict all hypotheses."""
    scale = state.scalars[MAP_LOG_VARIANCE]
    for h in range(int(state.scalars[HYPOTHESES])):
        predict(inputs, t, state.mean[h], state.covariance[h], scale, 0.0, work, h)


@borrowing
def _coast(inputs: Inputs, t: int, state: KernelState, bank: Subfilters, work: Work, h: int) -> None:
    """Take over the prediction of all hypotheses and sub-filters where nothing is measured; row `h` is free."""
    for k in range(int(state.scalars[HYPOTHESES])):
        _take(state.mean, state.covariance, k, work.mean, work.spread, k)
    for b in range(len(bank.running)):
        if bank.running[b]:
            scale = state.scalars[MAP_LOG_VARIANCE]
            wrong_m = inputs.parameters.level_map_m if b == len(bank.running) - OTHERS + WRONG_MAP else 0.0
            predict(inputs, t, bank.mean[b], bank.covariance[b], scale, wrong_m, work, h)
            _take(bank.mean, bank.covariance, b, work.mean, work.spread, h)


@borrowing
def _measure(
    inputs: Inputs, t: int, state: KernelState, bank: Subfilters, rows: Rows, work: Work, shift: float, code_s: float
) -> int:
    """Take over what an epoch's measurements have given, and learn from it; return the hypothesis to go by."""
    epochs, scalars, count = inputs.epochs, state.scalars, int(state.scalars[HYPOTHESES])
    map_log_variance = scalars[MAP_LOG_VARIANCE]
    for h in range(count):
        _take(state.mean, state.covariance, h, work.new_mean, work.new_covariance, h)
    scalars[MEASURED] = epochs.time_s[t]
    if rows.counts[0] > 0:
        scalars[CODED] = epochs.time_s[t]
    for i in range(rows.counts[0]):
        state.offset_known[epochs.offset[rows.codes[i]]] = True
    best = leading(state, count)
    found = learn(inputs, t, state, rows, work, best, shift, code_s)
    if len(bank.running):
        advance_subfilters(inputs, t, bank, rows, best, map_log_variance, work, len(work.now) - 1)
    if found and abs(shift) < FREED_SIGMAS:
        for h in range(count):
            state.covariance[h, ARC, ARC] += FREED_M**2
        for b in range(len(bank.running)):
            bank.covariance[b, ARC, ARC] += FREED_M**2
    square, dt = contradiction(epochs, t, inputs.line, inputs.parameters, state, work, best), epochs.interval_s[t]
    watch(inputs.parameters, state, bank, square, 0.0 if best else shift, work.beyond[best], dt, code_s)
    return best


@borrowing
def _update(inputs: Inputs, t: int, state: KernelState, rows: Rows, work: Work) -> float:
    """Write all hypotheses after an epoch's measurements; return the shift that codes ask of the one in the lead."""
    epochs, line, parameters, active = inputs.epochs, inputs.line, inputs.parameters, inputs.active
    mean, new_mean = work.mean, work.new_mean
    n, room = mean.shape[1] - OF_EPOCH, mean.shape[0] - 1
    count, nc = int(state.scalars[HYPOTHESES]), rows.counts[0]
    gnss = nc + rows.counts[1] + rows.counts[2]
    size = nc + COMBINED + rows.counts[3]
    going = leading(state, count)
    shift, doubtful = 0.0, False
    for turn in range(1 + RELINEARISED):
        furthest = 0.0
        for h in range(count):
            work.now[h] = new_mean[h, ARC] if turn else mean[h, ARC]
            work.before[h] = new_mean[h, n] if turn else mean[h, n + PREVIOUS_ARC]
            write_equations(epochs, t, line, active, rows, state.scalars[DIRECTION], work, h)
            if turn == 0:
                add_bend(parameters, work, h)
                start_clocks(epochs, active, state, rows, work, h)
                for i in range(gnss + rows.counts[3]):
                    work.innovation[h, i] = work.value[h, i]
            combine(epochs, t, active, rows, work, h)
            invert(work.own, h, size, work.factor, work.pivots, work.lower, work.information, h)
            work.log_before[h] = log_determinant(work.pivots, size)
            if turn == 0:
                first_weights(rows, work.variance, parameters.degrees, 0.0, 0.0, work, h, h)
                if h == going:
                    shift = code_shift(rows, work, h)
            work.log_after[h] = reweight(rows, work.variance, parameters.degrees, parameters.passes, work, h, h, h)
            if turn == 0:
                code, motion = mean_weights(rows, work.variance, work, h)
                doubtful = doubtful or code < WEAK_FIT or motion < WEAK_FIT
        for h in range(count):
            if turn == 0 and doubtful:
                second_start(parameters, rows, work, h, room)
            apply_update(rows, work.variance, work, h)
            furthest = max(furthest, abs(new_mean[h, ARC] - work.now[h]))
        if furthest < MOVED_M:
            break
    if count > 1:
        reweigh(line, parameters, rows, state, work, count, epochs.interval_s[t])
    for h in range(count):
        work.beyond[h] = beyond_end(line, work, h)
    return shift


@borrowing
def _finish(
    inputs: Inputs,
    t: int,
    best: int,
    status: int,
    state: KernelState,
    bank: Subfilters,
    outputs: Outputs,
    work: Work,
) -> None:
    """End an epoch: direction, distance on the branches, hypotheses to go on with; write its answer.

    `status` is that of an epoch without doubt and without other branches.
    """
    line, parameters, active, dt = inputs.line, inputs.parameters, inputs.active, inputs.epochs.interval_s[t]
    scalars = state.scalars
    count = int(scalars[HYPOTHESES])
    speed = state.mean[best, SPEED]
    if abs(speed) > DIRECTION_MPS:
        scalars[DIRECTION] = math.copysign(1.0, speed)
    scalars[BRANCH_S] += dt
    scalars[BRANCH_M] += abs(speed) * dt
    for h in range(count):
        state.log_least[h] = min(state.log_least[h] + LEAST_RISE * dt, state.log_probability[h])
    if count > 1:
        count = keep_hypotheses(state, parameters, work, count)
        scalars[HYPOTHESES] = count
    if scalars[BRANCH_S] > TAKEOVER_AFTER_S and state.log_least[0] < TAKEOVER:
        scalars[ACROSS] = ACROSS_TAKEN
        scalars[WITHHELD] = max(scalars[WITHHELD], parameters.level_hold_s)
    probability = math.exp(state.log_probability[0])
    sigma = math.sqrt(state.covariance[0, ARC, ARC])
    outputs.hypotheses[t], outputs.probability[t] = count, probability
    if not sigma <= parameters.expired_sigma_m:
        outputs.status[t] = EXPIRED
        return
    far = write_branches(state, line, parameters, work, count)
    spread = sigma * sigma
    for h in range(1, count):
        own = work.branch[h, 1] ** 2 + work.branch[h, 2] ** 2
        spread += math.exp(state.log_probability[h]) * (own - sigma * sigma)
    outputs.arc_m[t], outputs.sigma_m[t] = state.mean[0, ARC], math.sqrt(spread)
    outputs.speed_mps[t] = state.mean[0, SPEED]
    outputs.speed_sigma_mps[t] = math.sqrt(state.covariance[0, SPEED, SPEED])
    outputs.acceleration_mps2[t] = state.mean[0, ACCELERATION]
    if active.wheel >= 0:
        outputs.wheel_scale[t] = state.mean[0, active.wheel]
    if active.force >= 0:
        outputs.force_offset_mps2[t] = state.mean[0, active.force]
    if active.radar >= 0:
        outputs.radar_scale[t] = state.mean[0, active.radar]
    outputs.map_scale[t] = math.exp(0.5 * scalars[MAP_LOG_VARIANCE])
    scalars[OPEN] = parameters.level_hold_s if far > parameters.level_risk else max(scalars[OPEN] - dt, 0.0)
    if len(bank.running):
        write_level(state, count, far, bank, parameters, work, outputs, t)
        if scalars[WITHHELD] > 0.0:
            outputs.ground_level_m[t] = math.inf
        if scalars[WITHHELD] > 0.0 or scalars[OPEN] > 0.0:
            outputs.level_m[t] = math.inf
        outputs.amount_m[t] = max(outputs.level_m[t], SCALE_BOUND * scalars[DISTANCE_SINCE_CODE])
        outputs.level_speed_mps[t] = speed_bound(state.mean[0, SPEED], outputs.speed_sigma_mps[t], bank, parameters)
    if status != LOST and scalars[OPEN] > 0.0:
        outputs.status[t] = SEVERAL_BRANCHES
    elif status != LOST and scalars[WITHHELD] > 0.0:
        outputs.status[t] = DOUBTFUL
    else:
        outputs.status[t] = status


@borrowing
def _advance(
    inputs: Inputs,
    state: KernelState,
    bank: Subfilters,
    outputs: Outputs,
    rows: Rows,
    work: Work,
    span: tuple[int, int],
    part: int,
) -> int:
    """Do the epochs of a span (`advance`)."""
    epochs, line, parameters, active = inputs.epochs, inputs.line, inputs.parameters, inputs.active
    scalars, room = state.scalars, len(work.now) - 1
    for t in range(span[0], span[1]):
        if part < REST:
            if epochs.begins[t] or (part == WHOLE and _needs_search(epochs, t, parameters, state)):
                return t
            _reset_code_errors(epochs, t, active, state, bank)
            _wrap_closed_line(line, state, bank)
            _predict_all(inputs, t, state, work)
            if part == PREDICTION:
                return t
        code_s = code_interval_s(epochs, t, parameters, state, outputs)
        choose_rows(epochs, t, rows)
        choose_sensors(epochs, t, state, rows, work)
        measured = rows.counts[0] + rows.counts[1] + rows.counts[2] + rows.counts[3] > 0
        dt, shift = epochs.interval_s[t], 0.0
        if measured:
            write_variances(epochs, t, state, rows, work.variance)
            shift = _update(inputs, t, state, rows, work)
        if not possible(parameters, state, rows, work, dt, measured):
            # What no train can do is not believed: the prediction goes on, made again as the clocks in it were moved.
            measured = False
            scalars[WEAK_MOTION] += dt
            write_rows(outputs, rows, work, t, 0, 0.0)
            if part == WHOLE:
                _predict_all(inputs, t, state, work)
        if measured:
            best = _measure(inputs, t, state, bank, rows, work, shift, code_s)
            write_rows(outputs, rows, work, t, best, 1.0)
        else:
            _coast(inputs, t, state, bank, work, room)
            best = leading(state, int(scalars[HYPOTHESES]))
            scalars[WITHHELD] = max(scalars[WITHHELD] - dt, 0.0)
        travel = scalars[DISTANCE_SINCE_CODE] + abs(state.mean[best, SPEED]) * dt
        scalars[DISTANCE_SINCE_CODE] = 0.0 if measured and rows.counts[0] > 0 else travel
        status = LOST if part == REST_LOST else (TRACKING if measured else COASTING)
        _finish(inputs, t, best, status, state, bank, outputs, work)
        if not math.isfinite(state.mean[0, ARC]):
            return t + 1
    return span[1]


@borrowing_kernel
def advance(
    inputs: Inputs,
    state: KernelState,
    bank: Subfilters,
    outputs: Outputs,
    rows: Rows,
    work: Work,
    span: tuple[int, int],
    part: int,
) -> int:
    """Do the epochs of a span; return the first before which places have to be sought, or the end of the span.

    `part` says what of an epoch is done: `layout.WHOLE`, or of the first alone the `PREDICTION`, or the `REST`.
    """
    return _advance(
        by_reference(inputs), by_reference(state), by_reference(bank), by_reference(outputs),
        by_reference(rows), by_reference(work), span, part,
    )  # fmt: skip
