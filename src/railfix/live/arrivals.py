"""What the data of a source complete as they arrive: of a receiver's stream or log, or of a RINEX file."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Sequence
from typing import Any, TypeVar

import numpy as np

from railfix.io.receiver.framing import head_of, is_receiver_log
from railfix.io.receiver.log import StreamState
from railfix.io.rinex import scan_observations
from railfix.live.settings import LiveSettings
from railfix.live.sources import Connected, Lost, Place, is_file, read_source
from railfix.live.stream import ReceivedData, ReceiverState, receive_bytes, single_epochs

Item = TypeVar("Item")


def fresh_state(source: str, date: np.datetime64 | None = None) -> ReceiverState:
    """State of a stream before its first byte; `date` as for `railfix.live.run_session`."""
    if date is None and not is_file(source):
        date = np.datetime64(time.time_ns(), "ns")  # leap seconds do not matter here
    return ReceiverState() if date is None else ReceiverState(stream=StreamState(time=date.astype("datetime64[ns]")))


async def arrivals(
    source: str, state: ReceiverState, settings: LiveSettings, place: Place | None = None
) -> AsyncIterator[ReceivedData | Connected | Lost]:
    """What a source's data complete, item by item, and the breaks of its connection; `place` as for `read_source`."""
    path = source.removeprefix("file:")
    if source != "-" and is_file(source) and not is_receiver_log(head_of(path)):
        for piece in scan_observations(path, epochs=200):
            for epoch in single_epochs(piece):
                yield ReceivedData(epochs=(epoch,), after=state)
                await asyncio.sleep(0)
        return
    async for part in read_source(source, settings, place):
        if isinstance(part, bytes):
            for item in receive_bytes(part, state):
                state = item.after
                yield item
        else:
            if isinstance(part, Lost):
                state = state.after_break()
            yield part


async def next_arrival(
    queue: asyncio.Queue[Item], pumps: Sequence[asyncio.Task[Any]], *, wait_s: float | None = None
) -> Item | None:
    """The next item that the pumps have put; None after `wait_s`, or when one has ended by an error."""
    if not queue.empty():
        await asyncio.sleep(0)  # signals act also where data come faster than they are processed
        return queue.get_nowait()
    getting = asyncio.ensure_future(queue.get())
    running = [pump for pump in pumps if not pump.done()]
    await asyncio.wait([getting, *running], timeout=wait_s, return_when=asyncio.FIRST_COMPLETED)
    if getting.done():
        return getting.result()
    getting.cancel()
    return None
