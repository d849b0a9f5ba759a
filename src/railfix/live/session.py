"""A live session: sources to engine to sinks, until the sources end or the program is stopped."""

from __future__ import annotations

import asyncio
import gc
import logging
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.files import FilePath
from railfix.core.timescale import GPS_EPOCH, utc_to_gpst
from railfix.io.receiver.log import StreamState
from railfix.io.receiver.recognise import head_of, is_receiver_log
from railfix.io.rinex import scan_observations
from railfix.live.channels import TwoChannels
from railfix.live.engine import LiveEngine, LiveOutput
from railfix.live.metrics import Metrics
from railfix.live.sinks import Sink
from railfix.live.sources import Connected, Lost, hidden, is_file, read_source
from railfix.live.state import SavedSession
from railfix.live.stream import Received, ReceiverState, receive_bytes, single_epochs
from railfix.ranges.sbas import from_receiver

#: Items that may wait for the processor before a source is held back.
_LONGEST_QUEUE: Final = 64
#: Messages between two collections of garbage, in idle time.
_BETWEEN_COLLECTIONS: Final = 100
#: How often the status is shown [s].
_STATUS_S: Final = 0.5
#: A time after all epochs [ns].
_END_NS: Final = 1 << 62

_LOG: Final = logging.getLogger("railfix.live")
_Queue = asyncio.Queue[tuple[str, Received | None]]


@dataclass(frozen=True, kw_only=True)
class Hooks:
    """What else a session does.

    Attributes
    ----------
    observe : callable or None
        Called with every output, after the sinks.
    save : callable or None
        Called every `LiveSettings.state_every_s`, in idle time, with what a restart needs.
    show : callable or None
        Called with a text for the status line, twice a second.
    """

    observe: Callable[[LiveOutput], None] | None = None
    save: Callable[[SavedSession], None] | None = None
    show: Callable[[str], None] | None = None


@dataclass(kw_only=True)
class _Clocks:
    """When things were done last, monotonic time."""

    saved: float = field(default_factory=time.monotonic)
    shown: float = 0.0
    since_collection: int = 0


async def run_session(
    engine: LiveEngine | TwoChannels,
    sources: Mapping[str, str],
    sinks: Sequence[Sink],
    *,
    speed: float | None,
    metrics: Metrics | None = None,
    hooks: Hooks | None = None,
    date: np.datetime64 | None = None,
    streams: Mapping[str, ReceiverState] | None = None,
) -> Metrics:
    """Process sources until all have ended.

    Parameters
    ----------
    engine : LiveEngine or TwoChannels
    sources : mapping of str to str
        By antenna; see `railfix.live.sources.read_source`. RINEX observation files are replayed as well.
    sinks : sequence of Sink
    speed : float or None
        For recorded files: times as fast as recorded. None: as fast as they go; the clock is then that of the time
        tags (set `LiveSettings.no_input` to "skip" for one message an epoch and no more).
    metrics : Metrics, optional
    hooks : Hooks, optional
    date : datetime64, optional
        Some time within half a week of RTCM 3 streams, whose observations carry no week: now where they are live.
    streams : mapping of str to ReceiverState, optional
        State of the receivers' streams to continue from.

    Raises
    ------
    InputFileError
        A source cannot be opened, or breaks and is not opened again.
    OutputError
        A sink of a replay cannot be written.
    ChannelsDisagreeError
        Two channels differ.
    """
    metrics, hooks, clocks = metrics or Metrics(), hooks or Hooks(), _Clocks()
    metrics.epochs, metrics.sinks = engine.counts, sinks
    replay = speed is None and all(is_file(source) for source in sources.values())
    states = {name: (streams or {}).get(name) or _fresh(source, date) for name, source in sources.items()}
    queue: _Queue = asyncio.Queue(_LONGEST_QUEUE)
    running, read_to_ns = set(sources), dict.fromkeys(sources, -1)
    gc.collect()
    gc.freeze()
    gc.disable()  # collections come in idle time
    if not replay:
        engine.start(now_ns=time.monotonic_ns())
    pumps = [
        asyncio.create_task(_pump(name, source, states[name], speed, engine, metrics, queue))
        for name, source in sources.items()
    ]
    try:
        while running:
            for pump in pumps:
                if pump.done() and queue.empty():
                    pump.result()  # an error of a source ends the session, after what came before it
            wait = None if replay else max(engine.wait_s(now_ns=time.monotonic_ns()), 0.001)
            item = await _next(queue, wait, pumps)
            now = time.monotonic_ns()
            if item is not None:
                name, received = item
                if received is None:
                    running.discard(name)
                    read_to_ns.pop(name)
                else:
                    states[name] = received.after
                    tag_ns = _take(engine, name, received, metrics, None if replay else now)
                    read_to_ns[name] = max(read_to_ns[name], tag_ns)
            # In a replay the clock is the tag up to which all files have been read: no pair is torn, whatever file is
            # ahead.
            clock, sent = (min(read_to_ns.values(), default=_END_NS), None) if replay else (now, _gps_now_ns())
            outputs = _emit(engine, sinks, metrics, hooks, clock, sent)
            if queue.empty() or replay:
                _in_idle_time(engine, states, outputs, metrics, hooks, clocks)
        _save(engine, states, hooks)
    except asyncio.CancelledError:
        _save(engine, states, hooks)
        raise
    finally:
        while pending := [pump for pump in pumps if not pump.done()]:
            for pump in pending:
                pump.cancel()
            await asyncio.wait(pending, timeout=1.0)
        gc.enable()
        gc.unfreeze()
    return metrics


def _fresh(source: str, date: np.datetime64 | None) -> ReceiverState:
    """State of a stream before its first byte."""
    if date is None and not is_file(source):
        date = np.datetime64(time.time_ns(), "ns")  # leap seconds do not matter here
    return ReceiverState() if date is None else ReceiverState(stream=StreamState(time=date.astype("datetime64[ns]")))


def _save(engine: LiveEngine | TwoChannels, states: Mapping[str, ReceiverState], hooks: Hooks) -> None:
    """Hand over what a restart needs, where there is something and somebody wants it."""
    if hooks.save is not None and (saved := engine.saved()) is not None:
        hooks.save(SavedSession(engine=saved, streams={name: state.after_break() for name, state in states.items()}))


async def _next(
    queue: _Queue, wait_s: float | None, pumps: list[asyncio.Task[None]]
) -> tuple[str, Received | None] | None:
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
    name: str,
    source: str,
    state: ReceiverState,
    speed: float | None,
    engine: LiveEngine | TwoChannels,
    metrics: Metrics,
    queue: _Queue,
) -> None:
    """Move what a source's data complete into the queue, then None; recorded epochs wait for their time."""
    pace = _Pace(speed) if speed is not None and is_file(source) else None
    async for received in _received(name, source, state, engine, metrics):
        if pace is not None and received.epochs:
            await pace.wait(received.epochs[-1].time[-1])
        await queue.put((name, received))
    await queue.put((name, None))


class _Pace:
    """Waits until a recorded time tag is due."""

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._began = 0.0
        self._first: np.datetime64 | None = None

    async def wait(self, tag: np.datetime64) -> None:
        now = asyncio.get_running_loop().time()
        if self._first is None:
            self._began, self._first = now, tag
        due = self._began + float((tag - self._first) / np.timedelta64(1, "s")) / self._speed
        await asyncio.sleep(max(0.0, due - now))


async def _received(
    name: str, source: str, state: ReceiverState, engine: LiveEngine | TwoChannels, metrics: Metrics
) -> AsyncIterator[Received]:
    """What a source's data complete, item by item; breaks of its connection are logged and counted."""
    if source != "-" and is_file(source) and not is_receiver_log(head_of(_path(source))):
        for piece in scan_observations(_path(source), epochs=200):
            for epoch in single_epochs(piece):
                yield Received(epochs=(epoch,), after=state)
                await asyncio.sleep(0)
        return
    async for part in read_source(source, engine.settings):
        if isinstance(part, bytes):
            items, state = receive_bytes(part, state)
            for item in items:
                yield item
        elif isinstance(part, Lost):
            metrics.lost[hidden(source)] += 1
            state = state.after_break()
            _LOG.warning("%s: %s: %s; next attempt in %.1f s", name, hidden(source), part.reason, part.wait_s)
        elif isinstance(part, Connected):
            again = f", after {part.broken} breaks" if part.broken else ""
            _LOG.info("%s: connected to %s%s", name, hidden(source), again)


def _path(source: str) -> FilePath:
    return source.removeprefix("file:")


def _take(engine: LiveEngine | TwoChannels, name: str, received: Received, metrics: Metrics, now_ns: int | None) -> int:
    """Hand what one source has completed to the engine; without a clock the epochs arrive at their tags.

    Returns the tag of the last epoch [ns], -1 without one.
    """
    metrics.skipped.update(received.passed_over)
    metrics.skipped["bytes outside messages"] += received.skipped_bytes
    metrics.skipped["messages with a bad checksum"] += received.bad_checksums
    if received.navigation is not None:
        engine.learn(received.navigation)
    if received.sbas is not None and engine.uses_sbas:
        messages = from_receiver(received.sbas, source=name)
        metrics.skipped.update({f"SBAS messages: {why}": n for why, n in messages.rejected.items() if n})
        if len(messages):
            engine.hear(messages)
    tag_ns = -1
    for epoch in received.epochs:
        tag_ns = int((epoch.time[0] - GPS_EPOCH).astype(np.int64))
        engine.push(name, epoch, now_ns=tag_ns if now_ns is None else now_ns)
    return tag_ns


def _emit(
    engine: LiveEngine | TwoChannels,
    sinks: Sequence[Sink],
    metrics: Metrics,
    hooks: Hooks,
    now_ns: int,
    sent_ns: int | None,
) -> list[LiveOutput]:
    began = time.perf_counter()
    outputs = engine.poll(now_ns=now_ns, sent_ns=sent_ns)
    if outputs:
        metrics.took(time.perf_counter() - began, outputs)
    for output in outputs:
        for sink in sinks:
            sink.send(output)
        if hooks.observe is not None:
            hooks.observe(output)
    return outputs


def _in_idle_time(
    engine: LiveEngine | TwoChannels,
    states: Mapping[str, ReceiverState],
    outputs: Sequence[LiveOutput],
    metrics: Metrics,
    hooks: Hooks,
    clocks: _Clocks,
) -> None:
    """Log, status, state and garbage, while no data wait."""
    while engine.told:
        _LOG.warning("%s", engine.told.popleft())
    now = time.monotonic()
    if hooks.show is not None and outputs and now - clocks.shown >= _STATUS_S:
        clocks.shown = now
        hooks.show(status_text(outputs[-1], metrics))
    if outputs and now - clocks.saved >= engine.settings.state_every_s:
        clocks.saved = now
        _save(engine, states, hooks)
    clocks.since_collection += len(outputs)
    if clocks.since_collection >= _BETWEEN_COLLECTIONS:
        clocks.since_collection = 0
        gc.collect()


def status_text(output: LiveOutput, metrics: Metrics) -> str:
    """The status line: time, status, place, speed, satellites, processing time, what was lost."""
    message = output.message
    at = GPS_EPOCH + np.timedelta64(message.time_ns, "ns")
    words = [f"{np.datetime_as_string(at, unit='ms')[11:]} GPST", message.status.name.lower()]
    if message.chainage_cm is not None:
        bound = "" if message.over_cm is None else f" ± {message.over_cm / 100:.1f}"
        words.append(f"{message.chainage_cm / 100:,.1f}{bound} m")
    if message.speed_cmps is not None:
        words.append(f"{message.speed_cmps * 0.036:.0f} km/h")
    if output.result is not None:
        used = "+".join(str(int(antenna.n_used[-1])) for antenna in output.result.antennas.values())
        words.append(f"{used} satellites")
    words.append(f"{1e3 * float(np.median(metrics.processing_s)):.0f} ms")
    words.append(f"{sum(metrics.messages.values()):,} messages")
    if lost := sum(metrics.lost.values()):
        words.append(f"connections lost {lost}")
    if dropped := sum(sink.dropped + sink.failed for sink in metrics.sinks):
        words.append(f"not delivered {dropped}")
    return "  ".join(words)


def _gps_now_ns() -> int:
    """The computer's clock as GPS time since 1980 [ns]."""
    now = np.datetime64(time.time_ns(), "ns")
    return int((utc_to_gpst(now) - GPS_EPOCH).astype(np.int64))
