"""Supervision of a line's trains by the centre: computes authorities from reports, and does no input or output.

The supervision is used by `railfix.ground.control` (the centre with store and page) and by simulated traffic
(`railfix.ground.traffic`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal

from railfix.ground.authority import Authority, BrakeOrder
from railfix.ground.centre import CentreLimits, Rejection, TrainRecord
from railfix.ground.centre import report_received as record_received
from railfix.ground.interlocking import (
    NearbyTrains,
    due_commands,
    extend_authorities,
    points_reported,
    release_points,
    route_requested,
    stop_orders,
)
from railfix.ground.layout import Layout, PointName
from railfix.ground.reports import report_received
from railfix.ground.state import Interlocking, InterlockingLimits, PointState, TrainInterval, stop_trains
from railfix.ground.stops import (
    SWEPT,
    UNKNOWN,
    answer_received,
    ask_route_back,
    occupied_detected,
    overlaps_stopped,
    parted_cleared,
)
from railfix.io.train_message import TrainMessage

#: A train gets its next route when its front end is less than this from the end of its track [m].
ROUTE_AHEAD_M = 700.0
#: Longest time between two authorities to a train [s]. A train also gets an authority after each report, and when its
#: stop begins or ends.
AUTHORITY_S = 1.0
#: At a restart, at least this many authority numbers are skipped.
SKIPPED: Final = 1 << 20
#: An authority counts as lapsed on board when the report that it answers is older than this [s]. This time must exceed
#: `LONGEST_FRESH_S`.
LAPSED_S: Final = 60.0
#: Largest relative drift between the clocks of a train and the centre.
CLOCK_DRIFT: Final = 1e-4


@dataclass(kw_only=True)
class Supervision:
    """Supervised trains of a line."""

    layout: Layout
    state: Interlocking
    #: Function that commands a set of points to a track. The detection that follows must be passed to `set_detected`.
    command: Callable[[PointName, int], None] = lambda *_: None

    routes: Literal["automatic", "by hand"] = "automatic"
    limits: InterlockingLimits = field(default_factory=InterlockingLimits)
    centre: CentreLimits = field(default_factory=CentreLimits)
    records: dict[int, TrainRecord] = field(default_factory=dict)
    routes_set: int = 0
    heard: set[int] = field(default_factory=set)  #: Trains that have reported since authorities were last computed.
    #: Time at which the last authority was sent to each train [s], and whether this authority was an order to stop.
    sent: dict[int, tuple[float, bool]] = field(default_factory=dict)
    #: Time at which the newest authority that permits the train to run was sent, by train [s].
    granted_s: dict[int, float] = field(default_factory=dict)

    #: Order to brake of each stopped train: time of the last sending [s] (infinite once acknowledged), and number.
    ordered: dict[int, tuple[float, int]] = field(default_factory=dict)
    #: Numbers of all orders to brake sent to each train since the start.
    issued: dict[int, set[int]] = field(default_factory=dict)
    begun_s: float = -math.inf  #: Time on the centre's clock when the centre started from a stored state [s].
    #: Trains that must report before any authority is extended or any route is set (`begin_again`).
    awaited: set[int] = field(default_factory=set)
    #: Whether each section is detected as occupied; None if there is no answer, or the last answer is too old.
    detected: dict[str, bool | None] = field(default_factory=dict)
    #: Time of the newest message of each section's detection, which must send messages regularly [s].
    answered_s: dict[str, float] = field(default_factory=dict)

    _clocks: dict[int, tuple[float, float]] = field(default_factory=dict)
    _asked_s: dict[PointName, float] = field(default_factory=dict)
    _nearby: NearbyTrains = field(init=False)
    #: Trains as they were when they were last compared in pairs.
    _checked: Mapping[int, TrainInterval] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._nearby = NearbyTrains(self.state, self.layout)

    def report(self, message: TrainMessage, now_s: float) -> Rejection | None:
        """Process a report; return the reason for its rejection, None if it is accepted."""
        number = message.train
        if number not in self.state.trains:
            return Rejection.UNKNOWN_TRAIN
        before = self.records.get(number) or TrainRecord(train=number)
        self.records[number], reason = record_received(before, message, now_s, limits=self.centre)
        if counts(reason):
            if self.state.skipped[1] <= max(message.authority or 0, message.brake_order or 0) <= self.state.granted:
                self.awaited.discard(number)
            elapsed_s, clock, is_new = self._read_clock(message, before, now_s)
            self.state = report_received(self.state, message, self.layout, limits=self.limits, elapsed_s=elapsed_s)
            # with a clock delay from a contradicted report, later checks could accept too long distances
            if is_new or self.state.trains[number].contradiction is None:
                self._clocks[number] = clock
            self.state = answer_received(self.state, message)
            self.heard.add(number)
        if reason not in (Rejection.REPEATED, Rejection.EARLIER_START, Rejection.FAR_AHEAD):
            self._take_answer(message)
        return reason

    def _take_answer(self, message: TrainMessage) -> None:
        """Process what a report states about the order to brake that the train obeys."""
        number, held = message.train, message.brake_order
        sent_s, first = self.ordered.get(number, (0.0, 0))
        if number in self.ordered and is_obeyed(message, first):
            self.ordered[number] = math.inf, first
        elif sent_s == math.inf:  # the on-board unit has restarted and no longer obeys the order
            self.ordered[number] = -math.inf, first
        elif held is not None and held not in self.issued.get(number, ()):
            reason = "the train obeys an order to brake from before this start"
            self.state = stop_trains(self.state, [number], reason)

    def _read_clock(
        self, message: TrainMessage, record: TrainRecord, now_s: float
    ) -> tuple[float | None, tuple[float, float], bool]:
        """Return an upper bound of the time since the previous position [s], the delay of the train's clock, and
        whether this clock is new.

        The bound is computed with the least delay of earlier reports or, after a restart on board, with the centre's
        clock alone; it is None if unknown. The delay behind the centre's clock [s] is returned with the time of its
        observation. A clock that was set back counts as new, because its earlier delays make later bounds too long.
        """
        number = message.train
        known, tolerance_s = self.state.trains[number], self.centre.clock_s
        apart_s = now_s - message.sent_ns / 1e9
        same = known.measured_ns is not None and (message.session or 0) == known.session
        before = self._clocks.get(number) if same else None
        if before is None:
            heard = not same and number in self._clocks
            return (now_s - record.measured_s + tolerance_s if heard else None), (apart_s, now_s), True
        least_s = before[0] + CLOCK_DRIFT * (now_s - before[1])
        assert known.measured_ns is not None
        elapsed_s = now_s - least_s + tolerance_s - known.measured_ns / 1e9
        set_back = message.time_ns < known.measured_ns
        return elapsed_s, (apart_s if set_back else min(apart_s, least_s), now_s), set_back

    @property
    def awaited_text(self) -> str:
        """List of the trains that have not reported since the start, in words."""
        return ", ".join(f"train {number}" for number in sorted(self.awaited))

    def set_detected(self, point: PointName, track: int | None) -> None:
        """Process the detection of points: a track, or None if the points are in neither end position."""
        self._asked_s.pop(point, None)
        self.state = points_reported(self.state, point, track, self.layout)

    def has_lapsed(self, train: int, now_s: float) -> bool:
        """Return whether every authority that permitted a train to run has lapsed on board.

        On board, the age of an authority is counted from the sending of the report that it answers, which is before the
        sending of the authority.
        """
        record = self.records.get(train)
        counted_s = math.inf if record is None or record.counted_s is None else record.counted_s
        answered_s = min(self.granted_s.get(train, -math.inf), counted_s)
        return now_s - max(answered_s, self.begun_s) > LAPSED_S

    def begin_again(self, now_s: float, *, wall_us: int) -> tuple[PointName, ...]:
        """Begin with a stored state, which may be an older copy; return the points whose detection must be requested.

        No authority is extended until every train has acknowledged an authority or an order to brake sent since this
        start. The acknowledging report states the end of the train's authority, which the database may not contain. A
        train that has acknowledged rejects late authorities of the earlier process. Stored detections are dropped.

        The first authority number is the computer's time `wall_us` [us], so that it exceeds the numbers of earlier
        starts. If the computer's clock was set back, the numbers still exceed those in the database.
        """
        self.awaited, self.begun_s, last = set(self.state.trains), now_s, self.state.granted
        first = max(last + SKIPPED, wall_us)
        trains = {n: replace(t, runs_by=first) for n, t in self.state.trains.items()}
        points = {name: replace(p, detected=None, commanded=False) for name, p in self.state.points.items()}
        self.state = replace(self.state, trains=trains, points=points, granted=first, skipped=(last, first))
        self._asked_s = dict.fromkeys(points, now_s)
        return tuple(points)

    def set_section_detected(self, section: str, occupied: bool | None, now_s: float = -math.inf) -> None:
        """Process the detection of a section: occupied, free, or None if unknown.

        An occupied section is immediately compared with the intervals of the trains. Otherwise, a wrong report that
        arrives later could extend an interval into the section, and the occupation would be attributed to that train.
        """
        self.detected[section] = occupied
        if section in self.answered_s:
            self.answered_s[section] = now_s
        cleared = SWEPT if occupied is False else {UNKNOWN}
        bars = {bar for bar in self.state.bars if bar[0] != section or bar[1] not in cleared}
        unknown = {(section, UNKNOWN)} if occupied is None else set()
        self.state = replace(self.state, bars=frozenset(bars | unknown))
        if occupied:
            self.state = occupied_detected(self.state, self.layout, [section])

    def set_route(self, train: int, **step: Any) -> str | None:
        """Set a route to the next station; return the reason for a refusal.

        The keyword arguments `step` (`nearby` and `stopped`) are passed to `route_requested`. The points move after
        `command_points` is called.
        """
        if train not in self.state.trains:
            return f"no such train: {train}"
        if self.awaited:
            return f"no report since the start: {self.awaited_text}"
        self.state, _, reason = route_requested(self.state, train, self.layout, **step)
        self.routes_set += reason is None
        return reason

    def ask_route_back(self, train: int) -> str | None:
        """Request a train to give back its route to the next station; return the reason for a refusal."""
        self.state, reason = ask_route_back(self.state, train, self.layout, limits=self.limits)
        return reason

    def command_points(self, stored: Interlocking) -> None:
        """Command points according to a stored state; no commands are given before every train has reported."""
        if self.awaited:
            return
        self.state, commands = due_commands(self.state, self.layout, stored, self._locate())
        for point, track in commands.items():
            self.command(point, track)

    def forget(self, trains: Iterable[int]) -> None:
        """Drop the data of trains that are no longer supervised."""
        for number in trains:
            for kept in (self.records, self.sent, self.granted_s, self.ordered, self.issued, self._clocks):
                kept.pop(number, None)
            self.heard.discard(number)
            self.awaited.discard(number)

    def advance(self, now_s: float) -> list[Authority]:
        """Run `watch`, `work` and `command_points` without a store; return the authorities."""
        self.watch(now_s)
        authorities = self.work(now_s)
        self.command_points(self.state)
        return authorities

    def watch(self, now_s: float) -> list[BrakeOrder]:
        """Find trains that have to stop, and return the orders to brake to be sent; no commit is required.

        An order is repeated every `AUTHORITY_S` until a report of the train acknowledges it.
        """
        for section, at_s in self.answered_s.items():
            if now_s - at_s > self.limits.detection_s and self.detected[section] is not None:
                self.set_section_detected(section, None)
        self.state = parted_cleared(self.state)
        self.state = overlaps_stopped(self.state, self.layout, nearby=self._locate(), checked=self._checked)
        self._checked = self.state.trains
        self.state = occupied_detected(self.state, self.layout, [n for n, found in self.detected.items() if found])
        for point, asked_s in list(self._asked_s.items()):
            if now_s - asked_s > self.limits.answer_s:
                del self._asked_s[point]
                low, high = self.layout.zone_m(point)
                on = [n for n in self.state.points[point].locked if self.state.trains[n].overlaps(low, high)]
                self.state = stop_trains(self.state, on, "the trackside does not answer for points of its route")
        stops = stop_orders(self.state)
        if self.state.stopped:
            stops = dict.fromkeys(self.state.trains, "satellite positioning is suspended") | stops
        for number in [n for n in self.ordered if n not in stops]:
            del self.ordered[number]
        orders = []
        for number, reason in stops.items():
            sent_s, first = self.ordered.get(number, (-math.inf, self.state.granted))
            if now_s - sent_s >= AUTHORITY_S - 1e-6:
                self.ordered[number] = now_s, first
                order = self._authority(self.state.trains[number], stopped=True)
                self.issued.setdefault(number, set()).add(order.number)
                orders.append(BrakeOrder(**order.model_dump(), reason=reason[:200]))
        return orders

    def work(self, now_s: float) -> list[Authority]:
        """Release points, set routes, extend authorities; return the messages to send once the state is stored.

        The trains processed are those that have reported since the last call, whose stop has changed, or to which no
        authority was sent for `AUTHORITY_S`.
        """
        stopped = stop_orders(self.state)
        if not self.awaited:
            self._grant(now_s, stopped)
            stopped = stop_orders(self.state)
        due = self._list_due(now_s, stopped)
        if not due:
            return []
        granted, trains, stop = self.state.granted + 1, dict(self.state.trains), self.state.stopped
        for number in due:
            self.sent[number] = now_s, stop or number in stopped
            if not self.sent[number][1]:
                self.granted_s[number] = now_s
                trains[number] = trains[number].changed(runs_by=granted)
        self.state = replace(self.state, granted=granted, trains=trains)
        self.heard.clear()
        return [self._authority(trains[number], stopped=self.sent[number][1]) for number in due]

    def _grant(self, now_s: float, stopped: Mapping[int, str]) -> None:
        """Release points, set routes, and extend authorities."""
        self.state = release_points(self.state, now_s, self.layout, limits=self.limits)
        nearby, due = self._locate(), self._list_due(now_s, stopped)
        if self.routes == "automatic":
            for number in due:
                if self._wants_route(self.state.trains[number]):
                    self.set_route(number, nearby=nearby, stopped=stopped)
        self.state = extend_authorities(
            self.state, self.layout, limits=self.limits, trains=due, nearby=nearby, stopped=stopped
        )

    def _locate(self) -> NearbyTrains:
        """Return the updated index of trains by location."""
        self._nearby.update(self.state)
        return self._nearby

    def _list_due(self, now_s: float, stopped: Mapping[int, str]) -> list[int]:
        """Return the trains that have reported, whose stop has changed, or that got no authority for `AUTHORITY_S`."""
        stop, sent, least_s = self.state.stopped, self.sent, AUTHORITY_S - 1e-6
        return [
            number
            for number in self.state.trains
            if number in self.heard
            or (last := sent.get(number)) is None
            or now_s - last[0] >= least_s
            or last[1] != (stop or number in stopped)
        ]

    def _authority(self, train: TrainInterval, *, stopped: bool) -> Authority:
        end, record = train.end_m if train.asked_m is None else train.asked_m, self.records.get(train.train)
        low_m, high_m = train.span_m
        return Authority(
            train=train.train,
            number=self.state.granted,
            report=0 if record is None else max(record.sequence, 0),
            session=0 if record is None else record.session,
            end_cm=train.direction * int(train.direction * end * 100.0 // 1.0),
            direction=1 if train.direction > 0 else -1,
            stopped=stopped,
            shortens=train.asked_m is not None,
            overlap_cm=int(100.0 * self.limits.overlap_m),
            restrictions=tuple(
                (math.floor(100.0 * r.low_m), math.ceil(100.0 * r.high_m), int(100.0 * r.speed_mps))
                for r in self.state.restrictions.values()
                if r.low_m < high_m and low_m < r.high_m
            ),
            gradients=self.layout.gradients_between(low_m, high_m, train.direction),
        )

    def _wants_route(self, train: TrainInterval) -> bool:
        ahead = train.station + train.direction
        if train.held or train.asked_m is not None:
            return False
        if not 0 <= ahead < len(self.layout.stations):
            return False
        end = self.layout.track_end_m(train.station, train.direction)
        return train.direction * (end - train.front_m) < ROUTE_AHEAD_M


def is_obeyed(message: TrainMessage, number: int) -> bool:
    """Return whether a report acknowledges the order to brake with a given number, or a later order."""
    return (message.brake_order or -1) >= number


def counts(reason: Rejection | None) -> bool:
    """Return whether a report is accepted: there is no reason for rejecting it."""
    return reason is None


def standing_train(
    number: int, *, direction: int, front_m: float, length_m: float, bound_m: float, station: int, track: int
) -> TrainInterval:
    """Return the interval of a train at rest in a station; the front is known within `bound_m`."""
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
    """Return the interlocking with trains at rest, and every set of points detected in its position for track 1."""
    return Interlocking(
        trains={train.train: train for train in trains}, points={name: PointState() for name in layout.points()}
    )
