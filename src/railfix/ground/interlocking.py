"""Authorities, routes and points of a single-track line with passing loops.

A pure state machine. A train occupies the interval from its last safe rear end to the end of its authority. An
authority is extended up to the nearest of these limits, less a margin: another train's interval, a section that is
closed or occupied, points that are not both locked and detected for the train, or the end of the train's route.
Authorities are shortened only by agreement with the train (`railfix.ground.stops`). Reports move the intervals
(`railfix.ground.reports`). Shunting, overlaps behind signals, level crossings and degraded working by hand are not
modelled.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from railfix.ground.layout import Layout, Piece, PointName, along, shares
from railfix.ground.state import Interlocking, InterlockingLimits, PointState, TrainInterval, stop_trains


class NearbyTrains:
    """Index of trains by block of the line; a train's blocks cover its interval, route and next route.

    With this index, the time of a step grows with the number of trains, not with the number of pairs of trains.
    `update` locates only trains whose interval or route has changed.
    """

    def __init__(self, state: Interlocking, layout: Layout) -> None:
        self._layout = layout
        self._blocks: dict[int, set[int]] = defaultdict(set)
        #: Record and blocks of each train at the last update.
        self._located: dict[int, tuple[TrainInterval, range]] = {}
        self.update(state)

    def update(self, state: Interlocking) -> None:
        """Update the index to a newer state."""
        for number in self._located.keys() - state.trains.keys():
            self._move(range(0), number, self._located.pop(number)[1])
        for number, train in state.trains.items():
            if (before := self._located.get(number)) is None:
                known, blocks = train, range(0)
            elif train is before[0]:
                continue
            else:
                known, blocks = before
            if before is None or _place(known) != _place(train):
                self._move(after := self._blocks_of(train), number, blocks)
                blocks = after
            self._located[number] = train, blocks

    def _blocks_of(self, train: TrainInterval) -> range:
        """Return the blocks from the rear of a train to the end of its next route."""
        last = len(self._layout.stations) - 1
        ahead = self._layout.stations[min(max(train.station + train.direction, 0), last)]
        furthest = ahead.end_m if train.direction > 0 else ahead.begin_m
        low, high = train.span_m
        return self._layout.blocks_between(min(low, furthest), max(high, furthest))

    def _move(self, blocks: range, number: int, before: range) -> None:
        """Enter a train in the new blocks (`blocks`), and remove the train from its earlier blocks (`before`)."""
        if blocks == before:
            return
        for block in before:
            self._blocks[block].discard(number)
        for block in blocks:
            self._blocks[block].add(number)

    def between(self, state: Interlocking, low_m: float, high_m: float) -> Iterator[TrainInterval]:
        """Return the trains that may overlap a range of chainages, in order of train number."""
        numbers = {n for block in self._layout.blocks_between(low_m, high_m) for n in self._blocks.get(block, ())}
        return (state.trains[number] for number in sorted(numbers))


def _place(train: TrainInterval) -> tuple[object, ...]:
    """Return the values that determine the blocks of a train."""
    return train.span_m, train.station, train.direction


def stop_orders(state: Interlocking) -> dict[int, str]:
    """Return the trains that must stop, with reasons: stopped trains, and the trains nearest to each stopped train."""
    found = {number: train.stop for number, train in state.trains.items() if train.stop is not None}
    if not found:
        return {}
    by_low = sorted((*train.span_m, number) for number, train in state.trains.items())
    by_high = sorted((high, low) for low, high, _ in by_low)
    free = [span for span in by_low if span[2] not in found]
    for number in list(found):
        # Range that includes the nearest train on either side. The range also overlaps trains on other tracks of the
        # stations in which the stopped train and its nearest trains are.
        low, high = state.trains[number].span_m
        if (k := bisect_left(by_low, (high,))) < len(by_low):
            high = by_low[bisect_right(by_low, (by_low[k][0], math.inf)) - 1][1]
        if k := bisect_right(by_high, (low, math.inf)):
            low = by_high[bisect_left(by_high, (by_high[k - 1][0],))][1]
        beside = [span for span in free if span[0] <= high and span[1] >= low]
        found.update((span[2], f"the neighbouring train {number} is stopped") for span in beside)
        free = [span for span in free if span not in beside] if beside else free
    return found


def points_reported(state: Interlocking, point: PointName, detected: int | None, layout: Layout) -> Interlocking:
    """Return the state after points were reported as detected for track `detected`, or as undetected (None).

    Trains that lock the points are stopped if the detection of the points is lost. If points without detection are
    detected again, but not in the commanded position, trains on the points are stopped. Points that no train locks
    remain in their detected position.
    """
    before = state.points[point]
    after = replace(before, detected=detected)
    if detected is not None and not before.commanded and not before.locked:
        after = replace(after, wanted=detected, commanded=True)
    state = replace(state, points={**state.points, point: after})
    lost = before.lies and not state.points[point].lies
    answered = before.detected is None and detected is not None and not state.points[point].lies
    if lost:
        return stop_trains(state, before.locked, "points of its route have lost their detection")
    if answered:
        low, high = layout.zone_m(point)
        under = [number for number in before.locked if state.trains[number].overlaps(low, high)]
        return stop_trains(state, under, "points of its route are detected in another position")
    return state


def route_requested(
    state: Interlocking,
    train: int,
    layout: Layout,
    *,
    nearby: NearbyTrains | None = None,
    stopped: Mapping[int, str] | None = None,
) -> tuple[Interlocking, tuple[PointName, ...], str | None]:
    """Set a route to the next station; return the new state, the points to be moved, and the reason for a refusal.

    `nearby` and `stopped` (`stop_orders`) are computed if they are not given.
    """
    here = state.trains[train]
    begin, direction = here.station, here.direction
    target = begin + direction
    track = 1 if direction > 0 else 2
    nearby = nearby or NearbyTrains(state, layout)
    reason = _refusal(state, here, layout, stop_orders(state) if stopped is None else stopped)
    reason = reason or _taken(state, here, layout, nearby)
    if reason is not None:
        return state, (), reason
    needs: dict[PointName, int] = {(target, -direction): track}
    if not here.has_passed(*layout.zone_m((begin, direction))):
        needs[begin, direction] = here.tracks[begin]
    points, moved = dict(state.points), []
    for name, wanted in needs.items():
        point = points[name]
        if point.wanted != wanted or (point.detected is not None and point.detected != wanted and point.commanded):
            if not is_free(state, name, layout, nearby):
                return state, (), f"points {layout.stations[name[0]].name} are locked"
            moved.append(name)
            point = replace(point, wanted=wanted, commanded=False)
        points[name] = replace(point, locked={**point.locked, train: None})
    routed = replace(here, tracks={**here.tracks, target: track}, station=target, held=False)
    return replace(state, trains={**state.trains, train: routed}, points=points), tuple(moved), None


def _refusal(state: Interlocking, here: TrainInterval, layout: Layout, stopped: Mapping[int, str]) -> str | None:
    """Return the reason for refusing a route, without regard to other trains' intervals; None if there is no reason."""
    target = here.station + here.direction
    if here.asked_m is not None:
        return "a shorter authority is being agreed with the train"
    if state.stopped:
        return "satellite positioning is suspended"
    if here.train in stopped:
        return f"the train is stopped: {stopped[here.train]}"
    if not 0 <= target < len(layout.stations):
        return "there is no station ahead"
    if reached(here, target, layout):  # the train already has a track in this station, on which it may stop
        return f"the train is in {layout.stations[target].name}"
    for name in ((here.station, here.direction), (target, -here.direction)):
        if not state.points[name].commanded and state.points[name].detected is None:
            return f"the detection of points {layout.stations[name[0]].name} is awaited"
    return None


def reached(train: TrainInterval, station: int, layout: Layout) -> bool:
    """Return whether the front of a train is in a station, or beyond the station."""
    return layout.is_reached(station, train.front_m, train.direction)


def _taken(state: Interlocking, here: TrainInterval, layout: Layout, nearby: NearbyTrains) -> str | None:
    """Return the obstacle on a train's path to and through the next station; None if there is none."""
    direction, target = here.direction, here.station + here.direction
    track, section, ahead = 1 if direction > 0 else 2, min(here.station, target), layout.stations[target]
    end = layout.track_end_m(target, direction)
    if state.bars:
        path = layout.pieces(here.front_m, end, {**here.tracks, target: track})
        if (bar := barred(state, path, layout)) is not None:
            return f"{bar[0]} is {bar[1]}"
    for other in nearby.between(state, layout.stations[section].begin_m, layout.stations[section + 1].end_m):
        if other.train == here.train:
            continue
        stays = other.station == target or other.direction != direction
        if other.tracks.get(target) == track and stays and not other.has_passed(ahead.begin_m, ahead.end_m):
            return f"track {track} of {ahead.name} is occupied or reserved by train {other.train}"
        if comes_the_other_way(other, direction, section, layout):
            return f"train {other.train} comes from the opposite direction"
    return None


def barred(state: Interlocking, path: list[Piece], layout: Layout) -> tuple[str, str] | None:
    """Return the name of a closed section that shares track with a path, and the reason; None if there is none."""
    for name, kind in sorted(state.bars):
        if any(shares(piece, mine) for piece in layout.sections[name] for mine in path):
            return name, kind
    return None


def comes_the_other_way(other: TrainInterval, direction: int, section: int, layout: Layout) -> bool:
    """Return whether an opposing train has its route or interval between stations `section` and `section` + 1.

    The points of both stations are not considered.
    """
    if other.direction == direction:
        return False
    between = layout.stations[section].end_m, layout.stations[section + 1].begin_m
    routed = section in other.tracks and section + 1 in other.tracks and not other.has_passed(*between)
    return routed or other.overlaps(*between)


def is_free(state: Interlocking, point: PointName, layout: Layout, nearby: NearbyTrains) -> bool:
    """Return whether points may be moved: not locked, and not in any interval or closed section."""
    return not (state.points[point].locked or under_interval(state, point, layout, nearby))


def under_interval(state: Interlocking, point: PointName, layout: Layout, nearby: NearbyTrains) -> bool:
    """Return whether any train's interval, or any closed section, includes a set of points."""
    zone: Piece = (0, *layout.zone_m(point))
    if barred(state, [zone], layout) is not None:
        return True
    return any(
        train.overlaps(*zone[1:]) and any(shares(zone, p) for p in layout.pieces(*train.span_m, train.tracks))
        for train in nearby.between(state, *zone[1:])
    )


def due_commands(
    state: Interlocking, layout: Layout, stored: Interlocking, nearby: NearbyTrains | None = None
) -> tuple[Interlocking, dict[PointName, int]]:
    """Return the state after all due commands to points, and the commanded track by set of points.

    A command is due only after the commanded position is stored. Points get no command while their detection is awaited
    or an interval includes them.
    """
    due = {
        name: point
        for name, point in state.points.items()
        if not point.commanded and point.detected is not None and stored.points[name].wanted == point.wanted
    }
    if not due:
        return state, {}
    nearby, points, given = nearby or NearbyTrains(state, layout), dict(state.points), {}
    for name, point in due.items():
        if point.lies:
            points[name] = replace(point, commanded=True)
        elif not under_interval(state, name, layout, nearby):
            points[name] = replace(point, commanded=True, detected=None)  # undetected until the trackside answers
            given[name] = point.wanted
    return replace(state, points=points), given


def release_points(state: Interlocking, now_s: float, layout: Layout, *, limits: InterlockingLimits) -> Interlocking:
    """Return the state with points released `InterlockingLimits.release_s` after a train's safe rear end has passed."""
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
    """Return the state with the authorities of trains, by default of all trains, extended as far as possible.

    `nearby` and `stopped` (`stop_orders`) are computed if they are not given.
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
            after[number] = train.changed(end_m=end)
    return state


def _limit_m(
    state: Interlocking, train: TrainInterval, layout: Layout, nearby: NearbyTrains, *, limits: InterlockingLimits
) -> float:
    """Return the chainage to which a train's authority may be extended at most [m]."""
    direction = train.direction
    end = direction * layout.track_end_m(train.station, direction)
    for name in layout.points_between(*sorted((train.rear_m, direction * end))):
        near, far = along(layout.zone_m(name), direction)
        if far <= direction * train.rear_m or near >= end:
            continue
        # points under the train are locked for the train, and therefore do not limit its authority
        if not leads(state.points[name], train, name[0]):
            end = min(end, near)
    first_m, last_m = sorted((train.rear_m, direction * end))
    taken = bars_ahead(state, layout)
    for other in nearby.between(state, first_m, last_m):
        if other.train not in (train.train, train.parted) and other.overlaps(first_m, last_m):
            taken += layout.pieces(*other.span_m, other.tracks)
    if taken:
        path = layout.pieces(train.rear_m, direction * end, train.tracks)
        blocked = [piece for piece in taken if any(shares(piece, mine) for mine in path)]
        end = min([end, *(along(piece[1:], direction)[0] for piece in blocked)])
    return direction * (end - limits.margin_m - limits.overlap_m)


def bars_ahead(state: Interlocking, layout: Layout) -> list[Piece]:
    """Return the pieces of track of all closed sections."""
    return [piece for name, _ in state.bars for piece in layout.sections[name]]


def leads(point: PointState, train: TrainInterval, station: int) -> bool:
    """Return whether points are locked for a train, and detected in the position for its track in the station."""
    return train.train in point.locked and point.lies and point.wanted == train.tracks.get(station)
