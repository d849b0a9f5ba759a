"""Epochs one after the other (`railfix.tracking.filter`): the part of the recursion that is compiled."""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing, kernel
from railfix.kernels.tracking.algebra import invert, median, most_probable, restart
from railfix.kernels.tracking.branches import keep_hypotheses, reweigh
from railfix.kernels.tracking.course import onto_line
from railfix.kernels.tracking.equations import combine, write_equations
from railfix.kernels.tracking.layout import (
    ACCELERATION,
    ACROSS,
    BRANCH_M,
    BRANCH_S,
    CODE_CLOCK,
    CODED,
    COMBINED,
    DIRECTION,
    DRIFT,
    HYPOTHESES,
    MAP_SCALE,
    MEASURED,
    OF_EPOCH,
    OLD_PLACE,
    OPEN,
    PHASE_CLOCK,
    PLACE,
    SCALE_DOPPLER,
    SCALE_PHASE,
    SENSORS,
    SPEED,
    UNAIDED,
    WEAK_CODE,
    WEAK_MOTION,
    WHEEL_ROW,
    WITHHELD,
    Active,
    Answers,
    Course,
    Epochs,
    Memory,
    Numbers,
    Rows,
    Subfilters,
    Work,
)
from railfix.kernels.tracking.learning import learn
from railfix.kernels.tracking.level import advance_subfilters, speed_bound, write_branches, write_level
from railfix.kernels.tracking.misfit import code_shift
from railfix.kernels.tracking.monitors import contradiction, watch
from railfix.kernels.tracking.possible_speed import possible
from railfix.kernels.tracking.prediction import add_bend, predict
from railfix.kernels.tracking.update import apply_update, first_weights, mean_weights, reweight, second_start


@borrowing
def _left_to_numpy(epochs: Epochs, t: int, course: Course, numbers: Numbers, memory: Memory) -> bool:
    """Return whether numpy has to do an epoch: a restart, a search, or places that go round a closed line."""
    scalars, count = memory.scalars, int(memory.scalars[HYPOTHESES])
    left = epochs.left[t]
    left = left or scalars[WEAK_MOTION] >= numbers.lost_motion_s or scalars[WEAK_CODE] >= numbers.lost_code_s
    left = left or scalars[ACROSS] >= numbers.across_lost
    beside = scalars[WEAK_MOTION] >= numbers.beside_after_s or scalars[ACROSS] >= numbers.across_doubt
    left = left or (beside and count <= numbers.most_hypotheses // 2)
    # Beyond an end of a closed line numpy lets places go on where it closes.
    for h in range(count):
        left = left or (memory.mean[h, PLACE] < course.arc_m[0] and course.start_m == -math.inf)
        left = left or (memory.mean[h, PLACE] > course.arc_m[-1] and course.end_m == math.inf)
    return left


@borrowing
def _code_interval_s(epochs: Epochs, t: int, numbers: Numbers, memory: Memory, answers: Answers) -> float:
    """Time that the codes of an epoch stand for (`railfix.tracking.chunk.code_interval_s`), in force from here on."""
    dt, since, coded = epochs.interval_s[t], epochs.time_s[t] - memory.scalars[CODED], False
    for k in range(epochs.has.shape[2]):
        coded = coded or epochs.has[0, t, k]
    if not coded:
        return float(dt)
    recent = epochs.motion_measured[t] and since < numbers.code_period_s - 0.5 * dt
    code_s = 0.0 if recent else min(max(since, dt), max(numbers.code_period_s, dt))
    for k in range(epochs.has.shape[2]):
        if recent:
            epochs.has[0, t, k] = False
            continue
        epochs.variance[0, t, k] /= min(code_s, 1.0)
        slot = epochs.slot[k]
        if slot >= 0 and epochs.has[0, t, k] and not epochs.fresh[t, slot]:
            answers.faulty[t, k] = abs(memory.code_bias[slot]) > numbers.bias_faulty
            if answers.faulty[t, k]:
                epochs.variance[0, t, k] *= numbers.bias_inflated
    return float(code_s)


@borrowing
def _choose_rows(epochs: Epochs, t: int, numbers: Numbers, memory: Memory, rows: Rows) -> bool:
    """List the channels of each kind of measurement; return False where numpy has to seek places first."""
    counts = rows.counts
    for kind in range(4):
        counts[kind] = 0
    known = True
    for k in range(epochs.has.shape[2]):
        if epochs.has[0, t, k]:
            known = known and memory.offset_known[epochs.offset[k]]
            rows.codes[counts[0]] = k
            counts[0] += 1
        if epochs.has[1, t, k]:
            rows.phases[counts[1]] = k
            counts[1] += 1
        if epochs.has[2, t, k]:
            rows.dopplers[counts[2]] = k
            counts[2] += 1
    return known and not (counts[0] > 0 and epochs.time_s[t] - memory.scalars[MEASURED] > numbers.gap_s)


@borrowing
def _choose_sensors(epochs: Epochs, t: int, numbers: Numbers, memory: Memory, rows: Rows, work: Work) -> None:
    """List the sensors that have measured; a wheel without a sign needs a direction."""
    count = int(memory.scalars[HYPOTHESES])
    for kind in range(SENSORS):
        known = math.isfinite(epochs.sensor[t, kind])
        if kind == WHEEL_ROW and epochs.unsigned and memory.scalars[DIRECTION] == 0.0:
            for h in range(count):
                known = known and abs(work.mean[h, SPEED]) > numbers.direction_mps
        if known:
            rows.sensors[rows.counts[3]] = kind
            rows.counts[3] += 1


@borrowing
def _forget(epochs: Epochs, t: int, active: Active, memory: Memory, bank: Subfilters) -> None:
    """Make the code errors of satellites that come into view independent of all else."""
    for i in range(epochs.fresh.shape[1]):
        if epochs.fresh[t, i]:
            k = active.satellite[i]
            memory.code_bias[i] = 0.0
            for h in range(int(memory.scalars[HYPOTHESES])):
                memory.mean[h, k] = 0.0
                restart(memory.covariance, k, 1.0, h)
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
def _coast(
    epochs: Epochs,
    t: int,
    course: Course,
    numbers: Numbers,
    active: Active,
    memory: Memory,
    bank: Subfilters,
    work: Work,
    h: int,
) -> None:
    """Take over the prediction of all hypotheses and sub-filters where nothing is measured; row `h` is free."""
    for k in range(int(memory.scalars[HYPOTHESES])):
        _take(memory.mean, memory.covariance, k, work.mean, work.spread, k)
    for b in range(len(bank.running)):
        if bank.running[b]:
            scale = memory.scalars[MAP_SCALE]
            wrong_m = numbers.level_map_m if b == len(bank.running) - 1 else 0.0
            predict(epochs, t, course, numbers, active, bank.mean, bank.covariance, b, scale, wrong_m, work, h)
            _take(bank.mean, bank.covariance, b, work.mean, work.spread, h)


@borrowing
def _write_variances(epochs: Epochs, t: int, memory: Memory, rows: Rows, variance: Floats) -> None:
    """Write the variances of the measurements, with what has been learnt of phases and Dopplers."""
    nc, nph, nd = rows.counts[0], rows.counts[1], rows.counts[2]
    for i in range(nc):
        variance[i] = epochs.variance[0, t, rows.codes[i]]
    for i in range(nph):
        variance[nc + i] = epochs.variance[1, t, rows.phases[i]] * math.exp(memory.scalars[SCALE_PHASE])
    for i in range(nd):
        variance[nc + nph + i] = epochs.variance[2, t, rows.dopplers[i]] * math.exp(memory.scalars[SCALE_DOPPLER])
    for j in range(rows.counts[3]):
        variance[nc + nph + nd + j] = epochs.sensor_sigma[t, rows.sensors[j]] ** 2


@borrowing
def _start_clocks(numbers: Numbers, rows: Rows, work: Work, h: int) -> None:
    """Take the median of each kind of innovation into its clock; clocks that have stepped begin anew."""
    mean, spread, value = work.mean, work.spread, work.value
    n = mean.shape[1] - OF_EPOCH
    work.anew[h, 0] = work.anew[h, 1] = False
    begin = 0
    for kind in range(3):
        end = begin + rows.counts[kind]
        if end > begin:
            middle = median(value, h, begin, end - begin, work.ordered)
            unknown = n + CODE_CLOCK if kind == 0 else (n + PHASE_CLOCK if kind == 1 else DRIFT)
            own_variance = spread[h, unknown, unknown]
            stepped = own_variance > numbers.unknown_clock**2
            stepped = stepped or abs(middle) > numbers.stepped * math.sqrt(own_variance + 0.25)
            if kind == 0 or stepped:
                mean[h, unknown] += middle
                for i in range(begin, end):
                    value[h, i] -= middle
            if kind > 0 and stepped:
                restart(spread, unknown, numbers.unknown_clock**2, h)
                work.anew[h, kind - 1] = True
        begin = end


@borrowing
def _update(
    epochs: Epochs,
    t: int,
    course: Course,
    numbers: Numbers,
    active: Active,
    memory: Memory,
    rows: Rows,
    work: Work,
) -> float:
    """Write all hypotheses after an epoch's measurements; return the shift that codes ask of the one in the lead."""
    mean, new_mean = work.mean, work.new_mean
    n, room = mean.shape[1] - OF_EPOCH, mean.shape[0] - 1
    count, nc = int(memory.scalars[HYPOTHESES]), rows.counts[0]
    gnss = nc + rows.counts[1] + rows.counts[2]
    size = nc + COMBINED + rows.counts[3]
    going = most_probable(memory.log_probability, count, numbers.switch)
    shift, doubtful = 0.0, False
    for turn in range(1 + numbers.relinearised):
        furthest = 0.0
        for h in range(count):
            work.now[h] = new_mean[h, PLACE] if turn else mean[h, PLACE]
            work.before[h] = new_mean[h, n] if turn else mean[h, n + OLD_PLACE]
            write_equations(epochs, t, course, active, numbers, rows, memory.scalars[DIRECTION], work, h)
            if turn == 0:
                add_bend(numbers, work, h)
                _start_clocks(numbers, rows, work, h)
                for i in range(gnss + rows.counts[3]):
                    work.innovation[h, i] = work.value[h, i]
            combine(epochs, t, active, numbers.sensor_floor, rows, work, h)
            work.log_before[h] = invert(work.own, h, size, work.factor, work.lower, work.information, h)
            if turn == 0:
                first_weights(rows, work.variance, numbers.degrees, 0.0, 0.0, work, h, h)
                if h == going and nc >= numbers.misfit_codes:
                    shift = code_shift(rows, numbers.misfit_most, work, h)
            work.log_after[h] = reweight(rows, work.variance, numbers.degrees, numbers.passes, work, h, h, h)
            if turn == 0:
                code, motion = mean_weights(rows, work.variance, work, h)
                doubtful = doubtful or code < numbers.doubtful or motion < numbers.doubtful
        for h in range(count):
            if turn == 0 and doubtful:
                second_start(numbers, rows, work, h, room)
            apply_update(rows, work, h)
            furthest = max(furthest, abs(new_mean[h, PLACE] - work.now[h]))
        if furthest < numbers.moved_m:
            break
    if count > 1:
        reweigh(course, numbers, rows, memory, work, count, epochs.interval_s[t])
    for h in range(count):
        work.pushed[h] = onto_line(course, numbers.start_sigma_m, work, h)
    return shift


@borrowing
def _finish(
    t: int,
    best: int,
    aided: bool,
    measured: bool,
    dt: float,
    course: Course,
    numbers: Numbers,
    active: Active,
    memory: Memory,
    bank: Subfilters,
    answers: Answers,
    work: Work,
) -> None:
    """End an epoch: direction, way without codes, hypotheses to go on with; write its answer."""
    scalars = memory.scalars
    count = int(scalars[HYPOTHESES])
    speed = memory.mean[best, SPEED]
    if abs(speed) > numbers.direction_mps:
        scalars[DIRECTION] = math.copysign(1.0, speed)
    scalars[UNAIDED] = 0.0 if aided else scalars[UNAIDED] + abs(speed) * dt
    scalars[BRANCH_S] += dt
    scalars[BRANCH_M] += abs(speed) * dt
    for h in range(count):
        memory.log_least[h] = min(memory.log_least[h] + numbers.least_rise * dt, memory.log_probability[h])
    if count > 1:
        count = keep_hypotheses(memory, numbers, work, count)
        scalars[HYPOTHESES] = count
    if scalars[BRANCH_S] > numbers.takeover_after_s and memory.log_least[0] < numbers.takeover:
        scalars[ACROSS] = numbers.across_taken
    probability = math.exp(memory.log_probability[0])
    sigma = math.sqrt(memory.covariance[0, PLACE, PLACE])
    answers.hypotheses[t], answers.probability[t] = count, probability
    if sigma > numbers.expired_sigma_m:
        answers.status[t] = numbers.expired
        return
    far = write_branches(memory, course, numbers, work, count)
    spread = sigma * sigma
    for h in range(1, count):
        own = work.branch[h, 1] ** 2 + work.branch[h, 2] ** 2
        spread += math.exp(memory.log_probability[h]) * (own - sigma * sigma)
    answers.arc_m[t], answers.sigma_m[t] = memory.mean[0, PLACE], math.sqrt(spread)
    answers.speed_mps[t] = memory.mean[0, SPEED]
    answers.speed_sigma_mps[t] = math.sqrt(memory.covariance[0, SPEED, SPEED])
    answers.acceleration_mps2[t] = memory.mean[0, ACCELERATION]
    if active.wheel >= 0:
        answers.wheel_scale[t] = memory.mean[0, active.wheel]
    if active.force >= 0:
        answers.force_offset_mps2[t] = memory.mean[0, active.force]
    if active.radar >= 0:
        answers.radar_scale[t] = memory.mean[0, active.radar]
    answers.map_scale[t] = math.exp(0.5 * scalars[MAP_SCALE])
    scalars[OPEN] = numbers.level_hold_s if far > numbers.level_risk else max(scalars[OPEN] - dt, 0.0)
    if len(bank.running):
        write_level(memory, count, far, bank, numbers, work, answers, t)
        if scalars[WITHHELD] > 0.0:
            answers.ground_level_m[t] = math.inf
        if scalars[WITHHELD] > 0.0 or scalars[OPEN] > 0.0:
            answers.level_m[t] = math.inf
        answers.amount_m[t] = max(answers.level_m[t], numbers.scale_bound * scalars[UNAIDED])
        answers.level_speed_mps[t] = speed_bound(memory.mean[0, SPEED], answers.speed_sigma_mps[t], bank, numbers)
    if scalars[OPEN] > 0.0:
        answers.status[t] = numbers.several
    elif scalars[WITHHELD] > 0.0:
        answers.status[t] = numbers.unsure
    else:
        answers.status[t] = numbers.tracking if measured else numbers.coasting


@kernel
def advance(
    epochs: Epochs,
    course: Course,
    numbers: Numbers,
    active: Active,
    memory: Memory,
    bank: Subfilters,
    answers: Answers,
    rows: Rows,
    work: Work,
    first: int,
    last: int,
) -> int:
    """Do epochs from `first` on; return the first that is left to numpy, or `last`."""
    scalars, room = memory.scalars, len(memory.log_probability)
    for t in range(first, last):
        if _left_to_numpy(epochs, t, course, numbers, memory):
            return t
        code_s = _code_interval_s(epochs, t, numbers, memory, answers)
        if not _choose_rows(epochs, t, numbers, memory, rows):
            return t
        count, dt, map_scale = int(scalars[HYPOTHESES]), epochs.interval_s[t], scalars[MAP_SCALE]
        _forget(epochs, t, active, memory, bank)
        for h in range(count):
            predict(epochs, t, course, numbers, active, memory.mean, memory.covariance, h, map_scale, 0.0, work, h)
        _choose_sensors(epochs, t, numbers, memory, rows, work)
        measured = rows.counts[0] + rows.counts[1] + rows.counts[2] + rows.counts[3] > 0
        shift = 0.0
        if measured:
            _write_variances(epochs, t, memory, rows, work.variance)
            shift = _update(epochs, t, course, numbers, active, memory, rows, work)
        if not possible(numbers, memory, rows, work, dt, measured):
            return t
        if measured:
            for h in range(count):
                _take(memory.mean, memory.covariance, h, work.new_mean, work.new_covariance, h)
            scalars[MEASURED] = epochs.time_s[t]
            if rows.counts[0] > 0:
                scalars[CODED] = epochs.time_s[t]
        else:
            _coast(epochs, t, course, numbers, active, memory, bank, work, room)
        best = most_probable(memory.log_probability, count, numbers.switch)
        if measured:
            found = learn(epochs, numbers, memory, answers, rows, work, t, best, shift, dt, code_s)
            if len(bank.running):
                advance_subfilters(epochs, t, course, numbers, active, bank, rows, best, map_scale, work, room)
            if found and abs(shift) < numbers.freed_sigmas:
                for h in range(count):
                    memory.covariance[h, PLACE, PLACE] += numbers.freed_m**2
                for b in range(len(bank.running)):
                    bank.covariance[b, PLACE, PLACE] += numbers.freed_m**2
        aided = rows.counts[0] > 0
        if measured:
            square = contradiction(epochs, t, course, numbers, memory, work, best)
            watch(numbers, memory, bank, square, 0.0 if best else shift, work.pushed[best], dt, code_s)
        else:
            scalars[WITHHELD] = max(scalars[WITHHELD] - dt, 0.0)
        _finish(t, best, aided, measured, dt, course, numbers, active, memory, bank, answers, work)
    return last
