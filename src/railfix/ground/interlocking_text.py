"""State of the interlocking as JSON, for the store."""

from __future__ import annotations

import json
from dataclasses import asdict

from railfix.ground.interlocking import Interlocking, PointState, TrainInterval


def to_json(state: Interlocking) -> str:
    """Return the state as a line of JSON."""
    return json.dumps(
        {
            "trains": [asdict(train) for train in state.trains.values()],
            "points": [[*name, asdict(point)] for name, point in state.points.items()],
            "stopped": state.stopped,
            "granted": state.granted,
        }
    )


def from_json(text: str) -> Interlocking:
    """Return the state from its JSON. Times of release begin again: the clock of the process before is not known."""
    values = json.loads(text)
    trains = {}
    for item in values["trains"]:
        tracks = {int(station): track for station, track in item.pop("tracks").items()}
        trains[item["train"]] = TrainInterval(**item, tracks=tracks)
    points = {
        (station, side): PointState(
            wanted=item["wanted"], detected=item["detected"], locked={int(train): None for train in item["locked"]}
        )
        for station, side, item in values["points"]
    }
    return Interlocking(trains=trains, points=points, stopped=values["stopped"], granted=values["granted"])
