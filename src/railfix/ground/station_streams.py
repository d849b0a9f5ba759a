"""Reference triangle on live streams: fixes of the receivers at each common epoch, as it arrives."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import MismatchError
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.ground.station_fixes import FALLEN_DBHZ, StationFixes, no_fixes, rounded, station_fixes
from railfix.live.arrivals import arrivals, fresh_state, next_arrival
from railfix.live.settings import LiveSettings
from railfix.live.stream import ReceivedData
from railfix.pipeline.config import Config
from railfix.pipeline.received import Received as Known
from railfix.pipeline.received import known_from_start, receive

#: Epochs that may wait for the other receivers.
_LONGEST_QUEUE: Final = 1000
#: Epochs over which the usual C/N0 of a receiver is taken.
_USUAL_EPOCHS: Final = 600


class StationStreams:
    """Fixes of receivers at known points from their epochs as they arrive.

    An epoch counts when every receiver has it; older ones that wait are then dropped. A receiver that sends nothing
    therefore gives no fixes at all, which the monitor finds by their lateness. Records from the streams are added to
    the navigation known from the start; epochs at whole multiples of the period are used.

    Attributes
    ----------
    counts : Counter of str
        Epochs "used", "incomplete", and "without common satellites".
    """

    def __init__(
        self,
        points_ecef_m: Floats,
        *,
        navigation: Navigation | None = None,
        config: Config | None = None,
        period_s: float = 1.0,
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._points, self._config = points_ecef_m, config or Config()
        self._known: Known = known_from_start(self._config, navigation=navigation)
        self._period = round(period_s * 1e9)
        self._waiting: dict[np.datetime64, dict[int, Observations]] = {}
        self._done = np.datetime64("1980-01-06", "ns")
        self._levels = [deque[float](maxlen=_USUAL_EPOCHS) for _ in points_ecef_m]

    def add_navigation(self, navigation: Navigation) -> None:
        """Take navigation records."""
        self._known = receive(self._known, self._config, np.datetime64("NaT", "ns"), navigation=navigation)

    def push(self, receiver: int, epoch: Observations) -> StationFixes | None:
        """Take one epoch of a receiver; return the fixes where all receivers have sent theirs."""
        tag = rounded(epoch.time)[0]
        tag_ns = int(tag.astype(np.int64))
        if tag_ns % self._period or tag <= self._done:
            return None
        for later, epochs in list(self._waiting.items()):
            # the receiver's tags were in the future: they would push out those of the others
            if later > tag and epochs.pop(receiver, None) is not None and not epochs:
                del self._waiting[later]
        together = self._waiting.setdefault(tag, {})
        together[receiver] = epoch
        if len(together) < len(self._points):
            if len(self._waiting) > _LONGEST_QUEUE:
                del self._waiting[min(self._waiting)]
                self.counts["incomplete"] += 1
            return None
        self.counts["incomplete"] += sum(older < tag for older in self._waiting)
        self._waiting = {later: epochs for later, epochs in self._waiting.items() if later > tag}
        self._done = tag
        return self._fixes(tag, [together[k] for k in range(len(self._points))])

    def _fixes(self, tag: np.datetime64, epochs: list[Observations]) -> StationFixes:
        fallen = np.zeros((1, len(epochs)), dtype=bool)
        for k, epoch in enumerate(epochs):
            seen = epoch.cn0_dbhz[np.isfinite(epoch.cn0_dbhz)]
            level = float(seen.mean()) if len(seen) else 0.0
            fallen[0, k] = bool(self._levels[k]) and level < float(np.median(self._levels[k])) - FALLEN_DBHZ
            self._levels[k].append(level)
        try:
            fixes = station_fixes(epochs, self._points, self._known.navigation, config=self._config)
            self.counts["used"] += 1
        except MismatchError:
            self.counts["without common satellites"] += 1
            fixes = no_fixes(np.array([tag]), self._points)
        return replace(fixes, cn0_fallen=fallen)


async def stream_fixes(
    sources: Sequence[str],
    points_ecef_m: Floats,
    *,
    navigation: Navigation | None = None,
    config: Config | None = None,
    settings: LiveSettings | None = None,
    period_s: float = 1.0,
) -> AsyncIterator[StationFixes]:
    """Fixes of one epoch at a time, until every source has ended.

    The sources are as of ``railfix live`` (``tcp://HOST:PORT``, ``ntrip://``, ``serial:``, receivers' files), and RINEX
    files too. InputFileError: when a source cannot be opened, or breaks and is not opened again.
    """
    settings = settings or LiveSettings()
    stations = StationStreams(points_ecef_m, navigation=navigation, config=config, period_s=period_s)
    queue: asyncio.Queue[tuple[int, ReceivedData | None]] = asyncio.Queue(2 * len(sources))

    async def pump(receiver: int, source: str) -> None:
        async for item in arrivals(source, fresh_state(source), settings):
            if isinstance(item, ReceivedData):
                await queue.put((receiver, item))
        await queue.put((receiver, None))

    pumps = [asyncio.create_task(pump(k, source)) for k, source in enumerate(sources)]
    running = len(pumps)
    try:
        while running:
            arrived = await next_arrival(queue, pumps)
            for task in pumps:
                if task.done():
                    task.result()  # an error of a source ends the session
            if arrived is None:
                continue
            receiver, received = arrived
            if received is None:
                running -= 1
                continue
            if received.navigation is not None:
                stations.add_navigation(received.navigation)
            for epoch in received.epochs:
                if (fixes := stations.push(receiver, epoch)) is not None:
                    yield fixes
    finally:
        for task in pumps:
            task.cancel()
        await asyncio.gather(*pumps, return_exceptions=True)
