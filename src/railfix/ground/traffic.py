"""Simulated traffic of a line with trains and points; safety invariants are checked at each time step."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Final

from railfix.ground.authority import Authority
from railfix.ground.layout import Layout, LoopStation, PointName, along, overlap
from railfix.ground.on_board import OnBoard
from railfix.ground.state import TrainInterval
from railfix.ground.supervision import Supervision, standing_train
from railfix.io.train_message import MessageStatus, TrainMessage

BRAKING_MPS2: Final = 0.7
ACCELERATION_MPS2: Final = 0.5
STEP_S: Final = 1.0
#: Distance before the end of the authority at which a train stops [m].
STOP_SHORT_M: Final = 2.0


def line_with_loops(stations: int = 6) -> Layout:
    """Return a line with stations of 500 m length at intervals of 1,500 m."""
    begins = [1500.0 * k for k in range(stations)]
    return Layout(
        stations=tuple(LoopStation(name=chr(65 + k), begin_m=b, end_m=b + 500.0) for k, b in enumerate(begins))
    )


@dataclass(kw_only=True)
class SimulatedTrain:
    """Simulated train with its on-board supervision."""

    number: int
    front_m: float
    tracks: dict[int, int]  #: Track, in each station, to which the points have led the train.
    on_board: OnBoard
    length_m: float = 80.0
    speed_mps: float = 0.0
    top_mps: float = 22.0
    error_m: float = 0.0
    bound_m: float = 5.0
    sequence: int = 0
    blind_until_s: float = -1.0
    waits_s: float = 0.0

    @property
    def direction(self) -> int:
        """Running direction."""
        return self.on_board.direction

    @property
    def rear_m(self) -> float:
        """Rear end [m]."""
        return self.front_m - self.direction * self.length_m

    def at_rest(self) -> TrainInterval:
        """Return the interval of the train, which must be at rest within one station."""
        ((station, track),) = self.tracks.items()
        return standing_train(
            self.number,
            direction=self.direction,
            front_m=self.front_m,
            length_m=self.length_m,
            bound_m=self.bound_m,
            station=station,
            track=track,
        )

    def message(self, now_s: float) -> TrainMessage:
        """Return the position message at a time [s]; before `blind_until_s`, it contains no position."""
        self.sequence += 1
        self.on_board.note_report(self.sequence, now_s)
        time = 1_400_000_000_000_000_000 + round(now_s * 1e9)
        head: dict[str, Any] = {
            "train": self.number,
            "sequence": self.sequence,
            "time_ns": time,
            "sent_ns": time,
            "line": 1,
            **self.on_board.acknowledgement(),
        }
        if now_s < self.blind_until_s:
            return TrainMessage(**head)
        bound = round(self.bound_m * 100)
        return TrainMessage(
            **head,
            chainage_cm=round((self.front_m + self.error_m) * 100),
            over_cm=bound + 1,
            under_cm=bound + 1,
            speed_cmps=round(self.direction * self.speed_mps * 100),
            direction=self.direction if self.speed_mps > 0.0 else 0,
            facing=self.direction,
            standstill=self.speed_mps == 0.0,
            status=MessageStatus.POSITION,
            length_cm=round(self.length_m * 100),
            complete=True,
        )

    def step(self, now_s: float) -> None:
        """Move the train for one time step, at most at the permitted speed."""
        wanted = min(self.top_mps, self.speed_mps + ACCELERATION_MPS2 * STEP_S, self.permitted_mps())
        if self.on_board.brake_reason(now_s) is not None or now_s < self.blind_until_s:
            wanted = 0.0
        after = max(wanted, self.speed_mps - BRAKING_MPS2 * STEP_S, 0.0)
        after = 0.0 if after < 0.05 else after
        self.front_m += self.direction * 0.5 * (self.speed_mps + after) * STEP_S
        self.speed_mps = after
        self.on_board.note_position(self.safe_front_m, after)

    @property
    def safe_front_m(self) -> float:
        """Safe front end: reported position plus its bound plus the driver's margin `STOP_SHORT_M` [m]."""
        return self.front_m + self.error_m + self.direction * (self.bound_m + STOP_SHORT_M)

    def permitted_mps(self) -> float:
        """Return the permitted speed according to the train's authority [m/s]."""
        found = self.on_board.supervised()
        return 0.0 if found is None else found.permitted_mps


@dataclass(kw_only=True)
class Traffic:
    """Traffic on a line: the trains and points, and the centre that supervises them.

    Subclasses implement `send_report` and `exchange`, which transmit messages between the trains and the centre.
    """

    trains: dict[int, SimulatedTrain]
    centre: Supervision
    random: random.Random
    centre_works: bool = True  #: Whether the centre runs; otherwise it receives no reports and no detection of points.
    now_s: float = 0.0
    violations: Counter[str] = field(default_factory=Counter)  #: Number of broken invariants in all steps, by kind.
    moving: dict[PointName, tuple[float, int]] = field(default_factory=dict)
    lie: dict[PointName, int] = field(default_factory=dict)  #: Track to which each set of points leads; 1 by default.
    _stopped_s: float | None = None

    def __post_init__(self) -> None:
        self.centre.command = self.command

    @property
    def layout(self) -> Layout:
        """Layout of the line."""
        return self.centre.layout

    def step(self) -> None:
        """Simulate one time step and check the invariants."""
        self.now_s += STEP_S
        self.disturb()
        self._field()
        for train in self.trains.values():
            before = train.front_m
            train.step(self.now_s)
            self._lead(train, before)
            self._change_ends(train)
            self.send_report(train.message(self.now_s))
        self.exchange()
        self._check()

    def disturb(self) -> None:
        """Change the position errors of some trains."""
        for train in self.trains.values():
            if self.random.random() < 0.05:
                train.error_m = self.random.uniform(-train.bound_m, train.bound_m)

    def send_report(self, message: TrainMessage) -> None:
        """Send the report of a train."""
        raise NotImplementedError

    def exchange(self) -> None:
        """Deliver the messages that are due, and run the centre for a step."""
        raise NotImplementedError

    def authority(self, authority: Authority) -> None:
        """Deliver an authority to its train."""
        self.trains[authority.train].on_board.receive(authority)

    def command(self, name: PointName, track: int) -> None:
        """Begin to move a set of points; its new position is detected after some seconds."""
        self.moving[name] = self.now_s + self.random.uniform(3.0, 7.0), track
        self.centre.set_detected(name, None)
        low, high = self.layout.zone_m(name)
        for train in self.trains.values():
            if min(train.rear_m, train.front_m) < high and low < max(train.rear_m, train.front_m):
                self.violations["points moved under a train"] += 1

    def _field(self) -> None:
        for name, (until, track) in list(self.moving.items()):
            if self.now_s >= until and self.centre_works:
                del self.moving[name]
                self.lie[name] = track
                self.centre.set_detected(name, track)

    def _lead(self, train: SimulatedTrain, before_m: float) -> None:
        """Store the track to which points lead a train that runs onto them, and count violations."""
        for name in self.centre.state.points:
            near, _ = along(self.layout.zone_m(name), train.direction)
            if not train.direction * before_m < near <= train.direction * train.front_m:
                continue
            if name in self.moving:
                self.violations["train on moving points"] += 1
            facing = name[1] == -train.direction
            if facing:
                train.tracks[name[0]] = self.lie.get(name, 1)
            elif self.lie.get(name, 1) != train.tracks.get(name[0]):
                self.violations["points run through from the wrong track"] += 1

    def _change_ends(self, train: SimulatedTrain) -> None:
        last = len(self.layout.stations) - 1
        station = self.layout.station_at(*sorted((train.rear_m, train.front_m)))
        turns = station == (last if train.direction > 0 else 0) and train.speed_mps == 0.0
        train.waits_s = train.waits_s + STEP_S if turns else 0.0
        if turns and station is not None and train.waits_s > 20.0:
            train.front_m = train.rear_m
            train.on_board.turn(-train.direction, train.front_m)
            train.waits_s = 0.0
            train.tracks = {station: train.tracks[station]}

    def _check(self) -> None:
        trains = list(self.trains.values())
        true = {t.number: self.layout.pieces(t.rear_m, t.front_m, t.tracks) for t in trains}
        known = {n: self.layout.pieces(*t.interval_m, t.tracks) for n, t in self.centre.state.trains.items()}
        for k, first in enumerate(trains):
            supervised = self.centre.state.trains[first.number]
            if supervised.direction == first.direction:
                rear, end = supervised.interval_m
                inside = first.direction * (first.rear_m - rear) >= -1e-6
                inside &= first.direction * (end - first.front_m) >= -1e-6
                if not inside:
                    self.violations["train outside its interval"] += 1
            for second in trains[k + 1 :]:
                if overlap(true[first.number], true[second.number]):
                    self.violations["trains overlap"] += 1
                if overlap(known[first.number], known[second.number]):
                    self.violations["intervals overlap"] += 1
        self._check_sections()
        self._check_stops()

    def _check_sections(self) -> None:
        for k in range(len(self.layout.stations) - 1):
            first, last = self.layout.stations[k].end_m, self.layout.stations[k + 1].begin_m
            directions = {t.direction for t in self.centre.state.trains.values() if t.overlaps(first, last)}
            if len(directions) > 1:
                self.violations["opposing trains in a section"] += 1

    def _check_stops(self) -> None:
        """Check that trains brake when their authority is too old, and come to rest in time after an order to stop."""
        stopped = self.centre.state.stopped and self.centre_works
        self._stopped_s = (self.now_s if self._stopped_s is None else self._stopped_s) if stopped else None
        for train in self.trains.values():
            limit_s = train.on_board.limits.fresh_s
            late_s = train.on_board.age_s(self.now_s) - limit_s - 2.0 * STEP_S
            if late_s > 0.0 and train.speed_mps > max(0.0, train.top_mps - BRAKING_MPS2 * late_s):
                self.violations["runs without a fresh authority"] += 1
            rest_s = limit_s + train.top_mps / BRAKING_MPS2 + 3.0 * STEP_S
            if self._stopped_s is not None and self.now_s - self._stopped_s > rest_s and train.speed_mps > 0.0:
                self.violations["runs after a stop was ordered"] += 1
