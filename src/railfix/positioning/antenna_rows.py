"""Assignment of array rows to the antennas of a train.

The epochs of several antennas are rows of the same arrays. Stages that depend on neither the line nor earlier epochs
process all rows in one call. Other stages process the rows of each antenna separately.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from railfix.core.arrays import Floats, Indices
from railfix.core.epoch_rows import EVERY, join_epochs
from railfix.positioning.search_index import SearchIndex
from railfix.track.trajectory import Trajectory

Value = TypeVar("Value")
State = TypeVar("State")


@dataclass(frozen=True)
class AntennaRows:
    """Assignment of array rows to antennas."""

    indices: tuple[SearchIndex, ...]  #: Search index of each antenna's trajectory; all maps have the same sigmas.
    parts: tuple[slice, ...]  #: Rows of each antenna, in the order of `indices`; `EVERY` for a single antenna.

    @classmethod
    def on(cls, line: Trajectory | SearchIndex | AntennaRows) -> AntennaRows:
        """Return `line` if it is an `AntennaRows`, else an assignment of all rows to one antenna on `line`."""
        if isinstance(line, AntennaRows):
            return line
        return cls((line if isinstance(line, SearchIndex) else SearchIndex(line),), (EVERY,))

    @property
    def sigma_plan_m(self) -> float:
        """Standard deviation of the lateral map error [m]."""
        return self.indices[0].trajectory.sigma_plan_m

    @property
    def sigma_height_m(self) -> float:
        """Standard deviation of the vertical map error [m]."""
        return self.indices[0].trajectory.sigma_height_m

    @property
    def lines(self) -> list[tuple[Trajectory, slice]]:
        """Trajectory and rows of each antenna."""
        return [(index.trajectory, rows) for index, rows in zip(self.indices, self.parts, strict=True)]

    def apart(self, function: Callable[..., Value], *of_antennas: Sequence[Any]) -> list[Value]:
        """Call a function with each antenna's search index, rows and item of each list; return all results."""
        return [function(*each) for each in zip(self.indices, self.parts, *of_antennas, strict=True)]

    def each(self, function: Callable[..., Value], *of_antennas: Sequence[Any]) -> Value:
        """Call a function for each antenna (see `apart`) and return the results joined along the rows."""
        return join_epochs(self.apart(function, *of_antennas))

    def each_with_state(
        self, function: Callable[..., tuple[Value, State]], *of_antennas: Sequence[Any]
    ) -> tuple[Value, list[State]]:
        """Call `function`, which returns a value and a state, for each antenna; return joined values and all states."""
        found = self.apart(function, *of_antennas)
        return join_epochs([rows for rows, _ in found]), [state for _, state in found]

    def split(self, rows: Indices) -> Iterator[tuple[SearchIndex, Indices]]:
        """Yield the search index of each antenna and its rows out of `rows` (ascending); skip antennas without rows."""
        if len(self.parts) == 1:
            if len(rows):
                yield self.indices[0], rows
            return
        for index, part in zip(self.indices, self.parts, strict=True):
            own = rows[(rows >= part.start) & (rows < part.stop)]
            if len(own):
                yield index, own

    def at_arc(self, arc_m: Floats) -> Floats:
        """Return the ECEF positions on the lines at arc lengths, shape (T, 3) [m]; NaN where the arc length is NaN."""
        return self.each(lambda index, rows: index.trajectory.at_arc(arc_m[rows]))

    def chainage_at(self, arc_m: Floats) -> Floats:
        """Return the chainages at arc lengths, shape (T,) [m]; NaN where the arc length is NaN."""
        return self.each(lambda index, rows: index.trajectory.chainage_at(arc_m[rows]))

    def segment_at(self, arc_m: Floats) -> Indices:
        """Return the index of the section that contains each arc length (`Trajectory.segment_at`), shape (T,)."""
        return self.each(lambda index, rows: index.trajectory.segment_at(arc_m[rows])[0])

    def get_axes(self, section: Indices) -> Floats:
        """Return the unit vectors along, across and up at sections of the lines, shape (T, 3, 3)."""
        return self.each(lambda index, rows: index.trajectory.get_axes(section[rows]))


#: Line argument of a stage: one antenna's trajectory or its search index, or the lines of several antennas.
Line = Trajectory | SearchIndex | AntennaRows
