"""Section search and constrained fix of one antenna, and the linear model there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Indices, Integers
from railfix.integrity.raim.model import LinearModel, model_on_line
from railfix.pipeline.config import Config
from railfix.pipeline.results import patched
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.constrained import Constrained, constrained_position
from railfix.positioning.normal_equations import Ranges
from railfix.positioning.section_search import SearchIndex, Section, search
from railfix.positioning.single_point import SinglePoint, single_point


@dataclass(frozen=True, kw_only=True)
class Place:
    """Positions of one antenna from one set of ranges, T epochs.

    Attributes
    ----------
    point : SinglePoint
        3-D position without the map.
    section : Section
        Best-fitting vertex of the trajectory.
    constrained : Constrained
        Position on the line.
    """

    point: SinglePoint
    section: Section
    constrained: Constrained


def place_on_line(ranges: Ranges, index: SearchIndex, point: SinglePoint, config: Config) -> Place:
    """Return section and constrained position of the epochs that have `Config.min_satellites`.

    Parameters
    ----------
    ranges : Ranges
    index : SearchIndex
    point : SinglePoint
        3-D position from the same ranges.
    config : Config
    """
    section = search(ranges, index, point, limits=config.section)
    vertex = np.where(ranges.n_used >= config.min_satellites, section.vertex, -1)
    constrained = constrained_position(ranges, index.trajectory, vertex, limits=config.constrained)
    return Place(point=point, section=section, constrained=constrained)


def solved_again(ranges: Ranges, index: SearchIndex, place: Place, epochs: Indices, config: Config) -> Place:
    """Return positions of which those of some epochs of one antenna are solved again, from other ranges."""
    part = ranges.take(epochs)
    point = single_point(part, place.point.ecef_m[epochs], limits=config.single_point)
    solved = place_on_line(part, index, point, config)
    return Place(
        point=patched(place.point, epochs, solved.point),
        section=patched(place.section, epochs, solved.section),
        constrained=patched(place.constrained, epochs, solved.constrained),
    )


def line_model(ranges: Ranges, antennas: AntennaRows, constrained: Constrained) -> LinearModel:
    """Return the model of positions on the line (`constrained_model`); NaN in the epochs without one."""
    section = np.maximum(constrained.section, 0)
    axes = antennas.each(lambda index, rows: index.trajectory.axes_of(section[rows]))
    place = antennas.at_arc(constrained.arc_m)
    return model_on_line(ranges, place, axes, antennas.sigma_plan_m, antennas.sigma_height_m)


def redundancy_of(ranges: Ranges) -> Integers:
    """Return the number of ranges beyond the clocks and the distance along the line, shape (T,)."""
    return np.asarray(ranges.n_used - ranges.n_clocks - 1, dtype=np.int64)
