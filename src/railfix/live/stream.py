"""Epochs, navigation records and SBAS messages that the data of a source complete as they arrive."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from railfix.core.arrays import Bytes, Indices
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io.receiver import rtcm, sbf, ubx
from railfix.io.receiver.ephemerides import navigation_of
from railfix.io.receiver.framing import SbasFrames, find_frames, head_of, is_receiver_log
from railfix.io.receiver.log import StreamState, at_station, decode
from railfix.io.receiver.measurements import Tracking, observations_of
from railfix.io.rinex import scan_observations
from railfix.live.settings import LiveSettings
from railfix.live.sources import Connected, Lost, Place, is_file, read_source


@dataclass(frozen=True, kw_only=True)
class ReceiverState:
    """State of a receiver's stream after some bytes."""

    stream: StreamState = field(default_factory=StreamState)
    tracking: Tracking = field(default_factory=Tracking)

    def after_break(self) -> ReceiverState:
        """The state after a break of the connection: the start of a frame whose end never comes is dropped."""
        return replace(self, stream=replace(self.stream, rest=b""))


@dataclass(frozen=True, kw_only=True)
class ReceivedData:
    """What some bytes completed."""

    epochs: tuple[Observations, ...]  #: One epoch each, with the channels observed in it.
    navigation: Navigation | None = None
    sbas: SbasFrames | None = None
    skipped_bytes: int = 0
    bad_checksums: int = 0
    passed_over: dict[str, int] = field(default_factory=dict)
    after: ReceiverState = field(default_factory=ReceiverState)  #: Of the stream after these bytes.


def receive_bytes(data: bytes, state: ReceiverState) -> Iterator[ReceivedData]:
    """What some bytes of a receiver complete, in the order of the stream; any cutting of the stream gives the same.

    Each item ends with the message that completes an epoch, so that its navigation records came before its epoch.
    The state to go on with is that of the last item, `ReceivedData.after`; there is always one. Epochs with repeated or
    older time tags are kept: `LiveEngine.push` judges them.
    """
    kept = len(state.stream.rest)
    ends = epoch_ends(np.frombuffer(state.stream.rest + data, dtype=np.uint8)) - kept
    place = 0
    for end in [*np.unique(ends[(ends > 0) & (ends < len(data))]).tolist(), len(data)]:
        item = _receive(data[place:end], state)
        place, state = end, item.after
        yield item


def epoch_ends(buffer: Bytes) -> Indices:
    """Places after the messages that complete an epoch: RXM-RAWX, MeasEpoch, and the last MSM of an epoch."""
    frames = find_frames(buffer, at_end=False)
    raw, msm = frames.of("ubx", ubx.RXM_RAWX), frames.of("rtcm3", *rtcm.MSM_NUMBERS)
    last = msm[rtcm.completes_epoch(frames, msm)]
    return np.sort(
        np.concatenate([frames.end[raw] + 2, frames.end[frames.of("sbf", sbf.MEAS_EPOCH)], frames.end[last] + 3])
    )


def _receive(data: bytes, state: ReceiverState) -> ReceivedData:
    piece, stream = decode(data, state.stream)
    observations, tracking = observations_of(
        piece.measurements, replace(state.tracking, last=np.datetime64("NaT", "ns"))
    )
    records = piece.ephemerides
    return ReceivedData(
        epochs=single_epochs(at_station(observations, piece.station)),
        navigation=navigation_of(records) if records.records or records.klobuchar else None,
        sbas=piece.sbas if len(piece.sbas) else None,
        skipped_bytes=piece.skipped_bytes,
        bad_checksums=piece.bad_checksums,
        passed_over={**observations.skipped, **records.skipped},
        after=ReceiverState(stream=stream, tracking=tracking),
    )


def single_epochs(observations: Observations) -> tuple[Observations, ...]:
    """Observations epoch by epoch, each with the channels that have a value in it."""
    epochs = []
    for k in range(len(observations)):
        part = observations[k : k + 1]
        seen = np.isfinite(part.code_m[0]) | np.isfinite(part.phase_cycles[0]) | np.isfinite(part.cn0_dbhz[0])
        names = ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock")
        epochs.append(
            replace(
                part,
                satellite=part.satellite[seen],
                signal=part.signal[seen],
                **{name: getattr(part, name)[:, seen] for name in names},
            )
        )
    return tuple(epochs)


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
