"""Monitors of the filter's place: velocity across the line, the open end of a map, a step of all codes.

Where one of them speaks against the place its level is withheld; where it lasts the track is lost, and places are
sought over the whole line.
"""

from __future__ import annotations

import math

from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.constants import (
    ACROSS_DOUBT,
    ACROSS_LOST,
    ALLOWED_SQUARE,
    BESIDE_M,
    BESIDE_SIGMAS,
    DIRECTION_SHARE,
    DRIFT_LOG,
    DRIFT_SIGMAS,
    LARGEST_SQUARE,
    MOTION_FIT,
    REACH_M,
    REACH_SIGMAS,
    STEP_HELD_S,
    STEP_S,
    STEP_SIGMAS,
    VELOCITY_FLOOR_MPS,
    YOUNG,
    YOUNG_HELD_S,
)
from railfix.kernels.tracking.course import point_at
from railfix.kernels.tracking.layout import (
    ACCELERATION,
    ACROSS,
    ARC,
    BRANCH_S,
    HYPOTHESES,
    MAP_LOG_VARIANCE,
    MOTION_MISFIT,
    OTHERS,
    RIGHT,
    SHIFT,
    SHIFT_VARIANCE,
    SPEED,
    STEP_TIME,
    WEAK_CODE,
    WEAK_MOTION,
    WITHHELD,
    WRONG_MAP,
    Epochs,
    KernelState,
    LineArrays,
    Parameters,
    Subfilters,
    Work,
)


@borrowing
def contradiction(
    epochs: Epochs, t: int, line: LineArrays, parameters: Parameters, state: KernelState, work: Work, h: int
) -> float:
    """Return the square of the velocity against that of the place over its variance; NaN without a velocity.

    Along the line and across it, at the best of three places that the place's standard deviation allows.
    """
    velocity, covariance, axes = epochs.velocity_mps, epochs.velocity_covariance, work.axes
    if not math.isfinite(velocity[t, 0]):
        return math.nan
    reach = max(REACH_M, REACH_SIGMAS * math.sqrt(state.covariance[h, ARC, ARC]))
    age_s = epochs.velocity_age_s[t]
    speed = state.mean[h, SPEED] - age_s * state.mean[h, ACCELERATION]
    floor, least = 0.0, math.inf
    for c in range(3):
        floor += velocity[t, c] * velocity[t, c]
    direction = max(DIRECTION_SHARE, math.sqrt(2.0) * line.sigma_plan_m / parameters.map_correlation_m)
    floor = VELOCITY_FLOOR_MPS**2 + direction**2 * floor
    for turn in range(3):
        point_at(line, state.mean[h, ARC] - age_s * speed + (turn - 1) * reach, work.point, axes, 0)
        total = 0.0
        for k in range(2):
            away, own = -speed if k == 0 else 0.0, floor
            for c in range(3):
                away += velocity[t, c] * axes[0, k, c]
                for e in range(3):
                    own += axes[0, k, c] * covariance[t, c, e] * axes[0, k, e]
            if k == 0:
                own += state.covariance[h, SPEED, SPEED]
            total += away * away / own
        least = min(least, total)
    return least


@borrowing
def watch(
    parameters: Parameters,
    state: KernelState,
    bank: Subfilters,
    square: float,
    shift: float,
    beyond_m: float,
    dt: float,
    code_s: float,
) -> None:
    """Take the contradictions of an epoch into the state.

    `square` is `contradiction` of the most probable hypothesis, `shift` the one that its codes imply, `beyond_m` how
    far its place is beyond an open end of the line, `code_s` the time that the codes stand for.
    """
    scalars = state.scalars
    if not math.isnan(square):
        gained = (min(square, LARGEST_SQUARE) - ALLOWED_SQUARE) * min(dt, 1.0)
        scalars[ACROSS] = max(scalars[ACROSS] + gained, 0.0)
    if beyond_m > 0.0 and scalars[WEAK_MOTION] >= parameters.end_doubt_s:
        scalars[ACROSS] = ACROSS_LOST
    if code_s > 0.0:
        stepped = abs(shift) > STEP_SIGMAS
        scalars[STEP_TIME] = scalars[STEP_TIME] + code_s if stepped else max(scalars[STEP_TIME] - 0.5 * code_s, 0.0)
    withheld = 0.0
    doubtful = scalars[WEAK_CODE] > parameters.level_doubt_code_s or scalars[WEAK_MOTION] > parameters.level_doubt_s
    doubtful = doubtful or scalars[MOTION_MISFIT] > 1.0 - MOTION_FIT
    if doubtful or scalars[ACROSS] > ACROSS_DOUBT or beyond_m > 0.0:
        withheld = parameters.level_hold_s
    if scalars[BRANCH_S] < parameters.level_start_s:
        largest = -math.inf
        for h in range(int(scalars[HYPOTHESES])):
            largest = max(largest, state.log_probability[h])
        if largest < math.log(YOUNG):
            withheld = YOUNG_HELD_S
    if scalars[SHIFT] ** 2 > DRIFT_SIGMAS**2 * scalars[SHIFT_VARIANCE] or scalars[MAP_LOG_VARIANCE] > DRIFT_LOG:
        withheld = parameters.level_hold_s
    for b in range(len(bank.running)):
        if bank.running[b] and bank.weak_s[b] > parameters.level_doubt_s:
            withheld = parameters.level_hold_s
    wrong = len(bank.running) - OTHERS + WRONG_MAP
    if wrong >= 0 and bank.running[wrong]:
        reach = BESIDE_SIGMAS * math.sqrt(bank.covariance[wrong, RIGHT, RIGHT])
        if abs(bank.mean[wrong, RIGHT]) > max(BESIDE_M, reach):
            withheld = parameters.level_hold_s
    if scalars[STEP_TIME] >= STEP_S:
        withheld = STEP_HELD_S
    scalars[WITHHELD] = max(scalars[WITHHELD] - dt, withheld)
