"""Epochs of several antennas as the rows of one set of arrays.

Stages that know neither the line nor earlier epochs take all rows in one call; those that do are called for the rows of
each antenna, and what they return is joined.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.core.epoch_rows import EVERY, join_epochs
from railfix.gnss.observations import Observations, stack_parts
from railfix.positioning.section_search import SearchIndex
from railfix.track.trajectory import between_points

Value = TypeVar("Value")
State = TypeVar("State")


@dataclass(frozen=True)
class AntennaRows:
    """Which rows are of which antenna."""

    indices: tuple[SearchIndex, ...]  #: Of the trajectory of each antenna; their maps have the same sigmas.
    parts: tuple[slice, ...]  #: Rows of each antenna, one after the other; `EVERY` of a single one.

    @classmethod
    def of(cls, index: SearchIndex) -> AntennaRows:
        """Return the rows of one antenna."""
        return cls((index,), (EVERY,))

    @property
    def sigma_plan_m(self) -> float:
        """Standard deviation of the map across the line [m]."""
        return self.indices[0].trajectory.sigma_plan_m

    @property
    def sigma_height_m(self) -> float:
        """Standard deviation of the heights of the map [m]."""
        return self.indices[0].trajectory.sigma_height_m

    def apart(self, function: Callable[..., Value], *of_antennas: Sequence[Any]) -> list[Value]:
        """Return what a function gives for each antenna: of its search index, rows, and one item of each list."""
        return [function(*each) for each in zip(self.indices, self.parts, *of_antennas, strict=True)]

    def each(self, function: Callable[..., Value], *of_antennas: Sequence[Any]) -> Value:
        """Return the same, joined."""
        return join_epochs(self.apart(function, *of_antennas))

    def each_with_state(
        self, function: Callable[..., tuple[Value, State]], *of_antennas: Sequence[Any]
    ) -> tuple[Value, list[State]]:
        """Return the joined first results of a function for each antenna, and a list of its second ones."""
        found = self.apart(function, *of_antennas)
        return join_epochs([rows for rows, _ in found]), [state for _, state in found]

    def split(self, rows: Indices) -> Iterator[tuple[SearchIndex, Indices]]:
        """Yield the search index and the rows of each antenna that has any of some rising ones."""
        if len(self.parts) == 1:
            if len(rows):
                yield self.indices[0], rows
            return
        for index, part in zip(self.indices, self.parts, strict=True):
            own = rows[(rows >= part.start) & (rows < part.stop)]
            if len(own):
                yield index, own

    @cached_property
    def _first(self) -> Indices | int:
        """Place of the first point of each epoch's line among those of all lines."""
        if len(self.parts) == 1:
            return 0
        return np.repeat(_lines(self.indices).first, [part.stop - part.start for part in self.parts])

    def at_arc(self, arc_m: Floats) -> Floats:
        """Return the points of the lines at arc lengths, shape (T, 3) [m]; NaN for NaN."""
        return self._interpolate(arc_m, _lines(self.indices).ecef_m)

    def chainage_at(self, arc_m: Floats) -> Floats:
        """Return chainages at arc lengths, shape (T,) [m]; NaN for NaN."""
        return self._interpolate(arc_m, _lines(self.indices).chainage_m)

    def segment_at(self, arc_m: Floats) -> Indices:
        """Return the section of each arc length on its line, shape (T,), as `Trajectory.segment_at`."""
        section = np.empty(len(arc_m), dtype=np.intp)
        for index, rows in zip(self.indices, self.parts, strict=True):
            of_line = index.trajectory.arc_m
            found = of_line.searchsorted(arc_m[rows], side="right") - 1
            section[rows] = np.minimum(np.maximum(found, 0), len(of_line) - 2)
        return section

    def get_axes(self, section: Indices) -> Floats:
        """Return the unit vectors along, across and up at sections of the lines, shape (T, 3, 3)."""
        return np.asarray(_lines(self.indices).axes[section + self._first])

    def _interpolate(self, arc_m: Floats, values: Floats) -> Floats:
        """Interpolate values of the points of all lines at arc lengths."""
        lines = _lines(self.indices)
        return between_points(arc_m, lines.arc_m, lines.length_m, values, self.segment_at(arc_m) + self._first)


class _Lines(NamedTuple):
    """Points of several lines, one line after the other, and the sections that begin there; none does at a last one."""

    first: Indices  #: First point of each line.
    #: Of V points.
    arc_m: Floats
    ecef_m: Floats
    chainage_m: Floats
    #: Of the sections, shapes (V,), (V, 3, 3): along, across, up.
    length_m: Floats
    axes: Floats


@lru_cache(maxsize=4)
def _lines(indices: tuple[SearchIndex, ...]) -> _Lines:
    lines = [index.trajectory for index in indices]
    points = np.cumsum([0, *map(len, lines)])
    length, axes = np.full(points[-1], np.nan), np.full((points[-1], 3, 3), np.nan)
    for line, first in zip(lines, points[:-1].tolist(), strict=True):
        own = slice(first, first + len(line) - 1)
        length[own], axes[own] = line.length_m, line.get_axes(np.arange(len(line) - 1))
    arc, ecef, chainage = (
        np.concatenate([getattr(line, n) for line in lines]) for n in ("arc_m", "ecef_m", "chainage_m")
    )
    return _Lines(points[:-1].astype(np.intp), arc, ecef, chainage, length, axes)


def stack_observations(observations: Sequence[Observations]) -> tuple[Observations, tuple[slice, ...]]:
    """Return the observations of several antennas, with all their channels, as rows; and the rows of each."""
    first, *others = observations
    if not others:
        return first, (EVERY,)
    ends = [0, *accumulate(map(len, observations))]
    same = all(_has_same_channels(first, other) for other in others)
    stacked = join_epochs(observations) if same else stack_parts(observations)
    return stacked, tuple(slice(a, b) for a, b in pairwise(ends))


def _has_same_channels(first: Observations, other: Observations) -> bool:
    """Whether two receivers have the same channels in the same order, and GLONASS satellites the same frequencies."""
    return (
        first.satellite.tobytes() == other.satellite.tobytes()
        and first.signal.tobytes() == other.signal.tobytes()
        and first.header.glonass_channel == other.header.glonass_channel
    )
