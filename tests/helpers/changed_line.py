"""Random sequences of `attacked_line` in which trains are hauled, divided and joined, and intervals are corrected.

Also: vehicles that report nothing enter sections, points are moved by hand, orders come at wrong moments, and the
centre goes on from an older copy of its database. Checked as there: no authority is extended into a train, its wagons
or a vehicle, and none is held beyond an interval; besides, no train runs over points that are not locked for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from attacked_line import BOUND_M, LENGTH_M, LINE, STEP_S, AttackedLine, AttackedTrain
from railfix.ground.authority import Authority
from railfix.ground.changes import correct_interval, divide_train, join_trains
from railfix.ground.interlocking import NearbyTrains, is_free
from railfix.ground.layout import Piece, PointName, overlap
from railfix.ground.state import Interlocking, from_documents, stop_trains, to_documents
from railfix.ground.stops import OCCUPIED, close_section, open_section, pieces_of

#: A hauled train is moved so far in a step at most [m].
HAULED_M = 50.0
#: Length of what a divided train keeps [m].
FRONT_M = 30.0


@dataclass(kw_only=True)
class ChangedLine(AttackedLine):
    """Line with more kinds of events."""

    copies: list[Interlocking] = field(default_factory=list)
    vehicles: dict[str, list[Piece]] = field(default_factory=dict)
    parts: dict[int, int] = field(default_factory=dict)  #: Number of the rear part, by that of the divided train.

    def __post_init__(self) -> None:
        super().__post_init__()
        self.calm = self.rng.choice((1.0, 0.3, 0.1))

    def step(self) -> None:
        """Run a step of `attacked_line`, and one of the other events before it."""
        self.copies = [*self.copies[-3:], self.centre.state]
        events: list[Callable[[], None]] = [
            self.haul, self.divide, self.join, self.enter_vehicle, self.clear_vehicle, self.move_points, self.order,
            self.correct,
        ]  # fmt: skip
        if self.rng.random() < 0.5 * self.calm:
            self.rng.choice(events)()
        if self.rng.random() < 0.01 * self.calm:
            self.restart_older()
        super().step()
        self.check_apart()

    def check_held(self) -> None:
        """As before, of trains that have been heard since the start: an older copy does not know what others hold."""
        kept = self.trains
        self.trains = {n: train for n, train in kept.items() if n not in self.centre.awaited}
        super().check_held()
        self.trains = kept

    def sent(self) -> list[Authority]:
        """As before, with the orders to brake."""
        messages = [*self.centre.watch(self.now_s), *self.centre.work(self.now_s)]
        self.centre.command_points(self.centre.state)
        return messages

    def is_clear(self, train: AttackedTrain, back_m: float) -> bool:
        """Return whether a train can go back so far: over points that lie as it has passed them, and into no other."""
        path = LINE.pieces(train.rear_m, train.rear_m - train.direction * back_m, train.tracks)
        under = [point for point in LINE.points() if overlap([(0, *LINE.zone_m(point))], path)]
        lie = all(self.points[p] == train.tracks.get(p[0]) and p not in self.moving for p in under)
        return lie and not any(overlap(path, self.pieces(n)) for n in self.trains if n != train.number)

    def check_apart(self) -> None:
        """No train has run into another one, where all have moved by what was granted alone."""
        for number, train in self.trains.items():
            for other in self.trains:
                astray = train.astray or self.trains[other].astray
                if number < other and not astray and overlap(self.pieces(number), self.pieces(other)):
                    self.violations["trains overlap"] += 1

    def any_train(self) -> AttackedTrain:
        return self.rng.choice(list(self.trains.values()))

    def others(self, number: int) -> list[Piece]:
        found = [piece for other in self.trains if other != number for piece in self.pieces(other)]
        return [*found, *(piece for pieces in self.vehicles.values() for piece in pieces)]

    def haul(self) -> None:
        """Move a stopped train along its track, by what moves others: not over points, not into a train."""
        train = self.any_train()
        if self.centre.state.trains[train.number].stop is None or train.wagons:
            return
        way = self.rng.uniform(-HAULED_M, HAULED_M)
        ends = sorted((train.front_m, train.rear_m, train.front_m + way, train.rear_m + way))
        path = LINE.pieces(ends[0], ends[-1], train.tracks)
        zones: list[Piece] = [(0, *LINE.zone_m(point)) for point in LINE.points()]
        if overlap(path, zones) or overlap(path, self.others(train.number)) or ends[0] < 0.0:
            return
        train.front_m += way
        train.lies = 0
        self.seen["hauled"] += 1
        # its own unit sees it: the place is right, and the speed that of the way
        self.report(train, abs(way) / STEP_S, certain=True)

    def divide(self) -> None:
        train = self.any_train()
        known = self.centre.state.trains[train.number]
        if train.wagons or train.whole_m != LENGTH_M or known.direction != train.direction or not self.is_known(train):
            return
        other = 10 + train.number
        self.centre.state, reason = divide_train(self.centre.state, train.number, other, length_m=FRONT_M)
        if reason is not None:
            return
        train.cut_m = train.front_m - train.direction * FRONT_M
        train.wagons, train.whole_m = LINE.pieces(train.cut_m, train.rear_m, train.tracks), FRONT_M
        train.divided = True
        self.parts[train.number] = other
        self.seen["divided"] += 1

    def join(self) -> None:
        """Couple the parts of a train that has not moved since."""
        train = self.any_train()
        other = self.parts.get(train.number)
        if other is None or train.direction != self.centre.state.trains[train.number].direction:
            return
        cut = train.front_m - train.direction * FRONT_M
        rear = cut - train.direction * (LENGTH_M - FRONT_M)
        if train.wagons != LINE.pieces(cut, rear, train.tracks):
            return
        self.centre.state, reason = join_trains(self.centre.state, train.number, other, LINE)
        if reason is None:
            train.wagons, train.whole_m = [], LENGTH_M
            train.divided = False
            del self.parts[train.number]
            self.centre.forget([other])
            self.seen["joined"] += 1

    def enter_vehicle(self) -> None:
        """Let a vehicle in where somebody has barred the section, or its detection says so at once."""
        name = self.rng.choice(sorted(LINE.sections))
        if name in self.vehicles:
            return
        detected = self.rng.random() < 0.5
        if not detected:
            self.centre.state = close_section(self.centre.state, name, LINE, "occupied", kind=OCCUPIED)
        intervals = [piece for train in self.centre.state.trains.values() for piece in pieces_of(train, LINE)]
        piece = self.rng.choice(LINE.sections[name])
        taken = overlap(LINE.sections[name], intervals) or overlap([piece], self.others(0))
        if taken or any(is_under(point, piece) and point in self.moving for point in LINE.points()):
            if not detected:
                self.centre.state = open_section(self.centre.state, name, OCCUPIED)
            return
        self.vehicles[name] = [piece]
        if detected:
            self.centre.set_section_detected(name, True)
        self.seen["vehicle"] += 1

    def clear_vehicle(self) -> None:
        if self.vehicles:
            name = self.rng.choice(sorted(self.vehicles))
            del self.vehicles[name]
            self.centre.set_section_detected(name, False)

    def move_points(self) -> None:
        """Move points by hand that nothing locks."""
        point = self.rng.choice(sorted(self.points))
        if point in self.moving or self.centre.awaited or not self.is_free(point):
            return
        if any(overlap([(0, *LINE.zone_m(point))], self.pieces(number)) for number in self.trains):
            return
        self.points[point] = 3 - self.points[point]
        self.centre.set_detected(point, self.points[point])
        self.seen["points by hand"] += 1

    def is_free(self, point: PointName) -> bool:
        return is_free(self.centre.state, point, LINE, NearbyTrains(self.centre.state, LINE))

    def order(self) -> None:
        """Orders at any moment: a route, a stop, a section closed and opened."""
        kind, train = self.rng.choice(("route", "stop", "close", "open")), self.any_train()
        if kind == "route":
            self.centre.set_route(train.number)
        elif kind == "stop" and self.rng.random() < 0.3:
            self.centre.state = stop_trains(self.centre.state, [train.number], "by hand")
        elif kind == "close" and self.rng.random() < 0.3:
            name = self.rng.choice(sorted(LINE.sections))
            self.centre.state = close_section(self.centre.state, name, LINE, "closed")
        elif kind == "open":
            for name, _ in sorted(self.centre.state.bars):
                self.centre.state = open_section(self.centre.state, name)
        self.seen["order"] += 1

    def dispatch(self, train: AttackedTrain) -> None:
        """As before; a train that stays stopped is looked for: its wagons are coupled again, its interval corrected."""
        super().dispatch(train)
        if self.centre.state.trains[train.number].stop is not None and self.rng.random() < 0.5:
            if train.wagons and not train.divided:
                self.couple(train)
            self.correct(train)

    def couple(self, train: AttackedTrain) -> None:
        """Back a train onto the wagons that it has lost, where nothing is between and points lead there."""
        place = train.cut_m + train.direction * train.whole_m
        back_m = train.direction * (train.front_m - place)
        if back_m >= 0.0 and self.is_clear(replace(train, wagons=[]), back_m):
            train.front_m, train.wagons, train.whole_m, train.lies, train.astray = place, [], LENGTH_M, 0, True
            self.report(train, 0.0, certain=True)
            self.seen["coupled"] += 1

    def is_known(self, train: AttackedTrain) -> bool:
        return self.taken[train.number].right and train.lies == 0

    def correct(self, train: AttackedTrain | None = None) -> None:
        """Set the interval of a stopped train to where it has been seen."""
        train = train or self.any_train()
        if self.centre.state.trains[train.number].stop is None or (train.wagons and not train.divided):
            return
        d = train.direction
        values: dict[str, Any] = {
            "direction": d,
            "rear_m": on_line(train.rear_m - d * BOUND_M),
            "front_m": on_line(train.front_m + d * BOUND_M),
        }
        stations = LINE.stations_between(*sorted((values["rear_m"], values["front_m"])))
        tracks = {train.tracks.get(k, 1) for k in stations}
        if len(tracks) > 1:
            return
        track = tracks.pop() if tracks else 1
        lapsed = self.centre.has_lapsed(train.number, self.now_s)
        self.seen["lapsed"] += lapsed
        self.centre.state, reason = correct_interval(
            self.centre.state, train.number, LINE, track=track, lapsed=lapsed, **values
        )
        self.seen["corrected"] += reason is None

    def restart_older(self) -> None:
        """Go on from a copy of the database of up to four steps ago; the field answers where its points lie."""
        state = from_documents(to_documents(self.rng.choice(self.copies)))
        if set(state.trains) != set(self.centre.state.trains):
            return  # trains were divided or joined since: that is assumed away with what was ordered
        bars, restrictions = self.centre.state.bars, self.centre.state.restrictions
        self.centre.state = Interlocking(
            trains=state.trains, points=state.points, stopped=state.stopped, granted=state.granted, bars=bars,
            restrictions=restrictions,
        )  # fmt: skip
        self.centre.records.clear()
        self.centre._clocks.clear()
        # a second after what was sent in the last step
        for point in self.centre.begin_again(self.now_s, wall_us=int(1e6 * self.now_s + 1e6)):
            if point not in self.moving:
                self.centre.set_detected(point, self.points[point])
        for number in self.parts.values():
            self.centre.awaited.discard(number)  # it reports nothing: confirmed by hand
        for taken in self.taken.values():
            taken.sent_s = None
        self.seen["older copy"] += 1

    def lead(self, train: AttackedTrain, way: float) -> None:
        """Let a train run; the points that it comes to are locked for it.

        After a start with an older copy of the database the centre does not know the route until the train is heard:
        nothing moves any points before all are.
        """
        before = train.front_m
        super().lead(train, way)
        for point in LINE.points():
            zone = sorted(train.direction * end for end in LINE.zone_m(point))
            if train.direction * before < zone[0] <= train.direction * train.front_m:
                if point[1] == train.direction and self.points[point] != train.tracks.get(point[0]):
                    self.violations["points run through from the wrong track"] += 1
                state = self.centre.state.points[point]
                locked = train.number in state.locked and state.wanted == self.points[point]
                if not locked and not self.centre.awaited:
                    self.violations["train over points that are not locked for it"] += 1

    def check_grant(self, end_before_m: float, authority: Authority) -> None:
        """As before, and into no vehicle."""
        super().check_grant(end_before_m, authority)
        known = self.centre.state.trains[authority.train]
        if known.direction * (known.end_m - end_before_m) > 0.0:
            path = LINE.pieces(end_before_m, known.end_m, known.tracks)
            if overlap(path, [piece for pieces in self.vehicles.values() for piece in pieces]):
                self.violations["authority into a vehicle"] += 1


def is_under(point: PointName, *pieces: Piece) -> bool:
    return overlap([(0, *LINE.zone_m(point))], pieces)


def on_line(chainage_m: float) -> float:
    return min(max(chainage_m, LINE.stations[0].begin_m), LINE.stations[-1].end_m)
