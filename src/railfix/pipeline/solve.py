"""Section search and constrained fix of one antenna."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Integers
from railfix.pipeline.config import Config
from railfix.positioning.constrained import Constrained, constrained_position
from railfix.positioning.normal_equations import Ranges
from railfix.positioning.section_search import SearchIndex, Section, search
from railfix.positioning.single_point import SinglePoint


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


def redundancy_of(ranges: Ranges) -> Integers:
    """Return the number of ranges beyond the clocks and the distance along the line, shape (T,)."""
    return np.asarray(ranges.n_used - ranges.n_clocks - 1, dtype=np.int64)
