"""Monitors of the filter's position: velocity across the line, open ends of the map, steps of all codes.

The protection level is withheld if a monitor contradicts the position. If the contradiction persists, the position is
lost, and the whole line is searched.
"""

from __future__ import annotations

import math

import numpy as np

from railfix.kernels.compiling import inner
from railfix.kernels.tracking import constants
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Given, Record, State
from railfix.kernels.tracking.line import write_point
from railfix.kernels.tracking.subfilters import find_other


@inner
def compute_contradiction(given: Given, t: int, state: State, h: int) -> float:
    """Return the squared normalised difference between measured velocity and motion along the line; NaN if unmeasured.

    The square is the sum of the squared components along and across the line. The smallest of three values is returned:
    at the estimated position, at one position ahead of it and at one behind it.
    """
    epoch, line, x, P = given.epoch[t], given.line[0], state.x[h], state.P[h]
    velocity, covariance = epoch.velocity_mps, epoch.velocity_covariance
    if not math.isfinite(velocity[0]):
        return math.nan
    reach = max(constants.REACH_M, constants.REACH_SIGMAS * math.sqrt(P[ix.ARC, ix.ARC]))
    speed = x[ix.SPEED] - epoch.velocity_age_s * x[ix.ACCELERATION]
    least, point, axes = math.inf, np.empty(3), np.empty((3, 3))
    direction = max(constants.DIRECTION_SHARE, math.sqrt(2.0) * line.sigma_plan_m / constants.MAP_CORRELATION_M)
    floor = constants.VELOCITY_FLOOR_MPS**2 + direction**2 * (velocity**2).sum()
    for turn in (-1.0, 0.0, 1.0):
        write_point(given.vertex, line, x[ix.ARC] - epoch.velocity_age_s * speed + turn * reach, point, axes)
        along, across = (velocity * axes[0]).sum() - speed, (velocity * axes[1]).sum()
        of_along = floor + (covariance * np.outer(axes[0], axes[0])).sum() + P[ix.SPEED, ix.SPEED]
        of_across = floor + (covariance * np.outer(axes[1], axes[1])).sum()
        least = min(least, along**2 / of_along + across**2 / of_across)
    return least


@inner
def update_monitors(
    state: State, contradiction: float, shift: float, beyond_m: float, dt: float, code_s: float
) -> None:
    """Update the monitors with the contradictions of an epoch.

    `contradiction`, `shift` and `beyond_m` are the results of `compute_contradiction`, `compute_code_shift` and
    `excess_beyond_end` for the reported hypothesis. `code_s` is the interval that the codes represent [s].
    """
    monitors = state.monitors[0]
    if not math.isnan(contradiction):
        gained = (min(contradiction, constants.LARGEST_SQUARE) - constants.ALLOWED_SQUARE) * min(dt, 1.0)
        monitors.contradiction = max(monitors.contradiction + gained, 0.0)
    if beyond_m > 0.0 and monitors.weak_motion_s >= constants.BESIDE_AFTER_S:
        monitors.contradiction = constants.CONTRADICTION_LOST
    if code_s > 0.0 and abs(shift) > constants.STEP_SIGMAS:
        monitors.step_s += code_s
    elif code_s > 0.0:
        monitors.step_s = max(monitors.step_s - 0.5 * code_s, 0.0)
    hold = 0.0
    if _is_doubtful(monitors) or beyond_m > 0.0:
        hold = constants.LEVEL_HOLD_S
    largest = state.hypothesis["log_probability"][: monitors.hypotheses].max()
    if monitors.branch_s < constants.LEVEL_START_S and largest < math.log(constants.YOUNG):
        hold = constants.YOUNG_HOLD_S
    drift = monitors.code_shift**2 > constants.DRIFT_SIGMAS**2 * monitors.code_shift_variance
    if drift or monitors.map_log_variance > constants.DRIFT_LOG or _is_contradicted_by_subfilter(state):
        hold = constants.LEVEL_HOLD_S
    if monitors.step_s >= constants.STEP_S:
        hold = constants.STEP_HOLD_S
    monitors.level_hold_s = max(monitors.level_hold_s - dt, hold)


@inner
def _is_doubtful(monitors: Record) -> bool:
    """Return True if codes, motion or the velocity across the line contradict the position."""
    return bool(
        monitors.weak_code_s > constants.LEVEL_DOUBT_CODE_S
        or monitors.weak_motion_s > constants.LEVEL_DOUBT_S
        or monitors.motion_misfit > 1.0 - constants.MOTION_FIT
        or monitors.contradiction > constants.CONTRADICTION_DOUBT
    )


@inner
def _is_contradicted_by_subfilter(state: State) -> bool:
    """Return True if measurements contradict a sub-filter, or if the map has a significant lateral displacement."""
    if (state.source["running"] & (state.source["contradicted_s"] > constants.LEVEL_DOUBT_S)).any():
        return True
    wrong = find_other(state, ix.WRONG_MAP)
    if wrong < 0 or not state.source[wrong].running:
        return False
    row = len(state.hypothesis) + wrong
    reach = constants.BESIDE_SIGMAS * math.sqrt(state.P[row, ix.MAP_RIGHT, ix.MAP_RIGHT])
    return bool(abs(state.x[row, ix.MAP_RIGHT]) > max(constants.BESIDE_M, reach))
