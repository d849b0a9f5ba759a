"""Logs of several antennas as chunks that cover the same span of time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Final, TypeVar

import numpy as np

from railfix.core.arrays import Datetimes
from railfix.core.reasons import Status
from railfix.gnss.observations import Observations, concatenate
from railfix.pipeline.along_track import doubted
from railfix.pipeline.config import Config
from railfix.pipeline.level_stage import judged
from railfix.pipeline.results import Result
from railfix.run.route import RouteOfLog
from railfix.tracking.result import TrackStatus, is_bounded

Item = TypeVar("Item")
#: Tags of two receivers that differ by no more than this belong to one instant [ns].
SAME_INSTANT_NS: Final = 20_000_000


def _spacing_ns(time: Datetimes) -> int:
    """Usual spacing of the epochs of a part [ns]; 0 when it has one epoch."""
    if len(time) < 2:
        return 0
    return int(np.median(np.diff(time).astype(np.int64)))


def aligned(logs: Mapping[str, Iterator[Observations]]) -> Iterator[dict[str, Observations]]:
    """Chunks of observations that cover the same span of time for every antenna.

    Each antenna keeps its own epochs. A chunk ends where the first of the current parts ends;
    what the others have beyond waits for the next chunk. Epochs that belong together but are
    tagged a little apart (`SAME_INSTANT_NS`) stay in one chunk.

    Yields
    ------
    dict of str to Observations
        All antennas that have been seen so far; empty for one without epochs in the span.
    """
    live = dict(logs)
    waiting: dict[str, Observations] = {}
    spacing: dict[str, int] = {}

    def read(name: str) -> None:
        part = next(live[name], None)
        if part is None:
            del live[name]
            return
        spacing[name] = _spacing_ns(part.time) or spacing.get(name, 0)
        rest = waiting.get(name)
        waiting[name] = concatenate([rest, part]) if rest is not None and len(rest) else part

    while True:
        for name in list(live):
            if not len(waiting.get(name, ())):
                read(name)
        if not any(map(len, waiting.values())):
            return
        cut = {name: len(part) for name, part in waiting.items()}
        if live:
            slack = min(SAME_INSTANT_NS, *(spacing[name] // 2 for name in live))
            horizon = min(waiting[name].time[-1] for name in live) + np.timedelta64(slack, "ns")
            cut = {name: int(np.searchsorted(part.time, horizon, side="right")) for name, part in waiting.items()}
        yield {name: part[: cut[name]] for name, part in waiting.items()}
        # A short rest would cut every chunk that follows in two: it is joined with the next part.
        short = [n for n in live if 0 < len(waiting[n]) - cut[n] < len(waiting[n]) // 2]
        waiting = {name: part[cut[name] :] for name, part in waiting.items()}
        for name in short:
            read(name)


def read_ahead(items: Iterator[Item]) -> Iterator[Item]:
    """Yield items of which the next one is made by a thread of its own while one is in use."""
    with ThreadPoolExecutor(max_workers=1) as reader:
        coming = reader.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = reader.submit(next, items, None)
            yield item


def without_beside(result: Result, route: RouteOfLog, config: Config) -> Result:
    """Results whose statuses and levels know where another track is more probable than `Config.track_risk`."""
    antennas, fusion = dict(result.antennas), dict(result.fusion)
    for name, single in antennas.items():
        beside = route.is_uncertain(single.time, single.chainage_m, risk=config.track_risk)
        status = np.where(beside & (single.status == Status.OK), np.int8(Status.MAP_OFFSET), single.status)
        protection = single.protection
        if protection is not None:
            has = np.isfinite(single.chainage_m)
            level = replace(protection.level, level_m=np.where(beside & has, np.inf, protection.level.level_m))
            protection = judged(replace(protection, level=level), status, has, single.chainage_m, config)
        antennas[name] = replace(single, status=status, protection=protection)
    for name, filtered in fusion.items():
        tracked = filtered.tracked
        beside = route.is_uncertain(tracked.time, filtered.chainage_m, risk=config.track_risk)
        beside &= is_bounded(tracked.status)
        fusion[name] = replace(filtered, tracked=doubted(tracked, beside, TrackStatus.MAP_OFFSET))
    return replace(result, antennas=antennas, fusion=fusion)
