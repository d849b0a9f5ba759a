"""Response rate and round-trip time of links by window and place, and the choice between normal and spare link."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.settings import Settings

#: Results that are kept: an hour of ten frames a second.
KEPT: Final = 36_000


class LinkResult(NamedTuple):
    """Result of a frame: when and where it was sent, and its round trip [s], NaN where it was not answered in time."""

    sent_s: float
    chainage_m: float
    round_trip_s: float


class LinkLimits(Settings):
    """Limits of the links."""

    #: An echo that takes longer counts as none (T); a centre lets one wait up to 0.2 s for an authority to go with.
    answer_s: float = Field(default=1.0, gt=0)
    misses: int = Field(default=3, ge=1)  #: Misses in a row after which the spare link is taken.
    good: int = Field(default=10, ge=1)  #: Answers in a row before the normal link is taken again.
    good_s: float = Field(default=30.0, ge=0)  #: Time since the fall-back before the normal link is taken again.
    window: int = Field(default=60, ge=1)  #: Frames of the response rate.
    place_m: float = Field(default=100.0, gt=0)  #: Length of a place of the coverage map.
    #: A connection without any packet for this time, at most 10 s, is made anew: so the trains of a centre that was
    #: killed come back.
    idle_s: float = Field(default=5.0, gt=0, le=10)


@dataclass(kw_only=True)
class LinkMeter:
    """Response rate and round-trip time of one link."""

    limits: LinkLimits = field(default_factory=LinkLimits)
    #: Misses, and answers, in a row.
    misses: int = 0
    good: int = 0
    #: Answered and sent frames by place and running direction.
    coverage: dict[tuple[int, int], tuple[int, int]] = field(default_factory=dict)
    #: The last `KEPT` frames, by the time of their result.
    results: deque[LinkResult] = field(default_factory=lambda: deque(maxlen=KEPT))

    _open: dict[int, tuple[float, float | None, int]] = field(default_factory=dict)

    def sent(self, sequence: int, now_s: float, *, chainage_m: float | None = None, direction: int = 0) -> None:
        """Note a frame that was sent; from a place that is not known it is not in the coverage."""
        self._open[sequence] = (now_s, chainage_m, direction)

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

    def _note(self, waiting: tuple[float, float | None, int], round_trip_s: float) -> None:
        sent_s, chainage_m, direction = waiting
        if chainage_m is not None:
            place = int(chainage_m // self.limits.place_m), direction
            answered, sent = self.coverage.get(place, (0, 0))
            self.coverage[place] = (answered + (round_trip_s == round_trip_s), sent + 1)
        known = float("nan") if chainage_m is None else chainage_m
        self.results.append(LinkResult(sent_s, known, round_trip_s))

    @property
    def _window_s(self) -> list[float]:
        return [result.round_trip_s for result in islice(reversed(self.results), self.limits.window)]

    @property
    def response_rate(self) -> float:
        """Share of the frames of the window that were answered in time; NaN without frames."""
        window = self._window_s
        return float(np.isfinite(window).mean()) if window else float("nan")

    @property
    def round_trip_s(self) -> float:
        """Median round-trip time of the window [s]; NaN without answers."""
        answered = [value for value in self._window_s if value == value]
        return float(np.median(answered)) if answered else float("nan")


LinkName = Literal["A", "B"]


@dataclass(frozen=True, kw_only=True)
class LinkChoice:
    """Link in use with a normal link A and a spare link B."""

    active: LinkName = "A"
    since_s: float = 0.0  #: When it was taken.
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


ANSWERED: Final = "#0b6e99"
MISSED: Final = "#e5989b"


def coverage(meters: Iterable[LinkMeter]) -> dict[int, dict[int, tuple[int, int]]]:
    """Return answered and sent frames by direction and place, summed over meters of one bearer."""
    total: dict[int, dict[int, tuple[int, int]]] = defaultdict(dict)
    for meter in meters:
        for (place, direction), (answered, sent) in meter.coverage.items():
            before = total[direction].get(place, (0, 0))
            total[direction][place] = (before[0] + answered, before[1] + sent)
    return dict(total)


def round_trips(meters: Iterable[LinkMeter]) -> tuple[Floats, Floats, Floats]:
    """Return time from the first frame [s], chainage [m] and round trip [s] of all frames, NaN: not answered."""
    results = sorted(result for meter in meters for result in meter.results)
    table = np.array(results, dtype=np.float64).reshape(-1, 3)
    return table[:, 0] - table[:1, 0].sum(), table[:, 1], table[:, 2]


def draw_coverage(path: Path, bearers: Mapping[LinkName, list[LinkMeter]]) -> None:
    """Draw the links of trains, by bearer.

    A row for each bearer and direction with the response rate along the line (P5, figure 7); and one for each bearer
    with the round trips over time and over place (P5, figures 9 and 10), unanswered frames at the foot.
    """
    from matplotlib.figure import Figure

    rows = [
        (f"bearer {name}, {'rising' if direction > 0 else 'falling'}", places, meters[0].limits.place_m)
        for name, meters in bearers.items()
        for direction, places in sorted(coverage(meters).items(), reverse=True)
    ]
    figure = Figure(figsize=(10, 1.2 + 1.1 * len(rows) + 1.8 * len(bearers)), layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=[max(1.1 * len(rows), 1.1), 1.8 * len(bearers)])
    rates, trips = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])
    for axes, (label, places, step) in zip(
        rates.subplots(max(len(rows), 1), 1, sharex=True, squeeze=False)[:, 0], rows, strict=False
    ):
        for place, (answered, sent) in places.items():
            rate = answered / sent
            axes.bar((place + 0.5) * step, 100.0 * rate, width=step, color=ANSWERED, linewidth=0)
            axes.bar((place + 0.5) * step, 100.0 * (1.0 - rate), width=step, bottom=100.0 * rate, color=MISSED)
        axes.set(ylabel="%", ylim=(0, 100), title=label)
    rates.supxlabel("chainage of the front [m]")
    rates.suptitle("Response rate along the line: answered (blue), not answered (red)")
    pairs = trips.subplots(len(bearers), 2, sharex="col", sharey=True, squeeze=False)
    for (name, meters), both in zip(bearers.items(), pairs, strict=True):
        sent_s, chainage_m, trip_s = round_trips(meters)
        missed = np.isnan(trip_s)
        for axes, over in zip(both, (sent_s, chainage_m), strict=True):
            axes.plot(over[~missed], 1e3 * trip_s[~missed], ".", color=ANSWERED, markersize=3)
            axes.plot(over[missed], np.zeros(np.count_nonzero(missed)), "|", color=MISSED, markersize=8)
        both[0].set(ylabel=f"bearer {name} [ms]")
    pairs[-1, 0].set(xlabel="time [s]")
    pairs[-1, 1].set(xlabel="chainage of the front [m]")
    trips.suptitle("Round trip over time and place; not answered (red)")
    figure.savefig(path, dpi=110)
