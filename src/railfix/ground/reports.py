"""Position reports: how they move the interval of a train, and what stops it.

The safe rear end moves to what two reports in a row confirm, of a complete train of its configured length. A report
that contradicts what is known of its train (`railfix.ground.plausibility`) stops that train and its neighbours.
"""

from __future__ import annotations

from dataclasses import replace

from railfix.ground.interlocking import Interlocking, InterlockingLimits, TrainInterval, with_train
from railfix.ground.layout import Layout
from railfix.ground.plausibility import compute_contradiction, confirms_rear, stop_contradicted
from railfix.io.train_message import MessageStatus, TrainMessage


def report_received(
    state: Interlocking,
    message: TrainMessage,
    layout: Layout,
    *,
    limits: InterlockingLimits | None = None,
    latest_ns: int | None = None,
) -> Interlocking:
    """Return the state after a position report.

    A train that looks the other way than before has changed ends; that counts only at a standstill inside its
    station, and the interval still covers where the train stood. A report that contradicts what is known stops the
    train and moves its interval outward alone. `latest_ns` is the train's clock at most, by the centre's own clock.
    """
    before = state.trains.get(message.train)
    placed = message.status in (MessageStatus.POSITION, MessageStatus.COASTING) and message.facing != 0
    if before is None or not placed or message.sequence <= before.sequence:
        return state
    chainage_cm, over_cm, under_cm = message.chainage_cm, message.over_cm, message.under_cm
    if chainage_cm is None or over_cm is None or under_cm is None:  # a bound that is absent is unknown, not 0
        return state
    front, facing = chainage_cm / 100.0, message.facing
    rear = front - facing * (over_cm / 100.0 + before.length_m)
    ahead = front + facing * under_cm / 100.0
    contradiction = compute_contradiction(
        before, message, layout, limits=limits or InterlockingLimits(), granted=state.granted, latest_ns=latest_ns
    )
    if contradiction is not None:
        return with_train(state, stop_contradicted(before, message, contradiction, rear, ahead))
    confirmed, turns = confirms_rear(before, message), facing != before.direction
    if turns and not (confirmed and layout.station_at(*sorted((rear, ahead))) == before.station):
        return state
    known = replace(
        before,
        sequence=message.sequence,
        standstill=message.standstill,
        line=message.line,
        measured_ns=message.time_ns,
        speed_mps=None if message.speed_cmps is None else abs(message.speed_cmps) / 100.0,
        claimed_m=rear if confirmed else None,
    )
    if turns:
        return with_train(state, _turned(known, facing, rear, ahead, layout))
    if confirmed and before.claimed_m is not None and before.stop is None:
        # one wrong report alone moves no rear end, and a wider bound moves none back
        both = min(facing * rear, facing * before.claimed_m)
        known = replace(known, rear_m=facing * max(both, facing * before.rear_m))
    # of a stopped train the interval only grows
    front = ahead if before.stop is None else facing * max(facing * ahead, facing * before.front_m)
    return with_train(state, replace(known, front_m=front))


def _turned(known: TrainInterval, facing: int, rear: float, ahead: float, layout: Layout) -> TrainInterval:
    """Return a train that has changed ends: no authority beyond its front, and where it stood is still occupied."""
    covered = facing * max(facing * ahead, facing * known.rear_m)
    back = facing * min(facing * rear, facing * known.front_m)
    under = {known.station, *layout.stations_between(*sorted((back, covered)))}
    return replace(
        known,
        direction=facing,
        rear_m=back,
        front_m=covered,
        end_m=ahead,
        tracks={station: track for station, track in known.tracks.items() if station in under},
        asked_m=None,
    )
