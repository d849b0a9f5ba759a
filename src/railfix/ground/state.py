"""State of the interlocking: intervals of trains, points, closed sections and speed restrictions.

The state is stored as several strings: a common string, one for each train, and one for each set of points. Values are
immutable: each step returns new values.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Final, NamedTuple, Self

from pydantic import Field

from railfix.core.arrays import copy_with
from railfix.core.errors import InputFileError
from railfix.core.settings import Settings
from railfix.ground.layout import PointName


class InterlockingLimits(Settings):
    """Limits of the interlocking."""

    #: An authority ends this distance plus `overlap_m` before the obstacle, points or end of track that limit it.
    margin_m: float = Field(default=20.0, ge=0)
    #: Distance kept free beyond the end of an authority for a train that passes the end at release speed. With 0, there
    #: is no release speed.
    overlap_m: float = Field(default=0.0, ge=0)
    #: Points are released this time after a train's safe rear end has passed them.
    release_s: float = Field(default=3.0, ge=0)
    #: Trains on points are stopped if the trackside does not answer a request for the points' detection within this
    #: time.
    answer_s: float = Field(default=10.0, gt=0)
    #: Longest time between two messages of a section's detection; after this time, the section's state is unknown.
    detection_s: float = Field(default=10.0, gt=0)
    speed_mps: float = Field(default=60.0, gt=0)  #: Highest speed of a train.
    #: Highest acceleration and deceleration of a train, to limit its distance between two reports with speeds.
    acceleration_mps2: float = Field(default=2.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class TrainInterval:
    """Interval and route of a train."""

    train: int
    direction: int
    rear_m: float  #: Last safe rear end [m].
    front_m: float  #: Last safe front end [m].
    end_m: float  #: End of the authority.
    sequence: int  #: Sequence number of the newest report; `session` is the `TrainMessage.session` of this report.
    session: int = 0
    tracks: Mapping[int, int]  #: Track in each station of the route.
    station: int  #: Station where the route ends.
    length_m: float  #: Length of the train as configured.
    standstill: bool = True
    #: Safe rear end of the newest report. The interval begins there after the next report confirms this position. None
    #: if the newest report does not confirm the train's integrity and length.
    claimed_m: float | None = None
    line: int | None = None  #: Line number in the train's reports; None before the first report.
    #: Time of the newest position by the train's clock. It is None until the train's unit has sent its first report
    #: after it was started.
    measured_ns: int | None = None
    speed_mps: float | None = None  #: Speed of the newest report; None if unknown.
    #: Ends of the train according to the newest report with a position, even if that report contradicts the record;
    #: lower chainage first [m].
    reported_m: tuple[float, float] | None = None
    contradiction: str | None = None  #: Contradiction between the newest report and the record; None if there is none.
    held_end_m: float | None = None  #: End of the train's authority according to its newest report.
    #: Number of the newest authority that may permit the train to run, sent by the centre or acknowledged by a report.
    #: None before the first authority. Also None after a report that acknowledges an order to brake with this or a
    #: higher number, because no authority in transit can end that order.
    runs_by: int | None = None
    stop: str | None = None  #: Reason for the train's stop, kept until a release by hand; None without a stop.
    asked_m: float | None = None  #: Earlier end of the authority that the train is requested to accept, if any.
    asked_number: int = 0  #: Number of the first authority that requests the earlier end.
    held: bool = False  #: Whether the train has given back its route; its next route is then set by hand.
    #: Number of the train that was divided from the rear of this train, until the two trains are apart.
    parted: int | None = None

    def changed(self, **values: Any) -> Self:
        """Return a copy with changed fields, faster than `dataclasses.replace`; raise TypeError for an unknown name."""
        if not values.keys() <= _NAMES[TrainInterval]:
            raise TypeError(
                f"a train has no fields of these names: {', '.join(sorted(values.keys() - _NAMES[TrainInterval]))}"
            )
        copy = copy_with(self, **values)
        if not values.keys().isdisjoint(("direction", "rear_m", "front_m", "end_m")):
            for computed in ("interval_m", "span_m"):
                copy.__dict__.pop(computed, None)
        return copy

    @cached_property
    def interval_m(self) -> tuple[float, float]:
        """Rear end and front end of the occupied interval, in running direction [m]."""
        return self.rear_m, max(self.end_m * self.direction, self.front_m * self.direction) * self.direction

    @cached_property
    def span_m(self) -> tuple[float, float]:
        """Ends of the occupied interval, lower first [m]."""
        low, high = sorted(self.interval_m)
        return low, high

    def overlaps(self, low_m: float, high_m: float) -> bool:
        """Return whether the occupied interval overlaps a range of chainages."""
        return self.span_m[0] < high_m and low_m < self.span_m[1]

    def has_passed(self, low_m: float, high_m: float) -> bool:
        """Return whether the rear end has passed a range of chainages in running direction."""
        return self.rear_m >= high_m if self.direction > 0 else self.rear_m <= low_m

    def outside_m(self) -> float:
        """Return the distance of the newest reported position from the interval [m], 0 if the train may be inside."""
        if self.reported_m is None:
            return 0.0
        front = max(self.direction * end for end in self.reported_m)
        beyond = front - self.direction * self.interval_m[1]
        behind = self.direction * self.rear_m + self.length_m - front
        return max(beyond, behind, 0.0) if max(beyond, behind) > ROUNDING_M else 0.0


#: Largest difference between two ends that is attributed to rounding [m].
ROUNDING_M: Final = 0.02


@dataclass(frozen=True, kw_only=True)
class PointState:
    """State of a set of points in the interlocking."""

    wanted: int = 1  #: Commanded track.
    detected: int | None = 1  #: Detected track; None while the points move, or before the trackside answers.
    commanded: bool = True  #: Whether the command to move to `wanted` has been given, or is not needed.
    #: Trains that lock the points, each with the time at which its lock ends [s]. The time is None until the train's
    #: rear end has passed.
    locked: Mapping[int, float | None] = field(default_factory=dict)

    @property
    def lies(self) -> bool:
        """Whether the points are detected in their commanded position."""
        return self.detected == self.wanted


#: Names of the stored fields of trains and points.
_NAMES: Final = {
    kind: dict.fromkeys(field.name for field in fields(kind)).keys() for kind in (TrainInterval, PointState)
}


class Restriction(NamedTuple):
    """Temporary speed restriction: highest speed while any part of a train is between two chainages."""

    low_m: float
    high_m: float
    speed_mps: float


@dataclass(frozen=True, kw_only=True)
class Interlocking:
    """State of the interlocking."""

    trains: Mapping[int, TrainInterval]
    points: Mapping[PointName, PointState]
    stopped: bool = False  #: Whether satellite positioning is suspended: no authority is extended, and no route is set.
    granted: int = 0  #: Number of the newest authority sent so far.
    #: Last authority number in the database when the centre was started, and first number after this start. Authorities
    #: with numbers between these two were issued by a centre with a newer state than the stored state.
    skipped: tuple[int, int] = (0, 0)
    #: Sections (`Layout.sections`) into which no authority may reach, each with the reason
    #: (`railfix.ground.stops.CLOSED`, `OCCUPIED` or `UNKNOWN`).
    bars: frozenset[tuple[str, str]] = frozenset()
    restrictions: Mapping[str, Restriction] = field(default_factory=dict)  #: Speed restrictions by name.


def with_train(state: Interlocking, train: TrainInterval) -> Interlocking:
    """Return the state with the record of a train replaced."""
    return copy_with(state, trains={**state.trains, train.train: train})


def stop_trains(state: Interlocking, trains: Iterable[int], reason: str) -> Interlocking:
    """Return the state with trains stopped; a train already stopped keeps its reason."""
    for number in trains:
        known = state.trains[number]
        if known.stop is None:
            state = with_train(state, replace(known, stop=reason))
    return state


#: Name of the stored string with the common state. The names of the strings of trains and points begin with it.
HEAD: Final = "interlocking"
_TRAIN, _POINTS = f"{HEAD} train ", f"{HEAD} points "


def to_documents(state: Interlocking, before: Interlocking | None = None) -> dict[str, str | None]:
    """Return the strings of a state by name.

    With a previous state `before`, only strings that may have changed are returned, and None for each string to remove.
    """
    head = {
        "stopped": state.stopped,
        "granted": state.granted,
        "bars": sorted(state.bars),
        "restrictions": state.restrictions,
    }
    texts: dict[str, str | None] = {HEAD: json.dumps(head)}
    trains, points = (before.trains, before.points) if before is not None else ({}, {})
    for number, train in state.trains.items():
        if train is not trains.get(number):
            texts[f"{_TRAIN}{number}"] = json.dumps(_values(train))
    texts.update((f"{_TRAIN}{number}", None) for number in trains if number not in state.trains)
    for (station, side), point in state.points.items():
        if point is not points.get((station, side)):
            texts[f"{_POINTS}{station} {side}"] = json.dumps(_values(point))
    return texts


def from_documents(texts: Mapping[str, str | None]) -> Interlocking:
    """Return the state from its strings.

    Points wait again for their full release time, because the clock of the earlier process is unknown.

    Raise InputFileError if the strings were written by an older version.
    """
    head = json.loads(texts[HEAD] or "")
    names = {field.name for field in fields(TrainInterval)}
    of_trains = [json.loads(text or "").keys() for name, text in texts.items() if name.startswith(_TRAIN)]
    if "bars" not in head or any(found != names for found in of_trains):
        raise InputFileError(
            "the centre's database", "was written by an older version of railfix; choose another database"
        )
    trains, points = {}, {}
    for name, text in texts.items():
        if name.startswith(_TRAIN):
            values = json.loads(text or "")
            tracks = {int(station): track for station, track in values.pop("tracks").items()}
            reported = values.pop("reported_m")
            trains[int(name.removeprefix(_TRAIN))] = TrainInterval(
                **values, tracks=tracks, reported_m=None if reported is None else tuple(reported)
            )
        elif name.startswith(_POINTS):
            values = json.loads(text or "")
            station, side = map(int, name.removeprefix(_POINTS).split())
            points[station, side] = PointState(**values | {"locked": dict.fromkeys(map(int, values["locked"]))})
    # sorted, so that the result does not depend on the order of the strings
    return Interlocking(
        trains=dict(sorted(trains.items())), points=dict(sorted(points.items())), stopped=head["stopped"],
        granted=head["granted"], bars=frozenset((name, kind) for name, kind in head["bars"]),
        restrictions={name: Restriction(*values) for name, values in head["restrictions"].items()},
    )  # fmt: skip


def _values(record: TrainInterval | PointState) -> dict[str, Any]:
    return {name: getattr(record, name) for name in _NAMES[type(record)]}
