"""State of the interlocking as named texts of JSON for the store: its head, a text a train, a text a pair of points."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Final

from railfix.core.errors import InputFileError
from railfix.ground.interlocking import Interlocking, PointState, TrainInterval

#: Name of the text without trains and points, and beginnings of the names of theirs.
HEAD: Final = "interlocking"
_TRAIN, _POINTS = f"{HEAD} train ", f"{HEAD} points "


def to_documents(state: Interlocking, before: Interlocking | None = None) -> dict[str, str]:
    """Return the texts by name; with a state before only those that may have changed since."""
    texts = {HEAD: json.dumps({"stopped": state.stopped, "granted": state.granted, "closed": sorted(state.closed)})}
    trains, points = (before.trains, before.points) if before is not None else ({}, {})
    for number, train in state.trains.items():
        if train is not trains.get(number):
            texts[f"{_TRAIN}{number}"] = json.dumps(_values(train))
    for (station, side), point in state.points.items():
        if point is not points.get((station, side)):
            texts[f"{_POINTS}{station} {side}"] = json.dumps(_values(point))
    return texts


def from_documents(texts: Mapping[str, str]) -> Interlocking:
    """Return the state from its texts. Times of release begin again: the clock of the process before is not known.

    InputFileError: when an older version wrote them.
    """
    head = json.loads(texts[HEAD])
    if "closed" not in head:
        raise InputFileError("the centre's database", "is of an older version of railfix; name another database")
    trains, points = {}, {}
    for name, text in texts.items():
        if name.startswith(_TRAIN):
            values = json.loads(text)
            tracks = {int(station): track for station, track in values.pop("tracks").items()}
            trains[int(name.removeprefix(_TRAIN))] = TrainInterval(**values, tracks=tracks)
        elif name.startswith(_POINTS):
            values = json.loads(text)
            station, side = map(int, name.removeprefix(_POINTS).split())
            points[station, side] = PointState(**values | {"locked": dict.fromkeys(map(int, values["locked"]))})
    # in the order of the line, whatever the order of the texts
    return Interlocking(
        trains=dict(sorted(trains.items())), points=dict(sorted(points.items())), stopped=head["stopped"],
        granted=head["granted"], closed=frozenset(head["closed"]),
    )  # fmt: skip


def _values(record: TrainInterval | PointState) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in fields(record)}
