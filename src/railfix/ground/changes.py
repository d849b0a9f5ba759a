"""Changes ordered by a person: correct a train's interval; enter, remove, join and divide trains.

Reports cannot show these changes; therefore, a person who has observed a change enters it. Each change leaves the
changed trains stopped, to be released one by one (`railfix.ground.stops.release_train`), and frees no track that a
train may still occupy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from railfix.ground.layout import Layout, PointName, overlap
from railfix.ground.state import Interlocking, PointState, TrainInterval, with_train
from railfix.ground.stops import OCCUPIED, close_section, pieces_of

#: Trains are joined only if their intervals are at most this far apart [m].
APART_M: Final = 50.0

Changed = tuple[Interlocking, str | None]


def _placed(
    train: TrainInterval, layout: Layout, *, direction: int, rear_m: float, front_m: float, track: int
) -> TrainInterval | str:
    """Return a train moved to the given ends, without an authority, or the reason why this is impossible."""
    low, high = sorted((rear_m, front_m))
    if direction not in (-1, 1) or track not in (1, 2):
        return "direction must be -1 or 1, and track 1 or 2"
    if direction * (front_m - rear_m) < train.length_m:
        return f"there is no room for a train of {train.length_m:g} m from rear_m to front_m in running direction"
    if low < layout.stations[0].begin_m or high > layout.stations[-1].end_m:
        return "the interval reaches beyond the line"
    stations = layout.stations_between(low, high)
    tracks = dict.fromkeys(stations, track)
    # between two stations, a train's route ends in the station that the train has left
    behind = [k for k, s in enumerate(layout.stations) if direction * (s.begin_m - front_m) < 0.0]
    station = max(behind) if direction > 0 else min(k for k, s in enumerate(layout.stations) if s.end_m > front_m)
    if station not in tracks:
        tracks[station] = track
    return replace(
        train, direction=direction, rear_m=rear_m, front_m=front_m, end_m=front_m, tracks=tracks, station=station,
        standstill=True, claimed_m=None, reported_m=None, contradiction=None, asked_m=None, held=False, parted=None,
        speed_mps=None,
    )  # fmt: skip


def correct_interval(
    state: Interlocking,
    train: int,
    layout: Layout,
    *,
    direction: int,
    rear_m: float,
    front_m: float,
    track: int,
    lapsed: bool = False,
) -> Changed:
    """Set the interval of a stopped train; return the new state, and the reason if the order is refused.

    The train's route and authority end, and the train's locks on points are removed. Therefore, one of two conditions
    is required: all authorities have lapsed on board (`lapsed`), or the train has reported that it obeys an order to
    brake that no authority in transit can end.
    """
    known = state.trains.get(train)
    if known is None:
        return state, f"no such train: {train}"
    if known.stop is None:
        return state, f"train {train} is not stopped: stop it first"
    if (reason := _may_run(known, lapsed=lapsed)) is not None:
        return state, reason
    moved = _placed(known, layout, direction=direction, rear_m=rear_m, front_m=front_m, track=track)
    if isinstance(moved, str):
        return state, moved
    moved = replace(moved, stop="its interval was corrected by order")
    return _refused_overlap(state, moved, layout, without_locks(state.points, train))


def _may_run(known: TrainInterval, *, lapsed: bool) -> str | None:
    """Return None if no authority in transit can permit a train to run, otherwise the reason for a refusal."""
    if known.runs_by is None or lapsed:
        return None
    return (
        f"train {known.train} has not reported that it obeys the order to brake, and may still be moving: wait "
        "for that report"
    )


def enter_train(
    state: Interlocking,
    train: int,
    layout: Layout,
    *,
    length_m: float,
    direction: int,
    rear_m: float,
    front_m: float,
    track: int,
) -> Changed:
    """Add a train at a given position; return the new state, and the reason if the order is refused.

    The train need not have reported.
    """
    if train in state.trains:
        return state, f"train {train} exists already"
    if not 0 < train < 1 << 32 or not length_m > 0.0:
        return state, "a number from 1 to 4294967295 and a length above 0 m were expected"
    new = TrainInterval(
        train=train, direction=1, rear_m=rear_m, front_m=front_m, end_m=front_m, sequence=-1, tracks={}, station=0,
        length_m=length_m, stop="entered by order",
    )  # fmt: skip
    moved = _placed(new, layout, direction=direction, rear_m=rear_m, front_m=front_m, track=track)
    return (state, moved) if isinstance(moved, str) else _refused_overlap(state, moved, layout, state.points)


def _refused_overlap(
    state: Interlocking, train: TrainInterval, layout: Layout, points: Mapping[PointName, PointState]
) -> Changed:
    """Add a train unless its interval overlaps another interval; return the new state, and the reason for a refusal."""
    pieces = pieces_of(train, layout)
    for other in state.trains.values():
        if other.train != train.train and overlap(pieces, pieces_of(other, layout)):
            return state, f"the interval overlaps the interval of train {other.train}"
    return with_train(replace(state, points=points), train), None


def without_locks(points: Mapping[PointName, PointState], train: int) -> dict[PointName, PointState]:
    """Return the points without the locks of a train."""
    return {
        name: replace(point, locked={n: since for n, since in point.locked.items() if n != train})
        if train in point.locked
        else point
        for name, point in points.items()
    }


def remove_train(state: Interlocking, train: int, layout: Layout, *, lapsed: bool = False) -> Changed:
    """Remove a train; the sections of the train's interval then count as occupied by vehicles that do not report.

    A section becomes free when its detection reports it free, or by the order of a person who has seen that it is free.
    As in `correct_interval`, the order is refused if an authority in transit can permit the train to run. Return the
    new state, and the reason if the order is refused.
    """
    known = state.trains.get(train)
    if known is None:
        return state, f"no such train: {train}"
    if known.stop is None or not known.standstill:
        return state, f"train {train} has not been ordered to stop, or is not at rest"
    if (reason := _may_run(known, lapsed=lapsed)) is not None:
        return state, reason
    pieces = pieces_of(known, layout)
    trains = {number: other for number, other in state.trains.items() if number != train}
    state = replace(state, trains=trains, points=without_locks(state.points, train))
    for name, own in layout.sections.items():
        # the section of a whole station is closed only if the train is on the points; each track is its own section
        if overlap(own if len(own) == 1 else [piece for piece in own if piece[0] == 0], pieces):
            state = close_section(state, name, layout, f"{name} is {OCCUPIED}", kind=OCCUPIED)
    return state, None


def join_trains(state: Interlocking, lead: int, other: int, layout: Layout) -> Changed:
    """Join train `other` to train `lead`, which is ahead; return the new state, and the reason if the order is refused.

    The joined train has the number `lead`, the sum of both lengths, and an interval that includes both intervals.
    """
    first, second = state.trains.get(lead), state.trains.get(other)
    if first is None or second is None or lead == other:
        return state, "two different trains of the line were expected"
    if not all(train.stop is not None and train.standstill for train in (first, second)):
        return state, "one of the trains has not been ordered to stop, or is not at rest"
    d = first.direction
    if second.direction != d or d * (first.front_m - second.front_m) < 0.0:
        return state, f"train {other} is not behind train {lead}, or has another direction"
    if d * (first.rear_m - second.interval_m[1]) > APART_M:
        return state, f"the intervals of the trains are more than {APART_M:g} m apart"
    if any(first.tracks[k] != track for k, track in second.tracks.items() if k in first.tracks):
        return state, "the trains are on different tracks of a station"
    joined = replace(
        first, rear_m=d * min(d * first.rear_m, d * second.rear_m), length_m=first.length_m + second.length_m,
        tracks={**second.tracks, **first.tracks}, stop=f"joined with train {other}", claimed_m=None, reported_m=None,
        parted=None,
    )  # fmt: skip
    points = dict(state.points)
    for name, point in state.points.items():
        if other in point.locked:
            locked = {lead if n == other else n: since for n, since in point.locked.items()}
            points[name] = replace(point, locked=locked)
    trains = {n: train for n, train in state.trains.items() if n != other}
    after, reason = _refused_overlap(replace(state, trains=trains), joined, layout, points)
    return (after, None) if reason is None else (state, reason)


def divide_train(state: Interlocking, train: int, other: int, *, length_m: float) -> Changed:
    """Divide a train after its first `length_m` metres; the rear part becomes the new train `other`.

    Until the parts are apart, their intervals overlap by the uncertainty of the position. Return the new state, and the
    reason if the order is refused.
    """
    known = state.trains.get(train)
    if known is None:
        return state, f"no such train: {train}"
    if other in state.trains or not 0 < other < 1 << 32:
        return state, f"{other} is not a valid number for the other part"
    if known.stop is None or not known.standstill:
        return state, f"train {train} has not been ordered to stop, or is not at rest"
    if not 0.0 < length_m < known.length_m:
        return state, f"a length between 0 and {known.length_m:g} m was expected"
    if known.reported_m is None or known.outside_m() > 0.0:
        return state, f"train {train} has not reported its position"
    d = known.direction
    back, front = sorted(d * end for end in known.reported_m)
    cut = d * (front - length_m)  # foremost possible rear end of the front part
    rear = d * max(min(back + known.length_m - length_m, d * cut), d * known.rear_m)
    stop = f"divided: trains {train} and {other}"
    first = replace(known, rear_m=rear, length_m=length_m, stop=stop, claimed_m=None, parted=other)
    second = replace(
        known, train=other, front_m=cut, end_m=cut, length_m=known.length_m - length_m, stop=stop, sequence=-1,
        session=0, claimed_m=None, reported_m=None, measured_ns=None, line=None, asked_m=None, station=known.station,
        parted=None,
    )  # fmt: skip
    points = {
        name: replace(point, locked={**point.locked, other: None}) if train in point.locked else point
        for name, point in state.points.items()
    }
    return with_train(with_train(replace(state, points=points), first), second), None
