"""Approximate antenna positions from raw ranges, for computing satellite directions and delays."""

from __future__ import annotations

from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np

from railfix.core.arrays import Floats, Masks, patch_rows
from railfix.positioning.antenna_rows import AntennaRows, Line
from railfix.positioning.gross_errors import gross_alone, gross_errors
from railfix.positioning.normal_equations import SinglePointLimits, point_position
from railfix.positioning.range_arrays import Ranges, without
from railfix.positioning.section_search import SectionLimits, find_section

#: Standard deviation assumed for raw ranges [m].
ANCHOR_SIGMA_M: Final = 10.0
#: The iteration ends if the step is shorter than this [m]. Linearised ranges then have errors of at most 0.03 m.
_TOLERANCE_M: Final = 1000.0
#: Raw 3-D positions are moved to the line if they are at most this far from it [m].
MAX_FROM_LINE_M: Final = 1e5


class ApproximatePosition(NamedTuple):
    """Antenna positions accurate to a few hundred metres, and gross code errors, T epochs by K channels."""

    ecef_m: Floats  #: Antenna position, shape (T, 3).
    arc_m: Floats  #: Arc length of the point of the line nearest to `ecef_m`, shape (T,).
    gross: Masks  #: True for codes with gross errors, shape (T, K).
    unsure: Masks  #: True for epochs with gross errors that cannot be identified, shape (T,).


def approximate_position(
    ranges: Ranges, line: Line, *, limits: SinglePointLimits | None = None, section: SectionLimits | None = None
) -> ApproximatePosition:
    """Estimate approximate positions from raw codes, after rejecting gross errors (P1 2.2(2)).

    The positions are used to compute atmospheric delays. The iteration of every epoch starts from the middle of the
    line, so that epochs are independent. Unless far from the line, the 3-D position is moved to the nearest trajectory
    point. Without a 3-D position, or with a gross error that cannot be identified, the best-fitting point of the line
    is returned. If no point fits, the middle of the line is returned.

    Parameters
    ----------
    ranges : Ranges
        Equally weighted codes, corrected for satellite clock and group delay (`weighted_ranges`).
    line : Trajectory, SearchIndex or AntennaRows
        Trajectory of the antenna.
    limits, section : SinglePointLimits, SectionLimits, optional
        Limits of the 3-D position and of the search for the best-fitting point.
    """
    antennas = AntennaRows.on(line)
    middle = antennas.each(lambda index, rows: index.middle_ecef_m[None].repeat(len(ranges.code_m[rows]), axis=0))
    point = point_position(ranges, middle, limits=_rough(limits or SinglePointLimits()))
    wrong = gross_errors(ranges, antennas, point)
    again = np.flatnonzero(wrong.gross.any(axis=1))
    if len(again):
        ranges = without(ranges, wrong.gross)
        retried = point_position(ranges.take(again), middle[again], limits=_rough(limits or SinglePointLimits()))
        point = patch_rows(point, again, retried)
    alone = gross_alone(ranges.weight, ranges.groups, point.clock_m)
    near = point.ecef_m.copy()
    arc, solved = np.full(len(near), np.nan), np.isfinite(near[:, 0])
    for index, found in antennas.split(solved.nonzero()[0]):
        distance, vertex = index.tree.query(near[found])
        close = np.asarray(distance) < MAX_FROM_LINE_M
        own, vertex = found[close], np.asarray(vertex)[close]
        near[own], arc[own] = index.trajectory.ecef_m[vertex], index.arc_of_points_m[vertex]
    for index, rest in antennas.split((~solved).nonzero()[0]):
        best = find_section(ranges.take(rest), index, point.take(rest), limits=section).vertex
        near[rest] = np.where((best >= 0)[:, None], index.trajectory.ecef_m[best], middle[rest])
    for index, off in antennas.split(np.isnan(arc).nonzero()[0]):
        arc[off], _ = index.trajectory.nearest(near[off])
    of_line = np.isfinite(wrong.unsure_arc_m)
    arc = np.where(of_line, wrong.unsure_arc_m, arc)
    near = np.where(of_line[:, None], antennas.at_arc(arc), near)
    return ApproximatePosition(near, arc, wrong.gross | alone, wrong.unsure)


@lru_cache
def _rough(limits: SinglePointLimits) -> SinglePointLimits:
    return limits.replaced(tolerance_m=max(_TOLERANCE_M, limits.tolerance_m))
