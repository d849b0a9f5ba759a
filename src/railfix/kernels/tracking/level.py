"""Protection level of the filtered position by solution separation; docs/filter-equations.md has the equation.

Each fault hypothesis (R. G. Brown and P. W. McBurney, 1988) uses the risk that it requires, not an equal fraction
(allocation of J. Blanch et al., 2013, doi:10.1109/TAES.2013.6494396). The separations enlarge the level but are not
tested, because robust filters can converge to different modes even without a fault.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from railfix.core.arrays import Floats
from railfix.kernels.compiling import inner
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Given, Record, State
from railfix.kernels.tracking.line import write_point
from railfix.kernels.tracking.subfilters import find_other


class Alternatives(NamedTuple):
    """Alternative positions of the train with their probabilities; all fields have shape (A,)."""

    #: Distance along the line from the reported position; 0 instead of distances above `start_separation_m`.
    along_m: Floats
    straight_m: Floats  #: Straight distance from the reported position.
    forward_m: Floats  #: Component of `straight_m` along the tangent at the alternative position.
    sigma_m: Floats
    probability: Floats


@inner
def find_other_positions(given: Given, state: State) -> tuple[Alternatives, float]:
    """Return all hypotheses but the first, and the probability of those beyond `start_separation_m` from the first."""
    others = slice(1, state.monitors[0].hypotheses)
    along = np.abs(state.x[others, ix.ARC] - state.x[0, ix.ARC])
    sigma = np.sqrt(state.P[others, ix.ARC, ix.ARC])
    probability = np.exp(state.hypothesis["log_probability"][others])
    straight, forward = np.empty(len(along)), np.empty(len(along))
    here, there, axes = np.empty(3), np.empty(3), np.empty((3, 3))
    write_point(given.vertex, given.line[0], state.x[0, ix.ARC], here, axes)
    for h in range(len(along)):
        write_point(given.vertex, given.line[0], state.x[1 + h, ix.ARC], there, axes)
        straight[h] = math.sqrt(((there - here) ** 2).sum())
        forward[h] = abs(((there - here) * axes[0]).sum())
    beyond = along > given.parameters[0].start_separation_m
    along[beyond] = 0.0
    return Alternatives(along, straight, forward, sigma, probability), probability[beyond].sum()


@inner
def widen_slow_code(slow_m: float, tilt_m: float, x: Floats, P: Floats) -> tuple[float, float]:
    """Return a Gaussian's arc length and variance for the prior slow code sigma `tilt_m` instead of `slow_m`."""
    less = 1.0 / slow_m**2 - 1.0 / tilt_m**2
    gain = P[ix.ARC, ix.SLOW_CODE] * less / (1.0 - less * P[ix.SLOW_CODE, ix.SLOW_CODE])
    return x[ix.ARC] + gain * x[ix.SLOW_CODE], P[ix.ARC, ix.ARC] + gain * P[ix.ARC, ix.SLOW_CODE]


@inner
def _find_subfilters(given: Given, t: int, state: State) -> Alternatives:
    """Return the running sub-filters, and the filter with larger slow code errors (disturbed or tilted ionosphere)."""
    first, size, most = len(state.hypothesis), 0, find_other(state, ix.ALL_IN_VIEW)
    away, sigma, probability = np.empty(most + 2), np.empty(most + 2), np.empty(most + 2)
    for b in range(most):
        if state.source[b].running:
            away[size] = abs(state.x[first + b, ix.ARC] - state.x[0, ix.ARC])
            sigma[size], probability[size] = math.sqrt(state.P[first + b, ix.ARC, ix.ARC]), state.source[b].prior
            size += 1
    slow_m, scale = given.parameters[0].slow_code_m, given.epoch[t].tilt_scale
    for wide_m, prior in ((slow_m, 1.0), (given.line[0].tilt_m, given.parameters[0].level_tilt_prior)):
        if scale * wide_m > slow_m:
            place, variance = widen_slow_code(slow_m, scale * wide_m, state.x[0], state.P[0])
            away[size], sigma[size] = abs(place - state.x[0, ix.ARC]), math.sqrt(variance)
            probability[size] = prior
            size += 1
    return Alternatives(away[:size], away[:size], away[:size], sigma[:size], probability[:size])


@inner
def _cross(positions: Alternatives, subfilters: Alternatives, risk: float, level: float) -> tuple[Alternatives, float]:
    """Return the positions on other branches if a source is faulty, and the risk of positions that are not returned.

    A fault shifts the positions on all branches equally along the line. Positions are not returned if their risk beyond
    `level` is negligible (`PAIR_SHARE`).
    """
    most, size, spent = len(positions.sigma_m) * len(subfilters.sigma_m), 0, 0.0
    along, straight, sigma, probability = np.empty(most), np.empty(most), np.empty(most), np.empty(most)
    for h in range(len(positions.sigma_m)):
        for b in range(len(subfilters.sigma_m)):
            separation, prior = subfilters.along_m[b], positions.probability[h] * subfilters.probability[b]
            own = max(positions.sigma_m[h], subfilters.sigma_m[b])
            forward = positions.forward_m[h]
            distance = math.sqrt(positions.straight_m[h] ** 2 + separation**2 + 2.0 * forward * separation)
            tail = prior * math.erfc((level - distance) / (math.sqrt(2.0) * own))
            if tail < constants.PAIR_SHARE * risk:
                spent += tail
                continue
            along[size] = positions.along_m[h] + separation if positions.along_m[h] > 0.0 else 0.0
            straight[size], sigma[size], probability[size] = distance, own, prior
            size += 1
    return Alternatives(along[:size], straight[:size], straight[:size], sigma[:size], probability[:size]), spent


@inner
def _find_pairs(state: State, risk: float, level: float) -> tuple[Alternatives, float]:
    """For pairs of satellites, return the position without the pair, and the risk of pairs that are not returned.

    The information of satellites is assumed to be additive. The standard deviation mostly differs by less than 10 %
    from that of a filter without both satellites; with few satellites, it can be half as large. Pairs are not returned
    if their risk beyond `level` is negligible (`PAIR_SHARE`), or if the position without the pair is not bounded.
    """
    source, first, satellites, spent, size = state.source, len(state.hypothesis), len(state.code_bias), 0.0, 0
    most = satellites * (satellites - 1) // 2
    away, sigma, probability = np.empty(most), np.empty(most), np.empty(most)
    information, weighted_separation = np.zeros(satellites), np.zeros(satellites)
    for k in range(satellites):
        if source[k].running:
            information[k] = 1.0 / state.P[first + k, ix.ARC, ix.ARC]
            weighted_separation[k] = information[k] * (state.x[first + k, ix.ARC] - state.x[0, ix.ARC])
    whole, whole_separation, in_view = 1.0 / state.P[0, ix.ARC, ix.ARC], 0.0, find_other(state, ix.ALL_IN_VIEW)
    if source[in_view].running:
        whole = 1.0 / state.P[first + in_view, ix.ARC, ix.ARC]
        whole_separation = whole * (state.x[first + in_view, ix.ARC] - state.x[0, ix.ARC])
    for i in range(satellites):
        if not (source[i].running and source[i].prior > 0.0):
            continue
        for j in range(i):
            if not source[j].running:
                continue
            remaining, prior = information[i] - whole + information[j], source[i].prior * source[j].prior
            if remaining <= constants.PAIR_LEFT * whole:
                spent += prior
                continue
            distance = abs(weighted_separation[i] - whole_separation + weighted_separation[j]) / remaining
            # only the tail towards the alternative; the opposite tail is smaller
            tail = prior * math.erfc((level - distance) * math.sqrt(0.5 * remaining))
            if tail < constants.PAIR_SHARE * risk:
                spent += tail
                continue
            away[size], sigma[size], probability[size] = distance, 1.0 / math.sqrt(remaining), prior
            size += 1
    return Alternatives(away[:size], away[:size], away[:size], sigma[:size], probability[:size]), spent


@inner
def find_unchecked(state: State) -> float:
    """Return the fault probability of a constellation that is alone in view and has no sub-filter; otherwise 0."""
    source, satellites, total = state.source, len(state.code_bias), 0.0
    for g in range(ix.CLOCK_COUNT):
        in_view = source["running"][:satellites] & (source["clock"][:satellites] == g)
        if in_view.any() and not source[satellites + g].running:
            total += source[satellites + g].prior
    return total


@inner
def write_level(given: Given, t: int, state: State, positions: Alternatives, unbounded: float, result: Record) -> None:
    """Write the protection levels of the first hypothesis, and their parts.

    Both levels are infinite if there are no sub-filters, if a sub-filter has been contradicted for longer than
    `LEVEL_DOUBT_S`, or if the neglected alternatives use the whole risk. The level along the line is also infinite if
    the probability `unbounded` of positions beyond `start_separation_m` exceeds the risk. The level of the straight
    distance takes account of all branches and of a laterally displaced map.
    """
    parameters, source, first = given.parameters[0], state.source, len(state.hypothesis)
    others = find_other(state, ix.ALL_DOPPLERS)
    sigma = math.sqrt(state.P[0, ix.ARC, ix.ARC])
    noise, apart = parameters.level_k * sigma, math.nan
    start, contradicted = noise, False
    for b in range(others + ix.ALL_IN_VIEW):
        if source[b].running:
            contradicted = contradicted or source[b].contradicted_s > constants.LEVEL_DOUBT_S
            away = abs(state.x[first + b, ix.ARC] - state.x[0, ix.ARC])
            # without the codes ahead or behind, the separation is mostly noise and is not reported
            if b < others + ix.CODES_AHEAD or b > others + ix.CODES_BEHIND:
                apart = away if math.isnan(apart) else max(apart, away)
            start = max(start, away + source[b].k * math.sqrt(state.P[first + b, ix.ARC, ix.ARC]))
    result.level_noise_m, result.separation_m = noise, apart
    result.unchecked_prior = find_unchecked(state)
    result.level_m = result.ground_level_m = math.inf
    if math.isnan(apart) or contradicted:
        return
    pairs, spent = _find_pairs(state, parameters.level_risk, start)
    subfilters = _find_subfilters(given, t, state)
    crossed, spent_on_branches = _cross(positions, subfilters, parameters.level_risk, start)
    risk = parameters.level_risk - spent - spent_on_branches
    if risk <= 0.0:
        return
    alternatives = join(join(join(subfilters, positions), pairs), crossed)
    result.ground_level_m = solve_level(sigma, alternatives.straight_m, alternatives, risk, start)
    if len(positions.sigma_m) == 0:
        result.level_m = result.ground_level_m
    elif unbounded <= risk:
        result.level_m = solve_level(sigma, alternatives.along_m, alternatives, risk, start)
    if source[others + ix.WRONG_MAP].running:
        row = first + others + ix.WRONG_MAP
        aside = abs(state.x[row, ix.MAP_RIGHT]) + 2.0 * math.sqrt(state.P[row, ix.MAP_RIGHT, ix.MAP_RIGHT])
        result.ground_level_m = math.hypot(result.ground_level_m, aside)


@inner
def join(one: Alternatives, other: Alternatives) -> Alternatives:
    """Concatenate two sets of alternatives."""
    return Alternatives(
        np.concatenate((one.along_m, other.along_m)), np.concatenate((one.straight_m, other.straight_m)),
        np.concatenate((one.forward_m, other.forward_m)), np.concatenate((one.sigma_m, other.sigma_m)),
        np.concatenate((one.probability, other.probability)),
    )  # fmt: skip


@inner
def solve_level(sigma: float, distance: Floats, alternatives: Alternatives, risk: float, start: float) -> float:
    """Return the level at which the risks of the position and of the alternatives, at `distance`, sum to `risk`.

    The solution is found by Newton steps on the logarithm of the risk, within a bracket. The steps start at the largest
    level that a single alternative requires, because at lower levels, a branch can make the risk nearly constant.
    """
    level, own, probability = start, alternatives.sigma_m, alternatives.probability
    for a in range(len(own)):
        excess = probability[a] / (2.0 * risk)
        k = math.sqrt(2.0 * math.log(excess)) if excess > 1.0 else 0.0
        level = max(level, distance[a] + k * own[a])
    low, high = 0.0, math.inf
    for _ in range(constants.ROUNDS):
        away = level / sigma
        spent = math.erfc(away / math.sqrt(2.0))
        slope = 2.0 * math.exp(-0.5 * away * away) / sigma
        for a in range(len(own)):
            for side in (-1.0, 1.0):
                away = (level + side * distance[a]) / own[a]
                spent += probability[a] * 0.5 * math.erfc(away / math.sqrt(2.0))
                slope += probability[a] * math.exp(-0.5 * away * away) / own[a]
        slope /= math.sqrt(2.0 * math.pi)
        low, high = (level, high) if spent > risk else (low, level)
        step = spent / slope * math.log(spent / risk) if spent > 0.0 and slope > 0.0 else -math.inf
        if not low <= level + step <= high:
            step = (0.5 * (low + high) if high < math.inf else 2.0 * level) - level
        level += step
        if abs(step) < constants.PRECISION_M:
            break
    return level


@inner
def bound_speed(parameters: Record, state: State, sigma: float) -> float:
    """Return the bound of the speed error that is used to propagate the protection level to later epochs."""
    bound, first = parameters.level_k_speed * sigma, len(state.hypothesis)
    for b in range(find_other(state, ix.ALL_IN_VIEW)):
        if state.source[b].running:
            away = abs(state.x[first + b, ix.SPEED] - state.x[0, ix.SPEED])
            bound = max(bound, away + state.source[b].k_speed * math.sqrt(state.P[first + b, ix.SPEED, ix.SPEED]))
    return float(bound)
