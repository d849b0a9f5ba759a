"""Detect grossly wrong codes before anything is fitted to all of them.

A least-squares position absorbs a share of every error: one code 10 km off moves it by kilometres, to where no
atmospheric model and no map is valid, and its residuals accuse other satellites. The position with the least sum of
absolute residuals is not moved further by an error that grows: the sum is convex, and each range beyond the others
pulls with the same force.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Integers, Masks, kernel_array
from railfix.positioning.normal_equations import Ranges, normal_equations

#: Raw codes, without atmospheric corrections, are not wrong by this much but for gross errors [m].
GROSS_M: Final = 100.0
#: Largest median residual of the codes that are left: they agree with each other [m].
AGREEING_M: Final = 30.0
#: Redundant ranges that are left after an exclusion in space, so that the rest is still checked.
_LEFT_IN_SPACE: Final = 3
#: Where only one or two are left, the other exclusions must fit worse by this factor.
_CLEARER: Final = 5.0
#: Scales of the residuals from which on a corrected code disagrees with the others.
_DISAGREE: Final = 5.0
_NORMAL_MEDIAN: Final = 0.6745  #: Median of the absolute value of a standard normal variable.
#: Iterations; the least residual that divides a weight, in sigmas, in the first ten of them and later.
_STEPS: Final = 60
_COARSE_STEPS: Final = 10
_COARSE, _FINE = 1.0, 0.3
_LONGEST_STEP_M: Final = 3e6
_SETTLED_M: Final = 0.3
_SINGULAR: Final = 1e-15  #: Determinant of a normal matrix of unit trace.


def least_absolute(ranges: Ranges, start_ecef_m: Floats) -> Floats:
    """Return the positions with the least sum of absolute weighted residuals, each clock free, shape (T, 3) [m].

    Iteratively reweighted least squares from starts (T, 3) [m] within some thousand kilometres. NaN where the ranges
    do not determine a position.
    """
    place, factor = start_ecef_m.copy(), np.ones(ranges.weight.shape)
    root = np.sqrt(ranges.weight)
    going = np.flatnonzero(ranges.n_used - ranges.n_clocks >= 3)
    place[np.setdiff1d(np.arange(len(place)), going)] = np.nan
    for k in range(_STEPS):
        if not len(going):
            break
        part = replace(ranges.take(going), weight=kernel_array(ranges.weight[going] * factor[going]))
        equations = normal_equations(part, place[going])
        step = _step(equations.matrix, equations.vector)
        place[going] += step
        residual = equations.residual_m - np.einsum("tim,ti->tm", equations.design, step)
        least = _COARSE if k < _COARSE_STEPS else _FINE
        factor[going] = 1.0 / np.maximum(np.abs(residual) * root[going], least)
        going = going[np.linalg.norm(step, axis=1) > _SETTLED_M]
    return place


def residuals_at(ranges: Ranges, place_ecef_m: Floats) -> Floats:
    """Return residuals at positions (T, 3) [m], each clock at the median of its ranges; NaN where not used, (T, M)."""
    even = replace(ranges, weight=kernel_array((ranges.weight > 0).astype(np.float64)), ties=None)
    residual = normal_equations(even, np.nan_to_num(place_ecef_m)).residual_m
    value = np.where(ranges.weight > 0, residual, np.nan)
    for group in ranges.groups:
        value[:, group] -= _median(value[:, group])[:, None]
    return value


def _median(values: Floats) -> Floats:
    """Return the median of each row, NaN left out; 0 for a row without any, shape (T,)."""
    some = np.isfinite(values).any(axis=1)
    middle = np.zeros(len(values))
    middle[some] = np.nanmedian(values[some], axis=1)
    return middle


def _freedom(ranges: Ranges, unknowns: int) -> Integers:
    return np.asarray(ranges.n_used - ranges.n_clocks - unknowns, dtype=np.int64)


def gross_in_space(ranges: Ranges, start_ecef_m: Floats) -> Masks:
    """Return the raw codes that are off by more than `GROSS_M`, shape (T, M), where the others agree on a position.

    Three redundant ranges are left and agree. With fewer, one range is accused where leaving it out makes the others
    agree, and leaving out any other one does not.
    """
    place = least_absolute(ranges, start_ecef_m)
    residual = residuals_at(ranges, place)
    gross = np.abs(residual) > GROSS_M
    rest = replace(ranges, weight=np.where(gross, 0.0, ranges.weight))
    located = np.isfinite(place[:, 0])
    agree = _median(np.abs(np.where(gross, np.nan, residual))) < AGREEING_M
    clear = (_freedom(rest, 3) >= _LEFT_IN_SPACE) & agree & located
    found = gross & clear[:, None]
    few = np.flatnonzero(gross.any(axis=1) & ~clear & located & (_freedom(ranges, 3) >= 2))
    if len(few):
        found[few] = _one_of_few(ranges.take(few), place[few])
    return found


def _one_of_few(ranges: Ranges, start_ecef_m: Floats) -> Masks:
    """Return the one range without which the others agree within `AGREEING_M`, shape (T, M); none where two explain."""
    epochs, channels = ranges.weight.shape
    epoch, channel = np.nonzero(ranges.weight > 0)
    each = ranges.take(epoch)
    weight = each.weight.copy()
    weight[np.arange(len(epoch)), channel] = 0.0
    each = replace(each, weight=weight)
    place = start_ecef_m[epoch]
    for _ in range(_COARSE_STEPS):
        equations = normal_equations(each, place)
        place = place + _step(equations.matrix, equations.vector)
    even = replace(each, weight=kernel_array((each.weight > 0).astype(np.float64)))
    freedom = _freedom(each, 3)
    square = normal_equations(even, np.nan_to_num(place)).wsse / np.maximum(freedom, 1)
    size = np.full((epochs, channels), np.inf)
    size[epoch, channel] = np.where((freedom >= 1) & np.isfinite(place[:, 0]), np.sqrt(square), np.inf)
    best = np.argmin(size, axis=1)
    rows = np.arange(epochs)
    least = size[rows, best]
    others = size.copy()
    others[rows, best] = np.inf
    found = np.zeros((epochs, channels), dtype=np.bool_)
    found[rows, best] = (least < AGREEING_M) & (others.min(axis=1) > np.maximum(_CLEARER * least, AGREEING_M))
    return found


def _step(matrix: Floats, vector: Floats) -> Floats:
    """Return the steps of normal equations, shape (T, 3) [m]; NaN where they are singular."""
    trace = np.trace(matrix, axis1=1, axis2=2)[:, None, None]
    singular = ~(np.linalg.det(matrix / np.maximum(trace, 1e-300)) > _SINGULAR)
    solvable = np.where(singular[:, None, None], np.eye(3), matrix)
    step = np.linalg.solve(solvable, vector[..., None])[..., 0]
    step = np.where(singular[:, None], np.nan, step)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, _LONGEST_STEP_M / np.maximum(length, 1.0)))


def disagreeing(ranges: Ranges, start_ecef_m: Floats) -> Masks:
    """Return the corrected ranges that disagree with most others by their sigmas, shape (T, M).

    Residuals at the position of least absolute residuals, beyond `_DISAGREE` robust scales (one sigma at least).
    """
    place = least_absolute(ranges, start_ecef_m)
    white = np.abs(residuals_at(ranges, place)) * np.sqrt(ranges.weight)
    freedom = _freedom(ranges, 3)
    spread = _median(white) * np.sqrt(ranges.n_used / np.maximum(freedom, 1)) / _NORMAL_MEDIAN
    found = white > _DISAGREE * np.maximum(1.0, spread)[:, None]
    rest = replace(ranges, weight=np.where(found, 0.0, ranges.weight))
    enough = (_freedom(rest, 3) >= _LEFT_IN_SPACE) & np.isfinite(place[:, 0])
    return np.asarray(found & enough[:, None])
