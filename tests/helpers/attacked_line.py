"""Random short sequences on a small line: wrong reports, splits, roll-backs, turns, losses, delays, restarts.

Lighter than `disturbed_traffic`: trains have a place and no dynamics, so that a sequence takes milliseconds. It checks
what the interlocking promises about authorities: none is extended into a train or its standing wagons, and no train
holds one beyond its interval. A sequence ends where what the document assumes is broken: two wrong places in a row that
nothing contradicts, as after an outage in which the train could have run so far.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from railfix.ground.authority import Authority, BrakeOrder
from railfix.ground.layout import Layout, LoopStation, Piece, PointName, overlap
from railfix.ground.on_board import OnBoard
from railfix.ground.state import InterlockingLimits, from_documents, to_documents
from railfix.ground.stops import release_train
from railfix.ground.supervision import Supervision, at_start, standing_train
from railfix.io.train_message import MessageStatus, TrainMessage

STEP_S, SPEED_MPS, LENGTH_M, BOUND_M = 3.0, 20.0, 80.0, 5.0
LINE = Layout(
    stations=tuple(
        LoopStation(name=n, begin_m=a, end_m=a + 400.0) for n, a in (("A", 0.0), ("B", 800.0), ("C", 1600.0))
    )
)


@dataclass(kw_only=True)
class AttackedTrain:
    """A train as it is, its tracks as the points have led it, and its end of the links."""

    number: int
    direction: int
    front_m: float
    tracks: dict[int, int]
    on_board: OnBoard
    wagons: list[Piece] = field(default_factory=list)
    whole_m: float = LENGTH_M
    cut_m: float = 0.0  #: Where its wagons begin, once it has lost some.
    divided: bool = False  #: Its wagons are another train, by order.
    astray: bool = False  #: It has moved by nothing that was granted: others may run into it before they can stop.
    sequence: int = 0
    lies: int = 0
    kind: str = ""
    offset_m: float = 0.0
    shift_s: float = 0.0
    held_m: float | None = None

    def receive(self, authority: Authority) -> None:
        if self.on_board.receive(authority) and not isinstance(authority, BrakeOrder):
            self.note_held()

    def note_held(self) -> None:
        """Note the end of what the train may run by: nothing before the first authority of a start or of a release."""
        self.held_m = self.on_board.end_m if self.on_board._granted else None

    @property
    def rear_m(self) -> float:
        return self.front_m - self.direction * self.whole_m

    def sends(self, values: dict[str, Any], now_s: float) -> TrainMessage:
        """What `railfix.ground.train` makes of a position: it sees ends change, and acknowledges."""
        place, taken = values["chainage_cm"] / 100.0, self.on_board.acknowledgement()
        if values["facing"] != self.on_board.direction and values["standstill"]:
            self.on_board.turn(values["facing"], place)
            self.held_m = None
        self.on_board.note_report(self.sequence, now_s)
        self.on_board.note_position(place + self.on_board.direction * BOUND_M, abs(values["speed_cmps"]) / 100.0)
        if self.on_board.order is not None and values["standstill"]:
            self.note_held()  # a train that stands by order gives its authority up
        return TrainMessage(**values, **taken)


@dataclass(kw_only=True)
class Taken:
    """Newest report of a train that the centre has taken: place, and when it was sent; None after a restart."""

    place_m: float
    sent_s: float | None
    wrong: int = 0
    right: bool = True


@dataclass(kw_only=True)
class AttackedLine:
    seed: int
    violations: Counter[str] = field(default_factory=Counter)
    seen: Counter[str] = field(default_factory=Counter)
    now_s: float = 0.0
    calm: float = 1.0  #: Share of the disturbances that happen.

    def __post_init__(self) -> None:
        rng = self.rng = random.Random(self.seed)
        places = rng.sample([(k, track) for k in range(3) for track in (1, 2)], rng.choice((2, 3)))
        self.trains, supervised = {}, []
        for number, (station, track) in enumerate(places, start=1):
            direction = 1 if station == 0 else -1 if station == 2 else (1, -1)[track - 1]
            inner = LINE.stations[station].inner_m
            front = (inner[1] if direction > 0 else inner[0]) - direction * 60.0
            place: dict[str, Any] = {"direction": direction, "front_m": front}
            supervised.append(
                standing_train(number, **place, length_m=LENGTH_M, bound_m=BOUND_M, station=station, track=track)
            )
            on_board = OnBoard(direction=direction, end_m=front)
            self.trains[number] = AttackedTrain(number=number, **place, tracks={station: track}, on_board=on_board)
        self.points: dict[PointName, int] = dict.fromkeys(LINE.points(), 1)
        self.moving: dict[PointName, int] = {}
        self.centre = Supervision(
            layout=LINE, state=at_start(LINE, supervised), command=self.move,
            limits=InterlockingLimits(release_s=0.0),
        )  # fmt: skip
        self.mail: list[tuple[float, int, Callable[[], Any]]] = []
        self.posted = 0
        self.taken = {n: Taken(place_m=train.front_m, sent_s=None) for n, train in self.trains.items()}
        self.broken = False

    def move(self, point: PointName, track: int) -> None:
        """Take a command to points."""
        self.moving[point] = track
        if any(overlap([(0, *LINE.zone_m(point))], self.pieces(number)) for number in self.trains):
            self.violations["points moved under a train"] += 1

    def post(self, deliver: Callable[[], Any], *, certain: bool = False) -> None:
        if not certain and self.rng.random() < 0.15:
            return
        delay = self.rng.uniform(0.0, 30.0) if not certain and self.rng.random() < 0.15 else 0.0
        self.posted += 1
        self.mail.append((self.now_s + delay, self.posted, deliver))

    def deliver(self) -> None:
        due = sorted(item for item in self.mail if item[0] <= self.now_s)
        self.mail = [item for item in self.mail if item[0] > self.now_s]
        for *_, deliver in due:
            deliver()

    def step(self) -> None:
        self.now_s += STEP_S
        for train in self.trains.values():
            self.act(train)
        self.deliver()
        if self.rng.random() < 0.03 * self.calm:
            self.centre.state = from_documents(to_documents(self.centre.state))
            self.centre._clocks.clear()
            moving = set(self.moving)
            for point in self.centre.begin_again(self.now_s, wall_us=int(1e6 * self.now_s)):
                if point not in moving:
                    self.centre.set_detected(point, self.points[point])
            self.centre.awaited &= set(self.trains)  # what reports nothing is confirmed by hand
            for taken in self.taken.values():
                taken.sent_s = None
            self.seen["restart"] += 1
        self.dispatch(self.rng.choice(list(self.trains.values())))
        for point, track in list(self.moving.items()):
            if self.rng.random() < 0.6:
                del self.moving[point]
                self.points[point] = track
                self.centre.set_detected(point, track)
                break
        before = self.centre.state
        for message in self.sent():
            if message.train not in self.trains:
                continue  # what reports nothing
            self.post(partial(self.trains[message.train].receive, message))
            self.check_grant(before.trains[message.train].end_m, message)
        self.deliver()
        self.check_held()

    def sent(self) -> list[Authority]:
        """Return what the centre sends in a step; here all orders to brake are lost."""
        return self.centre.advance(self.now_s)

    def dispatch(self, train: AttackedTrain) -> None:
        """What is done by hand: a train is released after a look at it, asked for its route, given one."""
        event, number = self.rng.random(), train.number
        known = self.centre.state.trains[number]
        whole = not train.wagons or train.divided
        as_it_is = known.direction == train.direction and whole and self.taken[number].right
        if event < 0.3 and known.stop is not None and as_it_is and train.lies == 0:
            self.centre.state, reason = release_train(self.centre.state, number, LINE)
            self.seen["release"] += reason is None
            if reason is None:  # what it reported before its stop tells nothing of the way after it
                self.taken[number].sent_s, train.astray = None, False
        elif event < 0.35:
            self.seen["asked back"] += self.centre.ask_route_back(number) is None
        elif event < 0.45 and known.held:
            self.centre.set_route(number)

    def act(self, train: AttackedTrain) -> None:
        rng = self.rng
        event = rng.random()
        event = event if event > 0.09 or self.calm == 1.0 or rng.random() < self.calm else 0.5
        speed = 0.0
        station = LINE.station_at(*sorted((train.front_m, train.rear_m)))
        if event < 0.01 and not train.wagons:
            self.seen["split"] += 1
            train.cut_m = train.front_m - train.direction * 30.0
            train.wagons, train.whole_m = LINE.pieces(train.cut_m, train.rear_m, train.tracks), 30.0
        elif event < 0.02 and self.is_clear(train, back_m := rng.uniform(60.0, 300.0)):
            self.seen["roll-back"] += 1
            train.front_m -= train.direction * back_m
            train.lies, train.astray = 0, True  # the report of a roll-back is right
            self.report(train, 0.0, certain=True)
            return
        elif event < 0.08 and station is not None and not train.wagons:
            self.seen["turn"] += 1
            train.direction, train.front_m = -train.direction, train.rear_m
        elif event < 0.09:
            self.seen["start on board"] += 1
            train.on_board = OnBoard(direction=train.direction, end_m=train.front_m, before_turn=train.sequence)
            train.held_m = None
        elif (
            event < 0.9
            and not train.on_board.stopped
            and train.on_board.order is None
            and train.on_board.answered_s is not None
            and train.on_board.direction == train.direction
        ):
            room = train.direction * (train.on_board.end_m - train.front_m) - BOUND_M - 1.0
            way = min(max(room, 0.0), SPEED_MPS * STEP_S)
            self.lead(train, way)
            speed = SPEED_MPS if way > 0.0 else 0.0
        self.report(train, speed)

    def is_clear(self, *_: Any) -> bool:
        """Return whether a train may roll back so far."""
        return True

    def lead(self, train: AttackedTrain, way: float) -> None:
        """Let a train run, and points lead it where they are."""
        before, train.front_m = train.front_m, train.front_m + train.direction * way
        for point in LINE.points():
            zone = LINE.zone_m(point)
            entry = zone[0] if train.direction > 0 else zone[1]
            if not train.direction * before < train.direction * entry <= train.direction * train.front_m:
                continue
            if point in self.moving:
                self.violations["train on moving points"] += 1
            if point[1] == -train.direction:
                train.tracks[point[0]] = self.points[point]

    def lie(self, train: AttackedTrain) -> None:
        """Begin a wrong report of any kind, or a run of such as a contradiction shows."""
        rng, ahead = self.rng, train.direction
        train.kind = kind = rng.choice(("jump", "jump for long", "other line", "length", "ends", "clock"))
        self.seen[kind] += 1
        train.lies = 1 if kind in ("jump", "ends") else 8
        train.shift_s = rng.uniform(20.0, 4000.0) if kind == "clock" else 0.0
        train.offset_m = {
            "jump": rng.choice((-1, 1)) * rng.uniform(20.0, 2000.0),
            "jump for long": ahead * rng.uniform(400.0, 2000.0),
            "other line": ahead * rng.uniform(0.0, 80.0),
            "length": 0.0,
            "ends": rng.choice((-1, 1)) * rng.choice((0.0, LENGTH_M, rng.uniform(0.0, 1000.0))),
            "clock": ahead * rng.uniform(400.0, 2000.0),
        }[kind]

    def report(self, train: AttackedTrain, speed: float, *, certain: bool = False) -> None:
        rng = self.rng
        if train.lies == 0 and not certain and rng.random() < 0.04 * self.calm:
            self.lie(train)
        lied = train.lies > 0
        train.lies = max(train.lies - 1, 0)
        train.sequence += 1
        offset, shift = (train.offset_m, train.shift_s) if lied else (0.0, 0.0)
        time_ns = round((1000.0 + self.now_s + shift) * 1e9)
        error = rng.uniform(-BOUND_M, BOUND_M)
        values: dict[str, Any] = {
            "train": train.number, "sequence": train.sequence, "time_ns": time_ns, "sent_ns": time_ns, "line": 1,
            "chainage_cm": round(100 * (train.front_m + error + offset)), "over_cm": 501, "under_cm": 501,
            "speed_cmps": round(train.direction * speed * 100), "direction": train.direction if speed else 0,
            "facing": train.direction, "standstill": speed == 0.0, "status": MessageStatus.POSITION,
            "length_cm": 3000 if train.divided else 8000, "complete": not train.wagons or train.divided,
        }  # fmt: skip
        if lied:
            values |= {
                "ends": {"facing": -train.direction, "standstill": True, "speed_cmps": 0, "direction": 0},
                "other line": {"line": 2},
                "length": {"length_cm": rng.choice((0, 1, 1000))},
            }.get(train.kind, {})
        wrong = lied and (abs(offset) > 0.0 or train.kind == "ends")
        deliver = partial(self.received, train.sends(values, self.now_s), wrong=wrong, sent_s=self.now_s)
        self.post(deliver, certain=certain)

    def received(self, message: TrainMessage, *, wrong: bool, sent_s: float) -> None:
        """Hand a report to the centre; of wrong places that nothing contradicts the second breaks the assumption."""
        number = message.train
        before = self.taken[number]
        reason = self.centre.report(message, self.now_s)
        if reason is not None:
            return
        known = self.centre.state.trains[number]
        if known.stop is not None or known.sequence != message.sequence or known.direction != message.facing:
            self.taken[number].right = not wrong
            return
        place = (message.chainage_cm or 0) / 100.0
        if before.sent_s is not None:
            way = message.facing * (place - before.place_m) - 4.0 * BOUND_M
            if way > 60.0 * (sent_s - before.sent_s + 1.1):
                self.violations["impossible way believed"] += 1
        self.taken[number] = Taken(
            place_m=place, sent_s=sent_s, wrong=before.wrong + 1 if wrong else 0, right=not wrong
        )
        self.broken |= self.taken[number].wrong > 1

    def pieces(self, number: int) -> list[Piece]:
        train = self.trains[number]
        return LINE.pieces(train.rear_m, train.front_m, train.tracks) + train.wagons

    def check_grant(self, end_before_m: float, authority: Authority) -> None:
        """An authority that is extended leads into no train, and into no wagons."""
        known = self.centre.state.trains[authority.train]
        if known.direction * (known.end_m - end_before_m) <= 0.0:
            return
        self.seen["extension"] += 1
        path = LINE.pieces(end_before_m, known.end_m, known.tracks)
        for other in self.trains:
            if other != authority.train and overlap(path, self.pieces(other)):
                self.violations["authority into another train"] += 1

    def check_held(self) -> None:
        """No train on board holds an authority beyond its interval."""
        for number, train in self.trains.items():
            known = self.centre.state.trains[number]
            end = known.interval_m[1]
            held = end if train.held_m is None else train.held_m
            if train.on_board.direction == known.direction and known.direction * (held - end) > 0.02:
                self.violations["train beyond its authority"] += 1


def run_sequence(
    seed: int, *, steps: int = 40, assumed: bool = True, kind: type[AttackedLine] = AttackedLine
) -> AttackedLine:
    """Return a line after a random sequence, which ends where an assumption is broken unless `assumed` is false."""
    line = kind(seed=seed)
    for _ in range(steps):
        line.step()
        if line.broken and assumed:
            line.violations.clear()
            line.seen["assumption broken"] += 1
        if line.violations or (line.broken and assumed):
            break
    return line
