"""Monitors of the filter's place (`railfix.tracking.monitors`)."""

from __future__ import annotations

import math

from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.course import point_at
from railfix.kernels.tracking.layout import (
    ACCELERATION,
    ACROSS,
    BRANCH_S,
    HYPOTHESES,
    MAP_SCALE,
    PLACE,
    RIGHT,
    SHIFT,
    SHIFT_VARIANCE,
    SPEED,
    STEP_TIME,
    WEAK_CODE,
    WEAK_MOTION,
    WITHHELD,
    Course,
    Epochs,
    Memory,
    Numbers,
    Subfilters,
    Work,
)


@borrowing
def contradiction(
    epochs: Epochs, t: int, course: Course, numbers: Numbers, memory: Memory, work: Work, h: int
) -> float:
    """Square of the velocity against that of the place over its variance; NaN without a velocity."""
    velocity, covariance, axes = epochs.velocity_mps, epochs.velocity_covariance, work.axes
    if not math.isfinite(velocity[t, 0]):
        return math.nan
    reach = max(numbers.reach_m, numbers.reach_sigmas * math.sqrt(memory.covariance[h, PLACE, PLACE]))
    age_s = epochs.velocity_age_s[t]
    speed = memory.mean[h, SPEED] - age_s * memory.mean[h, ACCELERATION]
    floor, least = 0.0, math.inf
    for c in range(3):
        floor += velocity[t, c] * velocity[t, c]
    floor = numbers.velocity_floor_mps**2 + numbers.direction_share**2 * floor
    for turn in range(3):
        point_at(course, memory.mean[h, PLACE] - age_s * speed + (turn - 1) * reach, work.point, axes, 0)
        total = 0.0
        for k in range(2):
            away, own = -speed if k == 0 else 0.0, floor
            for c in range(3):
                away += velocity[t, c] * axes[0, k, c]
                for e in range(3):
                    own += axes[0, k, c] * covariance[t, c, e] * axes[0, k, e]
            if k == 0:
                own += memory.covariance[h, SPEED, SPEED]
            total += away * away / own
        least = min(least, total)
    return least


@borrowing
def watch(
    numbers: Numbers, memory: Memory, bank: Subfilters, square: float, shift: float, pushed_m: float, dt: float,
    code_s: float,
) -> None:  # fmt: skip
    """Take the contradictions of an epoch into the state."""
    scalars = memory.scalars
    if not math.isnan(square):
        gained = (min(square, numbers.largest_square) - numbers.allowed_square) * min(dt, 1.0)
        scalars[ACROSS] = max(scalars[ACROSS] + gained, 0.0)
    if pushed_m > 0.0 and scalars[WEAK_MOTION] >= numbers.end_doubt_s:
        scalars[ACROSS] = numbers.across_lost
    if code_s > 0.0:
        stepped = abs(shift) > numbers.step_sigmas
        scalars[STEP_TIME] = scalars[STEP_TIME] + code_s if stepped else max(scalars[STEP_TIME] - 0.5 * code_s, 0.0)
    withheld = 0.0
    doubtful = scalars[WEAK_CODE] > numbers.level_doubt_code_s or scalars[WEAK_MOTION] > numbers.level_doubt_s
    if doubtful or scalars[ACROSS] > numbers.across_doubt:
        withheld = numbers.level_hold_s
    if scalars[BRANCH_S] < numbers.level_start_s:
        largest = -math.inf
        for h in range(int(scalars[HYPOTHESES])):
            largest = max(largest, memory.log_probability[h])
        if largest < math.log(numbers.young):
            withheld = numbers.young_held_s
    if (
        scalars[SHIFT] ** 2 > numbers.drift_sigmas**2 * scalars[SHIFT_VARIANCE]
        or scalars[MAP_SCALE] > numbers.drift_log
    ):
        withheld = numbers.level_hold_s
    for b in range(len(bank.running)):
        if bank.running[b] and bank.weak_s[b] > numbers.level_doubt_s:
            withheld = numbers.level_hold_s
    wrong = len(bank.running) - 1
    if wrong >= 0 and bank.running[wrong]:
        reach = numbers.beside_sigmas * math.sqrt(bank.covariance[wrong, RIGHT, RIGHT])
        if abs(bank.mean[wrong, RIGHT]) > max(numbers.beside_m, reach):
            withheld = numbers.level_hold_s
    if scalars[STEP_TIME] >= numbers.step_s:
        withheld = numbers.step_held_s
    scalars[WITHHELD] = max(scalars[WITHHELD] - dt, withheld)
