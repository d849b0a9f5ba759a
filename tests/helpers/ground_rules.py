"""Rules of the ground side that tests take out: of each the functions that keep it, and what stands in their place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from disturbed_traffic import DisturbedTraffic, without_grants
from railfix.ground import interlocking, reports, stops, supervision
from railfix.ground.on_board import OnBoard
from railfix.ground.reports import CHECKS, PlacedReport
from railfix.ground.traffic import SimulatedTrain

#: A place: an object and the name of its attribute; and what stands there without the rule.
Replaced = tuple[Any, str, Any]


def never(*_: Any, **__: Any) -> bool:
    return False


def always(*_: Any, **__: Any) -> bool:
    return True


def nothing(*_: Any, **__: Any) -> None:
    return None


def without(*checks: Callable[[PlacedReport], str | None]) -> Replaced:
    """The checks of a report but for some."""
    return reports, "CHECKS", tuple(check for check in CHECKS if check not in checks)


def rear_without_length(report: PlacedReport) -> float:
    return report.front_m


def rear_of_reported_length(report: PlacedReport) -> float:
    return report.front_m - report.message.facing * (report.over_m + report.message.length_cm / 100.0)


def complete(_: Any, message: Any) -> bool:
    return bool(message.complete)


def of_its_length(known: Any, message: Any) -> bool:
    return bool(abs(message.length_cm / 100.0 - known.length_m) <= reports.LENGTH_ROUNDING_M)


def by_the_trains_clock(known: Any, message: Any, _by_centre_s: float | None) -> float | None:
    return None if known.measured_ns is None else (message.time_ns - known.measured_ns) / 1e9


def not_grown(report: PlacedReport) -> tuple[float, float]:
    return report.known.rear_m, report.known.front_m


def beyond_front_as_well(report: PlacedReport) -> str | None:
    """A train whose own safe front end was taken for the end of its authority."""
    known, d = report.known, report.known.direction
    beyond = d * report.front_m - report.over_m > max(d * known.end_m, d * known.front_m)
    return "the train is beyond its authority" if beyond else None


def tracks_forgotten(known: Any, facing: int, rear: float, ahead: float, layout: Any) -> Any:
    turned = TURN(known, facing, rear, ahead, layout)
    return replace(turned, tracks={k: track for k, track in turned.tracks.items() if k == known.station})


def up_to_the_end(train: SimulatedTrain) -> float:
    """No curve: full speed up to the end of the authority."""
    room = train.direction * (train.on_board.end_m - train.safe_front_m)
    return 0.0 if room <= 0.0 else train.top_mps


def of_one_place(_: OnBoard, before_m: float | None, now_m: float) -> float | None:
    return None if before_m is None else now_m


TURN = reports._turn
#: Rules by name.
RULES: dict[str, list[Replaced]] = {
    "train ahead": [(interlocking, "shares", never)],
    "safe rear": [(PlacedReport, "rear_m", property(rear_without_length))],
    "sequence": [
        (reports, "is_newer", always),
        (reports, "furthest", lambda _facing, new, _known: new),
        without(reports.older_place, reports.rolled_back, reports.impossible_way),
        (supervision, "counts", always),
    ],
    "direction": [(interlocking, "comes_the_other_way", never)],
    "points locked": [(interlocking, "is_free", always), (interlocking, "under_interval", never)],
    "points detected": [
        (interlocking, "leads", lambda point, train, k: train.train in point.locked and point.wanted == train.tracks[k])
    ],
    "persistence": [(DisturbedTraffic, "restored", lambda self: without_grants(self._stored or self.centre.state))],
    "supervision": [(SimulatedTrain, "permitted_mps", up_to_the_end), (OnBoard, "curve_reason", nothing)],
    "closed": [(interlocking, "bars_ahead", lambda *_: []), (interlocking, "barred", nothing)],
    "freshness": [(OnBoard, "stale_reason", nothing)],
    "integrity": [(reports, "confirms_rear", of_its_length)],
    "length": [
        (reports, "confirms_rear", complete),
        (PlacedReport, "rear_m", property(rear_of_reported_length)),
        without(reports.no_length),
    ],
    "two reports": [(reports, "agreed_rear", lambda facing, rear, _claimed: facing * rear)],
    "way": [without(reports.impossible_way)],
    "roll-back": [without(reports.rolled_back)],
    "agreed": [(stops, "answers", always), (stops, "holds_more_than_asked", never)],
    "clock": [(reports, "_elapsed_s", by_the_trains_clock)],
    "place covered": [(reports, "covered_m", not_grown)],
    "turns": [(OnBoard, "_answers", always)],
    "creep": [
        (reports, "CHECKS", tuple(beyond_front_as_well if c is reports.beyond_authority else c for c in CHECKS))
    ],
    "tracks kept": [(reports, "_turn", tracks_forgotten)],
    "end of the place": [(OnBoard, "_begins", never)],
    "two places": [(OnBoard, "_further", of_one_place)],
    "unknown before": [(OnBoard, "_may_take", always)],
    "station reached": [(interlocking, "reached", never)],
    "points under": [(stops, "points_refused", nothing)],
    "standstill": [without(reports.moving_standstill), (reports, "stands", lambda message: message.standstill)],
    "place of a release": [(interlocking.TrainInterval, "outside_m", lambda _: 0.0)],
}  # fmt: skip


def take_out(monkeypatch: pytest.MonkeyPatch, *rules: str) -> None:
    """Put what stands there without the rules in the place of the functions that keep them."""
    for rule in rules:
        for owner, name, instead in RULES[rule]:
            assert hasattr(owner, name), f"{rule}: {owner} has no {name}"
            monkeypatch.setattr(owner, name, instead)
