"""Level of the filtered position by solution separation over a bank of sub-filters.

Each sub-filter runs the same recursion without one source (a satellite, a constellation, a sensor, all Dopplers, all
phases, the codes of all satellites ahead or behind) or with a map that may be wrong, from its own beginning: a fault,
however long it has lasted and whatever it has left in the state, is not in it. With the place s and its standard
deviation sigma, those of the sub-filters, Q the upper tail of the normal distribution and p_b the probability that
source b is faulty or was so recently that the filter still remembers it, the level L solves::

    2 Q(L / sigma) + sum over b of p_b [Q((L - |s - s_b|) / sigma_b) + Q((L + |s - s_b|) / sigma_b)] = risk

of an independent error, other branches and pairs of satellites being such sources with the probabilities that they
have. Every hypothesis thus spends what it needs instead of an equal share (the hypotheses of R. G. Brown and P. W.
McBurney, 1988, the allocation of J. Blanch et al., 2013, doi:10.1109/TAES.2013.6494396, over a filter instead of an
epoch). The separation bounds the error, it is no test: robust filters can settle in different modes without a fault.
"""

from __future__ import annotations

import math

from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.algebra import invert, restart
from railfix.kernels.tracking.constants import (
    AHEAD,
    JOINED,
    PAIR_LEFT,
    PAIR_SHARE,
    PRECISION_M,
    ROUNDS,
)
from railfix.kernels.tracking.course import find_ends, point_at
from railfix.kernels.tracking.equations import combine, move_sensor_equations, write_equations
from railfix.kernels.tracking.layout import (
    ALL_DOPPLERS,
    ALL_IN_VIEW,
    ALL_PHASES,
    ARC,
    CODE_CLOCK,
    CODES_AHEAD,
    CODES_BEHIND,
    COMBINED,
    DRIFT,
    MAP_LENGTH_ERROR,
    OF_EPOCH,
    OTHERS,
    PHASE_CLOCK,
    PREVIOUS_ARC,
    RANGE_ROW,
    RIGHT,
    SENSORS,
    SPEED,
    UP,
    WRONG_MAP,
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
from railfix.kernels.tracking.prediction import add_bend, predict
from railfix.kernels.tracking.update import apply_update, first_weights, fit, mean_weights, weigh_residuals


@borrowing
def _sources(epochs: Epochs, t: int, rows: Rows, bank: Subfilters, slots: int, before: bool, work: Work) -> None:
    """Mark the sources that an epoch needs a sub-filter for, and as `met` the clocks of all satellites in view.

    Where there was none before, what the hypothesis has met before is still in it.
    """
    clocks = len(bank.running) - OTHERS - SENSORS - slots
    source, met = work.source, work.met
    for b in range(len(bank.running)):
        source[b] = met[b] = False
    several = 0
    for i in range(rows.counts[0]):
        clock = slots + epochs.offset[rows.codes[i]]
        several += not source[clock]
        source[clock] = True
    for k in range(clocks):
        source[slots + k] = source[slots + k] and several > 1
    for k in range(epochs.has.shape[2]):
        if epochs.has[0, t, k] or epochs.has[1, t, k] or epochs.has[2, t, k]:
            source[epochs.slot[k]] = True
    for j in range(rows.counts[3]):
        source[slots + clocks + min(rows.sensors[j], RANGE_ROW)] = True
    first = slots + clocks + SENSORS
    source[first + ALL_DOPPLERS], source[first + ALL_PHASES] = rows.counts[2] > 0, rows.counts[1] > 0
    for b in range(first + CODES_AHEAD, first + ALL_IN_VIEW):
        source[b] = rows.counts[0] > 0
    source[first + ALL_IN_VIEW] = not before
    for k in range(slots):
        if epochs.remembered[t, k]:
            met[slots + bank.clock[k]] = True
            source[k] = source[k] or not before


@borrowing
def _begin(bank: Subfilters, b: int, copied: bool, best: int, parameters: Parameters, work: Work, h: int) -> None:
    """Begin a sub-filter with the state of the filter, or with what is known of nothing but the place."""
    mean, spread = work.mean, work.spread
    width = mean.shape[1]
    bank.running[b], bank.weak_s[b] = True, 0.0
    for c in range(width):
        mean[h, c] = mean[best, c] if copied else 0.0
        for e in range(width):
            spread[h, c, e] = spread[best, c, e] if copied else 0.0
        if not copied:
            spread[h, c, c] = bank.begun[c]
    if not copied:
        mean[h, ARC] = mean[h, width - OF_EPOCH + PREVIOUS_ARC] = mean[best, ARC]
    if b == len(bank.running) - OTHERS + WRONG_MAP:
        spread[h, RIGHT, RIGHT] += parameters.level_map_m**2
        spread[h, UP, UP] += parameters.level_map_m**2


@borrowing
def _turn_map(wrong_m: float, work: Work, h: int) -> None:
    """Turn the displacement of a map that may be wrong with the line: what was across in a bend is along after it.

    It is in the distance on the map, not in that of the phases. What was along before is not known.
    """
    mean, spread, n = work.mean, work.spread, work.mean.shape[1] - OF_EPOCH
    length = n + MAP_LENGTH_ERROR
    along = right = 0.0
    for c in range(3):
        along += work.axes[1, 1, c] * work.axes[0, 0, c]
        right += work.axes[1, 1, c] * work.axes[0, 1, c]
    mean[h, ARC] += along * mean[h, RIGHT]
    mean[h, length] -= along * mean[h, RIGHT]
    mean[h, RIGHT] *= right
    for c in range(mean.shape[1]):
        spread[h, ARC, c] += along * spread[h, RIGHT, c]
        spread[h, length, c] -= along * spread[h, RIGHT, c]
        spread[h, RIGHT, c] *= right
    for c in range(mean.shape[1]):
        spread[h, c, ARC] += along * spread[h, c, RIGHT]
        spread[h, c, length] -= along * spread[h, c, RIGHT]
        spread[h, c, RIGHT] *= right
    spread[h, RIGHT, RIGHT] += (along * wrong_m) ** 2


@borrowing
def _update(inputs: Inputs, t: int, rows: Rows, best: int, work: Work, h: int) -> None:
    """Update row `h` of the work space without the measurements whose `masked` variance is infinite."""
    epochs, line, parameters, active = inputs.epochs, inputs.line, inputs.parameters, inputs.active
    mean, spread, n = work.mean, work.spread, work.mean.shape[1] - OF_EPOCH
    for kind in range(3):
        if work.restarted[best, kind]:
            unknown = n + PHASE_CLOCK if kind == 0 else DRIFT
            if kind == 2:
                unknown = active.offset[epochs.offset[rows.codes[0]]]
            mean[h, unknown] = mean[best, unknown]
            restart(spread, unknown, spread[best, unknown, unknown], h)
    mean[h, n + CODE_CLOCK] = mean[best, n + CODE_CLOCK]
    work.now[h], work.before[h] = mean[h, ARC], mean[h, n + PREVIOUS_ARC]
    write_equations(epochs, t, line, active, rows, 1.0, work, h)
    move_sensor_equations(active, rows, best, work, h)
    combine(epochs, t, active, rows, work, h)
    size = rows.counts[0] + COMBINED + rows.counts[3]
    invert(work.own, h, size, work.factor, work.pivots, work.lower, work.information, h)
    first_weights(rows, work.masked, parameters.degrees, 0.0, 0.0, work, h, h)
    for _ in range(parameters.level_passes - 1):
        fit(rows, work.masked, work, h, h, h)
        weigh_residuals(rows, work.masked, parameters.degrees, work, h)
    apply_update(rows, work.masked, work, h)


@borrowing
def _is_contradicted(rows: Rows, parameters: Parameters, work: Work, h: int) -> bool:
    """Return whether the measurements that a sub-filter uses, codes or phases and Dopplers, have lost their weight."""
    code, motion = mean_weights(rows, work.masked, work, h)
    return code < parameters.lost_code_weight or motion < parameters.lost_motion_weight


@borrowing
def advance_subfilters(
    inputs: Inputs,
    t: int,
    bank: Subfilters,
    rows: Rows,
    best: int,
    map_log_variance: float,
    work: Work,
    h: int,
) -> None:
    """Do an epoch of all sub-filters; `best` has the equations, `h` is free.

    Each has equations of its own about its place: where the line bends between the two, those of the filter are none
    of it. One that its own measurements contradict has settled somewhere else and restarts. The filter itself is
    one without a source that it has not met. Where all restart, so does one with all satellites in view, until it
    has become the filter: pairs are compared with it.
    """
    epochs, line, parameters, active = inputs.epochs, inputs.line, inputs.parameters, inputs.active
    mean, spread = work.mean, work.spread
    n, dt = mean.shape[1] - OF_EPOCH, epochs.interval_s[t]
    nc, nph = rows.counts[0], rows.counts[1]
    gnss = nc + nph + rows.counts[2]
    slots = len(active.satellite)
    clocks = len(bank.running) - OTHERS - SENSORS - slots
    others = slots + clocks + SENSORS
    all_in_view, before = others + ALL_IN_VIEW, False
    for b in range(len(bank.running)):
        before = before or bank.running[b]
    before = before and not best
    _sources(epochs, t, rows, bank, slots, before, work)
    source, met = work.source, work.met
    for b in range(len(bank.running)):
        satellite = b < slots
        if best or (satellite and not epochs.remembered[t, b]):
            bank.running[b] = False
        if bank.running[b] and bank.weak_s[b] >= parameters.lost_motion_s:
            bank.running[b], met[b] = False, True
        rises = satellite and before and source[b] and not bank.running[b] and not met[b] and bank.prior[b] > 0.0
        begun_from = all_in_view if rises else b
        if bank.running[begun_from]:
            wrong_m = parameters.level_map_m if b == others + WRONG_MAP else 0.0
            begun_mean, begun_covariance = bank.mean[begun_from], bank.covariance[begun_from]
            predict(inputs, t, begun_mean, begun_covariance, map_log_variance, wrong_m, work, h)
            find_ends(line, mean[h, ARC], mean[h, n + PREVIOUS_ARC], work)
            if wrong_m > 0.0:
                _turn_map(wrong_m, work, h)
            add_bend(parameters, work, h)
            sigma = math.sqrt(spread[h, ARC, ARC])
            near = abs(mean[h, ARC] - mean[best, ARC]) < JOINED * sigma
            near = near and sigma < (1.0 + JOINED) * math.sqrt(spread[best, ARC, ARC])
            if near and (satellite or b == all_in_view) and not source[b]:
                bank.running[b] = False
                continue
            if rises:
                bank.running[b], bank.weak_s[b] = True, 0.0
        elif source[b] and (bank.prior[b] > 0.0 or b == all_in_view):
            _begin(bank, b, before and not met[b], best, parameters, work, h)
        else:
            continue
        side = (1.0 if b == others + CODES_AHEAD else 0.0) - (1.0 if b == others + CODES_BEHIND else 0.0)
        for i in range(gnss):
            k = rows.codes[i] if i < nc else (rows.phases[i - nc] if i < nc + nph else rows.dopplers[i - nc - nph])
            own = epochs.slot[k] if satellite else slots + epochs.offset[k]
            out = own == b or (b == others + ALL_DOPPLERS and i >= nc + nph)
            out = out or (b == others + ALL_PHASES and nc <= i < nc + nph)
            out = out or (i < nc and side * work.design[best, i, 0] < -AHEAD)  # moving ahead shortens its range
            work.masked[i] = math.inf if out else work.variance[i]
        for j in range(rows.counts[3]):
            own = slots + clocks + min(rows.sensors[j], RANGE_ROW)
            work.masked[gnss + j] = math.inf if own == b else work.variance[gnss + j]
        _update(inputs, t, rows, best, work, h)
        if _is_contradicted(rows, parameters, work, h):
            bank.weak_s[b] += dt
        elif nc > 0:
            bank.weak_s[b] = 0.0
        if not math.isfinite(work.new_mean[h, ARC]):  # it restarts, and bounds nothing before
            bank.weak_s[b] = parameters.lost_motion_s + parameters.level_doubt_s
        for c in range(n):
            bank.mean[b, c] = work.new_mean[h, c]
            for e in range(n):
                bank.covariance[b, c, e] = work.new_covariance[h, c, e]


@borrowing
def write_branches(state: KernelState, line: LineArrays, parameters: Parameters, work: Work, count: int) -> float:
    """Write distance along the line, straight distance and sigma of other hypotheses than the first.

    Returns the probability of those that are further along the line than a bound may reach.
    """
    far = 0.0
    if count > 1:
        point_at(line, state.mean[0, ARC], work.places, work.place_axes, 0)
    for h in range(1, count):
        point_at(line, state.mean[h, ARC], work.places, work.place_axes, h)
        square = 0.0
        for c in range(3):
            square += (work.places[h, c] - work.places[0, c]) ** 2
        apart = abs(state.mean[h, ARC] - state.mean[0, ARC])
        work.branch[h, 0], work.branch[h, 1] = apart, math.sqrt(square)
        work.branch[h, 2] = math.sqrt(state.covariance[h, ARC, ARC])
        work.branch[h, 3] = math.exp(state.log_probability[h])
        if apart > parameters.start_separation_m:
            far += work.branch[h, 3]
            work.branch[h, 0] = 0.0
    return far


@borrowing
def _add_pairs(
    state: KernelState, bank: Subfilters, parameters: Parameters, work: Work, count: int, start: float
) -> tuple[int, float]:
    """Add pairs of faulty satellites to the branches, from row `count` on.

    Information adds up: what is known of the place without both is the sum of what is known without each, less what
    is known with all in view. The standard deviation is mostly within a tenth of that of a filter without both; with
    few satellites it can be half of it.

    Returns the number of rows, and the risk that is spent on pairs that have none: those that require less than the
    level `start`, and those without whose satellites nothing is known, which nothing bounds.
    """
    place, in_view, spent = state.mean[0, ARC], len(bank.running) - OTHERS + ALL_IN_VIEW, 0.0
    whole, whole_shift = 1.0 / state.covariance[0, ARC, ARC], 0.0
    if bank.running[in_view]:
        whole = 1.0 / bank.covariance[in_view, ARC, ARC]
        whole_shift = whole * (bank.mean[in_view, ARC] - place)
    for first in range(len(bank.clock)):
        if not (bank.running[first] and bank.prior[first] > 0.0):
            continue
        information = 1.0 / bank.covariance[first, ARC, ARC] - whole
        shift = (bank.mean[first, ARC] - place) / bank.covariance[first, ARC, ARC] - whole_shift
        for second in range(first):
            if not bank.running[second]:
                continue
            remaining = information + 1.0 / bank.covariance[second, ARC, ARC]
            prior = bank.prior[first] * bank.prior[second]
            if remaining <= PAIR_LEFT * whole:
                spent += prior
                continue
            away = abs(shift + (bank.mean[second, ARC] - place) / bank.covariance[second, ARC, ARC]) / remaining
            tail = prior * math.erfc((start - away) * math.sqrt(0.5 * remaining))  # on the far side it is less
            if tail < PAIR_SHARE * parameters.level_risk:
                spent += tail
                continue
            work.branch[count, 0] = work.branch[count, 1] = away
            work.branch[count, 2], work.branch[count, 3] = 1.0 / math.sqrt(remaining), prior
            count += 1
    return count, spent


@borrowing
def write_level(
    state: KernelState,
    count: int,
    far: float,
    bank: Subfilters,
    parameters: Parameters,
    work: Work,
    outputs: Outputs,
    t: int,
) -> None:
    """Write the level of the first hypothesis and its parts.

    Infinite without a sub-filter, and where the measurements of one have contradicted it for longer than
    `TrackingLimits.level_doubt_s`: it has settled somewhere else, or began where the fault of its source had led the
    filter, and bounds nothing; and where pairs of satellites that nothing bounds are more probable than the risk. Along
    the line it is infinite where another place of it, further away than a bound may
    reach, is more probable than the risk; the straight distance is bounded with all branches and a map that lies aside.
    """
    place, sigma = state.mean[0, ARC], math.sqrt(state.covariance[0, ARC, ARC])
    noise, apart, branches = parameters.level_k * sigma, math.nan, count
    start, contradicted, others = noise, False, len(bank.running) - OTHERS
    for b in range(others + ALL_IN_VIEW):
        if bank.running[b]:
            contradicted = contradicted or bank.weak_s[b] > parameters.level_doubt_s
            away = abs(bank.mean[b, ARC] - place)
            if b < others + CODES_AHEAD or b > others + CODES_BEHIND:  # without half of the codes: apart by noise
                apart = away if math.isnan(apart) else max(apart, away)
            start = max(start, away + bank.k[b] * math.sqrt(bank.covariance[b, ARC, ARC]))
    outputs.level_noise_m[t], outputs.separation_m[t] = noise, apart
    outputs.level_m[t] = outputs.ground_level_m[t] = math.inf
    if math.isnan(apart) or contradicted:
        return
    count, spent = _add_pairs(state, bank, parameters, work, count, start)
    risk = parameters.level_risk - spent
    if risk <= 0.0:
        return
    outputs.ground_level_m[t] = _solve(state, count, bank, risk, work, 1, start)
    if branches == 1:
        outputs.level_m[t] = outputs.ground_level_m[t]
    elif far <= risk:
        outputs.level_m[t] = _solve(state, count, bank, risk, work, 0, start)
    wrong = others + WRONG_MAP
    if bank.running[wrong]:
        aside = abs(bank.mean[wrong, RIGHT]) + 2.0 * math.sqrt(bank.covariance[wrong, RIGHT, RIGHT])
        outputs.ground_level_m[t] = math.hypot(outputs.ground_level_m[t], aside)


@borrowing
def _solve(
    state: KernelState,
    count: int,
    bank: Subfilters,
    risk: float,
    work: Work,
    which: int,
    start: float,
) -> float:
    """Find the level with the risk of all hypotheses together; `which`: column of distances of branches and pairs.

    Newton's steps of its logarithm within a bracket, from the largest that one hypothesis alone requires: they must
    not begin where a branch makes it flat.
    """
    place, sigma, level = state.mean[0, ARC], math.sqrt(state.covariance[0, ARC, ARC]), start
    for h in range(1, count):
        excess = work.branch[h, 3] / (2.0 * risk)
        k = math.sqrt(2.0 * math.log(excess)) if excess > 1.0 else 0.0
        level = max(level, work.branch[h, which] + k * work.branch[h, 2])
    low, high, sources = 0.0, math.inf, len(bank.running) - OTHERS + ALL_IN_VIEW
    for _ in range(ROUNDS):
        away = level / sigma
        spent = math.erfc(away / math.sqrt(2.0))
        slope = 2.0 * math.exp(-0.5 * away * away) / sigma
        for side in (-1.0, 1.0):
            for b in range(sources):
                if bank.running[b]:
                    own = math.sqrt(bank.covariance[b, ARC, ARC])
                    away = (level + side * abs(bank.mean[b, ARC] - place)) / own
                    spent += bank.prior[b] * 0.5 * math.erfc(away / math.sqrt(2.0))
                    slope += bank.prior[b] * math.exp(-0.5 * away * away) / own
            for h in range(1, count):
                prior, own = work.branch[h, 3], work.branch[h, 2]
                away = (level + side * work.branch[h, which]) / own
                spent += prior * 0.5 * math.erfc(away / math.sqrt(2.0))
                slope += prior * math.exp(-0.5 * away * away) / own
        slope /= math.sqrt(2.0 * math.pi)
        if spent > risk:
            low = level
        else:
            high = level
        step = spent / slope * math.log(spent / risk) if spent > 0.0 and slope > 0.0 else -math.inf
        if not low <= level + step <= high:
            step = (0.5 * (low + high) if high < math.inf else 2.0 * level) - level
        level += step
        if abs(step) < PRECISION_M:
            break
    return level


@borrowing
def speed_bound(speed: float, sigma: float, bank: Subfilters, parameters: Parameters) -> float:
    """Return the bound of the error of the speed: what carries the level over the epochs until the next one."""
    bound = parameters.level_k_speed * sigma
    for b in range(len(bank.running) - OTHERS + ALL_IN_VIEW):
        if bank.running[b]:
            own = math.sqrt(bank.covariance[b, SPEED, SPEED])
            bound = max(bound, abs(bank.mean[b, SPEED] - speed) + bank.k_speed[b] * own)
    return bound
