"""Section search and constrained position on the line."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from railfix.core.arrays import Indices, patch_rows
from railfix.core.notebook import NotebookTable
from railfix.positioning.antenna_rows import AntennaRows, Line
from railfix.positioning.normal_equations import (
    Constrained,
    ConstrainedLimits,
    SinglePoint,
    SinglePointLimits,
    point_position,
    position_on_line,
)
from railfix.positioning.range_arrays import Ranges
from railfix.positioning.section_search import Section, SectionLimits, find_section


class FixLimits(NamedTuple):
    """Limits of the 3-D position, the section search and the position on the line."""

    min_satellites: int = 3  #: Minimum number of satellites; with 2, sections in sharp curves can be wrong (P1 3.2).
    single_point: SinglePointLimits = SinglePointLimits()
    section: SectionLimits = SectionLimits()
    constrained: ConstrainedLimits = ConstrainedLimits()


@dataclass(frozen=True, kw_only=True, repr=False)
class LineFix(NotebookTable):
    """3-D positions and positions on the line of T epochs, from the same ranges."""

    point: SinglePoint  #: 3-D position without the map.
    section: Section  #: Best-fitting point of the trajectory (section search).
    constrained: Constrained  #: Position on the line.


def fix_on_line(ranges: Ranges, line: Line, point: SinglePoint, limits: FixLimits | None = None) -> LineFix:
    """Compute section and position on the line (P1 2.2(2), (3)); NaN for fewer than `min_satellites` satellites."""
    limits, antennas = limits or FixLimits(), AntennaRows.on(line)
    section = find_section(ranges, antennas, point, limits=limits.section)
    vertex = np.where(ranges.n_used >= limits.min_satellites, section.vertex, -1)
    return LineFix(
        point=point, section=section,
        constrained=position_on_line(ranges, antennas, vertex, limits=limits.constrained),
    )  # fmt: skip


def refit_epochs(ranges: Ranges, antennas: AntennaRows, fix: LineFix, epochs: Indices, limits: FixLimits) -> LineFix:
    """Return a copy of `fix` with the positions of the ascending `epochs` recomputed from `ranges`."""
    for index, own in antennas.split(epochs):
        part = ranges.take(own)
        solved = fix_on_line(
            part, index, point_position(part, fix.point.ecef_m[own], limits=limits.single_point), limits
        )
        fix = LineFix(
            point=patch_rows(fix.point, own, solved.point), section=patch_rows(fix.section, own, solved.section),
            constrained=patch_rows(fix.constrained, own, solved.constrained),
        )  # fmt: skip
    return fix
