"""Monitors of the filter's place: velocity across the line, the open end of a map, a step of all codes.

Where one of them speaks against the place its level is withheld; where it lasts the track is lost, and places are
sought over the whole line.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.state import TrackState, Unknown

#: The velocity is compared with the line at the place and so many of its standard deviations, or metres, beside it.
REACH_SIGMAS: Final = 2.0
REACH_M: Final = 3.0
#: Errors of the velocity beside its covariance [m/s], and of the line's direction as a share of the speed.
VELOCITY_FLOOR_MPS: Final = 0.15
DIRECTION_SHARE: Final = 0.03
#: A squared contradiction counts up to this, less this a second (cumulative sum, E. S. Page, 1954).
LARGEST_SQUARE: Final = 12.0
ALLOWED_SQUARE: Final = 4.0
#: Sums from which on the level is withheld, and the track is lost.
ACROSS_DOUBT: Final = 12.0
ACROSS_LOST: Final = 30.0
#: The sum after a takeover (`railfix.tracking.branches.TAKEOVER`): more than a velocity across the line gives.
ACROSS_TAKEN: Final = 60.0
#: Probability of other places where the velocity contradicts the one that was sure: the map may be wrong just here.
ELSEWHERE: Final = 0.01
#: Mean of the places that codes ask for, over its standard deviation, and factor on the error of the map's lengths:
#: beyond them codes contradict motion, by a step of all codes, a pull, or a map that is wrong.
DRIFT_SIGMAS: Final = 5.0
DRIFT_SCALE: Final = 6.0
#: A displacement of the map across, by the sub-filter that lets it be wrong, is real beyond so many of its standard
#: deviations and metres.
BESIDE_SIGMAS: Final = 4.5
BESIDE_M: Final = 8.0
#: Young hypotheses bound nothing before one of them is this probable: the right place may not be among them yet.
YOUNG: Final = 0.99
YOUNG_HELD_S: Final = 1.0
#: Codes that ask for another place by more than so many standard deviations for so long [s] have stepped together.
STEP_SIGMAS: Final = 6.0
STEP_S: Final = 3.0
#: The level is withheld for so long after a step of all codes [s]: the place after it is the codes' own.
STEP_HELD_S: Final = 300.0


def contradiction(
    velocity: Floats, covariance: Floats, age_s: float, mean: Floats, spread: Floats, line: Line
) -> float:
    """Return the square of the velocity against that of the place, over its variance; NaN without a velocity.

    Along the line and across it, at the best of three places that the place's standard deviation allows.

    Parameters
    ----------
    velocity, covariance : ndarray, shapes (3,), (3, 3)
    age_s : float
        `velocity.Velocity`.
    mean, spread : ndarray, shapes (N,), (N, N)
        Of the hypothesis.
    line : Line
    """
    if not np.isfinite(velocity[0]):
        return float("nan")
    reach = max(REACH_M, REACH_SIGMAS * float(np.sqrt(spread[Unknown.PLACE, Unknown.PLACE])))
    speed = float(mean[Unknown.SPEED] - age_s * mean[Unknown.ACCELERATION])
    _, axes = line.at(mean[Unknown.PLACE] - age_s * speed + reach * np.array([-1.0, 0.0, 1.0]))
    floor = VELOCITY_FLOOR_MPS**2 + DIRECTION_SHARE**2 * float(velocity @ velocity)
    least = float("inf")
    for tangent, right, _ in axes:
        along = float(velocity @ tangent - speed)
        across = float(velocity @ right)
        own = float(tangent @ covariance @ tangent) + spread[Unknown.SPEED, Unknown.SPEED] + floor
        least = min(least, along**2 / own + across**2 / (float(right @ covariance @ right) + floor))
    return float(least)


def watch(
    state: TrackState, square: float, shift: float, pushed_m: float, dt: float, code_s: float, limits: TrackingLimits
) -> None:
    """Take the contradictions of an epoch into the state.

    Parameters
    ----------
    state : TrackState
    square : float
        `contradiction` of the most probable hypothesis.
    shift : float
        `misfit.code_shift`.
    pushed_m : float [m]
        How far the place was put back onto an open end of the line.
    dt, code_s : float [s]
        Interval, and time that the epoch's codes represent.
    limits : TrackingLimits
    """
    if square == square:
        state.across = max(state.across + (min(square, LARGEST_SQUARE) - ALLOWED_SQUARE) * min(dt, 1.0), 0.0)
    if pushed_m > 0.0 and state.weak_motion_s >= limits.end_doubt_s:
        state.across = ACROSS_LOST
    if code_s > 0.0:
        stepped = abs(shift) > STEP_SIGMAS
        state.step_s = state.step_s + code_s if stepped else max(state.step_s - 0.5 * code_s, 0.0)
    withheld = 0.0
    doubtful = state.weak_code_s > limits.level_doubt_code_s or state.weak_motion_s > limits.level_doubt_s
    if doubtful or state.across > ACROSS_DOUBT:
        withheld = limits.level_hold_s
    if state.branch_s < limits.level_start_s and state.log_probability.max() < np.log(YOUNG):
        withheld = YOUNG_HELD_S
    mean, variance = state.code_shift
    if mean**2 > DRIFT_SIGMAS**2 * variance or state.map_scale > DRIFT_SCALE:
        withheld = limits.level_hold_s
    if state.bank is not None and "map" in state.bank.without:
        k = state.bank.without.index("map")
        aside, variance = (
            state.bank.mean[k, Unknown.MAP_RIGHT],
            state.bank.covariance[k, Unknown.MAP_RIGHT, Unknown.MAP_RIGHT],
        )
        if abs(aside) > max(BESIDE_M, BESIDE_SIGMAS * float(np.sqrt(variance))):
            withheld = limits.level_hold_s
    if state.bank is not None and (state.bank.weak_s > limits.level_doubt_s).any():
        withheld = limits.level_hold_s
    if state.step_s >= STEP_S:
        withheld = STEP_HELD_S
    state.withheld_s = max(state.withheld_s - dt, withheld)
