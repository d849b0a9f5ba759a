"""Probabilities of hypotheses, and which of them go on."""

from __future__ import annotations

import math

from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.algebra import log_sum
from railfix.kernels.tracking.constants import (
    ALIKE,
    MOST_MOTION,
    MOST_ODDS,
    MOTION_M,
    MOTION_SATELLITES,
    RECENT_MOST,
    RECENT_S,
    SWITCH,
)
from railfix.kernels.tracking.course import point_at
from railfix.kernels.tracking.layout import ARC, BRANCH_M, BRANCH_S, KernelState, LineArrays, Parameters, Rows, Work
from railfix.kernels.tracking.update import compute_log_evidence, motion_evidence


@borrowing
def reweigh(
    line: LineArrays, parameters: Parameters, rows: Rows, state: KernelState, work: Work, count: int, dt: float
) -> None:
    """Update the probabilities of hypotheses by the evidence of an epoch."""
    counts, other = rows.counts, work.mean.shape[0] - 1
    for h in range(count):
        joint = compute_log_evidence(rows, work.variance, parameters.degrees, work.log_after[h], work, h, h)
        work.evidence[h] = motion_evidence(rows, parameters, work, h, other)
        work.code_evidence[h] = joint - work.evidence[h] if counts[0] >= MOTION_SATELLITES else 0.0
        if max(counts[1], counts[2]) < MOTION_SATELLITES and counts[3] == 0:
            work.evidence[h] = 0.0
        point_at(line, work.new_mean[h, ARC], work.places, work.place_axes, h)
    judge(parameters, state, work, count, dt)


@borrowing
def judge(parameters: Parameters, state: KernelState, work: Work, count: int, dt: float) -> None:
    """Update the probabilities of branches, and the part of them that codes gave, by evidence of motion and codes.

    With d the distance of a branch from the most probable one, the difference of the evidence counts by
    ``d^2 / (d^2 + map_branch_m^2)``: branches within the error of the map differ in their ranges at every epoch alike.

    Motion (Dopplers, phases, sensors) has errors of seconds: that of a second counts once, at any rate of epochs, and
    by `MOST_MOTION` an epoch at most; its odds go no further than ``d^2 / (2 s^2)`` with s^2 = 2 (map_branch_m / 3)^2,
    nor than one for `MOTION_M` of travel.

    Codes have errors in common to all satellites of one side of a street, for minutes. Their odds go no further than
    ``n d^2 / (2 code_common_m^2)``, what n independent epochs with such an error can say, n being 1 and one more in
    `code_common_s` or `code_common_travel_m`; between branches that are closer than `branch_floor_m` now never below
    `branch_floor`, whatever was gained while they were apart.

    Between laps within `ALIKE` times map_branch_m what codes say now is kept as `log_recent`, for `leading` alone.
    """
    log_probability, log_code, places, after = state.log_probability, state.log_code, work.places, work.right
    travel = state.scalars[BRANCH_M]
    independent = 1.0 + state.scalars[BRANCH_S] / parameters.code_common_s + travel / parameters.code_common_travel_m
    best = 0
    for h in range(1, count):
        if log_probability[h] > log_probability[best]:
            best = h
    first, first_code = log_probability[best], log_code[best]
    of_second = min(dt, 1.0)
    most = MOST_MOTION * of_second
    kept = math.exp(-dt / RECENT_S)
    for h in range(count):
        square = 0.0
        for c in range(3):
            square += (places[h, c] - places[best, c]) ** 2
        part = square / (square + parameters.map_branch_m**2)
        odds = log_probability[h] - log_code[h] - (first - first_code)
        reach = min(MOST_ODDS * square / parameters.map_branch_m**2, travel / MOTION_M)
        gained = min(max(of_second * (work.evidence[h] - work.evidence[best]), -most), most)
        motion = min(max(odds + part * gained, min(odds, -reach)), max(odds, reach))
        odds = log_code[h] - first_code
        reach = independent * square / (2.0 * parameters.code_common_m**2)
        gained = work.code_evidence[h] - work.code_evidence[best]
        code = min(max(odds + part * gained, min(odds, -reach)), max(odds, reach))
        if square < parameters.branch_floor_m**2:
            code = min(max(code, math.log(parameters.branch_floor)), -math.log(parameters.branch_floor))
        recent = kept * state.log_recent[h]
        beside = abs(work.new_mean[h, ARC] - work.new_mean[best, ARC]) > parameters.start_separation_m
        if beside and square < (ALIKE * parameters.map_branch_m) ** 2:
            recent += part * gained
        state.log_recent[h] = min(max(recent, -RECENT_MOST), RECENT_MOST)
        work.joined[0, h] = code
        after[h] = motion + work.joined[0, h]
    total = log_sum(after, count)
    for h in range(count):
        log_probability[h], log_code[h] = after[h] - total, work.joined[0, h]


@borrowing
def leading(state: KernelState, count: int) -> int:
    """Return the hypothesis to go by: the first unless another is `SWITCH` as probable with what codes said lately."""
    log_probability, recent, best = state.log_probability, state.log_recent, 0
    for i in range(1, count):
        if log_probability[i] + recent[i] > log_probability[best] + recent[best]:
            best = i
    lead = log_probability[best] + recent[best] - log_probability[0] - recent[0]
    return best if lead > math.log(SWITCH) else 0


@borrowing
def keep_hypotheses(state: KernelState, parameters: Parameters, work: Work, count: int) -> int:
    """Order the hypotheses, join twins, drop the improbable; return how many are left, `work.kept` by their old rows.

    Improbable ones are dropped once the first has travelled far enough for motion to have distinguished them.
    """
    mean, covariance, log_probability = state.mean, state.covariance, state.log_probability
    origin, ranked, kept, joined = state.origin_m, work.ranked, work.kept, work.joined
    n = mean.shape[1]
    first = leading(state, count)
    ranked[0] = first
    for k in range(count):
        if k == first:
            continue
        j = k if k > first else k + 1
        while j > 1 and log_probability[ranked[j - 1]] < log_probability[k]:
            ranked[j] = ranked[j - 1]
            j -= 1
        ranked[j] = k
    size = 0
    for k in range(count):
        joined[0, k], joined[1, k] = log_probability[k], origin[k]
        joined[2, k], joined[3, k], joined[4, k] = state.log_code[k], state.log_least[k], state.log_recent[k]
    for r in range(count):
        k, twin = ranked[r], -1
        for j in range(size):
            other = kept[j]
            reach = max(2.0, math.sqrt(covariance[k, ARC, ARC]) + math.sqrt(covariance[other, ARC, ARC]))
            if abs(mean[k, ARC] - mean[other, ARC]) < reach:
                twin = other
                break
        if twin < 0:
            kept[size] = k
            size += 1
        else:
            one, two = max(joined[0, twin], joined[0, k]), min(joined[0, twin], joined[0, k])
            joined[0, twin] = one + math.log1p(math.exp(two - one))
    size = min(size, parameters.most_hypotheses)
    for j in range(size):
        log_probability[j] = joined[0, kept[j]]
    total = log_sum(log_probability, size)
    for j in range(size):
        log_probability[j] -= total
    if abs(mean[kept[0], ARC] - origin[kept[0]]) >= parameters.decided_travel_m:
        alive = 0
        for j in range(size):
            if log_probability[j] > math.log(parameters.least_probability):
                kept[alive], log_probability[alive] = kept[j], log_probability[j]
                alive += 1
        size = alive
        total = log_sum(log_probability, size)
        for j in range(size):
            log_probability[j] -= total
    for j in range(size):
        k = kept[j]
        origin[j], state.log_code[j], state.log_least[j] = joined[1, k], joined[2, k], joined[3, k]
        state.log_recent[j] = joined[4, k]
        for c in range(n):
            work.new_mean[j, c] = mean[k, c]
            for e in range(n):
                work.new_covariance[j, c, e] = covariance[k, c, e]
    for j in range(size):
        for c in range(n):
            mean[j, c] = work.new_mean[j, c]
            for e in range(n):
                covariance[j, c, e] = work.new_covariance[j, c, e]
    return size
