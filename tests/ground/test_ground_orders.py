"""Orders by hand, stops without the store, points after the commit, starts: the centre told wrong, and usable after."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from railfix.ground.authority import Authority, BrakeOrder
from railfix.ground.control import ControlCentre, list_orders
from railfix.ground.layout import Layout, LoopStation, overlap
from railfix.ground.on_board import OnBoard
from railfix.ground.state import HEAD, TrainInterval, from_documents, to_documents
from railfix.ground.stops import OCCUPIED, UNKNOWN, pieces_of
from railfix.ground.store import DatabaseError, Store
from railfix.ground.supervision import Supervision, at_start, standing_train
from railfix.ground.writer import ThreadWriter
from railfix.io.train_message import MessageStatus, TrainMessage, encode

pytestmark = pytest.mark.requirement("F2", "F4", "F6", "F7")

#: West 0 to 600 m, Mid 2500 to 3100 m, East 5000 to 5600 m; points of 60 m.
LINE = Layout(
    stations=tuple(
        LoopStation(name=n, begin_m=m, end_m=m + 600.0) for n, m in (("West", 0.0), ("Mid", 2500.0), ("East", 5000.0))
    )
)


class FailingStore(Store):
    """Store that fails, or waits, on demand."""

    fails = False
    waits: threading.Event | None = None

    def save(self, *records: Any, documents: Any = None) -> None:
        if self.waits is not None:
            self.waits.wait(20.0)
        if self.fails:
            raise DatabaseError("the database cannot be written (disk is full)")
        super().save(*records, documents=documents)


def train(number: int, front_m: float, station: int, *, direction: int = 1, track: int = 1) -> TrainInterval:
    return standing_train(
        number, direction=direction, front_m=front_m, length_m=200.0, bound_m=10.0, station=station, track=track
    )


class Desk:
    """A centre with its clock, what it sends, and the orders of two people."""

    def __init__(self, path: Path, *trains: TrainInterval, routes: str = "by hand") -> None:
        self.path, self.now, self.sequence = path, 100.0, 0
        self.sent: list[Authority] = []
        self.commands: list[Any] = []
        self.asked: list[Any] = []
        self.trains, self.routes = trains, routes
        self.start()

    def start(self) -> None:
        """Start the centre, or start it again."""
        self.store = FailingStore(f"sqlite:///{self.path / 'centre.db'}")
        supervision = Supervision(layout=LINE, state=at_start(LINE, list(self.trains)), routes=self.routes)  # type: ignore[arg-type]
        supervision.command = lambda point, track: self.commands.append((point, track))
        self.centre = ControlCentre.restore(
            supervision, self.store, judged=False, curves={}, clock=lambda: self.now, wall_ns=lambda: 0,
            send=lambda _, data: self.sent.append(Authority.decode(data)), ask=self.asked.append,
        )  # fmt: skip
        self.orders = list_orders(self.centre)

    def kill(self) -> None:
        """End the centre without another commit."""
        self.store._notes.clear()
        self.store.close()

    def report(self, number: int, front_m: float, **changes: Any) -> None:
        self.sequence += 1
        time_ns = round((1e6 + self.now) * 1e9)
        values: dict[str, Any] = {
            "train": number, "sequence": self.sequence, "time_ns": time_ns, "sent_ns": time_ns, "line": 1,
            "chainage_cm": round(100 * front_m), "over_cm": 500, "under_cm": 500, "speed_cmps": 0, "facing": 1,
            "standstill": True, "status": MessageStatus.POSITION, "length_cm": 20_000, "complete": True,
        }  # fmt: skip
        self.centre.report(number, encode(TrainMessage(**{**values, **changes})))

    def steps(self, seconds: float) -> None:
        for _ in range(round(seconds * 10)):
            self.now += 0.1
            self.centre.step()

    def twice(self, order: str, values: dict[str, Any]) -> str | None:
        """The order by one person, and by another."""
        first = self.orders[order](values, "anna")
        assert first is not None
        if "repeat the order" not in first:
            return first
        return self.orders[order](values, "ben")

    def order_to(self, number: int) -> int:
        """The number of the newest order to brake sent to a train."""
        return max(order.number for order in self.sent if isinstance(order, BrakeOrder) and order.train == number)

    @property
    def state(self) -> Any:
        return self.centre.supervision.state


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    """Train 1 up in West, train 2 up in Mid."""
    made = Desk(tmp_path, train(1, 400.0, 0), train(2, 2900.0, 1))
    yield made
    if made.store.waits is not None:
        made.store.waits.set()
    made.store.close()


def test_stops_leave_while_the_database_fails_or_hangs(desk: Desk) -> None:
    """Within one step of 0.1 s, and every second until the train names the order; nothing is granted meanwhile."""
    desk.steps(1.0)
    desk.store.fails = True
    desk.steps(2.0)
    assert desk.centre.database is not None
    desk.sent.clear()
    assert desk.orders["stop-all"]({}) is None
    desk.steps(0.1)
    assert {type(order) for order in desk.sent} == {BrakeOrder}
    assert {order.train for order in desk.sent} == {1, 2}
    desk.steps(4.9)
    assert len(desk.sent) == 10
    desk.report(1, 400.0, brake_order=desk.sent[-1].number)
    desk.sent.clear()
    desk.steps(3.0)
    assert {order.train for order in desk.sent} == {2}
    assert "acknowledged after" in (desk.centre.snapshot()["trains"][0]["stop"] or "")
    desk.store.fails = False
    desk.steps(3.0)
    assert desk.centre.database is None
    assert all(authority.stopped for authority in desk.sent)


def test_a_database_that_hangs_is_an_alarm_and_holds_up_nothing(desk: Desk) -> None:
    desk.steps(1.0)
    writer = ThreadWriter()
    desk.centre.commits.writer = writer
    desk.store.waits = threading.Event()
    begin = time.monotonic()
    desk.steps(3.0)
    assert desk.orders["stop"]({"train": 2}) is None
    desk.steps(0.1)
    assert time.monotonic() - begin < 2.0  # of real time: no step has waited
    assert "has not answered for" in (desk.centre.database or "")
    assert any("ALARM" in line for line in desk.centre.lines)
    assert next(order.train for order in desk.sent if isinstance(order, BrakeOrder)) == 2
    desk.store.waits.set()
    assert writer.stop(10.0)
    desk.centre.settle()
    assert desk.centre.database is None


def test_points_are_commanded_after_the_commit(tmp_path: Path) -> None:
    """Train 3 leaves track 2 of East for Mid: both points move. Killed before the commit nothing has moved."""
    (tmp_path / "down").mkdir()
    made = Desk(tmp_path / "down", train(3, 5200.0, 2, direction=-1, track=2))
    made.steps(0.2)
    made.store.fails = True
    assert made.orders["route"]({"train": 3}) is None
    made.steps(2.0)
    assert made.commands == []
    made.kill()
    made.store.fails = False
    made.start()
    assert {point.wanted for point in made.state.points.values()} == {1}
    for name in made.asked:
        made.centre.supervision.set_detected(name, 1)
    made.steps(0.2)
    made.report(3, 5200.0, facing=-1, authority=made.state.granted)
    made.steps(0.2)
    assert made.orders["route"]({"train": 3}) is None
    assert made.commands == []
    made.steps(0.2)
    assert sorted(made.commands) == [((1, 1), 2), ((2, -1), 2)]
    stored = from_documents(made.store.documents(HEAD))
    assert stored.points[2, -1].wanted == 2
    made.store.close()


def test_after_a_start_nothing_is_commanded_under_a_train(desk: Desk) -> None:
    """Train 1 stands on the upper points of West, whose detection was lost; the field answers that they lie wrong."""
    assert desk.orders["route"]({"train": 2}) is None
    desk.steps(1.0)
    assert desk.orders["route"]({"train": 1}) is None
    for front in range(410, 650, 10):
        desk.steps(1.0)
        desk.report(1, front, speed_cmps=1000, direction=1, standstill=False)
    desk.steps(0.2)
    desk.kill()
    desk.start()
    assert set(desk.asked) == set(LINE.points())
    desk.steps(0.5)
    assert desk.commands == []
    for name in LINE.points():
        desk.centre.supervision.set_detected(name, 2 if name == (0, 1) else 1)
    desk.steps(1.0)
    assert desk.commands == []
    assert desk.state.trains[1].stop == "points of its route are detected in another position"


def test_an_older_copy_moves_no_points_of_a_route_that_it_does_not_know(tmp_path: Path) -> None:
    """Points that the copy knows locked on track 2 lie on track 1 for a later route: train 1 runs by it, unheard."""
    made = Desk(tmp_path, train(1, 400.0, 0), train(3, 5200.0, 2, direction=-1, track=2))
    made.steps(0.2)
    assert made.orders["route"]({"train": 3}) is None
    made.steps(0.4)
    assert sorted(made.commands) == [((1, 1), 2), ((2, -1), 2)]
    made.kill()
    made.start()
    made.commands.clear()
    for name in LINE.points():
        made.centre.supervision.set_detected(name, 1)
    made.report(3, 4000.0, facing=-1, authority=900, authority_end_cm=400_000)
    made.steps(1.0)
    made.report(3, 4000.0, facing=-1, brake_order=made.state.granted)
    made.steps(5.0)
    assert made.centre.supervision.awaited == {1}
    assert made.commands == []
    made.report(1, 1500.0, authority=900, authority_end_cm=420_000, speed_cmps=1000, direction=1, standstill=False)
    made.report(1, 1500.0, brake_order=made.state.granted)
    assert made.centre.supervision.awaited == set()
    made.steps(5.0)
    assert made.state.trains[1].interval_m[1] == 4200.0
    assert ((1, 1), 2) not in made.commands
    made.store.close()


def test_after_a_start_points_that_nothing_locks_are_wanted_as_they_lie(desk: Desk) -> None:
    """A train on points that an older copy of the database wants otherwise can be released."""
    desk.steps(0.2)
    desk.kill()
    desk.start()
    for name in LINE.points():
        desk.centre.supervision.set_detected(name, 2)
    desk.report(1, 400.0)
    desk.report(2, 2900.0)
    desk.steps(1.0)
    assert desk.commands == []
    assert {point.wanted for point in desk.state.points.values()} == {2}


def test_a_train_that_has_turned_holds_what_an_older_copy_does_not_know(desk: Desk) -> None:
    """Both have turned since the copy, and hold authorities: of a number that it does not know, and of one it knows."""
    desk.steps(0.2)
    desk.kill()
    desk.start()
    desk.report(2, 2900.0, facing=-1, authority=900, authority_end_cm=120_000)
    assert desk.state.skipped[0] < 900 < desk.state.granted
    assert "the train has authority 900" in (desk.state.trains[2].stop or "")
    assert min(desk.state.trains[2].interval_m) == 1200.0
    desk.report(1, 205.0, facing=-1, authority=1, authority_end_cm=5_000)
    assert desk.state.trains[1].stop == "the train has an authority that ends beyond its interval, at 50 m"
    assert desk.state.trains[1].rear_m == 50.0
    assert desk.state.trains[1].direction == 1


def test_a_wrong_change_of_ends_frees_no_authority(desk: Desk) -> None:
    """The report says that train 2 looks down in Mid, and names the authority to the end of its track that it holds."""
    desk.steps(0.2)
    end = desk.state.trains[2].end_m
    desk.report(2, 2700.0, facing=-1, authority=desk.state.granted, authority_end_cm=round(100 * end))
    assert desk.state.trains[2].direction == -1
    assert desk.state.trains[2].rear_m == end == 3020.0


def test_a_field_that_does_not_answer_stops_the_trains_on_its_points(desk: Desk) -> None:
    assert desk.orders["route"]({"train": 2}) is None
    desk.steps(0.2)
    assert desk.state.trains[2].end_m > 5000.0
    desk.kill()
    desk.start()
    desk.report(2, 2900.0)
    desk.steps(9.0)
    assert desk.state.trains[2].stop is None
    desk.steps(2.0)
    assert desk.state.trains[2].stop == "the trackside does not answer for points of its route"
    assert desk.state.trains[1].stop is None


def test_nothing_is_granted_after_a_start_until_every_train_is_heard(desk: Desk) -> None:
    """The database is an older copy: train 1 has an authority to Mid that it does not know of."""
    copy = to_documents(desk.state)
    desk.store.save(documents=copy)
    desk.kill()
    desk.start()
    desk.steps(0.2)
    late = desk.sent[-1].number - (1 << 20)
    desk.report(2, 2900.0, authority=late)
    assert desk.centre.supervision.awaited == {1, 2}  # the report may be late: it names no order of this start
    desk.report(2, 2900.0, authority=desk.state.granted)
    desk.steps(2.0)
    assert desk.orders["route"]({"train": 2}) == "no report since the start: train 1"
    ends = {number: known.end_m for number, known in desk.state.trains.items()}
    desk.steps(2.0)
    assert {number: known.end_m for number, known in desk.state.trains.items()} == ends
    assert any("no authorities are extended until" in alarm for alarm in desk.centre.alarms)
    desk.report(1, 1500.0, authority=900, authority_end_cm=245_000, speed_cmps=1000, direction=1, standstill=False)
    assert "the newest in the centre's database at the last start was" in (desk.state.trains[1].stop or "")
    assert desk.state.trains[1].interval_m[1] == 2450.0  # what it may still run to is occupied
    assert desk.state.granted >= 900
    desk.steps(0.2)
    desk.report(1, 1510.0, brake_order=desk.sent[-1].number, speed_cmps=500, direction=1, standstill=False)
    assert desk.centre.alarms == []
    assert [a.stopped for a in desk.sent[-2:]] == [True, True]
    desk.kill()
    desk.start()
    assert desk.twice("confirm-start", {}) is None
    desk.steps(0.2)
    assert desk.centre.alarms == []


def test_a_train_outside_its_interval_is_not_released(desk: Desk) -> None:
    """Its place 1,500 m on is further than it can have got in a second: the interval covers as far as that."""
    desk.report(1, 400.0)
    desk.steps(1.0)
    desk.report(1, 1900.0)
    reason = desk.orders["release-train"]({"train": 1})
    assert "was last reported at 1695 to 1905 m, outside its interval" in reason
    assert "correct-train" in reason
    for _ in range(20):  # it reports on: the interval comes to cover its place
        desk.steps(1.0)
        desk.report(1, 1900.0)
    assert desk.state.trains[1].front_m == 1905.0
    assert desk.state.trains[1].contradiction == "the train is beyond its authority"
    assert desk.orders["release-train"]({"train": 1}) is None
    desk.report(1, 1901.0)
    assert desk.state.trains[1].stop is None


@pytest.mark.parametrize(
    "wrong",
    [{"length_cm": 0, "over_cm": 10**11, "under_cm": 10**11}, {"line": 7, "chainage_cm": 540_000}],
    ids=["no length and wide bounds", "another line"],
)
def test_an_order_frees_a_line_that_a_wrong_report_has_stopped(desk: Desk, wrong: dict[str, Any]) -> None:
    """Once the train reports right again its interval is corrected, by two people, and it is released."""
    desk.centre.supervision.routes = "automatic"
    for _ in range(3):
        for number, front in ((1, 400.0), (2, 2900.0)):
            desk.report(number, front)
        desk.steps(1.0)
        for name in {point for point, _ in desk.commands}:
            desk.centre.supervision.set_detected(name, desk.state.points[name].wanted)
    desk.report(2, 2900.0, **wrong)
    desk.steps(1.0)
    assert desk.state.trains[2].stop is not None
    for _ in range(5):
        for number, front in ((1, 400.0), (2, 2900.0)):
            desk.report(number, front, brake_order=desk.order_to(number))
        desk.steps(1.0)
    values = {"train": 2, "rear_m": 2690, "front_m": 2906, "direction": 1, "track": 1, "reason": "seen in Mid, whole"}
    assert "reason: one to" in (desk.orders["correct-train"]({**values, "reason": " "}, "anna") or "")
    assert "train 2 reports 2695 to 2905 m" in (desk.twice("correct-train", {**values, "front_m": 2900}) or "")
    alone = desk.orders["correct-train"](values, "anna")
    assert "repeat the order in 3 to 60 s" in (alone or "")
    assert desk.orders["correct-train"](values, "anna") is not None  # at once, by the same person
    assert desk.orders["correct-train"](values, "ben") is None
    assert desk.state.trains[2].span_m == (2690.0, 2906.0)
    for number in (1, 2):
        if desk.state.trains[number].stop is not None:
            assert desk.orders["release-train"]({"train": number}, "ben") is None
    for _ in range(3):
        for number, front in ((1, 400.0), (2, 2900.0)):
            desk.report(number, front)
        desk.steps(1.0)
    assert [known.stop for known in desk.state.trains.values()] == [None, None]
    assert any(line.split(": ", 1)[1].startswith("order of ben: correct-train") for line in desk.centre.lines)


def test_an_interval_is_not_shortened_while_an_authority_is_on_the_way(desk: Desk) -> None:
    """The train obeyed an order to brake, was released, and is stopped again while its next authority is late.

    So its newest report names an order to brake which that authority ends. Only an order to brake that is as new as the
    authority frees the track beyond the corrected interval, or 60 s: no unit takes one that has lapsed.
    """
    unit = OnBoard(direction=1, end_m=400.0)
    desk.centre.supervision.routes = "automatic"

    def answer(*, late: list[Authority] | None = None) -> None:
        desk.report(2, 2900.0)
        unit.note_report(desk.sequence + 1, desk.now)
        unit.note_position(405.0, 0.0)
        desk.report(1, 400.0, **unit.acknowledgement())
        desk.steps(1.0)
        for name in {point for point, _ in desk.commands}:
            desk.centre.supervision.set_detected(name, desk.state.points[name].wanted)
        for message in (sent := desk.sent[:]):
            if message.train == 1 and late is None:
                unit.receive(message)
        desk.sent.clear()
        if late is not None:
            late += [message for message in sent if message.train == 1]

    for _ in range(3):
        answer()
    assert unit.end_m > 2000.0
    desk.orders["stop"]({"train": 1}, "anna")
    answer()
    answer()
    assert unit.end_m < 410.0
    assert desk.orders["release-train"]({"train": 1}, "anna") is None
    late: list[Authority] = []
    answer(late=late)
    assert not late[-1].stopped
    assert late[-1].end_cm > 200_000
    desk.orders["stop"]({"train": 1}, "anna")
    values = {"train": 1, "rear_m": 190, "front_m": 410, "direction": 1, "track": 1, "reason": "seen in West, whole"}
    assert "has not reported that it obeys" in (desk.twice("correct-train", values) or "")
    for message in late:
        unit.receive(message)
    assert unit.end_m > 2000.0
    answer()
    answer()
    assert unit.order is not None
    assert desk.twice("correct-train", values) is None
    for message in late:
        unit.receive(message)
    assert unit.end_m < 410.0


def test_an_interval_is_corrected_once_every_authority_has_lapsed(desk: Desk) -> None:
    """A unit that names no order to brake, and from whose newest report on 60 s have passed, or since a stop."""
    unit = OnBoard(direction=1, end_m=400.0)
    desk.report(1, 400.0)
    unit.note_report(desk.sequence, desk.now)
    desk.steps(1.0)
    authority = next(message for message in desk.sent if message.train == 1 and not message.stopped)
    desk.orders["stop"]({"train": 1}, "anna")
    values = {"train": 1, "rear_m": 190, "front_m": 410, "direction": 1, "track": 1, "reason": "seen in West, whole"}
    for _ in range(58):
        desk.report(1, 400.0)
        desk.steps(1.0)
    assert "has not reported that it obeys" in (desk.twice("correct-train", values) or "")
    desk.report(1, 400.0)
    desk.steps(3.0)
    assert desk.twice("correct-train", values) is None
    unit.note_report(desk.sequence, desk.now)
    assert not unit.receive(authority)  # it answers a report of more than 45 s ago


def test_a_train_that_was_never_heard_may_have_what_it_was_sent(desk: Desk) -> None:
    """Its authority of now has lapsed no sooner than that of a train that reports."""
    desk.steps(1.0)
    desk.orders["stop"]({"train": 1}, "anna")
    values = {"train": 1, "rear_m": 190, "front_m": 410, "direction": 1, "track": 1, "reason": "seen in West, whole"}
    assert "has not reported that it obeys" in (desk.twice("correct-train", values) or "")
    desk.steps(61.0)
    assert desk.twice("correct-train", values) is None


def test_a_train_is_entered_anywhere_and_removed(desk: Desk) -> None:
    """Between stations: no authority leads into it; removed, its section stays occupied until it is seen free."""
    values = {
        "train": 9, "length_m": 100, "rear_m": 1000, "front_m": 1120, "direction": 1, "track": 1, "reason": "a crane",
    }  # fmt: skip
    assert "no room for a train" in (desk.twice("enter-train", {**values, "front_m": 1050}) or "")
    overlapping = desk.twice("enter-train", {**values, "rear_m": 300, "front_m": 500})
    assert overlapping == "the interval overlaps the interval of train 1"
    assert desk.twice("enter-train", values) is None
    assert desk.orders["release-train"]({"train": 9}, "anna") is not None  # silent: once more
    desk.now += 4.0
    assert desk.orders["release-train"]({"train": 9}, "anna") is None
    desk.report(1, 400.0)
    desk.centre.supervision.state = desk.state
    desk.steps(0.2)
    assert desk.state.trains[1].end_m <= 1000.0
    assert desk.orders["stop"]({"train": 9}) is None
    gone = {"train": 9, "reason": "lifted off"}
    assert "has not reported that it obeys" in (desk.twice("remove-train", gone) or "")  # its authority may be late
    desk.steps(61.0)
    assert desk.twice("remove-train", gone) is None
    assert 9 not in desk.state.trains
    assert desk.state.bars == {("West to Mid", OCCUPIED)}
    assert desk.orders["route"]({"train": 1}) is not None
    desk.steps(1.0)
    assert f"{HEAD} train 9" not in desk.store.documents(HEAD)
    assert desk.twice("free-section", {"section": "West to Mid"}) is None
    assert desk.state.bars == set()


def test_no_authority_into_a_section_of_vehicles_that_report_nothing(desk: Desk) -> None:
    """By hand, by its detection, and while that has not answered; a train that reports explains its detection."""
    supervision = desk.centre.supervision
    assert desk.orders["route"]({"train": 2}) is None
    assert desk.orders["occupy-section"]({"section": "Mid to East"}) is None
    desk.steps(0.5)
    assert desk.state.trains[2].end_m <= 3100.0
    assert supervision.set_route(2) is not None
    assert desk.orders["detect-section"]({"section": "Mid to East", "occupied": False}) is None
    desk.steps(1.2)
    assert desk.state.bars == set()
    assert desk.state.trains[2].end_m > 5000.0
    # train 2 may be in Mid to East: its detection needs no bar; that of West to Mid does
    for name in ("Mid to East", "West to Mid"):
        assert desk.orders["detect-section"]({"section": name, "occupied": True}) is None
    assert desk.state.bars == {("West to Mid", OCCUPIED)}
    assert desk.orders["detect-section"]({"section": "West to Mid", "occupied": None}) is None
    assert desk.state.bars == {("West to Mid", OCCUPIED), ("West to Mid", UNKNOWN)}
    assert desk.orders["detect-section"]({"section": "West to Mid", "occupied": False}) is None
    assert desk.state.bars == set()


def test_a_detection_that_falls_silent_leaves_its_section_unknown(desk: Desk) -> None:
    """One that repeats its answer keeps the section free; 10 s after the last answer nothing is granted into it."""
    desk.centre.supervision.answered_s["Mid to East"] = -math.inf
    desk.centre.supervision.set_section_detected("Mid to East", None)
    free = {"section": "Mid to East", "occupied": False}
    assert desk.orders["route"]({"train": 2}) == "Mid to East is unknown to its detection"
    for _ in range(4):
        assert desk.orders["detect-section"](free, "axle counter") is None
        desk.steps(8.0)
    assert desk.state.bars == set()
    assert sum("axle counter" in line for line in desk.centre.lines) == 1
    desk.steps(3.0)
    assert desk.state.bars == {("Mid to East", UNKNOWN)}
    assert desk.orders["route"]({"train": 2}) == "Mid to East is unknown to its detection"
    assert desk.orders["detect-section"](free, "axle counter") is None
    assert desk.orders["route"]({"train": 2}) is None


def test_no_authority_leaves_the_area(desk: Desk) -> None:
    """A train passes to another area by orders, where it stands: no route and no authority leads out of the last
    station, a place beyond it stops the train, and the track it is removed from stays occupied until it is seen free.
    """
    front_m = 5500.0
    values = {
        "train": 9, "length_m": 100, "rear_m": 5390, "front_m": front_m, "direction": 1, "track": 1, "reason": "enters",
    }  # fmt: skip
    assert desk.twice("enter-train", values) is None
    desk.report(9, front_m, length_cm=10_000)
    assert desk.orders["release-train"]({"train": 9}, "anna") is None
    desk.report(9, front_m, length_cm=10_000)
    desk.steps(2.0)
    assert desk.orders["route"]({"train": 9}) == "there is no station ahead"
    assert desk.state.trains[9].end_m <= LINE.stations[-1].end_m
    assert desk.twice("enter-train", {**values, "train": 10, "rear_m": 5590, "front_m": 5700}) is not None
    desk.report(9, 5640.0, length_cm=10_000)
    assert desk.state.trains[9].stop == "the position is not on the line: 5640 m"


def test_a_train_passes_to_another_centre_where_it_stands(desk: Desk, tmp_path: Path) -> None:
    """Removed here once it obeys an order to brake, it enters there, with its unit started for the other centre.

    What the first centre has sent, and still sends, counts for nothing then; its track stays occupied until it is seen
    free, and the second one grants nothing before it has released the train.
    """
    (tmp_path / "other").mkdir()
    other = Desk(tmp_path / "other", train(1, 400.0, 0), train(2, 2900.0, 1))
    other.now = desk.now
    unit = OnBoard(direction=1, end_m=2900.0, session=7)

    def report(at: Desk, number: int, front_m: float, unit: OnBoard) -> list[Authority]:
        at.sent.clear()
        unit.note_report(at.sequence + 1, at.now)
        unit.note_position(front_m + 5.0, 0.0)
        at.report(number, front_m, session=unit.session, **unit.acknowledgement())
        at.steps(1.0)
        for message in (mine := [message for message in at.sent if message.train == number]):
            unit.receive(message)
        return mine

    assert desk.orders["route"]({"train": 2}) is None
    for _ in range(3):
        late = report(desk, 2, 2900.0, unit)
        for name in LINE.points():
            desk.centre.supervision.set_detected(name, desk.state.points[name].wanted)
    assert unit.end_m > 5000.0
    assert desk.orders["stop"]({"train": 2}) is None
    gone = {"train": 2, "reason": "in the other area"}
    assert "has not reported that it obeys" in (desk.twice("remove-train", gone) or "")
    report(desk, 2, 2900.0, unit)
    report(desk, 2, 2900.0, unit)
    assert unit.order is not None
    assert desk.twice("remove-train", gone) is None
    assert {name for name, kind in desk.state.bars if kind == OCCUPIED} >= {"Mid track 1", "Mid to East"}
    assert desk.orders["route"]({"train": 1}) is not None
    there = {
        "train": 9, "length_m": 200, "rear_m": 5185, "front_m": 5405, "direction": 1, "track": 1, "reason": "enters",
    }  # fmt: skip
    unit = OnBoard(direction=1, end_m=5400.0, session=8)
    other.report(9, 5400.0, session=8)
    assert other.centre.rejected["of a train that is not supervised"] == 1
    assert other.twice("enter-train", there) is None
    report(other, 9, 5400.0, unit)
    assert unit.brake_reason(other.now) == "ordered to stop: entered by order"
    assert other.orders["release-train"]({"train": 9}, "anna") is None
    report(other, 9, 5400.0, unit)
    report(other, 9, 5400.0, unit)
    end_m = unit.end_m
    assert (unit.brake_reason(other.now), end_m) == (None, 5520.0)
    assert not any(unit.receive(message) for message in late)
    assert unit.end_m == end_m
    other.store.close()


def test_trains_are_divided_and_joined(desk: Desk) -> None:
    """80 m of train 2 go on in front; what stays behind is train 8, which never reports."""
    values = {"train": 2, "other": 8, "length_m": 80, "reason": "shunter"}
    assert "has not been ordered to stop" in (desk.twice("divide-train", values) or "")
    desk.report(2, 2900.0)
    assert desk.orders["stop"]({"train": 2}) is None
    assert desk.twice("divide-train", values) is None
    front, rear = desk.state.trains[2], desk.state.trains[8]
    whole = pieces_of(front, LINE) + pieces_of(rear, LINE)
    assert overlap([(3, 2700.0, 2900.0)], whole)
    assert (front.length_m, rear.length_m, rear.rear_m, rear.front_m) == (80.0, 120.0, 2690.0, 2825.0)
    assert front.rear_m == 2815.0  # 5 m of each bound are open
    desk.steps(0.2)
    assert desk.orders["release-train"]({"train": 2}) is None
    assert desk.state.trains[8].stop is not None
    desk.centre.supervision.state = desk.state
    for place in (2900.0, 2901.0):
        desk.report(2, place, length_cm=8_000)
        desk.steps(0.2)
    assert desk.state.trains[2].stop is None
    assert desk.orders["stop"]({"train": 2}) is None
    joined = {"train": 2, "other": 8, "reason": "coupled again"}
    assert "not behind" in (desk.twice("join-trains", {**joined, "train": 8, "other": 2}) or "")
    assert desk.twice("join-trains", joined) is None
    assert set(desk.state.trains) == {1, 2}
    assert (desk.state.trains[2].length_m, desk.state.trains[2].rear_m) == (200.0, 2690.0)
    assert desk.orders["release-train"]({"train": 2}) is None


def test_a_speed_restriction_is_in_every_authority_until_it_is_lifted_by_two_orders(desk: Desk) -> None:
    values = {"name": "km 0.4", "low_m": 350, "high_m": 550.5, "speed_mps": 5}
    assert desk.orders["restrict"]({**values, "high_m": 300}) is not None
    assert desk.orders["restrict"](values) is None
    assert "already" in (desk.orders["restrict"](values) or "")
    desk.steps(1.2)
    newest = {authority.train: authority.restrictions for authority in desk.sent[-2:]}
    assert newest == {1: ((35_000, 55_050, 500),), 2: ()}
    assert from_documents(to_documents(desk.state)) == desk.state
    assert desk.twice("restrict", {"name": "km 0.4", "lift": True}) is None
    desk.steps(1.2)
    assert {authority.restrictions for authority in desk.sent[-2:]} == {()}


def test_a_start_on_board_with_a_clock_an_hour_back_goes_on_with_a_word(desk: Desk) -> None:
    desk.report(1, 400.0, session=4)
    hour_ns = 3_600_000_000_000
    desk.now += 1.0
    time_ns = round((1e6 + desk.now) * 1e9) - hour_ns
    desk.sequence = 0
    desk.report(1, 401.0, session=5, time_ns=time_ns, sent_ns=time_ns)
    assert desk.state.trains[1].stop is None
    assert desk.state.trains[1].front_m == 406.0
    assert any("train 1: on-board unit restarted" in line for line in desk.centre.lines)
    desk.report(1, 402.0, session=5, sent_ns=time_ns - 2_000_000_000, time_ns=time_ns)
    assert "set the train's clock" in (desk.centre.snapshot()["trains"][0]["rejected"] or "")


def test_an_order_to_brake_from_before_the_start_stops_the_train(desk: Desk) -> None:
    """It was ordered while the database failed; the centre was killed, and does not know of it."""
    desk.steps(0.5)
    desk.report(1, 400.0, brake_order=3_000)
    assert desk.state.trains[1].stop == "the train obeys an order to brake from before this start"


def test_the_log_keeps_its_newest_lines(tmp_path: Path) -> None:
    with Store(f"sqlite:///{tmp_path / 'log.db'}", most_lines=1_000) as store:
        for k in range(300):
            for line in range(11):
                store.note(k, f"{k} {line}")
            store.save()
        kept = store.log(last=10_000)
    assert 1_000 <= len(kept) <= 1_010 + 11
    assert kept[-1][2] == "299 10"


def test_numbers_of_a_start_are_above_those_of_every_earlier_one_that_an_older_copy_does_not_know(desk: Desk) -> None:
    """Two starts with the same copy a second apart: an authority of the first one is late for a train of the second."""
    supervision = desk.centre.supervision
    copy = supervision.state
    supervision.begin_again(desk.now, wall_us=1_000_000_000)
    sent = supervision.state.granted + 1000
    supervision.state = copy
    supervision.begin_again(desk.now, wall_us=1_001_000_000)
    assert supervision.state.granted > sent
    supervision.begin_again(desk.now, wall_us=0)  # the clock has been set back
    assert supervision.state.granted > 1_001_000_000
