"""Simulated traffic of a line: trains, points and lossy links, every invariant checked at each step of time."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

from railfix.ground.interlocking import (
    ALL_RULES,
    Interlocking,
    InterlockingLimits,
    PointState,
    Rule,
    TrainInterval,
    extended,
    interval_of,
    points_reported,
    released,
    report_received,
    route_requested,
)
from railfix.ground.interlocking_text import from_json, to_json
from railfix.ground.layout import Layout, LoopStation, PointName, overlap
from railfix.io.train_message import MessageStatus, TrainMessage

BRAKING_MPS2: Final = 0.7
ACCELERATION_MPS2: Final = 0.5
STEP_S: Final = 1.0
#: A train stops so far before the end of its authority [m].
STOP_SHORT_M: Final = 2.0


def line_with_loops(stations: int = 6, *, apart_m: float = 1500.0, length_m: float = 500.0) -> Layout:
    """Return a line of equal stations."""
    return Layout(
        stations=tuple(
            LoopStation(name=chr(65 + k), begin_m=k * apart_m, end_m=k * apart_m + length_m) for k in range(stations)
        )
    )


@dataclass(kw_only=True)
class SimulatedTrain:
    """Train with its on-board supervision.

    Attributes
    ----------
    number, direction : int
    front_m, speed_mps : float
    end_m : float [m]
        End of its authority as received.
    tracks : dict of int to int
        Track in each station that the points have led it to.
    """

    number: int
    direction: int
    front_m: float
    tracks: dict[int, int]
    end_m: float
    length_m: float = 80.0
    speed_mps: float = 0.0
    top_mps: float = 22.0
    error_m: float = 0.0
    bound_m: float = 5.0
    sequence: int = 0
    authority: int = -1
    blind_until_s: float = -1.0
    stop: bool = False
    waits_s: float = 0.0

    @property
    def rear_m(self) -> float:
        """Rear end [m]."""
        return self.front_m - self.direction * self.length_m

    def message(self, now_s: float) -> TrainMessage:
        """Return the position message of an instant."""
        self.sequence += 1
        time = 1_400_000_000_000_000_000 + round(now_s * 1e9)
        head: dict[str, Any] = {
            "train": self.number,
            "sequence": self.sequence,
            "time_ns": time,
            "sent_ns": time,
            "line": 1,
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

    def step(self, now_s: float, rules: frozenset[Rule]) -> None:
        """Run for a step of time below the braking curve to the end of the authority."""
        room = self.direction * (self.end_m - self.front_m - self.error_m) - self.bound_m - STOP_SHORT_M
        wanted = min(self.top_mps, self.speed_mps + ACCELERATION_MPS2 * STEP_S)
        if Rule.SUPERVISION in rules:
            lag = 1.5 * BRAKING_MPS2 * STEP_S
            wanted = min(wanted, (lag**2 + 2.0 * BRAKING_MPS2 * max(room, 0.0)) ** 0.5 - lag)
        elif room <= 0.0:
            wanted = 0.0
        if self.stop or now_s < self.blind_until_s:
            wanted = 0.0
        after = max(wanted, self.speed_mps - BRAKING_MPS2 * STEP_S, 0.0)
        after = 0.0 if after < 0.05 else after
        self.front_m += self.direction * 0.5 * (self.speed_mps + after) * STEP_S
        self.speed_mps = after


@dataclass(kw_only=True)
class Conditions:
    """Disturbances of a run of traffic.

    Attributes
    ----------
    loss : float
        Probability that a message is lost.
    delay_s : float [s]
        Largest delay; messages overtake each other.
    outage : float
        Probability a second that a train's links fail for up to 60 s.
    restart : float
        Probability a second that the centre stops for up to 30 s and is restarted from its store.
    blind : float
        Probability a second that a train's sensors fail for up to 40 s.
    """

    loss: float = 0.3
    delay_s: float = 8.0
    outage: float = 0.002
    restart: float = 0.004
    blind: float = 0.001


@dataclass(kw_only=True)
class Traffic:
    """Traffic on a line: the trains and points, and the centre that supervises them.

    Attributes
    ----------
    violations : Counter of str
        Invariants that were broken, by kind and in seconds.
    arrivals : int
        Routes that were set.
    """

    layout: Layout
    trains: dict[int, SimulatedTrain]
    state: Interlocking
    random: random.Random
    conditions: Conditions
    rules: frozenset[Rule] = ALL_RULES
    limits: InterlockingLimits = field(default_factory=InterlockingLimits)
    now_s: float = 0.0
    violations: Counter[str] = field(default_factory=Counter)
    arrivals: int = 0
    refusals: Counter[str] = field(default_factory=Counter)
    restarts: int = 0
    moving: dict[PointName, float] = field(default_factory=dict)
    _mail: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)
    _silent_until: dict[int, float] = field(default_factory=dict)
    _centre_back_s: float = -1.0
    _stored: Interlocking | None = None
    _grants: int = 0

    def step(self) -> None:
        """Run everything for a step of time and check the invariants."""
        self.now_s += STEP_S
        self._disturb()
        self._field()
        for train in self.trains.values():
            before = train.front_m
            train.step(self.now_s, self.rules)
            self._lead(train, before)
            self._change_ends(train)
            message = train.message(self.now_s)
            self._send_report(message)
        due = [item for item in self._mail if item[0] <= self.now_s]
        self._mail = [item for item in self._mail if item[0] > self.now_s]
        for _, _, deliver in sorted(due, key=lambda item: item[:2]):
            deliver()
        if self.now_s >= self._centre_back_s:
            self._centre()
        self._check()

    def _disturb(self) -> None:
        rng, conditions = self.random, self.conditions
        if self.now_s >= self._centre_back_s and rng.random() < conditions.restart:
            self._centre_back_s = self.now_s + rng.uniform(1.0, 30.0)
            self.restarts += 1
            self.state = from_json(to_json(self._stored or self.state))
            if Rule.PERSISTENCE not in self.rules:
                trains = {n: replace(t, end_m=t.front_m) for n, t in self.state.trains.items()}
                self.state = replace(self.state, trains=trains)
        for train in self.trains.values():
            if rng.random() < conditions.outage:
                self._silent_until[train.number] = self.now_s + rng.uniform(5.0, 60.0)
            if rng.random() < conditions.blind:
                train.blind_until_s = self.now_s + rng.uniform(5.0, 40.0)
            if rng.random() < 0.05:
                train.error_m = rng.uniform(-train.bound_m, train.bound_m)

    def _send(self, train: int, deliver: Callable[[], None]) -> None:
        rng = self.random
        if rng.random() < self.conditions.loss or self.now_s < self._silent_until.get(train, -1.0):
            return
        delay = rng.uniform(0.0, self.conditions.delay_s) if rng.random() < 0.5 else 0.0
        self._mail.append((self.now_s + delay, len(self._mail), deliver))

    def _report(self, message: TrainMessage) -> None:
        if self.now_s >= self._centre_back_s:
            self.state = report_received(self.state, message, self.layout, rules=self.rules)

    def _centre(self) -> None:
        """Release, route, extend; store; send."""
        self.state = released(self.state, self.now_s, self.layout, limits=self.limits)
        for number, train in self.state.trains.items():
            if not self._wants_route(train):
                continue
            self.state, moved, reason = route_requested(self.state, number, self.layout, rules=self.rules)
            if reason is not None:
                self.refusals[reason.split()[-1] if "taken" not in reason else "taken"] += 1
                continue
            self.arrivals += 1
            for name in moved:
                self._command(name)
        self.state = extended(self.state, self.layout, limits=self.limits, rules=self.rules)
        self._stored = self.state
        self._grants += 1
        for number, train in self.state.trains.items():
            self._send_authority(number, self._grants, train.direction, train.end_m)

    def _send_report(self, message: TrainMessage) -> None:
        self._send(message.train, partial(self._report, message))

    def _send_authority(self, number: int, grant: int, direction: int, end_m: float) -> None:
        stopped = self.state.stopped
        self._send(number, partial(self._authority, number, grant, direction, end_m, stopped=stopped))

    def _wants_route(self, train: TrainInterval) -> bool:
        ahead = train.station + train.direction
        if not 0 <= ahead < len(self.layout.stations):
            return False
        inner = self.layout.stations[train.station].inner_m
        way = train.direction * ((inner[1] if train.direction > 0 else inner[0]) - train.front_m)
        return way < 700.0

    def _authority(self, number: int, grant: int, direction: int, end_m: float, *, stopped: bool) -> None:
        train = self.trains[number]
        if grant <= train.authority or direction != train.direction:
            return
        train.authority, train.stop = grant, stopped
        train.end_m = direction * max(direction * end_m, direction * train.end_m)

    def _command(self, name: PointName) -> None:
        self.moving[name] = self.now_s + self.random.uniform(3.0, 7.0)
        low, high = self.layout.zone_m(name)
        for train in self.trains.values():
            if min(train.rear_m, train.front_m) < high and low < max(train.rear_m, train.front_m):
                self.violations["points moved under a train"] += 1

    def _field(self) -> None:
        for name, until in list(self.moving.items()):
            if self.now_s >= until and self.now_s >= self._centre_back_s:
                del self.moving[name]
                self.state = points_reported(self.state, name, self.state.points[name].wanted)

    def _lead(self, train: SimulatedTrain, before_m: float) -> None:
        """Let points lead a train that runs onto them."""
        for name, point in self.state.points.items():
            low, high = self.layout.zone_m(name)
            entered = (low, high) if train.direction > 0 else (-high, -low)
            if not train.direction * before_m < entered[0] <= train.direction * train.front_m:
                continue
            if name in self.moving:
                self.violations["train on moving points"] += 1
            facing = name[1] == -train.direction
            if facing:
                train.tracks[name[0]] = point.wanted
            elif point.wanted != train.tracks.get(name[0]):
                self.violations["points run through from the wrong track"] += 1

    def _change_ends(self, train: SimulatedTrain) -> None:
        last = len(self.layout.stations) - 1
        station = self.layout.station_at(*sorted((train.rear_m, train.front_m)))
        turns = station == (last if train.direction > 0 else 0) and train.speed_mps == 0.0
        train.waits_s = train.waits_s + STEP_S if turns else 0.0
        if turns and station is not None and train.waits_s > 20.0:
            train.front_m, train.direction = train.rear_m, -train.direction
            train.end_m, train.waits_s = train.front_m, 0.0
            train.tracks = {station: train.tracks[station]}

    def _check(self) -> None:
        trains = list(self.trains.values())
        true = {t.number: self.layout.pieces(t.rear_m, t.front_m, t.tracks) for t in trains}
        known = {n: self.layout.pieces(*interval_of(t), t.tracks) for n, t in self.state.trains.items()}
        for k, first in enumerate(trains):
            supervised = self.state.trains[first.number]
            if supervised.direction == first.direction:
                rear, end = interval_of(supervised)
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

    def _check_sections(self) -> None:
        for k in range(len(self.layout.stations) - 1):
            first, last = self.layout.stations[k].end_m, self.layout.stations[k + 1].begin_m
            directions = {
                t.direction
                for t in self.state.trains.values()
                if min(interval_of(t)) < last and max(interval_of(t)) > first
            }
            if len(directions) > 1:
                self.violations["opposing trains in a section"] += 1


def traffic(
    seed: int,
    *,
    trains: int = 8,
    layout: Layout | None = None,
    rules: frozenset[Rule] = ALL_RULES,
    conditions: Conditions | None = None,
    **settings: Any,
) -> Traffic:
    """Return traffic at its start: trains at rest in stations, at places that the seed chooses."""
    layout, rng = layout or line_with_loops(), random.Random(seed)
    last = len(layout.stations) - 1
    slots = [(k, track) for k in range(last + 1) for track in (1, 2)]
    simulated, supervised = {}, {}
    for number, (station, track) in enumerate(rng.sample(slots, trains), start=1):
        direction = 1 if station == 0 else -1 if station == last else 1 if track == 1 else -1
        inner = layout.stations[station].inner_m
        front = (inner[1] if direction > 0 else inner[0]) - direction * rng.uniform(60.0, 120.0)
        train = SimulatedTrain(
            number=number,
            direction=direction,
            front_m=front,
            tracks={station: track},
            end_m=front,
            top_mps=rng.uniform(12.0, 25.0),
            length_m=rng.uniform(40.0, 150.0),
        )
        simulated[number] = train
        supervised[number] = TrainInterval(
            train=number,
            direction=direction,
            rear_m=train.rear_m - direction * 5.0,
            front_m=front + direction * 5.0,
            end_m=front + direction * 5.0,
            sequence=0,
            tracks={station: track},
            station=station,
        )
    state = Interlocking(trains=supervised, points={name: PointState() for name in layout.points()})
    return Traffic(
        layout=layout,
        trains=simulated,
        state=state,
        random=rng,
        rules=rules,
        conditions=conditions or Conditions(),
        **settings,
    )
