"""Response rate and round-trip time of links by window and place, and the choice between normal and spare link."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from pydantic import Field

from railfix.core.settings import Settings


class LinkLimits(Settings):
    """Limits of the links.

    Attributes
    ----------
    answer_s : float [s]
        An echo that takes longer counts as none (T); a centre lets one wait up to 0.2 s for an authority to go with.
    misses : int
        Misses in a row after which the spare link is taken.
    good : int
        Answers in a row before the normal link is taken again.
    good_s : float [s]
        Time since the fall-back before the normal link is taken again.
    window : int
        Frames of the response rate.
    place_m : float [m]
        Length of a place of the coverage map.
    idle_s : float [s]
        A connection without any packet for this time, at most 10 s, is made anew: so the trains of a centre that was
        killed come back.
    """

    answer_s: float = Field(default=1.0, gt=0)
    misses: int = Field(default=3, ge=1)
    good: int = Field(default=10, ge=1)
    good_s: float = Field(default=30.0, ge=0)
    window: int = Field(default=60, ge=1)
    place_m: float = Field(default=100.0, gt=0)
    idle_s: float = Field(default=5.0, gt=0, le=10)


@dataclass(kw_only=True)
class LinkMeter:
    """Response rate and round-trip time of one link.

    Attributes
    ----------
    limits : LinkLimits
    misses, good : int
        Misses, and answers, in a row.
    coverage : dict of (int, int) to (int, int)
        Answered and sent frames by place and running direction.
    """

    limits: LinkLimits = field(default_factory=LinkLimits)
    misses: int = 0
    good: int = 0
    coverage: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)
    _open: dict[int, tuple[float, tuple[int, int] | None]] = field(default_factory=dict)
    _results: deque[tuple[float, float]] = field(default_factory=deque)

    def sent(self, sequence: int, now_s: float, *, chainage_m: float | None = None, direction: int = 0) -> None:
        """Note a frame that was sent; from a place that is not known it is not in the coverage."""
        place = None if chainage_m is None else (int(chainage_m // self.limits.place_m), direction)
        self._open[sequence] = (now_s, place)

    def answered(self, sequence: int, now_s: float, round_trip_s: float) -> None:
        """Note the echo of a frame; one that is too late, or comes twice, is none."""
        self.settle(now_s)
        if (waiting := self._open.pop(sequence, None)) is None:
            return
        self.misses, self.good = 0, self.good + 1
        self._note(waiting, round_trip_s)

    def settle(self, now_s: float) -> None:
        """Count the frames whose time has passed as misses."""
        for sequence, waiting in list(self._open.items()):
            if now_s - waiting[0] <= self.limits.answer_s:
                break
            del self._open[sequence]
            self.misses, self.good = self.misses + 1, 0
            self._note(waiting, float("nan"))

    def _note(self, waiting: tuple[float, tuple[int, int] | None], round_trip_s: float) -> None:
        sent_s, place = waiting
        if place is not None:
            answered, sent = self.coverage.get(place, (0, 0))
            self.coverage[place] = (answered + (round_trip_s == round_trip_s), sent + 1)
        self._results.append((sent_s, round_trip_s))
        if len(self._results) > self.limits.window:
            self._results.popleft()

    @property
    def response_rate(self) -> float:
        """Share of the frames of the window that were answered in time; NaN without frames."""
        results = [value for _, value in self._results]
        return float(np.isfinite(results).mean()) if results else float("nan")

    @property
    def round_trip_s(self) -> float:
        """Median round-trip time of the window [s]; NaN without answers."""
        results = [value for _, value in self._results if value == value]
        return float(np.median(results)) if results else float("nan")


LinkName = Literal["A", "B"]


@dataclass(frozen=True, kw_only=True)
class LinkChoice:
    """Link in use with a normal link A and a spare link B.

    Attributes
    ----------
    active : {"A", "B"}
    since_s : float [s]
        When it was taken.
    switches : int
    """

    active: LinkName = "A"
    since_s: float = 0.0
    switches: int = 0

    def after(self, now_s: float, normal: LinkMeter, spare: LinkMeter) -> LinkChoice:
        """Return the choice after new results of both links.

        The spare link is taken after misses of the normal one in a row, unless it misses as well; the normal link
        again after answers in a row and a time, or at once where only the spare one misses.
        """
        limits = normal.limits
        lost_normal, lost_spare = normal.misses >= limits.misses, spare.misses >= limits.misses
        if self.active == "A" and lost_normal and not lost_spare:
            return replace(self, active="B", since_s=now_s, switches=self.switches + 1)
        steady = normal.good >= limits.good and now_s - self.since_s >= limits.good_s
        if self.active == "B" and (steady or (lost_spare and normal.good > 0)):
            return replace(self, active="A", since_s=now_s, switches=self.switches + 1)
        return self
