"""Single line with passing loops: stations with two tracks, points at both ends, sections between."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Self

from pydantic import Field, model_validator

from railfix.core.settings import Settings

#: Points: station and side, -1 at its lower end of chainage, 1 at its upper.
PointName = tuple[int, int]
#: Piece of track: lane and chainages, lower first [m]. Lane 0 is the single line with the points.
Piece = tuple[int, float, float]


class LoopStation(Settings):
    """Station with two tracks.

    Attributes
    ----------
    name : str
    begin_m, end_m : float [m]
        Outer ends of the points.
    points_m : float [m]
        Length from the outer end of the points to where the tracks are clear of each other.
    """

    name: str
    begin_m: float
    end_m: float
    points_m: float = Field(default=60.0, gt=0)

    @model_validator(mode="after")
    def _tracks_between_points(self) -> Self:
        if self.end_m - self.begin_m <= 2.0 * self.points_m:
            raise ValueError(f"{self.name}: no track is left between the points")
        return self

    @property
    def inner_m(self) -> tuple[float, float]:
        """Ends of the two tracks between the points [m]."""
        return self.begin_m + self.points_m, self.end_m - self.points_m


class Layout(Settings):
    """Line of stations in order of chainage."""

    stations: Annotated[tuple[LoopStation, ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        names = [station.name for station in self.stations]
        if len(set(names)) < len(names):
            raise ValueError("two stations have the same name")
        for one, other in zip(self.stations[:-1], self.stations[1:], strict=True):
            if other.begin_m <= one.end_m:
                raise ValueError(f"{other.name} begins at {other.begin_m} m, before the end of {one.name}")
        return self

    @cached_property
    def _begins_m(self) -> list[float]:
        return [station.begin_m for station in self.stations]

    @cached_property
    def _ends_m(self) -> list[float]:
        return [station.end_m for station in self.stations]

    @cached_property
    def _borders_m(self) -> list[float]:
        return [border for station in self.stations for border in (station.begin_m, station.end_m)]

    def stations_between(self, low_m: float, high_m: float) -> range:
        """Return the numbers of the stations that share some chainage with an interval."""
        return range(bisect_right(self._ends_m, low_m), bisect_left(self._begins_m, high_m))

    def points_between(self, low_m: float, high_m: float) -> Iterator[PointName]:
        """Return the points of the stations that share some chainage with an interval."""
        last = len(self.stations) - 1
        between = self.stations_between(low_m, high_m)
        return ((k, side) for k in between for side in (-1, 1) if (k, side) not in ((0, -1), (last, 1)))

    def blocks_between(self, low_m: float, high_m: float) -> range:
        """Return the numbers of the blocks that an interval touches: 2 k + 1 is station k, 2 k what lies before it."""
        return range(bisect_left(self._borders_m, low_m), bisect_right(self._borders_m, high_m) + 1)

    @cached_property
    def sections(self) -> dict[str, int]:
        """Blocks by name: stations, and the sections between them."""
        names = [station.name for station in self.stations]
        between = {f"{one} to {other}": 2 * k + 2 for k, (one, other) in enumerate(pairwise(names))}
        return {name: 2 * k + 1 for k, name in enumerate(names)} | between

    def block_m(self, block: int) -> tuple[float, float]:
        """Chainages of a block of `sections`, lower first [m]."""
        return self._borders_m[block - 1], self._borders_m[block]

    def zone_m(self, point: PointName) -> tuple[float, float]:
        """Chainages of points, lower first [m]."""
        station = self.stations[point[0]]
        if point[1] < 0:
            return station.begin_m, station.inner_m[0]
        return station.inner_m[1], station.end_m

    def points(self) -> Iterator[PointName]:
        """All points; the outer ones of the first and the last station do not exist."""
        last = len(self.stations) - 1
        return ((k, side) for k in range(last + 1) for side in (-1, 1) if (k, side) not in ((0, -1), (last, 1)))

    def pieces(self, from_m: float, to_m: float, tracks: Mapping[int, int]) -> list[Piece]:
        """Return the pieces of an interval, given the track in each station (1 where none is given)."""
        low, high = min(from_m, to_m), max(from_m, to_m)
        pieces, at = [], low
        for k in self.stations_between(low, high):
            station = self.stations[k]
            first, last = station.inner_m
            if last <= low or first >= high:
                continue
            if at < first:
                pieces.append((0, at, first))
            pieces.append((lane_of(k, tracks.get(k, 1)), max(at, first), min(high, last)))
            at = min(high, last)
        if at < high or not pieces:
            pieces.append((0, at, high))
        return pieces

    def station_at(self, low_m: float, high_m: float) -> int | None:
        """Return the station whose tracks hold a whole interval, None where there is none."""
        for k in self.stations_between(low_m, high_m):
            station = self.stations[k]
            if station.inner_m[0] <= low_m and high_m <= station.inner_m[1]:
                return k
        return None


def lane_of(station: int, track: int) -> int:
    """Return the number of the lane of a station's track; 0 is the single line."""
    return 2 * station + track


def overlap(first: list[Piece], second: list[Piece]) -> bool:
    """Return whether two lists of pieces share some track."""
    return any(a[0] == b[0] and a[1] < b[2] and b[1] < a[2] for a in first for b in second)
