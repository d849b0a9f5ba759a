"""Faults found while reading a RINEX file: raised, or counted and described."""

from __future__ import annotations

from collections.abc import Callable

from railfix.core.arrays import Integers
from railfix.core.errors import InputFileError
from railfix.core.files import BrokenLines
from railfix.gnss.observations import MAX_PROBLEMS, capped_problems

EPOCHS = "broken epochs"
SATELLITES = "broken satellite lines"
RECORDS = "broken records"
DUPLICATES = "epochs out of order"
UNKNOWN_SYSTEMS = "satellites of unknown constellations"
NOT_SELECTED = "satellites of constellations not selected"
EXTERNAL_EVENTS = "external events"
CYCLE_SLIPS = "cycle-slip records"

_CONSEQUENCE = {
    EPOCHS: "the epoch was skipped",
    SATELLITES: "the satellite was skipped in this epoch",
    RECORDS: "the record was skipped",
    DUPLICATES: "the epoch was skipped",
}


class FaultLog:
    """Faults of one file; `settle` raises the first one where broken lines stop the reading."""

    def __init__(self, path: str, *, broken_lines: BrokenLines) -> None:
        self.path = path
        self.stops = broken_lines == "stop"
        self.counts: dict[str, int] = {}
        self._messages: list[str] = []
        self._problems = 0
        self._first: tuple[int, str] | None = None

    def count(self, kind: str, number: int) -> None:
        """Count skipped items that are no faults."""
        if number:
            self.counts[kind] = self.counts.get(kind, 0) + number

    def fault(self, kind: str, line: int, message: str) -> None:
        """Record one fault at a 1-based line number."""
        message = "".join(c if c.isprintable() else "?" for c in message)
        self.count(kind, 1)
        self._problems += 1
        if self.stops:
            if self._first is None or line < self._first[0]:
                self._first = (line, message)
        elif len(self._messages) < MAX_PROBLEMS:
            self._messages.append(f"{self.path}, line {line}: {message}; {_CONSEQUENCE[kind]}")

    def faults(self, kind: str, lines: Integers, message: Callable[[int], str]) -> None:
        """Record faults of one kind at ascending line numbers; `message(i)` is called for the first ones only."""
        described = 1 if self.stops else MAX_PROBLEMS
        for i, line in enumerate(lines[:described].tolist()):
            self.fault(kind, line, message(i))
        rest = max(len(lines) - described, 0)
        self.count(kind, rest)
        self._problems += rest

    def note(self, message: str, *, kind: str = RECORDS) -> None:
        """Record a fault by its complete message."""
        self.count(kind, 1)
        self._problems += 1
        if len(self._messages) < MAX_PROBLEMS:
            self._messages.append(message)

    def fresh(self) -> FaultLog:
        """Return an empty log of the same file, for a trial that may be discarded."""
        return FaultLog(self.path, broken_lines="stop" if self.stops else "count")

    def absorb(self, other: FaultLog) -> None:
        """Add the faults of another log of the same file."""
        for kind, number in other.counts.items():
            self.count(kind, number)
        self._problems += other._problems
        self._messages += other._messages[: MAX_PROBLEMS - len(self._messages)]
        if other._first is not None and (self._first is None or other._first < self._first):
            self._first = other._first

    def settle(self) -> None:
        """Raise the first fault of the file where broken lines stop the reading."""
        if self.stops and self._first is not None:
            raise InputFileError(self.path, self._first[1], line=self._first[0])

    def take(self) -> tuple[tuple[str, ...], int, dict[str, int]]:
        """Return messages, number of faults and counts since the last call, and reset them."""
        taken = (capped_problems(self._messages, count=self._problems), self._problems, self.counts)
        self._messages, self._problems, self.counts = [], 0, {}
        return taken
