"""Orders given on the page, and their confirmation by a second order.

For each order, the log gets a line with the author and the outcome. Orders based on an observation that no report
confirms must be given twice: by two people, or by one person after a minimum time.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

from railfix.ground.centre import TrainState
from railfix.ground.changes import correct_interval, divide_train, enter_train, join_trains, remove_train
from railfix.ground.layout import MOST_PARTS
from railfix.ground.state import Interlocking, Restriction
from railfix.ground.stops import CLOSED, OCCUPIED, close_section, open_section, release_train
from railfix.ground.supervision import Supervision
from railfix.ground.web import Order

#: Shortest and longest time after which the same person may confirm an order [s]; another person may confirm at once.
AGAIN_S: Final = 3.0, 60.0
#: Largest length of the reason for an order [characters]; longer reasons are refused.
LONGEST_REASON: Final = 200
Values = dict[str, Any]


def number_of(values: Values, name: str) -> int | str:
    """Return a value of an order if it is an integer, otherwise the reason for a refusal."""
    value = values.get(name)
    return value if type(value) is int else f"{name}: a number was expected"


def metres_of(values: Values, *names: str) -> list[float] | str:
    """Return values of an order if they are numbers below 1e7, otherwise the reason for a refusal."""
    found = [values.get(name) for name in names]
    for name, value in zip(names, found, strict=True):
        if type(value) not in (int, float) or not abs(value) < 1e7:  # type: ignore[arg-type]
            return f"{name}: a number was expected"
    return [float(value) for value in found]  # type: ignore[arg-type]


@dataclass(kw_only=True)
class OrderDesk:
    """Orders of one centre (`railfix.ground.control.ControlCentre`)."""

    supervision: Supervision
    clock: Callable[[], float]  #: Centre's clock [s].
    log: Callable[..., None]  #: Function that writes a line to the log.
    release: Callable[[], str | None]  #: Function that releases a stop of all trains.
    stop: Callable[[int | None], str | None]  #: Function that stops a train, or every train (None).
    #: Time [s] and author of each order that awaits confirmation, by name and values of the order.
    _asked: dict[str, tuple[float, str]] = field(default_factory=dict)

    def given(self, name: str, order: Callable[[Values, str], str | None], values: Values, by: str = "") -> str | None:
        """Carry out an order and log it; return the reason for a refusal, None if the order was carried out."""
        reason = order(values, by)
        shown = json.dumps({key: value for key, value in values.items() if key != "password"})
        outcome = "done" if reason is None else f"refused: {reason}"
        train = values.get("train")
        who = by or "the page"
        self.log(f"order of {who}: {name} {shown}: {outcome}", train=train if type(train) is int else None)
        return reason

    def confirmed(self, name: str, values: Values, by: str, what: str) -> str | None:
        """Return None if this order confirms an earlier order in time, otherwise a request to confirm this order."""
        key, now, (least_s, most_s) = f"{name} {json.dumps(values, sort_keys=True)}", self.clock(), AGAIN_S
        asked = self._asked.pop(key, None)
        if asked is not None:
            least_s = 0.0 if asked[1] != by else least_s
            if least_s <= now - asked[0] <= most_s:
                return None
        self._asked = {k: v for k, v in self._asked.items() if now - v[0] <= most_s}
        self._asked[key] = now, by
        return (
            f"{what}: if this is true, repeat the order in {AGAIN_S[0]:g} to {most_s:g} s, or let another "
            "person give it"
        )

    def asked_s(self, name: str, values: Values) -> float:
        """Return the time of an equal order that awaits confirmation; without such an order, the present time [s]."""
        key = f"{name} {json.dumps(values, sort_keys=True)}"
        return self._asked.get(key, (self.clock(), ""))[0]

    def release_train(self, values: Values, by: str) -> str | None:
        """Release the stop of a train; the release of a train that does not report must be ordered twice."""
        train = number_of(values, "train")
        if isinstance(train, str):
            return train
        state, reason = release_train(self.supervision.state, train, self.supervision.layout)
        record = self.supervision.records.get(train)
        silent = record is None or record.state is not TrainState.TRACKED
        if reason is None and silent:
            reason = self.confirmed(
                "release-train", values, by, f"train {train} does not report, but is at rest and complete"
            )
        if reason is None:
            self.supervision.state = state
        return reason

    def twice(
        self, name: str, change: Callable[[Values], tuple[Interlocking, str | None]], what: str, values: Values, by: str
    ) -> str | None:
        """Carry out a change of trains when it is ordered again; both orders must contain the same reason."""
        reason = values.get("reason")
        if not isinstance(reason, str) or not 0 < len(reason.strip()) <= LONGEST_REASON:
            return f"reason: one to {LONGEST_REASON} characters on who observed what were expected"
        since_s = self.asked_s(name, values)
        before = self.supervision.state
        state, refused = change(values)
        refused = refused or self._moved_meanwhile(before, state, since_s)
        refused = refused or self.confirmed(name, values, by, what)
        if refused is None:
            self.supervision.forget([number for number in before.trains if number not in state.trains])
            self.supervision.state = state
        return refused

    def _moved_meanwhile(self, before: Interlocking, after: Interlocking, since_s: float) -> str | None:
        """Return a message if, since the first order, a train has reported a position outside its new interval."""
        for number, train in after.trains.items():
            known, record = before.trains.get(number), self.supervision.records.get(number)
            if known is None or known is train or known.reported_m is None or record is None:
                continue
            if (
                record.heard_s >= since_s - self.supervision.centre.lost_s
                and replace(train, reported_m=known.reported_m).outside_m() > 0.0
            ):
                return "train {} reports {:.0f} to {:.0f} m, outside that interval".format(number, *known.reported_m)
        return None

    def change(self, values: Values, *, of: str) -> tuple[Interlocking, str | None]:
        """Carry out a change, whose name is `of`. Return the new state and, if the change is refused, the reason."""
        state, layout = self.supervision.state, self.supervision.layout
        train = number_of(values, "train")
        if isinstance(train, str):
            return state, train
        lapsed = self.supervision.has_lapsed(train, self.clock())
        if of in ("correct", "enter"):
            ends, track = metres_of(values, "rear_m", "front_m"), number_of(values, "track")
            direction = number_of(values, "direction")
            for value in (ends, track, direction):
                if isinstance(value, str):
                    return state, value
            place: Any = {"rear_m": ends[0], "front_m": ends[1], "track": track, "direction": direction}
            if of == "correct":
                return correct_interval(state, train, layout, **place, lapsed=lapsed)
            length = metres_of(values, "length_m")
            if isinstance(length, str):
                return state, length
            return enter_train(state, train, layout, length_m=length[0], **place)
        if of == "remove":
            return remove_train(state, train, layout, lapsed=lapsed)
        other = number_of(values, "other")
        if isinstance(other, str):
            return state, other
        if of == "join":
            return join_trains(state, train, other, layout)
        length = metres_of(values, "length_m")
        if isinstance(length, str):
            return state, length
        return divide_train(state, train, other, length_m=length[0])

    def confirm_start(self, values: Values, by: str) -> str | None:
        """On the second order, stop waiting for trains that have not reported since the start of the centre."""
        if not self.supervision.awaited:
            return "every train has reported since the start"
        what = f"the database is not an older copy, and these trains do not report: {self.supervision.awaited_text}"
        if (reason := self.confirmed("confirm-start", values, by, what)) is None:
            self.supervision.awaited.clear()
        return reason

    def section(self, values: Values, by: str, *, of: str) -> str | None:
        """Close, open, occupy or free a section; a section is freed only when the order is given a second time."""
        supervision, name = self.supervision, str(values.get("section", ""))
        layout, state = supervision.layout, supervision.state
        if name not in layout.sections:
            return f"no such section: {name!r}"
        kind = CLOSED if of in ("close", "open") else OCCUPIED
        if of in ("close", "occupy"):
            supervision.state = close_section(state, name, layout, f"{name} is {kind}", kind=kind)
            return None
        if (name, kind) not in state.bars:
            return f"{name!r} is not {kind}"
        if of == "free" and (reason := self.confirmed("free-section", values, by, f"{name} is free of vehicles")):
            return reason
        supervision.state = open_section(state, name, kind)
        return None

    def detect(self, values: Values, by: str = "") -> str | None:
        """Process a report on a section: true for an occupied section, false for a free section, null for an unknown
        state. Changes are logged.
        """
        name, occupied = str(values.get("section", "")), values.get("occupied")
        if name not in self.supervision.layout.sections:
            return f"no such section: {name!r}"
        if occupied is not None and not isinstance(occupied, bool):
            return "occupied: true, false or null was expected"
        if self.supervision.detected.get(name, "not yet") != occupied:
            word = {True: "occupied", False: "free", None: "unknown"}[occupied]
            self.log(f"detection of {by or 'the page'}: {name} is {word}")
        self.supervision.set_section_detected(name, occupied, self.clock())
        return None

    def restrict(self, values: Values, by: str) -> str | None:
        """Set a named temporary speed restriction at once, or lift a restriction if this is ordered twice."""
        supervision, name = self.supervision, str(values.get("name", "")).strip()
        state = supervision.state
        if not 0 < len(name) <= 40:
            return "name: one to 40 characters were expected"
        if values.get("lift") is True:
            if name not in state.restrictions:
                return f"there is no restriction {name!r}"
            reason = self.confirmed("restrict", values, by, f"restriction {name} is no longer needed")
            if reason is None:
                kept = {key: value for key, value in state.restrictions.items() if key != name}
                supervision.state = replace(state, restrictions=kept)
            return reason
        found = metres_of(values, "low_m", "high_m", "speed_mps")
        if isinstance(found, str):
            return found
        new = Restriction(*found)
        if not new.low_m < new.high_m or not 0.0 < new.speed_mps <= 100.0:
            return "low_m below high_m, and a speed above 0 and up to 100 m/s were expected"
        if name in state.restrictions:
            return f"restriction {name!r} exists already: lift it, or use another name"
        if len(state.restrictions) >= MOST_PARTS:
            return f"there are {MOST_PARTS} restrictions already, the largest number that an authority can contain"
        supervision.state = replace(state, restrictions={**state.restrictions, name: new})
        return None

    def orders(self) -> dict[str, Order]:
        """Return the function of each order by name; a function is called with the order's values and author."""
        supervision = self.supervision

        def of_train(order: Callable[[int], str | None]) -> Callable[[Values, str], str | None]:
            def given(values: Values, _: str) -> str | None:
                train = number_of(values, "train")
                return train if isinstance(train, str) else order(train)

            return given

        def changing(of: str, what: str) -> Callable[[Values, str], str | None]:
            return lambda values, by: self.twice(of, partial(self.change, of=of), what, values, by)

        orders: dict[str, Callable[[Values, str], str | None]] = {
            "close-section": partial(self.section, of="close"),
            "open-section": partial(self.section, of="open"),
            "occupy-section": partial(self.section, of="occupy"),
            "free-section": partial(self.section, of="free"),
            "restrict": self.restrict,
            "confirm-start": self.confirm_start,
            "release": lambda _values, _by: self.release(),
            "route": of_train(supervision.set_route),
            "route-back": of_train(supervision.ask_route_back),
            "stop": of_train(self.stop),
            "stop-all": lambda _values, _by: self.stop(None),
            "release-train": self.release_train,
            "correct-train": changing("correct", "the train is inside that interval, and at rest"),
            "enter-train": changing("enter", "the train is inside that interval, and at rest"),
            "remove-train": changing("remove", "the train is no longer to be supervised"),
            "join-trains": changing("join", "the trains are coupled, and at rest"),
            "divide-train": changing("divide", "the train is divided there, and both parts are at rest"),
        }
        return {name: partial(self.given, name, order) for name, order in orders.items()} | {
            "detect-section": self.detect  # only changes are logged, because this order is repeated every few seconds
        }
