"""A live session: sources to engine to sinks, until the sources end or the program is stopped."""

from __future__ import annotations

import asyncio
import gc
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from railfix.core.timescale import GPS_EPOCH, utc_to_gpst
from railfix.gnss.observations import Observations
from railfix.io.receiver.log import head_of, is_receiver_log
from railfix.io.rinex import scan_observations
from railfix.io.train_message import MessageStatus
from railfix.live.channels import TwoChannels
from railfix.live.engine import LiveEngine, LiveOutput
from railfix.live.sinks import Sink
from railfix.live.sources import read_source
from railfix.live.stream import ReceiverState, receive_bytes, single_epochs

#: Blocks of bytes that may wait for the processor before a source is held back.
_LONGEST_QUEUE = 64
#: A time after all epochs [ns].
_END_NS = 1 << 62


@dataclass(kw_only=True)
class Metrics:
    """Counts and times of a session.

    Attributes
    ----------
    messages : Counter of MessageStatus
    skipped : Counter of str
        Bytes and messages of the receivers that were not used.
    processing_s : list of float
        Of the last messages, at most 1000.
    started : float
    """

    messages: Counter[MessageStatus] = field(default_factory=Counter)
    skipped: Counter[str] = field(default_factory=Counter)
    processing_s: list[float] = field(default_factory=list)
    started: float = field(default_factory=time.monotonic)

    def took(self, seconds: float, outputs: list[LiveOutput]) -> None:
        """Count messages and the time they took together."""
        for output in outputs:
            self.messages[output.message.status] += 1
            self.processing_s.append(seconds / len(outputs))
        del self.processing_s[:-1000]

    def text(self, counts: Mapping[str, int]) -> str:
        """The metrics in the text format of Prometheus (version 0.0.4)."""
        lines = ["# TYPE railfix_messages_total counter"]
        lines += [
            f'railfix_messages_total{{status="{status.name.lower()}"}} {self.messages[status]}'
            for status in MessageStatus
        ]
        lines.append("# TYPE railfix_epochs_total counter")
        lines += [f'railfix_epochs_total{{fate="{fate}"}} {number}' for fate, number in sorted(counts.items())]
        lines.append("# TYPE railfix_skipped_total counter")
        lines += [f'railfix_skipped_total{{what="{what}"}} {number}' for what, number in sorted(self.skipped.items())]
        if self.processing_s:
            lines.append("# TYPE railfix_processing_seconds summary")
            for quantile in (0.5, 0.99):
                value = float(np.quantile(self.processing_s, quantile))
                lines.append(f'railfix_processing_seconds{{quantile="{quantile}"}} {value:.6f}')
        lines.append("# TYPE railfix_uptime_seconds gauge")
        lines.append(f"railfix_uptime_seconds {time.monotonic() - self.started:.1f}")
        return "\n".join(lines) + "\n"


async def serve_metrics(metrics: Metrics, engine: LiveEngine | TwoChannels, host: str, port: int) -> asyncio.Server:
    """Serve ``/metrics`` over HTTP."""

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = await reader.readline()
        found = request.split(b" ")[1:2] == [b"/metrics"]
        body = metrics.text(engine.counts).encode() if found else b"not found; see /metrics\n"
        head = f"HTTP/1.1 {'200 OK' if found else '404 Not Found'}\r\nContent-Type: text/plain; version=0.0.4\r\n"
        writer.write(f"{head}Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body)
        await writer.drain()
        writer.close()

    return await asyncio.start_server(answer, host, port)


async def run_session(
    engine: LiveEngine | TwoChannels,
    sources: Mapping[str, str],
    sinks: list[Sink],
    *,
    speed: float | None,
    metrics: Metrics | None = None,
    observe: Callable[[LiveOutput], None] | None = None,
) -> Metrics:
    """Process sources until all have ended.

    Parameters
    ----------
    engine : LiveEngine or TwoChannels
    sources : mapping of str to str
        By antenna; see `railfix.live.sources.read_source`. RINEX observation files are replayed as well.
    sinks : list of Sink
    speed : float or None
        For recorded files: times as fast as recorded. None: as fast as they go; the clock is then that of the time
        tags (set `LiveSettings.no_input` to "skip" for one message an epoch and no more).
    metrics : Metrics, optional
    observe : callable, optional
        Called with every output, after the sinks.

    Raises
    ------
    InputFileError
        A source cannot be opened, or breaks.
    ChannelsDisagreeError
        Two channels differ.
    """
    metrics = metrics or Metrics()
    queue: asyncio.Queue[tuple[str, bytes | Observations | None]] = asyncio.Queue(_LONGEST_QUEUE)
    replay = speed is None and all(_is_file(source) for source in sources.values())
    states = {name: ReceiverState() for name in sources}
    running, read_to_ns = set(sources), dict.fromkeys(sources, -1)
    gc.collect()
    gc.freeze()
    pumps = [asyncio.create_task(_pump(name, source, speed, queue)) for name, source in sources.items()]
    try:
        while running:
            for pump in pumps:
                if pump.done():
                    pump.result()  # an error of a source ends the session
            wait = None if replay else max(engine.wait_s(now_ns=time.monotonic_ns()), 0.001)
            item = await _next(queue, wait, pumps)
            now = time.monotonic_ns()
            if item is not None:
                name, data = item
                if data is None:
                    running.discard(name)
                    read_to_ns.pop(name)
                else:
                    states[name], tag_ns = _take(engine, name, data, states[name], metrics, None if replay else now)
                    read_to_ns[name] = max(read_to_ns[name], tag_ns)
            if replay:
                # The clock is the tag up to which all files have been read: no pair is torn, whatever file is ahead.
                _emit(engine, sinks, metrics, observe, min(read_to_ns.values(), default=_END_NS), None)
            else:
                _emit(engine, sinks, metrics, observe, now, _gps_now_ns())
    finally:
        for pump in pumps:
            pump.cancel()
        gc.unfreeze()
    return metrics


def _is_file(source: str) -> bool:
    return Path(source.removeprefix("file:")).is_file()


async def _next(
    queue: asyncio.Queue[tuple[str, bytes | Observations | None]],
    wait_s: float | None,
    pumps: list[asyncio.Task[None]],
) -> tuple[str, bytes | Observations | None] | None:
    """The next data; None after `wait_s`, or when a source has ended by an error."""
    if not queue.empty():
        return queue.get_nowait()
    getting = asyncio.ensure_future(queue.get())
    running = [pump for pump in pumps if not pump.done()]
    await asyncio.wait([getting, *running], timeout=wait_s, return_when=asyncio.FIRST_COMPLETED)
    if getting.done():
        return getting.result()
    getting.cancel()
    return None


async def _pump(
    name: str, source: str, speed: float | None, queue: asyncio.Queue[tuple[str, bytes | Observations | None]]
) -> None:
    """Move a source's data into the queue, then None."""
    parts: AsyncIterator[bytes | Observations] = (
        _epochs(source, speed) if _is_rinex(source) else read_source(source, speed=speed)
    )
    async for part in parts:
        await queue.put((name, part))
    await queue.put((name, None))


def _is_rinex(source: str) -> bool:
    path = source.removeprefix("file:")
    return Path(path).is_file() and not is_receiver_log(head_of(path))


async def _epochs(source: str, speed: float | None) -> AsyncIterator[Observations]:
    """A RINEX file epoch by epoch, paced by its time tags where a speed is given."""
    loop = asyncio.get_running_loop()
    began, first = loop.time(), None
    for piece in scan_observations(source.removeprefix("file:"), epochs=200):
        for epoch in single_epochs(piece):
            if speed is not None:
                first = epoch.time[0] if first is None else first
                due = began + float((epoch.time[0] - first) / np.timedelta64(1, "s")) / speed
                await asyncio.sleep(max(0.0, due - loop.time()))
            yield epoch
            await asyncio.sleep(0)


def _take(
    engine: LiveEngine | TwoChannels,
    name: str,
    data: bytes | Observations,
    state: ReceiverState,
    metrics: Metrics,
    now_ns: int | None,
) -> tuple[ReceiverState, int]:
    """Hand some data of one source to the engine; without a clock the epochs arrive at their tags.

    Returns the stream's new state, and the tag of its last epoch [ns], -1 without one.
    """
    tag_ns = -1
    if isinstance(data, Observations):
        tag_ns = _push(engine, name, data, now_ns)
    else:
        items, state = receive_bytes(data, state)
        for received in items:
            metrics.skipped.update(received.passed_over)
            metrics.skipped["bytes outside messages"] += received.skipped_bytes
            metrics.skipped["messages with a bad checksum"] += received.bad_checksums
            if received.navigation is not None:
                engine.learn(received.navigation)
            for epoch in received.epochs:
                tag_ns = _push(engine, name, epoch, now_ns)
    return state, tag_ns


def _push(engine: LiveEngine | TwoChannels, name: str, epoch: Observations, now_ns: int | None) -> int:
    tag_ns = int((epoch.time[0] - GPS_EPOCH).astype(np.int64))
    engine.push(name, epoch, now_ns=tag_ns if now_ns is None else now_ns)
    return tag_ns


def _emit(
    engine: LiveEngine | TwoChannels,
    sinks: list[Sink],
    metrics: Metrics,
    observe: Callable[[LiveOutput], None] | None,
    now_ns: int,
    sent_ns: int | None,
) -> None:
    began = time.perf_counter()
    outputs = engine.poll(now_ns=now_ns, sent_ns=sent_ns)
    if outputs:
        metrics.took(time.perf_counter() - began, outputs)
    for output in outputs:
        for sink in sinks:
            sink.send(output)
        if observe is not None:
            observe(output)


def _gps_now_ns() -> int:
    """The computer's clock as GPS time since 1980 [ns]."""
    now = np.datetime64(time.time_ns(), "ns")
    return int((utc_to_gpst(now) - GPS_EPOCH).astype(np.int64))
