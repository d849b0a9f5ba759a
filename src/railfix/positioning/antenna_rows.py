"""Epochs of several antennas as the rows of one set of arrays.

Stages that know neither the line nor earlier epochs take all rows in one call; those that do are called for the rows of
each antenna, and what they return is joined.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, cached_property, lru_cache
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar, cast

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.gnss.observations import Observations, stack_parts
from railfix.positioning.section_search import SearchIndex
from railfix.track.trajectory import between_points

Value = TypeVar("Value")
State = TypeVar("State")
#: Members that are the same for all rows: of the channels alone.
_OF_CHANNELS: Final = frozenset({"satellite", "signal", "frequency_hz", "channels", "columns", "header"})
EVERY: Final = slice(None)  #: All rows.


class OnDemand:
    """Base of dataclasses with fields that are computed when they are first asked for: most are not, epoch by epoch."""

    @classmethod
    def create(cls: type[Value], later: Callable[[str], Mapping[str, Any]], **members: Any) -> Value:
        """Return an instance with some fields; `later` returns another by its name, and those made with it."""
        return cast(Value, _make(cls, {**members, "_later": later}))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            own = self.__dict__
            if "_later" not in own or name not in _members(self.__class__):
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            own.update(own["_later"](name))
            return own[name]

    def __getstate__(self) -> dict[str, Any]:
        """Return all fields, for another process."""
        return {name: getattr(self, name) for name in _members(cast(Any, type(self)))}


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


@cache
def _members(kind: Any) -> dict[str, bool]:
    """Return whether each member of a dataclass has rows, or may have; none for other types."""
    return {f.name: f.name not in _OF_CHANNELS for f in fields(kind)} if is_dataclass(kind) else {}


@cache
def _defaults(kind: Any) -> tuple[str, ...]:
    """Return the members of a dataclass that have a default."""
    return tuple(name for name in _members(kind) if hasattr(kind, name))


def join_epochs(values: Sequence[Value]) -> Value:
    """Join arrays row after row, or those of dataclasses or of tuples; what is neither is that of the first."""
    first: Any = values[0]
    if len(values) == 1:
        return values[0]
    if type(first) is tuple:
        return cast(Value, tuple(_join(column) for column in zip(*cast(Any, values), strict=True)))
    return cast(Value, _join(values))


def _join(values: Sequence[Any]) -> Any:
    first = values[0]
    if first.__class__ is np.ndarray:
        return np.concatenate(values)
    if not (has_rows := _members(first.__class__)):
        return first
    return _make(
        type(first),
        {n: _join([getattr(v, n) for v in values]) if rows else getattr(first, n) for n, rows in has_rows.items()},
    )


def take_epochs(value: Value, rows: slice | Indices) -> Value:
    """Return some rows of an array, or of the arrays of a dataclass and of those within it."""
    return value if rows is EVERY else cast(Value, _take_epochs(value, rows))


def _take_epochs(value: Any, rows: slice | Indices) -> Any:
    if value.__class__ is np.ndarray:
        return value[rows]
    if not (has_rows := _members(value.__class__)):
        return value
    own, members = value.__dict__, {}
    if isinstance(value, OnDemand):
        for name, item in own.items():
            if item.__class__ is np.ndarray and has_rows[name]:
                members[name] = item[rows]
        for name in _defaults(cast(Any, value.__class__)):  # they would hide that a field is to be taken
            members[name] = _take_epochs(own[name], rows)
        return value.create(
            lambda n: {n: _take_epochs(getattr(value, n), rows) if has_rows[n] else getattr(value, n)}, **members
        )
    for name, of_rows in has_rows.items():
        item = own[name]
        if of_rows and item is not None:
            item = item[rows] if item.__class__ is np.ndarray else _take_epochs(item, rows)
        members[name] = item
    return _make(type(value), members)


def _make(kind: Any, members: dict[str, Any]) -> Any:
    """Return a dataclass with given members, which have been checked before."""
    instance = object.__new__(kind)
    instance.__dict__.update(members)
    return instance
