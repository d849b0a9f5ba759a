"""Probabilities of hypotheses, and pruning of hypotheses."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.kernels.compiling import inner
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Given, Record, Records, State
from railfix.kernels.tracking.line import write_point


@inner
def log_sum(values: Floats) -> float:
    """Return the logarithm of the sum of the exponentials of the values."""
    largest = values.max()
    return float(largest + math.log(np.exp(values - largest).sum()))


@inner
def clip_odds(odds: float, gained: float, reach: float) -> float:
    """Return `odds + gained`, limited to +-`reach`; if `odds` is already beyond a limit, it replaces this limit."""
    return min(max(odds + gained, min(odds, -reach)), max(odds, reach))


@inner
def reweigh(
    parameters: Record, state: State, evidence: Floats, code_evidence: Floats, points: Floats, arc: Floats, dt: float
) -> None:
    """Update the log probabilities with the evidence of motion and codes, and separately their parts due to codes.

    docs/filter-equations.md has the bounds of the evidence. They are required because errors are correlated over
    epochs: map errors permanently, motion errors for seconds, and code errors of all satellites on one side of a street
    for minutes. The evidence of motion is therefore multiplied by the interval, at most 1 s. For laps closer than
    `ALIKE` times `map_branch_m`, recent evidence of codes is stored as `log_recent`, which only `find_leading` uses.

    `evidence` is the log evidence of motion, and `code_evidence` the log evidence of codes given the motion, shape
    (H,). `points`, shape (H, 3), and `arc`, shape (H,), are the positions [m].
    """
    hypothesis, monitors, count = state.hypothesis, state.monitors[0], len(evidence)
    travel = monitors.branch_m
    independent = 1.0 + monitors.branch_s / constants.CODE_COMMON_S + travel / constants.CODE_COMMON_TRAVEL_M
    best = int(np.argmax(hypothesis["log_probability"][:count]))
    best_log, best_log_code = hypothesis[best].log_probability, hypothesis[best].log_code
    of_second = min(dt, 1.0)
    most, floor = constants.MOST_MOTION * of_second, math.log(constants.BRANCH_FLOOR)
    after, after_code = np.empty(count), np.empty(count)
    for h in range(count):
        one = hypothesis[h]
        square = ((points[h] - points[best]) ** 2).sum()
        part = square / (square + parameters.map_branch_m**2)
        reach = min(constants.MOST_ODDS * square / parameters.map_branch_m**2, travel / constants.MOTION_M)
        gained = min(max(of_second * (evidence[h] - evidence[best]), -most), most)
        motion = clip_odds(one.log_probability - one.log_code - (best_log - best_log_code), part * gained, reach)
        reach = independent * square / (2.0 * constants.CODE_COMMON_M**2)
        gained = code_evidence[h] - code_evidence[best]
        code = clip_odds(one.log_code - best_log_code, part * gained, reach)
        if square < constants.BRANCH_FLOOR_M**2:
            code = min(max(code, floor), -floor)
        recent = math.exp(-dt / constants.RECENT_S) * one.log_recent
        apart = abs(arc[h] - arc[best]) > parameters.start_separation_m
        if apart and square < (constants.ALIKE * parameters.map_branch_m) ** 2:
            recent += part * gained
        one.log_recent = min(max(recent, -constants.RECENT_MOST), constants.RECENT_MOST)
        after[h], after_code[h] = motion + code, code
    total = log_sum(after)
    for h in range(count):
        hypothesis[h].log_probability, hypothesis[h].log_code = after[h] - total, after_code[h]


@inner
def find_leading(hypothesis: Records, count: int) -> int:
    """Return the hypothesis to report: the first, unless recent codes make another `SWITCH` times as probable."""
    lead = hypothesis["log_probability"][:count] + hypothesis["log_recent"][:count]
    best = int(np.argmax(lead))
    return best if lead[best] - lead[0] > math.log(constants.SWITCH) else 0


@inner
def prune(given: Given, state: State) -> Indices:
    """Sort the hypotheses, merge duplicates, drop improbable hypotheses, and return the previous indices of the rest.

    Improbable hypotheses are dropped only after the first one has travelled `DECIDED_TRAVEL_M`.
    """
    count = state.monitors[0].hypotheses
    order = np.argsort(-state.hypothesis["log_probability"][:count], kind="mergesort")
    leading = find_leading(state.hypothesis, count)
    kept, log_probability = _merge_twins(given, state, np.concatenate((np.array([leading]), order[order != leading])))
    size = min(len(kept), given.parameters[0].most_hypotheses)
    kept, log_probability = kept[:size], log_probability[:size] - log_sum(log_probability[:size])
    if abs(state.x[kept[0], ix.ARC] - state.hypothesis[kept[0]].origin_m) >= constants.DECIDED_TRAVEL_M:
        likely = log_probability > math.log(constants.LEAST_PROBABILITY)
        kept, log_probability = kept[likely], log_probability[likely] - log_sum(log_probability[likely])
    x, P, hypothesis = state.x[:count].copy(), state.P[:count].copy(), state.hypothesis.copy()
    for j in range(len(kept)):
        state.x[j], state.P[j], state.hypothesis[j] = x[kept[j]], P[kept[j]], hypothesis[kept[j]]
        state.hypothesis[j].log_probability = log_probability[j]
    state.monitors[0].hypotheses = len(kept)
    return kept


@inner
def _merge_twins(given: Given, state: State, ranked: Indices) -> tuple[Indices, Floats]:
    """Return hypotheses and log probabilities after merging hypotheses with the same position.

    Two hypotheses are merged if their distance is less than the sum of their standard deviations. If another lap has a
    hypothesis at the same position within the map error, the smaller standard deviation is the limit. With the sum, a
    right position could be merged into a wrong position of the same lap, which the next bend would contradict.
    """
    kept, log_probability, size = np.empty_like(ranked), np.empty(len(ranked)), 0
    arc, points, axes = state.x[: len(ranked), ix.ARC], np.empty((len(ranked), 3)), np.empty((3, 3))
    for h in range(len(ranked)):
        write_point(given.vertex, given.line[0], arc[h], points[h], axes)
    for k in ranked:
        twin, sigma = -1, math.sqrt(state.P[k, ix.ARC, ix.ARC])
        alike = ((points - points[k]) ** 2).sum(axis=1) < (constants.ALIKE * given.parameters[0].map_branch_m) ** 2
        alike = alike & (np.abs(arc - arc[k]) > given.parameters[0].start_separation_m)
        for j in range(size):
            other = math.sqrt(state.P[kept[j], ix.ARC, ix.ARC])
            reach = max(2.0, min(sigma, other) if alike.any() else sigma + other)
            if abs(arc[k] - arc[kept[j]]) < reach:
                twin = j
                break
        own = state.hypothesis[k].log_probability
        if twin < 0:
            kept[size], log_probability[size] = k, own
            size += 1
        else:
            larger, smaller = max(log_probability[twin], own), min(log_probability[twin], own)
            log_probability[twin] = larger + math.log1p(math.exp(smaller - larger))
    return kept[:size], log_probability[:size]
