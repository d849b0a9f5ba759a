"""Routes taken back: a shorter authority is asked for, and counts once the train says that it holds it.

Until then everything that was granted stays occupied. The train agrees where it can stop before the shorter end; every
authority from the asking on carries that end, and on board one with an older number is refused, so that none can
lengthen it again by being late.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from railfix.ground.interlocking import Interlocking, InterlockingLimits, with_train
from railfix.ground.layout import Layout
from railfix.io.train_message import TrainMessage

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
    inner = layout.stations[base].inner_m
    end = direction * (inner[1] if direction > 0 else inner[0])
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
