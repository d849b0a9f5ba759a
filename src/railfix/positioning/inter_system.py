"""3-D positions of several constellations, whose receiver clocks are tied by the biases known from earlier epochs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Datetimes, Floats, Masks, patch_rows
from railfix.core.epoch_rows import EVERY
from railfix.positioning.gross_errors import gross_alone
from railfix.positioning.normal_equations import SinglePoint, SinglePointLimits, point_position
from railfix.positioning.range_arrays import UNTIED_M, InterSystemBiases, Ranges, without
from railfix.positioning.receiver_noise import ClockOffsetLimits, OffsetState, RobustFitLimits, robust_fit, tie_clocks


class PointPositions(NamedTuple):
    """3-D positions of T epochs, and the ranges with the estimated clocks."""

    untied: Ranges  #: Position with a clock for each constellation.
    ranges: Ranges  #: Position with the inter-system biases known so far.
    point: SinglePoint  #: The conventional position, from the untied ranges.
    tied: SinglePoint  #: From those with known biases.
    #: Ranges that agree with each other in space, and the positions from these.
    agreeing: Ranges
    free: SinglePoint
    ties: InterSystemBiases
    gross: Masks  #: Ranges that are alone on their clock and contradict the known biases grossly, shape (T, K).


class TieLimits(NamedTuple):
    """Limits of the positions, of the robust fit in space, and of the inter-system biases."""

    single_point: SinglePointLimits = SinglePointLimits()
    robust_fit: RobustFitLimits = RobustFitLimits()
    clock_offsets: ClockOffsetLimits = ClockOffsetLimits()


def tie_constellations(
    time: Datetimes,
    clocks: tuple[str, ...],
    ranges: Ranges,
    near_ecef_m: ArrayLike,
    states: Sequence[OffsetState] = (OffsetState(),),
    *,
    reference: str | None = None,
    parts: Sequence[slice] = (EVERY,),
    limits: TieLimits | None = None,
) -> tuple[PointPositions, list[OffsetState]]:
    """Return 3-D positions (P1 5), inter-system biases by the epochs before each, and the state after the last one.

    Each further constellation costs one satellite for its clock, unless its bias is known to a metre. Biases
    are differences of the receiver clocks of positions from ranges that agree with each other, averaged over earlier
    epochs: results do not depend on how a log is cut.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    clocks : tuple of str
        Letter of each receiver clock (`Channels.clocks`).
    ranges : Ranges
        Of `weighted_ranges`.
    near_ecef_m : array_like, shape (3,) or (T, 3) [m]
        Approximate positions.
    states : sequence of OffsetState
        State of each receiver after the earlier epochs; the new states are returned.
    reference : str, optional
        Letter of the clock that biases refer to; by default that of GPS, or the first one without GPS.
    parts : sequence of slice
        Epochs of each receiver.
    limits : TieLimits, optional
    """
    limits = limits or TieLimits()
    near = np.broadcast_to(np.asarray(near_ecef_m, dtype=np.float64), (len(ranges), 3))
    point = point_position(ranges, near, limits=limits.single_point)
    start = np.where(np.isnan(point.ecef_m), near, point.ecef_m)
    agreeing, free = _agreeing(ranges, point, start, limits)
    reference = reference or ("G" if "G" in clocks else clocks[0] if clocks else "G")
    ties, after = tie_clocks(
        time, clocks, reference, agreeing, free, states, parts=parts, limits=limits.clock_offsets
    )  # fmt: skip
    alone = gross_alone(ranges, point.clock_m, ties)
    if alone.any():
        ranges = without(ranges, alone)
    tied, tied_ranges = point, ranges
    if len(ranges.groups) > 1:
        tied_ranges = replace(ranges, ties=ties)
        tied = _tie(tied_ranges, ties, point, start, limits.single_point)
    return PointPositions(ranges, tied_ranges, point, tied, agreeing, free, ties, alone), after


def _tie(
    ranges: Ranges, ties: InterSystemBiases, point: SinglePoint, start_ecef_m: Floats, limits: SinglePointLimits
) -> SinglePoint:
    """Return the 3-D positions with the clocks tied; those with free clocks where no bias is known yet."""
    rows = ((ties.sigma_m < UNTIED_M).sum(axis=1) > 1).nonzero()[0]
    if not len(rows):
        return point
    if len(rows) == len(ranges):
        return point_position(ranges, start_ecef_m, limits=limits)
    return patch_rows(point, rows, point_position(ranges.take(rows), start_ecef_m[rows], limits=limits))


def _agreeing(
    ranges: Ranges, point: SinglePoint, start_ecef_m: Floats, limits: TieLimits
) -> tuple[Ranges, SinglePoint]:
    """Return the ranges that agree with each other in space, and the 3-D positions from these."""
    fit = robust_fit(ranges, start_ecef_m, limits=limits.robust_fit)
    dropped = (ranges.weight > 0) & ~fit.kept
    changed = np.flatnonzero(dropped.any(axis=1))
    if not len(changed):
        return ranges, point
    agreeing = without(ranges, dropped)
    again = point_position(agreeing.take(changed), start_ecef_m[changed], limits=limits.single_point)
    return agreeing, patch_rows(point, changed, again)
