"""Intervals, authorities, routes and points: no overlap in seeded traffic, and each rule is needed."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import fields, replace
from typing import Any

import cbor2
import pytest

from attacked_line import AttackedLine, run_sequence
from changed_line import ChangedLine
from disturbed_traffic import Conditions, traffic
from ground_rules import take_out
from network_made import made_network
from railfix.core.errors import MismatchError, SettingsError
from railfix.ground.authority import Authority, BrakeOrder
from railfix.ground.interlocking import (
    NearbyTrains,
    extend_authorities,
    points_reported,
    release_points,
    route_requested,
    stop_orders,
)
from railfix.ground.layout import Layout, LoopStation, derive_layout, overlap
from railfix.ground.on_board import OnBoard, OnBoardLimits
from railfix.ground.reports import report_received
from railfix.ground.state import (
    Interlocking,
    InterlockingLimits,
    PointState,
    TrainInterval,
    from_documents,
    stop_trains,
    to_documents,
)
from railfix.ground.stops import CLOSED, close_section, open_section, overlaps_stopped, release_train
from railfix.ground.supervision import Supervision
from railfix.ground.traffic import line_with_loops
from railfix.io.train_message import MessageError, MessageStatus, TrainMessage

pytestmark = [pytest.mark.requirement("F4"), pytest.mark.requirement("F5")]

#: A 0 to 400 m, B 2000 to 2400 m; points of 50 m, tracks 50 to 350 m and 2050 to 2350 m.
LAYOUT = Layout(
    stations=(
        LoopStation(name="A", begin_m=0.0, end_m=400.0, points_m=50.0),
        LoopStation(name="B", begin_m=2000.0, end_m=2400.0, points_m=50.0),
    )
)
LIMITS = InterlockingLimits(margin_m=20.0, release_s=3.0)


def interval(train: int, direction: int, front: float, track: int, station: int) -> TrainInterval:
    return TrainInterval(
        train=train, direction=direction, rear_m=front - direction * 110.0, front_m=front + direction * 5.0,
        end_m=front + direction * 5.0, sequence=0, tracks={station: track}, station=station, length_m=100.0,
        measured_ns=0,
    )  # fmt: skip


def message(train: int, sequence: int, front_m: float, facing: int = 1, **changes: Any) -> TrainMessage:
    time_ns = sequence * 10_000_000_000
    whole = TrainMessage(
        train=train, sequence=sequence, time_ns=time_ns, sent_ns=time_ns, line=1, chainage_cm=round(front_m * 100),
        over_cm=1000, under_cm=500, facing=facing, standstill=True, status=MessageStatus.POSITION, length_cm=10_000,
        complete=True,
    )  # fmt: skip
    return whole.replaced(**changes) if changes else whole


def twice(state: Interlocking, whole: TrainMessage) -> Interlocking:
    """The state after a report and one more that confirms it."""
    state = report_received(state, whole, LAYOUT)
    return report_received(state, whole.replaced(sequence=whole.sequence + 1), LAYOUT)


@pytest.fixture
def state() -> Interlocking:
    """Train 1 up in A on track 1, train 2 down in B on track 2."""
    trains = {1: interval(1, 1, 330.0, 1, 0), 2: interval(2, -1, 2070.0, 2, 1)}
    return Interlocking(trains=trains, points={name: PointState() for name in LAYOUT.points()})


@pytest.mark.requirement("F4")
@pytest.mark.parametrize("bound", ["over_cm", "under_cm"])
def test_a_report_without_a_bound_moves_nothing(state: Interlocking, bound: str) -> None:
    whole = message(1, 1, 340.0)
    assert report_received(state, whole, LAYOUT) != state
    assert report_received(state, whole.model_copy(update={bound: 0}), LAYOUT) != state
    assert report_received(state, whole.model_copy(update={bound: None}), LAYOUT) == state


def test_pieces_of_an_interval() -> None:
    assert LAYOUT.pieces(300.0, 2100.0, {0: 2, 1: 1}) == [(2, 300.0, 350.0), (0, 350.0, 2050.0), (3, 2050.0, 2100.0)]
    assert LAYOUT.pieces(2100.0, 300.0, {0: 2}) == LAYOUT.pieces(300.0, 2100.0, {0: 2})
    assert LAYOUT.pieces(-20.0, 60.0, {}) == [(0, -20.0, 50.0), (1, 50.0, 60.0)]
    assert not overlap(LAYOUT.pieces(100.0, 300.0, {0: 1}), LAYOUT.pieces(100.0, 300.0, {0: 2}))
    assert overlap(LAYOUT.pieces(100.0, 360.0, {0: 1}), LAYOUT.pieces(351.0, 500.0, {0: 2}))


def test_a_route_by_hand(state: Interlocking, monkeypatch: pytest.MonkeyPatch) -> None:
    """Train 1 from A to track 1 of B: no points have to move; the authority ends 20 m before the end of track 1."""
    routed, moved, reason = route_requested(state, 1, LAYOUT)
    assert (moved, reason) == ((), None)
    assert extend_authorities(routed, LAYOUT, limits=LIMITS).trains[1].end_m == pytest.approx(2350.0 - 20.0)
    # now train 2 may neither have the section nor, without that rule, the points
    assert route_requested(routed, 2, LAYOUT)[2] == "train 1 comes from the opposite direction"
    assert route_requested(replace(state, stopped=True), 1, LAYOUT)[2] == "satellite positioning is suspended"
    take_out(monkeypatch, "direction")
    assert "locked" in (route_requested(routed, 2, LAYOUT)[2] or "")


def test_an_authority_ends_before_points_until_they_are_detected(
    state: Interlocking, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Train 2 leaves track 2: both points move, then the authority passes them."""
    routed, moved, reason = route_requested(state, 2, LAYOUT)
    assert (set(moved), reason) == ({(1, -1), (0, 1)}, None)
    assert extend_authorities(routed, LAYOUT, limits=LIMITS).trains[2].end_m == 2065.0  # 2050 + 20 m is no extension
    near = extend_authorities(points_reported(routed, (1, -1), 2, LAYOUT), LAYOUT, limits=LIMITS)
    assert near.trains[2].end_m == pytest.approx(400.0 + 20.0)
    through = extend_authorities(points_reported(near, (0, 1), 2, LAYOUT), LAYOUT, limits=LIMITS)
    assert through.trains[2].end_m == pytest.approx(50.0 + 20.0)
    take_out(monkeypatch, "points detected")
    assert extend_authorities(routed, LAYOUT, limits=LIMITS).trains[2].end_m == pytest.approx(50.0 + 20.0)


def test_a_follower_ends_before_the_safe_rear_of_the_train_ahead(state: Interlocking) -> None:
    ahead = replace(interval(3, 1, 1500.0, 1, 0), tracks={0: 1, 1: 1}, station=1)
    state = replace(state, trains={1: state.trains[1], 3: ahead})
    routed, _, reason = route_requested(state, 1, LAYOUT)
    assert "reserved by train 3" in (reason or "")  # it has no route onwards yet
    follower = replace(state.trains[1], tracks={0: 1, 1: 1}, station=1)
    points = {name: PointState(locked={1: None, 3: None}) for name in LAYOUT.points()}
    both = replace(routed, trains={1: follower, 3: ahead}, points=points)
    assert extend_authorities(both, LAYOUT, limits=LIMITS).trains[1].end_m == pytest.approx(1390.0 - 20.0)
    both = replace(both, trains={1: follower, 3: replace(ahead, end_m=1800.0)})
    later = twice(both, message(3, 1, 1600.0))
    assert later.trains[3].rear_m == pytest.approx(1600.0 - 110.0)
    assert extend_authorities(later, LAYOUT, limits=LIMITS).trains[1].end_m == pytest.approx(1490.0 - 20.0)


def test_points_are_released_after_the_rear_end_and_the_time(state: Interlocking) -> None:
    routed, _, _ = route_requested(state, 1, LAYOUT)
    assert 1 in release_points(routed, 10.0, LAYOUT, limits=LIMITS).points[0, 1].locked
    granted = extend_authorities(routed, LAYOUT, limits=LIMITS)
    passed = twice(granted, message(1, 1, 520.0))  # safe rear 410 m, points end at 400 m
    waiting = release_points(passed, 20.0, LAYOUT, limits=LIMITS)
    assert 1 in release_points(waiting, 22.9, LAYOUT, limits=LIMITS).points[0, 1].locked
    done = release_points(waiting, 23.0, LAYOUT, limits=LIMITS)
    assert done.points[0, 1].locked == {}
    assert 1 in done.points[1, -1].locked


def test_reports_that_change_nothing(state: Interlocking) -> None:
    state = report_received(state, message(1, 5, 335.0), LAYOUT)
    assert report_received(state, message(1, 5, 340.0), LAYOUT) == state
    assert report_received(state, message(1, 4, 340.0), LAYOUT) == state
    assert report_received(state, message(9, 9, 340.0), LAYOUT) == state
    lost = TrainMessage(train=1, sequence=9, time_ns=1, sent_ns=1, line=1)
    assert report_received(state, lost, LAYOUT) == state
    # changed ends: only inside the station
    assert report_received(state, message(1, 6, 345.0, facing=-1), LAYOUT).trains[1].direction == 1
    turned = report_received(state, message(1, 6, 230.0, facing=-1), LAYOUT).trains[1]
    assert (turned.direction, turned.interval_m) == (-1, (340.0, 220.0))


def test_an_interval_reaches_to_the_front_where_that_is_beyond_the_authority() -> None:
    train = interval(1, 1, 330.0, 1, 0)
    assert replace(train, end_m=300.0).interval_m == (220.0, 335.0)
    assert replace(train, end_m=360.0).interval_m == (220.0, 360.0)
    down = interval(1, -1, 330.0, 1, 0)
    assert replace(down, end_m=360.0).interval_m == (440.0, 325.0)
    assert replace(down, end_m=300.0).interval_m == (440.0, 300.0)


def test_stored_text_gives_the_same_state(state: Interlocking) -> None:
    routed, _, _ = route_requested(state, 2, LAYOUT)
    assert from_documents(to_documents(routed)) == routed


def violations(seeds: range, steps: int) -> tuple[Counter[str], int]:
    counted: Counter[str] = Counter()
    routes = 0
    for seed in seeds:
        run = traffic(seed)
        for _ in range(steps):
            run.step()
            if run.violations:
                break
        counted += run.violations
        routes += run.centre.routes_set
    return counted, routes


@pytest.mark.parametrize(
    ("seeds", "steps"),
    [(range(4), 250), pytest.param(range(1000), 600, marks=pytest.mark.slow)],
    ids=["4 runs", "1000 runs"],
)
def test_no_overlap_in_traffic_of_eight_trains(seeds: range, steps: int) -> None:
    """Loss 30 %, delays to 8 s, outages, stops of the centre, sensor failures."""
    counted, routes = violations(seeds, steps)
    assert counted == Counter()
    assert routes > 8 * len(seeds)


@pytest.mark.parametrize(
    ("rule", "seed", "kind"),
    [
        ("train ahead", 1, "intervals overlap"),
        ("safe rear", 0, "train outside its interval"),
        ("sequence", 1, "intervals overlap"),
        ("points locked", 0, "points moved under a train"),
        ("persistence", 1, "train outside its interval"),
        ("supervision", 0, "train outside its interval"),
        ("freshness", 0, "runs without a fresh authority"),
    ],
)
def test_without_a_rule_the_traffic_breaks_an_invariant(
    rule: str, seed: int, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    take_out(monkeypatch, rule)
    counted, _ = violations(range(seed, seed + 1), 300)
    assert counted[kind] > 0


def test_the_direction_of_a_section_is_a_second_defence_behind_the_points(monkeypatch: pytest.MonkeyPatch) -> None:
    """Opposing trains use different tracks at both ends, so locked points already keep one of them out."""
    with monkeypatch.context() as patch:
        take_out(patch, "direction")
        assert violations(range(3), 150)[0] == Counter()
    take_out(monkeypatch, "direction", "points locked")
    counted, _ = violations(range(1, 2), 150)
    assert counted["trains overlap"] > 0


def test_trains_stop_within_the_time_limit_of_authorities_although_their_links_fail(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A stop is ordered while links are out: with the time limit every train rests soon, without it one runs on."""
    found = []
    for rules in ((), ("freshness",)):
        take_out(monkeypatch, *rules)
        run = traffic(3, conditions=Conditions(outage=0.01, suspension=0.01))
        for _ in range(400):
            run.step()
        found.append(run.violations)
    assert found[0] == Counter()
    assert found[1]["runs after a stop was ordered"] > 0


def authority(number: int, *, report: int = 0, end_m: float = 500.0, direction: int = 1) -> Authority:
    return Authority(
        train=7, number=number, report=report, end_cm=round(end_m * 100), direction=direction, stopped=False
    )


def test_the_age_of_an_authority_is_that_of_the_report_it_answers() -> None:
    train = OnBoard(direction=1, end_m=100.0, limits=OnBoardLimits(fresh_s=10.0))
    assert train.brake_reason(0.0) == "no fresh authority"
    train.note_report(1, 50.0)
    train.note_report(2, 51.0)
    assert train.receive(authority(1, report=1))
    assert (train.age_s(55.0), train.end_m) == (5.0, 500.0)
    assert train.brake_reason(60.0) is None
    assert train.brake_reason(60.1) == "no fresh authority"
    # delivered late by the link: as old as its report, not as its arrival
    assert train.receive(authority(2, report=2))
    assert train.brake_reason(61.1) == "no fresh authority"
    # a centre that hears nothing repeats its authority in vain
    train.note_report(3, 62.0)
    assert train.receive(authority(3, report=2))
    assert train.brake_reason(62.0) == "no fresh authority"
    assert not train.receive(authority(3, report=3))  # repeated
    assert not train.receive(authority(4, report=3, direction=-1))
    assert train.brake_reason(62.0) == "no fresh authority"
    assert train.receive(authority(4, report=3, end_m=300.0))
    assert (train.brake_reason(62.0), train.end_m) == (None, 500.0)  # never shortened


def test_an_authority_that_lapsed_on_the_way_is_not_taken() -> None:
    """A unit that reports every second takes none whose report was sent more than 45 s before the newest."""
    train = OnBoard(direction=1, end_m=100.0)
    for second in range(46):
        train.note_report(second + 1, float(second))
    assert train.receive(authority(1, report=1))
    train.note_report(47, 46.0)
    assert not train.receive(authority(2, report=1, end_m=900.0))
    for second in range(46, 700):
        train.note_report(second + 1, float(second))
    assert not train.receive(authority(3, report=20, end_m=900.0))  # so old that it is forgotten
    assert (train.end_m, train.number) == (500.0, 1)


def test_bytes_of_an_authority() -> None:
    data = authority(9, report=3, end_m=-12.34, direction=-1).encode()
    assert Authority.decode(data) == authority(9, report=3, end_m=-12.34, direction=-1)
    order = BrakeOrder(**authority(9).model_dump(), reason="A is closed")
    assert Authority.decode(order.encode()) == order
    assert (type(Authority.decode(order.encode())), type(Authority.decode(data))) == (BrakeOrder, Authority)
    another = data[:2] + b"\x02" + data[3:]  # version 2
    number = cbor2.dumps([1, 3, *(authority(9).model_dump() | {"stopped": 1}).values()], canonical=True)
    for wrong in (data[:-1], data + b"x", another, number, b"", b"\xff", order.encode()[:-1], cbor2.dumps({1: 3})):
        with pytest.raises(MessageError):
            Authority.decode(wrong)


def test_layout_of_a_network_map() -> None:
    """Three units of 2 km: 440 m of single line, two tracks of 1120 m 3.6 m apart, 440 m; the second is on the left."""
    network = made_network(9.0)
    found = derive_layout(network)
    assert [s.name for s in found.stations] == ["02", "12", "22"]
    for k, station in enumerate(found.stations):
        # along the track aside, 0.24 m longer in each station
        assert station.begin_m == pytest.approx(2000.0 * k + 440.0 + 0.24 * k, abs=0.1)
        assert station.end_m == pytest.approx(2000.0 * k + 1560.0 + 0.24 * (k + 1), abs=0.1)
        # points of the map are 20 m apart: 2.67 m aside at 40 m, 3.6 m at 60 m, so 3.5 m at 57.8 m; steps of 2 m
        assert 57.8 <= station.points_m <= 57.8 + 2.0 + 1.0
    right = derive_layout(network, drive="right")
    assert [s.name for s in right.stations] == ["01", "11", "21"]
    # the files' order and directions do not matter
    turned = replace(
        network,
        tracks=tuple(track.reverse() for track in network.tracks),
        links=tuple(
            replace(link, first_end=1 - link.first_end, second_end=1 - link.second_end) for link in network.links
        ),
    )
    assert [s.points_m for s in derive_layout(turned).stations] == [s.points_m for s in found.stations]
    assert derive_layout(turned).stations[0].name in ("02", "21")


def test_networks_that_are_no_single_line_are_refused() -> None:
    network = made_network(9.0)
    with pytest.raises(MismatchError, match="passing loops; the interlocking needs two"):
        derive_layout(made_network(3.0))
    with pytest.raises(MismatchError, match="4 open ends"):
        derive_layout(made_network(6.0, line_km=2.0))
    without_one = replace(network, links=tuple(link for link in network.links if 2 not in (link.first, link.second)))
    with pytest.raises(MismatchError, match="open ends"):
        derive_layout(without_one)


def test_a_route_over_the_layout_of_a_network() -> None:
    run = traffic(1, trains=3, layout=derive_layout(made_network(9.0)))
    for _ in range(600):
        run.step()
    assert run.violations == Counter()
    assert run.centre.routes_set > 2


def test_trains_nearby_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step that looks at the trains nearby ends as one that looks at every train, over 200 s of disturbed traffic."""

    def course() -> list[Interlocking]:
        run, states = traffic(3, trains=10, layout=line_with_loops(8)), []
        for _ in range(200):
            run.step()
            states.append(run.centre.state)
        return states

    nearby = course()
    assert any(train.stop is None and train.end_m > 0.0 for train in nearby[-1].trains.values())
    monkeypatch.setattr(NearbyTrains, "between", lambda _self, state, _low, _high: iter(state.trains.values()))
    assert course() == nearby


@pytest.mark.parametrize("kind", [AttackedLine, ChangedLine])
def test_trains_that_are_as_before_need_no_second_comparison(
    kind: type[AttackedLine], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each step stops the trains that a comparison of all trains with each other stops, located anew."""
    stopped = 0

    def compared(state: Interlocking, layout: Layout, **known: Any) -> Interlocking:
        nonlocal stopped
        found, anew = overlaps_stopped(state, layout, **known), NearbyTrains(state, layout)
        assert found == overlaps_stopped(state, layout)
        for low, high in (station.inner_m for station in layout.stations):
            assert [*known["nearby"].between(state, low, high)] == [*anew.between(state, low, high)]
            assert [*known["nearby"].between(state, high + 100.0, high + 101.0)] == [
                *anew.between(state, high + 100.0, high + 101.0)
            ]
        stopped += found is not state
        return found

    monkeypatch.setattr("railfix.ground.supervision.overlaps_stopped", compared)
    for seed in range(6):
        run_sequence(seed, steps=100, kind=kind)
    assert stopped


def test_a_changed_train_is_as_a_replaced_one() -> None:
    """Whatever changes, computed ends follow, and an unknown name is an error."""
    train = interval(1, 1, 300.0, 1, 0)
    assert train.span_m == (190.0, 305.0)
    other: dict[str, Any] = {"direction": -1, "rear_m": 200.0, "front_m": 400.0, "end_m": 500.0, "stop": "by hand"}
    for field in fields(TrainInterval):
        value = {field.name: other.get(field.name)}
        found, expected = train.changed(**value), replace(train, **value)
        assert found == expected
        if value[field.name] is not None:
            assert (found.interval_m, found.span_m) == (expected.interval_m, expected.span_m)
    with pytest.raises(TypeError, match="no fields of these names: ende_m"):
        train.changed(ende_m=1.0)


def neighbours_of_stopped(state: Interlocking) -> set[int]:
    """Trains ordered to stop, train by train."""
    found = {number for number, train in state.trains.items() if train.stop is not None}
    for number in set(found):
        low, high = state.trains[number].span_m
        others = [(n, *train.span_m) for n, train in state.trains.items() if n != number]
        above = min((first for _, first, _ in others if first >= high), default=None)
        below = max((last for _, _, last in others if last <= low), default=None)
        upper = max((last for _, first, last in others if first == above), default=high)
        lower = min((first for _, first, last in others if last == below), default=low)
        found |= {n for n, first, last in others if first <= upper and last >= lower}
    return found


def test_neighbours_of_stopped_trains() -> None:
    run, rng, kinds = traffic(5, trains=12, layout=line_with_loops(8)), random.Random(2), set()
    for _ in range(300):
        run.step()
        stopped = stop_trains(run.centre.state, rng.sample(sorted(run.trains), rng.randint(0, 4)), "by hand")
        assert set(stop_orders(stopped)) == neighbours_of_stopped(stopped)
        kinds.add(len(stop_orders(stopped)))
    assert len(kinds) > 4


def closed_course(seed: int) -> tuple[int, int]:
    """Extensions into a closed section in 500 s in which sections are closed and opened, and trains that it stopped."""
    run, rng = traffic(seed, trains=6, layout=line_with_loops(6)), random.Random(seed)
    layout, into, stopped = run.layout, 0, set()
    for _ in range(500):
        if rng.random() < 0.05:
            closed = sorted(name for name, _ in run.centre.state.bars)
            if closed:
                run.centre.state = open_section(run.centre.state, closed[0])
                for number in run.trains:
                    run.centre.state, _ = release_train(run.centre.state, number, layout)
            else:
                section = rng.choice(sorted(layout.sections))
                run.centre.state = close_section(run.centre.state, section, layout, "closed")
        before = run.centre.state
        run.step()
        for number, train in run.centre.state.trains.items():
            stopped |= {number} if train.stop == "closed" else set()
            old = before.trains[number]
            grows = train.direction == old.direction and train.direction * (train.end_m - old.end_m) > 0.0
            path = layout.pieces(old.end_m, train.end_m, train.tracks)
            for name, _ in before.bars if grows else ():
                into += overlap(layout.sections[name], path)
    assert not run.violations
    return into, len(stopped)


@pytest.mark.slow
def test_no_authority_is_extended_into_a_closed_section(monkeypatch: pytest.MonkeyPatch) -> None:
    courses = [closed_course(seed) for seed in range(4)]
    assert [into for into, _ in courses] == [0, 0, 0, 0]
    assert sum(stopped for _, stopped in courses) > 5
    take_out(monkeypatch, "closed")
    assert any(closed_course(seed)[0] for seed in range(4))


def test_a_closed_section_stops_its_trains_until_it_is_open() -> None:
    """Train 1 in A with an authority up to 340 m; the section A to B is closed, then A itself."""
    state = Interlocking(
        trains={1: interval(1, 1, 300.0, 1, 0)}, points={name: PointState() for name in LAYOUT.points()}
    )
    assert list(LAYOUT.sections) == [
        "A", "A track 1", "A track 2", "B", "B track 1", "B track 2", "A to B",
    ]  # fmt: skip
    assert [LAYOUT.section_m(name) for name in ("A", "A to B", "B")] == [(0, 400), (400, 2000), (2000, 2400)]
    assert LAYOUT.sections["B track 2"] == ((4, 2050.0, 2350.0),)
    between = close_section(state, "A to B", LAYOUT, "A to B is closed")
    assert between.trains[1].stop is None
    assert route_requested(between, 1, LAYOUT)[2] == "A to B is closed"
    aside = close_section(state, "A track 2", LAYOUT, "it is closed")
    assert (aside.trains[1].stop, route_requested(aside, 1, LAYOUT)[2]) == (None, None)
    both = close_section(between, "A", LAYOUT, "A is closed")
    assert both.trains[1].stop == "A is closed"
    assert both.bars == {("A", CLOSED), ("A to B", CLOSED)}
    assert from_documents(to_documents(both)) == both
    assert release_train(both, 1, LAYOUT)[1] == "section A, where train 1 is or may run, is closed"
    opened = open_section(both, "A")
    free, reason = release_train(opened, 1, LAYOUT)
    assert reason is None
    assert route_requested(open_section(free, "A to B"), 1, LAYOUT)[2] is None


@pytest.mark.slow
def test_routes_are_taken_back_in_disturbed_traffic() -> None:
    """Asked at random under loss, delays and restarts: no invariant breaks, some trains agree and some do not."""
    answers: Counter[bool] = Counter()
    for seed in range(6):
        run, rng = traffic(seed), random.Random(seed)
        for _ in range(600):
            number = rng.choice(sorted(run.trains))
            if rng.random() < 0.2:
                run.centre.ask_route_back(number)
            elif rng.random() < 0.1:
                run.centre.set_route(number)
            before = run.centre.state
            run.step()
            for train in run.centre.state.trains.values():
                old = before.trains[train.train]
                if old.asked_m is not None and train.asked_m is None and train.direction == old.direction:
                    answers[train.held] += 1
        assert not run.violations
    assert answers[True] > 10
    assert answers[False] > 2


def test_a_stopped_train_gives_no_route_back() -> None:
    """Its answer may stand in the report that contradicts what is known of it; it counts after the release."""
    state = Interlocking(
        trains={1: interval(1, 1, 300.0, 1, 0)}, points={name: PointState() for name in LAYOUT.points()}
    )
    centre = Supervision(layout=LAYOUT, state=state, limits=LIMITS)
    assert centre.set_route(1) is None
    centre.advance(0.0)
    assert centre.ask_route_back(1) is None
    (asked,) = centre.advance(1.0)
    agreed = {"authority": asked.number, "authority_end_cm": asked.end_cm}
    assert centre.report(message(1, 1, 300.0, length_cm=0, **agreed), 2.0) is None
    assert centre.state.trains[1].stop == "the report has no train length"
    assert (centre.state.trains[1].station, centre.state.trains[1].end_m) == (1, 2330.0)
    centre.state, reason = release_train(centre.state, 1, LAYOUT)
    assert reason is None
    assert centre.report(message(1, 2, 300.0, **agreed), 12.0) is None
    assert (centre.state.trains[1].station, centre.state.trains[1].end_m) == (0, 330.0)


def test_names_of_stations_are_different() -> None:
    """Sections are closed by them."""
    with pytest.raises(SettingsError, match="two stations have the same name"):
        Layout(stations=tuple(LoopStation(name="A", begin_m=m, end_m=m + 400.0) for m in (0.0, 2000.0)))
