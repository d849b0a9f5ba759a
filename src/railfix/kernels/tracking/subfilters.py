"""Sub-filters for the protection level, each of which excludes one source of measurements.

Each sub-filter is updated like the filter, without one source (a satellite, a constellation, a sensor, all Dopplers,
all phases, the codes of all satellites ahead or behind) or with a possibly wrong map. A sub-filter has its own state
from the start on, so that a fault of the excluded source never affects this state.
"""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Masks
from railfix.kernels.compiling import inner
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.equations import find_wheel_sign, linearise, new_equations
from railfix.kernels.tracking.layout import Given, Rows, State
from railfix.kernels.tracking.line import write_point
from railfix.kernels.tracking.model import add_bend, carry, identity, restart
from railfix.kernels.tracking.update import (
    Correction,
    Equations,
    Fit,
    correct_state,
    fit,
    mean_weights,
    new_fit,
    predict_quantities,
    write_first_weights,
    write_weights,
)


@inner
def find_other(state: State, which: int) -> int:
    """Return the index in `State.source` of a source in `index`, from `index.ALL_DOPPLERS` on.

    The index is negative if levels are off.
    """
    return len(state.source) - ix.OTHERS + which


@inner
def _find_needed(given: Given, t: int, rows: Rows, state: State) -> Masks:
    """Return a mask, shape (B,), of the sources that are measured, except the only constellation in view."""
    needed, satellites = np.zeros(len(state.source), dtype=np.bool_), len(state.code_bias)
    others = find_other(state, ix.ALL_DOPPLERS)
    constellations = 0
    for j in range(rows.code.start, rows.code.stop):
        clock = satellites + given.channel[t, rows.channel[j]].clock
        constellations += not needed[clock]
        needed[clock] = True
    if constellations < 2:
        needed[satellites : satellites + ix.CLOCK_COUNT] = False
    for j in range(rows.code.start, rows.doppler.stop):
        needed[given.channel[t, rows.channel[j]].satellite] = True
    for j in range(rows.sensor.start, rows.sensor.stop):
        needed[satellites + ix.CLOCK_COUNT + min(rows.channel[j], ix.RANGE_COLUMN)] = True
    needed[others + ix.ALL_DOPPLERS] = rows.doppler.stop > rows.doppler.start
    needed[others + ix.ALL_PHASES] = rows.phase.stop > rows.phase.start
    for b in (ix.CODES_AHEAD, ix.CODES_BEHIND, ix.WRONG_MAP):
        needed[others + b] = rows.code.stop > 0
    return needed


@inner
def advance_subfilters(given: Given, t: int, state: State, rows: Rows, best: Correction, leading: int) -> None:
    """Correct the predicted sub-filters; `leading` is the index of the leading hypothesis, `best` its correction.

    Each sub-filter has separate equations, because the line may bend between the positions of sub-filter and filter. A
    sub-filter restarts if measurements contradict it. For a source that the filter has not yet used, the sub-filter is
    a copy of the filter. If all sub-filters restart, a sub-filter with all satellites in view restarts, too. This
    sub-filter replaces the filter as the reference for satellite pairs until both are equal.
    """
    source, first, satellites = state.source, len(state.hypothesis), len(state.code_bias)
    all_in_view = find_other(state, ix.ALL_IN_VIEW)
    before = leading == 0 and source["running"].any()
    needed = _find_needed(given, t, rows, state)
    needed[all_in_view] = not before
    absorbed = np.zeros(len(source), dtype=np.bool_)
    for k in range(satellites):
        if given.within_memory[t, k]:  # the hypothesis has already used this source
            absorbed[satellites + source[k].clock] = True
            needed[k] = needed[k] or not before
    sign = find_wheel_sign(best.x_prior, state.monitors[0].direction)
    for b in range(len(source)):
        one = source[b]
        is_satellite = b < satellites
        if leading != 0 or (is_satellite and not given.within_memory[t, b]):
            one.running = False
        if one.running and one.contradicted_s >= constants.LOST_MOTION_S:
            one.running, absorbed[b] = False, True
        x, P = state.x[first + b], state.P[first + b]
        fresh = is_satellite and before and needed[b] and not one.running and not absorbed[b] and one.prior > 0.0
        if fresh and source[all_in_view].running:
            x[:], P[:] = state.x[first + all_in_view], state.P[first + all_in_view]
            one.running, one.contradicted_s = True, 0.0
        if one.running:
            at = x[ix.ARC], x[ix.PREVIOUS_ARC]
            if b == find_other(state, ix.WRONG_MAP):
                rotate_map_error(given, x, P)
            add_bend(given, at, P)
            if (is_satellite or b == all_in_view) and not needed[b] and _has_joined(x, P, best):
                one.running = False
                continue
        elif needed[b] and (one.prior > 0.0 or b == all_in_view):
            _begin(given, state, b, before and not absorbed[b], best)
        else:
            continue
        variance = _exclude_source(given, t, rows, state, b, best.equations)
        if one.running and _has_diverged(b - satellites, P, variance):
            one.running = False
            continue
        found = _correct(given, t, rows, variance, best, x, P, sign)
        _update_contradiction(given, t, rows, state, b, variance, found)


@inner
def _has_joined(x: Floats, P: Floats, best: Correction) -> bool:
    """Return True if position and sigma of a sub-filter are within `JOINED` sigmas of the filter's."""
    sigma = math.sqrt(P[ix.ARC, ix.ARC])
    near = abs(x[ix.ARC] - best.x_prior[ix.ARC]) < constants.JOINED * sigma
    return near and sigma < (1.0 + constants.JOINED) * math.sqrt(best.P_prior[ix.ARC, ix.ARC])


@inner
def _has_diverged(clock: int, P: Floats, variance: Floats) -> bool:
    """Return True if a sub-filter without the constellation `clock` of `CLOCKS` is lost for lack of measurements.

    Its position is as uncertain as at a start, and gives no bound (`railfix.kernels.tracking.level.find_unchecked`).
    """
    lost = 0 <= clock < ix.CLOCK_COUNT and math.sqrt(P[ix.ARC, ix.ARC]) > constants.START_SIGMA_M
    return lost and not np.isfinite(variance).any()


@inner
def _begin(given: Given, state: State, b: int, copied: bool, best: Correction) -> None:
    """Start a sub-filter with the state of the filter if `copied`, otherwise with the filter's position only."""
    row = len(state.hypothesis) + b
    x, P = state.x[row], state.P[row]
    state.source[b].running, state.source[b].contradicted_s = True, 0.0
    if copied:
        x[:], P[:] = best.x_prior, best.P_prior
    else:
        x[:], P[:] = 0.0, 0.0
        x[ix.ARC] = x[ix.PREVIOUS_ARC] = best.x_prior[ix.ARC]
        for c in range(len(x)):
            P[c, c] = given.start_variance[c]
    if b == find_other(state, ix.WRONG_MAP):
        P[ix.MAP_RIGHT, ix.MAP_RIGHT] += given.parameters[0].level_map_m ** 2
        P[ix.MAP_UP, ix.MAP_UP] += given.parameters[0].level_map_m ** 2


@inner
def rotate_map_error(given: Given, x: Floats, P: Floats) -> None:
    """Rotate the displacement of a possibly wrong map to the axes of the line at the new position.

    In a bend, a lateral displacement of the map becomes a displacement along the line. It changes the distance on the
    map, not the distance measured by phases. The component along the previous line is unknown.
    """
    axes, before, point = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    write_point(given.vertex, given.line[0], x[ix.ARC], point, axes)
    write_point(given.vertex, given.line[0], x[ix.PREVIOUS_ARC], point, before)
    along, right = (before[1] * axes[0]).sum(), (before[1] * axes[1]).sum()
    F = identity(len(x))
    for i, share in ((ix.ARC, along), (ix.MAP_LENGTH_ERROR, -along)):
        F.unknown[i, 1], F.coefficient[i, 1] = ix.MAP_RIGHT, share
    F.coefficient[ix.MAP_RIGHT, 0] = right
    carry(F, x, P, np.empty_like(P))
    P[ix.MAP_RIGHT, ix.MAP_RIGHT] += (along * given.parameters[0].level_map_m) ** 2


@inner
def _exclude_source(given: Given, t: int, rows: Rows, state: State, b: int, equations: Equations) -> Floats:
    """Return the variances of the measurements for sub-filter `b`, shape (M,); infinite for the excluded source.

    Measurements of infinite variance are not used. `equations` are the equations of the leading hypothesis. Their
    arc-length coefficients distinguish satellites ahead from satellites behind.
    """
    satellites, others, variance = len(state.code_bias), find_other(state, ix.ALL_DOPPLERS), rows.variance.copy()
    if b < satellites + ix.CLOCK_COUNT:
        for j in range(rows.code.start, rows.doppler.stop):
            channel = given.channel[t, rows.channel[j]]
            if b in (channel.satellite, satellites + channel.clock):
                variance[j] = math.inf
    elif b < others:
        for j in range(rows.sensor.start, rows.sensor.stop):
            if b == satellites + ix.CLOCK_COUNT + min(rows.channel[j], ix.RANGE_COLUMN):
                variance[j] = math.inf
    elif b == others + ix.ALL_DOPPLERS:
        variance[rows.doppler] = math.inf
    elif b == others + ix.ALL_PHASES:
        variance[rows.phase] = math.inf
    elif b in (others + ix.CODES_AHEAD, others + ix.CODES_BEHIND):
        side = 1.0 if b == others + ix.CODES_AHEAD else -1.0
        for j in range(rows.code.start, rows.code.stop):
            if side * equations.coefficient[j, 0] < -constants.AHEAD:  # forward motion shortens the range
                variance[j] = math.inf
    return variance


@inner
def _correct(
    given: Given, t: int, rows: Rows, variance: Floats, best: Correction, x: Floats, P: Floats, sign: float
) -> Fit:
    """Correct a predicted sub-filter (x, P) in place, after copying the filter's clocks of this epoch to it."""
    equations, found = new_equations(rows), new_fit(rows)
    for i in range(len(x)):
        if best.restarted[i]:
            x[i] = best.x_prior[i]
            restart(P, i, best.P_prior[i, i])
    x[ix.CODE_CLOCK] = best.x_prior[ix.CODE_CLOCK]
    linearise(given, t, rows, x, (x[ix.ARC], x[ix.PREVIOUS_ARC]), sign, equations)
    covariance, without_clock = predict_quantities(P, equations)
    write_first_weights(rows, equations, (covariance, without_clock), variance, found.weight)
    for _ in range(constants.LEVEL_PASSES - 1):
        fit(rows, equations, covariance, variance, found)
        write_weights(rows, variance, found)
    correct_state(rows, equations, variance, found.weight, x, P)
    return found


@inner
def _update_contradiction(given: Given, t: int, rows: Rows, state: State, b: int, variance: Floats, found: Fit) -> None:
    """Update the time for which measurements have contradicted sub-filter `b`, as shown by low weights."""
    one = state.source[b]
    code, motion = mean_weights(rows, variance, found.weight)
    if code < constants.LOST_CODE_WEIGHT or motion < constants.LOST_MOTION_WEIGHT:
        one.contradicted_s += given.epoch[t].interval_s
    elif rows.code.stop > 0:
        one.contradicted_s = 0.0
    # a diverged sub-filter gives no bound until it restarts
    if not math.isfinite(state.x[len(state.hypothesis) + b, ix.ARC]):
        one.contradicted_s = constants.LOST_MOTION_S + constants.LEVEL_DOUBT_S
