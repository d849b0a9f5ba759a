"""Reports, authorities and releases that once led a train into another: each by hand, with its rule and without."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from ground_rules import take_out
from railfix.ground.authority import Authority
from railfix.ground.interlocking import extend_authorities, route_requested
from railfix.ground.layout import Layout, LoopStation
from railfix.ground.on_board import OnBoard
from railfix.ground.reports import report_received
from railfix.ground.state import Interlocking, PointState, TrainInterval, stop_trains
from railfix.ground.stops import release_train
from railfix.ground.supervision import Supervision, at_start, standing_train
from test_ground_attacks import LENGTH_M, LIMITS, after, report
from test_ground_attacks import LINE as TWO
from test_ground_attacks import state as state

pytestmark = pytest.mark.requirement("F4", "F6")

#: A 0 to 400 m, B 2000 to 2400 m, C 4000 to 4400 m; tracks from 60 m after each begin.
LINE = Layout(
    stations=tuple(LoopStation(name="ABC"[k], begin_m=2000.0 * k, end_m=2000.0 * k + 400.0) for k in range(3))
)


def down_train(number: int, front_m: float, station: int, **changes: Any) -> TrainInterval:
    train = standing_train(
        number, direction=-1, front_m=front_m, length_m=LENGTH_M, bound_m=5.0, station=station, track=2
    )
    return replace(train, measured_ns=0, **changes)


def test_a_clock_set_forward_makes_no_way_possible(state: Interlocking, monkeypatch: pytest.MonkeyPatch) -> None:
    """The signals of a spoofer have another time and another place: 1,900 m on, an hour later."""

    def rear_m() -> float:
        centre = Supervision(layout=TWO, state=replace(state, trains={
            **state.trains, 1: replace(state.trains[1], end_m=5900.0)}))  # fmt: skip
        for k, place, hours in ((1, 3000.0, 0), (2, 4900.0, 1), (3, 4900.0, 1)):
            time_ns = (3600 * hours + k) * 1_000_000_000
            centre.report(report(k, place, time_ns=time_ns, sent_ns=time_ns), float(k))
        assert rule_out or "the train has moved" in (centre.state.trains[1].stop or "")
        return centre.state.trains[1].rear_m

    rule_out = False
    assert rear_m() == 2795.0
    rule_out = True
    take_out(monkeypatch, "clock")
    assert rear_m() == 4900.0 - 205.0


def test_a_roll_back_counts_whatever_the_clock_of_the_report(
    state: Interlocking, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A report was an hour ahead: those after it are older, and say that the train has rolled back by 300 m."""
    hour, standing = 3_600_000_000_000, {"speed_cmps": 0, "standstill": True}
    ahead = report(1, 3000.0, time_ns=hour, sent_ns=hour, **standing)
    back = [report(k, 2700.0, **standing) for k in (2, 3, 4)]
    found = after(state, ahead, back[0])
    assert found.trains[1].stop == "the position is older than in the previous report"
    assert found.trains[1].rear_m == 2495.0
    released, reason = release_train(found, 1, TWO)
    assert reason is None
    assert after(released, *back[1:]).trains[1].stop is None  # its clock counts again
    take_out(monkeypatch, "place covered")
    assert after(state, ahead, back[0]).trains[1].rear_m == 2795.0


def test_reports_that_were_late_are_no_clock_set_forward(state: Interlocking) -> None:
    """Two reports come 8 s late, those after them at once; 40 m/s all the time."""
    centre = Supervision(layout=TWO, state=state)
    for k, late_s in ((1, 0.0), (2, 8.0), (3, 7.0), (12, 0.0), (13, 0.0)):
        centre.report(report(k, 3000.0 + 40.0 * k), k + late_s)
    assert centre.state.trains[1].stop is None
    assert centre.state.trains[1].front_m == 3525.0


def test_a_train_that_creeps_beyond_its_authority_is_stopped(
    state: Interlocking, monkeypatch: pytest.MonkeyPatch
) -> None:
    """9 m a report, less than its bounds: its own safe front was once taken for the end."""
    state = replace(state, trains={**state.trains, 1: replace(state.trains[1], end_m=3005.0)})
    creeping = [report(k, 3000.0 + 9.0 * k, speed_cmps=900) for k in range(1, 9)]
    found = after(state, *creeping, report(9, 3072.0, speed_cmps=0, standstill=True))
    assert found.trains[1].stop == "the train is beyond its authority"
    released, reason = release_train(found, 1, TWO)
    assert (reason, released.trains[1].end_m) == (None, 3077.0)
    assert after(released, report(10, 3072.0, speed_cmps=0, standstill=True)).trains[1].stop is None
    take_out(monkeypatch, "creep")
    assert after(state, *creeping).trains[1].stop is None


def test_a_wrong_change_of_ends_in_the_next_station_frees_no_track(monkeypatch: pytest.MonkeyPatch) -> None:
    """Train 1 stands in B on track 2 with an authority to A; one report has it in A, looking back."""
    trains = [down_train(1, 2100.0, 0, end_m=80.0, tracks={0: 2, 1: 2, 2: 2}), down_train(2, 4100.0, 2)]
    state = at_start(LINE, trains)
    wrong = report(1, 300.0, facing=1, direction=0, speed_cmps=0, standstill=True)

    def reason() -> str | None:
        turned = report_received(state, wrong, LINE, limits=LIMITS)
        assert (turned.trains[1].direction, turned.trains[1].stop, turned.trains[1].span_m) == (1, None, (95.0, 2305.0))
        return route_requested(turned, 2, LINE)[2]

    assert reason() == "track 2 of B is occupied or reserved by train 1"
    take_out(monkeypatch, "tracks kept")
    assert reason() is None


def test_a_wrong_change_of_ends_in_the_next_station_sets_no_other_track(monkeypatch: pytest.MonkeyPatch) -> None:
    """Train 1 stands in B on track 2; one report has it in A, looking back to B, whose track up is 1."""
    state = at_start(LINE, [down_train(1, 2100.0, 0, end_m=80.0, tracks={0: 2, 1: 2})])
    wrong = report(1, 300.0, facing=1, direction=0, speed_cmps=0, standstill=True)
    turned = report_received(state, wrong, LINE, limits=LIMITS)
    assert (turned.trains[1].direction, turned.trains[1].front_m, turned.trains[1].station) == (1, 2305.0, 0)
    seen = replace(turned, trains={1: replace(turned.trains[1], rear_m=2095.0, reported_m=(2095.0, 2305.0))})
    assert route_requested(seen, 1, LINE)[2] == "the train is in B"
    released, reason = release_train(stop_trains(seen, [1], "by hand"), 1, LINE)
    assert (reason, released.trains[1].station, released.trains[1].tracks[1]) == (None, 1, 2)
    take_out(monkeypatch, "station reached")
    assert route_requested(seen, 1, LINE)[0].trains[1].tracks[1] == 1


@pytest.mark.parametrize(
    ("changes", "reason", "furthest_m"),
    [
        ({"facing": -1, "direction": 1}, "the train has changed ends while running", 4000.0),
        (
            {"facing": -1, "direction": 0, "standstill": True, "speed_cmps": 0, "chainage_cm": 420_000},
            "the train has changed ends and is beyond its interval",
            4300.0,  # 4405 m are further than it can have got
        ),
        (
            {"authority": 8, "authority_end_cm": 300_000},
            "has authority 8, but the newest in the centre's database is 7",
            4000.0,
        ),
        (
            {"authority": 7, "authority_end_cm": 410_000},
            "an authority that ends beyond its interval, at 4100 m",
            4100.0,
        ),
    ],
)
def test_more_contradictions(state: Interlocking, changes: dict[str, Any], reason: str, furthest_m: float) -> None:
    """The last two: an authority that the centre does not know of, as its database is an older one."""
    found = after(replace(state, granted=7), report(1, 3010.0, **changes)).trains[1]
    assert reason in (found.stop or "")
    assert found.span_m == (2795.0, furthest_m)


def test_a_train_that_runs_by_its_newest_report_is_not_released(state: Interlocking) -> None:
    """It stood; the report that is contradicted says that it runs."""
    found = after(state, report(1, 3000.0, speed_cmps=0, standstill=True), report(2, 2900.0, direction=-1))
    assert release_train(found, 1, TWO)[1] == "train 1 is not at rest"


def test_a_detection_from_before_the_last_command_counts_for_nothing() -> None:
    """Commanded to track 2 while they still report track 1; they lose their detection under a route later."""
    centre = Supervision(layout=LINE, state=at_start(LINE, [down_train(1, 2100.0, 1)]))
    assert centre.set_route(1) is None
    for now_s, detected, end_m in ((0.0, (1, 1), 2080.0), (2.0, (2, 1), 420.0), (4.0, (2, 2), 80.0)):
        for point, track in zip(((1, -1), (0, 1)), detected, strict=True):
            centre.set_detected(point, track)
        centre.advance(now_s)
        assert centre.state.trains[1].end_m == end_m
        assert centre.state.trains[1].stop is None
    centre.set_detected((0, 1), None)
    assert centre.state.trains[1].stop == "points of its route have lost their detection"


def test_points_that_are_on_their_way_are_detected_nowhere() -> None:
    """Commanded to track 2, wanted on track 1 before they have answered: commanded again once they are there."""
    commands: list[tuple[Any, int]] = []
    centre = Supervision(layout=LINE, state=at_start(LINE, [down_train(1, 2100.0, 1)]), routes="by hand")
    centre.command = lambda point, track: commands.append((point, track))
    assert centre.set_route(1) is None
    centre.advance(0.0)
    assert commands == [((0, 1), 2), ((1, -1), 2)]
    assert {centre.state.points[point].detected for point, _ in commands} == {None}
    points = {name: replace(point, wanted=1, commanded=False, locked={}) for name, point in centre.state.points.items()}
    centre.state = replace(centre.state, points=points)
    centre.command_points(centre.state)
    assert len(commands) == 2
    assert not centre.state.points[0, 1].lies


def test_a_train_that_has_rolled_back_over_points_is_not_released(monkeypatch: pytest.MonkeyPatch) -> None:
    """From track 2 of B over the points, which are set for track 1: its authority would lead there."""
    train = replace(down_train(1, 2100.0, 1), stop="the train has rolled back", rear_m=2460.0)
    state = at_start(LINE, [train])
    assert release_train(state, 1, LINE)[1] == "points B under its interval are not set for train 1"
    points = {**state.points, (1, 1): PointState(wanted=2, detected=2)}
    released, reason = release_train(replace(state, points=points), 1, LINE)
    assert (reason, released.points[1, 1].locked) == (None, {1: None})
    take_out(monkeypatch, "points under")
    assert release_train(state, 1, LINE)[1] is None


def authority(number: int, end_m: float, *, shortens: bool = False) -> Authority:
    return Authority(
        train=1, number=number, report=number, end_cm=round(100 * end_m), direction=1, stopped=False, shortens=shortens
    )


def test_a_wrong_place_at_the_start_on_board_is_no_authority(monkeypatch: pytest.MonkeyPatch) -> None:
    def end_m() -> float:
        train = OnBoard(direction=1, end_m=800.0)  # it stands at 300 m
        train.note_report(1, 0.0)
        assert train.receive(authority(1, 350.0))
        return train.end_m

    assert end_m() == 350.0
    take_out(monkeypatch, "end of the place")
    assert end_m() == 800.0


def test_one_wrong_place_alone_agrees_to_no_shorter_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """20 m/s at 300 m: it comes to rest at 760 m; one place is 500 m behind."""

    def end_m() -> float:
        train = OnBoard(direction=1, end_m=0.0)
        train.receive(authority(1, 2000.0))
        for place in (300.0, -200.0):
            train.note_position(place, 20.0)
        train.receive(authority(2, 330.0, shortens=True))
        return train.end_m

    assert end_m() == 2000.0
    take_out(monkeypatch, "two places")
    assert end_m() == 330.0


def test_a_start_on_board_while_the_train_runs_agrees_to_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it held before is not known any more, and it cannot stop before the shorter end."""

    def acknowledged() -> dict[str, int]:
        train = OnBoard(direction=1, end_m=300.0)
        for _ in range(2):
            train.note_position(305.0, 20.0)
        train.receive(authority(9, 330.0, shortens=True))
        return train.acknowledgement()

    assert acknowledged() == {}
    take_out(monkeypatch, "unknown before")
    assert acknowledged() == {"authority": 9, "authority_end_cm": 33_000}


def test_a_train_beyond_what_it_agrees_to_keeps_its_route() -> None:
    centre = Supervision(layout=LINE, state=at_start(LINE, [
        replace(down_train(1, 2150.0, 1), rear_m=2380.0, station=0, tracks={0: 2, 1: 2}, end_m=80.0)]))  # fmt: skip
    assert centre.ask_route_back(1) is None
    (asked,) = centre.advance(0.0)
    answer = {"authority": asked.number, "authority_end_cm": asked.end_cm, "facing": -1, "direction": -1}
    centre.report(report(3, 2070.0, speed_cmps=-4000, **answer), 3.0)
    assert (centre.state.trains[1].station, centre.state.trains[1].asked_m) == (0, None)
    assert extend_authorities(centre.state, LINE, limits=LIMITS).trains[1].end_m == 80.0
