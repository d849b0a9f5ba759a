"""Running control centre: supervision, store, monitor of satellite positioning, log, and values on the web page.

Authorities, which also acknowledge reports, are committed to the store before they are sent. A centre that is killed at
any moment therefore restarts with every authority that its trains may have received.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from railfix.ground.authority import Authority, BrakeOrder
from railfix.ground.centre import ReferenceCurve, TrainRecord, TrainState, time_passed
from railfix.ground.desk import OrderDesk
from railfix.ground.interlocking import stop_orders
from railfix.ground.layout import PointName
from railfix.ground.reports import stands
from railfix.ground.state import HEAD, Interlocking, TrainInterval, from_documents, stop_trains, to_documents
from railfix.ground.stops import CLOSED
from railfix.ground.store import Store
from railfix.ground.supervision import Supervision, is_obeyed
from railfix.ground.triangle import STOPPING, MonitorLimits, MonitorState, TriangleVerdict, advance, release
from railfix.ground.triangle import Order as MonitorOrder
from railfix.ground.web import Order
from railfix.ground.writer import Commits, ThreadWriter
from railfix.io.train_message import MessageError, SuspectedInterference, TrainMessage, decode

#: Name of the stored document that contains the cause of a stop.
_CAUSE = "cause of the stop"


def _severity(verdict: TriangleVerdict) -> int:
    """Return the severity of a verdict; each step uses the most severe verdict since the previous step."""
    if verdict in (TriangleVerdict.MONITOR_LOST, TriangleVerdict.JAMMING):
        return 2  # less severe, because missing fixes stop trains only after `MonitorLimits.late_s`
    return 3 if verdict in STOPPING else int(verdict is not TriangleVerdict.HEALTHY)


@dataclass(kw_only=True)
class StopOrder:
    """Order to stop a train, with the times from sending to acknowledgement and to standstill [s]."""

    number: int
    sent_s: float
    acknowledged_s: float | None = None
    rest_s: float | None = None

    def take_report(self, message: TrainMessage, now_s: float) -> bool:
        """Process a report; return whether it is the first report of the train at rest."""
        taken = is_obeyed(message, self.number)
        if taken and self.acknowledged_s is None:
            self.acknowledged_s = now_s - self.sent_s
        rests = stands(message) and self.rest_s is None and (taken or message.authority is None)
        if rests:
            self.rest_s = now_s - self.sent_s
        return rests

    def __str__(self) -> str:
        """Return the times to acknowledgement and standstill in words."""
        taken = "not acknowledged" if self.acknowledged_s is None else f"acknowledged after {self.acknowledged_s:.1f} s"
        return taken if self.rest_s is None else f"{taken}, at rest after {self.rest_s:.1f} s"


@dataclass(kw_only=True)
class ControlCentre:
    """Control centre: supervision of trains, store, monitor of satellite positioning, log and orders."""

    supervision: Supervision
    store: Store
    curves: dict[int, ReferenceCurve]  #: Reference run curves by running direction.
    send: Callable[[int, bytes], None]  #: Function that sends bytes to a train.
    clock: Callable[[], float]  #: Function that returns the time of the centre's clock, which never runs backwards [s].
    wall_ns: Callable[[], int]  #: Function that returns the time for the log [ns].
    monitor: MonitorState | None = None  #: State of the monitor of satellite positioning; None without a triangle.
    times: MonitorLimits = field(default_factory=MonitorLimits)
    lines: list[str] = field(default_factory=list)
    reports: int = 0
    rejected: Counter[str] = field(default_factory=Counter)  #: Number of rejected reports, by reason.
    stop_s: float | None = None
    stops: dict[int, StopOrder] = field(default_factory=dict)  #: For each stopped train, its newest order to stop.
    #: Commits to the store; in a running centre, they are carried out in a thread.
    commits: Commits = field(default_factory=Commits)
    #: Function that requests the detection of a set of points; `Supervision.set_detected` processes the answer.
    ask: Callable[[PointName], None] = lambda _: None
    #: Interference that each train suspects according to its newest report.
    interference: dict[int, SuspectedInterference] = field(default_factory=dict)

    _routes: dict[int, int] = field(init=False)
    _alarm: str | None = None
    _verdict: tuple[TriangleVerdict, int] | None = None
    _judged: TriangleVerdict | None = None
    _saved: Interlocking | None = None
    _saved_sequences: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._routes = {n: train.station for n, train in self.supervision.state.trains.items()}

    @classmethod
    def restore(cls, supervision: Supervision, store: Store, *, judged: bool, **rest: Any) -> ControlCentre:
        """Return the centre with the state stored by an earlier process; at the first start, with the given state.

        After a restart, trains are unknown until they report, and the detection of all points is requested. With a
        triangle (`judged`), all trains are stopped from the first start until a release by hand. A stop ordered before
        a restart stays in force.
        """
        texts, monitor = store.documents(HEAD), MonitorState() if judged else None
        asked: tuple[PointName, ...] = ()
        stopped = supervision.state.stopped
        if texts:
            supervision.state = state = from_documents(texts)
            supervision.records, stopped = store.records(), state.stopped
            if judged:
                cause = store.document(_CAUSE)
                monitor = MonitorState(stopped=stopped, cause=TriangleVerdict[cause] if stopped and cause else None)
        centre = cls(supervision=supervision, store=store, monitor=monitor, **rest)
        if monitor is not None:
            centre.monitor = replace(monitor, complete_s=centre.clock(), since_s=centre.clock())
            stopped = monitor.stopped
        supervision.state = replace(supervision.state, stopped=stopped)
        if texts:
            asked = supervision.begin_again(centre.clock(), wall_us=centre.wall_ns() // 1000)
        for point in asked:
            centre.ask(point)
        centre.log("centre started again; every train is unknown" if texts else "centre started")
        return centre

    @property
    def database(self) -> str | None:
        """Reason why the state cannot be written to the database, None if it can be written."""
        return self.commits.alarm

    def log(self, text: str, *, train: int | None = None) -> None:
        """Write a line to the log."""
        self.lines.append(f"{self.clock():.0f} s: {text}")
        del self.lines[:-200]
        self.store.note(self.wall_ns(), text, train=train)

    def report(self, number: int, payload: bytes) -> None:
        """Process a report received over the links of a train."""
        try:
            message = decode(payload)
        except MessageError:
            self.rejected["no position message"] += 1
            return
        if message.train != number:
            self.rejected["of another train"] += 1
            return
        trains = self.supervision.state.trains
        before = self.supervision.records.get(number) or TrainRecord(train=number)
        reason = self.supervision.report(message, self.clock())
        after = self.supervision.records.get(number, before)
        if after.session != before.session and before.sequence >= 0:
            self.log(f"train {number}: on-board unit restarted", train=number)
        if after.rejected != before.rejected:
            word = "reports are accepted again" if after.rejected is None else f"report rejected: {after.rejected}"
            self.log(f"train {number}: {word}", train=number)
        if after.sequence != before.sequence or after.session != before.session:
            self._hear_interference(message)
            if (order := self.stops.get(number)) is not None and order.take_report(message, self.clock()):
                self.log(f"train {number}: order to stop {order}", train=number)
        if reason is not None:
            self.rejected[reason.value] += 1
            return
        self._note_report(trains[number], self.supervision.state.trains[number], message)
        self.reports += 1
        if before.state in (TrainState.SIMULATED, TrainState.ERROR):
            self.log(f"train {number}: reports again, position jumps by {after.jump_m or 0.0:.1f} m", train=number)
        elif before.state is TrainState.UNKNOWN:
            self.log(f"train {number}: first report", train=number)

    def _note_report(self, was: TrainInterval, known: TrainInterval, message: TrainMessage) -> None:
        """Count and log contradictions between report and record; log whether a train gives back or keeps its route."""
        number = known.train
        if known.contradiction is not None:
            self.rejected["contradicts the record of the train"] += 1
            if known.contradiction != was.contradiction:
                word = "stopped" if was.stop is None else "stopped before; now"
                self.log(f"train {number}: {word}, {known.contradiction}", train=number)
        elif known.stop is not None and was.stop is None:
            self.log(f"train {number}: stopped, {known.stop}", train=number)
        elif known.direction != message.facing:
            self.rejected["change of ends outside the station, or by a train that is not complete"] += 1
        if was.asked_m is not None and known.asked_m is None:
            what = "has returned its route" if known.held else "keeps its route"
            self.log(f"train {number}: {what}", train=number)

    def _hear_interference(self, message: TrainMessage) -> None:
        """Store the interference that a report states, even if the report has no position, and log changes."""
        before = self.interference.get(message.train, SuspectedInterference.NONE)
        now = message.interference or SuspectedInterference.NONE
        if now is not before:
            word = f"{now.name.lower()} suspected" if now else f"{before.name.lower()} no longer suspected"
            self.log(f"train {message.train}: {word}", train=message.train)
        self.interference[message.train] = now

    @property
    def alarms(self) -> list[str]:
        """Alarms about reports awaited after a start of the centre, and about interference that trains suspect."""
        awaited = self.supervision.awaited_text
        waits = (
            [f"no authorities are extended until these trains report, or confirm-start is ordered twice: {awaited}"]
            if awaited
            else []
        )
        return waits + [
            f"train {n} suspects {kind.name.lower()}" for n, kind in sorted(self.interference.items()) if kind
        ]

    def judge(self, verdict: TriangleVerdict, receiver: int = -1, *, age_s: float = 0.0) -> None:
        """Process a verdict on satellite positioning from fixes of age `age_s`.

        A verdict is ignored if the time of its fixes is more than `MonitorLimits.late_s` before or after the present.

        Each step uses the most severe verdict since the previous step.
        """
        if abs(age_s) > self.times.late_s:
            self.rejected["fixes of the triangle too old, or in the future"] += 1
            return
        if self._verdict is None or _severity(verdict) >= _severity(self._verdict[0]):
            self._verdict = verdict, receiver

    def step(self) -> None:
        """Order braking, release points, set routes, extend authorities, and commit; then send the committed messages.

        This method must be called several times per second. Orders to brake do not wait for a commit. Authorities and
        commands to points are sent once the state on which they are based is committed.
        """
        now = self.clock()
        self._monitor(now)
        for order in self.supervision.watch(now):
            self._order(order, now)
        self.settle()
        if not self.commits.may_begin(now):
            return
        authorities = self.supervision.work(now)
        self._note_routes()
        self._pass_time(now)
        state, (changed, save) = self.supervision.state, self._unsaved()

        def then() -> None:
            self._saved = state
            self._saved_sequences.update((record.train, record.sequence) for record in changed)
            self.supervision.command_points(state)
            for authority in authorities:
                self._send(authority)

        self.commits.begin(save, then, now)
        self.settle()

    def _unsaved(self) -> tuple[list[TrainRecord], Callable[[], None]]:
        """Return the records that have changed since the last commit, and the function that saves all changes."""
        records = self.supervision.records.items()
        changed = [record for n, record in records if self._saved_sequences.get(n) != record.sequence]
        cause = "" if self.monitor is None or self.monitor.cause is None else self.monitor.cause.name
        documents = {**to_documents(self.supervision.state, self._saved), _CAUSE: cause}
        return changed, partial(self.store.save, *changed, documents=documents)

    def save_last(self, writer: ThreadWriter) -> Future[None]:
        """Queue a last commit that sends no messages; it stores stops whose orders to brake are already sent."""
        return writer.submit(self._unsaved()[1])

    def settle(self) -> None:
        """Send messages whose commit is complete, and log when the database fails or recovers."""
        self.commits.settle(self.clock())
        alarm = self.commits.alarm
        if alarm is not None and self._alarm is None:
            self.log(f"ALARM: {alarm}")
        elif alarm is None and self._alarm is not None:
            self.log("the database can be written again")
        self._alarm = alarm

    def _order(self, order: BrakeOrder, now: float) -> None:
        """Send an order to brake, and record the time of sending if the order is new."""
        first = self.supervision.ordered[order.train][1]
        if (known := self.stops.get(order.train)) is None or known.number != first:
            self.stops[order.train] = StopOrder(number=first, sent_s=now)
        self.send(order.train, order.encode())

    def _send(self, authority: Authority) -> None:
        """Send an authority to a supervised train; while the train is ordered to brake, only if `stopped` is true."""
        if authority.train not in self.supervision.state.trains:
            return
        if authority.train not in self.supervision.ordered:
            self.stops.pop(authority.train, None)
        elif not authority.stopped:
            return
        self.send(authority.train, authority.encode())

    def _note_routes(self) -> None:
        for number, train in self.supervision.state.trains.items():
            if (before := self._routes.get(number)) == train.station:
                continue
            self._routes[number] = train.station
            if before is not None and train.direction * (train.station - before) > 0:
                station = self.supervision.layout.stations[train.station].name
                self.log(f"train {number}: route to {station}, track {train.tracks[train.station]}", train=number)

    def _pass_time(self, now: float) -> None:
        state, limits = self.supervision.state, self.supervision.centre
        for number, record in self.supervision.records.items():
            if now - record.heard_s <= limits.lost_s:
                continue  # the train has reported recently
            rests = number in self.stops and state.trains[number].standstill  # a train at rest is not simulated
            curves = {} if rests else self.curves
            after = time_passed(record, now, curves=curves, authority_m=state.trains[number].end_m, limits=limits)
            if after.state is not record.state:
                self.log(f"train {number}: {after.state.value}", train=number)
            self.supervision.records[number] = after

    def release(self) -> str | None:
        """Release a stop by hand; return the reason for a refusal."""
        if self.monitor is None:
            if not self.supervision.state.stopped:
                return "there is no stop to release"
            self.supervision.state = replace(self.supervision.state, stopped=False)
            self.log("stop released by hand; satellite positioning is not monitored")
            return None
        self.monitor, orders, reason = release(self.monitor, self.clock(), limits=self.times)
        if orders:
            self.supervision.state = replace(self.supervision.state, stopped=False)
            self.log("stop released by hand")
        return reason

    def stop(self, train: int | None) -> str | None:
        """Stop a train, or every train if `train` is None, by hand; return the reason for a refusal."""
        state = self.supervision.state
        if train is not None and train not in state.trains:
            return f"no such train: {train}"
        self.supervision.state = stop_trains(state, state.trains if train is None else (train,), "stopped by hand")
        self.log("every train stopped by hand" if train is None else f"train {train}: stopped by hand", train=train)
        return None

    def set_route(self, train: int) -> str | None:
        """Set a train's route to the next station by hand; return the reason for a refusal."""
        return self.supervision.set_route(train)

    def _monitor(self, now: float) -> None:
        if self.monitor is None:
            return
        verdict, receiver = self._verdict or (None, -1)
        if verdict is None and now - self.monitor.complete_s <= self.times.late_s:
            return  # fixes are not late yet
        self._verdict, self._judged = None, verdict
        self.monitor, orders = advance(self.monitor, now, verdict, receiver=receiver, limits=self.times)
        for order in orders:
            self.log(f"triangle: {order.value}")
            if order is MonitorOrder.STOP:
                self.stop_s = now
        self.supervision.state = replace(self.supervision.state, stopped=self.monitor.stopped)

    def snapshot(self) -> dict[str, Any]:
        """Return the values of trains, points, monitor and log that the page displays."""
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
                "rejected": record.rejected, "contradiction": train.contradiction,
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
                {"name": name, "low": layout.section_m(name)[0], "high": layout.section_m(name)[1],
                 "closed": (name, CLOSED) in state.bars, "bars": sorted(kind for of, kind in state.bars if of == name)}
                for name in layout.sections
            ],
            "restrictions": [{"name": name, **limit._asdict()} for name, limit in state.restrictions.items()],
            "monitor": self._monitor_values(), "routes": self.supervision.routes, "rejected": dict(self.rejected),
        }  # fmt: skip

    def _place(self, direction: int, shown_m: float | None) -> str:
        """Return the station, or the section and the progress in it, as in P5 3.1; "" without a position."""
        if shown_m is None or (curve := self.curves.get(direction)) is None:
            return ""
        names = [station.name for station in self.supervision.layout.stations][::direction]
        if (station := curve.station_at(shown_m)) is not None:
            return names[station]
        section, progress = curve.progress(shown_m)
        return f"{names[section]} to {names[section + 1]}, {progress:.0f} %"

    def point_name(self, point: PointName) -> str:
        """Return the displayed name of points: the station, and "lower" or "upper" for the end of the station."""
        return f"{self.supervision.layout.stations[point[0]].name} {'lower' if point[1] < 0 else 'upper'}"

    def _monitor_values(self) -> dict[str, Any]:
        if self.monitor is None:
            return {"verdict": "not monitored", "stopped": False, "cause": None}
        cause, verdict = (
            absent if value is None else value.name.lower().replace("_", " ")
            for value, absent in ((self.monitor.cause, "not yet released"), (self._judged, "no verdict"))
        )
        return {"verdict": verdict, "stopped": self.monitor.stopped, "cause": cause if self.monitor.stopped else None}


def list_orders(centre: ControlCentre) -> dict[str, Order]:
    """Return a mapping from the name of each order that the page offers to the function that carries out the order."""
    desk = OrderDesk(
        supervision=centre.supervision, clock=centre.clock, log=centre.log, release=centre.release, stop=centre.stop
    )
    return desk.orders()
