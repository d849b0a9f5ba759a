"""Stops by order: of a train, of all, of a section; of trains whose intervals meet; and their release by hand."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from railfix.ground.interlocking import Interlocking, TrainInterval, with_train
from railfix.ground.layout import Layout, overlap


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
                state = with_train(
                    state, replace(first, stop=first.stop or f"its interval meets that of train {other}")
                )
                state = with_train(
                    state, replace(second, stop=second.stop or f"its interval meets that of train {number}")
                )
    return state


def release_train(state: Interlocking, train: int, layout: Layout) -> tuple[Interlocking, str | None]:
    """Return the state with the stop of one train released by hand, and the reason of a refusal.

    Points under its interval, which a train that has rolled back has passed, are locked for it again.
    """
    known = state.trains.get(train)
    if known is None or known.stop is None:
        return state, f"train {train} is not stopped"
    if not known.standstill:
        return state, f"train {train} does not stand still"
    if any(_touches(known, block, layout) for block in state.closed):
        return state, f"the section where train {train} is or may run is closed"
    points = dict(state.points)
    low, high = known.span_m
    for name in layout.points_between(low, high):
        first, last = layout.zone_m(name)
        if first < high and low < last:
            if not points[name].wanted == points[name].detected == known.tracks.get(name[0]):
                return state, f"points {layout.stations[name[0]].name} under its interval are not set for train {train}"
            points[name] = replace(points[name], locked={**points[name].locked, train: None})
    direction = known.direction  # where the train ran too far, its authority now ends there
    end = direction * max(direction * known.end_m, direction * known.front_m)
    released_state = with_train(replace(state, points=points), replace(known, stop=None, end_m=end))
    if overlaps_stopped(released_state, layout) != released_state:
        return state, f"the interval of train {train} meets another one"
    return released_state, None


def stop_trains(state: Interlocking, trains: Iterable[int], reason: str) -> Interlocking:
    """Return the state with trains stopped by order."""
    for number in trains:
        known = state.trains[number]
        state = with_train(state, replace(known, stop=known.stop or reason))
    return state


def close_section(state: Interlocking, block: int, layout: Layout, reason: str) -> Interlocking:
    """Return the state with a block closed: no authority reaches into it any more, trains that have one are stopped."""
    state = replace(state, closed=state.closed | {block})
    return stop_trains(state, [n for n, train in state.trains.items() if _touches(train, block, layout)], reason)


def open_section(state: Interlocking, block: int) -> Interlocking:
    """Return the state with a block open; trains that were stopped by it are released one by one."""
    return replace(state, closed=state.closed - {block})


def _touches(train: TrainInterval, block: int, layout: Layout) -> bool:
    low, high = layout.block_m(block)
    return train.span_m[0] < high and train.span_m[1] > low
