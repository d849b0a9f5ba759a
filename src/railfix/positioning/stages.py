"""Positions from plain arrays: 3-D position, section search and constrained fix, each a stage by hand."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats, Indices, Strings
from railfix.positioning.normal_equations import (
    Constrained,
    ConstrainedLimits,
    Ranges,
    SinglePoint,
    SinglePointLimits,
    clock_groups,
    constrained_position,
    single_point,
)
from railfix.positioning.section_search import SearchIndex, Section, SectionLimits, search
from railfix.track.trajectory import Trajectory


def weighted_ranges(satellite_ecef_m: Floats, code_m: Floats, sigma_m: Floats, clock: Strings) -> Ranges:
    """Return ranges to be fitted, each with the weight 1/sigma^2; 0 where code or sigma is NaN.

    Parameters
    ----------
    satellite_ecef_m : ndarray, shape (T, M, 3) [m]
        At the time of transmission.
    code_m, sigma_m : ndarray, shape (T, M) [m]
        Corrected pseudoranges and their standard deviations.
    clock : sequence of str, length M
        Constellation, or letter of the receiver clock, of each channel.
    """
    used = np.isfinite(code_m) & np.isfinite(sigma_m) & np.isfinite(satellite_ecef_m).all(axis=-1)
    return Ranges(
        sat_ecef_m=np.where(used[..., None], satellite_ecef_m, 1e7),
        code_m=np.where(used, code_m, 0.0),
        weight=np.where(used, 1.0 / np.where(used, sigma_m, 1.0) ** 2, 0.0),
        groups=clock_groups(clock),
    )


def point_position(
    satellite_ecef_m: Floats,
    code_m: Floats,
    sigma_m: Floats,
    clock: Strings,
    near_ecef_m: Floats,
    *,
    limits: SinglePointLimits | None = None,
) -> SinglePoint:
    """Compute 3-D positions without the map, one clock a constellation.

    Parameters
    ----------
    satellite_ecef_m, code_m, sigma_m, clock
        As for `weighted_ranges`.
    near_ecef_m : ndarray, shape (3,) or (T, 3) [m]
        Where the iteration starts, good to some thousand kilometres.
    limits : SinglePointLimits, optional
    """
    ranges = weighted_ranges(satellite_ecef_m, code_m, sigma_m, clock)
    return single_point(ranges, np.broadcast_to(near_ecef_m, (len(ranges), 3)), limits=limits)


def find_section(
    satellite_ecef_m: Floats,
    code_m: Floats,
    sigma_m: Floats,
    clock: Strings,
    trajectory: Trajectory | SearchIndex,
    *,
    limits: SectionLimits | None = None,
) -> Section:
    """Find the point of the line that the ranges of each epoch fit best, and the best other place.

    Parameters
    ----------
    satellite_ecef_m, code_m, sigma_m, clock
        As for `weighted_ranges`.
    trajectory : Trajectory or SearchIndex
        Of the antenna; an index made once (`SearchIndex(trajectory)`) saves time in repeated calls.
    limits : SectionLimits, optional
    """
    index = trajectory if isinstance(trajectory, SearchIndex) else SearchIndex(trajectory)
    ranges = weighted_ranges(satellite_ecef_m, code_m, sigma_m, clock)
    start = np.broadcast_to(index.middle_ecef_m, (len(ranges), 3))
    return search(ranges, index, single_point(ranges, start), limits=limits)


def position_on_line(
    satellite_ecef_m: Floats,
    code_m: Floats,
    sigma_m: Floats,
    clock: Strings,
    trajectory: Trajectory,
    vertex: Indices,
    *,
    limits: ConstrainedLimits | None = None,
) -> Constrained:
    """Compute the position along the line of each epoch, started at a point of it.

    Parameters
    ----------
    satellite_ecef_m, code_m, sigma_m, clock
        As for `weighted_ranges`.
    trajectory : Trajectory
        Of the antenna.
    vertex : ndarray of int, shape (T,)
        Point to start from (`Section.vertex` of `find_section`); -1 for no position.
    limits : ConstrainedLimits, optional
    """
    ranges = weighted_ranges(satellite_ecef_m, code_m, sigma_m, clock)
    return constrained_position(ranges, trajectory, vertex, limits=limits)
