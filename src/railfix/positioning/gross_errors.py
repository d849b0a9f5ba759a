"""Detect grossly wrong codes before a least-squares fit to all codes.

A least-squares position absorbs part of every error. A code error of 10 km moves the position by kilometres, to a point
at which neither the atmospheric models nor the map are valid. At this point, other satellites may have the largest
residuals. The position with the least sum of absolute residuals does not move further when an error grows, because the
influence of an outlying range does not depend on the size of its error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from railfix.core.array_functions import medians, middle_values
from railfix.core.arrays import Floats, Integers, Masks, kernel_array
from railfix.core.constants import EARTH_ROTATION_RATE, SPEED_OF_LIGHT
from railfix.core.geodesy import geodetic_from_ecef
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.normal_equations import SinglePoint, normal_equations
from railfix.positioning.range_arrays import UNTIED_M, InterSystemBiases, Ranges
from railfix.track.trajectory import Trajectory

#: Errors of raw codes (without atmospheric corrections) above this are gross errors [m].
GROSS_M: Final = 100.0
#: Codes agree with each other if the median of their absolute residuals is below this [m].
AGREEING_M: Final = 30.0
#: Least number of redundant ranges that must remain after an exclusion at a 3-D position, to test the result.
_LEFT_IN_SPACE: Final = 3
#: With fewer redundant ranges, the fit after every other exclusion must be worse by this factor.
_CLEARER: Final = 5.0
#: A corrected code is inconsistent with the other codes if its residual exceeds this multiple of the robust scale.
_DISAGREE: Final = 5.0
_NORMAL_MEDIAN: Final = 0.6745  #: Median of the absolute value of a standard normal variable.
#: Largest number of iterations. Residuals that divide weights are at least `_COARSE` sigmas in the first
#: `_COARSE_STEPS` iterations, and at least `_FINE` sigmas afterwards.
_STEPS: Final = 60
_COARSE_STEPS: Final = 10
_COARSE, _FINE = 1.0, 0.3
_LONGEST_STEP_M: Final = 3e6
_SETTLED_M: Final = 0.3
_SINGULAR: Final = 1e-15  #: A normal matrix of unit trace with a determinant up to this is singular.


def least_absolute(ranges: Ranges, start_ecef_m: Floats) -> Floats:
    """Estimate the positions with the least sum of absolute weighted residuals, clocks eliminated, shape (T, 3) [m].

    The method is iteratively reweighted least squares from `start_ecef_m`, shape (T, 3), accurate to a few thousand
    kilometres. The position is NaN where the ranges do not determine it.
    """
    place, factor = start_ecef_m.copy(), np.ones(ranges.weight.shape)
    root = np.sqrt(ranges.weight)
    going = np.flatnonzero(ranges.space_redundancy >= 0)
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
    """Return residuals at positions (T, 3), minus the median residual of each clock, (T, M) [m]; NaN where not used."""
    even = replace(ranges, weight=kernel_array((ranges.weight > 0).astype(np.float64)), ties=None)
    residual = normal_equations(even, np.nan_to_num(place_ecef_m)).residual_m
    value = np.where(ranges.weight > 0, residual, np.nan)
    for group in ranges.groups:
        value[:, group] -= np.nan_to_num(medians(value[:, group]))[:, None]
    return value


def gross_in_space(ranges: Ranges, start_ecef_m: Floats) -> Masks:
    """Find the raw codes with errors above `GROSS_M`, shape (T, M), where the other codes agree on a 3-D position.

    At least `_LEFT_IN_SPACE` redundant ranges must remain and agree. With fewer redundant ranges, a single range is
    rejected if the other ranges agree without it, and if the exclusion of any other single range does not lead to
    agreement.
    """
    place = least_absolute(ranges, start_ecef_m)
    residual = residuals_at(ranges, place)
    gross = np.abs(residual) > GROSS_M
    rest = replace(ranges, weight=np.where(gross, 0.0, ranges.weight))
    located = np.isfinite(place[:, 0])
    agree = np.nan_to_num(medians(np.abs(np.where(gross, np.nan, residual)))) < AGREEING_M
    clear = (rest.space_redundancy >= _LEFT_IN_SPACE) & agree & located
    found = gross & clear[:, None]
    few = np.flatnonzero(gross.any(axis=1) & ~clear & located & (ranges.space_redundancy >= 2))
    if len(few):
        found[few] = _one_of_few(ranges.take(few), place[few])
    return found


def _one_of_few(ranges: Ranges, start_ecef_m: Floats) -> Masks:
    """Return a mask (T, M) of the range without which all others agree within `AGREEING_M`; empty if ambiguous."""
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
    freedom = each.space_redundancy
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
    """Return the steps of normal equations, at most `_LONGEST_STEP_M` long, shape (T, 3) [m]; NaN if singular."""
    trace = np.trace(matrix, axis1=1, axis2=2)[:, None, None]
    singular = ~(np.linalg.det(matrix / np.maximum(trace, 1e-300)) > _SINGULAR)
    solvable = np.where(singular[:, None, None], np.eye(3), matrix)
    step = np.linalg.solve(solvable, vector[..., None])[..., 0]
    step = np.where(singular[:, None], np.nan, step)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, _LONGEST_STEP_M / np.maximum(length, 1.0)))


def disagreeing(ranges: Ranges, start_ecef_m: Floats) -> Masks:
    """Find the corrected ranges that are inconsistent with the majority of an epoch, shape (T, M).

    The residuals of these ranges at the position of least absolute residuals exceed `_DISAGREE` robust scales, where
    the scale is at least one sigma. No range is marked where fewer than `_LEFT_IN_SPACE` redundant ranges would remain.
    """
    place = least_absolute(ranges, start_ecef_m)
    white = np.abs(residuals_at(ranges, place)) * np.sqrt(ranges.weight)
    freedom = ranges.space_redundancy
    spread = np.nan_to_num(medians(white)) * np.sqrt(ranges.n_used / np.maximum(freedom, 1)) / _NORMAL_MEDIAN
    found = white > _DISAGREE * np.maximum(1.0, spread)[:, None]
    rest = replace(ranges, weight=np.where(found, 0.0, ranges.weight))
    enough = (rest.space_redundancy >= _LEFT_IN_SPACE) & np.isfinite(place[:, 0])
    return np.asarray(found & enough[:, None])


_COARSE_M: Final = 100.0  #: Spacing of line points in the coarse scan [m].
_FINE_M: Final = 12.5  #: Spacing in the fine scan around the best point of the coarse scan [m].
#: Usual limit of the differences between the clocks of constellations [m]: up to 71 m in the recordings.
_CLOCKS_APART_M: Final = 200.0
#: Clocks with one or two ranges that differ from the other clocks by more than this are not used [m].
_CLOCK_AWAY_M: Final = 600.0
#: Largest product of points, epochs and channels that are computed together.
_BLOCK: Final = 2_000_000
#: The cost of every other exclusion must be larger by this fraction of `GROSS_M`.
_CLEAR: Final = 0.7
#: Least number of redundant ranges that must agree with a point of the line.
_LEFT_ON_LINE: Final = 2


class LineScan(NamedTuple):
    """Best points of a line for raw ranges of T epochs by M channels."""

    arc_m: Floats  #: Point with the least cost, shape (T,).
    gross: Masks  #: Ranges whose residuals at the point exceed `GROSS_M`, shape (T, M).
    #: Redundancy of the ranges without gross errors; 0 where these ranges do not agree with the point; shape (T,).
    agreeing: Integers
    clear: Masks  #: Epochs at which all points that imply other gross errors have a clearly larger cost, shape (T,).


def scan_line(ranges: Ranges, line: Trajectory) -> LineScan:
    """Find the point of a line that agrees best with the raw ranges of each epoch, by a robust cost.

    The median residual of each clock is subtracted from the residuals. The cost of a point is the sum of the absolute
    residuals, each limited to `GROSS_M`, so that larger errors do not increase the cost. Points `_COARSE_M` apart are
    evaluated first, then points around the best of these points.
    """
    epochs = len(ranges)
    nodes = np.linspace(line.arc_m[0], line.arc_m[-1], max(int(np.ceil(np.ptp(line.arc_m) / _COARSE_M)), 1) + 1)
    steps = np.arange(-8, 9) * _FINE_M
    arc, gross = np.empty(epochs), np.empty(ranges.weight.shape, dtype=np.bool_)
    residual, clear = np.empty(ranges.weight.shape), np.empty(epochs, dtype=np.bool_)
    count = max(_BLOCK // (len(nodes) * max(ranges.weight.shape[1], 1)), 1)
    for first in range(0, epochs, count):
        rows = slice(first, min(first + count, epochs))
        part = ranges.take(np.arange(rows.start, rows.stop))
        coarse = _line_residuals(part, np.broadcast_to(line.at_arc(nodes), (len(part), len(nodes), 3)))
        cost = _capped_cost(coarse)
        near = np.clip(nodes[cost.argmin(axis=1)][:, None] + steps, nodes[0], nodes[-1])
        fine = _line_residuals(part, line.at_arc(near.ravel()).reshape(*near.shape, 3))
        own = _capped_cost(fine)
        each, best = np.arange(len(part)), own.argmin(axis=1)
        arc[rows], residual[rows] = near[each, best], fine[each, best]
        gross[rows] = np.abs(residual[rows]) > GROSS_M
        others = ((np.abs(coarse) > GROSS_M) & ~gross[rows][:, None]).any(axis=2)
        rival = np.where(others, cost, np.inf).min(axis=1)
        clear[rows] = rival - own[each, best] > _CLEAR * GROSS_M
    rest = replace(ranges, weight=np.where(gross, 0.0, ranges.weight))
    agree = np.nan_to_num(medians(np.abs(np.where(gross, np.nan, residual)))) < AGREEING_M
    return LineScan(arc, gross, np.where(agree, rest.redundancy, 0), clear)


def _line_residuals(ranges: Ranges, place_ecef_m: Floats) -> Floats:
    """Return residuals at positions (T, N, 3), minus the median residual of each clock, (T, N, M) [m]; NaN if unused.

    The median of an even number is the mean of the lower and the upper median, unless one of these has a clearly
    smaller `_capped_cost`. The mean fits no range if half of the ranges have gross errors. If some residuals of a clock
    agree with the median of all residuals to `_CLOCKS_APART_M`, the median of this clock is the median of these
    residuals alone.
    """
    used, satellite = ranges.weight > 0, ranges.sat_ecef_m
    square = -2.0 * (place_ecef_m @ satellite.swapaxes(1, 2))
    square += (place_ecef_m**2).sum(axis=2)[..., None] + (satellite**2).sum(axis=2)[:, None]
    turn = satellite[:, None, :, 0] * place_ecef_m[..., 1, None] - satellite[:, None, :, 1] * place_ecef_m[..., 0, None]
    value = ranges.code_m[:, None] - np.sqrt(square) - EARTH_ROTATION_RATE / SPEED_OF_LIGHT * turn
    value = np.where(used[:, None], value, np.nan)
    near = np.zeros(value.shape, dtype=np.bool_)
    for middle in middle_values(value):
        near |= np.abs(value - middle[..., None]) < _CLOCKS_APART_M
    for group in ranges.groups:
        some = near[..., group].any(axis=2, keepdims=True)
        counted = np.where(near[..., group] | ~some, value[..., group], np.nan)
        low, high = (middle[..., None] for middle in middle_values(counted))
        best = value[..., group] - 0.5 * (low + high)
        for clock in (low, high):
            other = value[..., group] - clock
            better = _capped_cost(other) < _capped_cost(best) - _CLEAR * GROSS_M
            best = np.where(better[..., None], other, best)
        value[..., group] = best
    return np.asarray(value)


def _capped_cost(residual_m: Floats) -> Floats:
    """Return the sum of absolute residuals, each limited to `GROSS_M`, shape (T, N) [m]."""
    return np.asarray(np.nansum(np.minimum(np.abs(residual_m), GROSS_M), axis=2))


class GrossErrors(NamedTuple):
    """Gross errors of raw ranges, T epochs by M channels."""

    gross: Masks  #: Ranges with gross errors, shape (T, M).
    #: Arc length of the best-fitting point of the line, at epochs whose gross errors cannot be identified or whose 3-D
    #: position is missing or implausible; NaN at other epochs; shape (T,).
    unsure_arc_m: Floats
    unsure: Masks  #: Epochs with a grossly wrong range that cannot be identified, shape (T,).


#: Plausible ellipsoidal heights of trains, with a margin [m]. Positions at other heights are not used.
_HEIGHTS_M: Final = (-500.0, 10_000.0)
#: An epoch is examined if the root of the sum of the squared raw residuals is not below this [m].
_QUIET_M: Final = 30.0
#: An epoch is also examined if the 3-D position is farther from the line than this [m].
_BESIDE_M: Final = 1000.0


def gross_errors(ranges: Ranges, antennas: AntennaRows, point: SinglePoint) -> GrossErrors:
    """Find gross errors of raw ranges, given their least-squares 3-D positions `point`.

    Epochs with large residuals, or with positions far from the line, are examined. Gross errors are identified at the
    best point of the line (`scan_line`), if redundant ranges agree with it and the cost of every other exclusion is
    clearly larger. Where the ranges agree with no point of the line, gross errors are identified at a 3-D position
    (`gross_in_space`). Where neither method identifies gross errors, the epoch is unsure. At an unsure epoch, the
    ranges with gross errors at the best point are still returned, so that they do not move the position. This requires
    that they are at most half of the ranges, and that redundant ranges agree with the point.
    """
    gross, arc = np.zeros(ranges.weight.shape, dtype=np.bool_), np.full(len(ranges), np.nan)
    unsure = np.zeros(len(ranges), dtype=np.bool_)
    located = np.isfinite(point.ecef_m[:, 0])
    residual = np.where(ranges.weight > 0, point.residual_m, 0.0)
    loud = ~located | ~(np.sqrt((residual**2).sum(axis=1)) < _QUIET_M)
    suspect = loud.copy()
    for index, rows in antennas.split(np.flatnonzero(located)):
        suspect[rows] |= np.asarray(index.tree.query(point.ecef_m[rows])[0]) > _BESIDE_M
    # ranges that agree in space have no gross error, even if the map is wrong
    largest = np.abs(residual).max(axis=1, initial=0.0)
    agree = located & (ranges.space_redundancy >= _LEFT_IN_SPACE) & (largest < 0.5 * GROSS_M)
    suspect &= ~agree & (ranges.redundancy > 0)
    height = geodetic_from_ecef(np.where(located[:, None], point.ecef_m, [6.4e6, 0.0, 0.0]))[2]
    nowhere = ~located | (height < _HEIGHTS_M[0]) | (height > _HEIGHTS_M[1])
    for index, rows in antennas.split(np.flatnonzero(suspect)):
        part = ranges.take(rows)
        scan = scan_line(part, index.trajectory)
        agreed = scan.agreeing >= _LEFT_ON_LINE
        sure, left, found = agreed & scan.clear, np.flatnonzero(~agreed), np.zeros_like(scan.gross)
        if len(left):
            found[left] = gross_in_space(part.take(left), np.repeat(index.middle_ecef_m[None], len(left), axis=0))
        open_ = ~sure & ~found.any(axis=1)
        doubt = open_ & scan.gross.any(axis=1) & (agreed | loud[rows] | nowhere[rows])
        open_ &= agreed | nowhere[rows] | doubt
        arc[rows[open_]], unsure[rows] = scan.arc_m[open_], doubt
        half = 2 * scan.gross.sum(axis=1) <= part.n_used
        likely = sure | (doubt & (scan.agreeing > 0) & half)
        gross[rows] = np.where(likely[:, None], scan.gross, found)
    return GrossErrors(gross, arc, unsure)


def gross_alone(
    weight: Floats, groups: Sequence[slice], clock_m: Floats, ties: InterSystemBiases | None = None
) -> Masks:
    """Find the ranges of clocks with few ranges where these clocks contradict the other clocks, shape (T, M).

    While a clock is estimated freely, no other range tests the sole range of this clock. With `ties`, the known biases
    test the sole range to `GROSS_M`. Without `ties`, the one or two ranges of a clock are marked if the clock differs
    from the common clock by more than `_CLOCK_AWAY_M`. `clock_m`, shape (T, G), are clocks estimated without ties. The
    common clock is the median of the clocks minus their biases, weighted by the number of satellites.
    """
    found = np.zeros(weight.shape, dtype=np.bool_)
    count = np.add.reduceat((weight > 0).astype(np.int64), [group.start for group in groups], axis=1)
    known, offset = np.isfinite(clock_m), np.zeros(clock_m.shape)
    most, limit_m = 2, _CLOCK_AWAY_M
    if ties is not None:
        known, offset, most, limit_m = known & (ties.sigma_m < UNTIED_M), ties.offset_m, 1, GROSS_M
    few = known & (count >= 1) & (count <= most)
    rows = np.flatnonzero(few.any(axis=1) & (known & (count > most)).any(axis=1))
    if not len(rows):
        return found
    common = np.where(known, clock_m - offset, np.inf)[rows]
    order = np.argsort(common, axis=1)
    satellites = np.take_along_axis(np.where(known, count, 0)[rows], order, axis=1).cumsum(axis=1)
    middle = (2 * satellites >= satellites[:, -1:]).argmax(axis=1)
    median = np.take_along_axis(common, order, axis=1)[np.arange(len(rows)), middle]
    wrong = few[rows] & (np.abs(common - median[:, None]) > limit_m)
    for g, group in enumerate(groups):
        found[rows, group] = wrong[:, g, None] & (weight[rows, group] > 0)
    return found
