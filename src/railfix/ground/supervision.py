"""Supervision of the trains of a line by the centre: reports in, authorities out, without input or output.

The one path for `railfix.ground.control` (the centre with its store and page) and for simulated traffic
(`railfix.ground.traffic`). Nothing here proves a report right: checks find reports that cannot be right together with
those before. What stays unseen (errors inside the train's own bounds) is assumed away in ``docs/ground.md``.

The safe rear end moves to what two reports in a row confirm, of a complete train of its configured length. A report
that contradicts what is known of its train stops that train and its neighbours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

from railfix.ground.centre import CentreLimits, Rejection, TrainRecord
from railfix.ground.centre import report_received as record_received
from railfix.ground.interlocking import (
    SPEED_ERROR_MPS,
    WIDEST_M,
    Interlocking,
    InterlockingLimits,
    NearbyTrains,
    PointState,
    TrainInterval,
    extend_authorities,
    points_reported,
    release_points,
    route_requested,
    stop_orders,
    with_train,
)
from railfix.ground.layout import Layout, PointName
from railfix.ground.stops import answer_received, ask_route_back, overlaps_stopped
from railfix.ground.train import Authority
from railfix.io.train_message import MessageStatus, TrainMessage

#: Difference of a reported length from the configured one that is rounding [m].
LENGTH_ROUNDING_M: Final = 0.02
#: Speed against the facing from which a train that does not stand rolls back [m/s].
ROLLING_MPS: Final = 0.5
#: Beginning of the reason where a train holds an authority beyond the end of its interval.
HOLDS_MORE: Final = "the train holds an authority beyond its interval,"
#: Beginnings of the reasons where the reported place itself cannot be right.
WRONG_PLACE: Final = ("the bounds of the place are wider", "the train has moved", "the place is not on the line")


def confirms_rear(known: TrainInterval, message: TrainMessage) -> bool:
    """Return whether the safe rear end may follow a report: the train is complete and has its configured length."""
    return message.complete and abs(message.length_cm / 100.0 - known.length_m) <= LENGTH_ROUNDING_M


def compute_contradiction(
    known: TrainInterval,
    message: TrainMessage,
    layout: Layout,
    *,
    limits: InterlockingLimits,
    granted: int,
    latest_ns: int | None = None,
) -> str | None:
    """Return what a placed report contradicts, None where it may be right.

    `granted` is the number of the last authorities, `latest_ns` the train's clock at most, by the centre's own clock.
    """
    assert message.chainage_cm is not None
    assert message.over_cm is not None
    assert message.under_cm is not None
    front, over, under = message.chainage_cm / 100.0, message.over_cm / 100.0, message.under_cm / 100.0
    if message.length_cm == 0:
        return "the report has no train length"
    if known.line is not None and message.line != known.line:
        return f"the report is of line {message.line}, the train is on line {known.line}"
    if over + under > WIDEST_M:
        return f"the bounds of the place are wider than {WIDEST_M:g} m"
    if not layout.stations[0].begin_m - over <= front <= layout.stations[-1].end_m + under:
        return f"the place is not on the line: {front:.0f} m"
    if (message.authority or 0) > granted:
        return f"the train holds authority {message.authority}, the centre's database ends at {granted}"
    if message.facing != known.direction:
        if not message.standstill:
            return "the train has changed ends while it runs"
        return _turn_contradiction(known, message.facing, front, over, under)
    direction = known.direction
    if message.authority_end_cm is not None and direction * (message.authority_end_cm / 100.0 - known.end_m) > 0.02:
        return f"{HOLDS_MORE} to {message.authority_end_cm / 100.0:.0f} m"
    speed = None if message.speed_cmps is None else abs(message.speed_cmps) / 100.0
    if speed is not None and speed > limits.speed_mps:
        return f"the speed {speed:.0f} m/s is above {limits.speed_mps:g} m/s"
    # before its first report has been answered a train has no fresh authority, and stands
    elapsed = 0.0 if known.measured_ns is None else (message.time_ns - known.measured_ns) / 1e9
    if elapsed < 0.0:
        return "the place is older than that of the report before"
    if latest_ns is not None and known.measured_ns is not None:  # a clock that was set forward makes no way possible
        elapsed = max(min(elapsed, (latest_ns - known.measured_ns) / 1e9), 0.0)
    way = direction * (front - known.front_m) - over
    if way > _longest_way_m(known.speed_mps, speed, elapsed, limits):
        return f"the train has moved {way:.0f} m or more in {elapsed:.1f} s"
    if direction * front - over > direction * known.end_m:
        return "the train is beyond its authority"
    if direction * front + under < direction * known.rear_m + known.length_m:
        return "the train has rolled back"
    backward = message.direction == -direction and (speed is None or speed > ROLLING_MPS)
    return "the train runs backward" if backward and not message.standstill else None


def stop_contradicted(
    known: TrainInterval, message: TrainMessage, reason: str, rear: float, ahead: float
) -> TrainInterval:
    """Return a train that is stopped, its interval extended to the reported place unless that cannot be right.

    Whatever else is wrong with a report, as its clock, the train may be there.
    """
    stopped = replace(
        known, stop=known.stop or reason, sequence=message.sequence, standstill=message.standstill, claimed_m=None
    )
    direction = known.direction
    if reason.startswith(HOLDS_MORE) and message.authority_end_cm is not None:
        stopped = replace(stopped, end_m=message.authority_end_cm / 100.0)
    if reason.startswith(WRONG_PLACE):
        return stopped
    ends = direction * rear, direction * ahead
    back, front = min(*ends, direction * known.rear_m), max(*ends, direction * known.front_m)
    return replace(stopped, rear_m=direction * back, front_m=direction * front)


def _turn_contradiction(known: TrainInterval, facing: int, front: float, over: float, under: float) -> str | None:
    """Return what a change of ends contradicts: the train stands where it stood, its rear end is now the front."""
    end = max(known.end_m * known.direction, known.front_m * known.direction) * known.direction
    if facing * front - over > facing * known.rear_m:
        return "the train has changed ends and is behind its interval"
    if facing * front + under - known.length_m < facing * end:
        return "the train has changed ends and is beyond its interval"
    return None


def _longest_way_m(before: float | None, now: float | None, elapsed: float, limits: InterlockingLimits) -> float:
    """Return how far a train can have run, between reports of its speed where it has given both [m]."""
    top = limits.speed_mps
    if before is not None and now is not None:
        # speeds in between are at most so much above both ends
        top = min(top, max(before, now) + SPEED_ERROR_MPS + 0.5 * limits.acceleration_mps2 * elapsed)
    return top * elapsed


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
        return with_train(state, _turn(known, facing, rear, ahead, layout))
    if confirmed and before.claimed_m is not None and before.stop is None:
        # one wrong report alone moves no rear end, and a wider bound moves none back
        both = min(facing * rear, facing * before.claimed_m)
        known = replace(known, rear_m=facing * max(both, facing * before.rear_m))
    # of a stopped train the interval only grows
    front = ahead if before.stop is None else facing * max(facing * ahead, facing * before.front_m)
    return with_train(state, replace(known, front_m=front))


def _turn(known: TrainInterval, facing: int, rear: float, ahead: float, layout: Layout) -> TrainInterval:
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


#: A train within this distance of the end of its track asks for the next route [m].
ROUTE_AHEAD_M = 700.0
#: A train is sent an authority at its report, at a stop, and otherwise this often [s].
AUTHORITY_S = 1.0
#: Largest drift between clocks of a train and of the centre, and error of a clock that is not noticed [s].
CLOCK_DRIFT, CLOCK_TOLERANCE_S = 1e-4, 1.0


@dataclass(kw_only=True)
class Supervision:
    """Supervised trains of a line."""

    layout: Layout
    state: Interlocking
    #: Called with points that have to move and the track they are to lead to; `set_detected` takes what they report.
    command: Callable[[PointName, int], None] = lambda *_: None

    routes: Literal["automatic", "by hand"] = "automatic"
    limits: InterlockingLimits = field(default_factory=InterlockingLimits)
    centre: CentreLimits = field(default_factory=CentreLimits)
    records: dict[int, TrainRecord] = field(default_factory=dict)
    routes_set: int = 0
    heard: set[int] = field(default_factory=set)  #: Trains that have reported since the last authorities.
    #: When a train was sent its last authority [s], and whether it was an order to stop.
    sent: dict[int, tuple[float, bool]] = field(default_factory=dict)

    _clocks: dict[int, tuple[float, float]] = field(default_factory=dict)

    def report(self, message: TrainMessage, now_s: float) -> Rejection | None:
        """Take a report; return why it does not count, None where it does."""
        if message.train not in self.state.trains:
            return Rejection.UNKNOWN_TRAIN
        record = self.records.get(message.train, TrainRecord(train=message.train))
        self.records[message.train], reason = record_received(record, message, now_s, limits=self.centre)
        if reason is None:
            latest_ns, clock = self._read_clock(message, now_s)
            self.state = report_received(self.state, message, self.layout, limits=self.limits, latest_ns=latest_ns)
            if self.state.trains[message.train].measured_ns == message.time_ns:
                self._clocks[message.train] = clock  # that of a contradicted report would make ways possible later
            self.state = answer_received(self.state, message)
            self.heard.add(message.train)
        return reason

    def _read_clock(self, message: TrainMessage, now_s: float) -> tuple[int | None, tuple[float, float]]:
        """Return the train's clock at most, by the delays of the reports before (None without one), and its delay."""
        known = self.state.trains[message.train]
        before = None if known.measured_ns is None else self._clocks.get(message.train)
        apart_s = now_s - message.sent_ns / 1e9
        least_s = apart_s if before is None else before[0] + CLOCK_DRIFT * (now_s - before[1])
        latest_ns = None if before is None else round((now_s - least_s + CLOCK_TOLERANCE_S) * 1e9)
        return latest_ns, (min(apart_s, least_s), now_s)

    def set_detected(self, point: PointName, track: int | None) -> None:
        """Take what points are detected at: a track, None where they are at neither end."""
        self.state = points_reported(self.state, point, track)

    def set_route(self, train: int, **step: Any) -> str | None:
        """Set a route to the next station; return the reason of a refusal.

        `step` is what `route_requested` takes of the step at hand.
        """
        if train not in self.state.trains:
            return f"there is no train {train}"
        self.state, moved, reason = route_requested(self.state, train, self.layout, **step)
        if reason is not None:
            return reason
        self.routes_set += 1
        for point in moved:
            self.command(point, self.state.points[point].wanted)
        return None

    def ask_route_back(self, train: int) -> str | None:
        """Ask a train to give its route to the next station back; return the reason of a refusal."""
        self.state, reason = ask_route_back(self.state, train, self.layout, limits=self.limits)
        return reason

    def advance(self, now_s: float) -> list[Authority]:
        """Release points, set routes, extend authorities; return what is sent once the state is stored.

        Trains that have reported since the last call, whose stop has changed, or that were sent nothing for
        `AUTHORITY_S` are looked at; the others wait for their report.
        """
        self.state = overlaps_stopped(self.state, self.layout)
        self.state = release_points(self.state, now_s, self.layout, limits=self.limits)
        nearby, stopped = NearbyTrains(self.state, self.layout), stop_orders(self.state)
        due = [number for number in self.state.trains if self._is_due(number, now_s, stopped)]
        if self.routes == "automatic":
            for number in due:
                if self._wants_route(self.state.trains[number]):
                    self.set_route(number, nearby=nearby, stopped=stopped)
        self.state = extend_authorities(
            self.state, self.layout, limits=self.limits, trains=due, nearby=nearby, stopped=stopped
        )
        stopped = stop_orders(self.state)
        due = [number for number in self.state.trains if self._is_due(number, now_s, stopped)]
        if not due:
            return []
        self.state = replace(self.state, granted=self.state.granted + 1)
        self.heard.clear()
        self.sent.update((number, (now_s, self.state.stopped or number in stopped)) for number in due)
        return [self._authority(self.state.trains[number], number in stopped) for number in due]

    def _is_due(self, number: int, now_s: float, stopped: Mapping[int, str]) -> bool:
        sent_s, was_stopped = self.sent.get(number, (-math.inf, False))
        stop = self.state.stopped or number in stopped
        return number in self.heard or now_s - sent_s >= AUTHORITY_S - 1e-6 or stop != was_stopped

    def _authority(self, train: TrainInterval, stopped: bool) -> Authority:
        end = train.end_m if train.asked_m is None else train.asked_m
        return Authority(
            train=train.train,
            number=self.state.granted,
            report=max(self.records[train.train].sequence, 0) if train.train in self.records else 0,
            end_cm=train.direction * int(train.direction * end * 100.0 // 1.0),
            direction=1 if train.direction > 0 else -1,
            stopped=self.state.stopped or stopped,
            shortens=train.asked_m is not None,
        )

    def _wants_route(self, train: TrainInterval) -> bool:
        ahead = train.station + train.direction
        if train.held or train.asked_m is not None:
            return False
        if not 0 <= ahead < len(self.layout.stations):
            return False
        return (
            train.direction * (self.layout.track_end_m(train.station, train.direction) - train.front_m) < ROUTE_AHEAD_M
        )


def standing_train(
    number: int, *, direction: int, front_m: float, length_m: float, bound_m: float, station: int, track: int
) -> TrainInterval:
    """Return the interval of a train at rest in a station, whose front is known within a bound."""
    ahead = front_m + direction * bound_m
    return TrainInterval(
        train=number,
        direction=direction,
        rear_m=front_m - direction * (length_m + bound_m),
        front_m=ahead,
        end_m=ahead,
        sequence=0,
        tracks={station: track},
        station=station,
        length_m=length_m,
    )


def at_start(layout: Layout, trains: list[TrainInterval]) -> Interlocking:
    """Return the interlocking with trains at rest and every point detected on track 1."""
    return Interlocking(
        trains={train.train: train for train in trains}, points={name: PointState() for name in layout.points()}
    )
