"""Stops of one train, all trains, a section, or trains whose intervals overlap, and the release of trains by hand.

Until the release, every granted interval stays occupied. A train accepts an earlier end of its authority if it can stop
before this end. Every authority sent after the request has the earlier end, and the train rejects authorities with
lower numbers. A late authority can therefore not move the end forward again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Final

from railfix.ground.interlocking import NearbyTrains
from railfix.ground.layout import Layout, Piece, PointName, overlap
from railfix.ground.state import ROUNDING_M, Interlocking, InterlockingLimits, TrainInterval, stop_trains, with_train
from railfix.io.train_message import TrainMessage

#: Reasons why no authority may reach into a section: `CLOSED` by hand; `OCCUPIED` by vehicles that do not report, as
#: entered by hand or as detected; or `UNKNOWN`, because the section's detection has not answered. For the reasons in
#: `BARS`, trains inside the section are stopped.
CLOSED: Final = "closed"
OCCUPIED: Final = "occupied by vehicles that report nothing"
UNKNOWN: Final = "unknown to its detection"
BARS: Final = (CLOSED, OCCUPIED)
#: Reasons that end when the detection reports the section free.
SWEPT: Final = {OCCUPIED, UNKNOWN}


def pieces_of(train: TrainInterval, layout: Layout) -> list[Piece]:
    """Return the pieces of track that a train occupies."""
    return layout.pieces(*train.span_m, train.tracks)


def overlaps_stopped(
    state: Interlocking,
    layout: Layout,
    *,
    nearby: NearbyTrains | None = None,
    checked: Mapping[int, TrainInterval] | None = None,
) -> Interlocking:
    """Return the state with trains stopped if their intervals overlap.

    Intervals can come to overlap because the bounds of trains at rest may grow.

    `checked` contains the trains as they were at an earlier call. Two trains that have not changed since that call are
    not compared again.
    """
    nearby, checked = nearby or NearbyTrains(state, layout), checked or {}
    pairs = set()
    for number, train in state.trains.items():
        if (known := checked.get(number)) is train or (known is not None and _occupation(known) == _occupation(train)):
            continue
        for other in nearby.between(state, *train.span_m):
            if other is not train and other.overlaps(*train.span_m):
                pairs.add(tuple(sorted([(*train.span_m, number), (*other.span_m, other.train)])))
    for (*_, number), (*_, other_number) in sorted(pairs):
        first, second = state.trains[number], state.trains[other_number]
        if (first.stop and second.stop) or first.parted == other_number or second.parted == number:
            continue
        if overlap(pieces_of(first, layout), pieces_of(second, layout)):
            state = stop_trains(state, [number], f"its interval overlaps the interval of train {other_number}")
            state = stop_trains(state, [other_number], f"its interval overlaps the interval of train {number}")
    return state


def _occupation(train: TrainInterval) -> tuple[object, ...]:
    """Return the values of a train that determine whether its interval overlaps other intervals."""
    return train.span_m, train.tracks, train.stop, train.parted


def parted_cleared(state: Interlocking) -> Interlocking:
    """Return the state with `TrainInterval.parted` cleared for divided trains whose parts no longer overlap."""
    for train in [train for train in state.trains.values() if train.parted is not None]:
        rear = state.trains.get(train.parted or 0)
        if rear is None or not train.overlaps(*rear.span_m):
            state = with_train(state, replace(train, parted=None))
    return state


def release_train(state: Interlocking, train: int, layout: Layout) -> tuple[Interlocking, str | None]:
    """Release the stop of one train by hand; return the new state, and the reason if the release is refused.

    Points under the train's interval are locked for the train again, because a train that has rolled back may have
    released these points. The next report determines the line number of the train. The route is shortened to the
    farthest station on the route that the train's front end has reached.
    """
    known = state.trains.get(train)
    if known is None or known.stop is None:
        return state, f"train {train} is not stopped"
    if not known.standstill:
        return state, f"train {train} is not at rest"
    if known.outside_m() > 0.0 and known.reported_m is not None:
        return state, (
            "train {} was last reported at {:.0f} to {:.0f} m, outside its interval {:.0f} to {:.0f} m: "
            "first observe where it is, and correct its interval by order (correct-train)"
        ).format(train, *known.reported_m, *known.span_m)
    held = known.held_end_m
    if held is not None and known.direction * (held - known.interval_m[1]) > ROUNDING_M:
        return (
            state,
            f"train {train} still has an authority to {held:.0f} m: it gives the authority up when it is at rest under "
            "an order to brake",
        )
    if (bar := bar_over(state, known, layout)) is not None:
        return state, f"section {bar[0]}, where train {train} is or may run, is {bar[1]}"
    under = [name for name in layout.points_between(*known.span_m) if known.overlaps(*layout.zone_m(name))]
    if (reason := points_refused(state, known, under, layout)) is not None:
        return state, reason
    points = dict(state.points)
    for name in under:
        points[name] = replace(points[name], locked={**points[name].locked, train: None})
    direction = known.direction  # if the train overran its authority, the authority now ends at the front of the train
    end = direction * max(direction * known.end_m, direction * known.front_m)
    station = known.station  # after a wrong change of ends, this station may be behind the train
    while (station + direction) in known.tracks and layout.is_reached(station + direction, known.front_m, direction):
        station += direction
    moved = replace(known, stop=None, end_m=end, line=None, station=station)
    released_state = with_train(replace(state, points=points), moved)
    if overlaps_stopped(released_state, layout) != released_state:
        return state, f"the interval of train {train} overlaps the interval of another train"
    return released_state, None


def points_refused(state: Interlocking, train: TrainInterval, under: Iterable[PointName], layout: Layout) -> str | None:
    """Return the reason for refusal if points under a train's interval are not set for the train's tracks."""
    for name in under:
        point = state.points[name]
        if not (point.lies and point.wanted == train.tracks.get(name[0])):
            station = layout.stations[name[0]].name
            return f"points {station} under its interval are not set for train {train.train}"
    return None


def bar_over(state: Interlocking, train: TrainInterval, layout: Layout) -> tuple[str, str] | None:
    """Return a closed section in a train's interval with its reason in `BARS`; None if there is no such section."""
    occupied = pieces_of(train, layout)
    bars = (bar for bar in sorted(state.bars) if bar[1] in BARS)
    return next((bar for bar in bars if overlap(layout.sections[bar[0]], occupied)), None)


def close_section(
    state: Interlocking, section: str, layout: Layout, reason: str, *, kind: str = CLOSED
) -> Interlocking:
    """Return the state with a section closed; no authority is extended into it, and trains inside are stopped."""
    state = replace(state, bars=state.bars | {(section, kind)})
    pieces = layout.sections[section]
    inside = [number for number, train in state.trains.items() if overlap(pieces, pieces_of(train, layout))]
    return stop_trains(state, inside, reason)


def open_section(state: Interlocking, section: str, kind: str = CLOSED) -> Interlocking:
    """Return the state without one reason for closing a section; trains stay stopped until a release by hand."""
    return replace(state, bars=state.bars - {(section, kind)})


def occupied_detected(state: Interlocking, layout: Layout, sections: Iterable[str]) -> Interlocking:
    """Close the sections that are detected as occupied and overlap no train's interval; return the new state."""
    for section in sections:
        pieces = layout.sections[section]
        if (section, OCCUPIED) not in state.bars and not any(
            overlap(pieces, pieces_of(train, layout)) for train in state.trains.values()
        ):
            state = replace(state, bars=state.bars | {(section, OCCUPIED)})
    return state


def ask_route_back(
    state: Interlocking, train: int, layout: Layout, *, limits: InterlockingLimits
) -> tuple[Interlocking, str | None]:
    """Request a train to give back its route; return the new state, and the reason if the order is refused."""
    known = state.trains.get(train)
    if known is None:
        return state, f"no such train: {train}"
    direction, base = known.direction, known.station - known.direction
    if base not in known.tracks:
        return state, "the train has no route that it could return"
    end = direction * layout.track_end_m(base, direction)
    if known.stop is not None or direction * (known.front_m - known.end_m) > 0.0:
        return state, "the train is stopped, or beyond its authority"
    if direction * known.front_m > end:
        return state, f"the train leaves or has left {layout.stations[base].name}"
    asked = direction * max(min(end - limits.margin_m, direction * known.end_m), direction * known.front_m)
    return with_train(state, replace(known, asked_m=asked, asked_number=state.granted + 1)), None


def answer_received(state: Interlocking, message: TrainMessage) -> Interlocking:
    """Return the state after a report that may answer a request for an earlier end of the authority.

    The route is released if the train agrees, otherwise it is kept. While a train is stopped, its answers are not used,
    because its reports may be wrong.
    """
    known = state.trains[message.train]
    if known.asked_m is None or known.stop is not None or message.sequence != known.sequence:
        return state
    if not answers(known, message):
        return state
    direction = known.direction
    if holds_more_than_asked(known, message):
        return with_train(state, replace(known, asked_m=None))
    base, end = known.station - direction, direction * max(direction * known.asked_m, direction * known.front_m)
    tracks = {station: track for station, track in known.tracks.items() if station != known.station}
    points = dict(state.points)
    for name in ((base, direction), (known.station, -direction)):
        locked = {train: since for train, since in points[name].locked.items() if train != known.train}
        points[name] = replace(points[name], locked=locked)
    short = replace(known, asked_m=None, held=True, end_m=end, tracks=tracks, station=base)
    return replace(with_train(state, short), points=points)


def answers(known: TrainInterval, message: TrainMessage) -> bool:
    """Return whether a report answers an authority that requests an earlier end."""
    held = message.authority
    return held is not None and message.authority_end_cm is not None and held >= known.asked_number


def holds_more_than_asked(known: TrainInterval, message: TrainMessage) -> bool:
    """Return whether a train's authority ends beyond the requested end, or the train is beyond this end."""
    d = known.direction
    assert known.asked_m is not None
    further = max(d * (message.authority_end_cm or 0) / 100.0, d * known.front_m)
    return further - d * known.asked_m > ROUNDING_M
