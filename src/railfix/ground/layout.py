"""Single-track line with passing loops: stations with two tracks and points at both ends, and sections between."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from scipy.spatial import cKDTree

from railfix.core.arrays import Floats
from railfix.core.errors import MismatchError
from railfix.core.settings import Settings
from railfix.track.network import Network

#: Name of a set of points: number of the station, and end of the station (-1: lower chainage, 1: higher chainage).
PointName = tuple[int, int]
#: Largest number of gradients, and of speed restrictions, in one authority.
MOST_PARTS: Final = 16
#: Piece of track: lane, lower chainage [m] and upper chainage [m]. Lane 0 is the single track including the sets of
#: points; lane 2 k + t is track t of station k.
Piece = tuple[int, float, float]


class LoopStation(Settings):
    """Station with two tracks."""

    name: str
    begin_m: float  #: Chainage of the outer end of the points at lower chainage.
    end_m: float  #: Chainage of the outer end of the points at higher chainage.
    #: Length of each set of points, from its outer end to the position at which the two tracks are clear of each other.
    points_m: float = Field(default=60.0, gt=0)

    @model_validator(mode="after")
    def _tracks_between_points(self) -> Self:
        if self.end_m - self.begin_m <= 2.0 * self.points_m:
            raise ValueError(f"{self.name}: no track is left between the points")
        return self

    @property
    def inner_m(self) -> tuple[float, float]:
        """Chainages at which the two separate tracks begin and end [m]."""
        return self.begin_m + self.points_m, self.end_m - self.points_m


class Gradient(Settings):
    """Gradient that applies up to the chainage of the next gradient; before the first gradient, the line is level."""

    from_m: float
    #: Gradient in thousandths, positive where the track rises with the chainage.
    permille: float = Field(ge=-1000, le=1000)


class Layout(Settings):
    """Line of stations in order of chainage."""

    stations: Annotated[tuple[LoopStation, ...], Field(min_length=2)]
    gradients: tuple[Gradient, ...] = ()  #: Gradients of the line, in order of chainage.

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        names = [station.name for station in self.stations]
        if len(set(names)) < len(names):
            raise ValueError("two stations have the same name")
        for one, other in zip(self.stations[:-1], self.stations[1:], strict=True):
            if other.begin_m <= one.end_m:
                raise ValueError(f"{other.name} begins at {other.begin_m} m, before the end of {one.name}")
        if any(other.from_m <= one.from_m for one, other in pairwise(self.gradients)):
            raise ValueError("gradients must be in order of chainage")
        if len(self.sections) < 4 * len(names) - 1:
            raise ValueError("a station must not have the name of a section")
        return self

    @cached_property
    def _borders_m(self) -> list[float]:
        return [border for station in self.stations for border in (station.begin_m, station.end_m)]

    def stations_between(self, low_m: float, high_m: float) -> range:
        """Return the numbers of the stations that overlap an interval of chainage."""
        return range(bisect_right(self._borders_m, low_m) // 2, (bisect_left(self._borders_m, high_m) + 1) // 2)

    def points_between(self, low_m: float, high_m: float) -> Iterator[PointName]:
        """Return the points of each station that overlaps an interval of chainage."""
        last = len(self.stations) - 1
        between = self.stations_between(low_m, high_m)
        return ((k, side) for k in between for side in (-1, 1) if (k, side) not in ((0, -1), (last, 1)))

    def blocks_between(self, low_m: float, high_m: float) -> range:
        """Return the numbers of the blocks in an interval: 2 k + 1 for station k, and 2 k for the line before it."""
        return range(bisect_left(self._borders_m, low_m), bisect_right(self._borders_m, high_m) + 1)

    @cached_property
    def sections(self) -> dict[str, tuple[Piece, ...]]:
        """Pieces of track by name of section: whole station, single track of a station, or line between stations."""
        found: dict[str, tuple[Piece, ...]] = {}
        for k, station in enumerate(self.stations):
            first, last = station.inner_m
            tracks = {f"{station.name} track {t}": ((2 * k + t, first, last),) for t in (1, 2)}
            points = ((0, station.begin_m, first), (0, last, station.end_m))
            found[station.name] = (points[0], *(piece for (piece,) in tracks.values()), points[1])
            found |= tracks
        for one, other in pairwise(self.stations):
            found[f"{one.name} to {other.name}"] = ((0, one.end_m, other.begin_m),)
        return found

    def section_m(self, name: str) -> tuple[float, float]:
        """Return the chainages of a section, lower first [m]."""
        pieces = self.sections[name]
        return pieces[0][1], pieces[-1][2]

    def gradients_between(self, low_m: float, high_m: float, direction: int) -> tuple[tuple[int, int], ...]:
        """Return chainages [cm] and gradients [1/1000] between two positions.

        Gradients are rounded so that no descent in running direction is understated.

        If there are more than `MOST_PARTS` gradients, only the first in running direction are returned, and the value
        of each is replaced by the steepest descent of the whole range.
        """
        ends = [gradient.from_m for gradient in self.gradients[1:]] + [math.inf] * bool(self.gradients)
        parts = [
            (round(100.0 * g.from_m), direction * math.floor(direction * g.permille))
            for g, end in zip(self.gradients, ends, strict=True)
            if g.from_m < high_m and end > low_m
        ]
        parts, others = (parts[:MOST_PARTS], parts[MOST_PARTS:]) if direction > 0 else (
            parts[-MOST_PARTS:], parts[:-MOST_PARTS])  # fmt: skip
        if others:
            steepest = direction * min(direction * permille for _, permille in (*others, *parts))
            parts = [(chainage, steepest) for chainage, _ in parts]
        return tuple(parts)

    def zone_m(self, point: PointName) -> tuple[float, float]:
        """Return the chainages of the two ends of a set of points, lower first [m]."""
        station = self.stations[point[0]]
        if point[1] < 0:
            return station.begin_m, station.inner_m[0]
        return station.inner_m[1], station.end_m

    def track_end_m(self, station: int, direction: int) -> float:
        """Return the chainage at which the tracks of a station end for a train in a given running direction [m]."""
        first, last = self.stations[station].inner_m
        return last if direction > 0 else first

    def points(self) -> Iterator[PointName]:
        """Return the points of all stations; there are none at the two outer ends of the line."""
        return self.points_between(-math.inf, math.inf)

    def pieces(self, from_m: float, to_m: float, tracks: Mapping[int, int]) -> list[Piece]:
        """Return the pieces of track of an interval; `tracks` is the train's track by station (default 1)."""
        low, high = min(from_m, to_m), max(from_m, to_m)
        pieces, at = [], low
        for k in self.stations_between(low, high):
            station = self.stations[k]
            first, last = station.inner_m
            if last <= low or first >= high:
                continue
            if at < first:
                pieces.append((0, at, first))
            pieces.append((2 * k + tracks.get(k, 1), max(at, first), min(high, last)))
            at = min(high, last)
        if at < high or not pieces:
            pieces.append((0, at, high))
        return pieces

    def is_reached(self, station: int, front_m: float, direction: int) -> bool:
        """Return whether the front of a train with a given running direction is beyond the entry of a station."""
        here = self.stations[station]
        return front_m > here.begin_m if direction > 0 else front_m < here.end_m

    def station_at(self, low_m: float, high_m: float) -> int | None:
        """Return the number of the station whose tracks contain a whole interval, None if there is none."""
        for k in self.stations_between(low_m, high_m):
            station = self.stations[k]
            if station.inner_m[0] <= low_m and high_m <= station.inner_m[1]:
                return k
        return None


def along(between_m: tuple[float, float], direction: int) -> tuple[float, float]:
    """Return the near end and the far end of a range of chainages, as distances in running direction [m]."""
    low, high = between_m
    return (low, high) if direction > 0 else (-high, -low)


def shares(one: Piece, other: Piece) -> bool:
    """Return whether two pieces of track overlap."""
    return one[0] == other[0] and one[1] < other[2] and other[1] < one[2]


def overlap(first: Iterable[Piece], second: Sequence[Piece]) -> bool:
    """Return whether any piece of one list overlaps a piece of another list."""
    return any(shares(a, b) for a in first for b in second)


#: Two tracks are clear of each other if their centrelines are at least this far apart [m].
CLEAR_M: Final = 3.5
#: Largest accepted difference between the lengths of a station's two tracks, which use one chainage [m].
LENGTHS_M: Final = 20.0
#: Spacing of the positions at which two tracks are compared [m].
_STEP_M: Final = 2.0


def derive_layout(network: Network, *, drive: Literal["left", "right"] = "left") -> Layout:
    """Return the layout of a network of tracks that is a single line with passing loops.

    The chainage begins at one end and follows the single track and track 1 of each station. A station is a pair of
    tracks between the same two switches; the line has one track between stations and beyond the outer stations. Points
    extend from the switch to the position at which the two tracks are `CLEAR_M` apart. Track 1 of a station is on the
    left or right (`drive`), seen in the direction of rising chainage. Raise MismatchError if the network is not of this
    kind: if it has several lines, branches, stations with three tracks, or loops of unequal length.
    """
    ends = network.joints.tolist()
    at: dict[int, list[int]] = defaultdict(list)
    for track, (first, last) in enumerate(ends):
        at[first].append(track)
        at[last].append(track)
    outer = sorted(node for node, tracks in at.items() if len(tracks) == 1)
    if len(outer) != 2:
        raise MismatchError(f"the network has {len(outer)} open ends; a single line with passing loops has two")
    node, done, here = outer[0], set[int](), 0.0
    stations: list[LoopStation] = []
    while ahead := [track for track in at[node] if track not in done]:
        done.update(ahead)
        fars = {ends[track][1] if ends[track][0] == node else ends[track][0] for track in ahead}
        names = tuple(network.names[track] for track in ahead)
        if len(ahead) > 2 or len(fars) != 1:
            raise MismatchError(
                f"tracks {', '.join(names)} start at the same switch but do not end at the same switch: this is not a "
                "passing loop"
            )
        far = fars.pop()
        lines = [_points_m(network, track, backward=ends[track][0] != node) for track in ahead]
        if len(ahead) == 2:
            # positive if the second track is to the right of the first
            if (_side(*lines) > 0.0) != (drive == "left"):
                ahead, names, lines = ahead[::-1], names[::-1], lines[::-1]
            stations.append(_station(names, [float(network.length_m[track]) for track in ahead], lines, here))
        here += float(network.length_m[ahead[0]])
        node = far
    if len(done) < len(ends):
        raise MismatchError(f"{len(ends) - len(done)} tracks are not part of the line that begins at an open end")
    if len(stations) < 2:
        raise MismatchError(f"the line has {len(stations)} passing loops; the interlocking needs two stations or more")
    return Layout(stations=tuple(stations))


def _station(names: tuple[str, ...], lengths_m: list[float], lines: list[Floats], begin_m: float) -> LoopStation:
    """Return the station that begins at a chainage; track 1 is the first of its two tracks."""
    if abs(lengths_m[0] - lengths_m[1]) > LENGTHS_M:
        raise MismatchError(
            f"tracks {names[0]} and {names[1]} are {lengths_m[0]:.0f} and {lengths_m[1]:.0f} m long; a "
            f"difference of at most {LENGTHS_M:g} m was expected"
        )
    points = max(_clear_after_m(*lines), _clear_after_m(*(line[::-1] for line in lines)))
    return LoopStation(name=names[0], begin_m=begin_m, end_m=begin_m + lengths_m[0], points_m=round(points + 0.5, 1))


def _points_m(network: Network, track: int, *, backward: bool) -> Floats:
    """Return positions along a track, `_STEP_M` apart, from its end if `backward`; shape (P, 3), ECEF [m]."""
    rows = slice(int(network.first_point[track]), int(network.first_point[track + 1]))
    chainage, points = network.chainage_m[rows], network.points_m[rows]
    along = np.append(np.arange(0.0, chainage[-1], _STEP_M), chainage[-1])
    line = np.stack([np.interp(along, chainage, points[:, k]) for k in range(3)], axis=1)
    return line[::-1] if backward else line


def _side(first: Floats, second: Floats) -> float:
    """Return the lateral offset from the first line to the middle of the second line, positive to the right [m]."""
    middle = len(first) // 2
    ahead = first[middle + 1] - first[middle - 1]
    right = np.cross(ahead / np.linalg.norm(ahead), first[middle] / np.linalg.norm(first[middle]))
    nearest = second[cKDTree(second).query(first[middle])[1]]
    return float((nearest - first[middle]) @ right)


def _clear_after_m(first: Floats, second: Floats) -> float:
    """Return the length from the common end of two lines to the position at which they are `CLEAR_M` apart [m].

    Raise MismatchError if the lines are nowhere `CLEAR_M` apart.
    """
    distance, _ = cKDTree(second).query(first)
    clear = np.flatnonzero(np.asarray(distance) >= CLEAR_M)
    if not len(clear):
        raise MismatchError(f"two tracks of a station are nowhere {CLEAR_M:g} m apart")
    return float(clear[0]) * _STEP_M
