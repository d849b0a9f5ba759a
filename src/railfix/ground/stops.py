"""Stops by order: of a train, of all, of a section; of trains whose intervals meet; and their release by hand.

Until then everything that was granted stays occupied. The train agrees where it can stop before the shorter end; every
authority from the asking on carries that end, and on board one with an older number is refused, so that none can
lengthen it again by being late.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from railfix.ground.interlocking import Interlocking, InterlockingLimits, stop_trains, with_train
from railfix.ground.layout import Layout, overlap
from railfix.io.train_message import TrainMessage


def overlaps_stopped(state: Interlocking, layout: Layout) -> Interlocking:
    """Return the state with the trains stopped whose intervals overlap: of trains at rest whose bounds have grown."""
    spans = sorted((*train.span_m, number) for number, train in state.trains.items())
    for k, (_, high, number) in enumerate(spans):
        for low, _, other in spans[k + 1 :]:
            if low >= high:
                break
            first, second = state.trains[number], state.trains[other]
            if first.stop and second.stop:
                continue
            one, two = (layout.pieces(*train.span_m, train.tracks) for train in (first, second))
            if overlap(one, two):
                state = stop_trains(state, [number], f"its interval meets that of train {other}")
                state = stop_trains(state, [other], f"its interval meets that of train {number}")
    return state


def release_train(state: Interlocking, train: int, layout: Layout) -> tuple[Interlocking, str | None]:
    """Return the state with the stop of one train released by hand, and the reason of a refusal.

    Points under its interval, which a train that has rolled back has passed, are locked for it again; its next
    report names its line and its clock. Its station becomes the furthest that its front has reached, on the track that
    it has there.
    """
    known = state.trains.get(train)
    if known is None or known.stop is None:
        return state, f"train {train} is not stopped"
    if not known.standstill:
        return state, f"train {train} does not stand still"
    if any(known.overlaps(*layout.block_m(block)) for block in state.closed):
        return state, f"the section where train {train} is or may run is closed"
    points = dict(state.points)
    for name in layout.points_between(*known.span_m):
        if known.overlaps(*layout.zone_m(name)):
            if not points[name].wanted == points[name].detected == known.tracks.get(name[0]):
                return state, f"points {layout.stations[name[0]].name} under its interval are not set for train {train}"
            points[name] = replace(points[name], locked={**points[name].locked, train: None})
    direction = known.direction  # where the train ran too far, its authority now ends there
    end = direction * max(direction * known.end_m, direction * known.front_m)
    station = known.station  # after a wrong change of ends one behind the train
    while (station + direction) in known.tracks and layout.is_reached(station + direction, known.front_m, direction):
        station += direction
    moved = replace(known, stop=None, end_m=end, line=None, measured_ns=None, station=station)
    released_state = with_train(replace(state, points=points), moved)
    if overlaps_stopped(released_state, layout) != released_state:
        return state, f"the interval of train {train} meets another one"
    return released_state, None


def close_section(state: Interlocking, block: int, layout: Layout, reason: str) -> Interlocking:
    """Return the state with a block closed: no authority reaches into it any more, trains that have one are stopped."""
    state = replace(state, closed=state.closed | {block})
    touched = [number for number, train in state.trains.items() if train.overlaps(*layout.block_m(block))]
    return stop_trains(state, touched, reason)


def open_section(state: Interlocking, block: int) -> Interlocking:
    """Return the state with a block open; trains that were stopped by it are released one by one."""
    return replace(state, closed=state.closed - {block})


#: Difference of an end that is rounding [m].
ROUNDING_M: Final = 0.02


def ask_route_back(
    state: Interlocking, train: int, layout: Layout, *, limits: InterlockingLimits
) -> tuple[Interlocking, str | None]:
    """Return the state in which a train is asked to stay in its station, and the reason of a refusal."""
    known = state.trains.get(train)
    if known is None:
        return state, f"there is no train {train}"
    direction, base = known.direction, known.station - known.direction
    if base not in known.tracks:
        return state, "the train has no route to take back"
    end = direction * layout.track_end_m(base, direction)
    if known.stop is not None or direction * (known.front_m - known.end_m) > 0.0:
        return state, "the train is stopped, or beyond its authority"
    if direction * known.front_m > end:
        return state, f"the train leaves or has left {layout.stations[base].name}"
    asked = direction * max(min(end - limits.margin_m, direction * known.end_m), direction * known.front_m)
    return with_train(state, replace(known, asked_m=asked, asked_number=state.granted + 1)), None


def answer_received(state: Interlocking, message: TrainMessage) -> Interlocking:
    """Return the state after a report that may answer: the route goes where the train agrees, and stays where not.

    Of a stopped train, whose report may be the contradicted one, no answer counts until it is released.
    """
    known = state.trains[message.train]
    if known.asked_m is None or known.stop is not None or message.sequence != known.sequence:
        return state
    if message.authority is None or message.authority_end_cm is None or message.authority < known.asked_number:
        return state
    direction = known.direction
    further = max(direction * message.authority_end_cm / 100.0, direction * known.front_m)
    if further - direction * known.asked_m > ROUNDING_M:  # it holds more, or is further than it agrees to
        return with_train(state, replace(known, asked_m=None))
    base, end = known.station - direction, direction * max(direction * known.asked_m, direction * known.front_m)
    tracks = {station: track for station, track in known.tracks.items() if station != known.station}
    points = dict(state.points)
    for name in ((base, direction), (known.station, -direction)):
        locked = {train: since for train, since in points[name].locked.items() if train != known.train}
        points[name] = replace(points[name], locked=locked)
    short = replace(known, asked_m=None, held=True, end_m=end, tracks=tracks, station=base)
    return replace(with_train(state, short), points=points)
