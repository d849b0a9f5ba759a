"""Supervision of the trains of a line by the centre: reports in, authorities out, without input or output.

The one path for `railfix.ground.control` (the centre with its store and page) and for simulated traffic
(`railfix.ground.traffic`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from railfix.ground.centre import CentreLimits, Rejection, TrainRecord
from railfix.ground.centre import report_received as record_received
from railfix.ground.interlocking import (
    Interlocking,
    InterlockingLimits,
    NearbyTrains,
    PointState,
    TrainInterval,
    extended,
    points_reported,
    released,
    route_requested,
    stopped_trains,
)
from railfix.ground.layout import Layout, PointName
from railfix.ground.on_board import Authority
from railfix.ground.plausibility import report_received
from railfix.ground.stops import answer_received, ask_route_back, overlaps_stopped
from railfix.io.train_message import TrainMessage

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
    #: Called with points that have to move and the track they are to lead to; `detected` takes what they report.
    command: Callable[[PointName, int], None] = lambda *_: None

    routes: Literal["automatic", "by hand"] = "automatic"
    limits: InterlockingLimits = field(default_factory=InterlockingLimits)
    centre: CentreLimits = field(default_factory=CentreLimits)
    records: dict[int, TrainRecord] = field(default_factory=dict)
    refusals: Counter[str] = field(default_factory=Counter)  #: Routes refused, by reason.
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
            self.state = report_received(
                self.state, message, self.layout, limits=self.limits, latest_ns=self._latest_ns(message, now_s)
            )
            self.state = answer_received(self.state, message)
            self.heard.add(message.train)
        return reason

    def _latest_ns(self, message: TrainMessage, now_s: float) -> int | None:
        """Return the train's clock at most, by the delays of the reports before; None before the first."""
        before = self._clocks.get(message.train)
        apart_s = now_s - message.sent_ns / 1e9
        least_s = apart_s if before is None else before[0] + CLOCK_DRIFT * (now_s - before[1])
        self._clocks[message.train] = min(apart_s, least_s), now_s
        return None if before is None else round((now_s - least_s + CLOCK_TOLERANCE_S) * 1e9)

    def detected(self, point: PointName, track: int | None) -> None:
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
            self.refusals[reason] += 1
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
        self.state = released(self.state, now_s, self.layout, limits=self.limits)
        nearby, stopped = NearbyTrains(self.state, self.layout), stopped_trains(self.state)
        due = [number for number in self.state.trains if self._is_due(number, now_s, stopped)]
        if self.routes == "automatic":
            for number in due:
                if self._wants_route(self.state.trains[number]):
                    self.set_route(number, nearby=nearby, stopped=stopped)
        self.state = extended(self.state, self.layout, limits=self.limits, trains=due, nearby=nearby, stopped=stopped)
        stopped = stopped_trains(self.state)
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
        inner = self.layout.stations[train.station].inner_m
        way = train.direction * ((inner[1] if train.direction > 0 else inner[0]) - train.front_m)
        return way < ROUTE_AHEAD_M


def standing_train(
    train: int, *, direction: int, front_m: float, length_m: float, bound_m: float, station: int, track: int
) -> TrainInterval:
    """Return the interval of a train at rest in a station, whose front is known within a bound."""
    ahead = front_m + direction * bound_m
    return TrainInterval(
        train=train,
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
