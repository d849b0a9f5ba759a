"""Where one set of ranges puts an antenna."""

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
    """Where one set of ranges puts an antenna: in space, at a point of the line, on the line."""

    point: SinglePoint
    section: Section
    constrained: Constrained


def place_on_line(ranges: Ranges, index: SearchIndex, point: SinglePoint, config: Config) -> Place:
    """Section search and constrained position where there are satellites enough."""
    section = search(ranges, index, point, limits=config.section)
    vertex = np.where(ranges.n_used >= config.min_satellites, section.vertex, -1)
    constrained = constrained_position(ranges, index.trajectory, vertex, limits=config.constrained)
    return Place(point=point, section=section, constrained=constrained)


def redundancy_of(ranges: Ranges) -> Integers:
    """Ranges beyond the clocks and the distance along the line, shape (T,)."""
    return np.asarray(ranges.n_used - ranges.n_clocks - 1, dtype=np.int64)
