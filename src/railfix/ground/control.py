"""Control centre at work: supervision with its store, the monitor of satellite positioning, log, and page values.

What is acknowledged or granted is committed before it is sent: a centre that is killed at any moment goes on from
what its trains know.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from railfix.ground.centre import ReferenceCurve, TrainRecord, TrainState, time_passed
from railfix.ground.interlocking import HEAD, Interlocking, from_documents, stop_orders, stop_trains, to_documents
from railfix.ground.layout import PointName
from railfix.ground.stops import close_section, open_section, release_train
from railfix.ground.store import DatabaseError, Store
from railfix.ground.supervision import Supervision
from railfix.ground.triangle import STOPPING, MonitorLimits, MonitorState, TriangleVerdict, advance, release
from railfix.ground.triangle import Order as MonitorOrder
from railfix.ground.web import Order
from railfix.io.train_message import MessageError, SuspectedInterference, TrainMessage, decode

#: Time between attempts to write to a database that fails [s].
RETRY_S = 1.0
#: The release of a silent train is ordered a second time so long after the first, at least and at most [s].
AGAIN_S = 3.0, 60.0
#: Name of the stored document.
_CAUSE = "cause of the stop"


def _severity(verdict: TriangleVerdict) -> int:
    """Return the rank of a verdict: of those between two steps the one with the highest counts."""
    if verdict in (TriangleVerdict.MONITOR_LOST, TriangleVerdict.JAMMING):
        return 2  # a fix is absent: that stops only once it is late
    return 3 if verdict in STOPPING else int(verdict is not TriangleVerdict.HEALTHY)


@dataclass(kw_only=True)
class StopOrder:
    """Order to stop that a train has: how long until it was acknowledged, and until the train was at rest [s]."""

    number: int
    sent_s: float
    acknowledged_s: float | None = None
    rest_s: float | None = None

    def take_report(self, message: TrainMessage, now_s: float) -> bool:
        """Take a report; return whether the train has come to rest by it."""
        taken = message.authority is not None and message.authority >= self.number
        if taken and self.acknowledged_s is None:
            self.acknowledged_s = now_s - self.sent_s
        rests = message.standstill and self.rest_s is None and (taken or message.authority is None)
        if rests:
            self.rest_s = now_s - self.sent_s
        return rests

    def __str__(self) -> str:
        """The times in words."""
        taken = "not acknowledged" if self.acknowledged_s is None else f"acknowledged after {self.acknowledged_s:.1f} s"
        return taken if self.rest_s is None else f"{taken}, at rest after {self.rest_s:.1f} s"


@dataclass(kw_only=True)
class ControlCentre:
    """Control centre."""

    supervision: Supervision
    store: Store
    curves: dict[int, ReferenceCurve]  #: By direction.
    send: Callable[[int, bytes], None]  #: Sends bytes to a train.
    clock: Callable[[], float]  #: Centre's clock, which never runs backwards [s].
    wall_ns: Callable[[], int]  #: Time for the log [ns].
    monitor: MonitorState | None = None  #: Of satellite positioning; None where nothing judges it.
    times: MonitorLimits = field(default_factory=MonitorLimits)
    lines: list[str] = field(default_factory=list)
    reports: int = 0
    rejected: Counter[str] = field(default_factory=Counter)  #: Reports that did not count, by reason.
    stop_s: float | None = None
    stops: dict[int, StopOrder] = field(default_factory=dict)  #: Trains that are ordered to stop.
    #: Why the database does not take the state: nothing is granted meanwhile, and the trains stop in time.
    database: str | None = None
    #: What the newest report of each train suspects.
    interference: dict[int, SuspectedInterference] = field(default_factory=dict)

    _asked_s: dict[int, float] = field(default_factory=dict)
    _failed_s: float = 0.0
    _routes: dict[int, int] = field(init=False)
    _verdict: tuple[TriangleVerdict, int] | None = None
    _judged: TriangleVerdict | None = None
    _saved: Interlocking | None = None
    _saved_sequences: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._routes = {n: train.station for n, train in self.supervision.state.trains.items()}

    @classmethod
    def restore(cls, supervision: Supervision, store: Store, *, judged: bool, **rest: Any) -> ControlCentre:
        """Return the centre with what a process before has stored; at the first start as `supervision` has it.

        Trains are unknown until they are heard, and points that were moving are moved again. Where a triangle judges
        satellite positioning, the first start is a stop, to be released by hand.
        """
        texts, monitor = store.documents(HEAD), MonitorState() if judged else None
        if texts:
            supervision.state = state = from_documents(texts)
            supervision.records = store.records()
            if judged:
                cause = store.document(_CAUSE)
                monitor = MonitorState(
                    stopped=state.stopped, cause=TriangleVerdict[cause] if state.stopped and cause else None
                )
        centre = cls(supervision=supervision, store=store, monitor=monitor, **rest)
        if monitor is not None:
            centre.monitor = replace(monitor, complete_s=centre.clock(), since_s=centre.clock())
        supervision.state = replace(supervision.state, stopped=monitor is not None and monitor.stopped)
        for name, point in supervision.state.points.items():
            if point.detected is None:
                supervision.command(name, point.wanted)
        centre.log("centre started again; every train is unknown" if texts else "centre started")
        return centre

    def log(self, text: str, *, train: int | None = None) -> None:
        """Write a line of the log."""
        self.lines.append(f"{self.clock():.0f} s: {text}")
        del self.lines[:-200]
        self.store.note(self.wall_ns(), text, train=train)

    def report(self, number: int, payload: bytes) -> None:
        """Take a report that came over the links of a train."""
        try:
            message = decode(payload)
        except MessageError:
            self.rejected["no position message"] += 1
            return
        if message.train != number:
            self.rejected["of another train"] += 1
            return
        trains = self.supervision.state.trains
        before = self.supervision.records.get(number, TrainRecord(train=number))
        if message.sequence > before.sequence:
            self._hear_interference(message)
        reason = self.supervision.report(message, self.clock())
        if reason is not None:
            self.rejected[reason.value] += 1
            return
        was, known = trains[number], self.supervision.state.trains[number]
        if known.stop is not None and known.stop != was.stop:
            self.rejected["contradicts what is known of the train"] += 1
            self.log(f"train {number}: stopped, {known.stop}", train=number)
        if known.direction != message.facing and known.stop is None:
            self.rejected["change of ends outside its station, or of an incomplete train"] += 1
        if was.asked_m is not None and known.asked_m is None:
            what = "has given its route back" if known.held else "keeps its route"
            self.log(f"train {number}: {what}", train=number)
        if (order := self.stops.get(number)) is not None and order.take_report(message, self.clock()):
            self.log(f"train {number}: order to stop {order}", train=number)
        self.reports += 1
        after = self.supervision.records[number]
        if before.state in (TrainState.SIMULATED, TrainState.ERROR):
            self.log(f"train {number}: heard again, place jumps by {after.jump_m or 0.0:.1f} m", train=number)
        elif before.state is TrainState.UNKNOWN:
            self.log(f"train {number}: heard", train=number)

    def _hear_interference(self, message: TrainMessage) -> None:
        """Note what a train suspects, also in a report without a place, and log where that changes."""
        before = self.interference.get(message.train, SuspectedInterference.NONE)
        now = message.interference or SuspectedInterference.NONE
        if now is not before:
            word = f"{now.name.lower()} suspected" if now else f"{before.name.lower()} no longer suspected"
            self.log(f"train {message.train}: {word}", train=message.train)
        self.interference[message.train] = now

    @property
    def alarms(self) -> list[str]:
        """Interference that trains suspect, a sentence each."""
        return [f"train {n} suspects {kind.name.lower()}" for n, kind in sorted(self.interference.items()) if kind]

    def judge(self, verdict: TriangleVerdict, receiver: int = -1, *, age_s: float = 0.0) -> None:
        """Take a verdict on satellite positioning, of fixes of an age; of those between two steps the worst counts.

        Fixes older than `MonitorLimits.late_s`, or from the future by as much, are no verdict.
        """
        if abs(age_s) > self.times.late_s:
            self.rejected["fixes of the triangle with a wrong age"] += 1
            return
        if self._verdict is None or _severity(verdict) >= _severity(self._verdict[0]):
            self._verdict = verdict, receiver

    def step(self) -> None:
        """Judge, release, route, extend; commit; then send. To be called several times a second."""
        now = self.clock()
        if self.database is not None and now - self._failed_s < RETRY_S:
            return
        self._monitor(now)
        authorities = self.supervision.advance(now)
        state, limits = self.supervision.state, self.supervision.centre
        for number, train in state.trains.items():
            before, self._routes[number] = self._routes[number], train.station
            if train.direction * (train.station - before) > 0:
                station = self.supervision.layout.stations[train.station].name
                self.log(f"train {number}: route to {station}, track {train.tracks[train.station]}", train=number)
        for number, record in self.supervision.records.items():
            rests = number in self.stops and state.trains[number].standstill  # it is not shown as running on
            curves = {} if rests else self.curves
            after = time_passed(record, now, curves=curves, authority_m=state.trains[number].end_m, limits=limits)
            if after.state is not record.state:
                self.log(f"train {number}: {after.state.value}", train=number)
            self.supervision.records[number] = after
        if not self._save_whole(now):
            return
        for authority in authorities:
            if not authority.stopped:
                self.stops.pop(authority.train, None)
            elif authority.train not in self.stops:
                self.stops[authority.train] = StopOrder(number=authority.number, sent_s=now)
            self.send(authority.train, authority.encode())

    def _save_whole(self, now: float) -> bool:
        """Commit what has changed since the last time; return whether the database has taken it."""
        state, records = self.supervision.state, self.supervision.records
        cause = "" if self.monitor is None or self.monitor.cause is None else self.monitor.cause.name
        changed = [record for n, record in records.items() if self._saved_sequences.get(n) != record.sequence]
        try:
            self.store.save(*changed, documents={**to_documents(state, self._saved), _CAUSE: cause})
        except DatabaseError as error:
            if self.database is None:
                self.log(f"ALARM: {error}; nothing is granted until it can")
            self.database, self._failed_s = f"{error}; nothing is granted", now
            return False
        if self.database is not None:
            self.log("the database is written again")
        self.database, self._saved = None, state
        self._saved_sequences.update((record.train, record.sequence) for record in changed)
        return True

    def release(self) -> str | None:
        """Release a stop by hand; return the reason of a refusal."""
        if self.monitor is None:
            return "there is no stop to release"
        self.monitor, orders, reason = release(self.monitor, self.clock(), limits=self.times)
        if orders:
            self.supervision.state = replace(self.supervision.state, stopped=False)
            self.log("stop released by hand")
        return reason

    def stop(self, train: int | None) -> str | None:
        """Stop a train, or every train with None, by hand; return the reason of a refusal."""
        state = self.supervision.state
        if train is not None and train not in state.trains:
            return f"there is no train {train}"
        self.supervision.state = stop_trains(state, state.trains if train is None else (train,), "stopped by hand")
        self.log("every train stopped by hand" if train is None else f"train {train}: stopped by hand", train=train)
        return None

    def close_section(self, name: str) -> str | None:
        """Close a station or a section by hand: its trains are stopped, others stay out; return a refusal's reason."""
        block = self.supervision.layout.sections.get(name)
        if block is None:
            return f"there is no section {name!r}"
        layout, reason = self.supervision.layout, f"{name} is closed"
        self.supervision.state = close_section(self.supervision.state, block, layout, reason)
        self.log(f"{name}: closed by hand")
        return None

    def open_section(self, name: str) -> str | None:
        """Open a station or a section that was closed by hand; return the reason of a refusal."""
        block = self.supervision.layout.sections.get(name)
        if block not in self.supervision.state.closed or block is None:
            return f"{name!r} is not closed"
        self.supervision.state = open_section(self.supervision.state, block)
        self.log(f"{name}: opened by hand; its trains are released one by one")
        return None

    def release_train(self, train: int) -> str | None:
        """Release the stop of a train by hand; return the reason of a refusal.

        Nothing says of a silent train that it still is where it was: its release is ordered twice (`AGAIN_S`).
        """
        now, (least_s, most_s), asked_s = self.clock(), AGAIN_S, self._asked_s.pop(train, -math.inf)
        silent = self.supervision.records.get(train, TrainRecord(train=train)).state is not TrainState.TRACKED
        state, reason = release_train(self.supervision.state, train, self.supervision.layout)
        if reason is None and silent and not least_s <= now - asked_s <= most_s:
            self._asked_s[train] = now
            reason = f"train {train} is silent: order it again in {least_s:g} to {most_s:g} s if it stands, whole"
        else:
            self.supervision.state = state
        return self._by_hand(train, "release asked for by hand", reason)

    def set_route(self, train: int) -> str | None:
        """Set a train's route to the next station by hand; return the reason of a refusal."""
        return self._by_hand(train, "route asked for by hand", self.supervision.set_route(train))

    def ask_route_back(self, train: int) -> str | None:
        """Ask a train by hand to give its route to the next station back; return the reason of a refusal."""
        return self._by_hand(train, "asked for its route back", self.supervision.ask_route_back(train))

    def _by_hand(self, train: int, order: str, reason: str | None) -> str | None:
        """Log an order and the reason of its refusal, which is returned."""
        self.log(f"train {train}: {order}{'' if reason is None else f', refused: {reason}'}", train=train)
        return reason

    def _monitor(self, now: float) -> None:
        if self.monitor is None:
            return
        verdict, receiver = self._verdict or (None, -1)
        if verdict is None and now - self.monitor.complete_s <= self.times.late_s:
            return  # not late yet
        self._verdict, self._judged = None, verdict
        self.monitor, orders = advance(self.monitor, now, verdict, receiver=receiver, limits=self.times)
        for order in orders:
            self.log(f"triangle: {order.value}")
            if order is MonitorOrder.STOP:
                self.stop_s = now
        self.supervision.state = replace(self.supervision.state, stopped=self.monitor.stopped)

    def snapshot(self) -> dict[str, Any]:
        """Return plain values of trains, points, monitor and log for the page."""
        layout, state = self.supervision.layout, self.supervision.state
        trains, stopped = [], stop_orders(state)
        for number, train in state.trains.items():
            record = self.supervision.records.get(number, TrainRecord(train=number))
            rear, front = train.interval_m
            pieces = layout.pieces(rear, front, train.tracks)
            speed = 0 if record.message is None else record.message.speed_cmps or 0
            trains.append({
                "number": number, "state": record.state.value, "shown": record.shown_m, "speed": abs(speed) / 100.0,
                "place": self._place(train.direction, record.shown_m),
                "direction": train.direction, "rear": rear, "front": front, "end": train.end_m, "jump": record.jump_m,
                "interference": self.interference.get(number, SuspectedInterference.NONE).name.lower(),
                "stop": None if number not in stopped else f"{stopped[number]}; {self.stops.get(number, 'not sent')}",
                "pieces": [[0 if lane == 0 else 2 - lane % 2, low, high] for lane, low, high in pieces],
            })  # fmt: skip
        points = [
            {"name": self.point_name(name), "wanted": point.wanted, "detected": point.detected,
             "locked": list(point.locked)}
            for name, point in state.points.items()
        ]  # fmt: skip
        return {
            "now": self.clock(), "trains": trains, "points": points, "log": self.lines[:-25:-1],
            "stations": [{"name": s.name, "begin": s.begin_m, "end": s.end_m, "points": s.points_m}
                         for s in layout.stations],
            "sections": [
                {"name": name, "low": layout.block_m(block)[0], "high": layout.block_m(block)[1],
                 "closed": block in state.closed}
                for name, block in layout.sections.items()
            ],
            "monitor": self._monitor_values(), "routes": self.supervision.routes, "rejected": dict(self.rejected),
        }  # fmt: skip

    def _place(self, direction: int, shown_m: float | None) -> str:
        """Return the station, or the section and the progress in it, as P5 3.1 reports it; "" without a place."""
        if shown_m is None or (curve := self.curves.get(direction)) is None:
            return ""
        names = [station.name for station in self.supervision.layout.stations][::direction]
        if (station := curve.station_at(shown_m)) is not None:
            return names[station]
        section, progress = curve.progress(shown_m)
        return f"{names[section]} to {names[section + 1]}, {progress:.0f} %"

    def point_name(self, point: PointName) -> str:
        """Return the name of points for people."""
        return f"{self.supervision.layout.stations[point[0]].name} {'lower' if point[1] < 0 else 'upper'}"

    def _monitor_values(self) -> dict[str, Any]:
        if self.monitor is None:
            return {"verdict": "judged by nothing", "stopped": False, "cause": None}
        cause, verdict = (
            absent if value is None else value.name.lower().replace("_", " ")
            for value, absent in ((self.monitor.cause, "not yet released"), (self._judged, "no verdict"))
        )
        return {"verdict": verdict, "stopped": self.monitor.stopped, "cause": cause if self.monitor.stopped else None}


def list_orders(centre: ControlCentre) -> dict[str, Order]:
    """Return the orders of the page: stops of one train and of all, their release, and routes."""

    def of_train(order: Callable[[int], str | None]) -> Order:
        def given(values: dict[str, Any]) -> str | None:
            train = values.get("train")
            return order(train) if type(train) is int else "train: a number was expected"

        return given

    def of_section(order: Callable[[str], str | None]) -> Order:
        return lambda values: order(str(values.get("section", "")))

    return {
        "close-section": of_section(centre.close_section),
        "open-section": of_section(centre.open_section),
        "release": lambda _: centre.release(),
        "route": of_train(centre.set_route),
        "route-back": of_train(centre.ask_route_back),
        "stop": of_train(centre.stop),
        "stop-all": lambda _: centre.stop(None),
        "release-train": of_train(centre.release_train),
    }
