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

from railfix.ground.authority import Authority
from railfix.ground.interlocking import InterlockingLimits
from railfix.ground.interlocking_text import from_documents, to_documents
from railfix.ground.layout import Layout, LoopStation, PointName, overlap
from railfix.ground.on_board import OnBoard
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
    number: int
    front_m: float
    on_board: OnBoard
    wagons_m: tuple[float, float] | None = None
    whole_m: float = LENGTH_M
    sequence: int = 0
    lies: int = 0
    lie: dict[str, Any] = field(default_factory=dict)
    offset_m: float = 0.0
    held_m: float | None = None

    @property
    def direction(self) -> int:
        return self.on_board.direction

    def receive(self, authority: Authority) -> None:
        if self.on_board.receive(authority):
            ends = [authority.end_cm / 100.0, *([] if self.held_m is None else [self.held_m])]
            self.held_m = max(ends, key=lambda end: end * self.direction)

    @property
    def rear_m(self) -> float:
        return self.front_m - self.direction * self.whole_m


@dataclass(kw_only=True)
class AttackedLine:
    seed: int
    violations: Counter[str] = field(default_factory=Counter)
    seen: Counter[str] = field(default_factory=Counter)
    now_s: float = 0.0

    def __post_init__(self) -> None:
        rng = self.rng = random.Random(self.seed)
        places = rng.sample([(k, track) for k in range(3) for track in (1, 2)], rng.choice((2, 3)))
        self.trains, supervised = {}, []
        for number, (station, track) in enumerate(places, start=1):
            direction = 1 if station == 0 else -1 if station == 2 else (1, -1)[track - 1]
            inner = LINE.stations[station].inner_m
            front = (inner[1] if direction > 0 else inner[0]) - direction * 60.0
            supervised.append(
                standing_train(
                    number,
                    direction=direction,
                    front_m=front,
                    length_m=LENGTH_M,
                    bound_m=BOUND_M,
                    station=station,
                    track=track,
                )
            )
            self.trains[number] = AttackedTrain(
                number=number, front_m=front, on_board=OnBoard(direction=direction, end_m=front)
            )
        self.moving: list[PointName] = []
        self.centre = Supervision(
            layout=LINE, state=at_start(LINE, supervised), command=self.moving.append,
            limits=InterlockingLimits(release_s=0.0),
        )  # fmt: skip
        self.mail: list[tuple[float, int, Callable[[], Any]]] = []
        self.posted = 0
        self.believed: Counter[int] = Counter()
        self.broken = False

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
        if self.rng.random() < 0.03:
            self.centre.state = from_documents(to_documents(self.centre.state))
            self.seen["restart"] += 1
        for point in self.moving:
            if self.rng.random() < 0.6:
                self.moving.remove(point)
                self.centre.detected(point)
                break
        before = self.centre.state
        for authority in self.centre.advance(self.now_s):
            self.post(partial(self.trains[authority.train].receive, authority))
            self.check_grant(before.trains[authority.train].end_m, authority)
        self.deliver()
        self.check_held()

    def act(self, train: AttackedTrain) -> None:
        rng = self.rng
        event = rng.random()
        speed = 0.0
        station = LINE.station_at(*sorted((train.front_m, train.rear_m)))
        if event < 0.01 and train.wagons_m is None:
            self.seen["split"] += 1
            cut = train.front_m - train.direction * 30.0
            train.wagons_m, train.whole_m = (cut, train.rear_m), 30.0
        elif event < 0.02:
            self.seen["roll-back"] += 1
            train.front_m -= train.direction * rng.uniform(60.0, 300.0)
            train.lies = 0  # the report of a roll-back is right
            self.report(train, 0.0, certain=True)
            return
        elif event < 0.08 and station is not None and train.wagons_m is None:
            self.seen["turn"] += 1
            front = train.rear_m
            train.on_board.turned(-train.direction, front)
            train.front_m, train.held_m = front, None
        elif event < 0.9 and not train.on_board.stopped and train.on_board.answered_s is not None:
            room = train.direction * (train.on_board.end_m - train.front_m) - BOUND_M - 1.0
            way = min(max(room, 0.0), SPEED_MPS * STEP_S)
            train.front_m += train.direction * way
            speed = SPEED_MPS if way > 0.0 else 0.0
        self.report(train, speed)

    def report(self, train: AttackedTrain, speed: float, *, certain: bool = False) -> None:
        rng = self.rng
        if train.lies == 0 and not certain and rng.random() < 0.04:
            # a single wrong report of any kind, or a run of such as a contradiction shows
            kind = rng.choice(("jump", "jump for long", "other line", "length"))
            self.seen[kind] += 1
            train.lies = 1 if kind == "jump" else 8
            train.offset_m, train.lie = {
                "jump": (rng.choice((-1, 1)) * rng.uniform(20.0, 2000.0), {}),
                "jump for long": (train.direction * rng.uniform(400.0, 2000.0), {}),
                "other line": (train.direction * rng.uniform(0.0, 80.0), {"line": 2}),
                "length": (0.0, {"length_cm": rng.choice((0, 1, 1000))}),
            }[kind]
        lied = train.lies > 0
        train.lies = max(train.lies - 1, 0)
        train.sequence += 1
        train.on_board.reported(train.sequence, self.now_s)
        time_ns = round((1000.0 + self.now_s) * 1e9)
        error = rng.uniform(-BOUND_M, BOUND_M)
        whole = TrainMessage(
            train=train.number, sequence=train.sequence, time_ns=time_ns, sent_ns=time_ns, line=1,
            chainage_cm=round(100 * (train.front_m + error + (train.offset_m if lied else 0.0))), over_cm=501,
            under_cm=501, speed_cmps=round(train.direction * speed * 100), direction=train.direction if speed else 0,
            facing=train.direction, standstill=speed == 0.0, status=MessageStatus.POSITION, length_cm=8000,
            complete=train.wagons_m is None,
        )  # fmt: skip
        message = whole.replaced(**train.lie) if lied and train.lie else whole
        self.post(partial(self.received, message, wrong=lied and abs(train.offset_m) > 0.0), certain=certain)

    def received(self, message: TrainMessage, *, wrong: bool) -> None:
        """Hand a report to the centre; of wrong places that nothing contradicts the second breaks the assumption."""
        number = message.train
        reason = self.centre.report(message, self.now_s)
        taken = reason is None and self.centre.state.trains[number].stop is None
        if taken:
            self.believed[number] = self.believed[number] + 1 if wrong else 0
            self.broken |= self.believed[number] > 1

    def pieces(self, number: int) -> list[tuple[int, float, float]]:
        train, tracks = self.trains[number], self.centre.state.trains[number].tracks
        parts = LINE.pieces(train.rear_m, train.front_m, tracks)
        return parts if train.wagons_m is None else parts + LINE.pieces(*train.wagons_m, tracks)

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
            if train.direction == known.direction and train.direction * (held - end) > 0.02:
                self.violations["train beyond its authority"] += 1


def run_sequence(seed: int, *, steps: int = 40, assumed: bool = True) -> AttackedLine:
    """Return a line after a random sequence, which ends where an assumption is broken unless `assumed` is false."""
    line = AttackedLine(seed=seed)
    for _ in range(steps):
        line.step()
        if line.broken and assumed:
            line.violations.clear()
            line.seen["assumption broken"] += 1
        if line.violations or (line.broken and assumed):
            break
    return line
