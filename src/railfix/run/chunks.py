"""Logs of several antennas as chunks that cover the same span of time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np

from railfix.gnss.observations import Observations, concatenate

#: Tags of two receivers that differ by no more than this belong to one instant [ns].
SAME_INSTANT_NS: Final = 20_000_000


def _spacing_ns(part: Observations) -> int:
    """Usual spacing of the epochs of a part [ns]; 0 when it has one epoch."""
    if len(part) < 2:
        return 0
    return int(np.median(np.diff(part.time).astype(np.int64)))


def aligned(logs: Mapping[str, Iterator[Observations]]) -> Iterator[dict[str, Observations]]:
    """Chunks that cover the same span of time for every antenna.

    Each antenna keeps its own epochs. A chunk ends where the first of the current parts ends;
    what the others have beyond waits for the next chunk. Epochs that belong together but are
    tagged a little apart (`SAME_INSTANT_NS`) stay in one chunk.

    Parameters
    ----------
    logs : mapping of str to iterator of Observations
        Parts of the log of each antenna, in order of time.

    Yields
    ------
    dict of str to Observations
        All antennas that have been seen so far; one without epochs in the span has zero length.
    """
    live = dict(logs)
    waiting: dict[str, Observations] = {}
    spacing: dict[str, int] = {}
    while True:
        for name in list(live):
            if len(waiting.get(name, ())):
                continue
            part = next(live[name], None)
            if part is None:
                del live[name]
                continue
            waiting[name] = part
            spacing[name] = _spacing_ns(part) or spacing.get(name, 0)
        ends = [waiting[name].time[-1] for name in live]
        if not any(len(part) for part in waiting.values()):
            return
        if ends:
            slack = min(SAME_INSTANT_NS, *(spacing[name] // 2 for name in live))
            horizon = min(ends) + np.timedelta64(slack, "ns")
            cut = {n: int(np.searchsorted(p.time, horizon, side="right")) for n, p in waiting.items()}
        else:
            cut = {name: len(part) for name, part in waiting.items()}
        yield {name: part[: cut[name]] for name, part in waiting.items()}
        rest = {name: part[cut[name] :] for name, part in waiting.items()}
        # A short rest would cut every chunk that follows in two: it is joined with the next part.
        short = [n for n in live if 0 < len(rest[n]) < len(waiting[n]) // 2]
        waiting = rest
        for name in short:
            part = next(live[name], None)
            if part is None:
                del live[name]
            else:
                waiting[name] = concatenate([rest[name], part])
