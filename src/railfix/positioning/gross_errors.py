"""Detection of gross code errors before a least-squares fit to all codes.

A least-squares position absorbs part of every error. A code error of 10 km moves the position by kilometres, to a point
where neither the atmospheric models nor the map are valid and where correct codes may have the largest residuals. The
position with the least sum of absolute residuals is robust: the influence of an outlying range does not depend on the
size of its error.
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

#: Raw code errors (without atmospheric corrections) above this limit are gross errors [m].
GROSS_M: Final = 100.0
#: Codes agree if the median of their absolute residuals is below this limit [m].
AGREEING_M: Final = 30.0
#: Minimum number of redundant ranges that must remain after an exclusion based on a 3-D position.
_LEFT_IN_SPACE: Final = 3
#: With fewer redundant ranges than `_LEFT_IN_SPACE`, a range is excluded only if all other exclusions leave residuals
#: larger by this factor.
_CLEARER: Final = 5.0
#: Corrected codes with residuals above this multiple of the robust scale disagree with the other codes.
_DISAGREE: Final = 5.0
_NORMAL_MEDIAN: Final = 0.6745  #: Median of the absolute value of a standard normal variable.
#: Largest number of iterations. In reweighting, residuals count as at least `_COARSE` sigmas in the first
#: `_COARSE_STEPS` iterations, and as at least `_FINE` sigmas afterwards.
_STEPS: Final = 60
_COARSE_STEPS: Final = 10
_COARSE, _FINE = 1.0, 0.3
_LONGEST_STEP_M: Final = 3e6
_SETTLED_M: Final = 0.3
_SINGULAR: Final = 1e-15  #: A normal matrix of unit trace counts as singular if its determinant is at most this.


def least_absolute(ranges: Ranges, start_ecef_m: Floats) -> Floats:
    """Estimate the positions with the least sum of absolute normalised residuals, shape (T, 3) [m].

    The method is iteratively reweighted least squares. `start_ecef_m`, shape (T, 3), may have errors of a few thousand
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
    """Return residuals at positions (T, 3) after subtracting each clock's median, shape (T, M) [m]; NaN if unused."""
    even = replace(ranges, weight=kernel_array((ranges.weight > 0).astype(np.float64)), ties=None)
    residual = normal_equations(even, np.nan_to_num(place_ecef_m)).residual_m
    value = np.where(ranges.weight > 0, residual, np.nan)
    for group in ranges.groups:
        value[:, group] -= np.nan_to_num(medians(value[:, group]))[:, None]
    return value


def gross_in_space(ranges: Ranges, start_ecef_m: Floats) -> Masks:
    """Find raw codes with gross errors, shape (T, M), at epochs at which the other codes agree on a 3-D position.

    At least `_LEFT_IN_SPACE` redundant ranges must remain and agree. With fewer redundant ranges, a single range is
    rejected if all others agree without it, and if no other single exclusion leads to agreement.
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
    """Return a mask (T, M), true for a range if only its exclusion makes the rest agree within `AGREEING_M`."""
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
    """Return steps of the normal equations, at most `_LONGEST_STEP_M` long, shape (T, 3) [m]; NaN if singular."""
    trace = np.trace(matrix, axis1=1, axis2=2)[:, None, None]
    singular = ~(np.linalg.det(matrix / np.maximum(trace, 1e-300)) > _SINGULAR)
    solvable = np.where(singular[:, None, None], np.eye(3), matrix)
    step = np.linalg.solve(solvable, vector[..., None])[..., 0]
    step = np.where(singular[:, None], np.nan, step)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, _LONGEST_STEP_M / np.maximum(length, 1.0)))


def disagreeing(ranges: Ranges, start_ecef_m: Floats) -> Masks:
    """Find corrected ranges that disagree with the other ranges of an epoch, shape (T, M).

    At the position of least absolute residuals, the residuals of these ranges exceed `_DISAGREE` robust scales. The
    scale is at least one sigma. No range is marked where fewer than `_LEFT_IN_SPACE` redundant ranges would remain.
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
_FINE_M: Final = 12.5  #: Spacing of line points in the fine scan [m].
#: Clocks of constellations normally differ by at most this [m]; in recordings, they differ by up to 71 m.
_CLOCKS_APART_M: Final = 200.0
#: A clock with one or two ranges is not used if it differs from the median clock by more than this [m].
_CLOCK_AWAY_M: Final = 600.0
#: Largest product of the numbers of points, epochs and channels that are computed at once.
_BLOCK: Final = 2_000_000
#: The least cost is clear if all alternatives cost more by this fraction of `GROSS_M`.
_CLEAR: Final = 0.7
#: The search along the line identifies gross errors only at points with which at least this many redundant ranges
#: agree.
_LEFT_ON_LINE: Final = 2


class LineScan(NamedTuple):
    """Best-fitting points of a line for raw ranges of T epochs by M channels."""

    arc_m: Floats  #: Arc length of the best-fitting point, shape (T,).
    gross: Masks  #: True for ranges with a residual above `GROSS_M` at the point, shape (T, M).
    #: Redundancy of the ranges without gross errors, shape (T,); 0 if these ranges do not agree with the point.
    agreeing: Integers
    clear: Masks  #: True if all points at which other ranges have gross errors have a clearly larger cost, shape (T,).


def scan_line(ranges: Ranges, line: Trajectory) -> LineScan:
    """Find, for each epoch, the point of a line at which the raw ranges have the least robust cost.

    Each clock's median residual is subtracted. The cost of a point is the sum of the absolute residuals, each limited
    to `GROSS_M`, so that larger errors do not increase the cost. After a coarse scan of the whole line, the
    surroundings of the best point are scanned finely.
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
    """Return residuals at positions (T, N, 3) after subtracting each clock's median, shape (T, N, M) [m]; NaN if
    unused.

    If residuals of a clock agree with the median of all clocks within `_CLOCKS_APART_M`, only these residuals determine
    the median of the clock. For an even number, the median is the mean of the two middle values, or one of these if its
    `_capped_cost` is clearly smaller. A middle value is necessary because the mean fits no range if half of the ranges
    have gross errors.
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

    gross: Masks  #: True for ranges with gross errors, shape (T, M).
    #: Arc length of the best-fitting point of the line, shape (T,), for epochs with unidentified gross errors or
    #: without a plausible 3-D position; NaN at other epochs.
    unsure_arc_m: Floats
    unsure: Masks  #: True for epochs with gross errors that cannot be identified, shape (T,).


#: Smallest and largest plausible ellipsoidal height of trains, with a margin [m].
_HEIGHTS_M: Final = (-500.0, 10_000.0)
#: Epochs whose raw residuals have a root sum of squares below this are not examined [m].
_QUIET_M: Final = 30.0
#: Epochs whose 3-D position is farther than this from the line are also examined [m].
_BESIDE_M: Final = 1000.0


def gross_errors(ranges: Ranges, antennas: AntennaRows, point: SinglePoint) -> GrossErrors:
    """Find gross errors of raw ranges; `point` are the least-squares 3-D positions of all ranges.

    Epochs with large residuals, or with positions far from the line, are examined. Gross errors are identified at the
    best point of the line (`scan_line`) if redundant ranges agree with it and the cost is clearly larger at all points
    at which other ranges have gross errors. Where the ranges agree with no point of the line, gross errors are
    identified at a 3-D position (`gross_in_space`). If neither method succeeds, the epoch is doubtful (`unsure`). At a
    doubtful epoch, the ranges with gross errors at the best point are also marked, if they are at most half of the
    ranges and redundant ranges agree with the point.
    """
    gross, arc = np.zeros(ranges.weight.shape, dtype=np.bool_), np.full(len(ranges), np.nan)
    unsure = np.zeros(len(ranges), dtype=np.bool_)
    located = np.isfinite(point.ecef_m[:, 0])
    residual = np.where(ranges.weight > 0, point.residual_m, 0.0)
    loud = ~located | ~(np.sqrt((residual**2).sum(axis=1)) < _QUIET_M)
    suspect = loud.copy()
    for index, rows in antennas.split(np.flatnonzero(located)):
        suspect[rows] |= np.asarray(index.tree.query(point.ecef_m[rows])[0]) > _BESIDE_M
    # ranges that agree with a 3-D position have no gross error, even if the map is wrong
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
    """Find ranges of clocks that have few ranges and contradict the other clocks, shape (T, M).

    No other range tests the only range of a separately estimated clock. Each clock (with `ties`, minus its bias) is
    therefore compared with the median of all clocks, weighted by the number of satellites. With `ties`, the only range
    of a clock is marked if the clock differs from the median by more than `GROSS_M`. Without `ties`, the ranges of a
    clock with one or two ranges are marked if the clock differs from the median by more than `_CLOCK_AWAY_M`.
    `clock_m`, shape (T, G), are clocks estimated without ties.
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
