"""Traffic under loss, delays, outages, restarts of the centre, sensor failures and suspensions."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

from railfix.ground.layout import Layout
from railfix.ground.on_board import OnBoard
from railfix.ground.state import Interlocking, from_documents, to_documents
from railfix.ground.supervision import Supervision, at_start
from railfix.ground.traffic import SimulatedTrain, Traffic, line_with_loops
from railfix.io.train_message import TrainMessage


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
    suspension : float
        Probability a second that satellite positioning is suspended for up to 120 s: trains stop.
    """

    loss: float = 0.3
    delay_s: float = 8.0
    outage: float = 0.002
    restart: float = 0.004
    blind: float = 0.001
    suspension: float = 0.001


@dataclass(kw_only=True)
class DisturbedTraffic(Traffic):
    """Traffic whose messages are lost and delayed, and whose centre stops and is restarted from its store."""

    conditions: Conditions
    _mail: list[tuple[float, int, Callable[[], None]]] = field(default_factory=list)
    _silent_until: dict[int, float] = field(default_factory=dict)
    _centre_back_s: float = -1.0
    _suspended_until_s: float = -1.0
    _stored: Interlocking | None = None

    def disturb(self) -> None:
        rng, conditions = self.random, self.conditions
        if self.now_s >= self._centre_back_s and rng.random() < conditions.restart:
            self._centre_back_s = self.now_s + rng.uniform(1.0, 30.0)
            self.centre.state = self.restored()
        self.centre_works = self.now_s >= self._centre_back_s
        if rng.random() < conditions.suspension:
            self._suspended_until_s = self.now_s + rng.uniform(30.0, 120.0)
        for train in self.trains.values():
            if rng.random() < conditions.outage:
                self._silent_until[train.number] = self.now_s + rng.uniform(5.0, 60.0)
            if rng.random() < conditions.blind:
                train.blind_until_s = self.now_s + rng.uniform(5.0, 40.0)
            if rng.random() < 0.05:
                train.error_m = rng.uniform(-train.bound_m, train.bound_m)

    def restored(self) -> Interlocking:
        return from_documents(to_documents(self._stored or self.centre.state))

    def send_report(self, message: TrainMessage) -> None:
        self._send(message.train, partial(self._report, message))

    def exchange(self) -> None:
        due = [item for item in self._mail if item[0] <= self.now_s]
        self._mail = [item for item in self._mail if item[0] > self.now_s]
        for _, _, deliver in sorted(due, key=lambda item: item[:2]):
            deliver()
        if not self.centre_works:
            return
        self.centre.state = replace(self.centre.state, stopped=self.now_s < self._suspended_until_s)
        authorities = self.centre.advance(self.now_s)
        self._stored = self.centre.state
        for authority in authorities:
            self._send(authority.train, partial(self.authority, authority))

    def _send(self, train: int, deliver: Callable[[], None]) -> None:
        rng = self.random
        if rng.random() < self.conditions.loss or self.now_s < self._silent_until.get(train, -1.0):
            return
        delay = rng.uniform(0.0, self.conditions.delay_s) if rng.random() < 0.5 else 0.0
        self._mail.append((self.now_s + delay, len(self._mail), deliver))

    def _report(self, message: TrainMessage) -> None:
        if self.centre_works:
            self.centre.report(message, self.now_s)


def without_grants(state: Interlocking) -> Interlocking:
    """The state whose authorities end at the fronts of the trains."""
    return replace(state, trains={n: replace(t, end_m=t.front_m) for n, t in state.trains.items()})


def traffic(
    seed: int, *, trains: int = 8, layout: Layout | None = None, conditions: Conditions | None = None
) -> DisturbedTraffic:
    """Return traffic at its start: trains at rest in stations, at places that the seed chooses."""
    layout, rng = layout or line_with_loops(), random.Random(seed)
    last = len(layout.stations) - 1
    slots = [(k, track) for k in range(last + 1) for track in (1, 2)]
    simulated, supervised = {}, []
    for number, (station, track) in enumerate(rng.sample(slots, trains), start=1):
        direction = 1 if station == 0 else -1 if station == last else 1 if track == 1 else -1
        inner = layout.stations[station].inner_m
        front = (inner[1] if direction > 0 else inner[0]) - direction * rng.uniform(60.0, 120.0)
        train = SimulatedTrain(
            number=number,
            front_m=front,
            tracks={station: track},
            on_board=OnBoard(direction=direction, end_m=front),
            top_mps=rng.uniform(12.0, 25.0),
            length_m=rng.uniform(40.0, 150.0),
        )
        simulated[number] = train
        supervised.append(train.at_rest())
    return DisturbedTraffic(
        trains=simulated,
        centre=Supervision(layout=layout, state=at_start(layout, supervised)),
        random=rng,
        conditions=conditions or Conditions(),
    )
