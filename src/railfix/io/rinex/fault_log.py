"""Faults met while reading: raised where they stand (strict), or counted and told of (lenient)."""

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
NOT_SELECTED = "satellites of constellations not asked for"
EXTERNAL_EVENTS = "external events"
CYCLE_SLIPS = "cycle-slip records"

_WHAT_BECAME_OF_IT = {
    EPOCHS: "the epoch was passed over",
    SATELLITES: "the satellite was passed over in this epoch",
    RECORDS: "the record was passed over",
    DUPLICATES: "the epoch was dropped",
}


class FaultLog:
    """Collects faults of one file; `settle` raises the first of them when reading is strict."""

    def __init__(self, path: str, *, broken_lines: BrokenLines) -> None:
        self.path = path
        self.strict = broken_lines == "stop"
        self.counts: dict[str, int] = {}
        self._sentences: list[str] = []
        self._problems = 0
        self._first: tuple[int, str] | None = None

    def count(self, what: str, number: int) -> None:
        """Things read over that are no faults."""
        if number:
            self.counts[what] = self.counts.get(what, 0) + number

    def fault(self, what: str, line: int, message: str) -> None:
        """One fault at a 1-based line number."""
        message = "".join(c if c.isprintable() else "?" for c in message)
        self.count(what, 1)
        self._problems += 1
        if self.strict:
            if self._first is None or line < self._first[0]:
                self._first = (line, message)
        elif len(self._sentences) < MAX_PROBLEMS:
            self._sentences.append(f"{self.path}, line {line}: {message}; {_WHAT_BECAME_OF_IT[what]}")

    def faults(self, what: str, lines: Integers, message: Callable[[int], str]) -> None:
        """Faults of one kind at ascending line numbers; `message(i)` is asked for the first ones only."""
        told = 1 if self.strict else MAX_PROBLEMS
        for i, line in enumerate(lines[:told].tolist()):
            self.fault(what, line, message(i))
        rest = max(len(lines) - told, 0)
        self.count(what, rest)
        self._problems += rest

    def note(self, sentence: str, *, what: str = RECORDS) -> None:
        """A fault whose sentence is complete."""
        self.count(what, 1)
        self._problems += 1
        if len(self._sentences) < MAX_PROBLEMS:
            self._sentences.append(sentence)

    def fresh(self) -> FaultLog:
        """An empty log of the same file, for a trial that may be thrown away."""
        return FaultLog(self.path, broken_lines="stop" if self.strict else "count")

    def absorb(self, other: FaultLog) -> None:
        """Add what another log of the same file has."""
        for what, number in other.counts.items():
            self.count(what, number)
        self._problems += other._problems
        self._sentences += other._sentences[: MAX_PROBLEMS - len(self._sentences)]
        if other._first is not None and (self._first is None or other._first < self._first):
            self._first = other._first

    def settle(self) -> None:
        """Raise the fault that stands first in the file, when reading is strict."""
        if self.strict and self._first is not None:
            raise InputFileError(self.path, self._first[1], line=self._first[0])

    def take(self) -> tuple[tuple[str, ...], int, dict[str, int]]:
        """Problems, their number and the counters since the last time, and start afresh."""
        taken = (capped_problems(self._sentences, count=self._problems), self._problems, self.counts)
        self._sentences, self._problems, self.counts = [], 0, {}
        return taken
