"""Simulated points; railfix has no interface to real points."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from railfix.ground.layout import PointName


@dataclass(kw_only=True)
class SimulatedPoints:
    """Simulated points. They move for `move_s` [s] after a command, and are not detected while they move."""

    move_s: float
    clock: Callable[[], float]
    lie: dict[PointName, int] = field(default_factory=dict)  #: Track to which each set of points leads; 1 by default.
    _moving: dict[PointName, tuple[float, int]] = field(default_factory=dict)
    _answers: dict[PointName, int | None] = field(default_factory=dict)

    def command(self, point: PointName, track: int) -> None:
        """Start to move a set of points to the position for the given track."""
        self._moving[point] = self.clock() + self.move_s, track
        self._answers[point] = None

    def ask(self, point: PointName) -> None:
        """Request the detection of a set of points; the next call of `take_detected` returns their detected track."""
        self._answers[point] = None if point in self._moving else self.lie.get(point, 1)

    def take_detected(self) -> Mapping[PointName, int | None]:
        """Return the detected track of each set of points that has changed or was requested since the last call.

        The detected track is None while points move.
        """
        answers, self._answers = self._answers, {}
        for point, (until, track) in list(self._moving.items()):
            if until <= self.clock():
                del self._moving[point]
                self.lie[point] = answers[point] = track
        return answers
