"""All sequences of a few events on a small line, one after the other: reports wrong, lost and late, splits, turns.

The rules are those of the package (`railfix.ground.supervision`, `on_board`); only the trains are a model: one event of
one train a step, of a fixed size. Worlds that differ only in clocks and counters are one, so that all sequences up to a
length are explored with each world once.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from dataclasses import dataclass, field, replace

from railfix.ground.authority import Authority
from railfix.ground.layout import Layout, LoopStation, PointName, overlap
from railfix.ground.on_board import OnBoard
from railfix.ground.state import InterlockingLimits, from_documents, to_documents
from railfix.ground.supervision import Supervision, at_start, standing_train
from railfix.io.train_message import MessageStatus, TrainMessage

STEP_S, LENGTH_M, BOUND_M, WAY_M = 10.0, 80.0, 5.0, 500.0
#: Four sections between five stations.
LINE = Layout(
    stations=tuple(LoopStation(name="ABCDE"[k], begin_m=800.0 * k, end_m=800.0 * k + 400.0) for k in range(5))
)
#: What may happen to a train in a step.
EVENTS = (
    "runs", "stays", "runs, report lost", "runs, report late", "place ahead", "place behind", "length 0", "splits",
    "rolls back", "turns", "stays, authority late", "asked back", "late report comes", "late authority comes",
)  # fmt: skip


@dataclass(kw_only=True)
class ModelTrain:
    """A train as it is, with what is under way to and from it."""

    number: int
    front_m: float
    on_board: OnBoard
    wagons_m: tuple[float, float] | None = None
    length_m: float = LENGTH_M
    sequence: int = 0
    held_m: float | None = None
    late_report: TrainMessage | None = None
    late_authority: Authority | None = None
    lied: bool = False

    @property
    def direction(self) -> int:
        return self.on_board.direction

    @property
    def rear_m(self) -> float:
        return self.front_m - self.direction * self.length_m

    def receive(self, authority: Authority) -> None:
        self.on_board.stops_at_m = self.front_m + self.direction * (BOUND_M + 1.0)
        if self.on_board.receive(authority):
            ends = [authority.end_cm / 100.0, *([] if self.held_m is None else [self.held_m])]
            self.held_m = (
                max(ends, key=lambda end: end * self.direction) if not authority.shortens else self.on_board.end_m
            )


@dataclass(kw_only=True)
class World:
    """Trains and the centre after some events; the first violation, where there is one."""

    trains: dict[int, ModelTrain]
    centre: Supervision
    now_s: float = 0.0
    violation: str | None = None
    moved: list[tuple[PointName, int]] = field(default_factory=list)

    def copied(self) -> World:
        """A world to go on from: states of the interlocking are never written to."""
        trains = {n: replace(t, on_board=copy(t.on_board)) for n, t in self.trains.items()}
        for train in trains.values():
            train.on_board._sent = train.on_board._sent.copy()
        centre = copy(self.centre)
        centre.records, centre._clocks = dict(centre.records), dict(centre._clocks)
        moved: list[tuple[PointName, int]] = []
        centre.command, centre.heard, centre.sent = lambda *command: moved.append(command), set(), {}
        return World(trains=trains, centre=centre, now_s=self.now_s, moved=moved)

    def report(self, train: ModelTrain, speed_mps: float, **changes: object) -> TrainMessage:
        """The next report of a train, right unless changed."""
        train.sequence += 1
        train.on_board.note_report(train.sequence, self.now_s)
        time_ns = round((1000.0 + self.now_s) * 1e9)
        whole = TrainMessage(
            train=train.number, sequence=train.sequence, time_ns=time_ns, sent_ns=time_ns, line=1,
            chainage_cm=round(100 * train.front_m), over_cm=500, under_cm=500,
            speed_cmps=round(train.direction * speed_mps * 100), direction=train.direction if speed_mps else 0,
            facing=train.direction, standstill=speed_mps == 0.0, status=MessageStatus.POSITION, length_cm=8000,
            complete=train.wagons_m is None, **train.on_board.acknowledgement(),
        )  # fmt: skip
        return whole.replaced(**changes) if changes else whole

    def after(self, number: int, event: str) -> World | None:
        """The world after an event and the answer of the centre; None where the event is not possible."""
        world = self.copied()
        world.now_s += STEP_S
        train = world.trains[number]
        message: TrainMessage | None = None
        speed, late = 0.0, False
        if event.startswith("runs"):
            way = min(max(train.direction * (train.on_board.end_m - train.front_m) - BOUND_M - 1.0, 0.0), WAY_M)
            if train.on_board.stopped or train.on_board.answered_s is None or way == 0.0:
                return None
            train.front_m += train.direction * way
            speed = way / STEP_S
        if event == "splits":
            if train.wagons_m is not None:
                return None
            cut = train.front_m - train.direction * 30.0
            train.wagons_m, train.length_m = (cut, train.rear_m), 30.0
        elif event == "rolls back":
            train.front_m -= train.direction * 150.0
        elif event == "turns":
            if train.wagons_m is not None or LINE.station_at(*sorted((train.front_m, train.rear_m))) is None:
                return None
            front = train.rear_m
            train.on_board.turn(-train.direction, front)
            train.front_m, train.held_m = front, None
        if event == "asked back" and world.centre.ask_route_back(number) is not None:
            return None
        if event == "late report comes":
            if train.late_report is None:
                return None
            message, train.late_report = train.late_report, None
        elif event == "late authority comes":
            if train.late_authority is None:
                return None
            train.receive(train.late_authority)
            train.late_authority = None
        else:
            offset = {"place ahead": 300.0, "place behind": -300.0}.get(event, 0.0) * train.direction
            if offset and train.lied:  # two wrong places in a row that agree are assumed away (docs/ground.md)
                return None
            train.lied = bool(offset)
            changes = {"chainage_cm": round(100 * (train.front_m + offset))} if offset else {}
            message = world.report(train, speed, **changes, **({"length_cm": 0} if event == "length 0" else {}))
            if event == "runs, report late":
                train.late_report, late = message, True
        if message is not None and not late and event != "runs, report lost":
            world.centre.report(message, world.now_s)
        world.answer(number if event == "stays, authority late" else None)
        return world

    def answer(self, late: int | None) -> None:
        """Let points move, the centre extend authorities, and the trains have them, but for one whose comes late."""
        for command in self.moved:
            self.centre.set_detected(*command)
        self.moved.clear()
        before = self.centre.state
        for authority in self.centre.advance(self.now_s):
            self.check_grant(before.trains[authority.train].end_m, authority)
            train = self.trains[authority.train]
            if authority.train == late:
                train.late_authority = authority
            else:
                train.receive(authority)
        for number, train in self.trains.items():
            known = self.centre.state.trains[number]
            held = known.interval_m[1] if train.held_m is None else train.held_m
            if train.direction == known.direction and train.direction * (held - known.interval_m[1]) > 0.02:
                self.violation = "train beyond its authority"

    def restarted(self) -> World:
        """The world after a restart of the centre from its document."""
        world = self.copied()
        world.centre.state = from_documents(to_documents(world.centre.state))
        return world

    def pieces(self, number: int) -> list[tuple[int, float, float]]:
        train, tracks = self.trains[number], self.centre.state.trains[number].tracks
        parts = LINE.pieces(train.rear_m, train.front_m, tracks)
        return parts if train.wagons_m is None else parts + LINE.pieces(*train.wagons_m, tracks)

    def check_grant(self, end_before_m: float, authority: Authority) -> None:
        """An authority that is extended leads into no train, and into no wagons."""
        known = self.centre.state.trains[authority.train]
        if known.direction * (known.end_m - end_before_m) <= 0.0:
            return
        path = LINE.pieces(end_before_m, known.end_m, known.tracks)
        if any(overlap(path, self.pieces(other)) for other in self.trains if other != authority.train):
            self.violation = "authority into another train"

    def key(self) -> tuple[object, ...]:
        """What decides of all that may follow: counters and clocks count by their differences alone."""
        state, origin_ns = self.centre.state, round((1000.0 + self.now_s) * 1e9)
        parts: list[object] = [state.stopped, tuple(sorted((n, p.wanted, p.detected, tuple(sorted(p.locked)))
                                                           for n, p in state.points.items()))]  # fmt: skip
        for number, train in self.trains.items():
            known, record = state.trains[number], self.centre.records.get(number)
            age = None if known.measured_ns is None else origin_ns - known.measured_ns
            parts.append((
                known.direction, known.rear_m, known.front_m, known.end_m, known.claimed_m, known.stop,
                known.asked_m, known.held, None if known.asked_m is None else state.granted - known.asked_number,
                known.standstill,
                known.speed_mps, known.station, tuple(sorted(known.tracks.items())), known.sequence - train.sequence,
                age,
                None if record is None else record.sequence - train.sequence,
                train.front_m, train.direction, train.wagons_m, train.held_m, train.on_board.end_m,
                train.lied, train.on_board.stopped, train.on_board.answered_s is None,
                train.on_board.before_turn - train.sequence,
                state.granted - train.on_board.number, self._late_report(train, origin_ns),
                None if train.late_authority is None else (
                    train.late_authority.end_cm, train.late_authority.direction, train.late_authority.stopped,
                    train.late_authority.shortens,
                    train.late_authority.report - train.sequence, state.granted - train.late_authority.number,
                ),
            ))  # fmt: skip
        return tuple(parts)

    @staticmethod
    def _late_report(train: ModelTrain, origin_ns: int) -> object:
        late = train.late_report
        return None if late is None else (late.chainage_cm, late.sequence - train.sequence, origin_ns - late.time_ns)


def small_world(*places: tuple[int, int, int]) -> World:
    """Trains at rest in stations: of each the direction, the station and the track."""
    trains, supervised = {}, []
    for number, (direction, station, track) in enumerate(places, start=1):
        inner = LINE.stations[station].inner_m
        front = (inner[1] if direction > 0 else inner[0]) - direction * 60.0
        supervised.append(standing_train(number, direction=direction, front_m=front, length_m=LENGTH_M,
                                         bound_m=BOUND_M, station=station, track=track))  # fmt: skip
        trains[number] = ModelTrain(number=number, front_m=front, on_board=OnBoard(direction=direction, end_m=front))
    centre = Supervision(layout=LINE, state=at_start(LINE, supervised), limits=InterlockingLimits(release_s=0.0))
    world = World(trains=trains, centre=centre)
    centre.command = lambda *command: world.moved.append(command)
    return world


def following(world: World) -> Iterator[tuple[str, World]]:
    """Every world that one event leads to, with the event."""
    for number in world.trains:
        for event in EVENTS:
            if (after := world.after(number, event)) is not None:
                yield f"{number} {event}", after
    yield "restart", world.restarted()


def explore(start: World, length: int, *, events: int = 10**9) -> tuple[int, list[str] | None]:
    """Explore all sequences of up to so many events; return the worlds seen, and the first sequence that violates."""
    seen = {start.key()}
    level: list[tuple[World, list[str]]] = [(start, [])]
    for left in reversed(range(length)):
        later: list[tuple[World, list[str]]] = []
        for world, path in level:
            for event, after in following(world):
                if after.violation is not None:
                    return len(seen), [*path, event, after.violation]
                if (key := after.key()) not in seen:
                    seen.add(key)
                    if left:
                        later.append((after, [*path, event]))
                    if len(seen) >= events:
                        return len(seen), None
        level = later
    return len(seen), None
