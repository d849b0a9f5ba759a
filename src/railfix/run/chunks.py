"""Logs of several antennas as chunks that cover the same span of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes
from railfix.gnss.observations import Observations, concatenate

#: Tags of two receivers that differ by no more than this belong to one instant [ns].
SAME_INSTANT_NS: Final = 20_000_000


def _spacing_ns(time: Datetimes) -> int:
    """Usual spacing of the epochs of a part [ns]; 0 when it has one epoch."""
    if len(time) < 2:
        return 0
    return int(np.median(np.diff(time).astype(np.int64)))


class Pieces:
    """The log of one antenna in order of time, read piece by piece and taken chunk by chunk."""

    def __init__(self, parts: Iterator[Observations]) -> None:
        self._parts = parts
        self._waiting: Observations | None = None
        self._ahead: Observations | None = None

    def read_ahead(self) -> None:
        """Read the next piece before it is asked for, where no whole piece is waiting."""
        if self._ahead is None and not (self._waiting is not None and len(self._waiting)):
            self._ahead = next(self._parts, None)

    def more(self) -> Datetimes | None:
        """Read the next piece and return its time tags; None at the end of the log."""
        part = next(self._parts, None) if self._ahead is None else self._ahead
        self._ahead = None
        if part is None:
            return None
        rest = self._waiting
        self._waiting = concatenate([rest, part]) if rest is not None and len(rest) else part
        return part.time

    def take(self, epochs: int) -> Observations:
        """Return the next epochs of what was read."""
        if self._waiting is None:
            raise ValueError("nothing was read yet")
        taken, self._waiting = self._waiting[:epochs], self._waiting[epochs:]
        return taken


def cuts(logs: Mapping[str, Callable[[], Datetimes | None]]) -> Iterator[dict[str, Datetimes]]:
    """Time tags of chunks that cover the same span of time for every antenna, of `Pieces.more` of each.

    Each antenna keeps its own epochs. A chunk ends where the first of the current parts ends;
    what the others have beyond waits for the next chunk. Epochs that belong together but are
    tagged a little apart (`SAME_INSTANT_NS`) stay in one chunk.

    Yields
    ------
    dict of str to ndarray of datetime64[ns]
        All antennas that have been seen so far; empty for one without epochs in the span.
    """
    live = dict(logs)
    waiting: dict[str, Datetimes] = {}
    spacing: dict[str, int] = {}
    while True:
        for name in list(live):
            if len(waiting.get(name, ())):
                continue
            part = live[name]()
            if part is None:
                del live[name]
                continue
            waiting[name] = part
            spacing[name] = _spacing_ns(part) or spacing.get(name, 0)
        ends = [waiting[name][-1] for name in live]
        if not any(len(part) for part in waiting.values()):
            return
        if ends:
            slack = min(SAME_INSTANT_NS, *(spacing[name] // 2 for name in live))
            horizon = min(ends) + np.timedelta64(slack, "ns")
            cut = {n: int(np.searchsorted(p, horizon, side="right")) for n, p in waiting.items()}
        else:
            cut = {name: len(part) for name, part in waiting.items()}
        yield {name: part[: cut[name]] for name, part in waiting.items()}
        rest = {name: part[cut[name] :] for name, part in waiting.items()}
        # A short rest would cut every chunk that follows in two: it is joined with the next part.
        short = [n for n in live if 0 < len(rest[n]) < len(waiting[n]) // 2]
        waiting = rest
        for name in short:
            part = live[name]()
            if part is None:
                del live[name]
            else:
                waiting[name] = np.concatenate([rest[name], part])


def aligned(logs: Mapping[str, Iterator[Observations]]) -> Iterator[dict[str, Observations]]:
    """Chunks of observations that cover the same span of time for every antenna seen so far, as `cuts` has them."""
    pieces = {name: Pieces(parts) for name, parts in logs.items()}
    for cut in cuts({name: own.more for name, own in pieces.items()}):
        yield {name: pieces[name].take(len(times)) for name, times in cut.items()}
