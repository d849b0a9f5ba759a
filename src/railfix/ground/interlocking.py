"""Intervals, authorities, routes and points of a single line with passing loops.

A pure state machine. Occupied by a train is the interval from its last safe rear end to the end of its authority.
Authorities are extended up to the nearest of: another train's interval, points that are not locked and detected for
the train, the end of its route; less a margin. They are shortened by agreement alone (`railfix.ground.stops`);
reports move the intervals (`railfix.ground.supervision`).
It is not a national rule book: no shunting, no overlaps behind signals, no level crossings, no degraded working by
hand.

State of the interlocking as named texts of JSON for the store: its head, a text a train, a text a pair of points.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
from pydantic import Field

from railfix.core.errors import InputFileError
from railfix.core.settings import Settings
from railfix.ground.layout import Layout, PointName, along, overlap

SPEED_ERROR_MPS: Final = 1.0  #: Largest error of a reported speed.
#: Largest sum of over- and under-reading amount of a report that is taken.
WIDEST_M: Final = 1000.0


class InterlockingLimits(Settings):
    """Limits of the interlocking."""

    margin_m: float = Field(default=20.0, ge=0)  #: Kept between the end of an authority and what limits it.
    #: Points are released this long after the safe rear end has passed them.
    release_s: float = Field(default=3.0, ge=0)
    speed_mps: float = Field(default=60.0, gt=0)  #: Highest speed of a train.
    #: Highest acceleration and deceleration, between two reports with speeds.
    acceleration_mps2: float = Field(default=2.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class TrainInterval:
    """Interval and route of a train."""

    train: int
    direction: int
    #: Last safe rear and front ends.
    rear_m: float
    front_m: float
    end_m: float  #: End of the authority.
    sequence: int  #: Newest report.
    tracks: Mapping[int, int]  #: Track in each station of the route.
    station: int  #: Station where the route ends.
    length_m: float  #: Length of the train as configured.
    standstill: bool = True
    #: Safe rear end of the newest report; the interval begins there once the next one confirms it. None where the
    #: newest report does not confirm the train's integrity and length.
    claimed_m: float | None = None
    line: int | None = None  #: Line of the train's reports; None before the first.
    measured_ns: int | None = None  #: Instant of the newest place, on the train's clock; None before the first.
    speed_mps: float | None = None  #: Newest speed.
    stop: str | None = None  #: Why the train is stopped, until it is released by hand.
    asked_m: float | None = None  #: Shorter end of the authority that the train is asked to agree to.
    asked_number: int = 0  #: Number of the first authority that asks for it.
    held: bool = False  #: A route was taken back: the next one is set by hand.

    @cached_property
    def interval_m(self) -> tuple[float, float]:
        """Rear end and furthest end of the occupied interval [m]."""
        return self.rear_m, max(self.end_m * self.direction, self.front_m * self.direction) * self.direction

    @cached_property
    def span_m(self) -> tuple[float, float]:
        """Ends of the occupied interval, lower first [m]."""
        low, high = sorted(self.interval_m)
        return low, high

    def overlaps(self, low_m: float, high_m: float) -> bool:
        """Return whether some chainage between two is occupied."""
        return self.span_m[0] < high_m and low_m < self.span_m[1]

    def has_passed(self, low_m: float, high_m: float) -> bool:
        """Return whether the rear end is beyond what lies between two chainages, in running direction."""
        return self.rear_m >= high_m if self.direction > 0 else self.rear_m <= low_m


@dataclass(frozen=True, kw_only=True)
class PointState:
    """Points as the interlocking knows them."""

    wanted: int = 1  #: Track they are commanded to.
    detected: int | None = 1  #: Track they are detected at; None while they move.
    #: Trains that lock them: None until the train's rear end has passed, then the time of release [s].
    locked: Mapping[int, float | None] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Interlocking:
    """State of the interlocking."""

    trains: Mapping[int, TrainInterval]
    points: Mapping[PointName, PointState]
    stopped: bool = False  #: True while no authority is extended and no route set: satellite positioning is suspended.
    granted: int = 0  #: Number of the last authorities that were sent.
    closed: frozenset[int] = frozenset()  #: Blocks (`Layout.sections`) that no authority reaches into.


class NearbyTrains:
    """Trains by where their intervals and routes are, or come to be by one more route.

    Made once for a step, so that the cost of a step is that of its trains and not of their pairs.
    """

    def __init__(self, state: Interlocking, layout: Layout) -> None:
        self._layout = layout
        self._blocks: dict[int, list[int]] = defaultdict(list)
        last = len(layout.stations) - 1
        for number, train in state.trains.items():
            ahead = layout.stations[min(max(train.station + train.direction, 0), last)]
            furthest = ahead.end_m if train.direction > 0 else ahead.begin_m
            low, high = train.span_m
            for block in layout.blocks_between(min(low, furthest), max(high, furthest)):
                self._blocks[block].append(number)

    def between(self, state: Interlocking, low_m: float, high_m: float) -> Iterator[TrainInterval]:
        """Return the trains, as they are now, that may share some chainage with an interval."""
        numbers = {n: None for block in self._layout.blocks_between(low_m, high_m) for n in self._blocks.get(block, ())}
        return (state.trains[number] for number in numbers)


def with_train(state: Interlocking, train: TrainInterval) -> Interlocking:
    """Return the state with the newer interval of a train."""
    return replace(state, trains={**state.trains, train.train: train})


def stop_trains(state: Interlocking, trains: Iterable[int], reason: str) -> Interlocking:
    """Return the state with trains stopped; one that is stopped already keeps its reason."""
    for number in trains:
        known = state.trains[number]
        state = with_train(state, replace(known, stop=known.stop or reason))
    return state


def stop_orders(state: Interlocking) -> dict[int, str]:
    """Return the trains that are ordered to stop, and why: those stopped themselves, and the nearest on either side."""
    found = {number: train.stop for number, train in state.trains.items() if train.stop is not None}
    if not found:
        return {}
    numbers = list(state.trains)
    low, high = np.array([train.span_m for train in state.trains.values()]).T
    free = np.array([number not in found for number in numbers])
    for k in np.flatnonzero(~free):
        number, first, last = numbers[k], low[k], high[k]
        # those beside it, the nearest on either side, and those beside the nearest: on other tracks of its station
        above, below = low >= last, high <= first
        above[k] = below[k] = False
        reach_high = np.max(high[above & (low == np.min(low, where=above, initial=np.inf))], initial=last)
        reach_low = np.min(low[below & (high == np.max(high, where=below, initial=-np.inf))], initial=first)
        beside = np.flatnonzero(free & (low <= reach_high) & (high >= reach_low))
        free[beside] = False
        found.update((numbers[k], f"train {number} is stopped beside it") for k in beside)
    return found


def points_reported(state: Interlocking, point: PointName, detected: int | None) -> Interlocking:
    """Return the state after a detection of points; where they lose it under a route, its trains are stopped."""
    before = state.points[point]
    state = replace(state, points={**state.points, point: replace(before, detected=detected)})
    if before.detected == before.wanted != detected:
        return stop_trains(state, before.locked, "points of its route have lost their detection")
    return state


def route_requested(
    state: Interlocking,
    train: int,
    layout: Layout,
    *,
    nearby: NearbyTrains | None = None,
    stopped: Mapping[int, str] | None = None,
) -> tuple[Interlocking, tuple[PointName, ...], str | None]:
    """Return the state with a route to the next station, the points to be moved, and the reason of a refusal.

    With `NearbyTrains` and `stop_orders` of the step where they are at hand.
    """
    here = state.trains[train]
    begin, direction = here.station, here.direction
    target = begin + direction
    if here.asked_m is not None:
        return state, (), "a shorter authority is being agreed with the train"
    if state.stopped:
        return state, (), "satellite positioning is suspended"
    if train in (stops := stop_orders(state) if stopped is None else stopped):
        return state, (), f"the train is stopped: {stops[train]}"
    if not 0 <= target < len(layout.stations):
        return state, (), "there is no station ahead"
    if layout.is_reached(target, here.front_m, direction):  # it has a track there, on which it may stand
        return state, (), f"the train is in {layout.stations[target].name}"
    track = 1 if direction > 0 else 2
    section = min(begin, target)
    if state.closed & {2 * target + 1, 2 * section + 2}:
        return state, (), "the section ahead is closed"
    nearby = nearby or NearbyTrains(state, layout)
    for other in nearby.between(state, layout.stations[section].begin_m, layout.stations[section + 1].end_m):
        if other.train == train:
            continue
        stays = other.station == target or other.direction != direction
        ahead = layout.stations[target]
        if other.tracks.get(target) == track and stays and not other.has_passed(ahead.begin_m, ahead.end_m):
            return state, (), f"track {track} of {ahead.name} is taken by train {other.train}"
        if other.direction != direction and _uses_section(other, section, layout):
            return state, (), f"train {other.train} comes the other way"
    needs: dict[PointName, int] = {(begin, direction): here.tracks[begin], (target, -direction): track}
    points, moved = dict(state.points), []
    for name, wanted in needs.items():
        point = points[name]
        if point.wanted != wanted:
            if point.locked or _under_interval(state, name, layout, nearby):
                return state, (), f"points {layout.stations[name[0]].name} are locked"
            moved.append(name)
            point = replace(point, wanted=wanted, detected=None)
        points[name] = replace(point, locked={**point.locked, train: None})
    routed = replace(here, tracks={**here.tracks, target: track}, station=target, held=False)
    return replace(state, trains={**state.trains, train: routed}, points=points), tuple(moved), None


def _uses_section(train: TrainInterval, section: int, layout: Layout) -> bool:
    """Return whether a train's route or interval lies between a station and the next, their points left out."""
    between = layout.stations[section].end_m, layout.stations[section + 1].begin_m
    routed = {section, section + 1} <= set(train.tracks) and not train.has_passed(*between)
    return routed or train.overlaps(*between)


def _under_interval(state: Interlocking, point: PointName, layout: Layout, nearby: NearbyTrains) -> bool:
    low, high = layout.zone_m(point)
    return any(
        train.overlaps(low, high) and overlap(layout.pieces(*train.span_m, train.tracks), [(0, low, high)])
        for train in nearby.between(state, low, high)
    )


def release_points(state: Interlocking, now_s: float, layout: Layout, *, limits: InterlockingLimits) -> Interlocking:
    """Return the state with the points released that safe rear ends have passed long enough ago."""
    points: dict[PointName, PointState] = {}
    for name, point in state.points.items():
        if not point.locked:
            continue
        low, high = layout.zone_m(name)
        locked: dict[int, float | None] = {}
        for train, since in point.locked.items():
            known = state.trains[train]
            due = None if not known.has_passed(low, high) else now_s + limits.release_s if since is None else since
            if due is None or due > now_s:
                locked[train] = due
        if locked != point.locked:
            points[name] = replace(point, locked=locked)
    return replace(state, points={**state.points, **points}) if points else state


def extend_authorities(
    state: Interlocking,
    layout: Layout,
    *,
    limits: InterlockingLimits,
    trains: Iterable[int] | None = None,
    nearby: NearbyTrains | None = None,
    stopped: Mapping[int, str] | None = None,
) -> Interlocking:
    """Return the state with the authorities of trains, of all without `trains`, extended as far as they may be.

    With `NearbyTrains` and `stop_orders` of the step where they are at hand.
    """
    if state.stopped:
        return state
    stopped = stop_orders(state) if stopped is None else stopped
    nearby = nearby or NearbyTrains(state, layout)
    after = dict(state.trains)
    state = replace(state, trains=after)
    for number in list(after) if trains is None else trains:
        train = after[number]
        if number in stopped or train.asked_m is not None:
            continue
        end = _limit_m(state, train, layout, nearby, limits=limits)
        if train.direction * (end - train.end_m) > 0.0:
            after[number] = replace(train, end_m=end)
    return state


def _limit_m(
    state: Interlocking, train: TrainInterval, layout: Layout, nearby: NearbyTrains, *, limits: InterlockingLimits
) -> float:
    """Return the furthest end of a train's authority [m]."""
    direction = train.direction
    end = direction * layout.track_end_m(train.station, direction)
    for name in layout.points_between(*sorted((train.rear_m, direction * end))):
        point = state.points[name]
        near, far = along(layout.zone_m(name), direction)
        if far <= direction * train.rear_m or near >= end:
            continue
        wanted = train.tracks.get(name[0])
        # points that the train stands on, locked by its passage, do not limit it
        if not (train.train in point.locked and point.wanted == wanted == point.detected):
            end = min(end, near)
    for block in state.closed:
        near, far = along(layout.block_m(block), direction)
        if far > direction * train.rear_m:
            end = min(end, near)
    path = layout.pieces(train.rear_m, direction * end, train.tracks)
    first_m, last_m = sorted((train.rear_m, direction * end))
    for other in nearby.between(state, first_m, last_m):
        if other.train == train.train or not other.overlaps(first_m, last_m):
            continue
        for lane, low, high in layout.pieces(*other.span_m, other.tracks):
            for mine, first, last in path:
                if mine == lane and low < last and first < high:
                    end = min(end, direction * (low if direction > 0 else high))
    return direction * (end - limits.margin_m)


#: Name of the text without trains and points, and beginnings of the names of theirs.
HEAD: Final = "interlocking"
_TRAIN, _POINTS = f"{HEAD} train ", f"{HEAD} points "


def to_documents(state: Interlocking, before: Interlocking | None = None) -> dict[str, str]:
    """Return the texts by name; with a state before only those that may have changed since."""
    texts = {HEAD: json.dumps({"stopped": state.stopped, "granted": state.granted, "closed": sorted(state.closed)})}
    trains, points = (before.trains, before.points) if before is not None else ({}, {})
    for number, train in state.trains.items():
        if train is not trains.get(number):
            texts[f"{_TRAIN}{number}"] = json.dumps(_values(train))
    for (station, side), point in state.points.items():
        if point is not points.get((station, side)):
            texts[f"{_POINTS}{station} {side}"] = json.dumps(_values(point))
    return texts


def from_documents(texts: Mapping[str, str]) -> Interlocking:
    """Return the state from its texts. Times of release begin again: the clock of the process before is not known.

    InputFileError: when an older version wrote them.
    """
    head = json.loads(texts[HEAD])
    if "closed" not in head:
        raise InputFileError("the centre's database", "is of an older version of railfix; name another database")
    trains, points = {}, {}
    for name, text in texts.items():
        if name.startswith(_TRAIN):
            values = json.loads(text)
            tracks = {int(station): track for station, track in values.pop("tracks").items()}
            trains[int(name.removeprefix(_TRAIN))] = TrainInterval(**values, tracks=tracks)
        elif name.startswith(_POINTS):
            values = json.loads(text)
            station, side = map(int, name.removeprefix(_POINTS).split())
            points[station, side] = PointState(**values | {"locked": dict.fromkeys(map(int, values["locked"]))})
    # in the order of the line, whatever the order of the texts
    return Interlocking(
        trains=dict(sorted(trains.items())), points=dict(sorted(points.items())), stopped=head["stopped"],
        granted=head["granted"], closed=frozenset(head["closed"]),
    )  # fmt: skip


def _values(record: TrainInterval | PointState) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in fields(record)}
