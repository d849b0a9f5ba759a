"""Live session that passes data from sources to the engine and messages to sinks, until the sources end."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.errors import OutputError
from railfix.core.timescale import GPS_EPOCH
from railfix.core.utc import gps_now_ns
from railfix.gnss.observations import Observations
from railfix.live.console import Metrics
from railfix.live.engine import END_NS, LiveEngine, LiveOutput
from railfix.live.forms import gga_sentence
from railfix.live.sinks import Sink
from railfix.live.sources import Connected, Lost, hidden, is_file, read_source
from railfix.live.state import SavedSession
from railfix.live.stream import (
    FOREVER,
    ReceivedData,
    ReceiverState,
    Sensed,
    SensorLines,
    arrivals,
    fresh_state,
    next_arrival,
)
from railfix.ranges.sbas import from_receiver

#: Number of received items that may wait to be processed; while this number waits, the sources are paused.
_LONGEST_QUEUE: Final = 64
_STATUS_S: Final = 0.5  #: Interval between two updates of the status line [s].

BASE: Final = "base"  #: Key of the base station's source among the sources.

_LOG: Final = logging.getLogger("railfix.live")
#: Items of a source with the source's name: received data; in a replay, the time tag of the file's next epoch [ns],
#: before the file waits for its turn; None at the end.
_Queue = asyncio.Queue[tuple[str, ReceivedData | int | None] | Sensed]


@dataclass(frozen=True, kw_only=True)
class Hooks:
    """Optional callbacks and the metrics of a session."""

    observe: Callable[[LiveOutput], None] | None = None  #: Called with every output, after the sinks.
    sensed: Callable[[Sensed], None] | None = None  #: Called with each chunk of samples decoded from a sensor's source.
    #: Called every `LiveSettings.state_every_s`, at a time when no data wait, with the state from which a restarted
    #: session continues.
    save: Callable[[SavedSession], None] | None = None
    show: Callable[[str], None] | None = None  #: Called twice a second with the text of the status line.
    metrics: Metrics = field(default_factory=Metrics)  #: Metrics, which `run_session` updates and returns.


async def run_session(
    engine: LiveEngine,
    sources: Mapping[str, str],
    sinks: Sequence[Sink],
    *,
    speed: float | None,
    sensors: Mapping[str, str] | None = None,
    hooks: Hooks | None = None,
    date: np.datetime64 | None = None,
    streams: Mapping[str, ReceiverState] | None = None,
) -> Metrics:
    """Process sources until they have ended, and return the metrics of the session.

    Parameters
    ----------
    sources : mapping of str to str
        Source of each antenna, and of a base station (key `BASE`); see `railfix.live.sources.read_source`. RINEX
        observation files are also accepted, and replayed.
    speed : float or None
        Replay speed of recorded files relative to real time. If None, files are replayed as fast as possible, and the
        clock follows the time tags. For exactly one message per epoch, set `LiveSettings.no_input` to "skip".
    sensors : mapping of str to str, optional
        Source of each on-board sensor's stream (`railfix.live.stream`). Tables from files are not included; they must
        be added to the engine beforehand.
    date : datetime64, optional
        A time within half a week of the observations in RTCM 3 streams. It is needed because RTCM 3 has no week
        number. The default is the computer's time, which suits live streams.
    streams : mapping of str to ReceiverState, optional
        States from which the decoding of the receivers' streams continues, by source name.

    Raises
    ------
    InputFileError
        A source cannot be opened, or breaks and is not opened again, or the first line of a sensor's stream is not the
        header of the sensor's table.
    OutputError
        In a replay, a sink cannot be written. The error is raised after all other sinks have been written, or at once
        if no sink is left.
    ChannelsDisagreeError
        The messages, or the results of a processing stage, of two channels differ.
    """
    hooks = hooks or Hooks()
    session = _Session(engine=engine, sinks=sinks, metrics=hooks.metrics, hooks=hooks)
    session.metrics.epochs, session.metrics.sinks = engine.counts, sinks
    replay = speed is None and not sensors and all(is_file(source) for source in sources.values())
    session.streams = {name: (streams or {}).get(name) or fresh_state(source, date) for name, source in sources.items()}
    queue: _Queue = asyncio.Queue(_LONGEST_QUEUE)
    if not replay:
        engine.start(now_ns=time.monotonic_ns())
    if any(is_file(source) for source in sources.values()):
        engine.lag.behind_s = math.inf
    session.read_to_ns = dict.fromkeys(sources, -1)
    files = [name for name, source in sources.items() if is_file(source)]
    turn: _Pace | _InTurn | None = None if speed is None else _Pace(speed, files)
    if isinstance(turn, _Pace) and len(files) == len(sources):
        session.clock = turn.now_ns
    if replay:
        turn = _InTurn(files)
    pumps = [
        asyncio.create_task(session.pump(name, source, turn if name in files else None, queue))
        for name, source in sources.items()
    ]
    pumps += [asyncio.create_task(session.listen(name, source, queue)) for name, source in (sensors or {}).items()]
    try:
        await session.process(queue, pumps, replay=replay)
    finally:
        while pending := [pump for pump in pumps if not pump.done()]:
            for pump in pending:
                pump.cancel()
            await asyncio.wait(pending, timeout=1.0)
    for error in session.ended.values():
        raise error
    return session.metrics


@dataclass(kw_only=True)
class _Session:
    """Running session: engine, sinks, states of the streams, and the monotonic times at which the state was last saved
    and the status last shown [s].

    `read_to_ns` contains, for each source that has not ended, the time [ns] up to which its epochs have been passed to
    the engine; this time is -1 before the first epoch. `place` is the last position as a GGA sentence, which is sent to
    the caster of a virtual base station.
    """

    engine: LiveEngine
    sinks: Sequence[Sink]
    metrics: Metrics
    hooks: Hooks
    streams: dict[str, ReceiverState] = field(default_factory=dict)
    read_to_ns: dict[str, int] = field(default_factory=dict)
    place: bytes = b""
    #: Function that returns the time of sending, GPS time since 1980 [ns]. The time is the computer's or, in a paced
    #: replay, the recording's.
    clock: Callable[[], int] = field(default_factory=lambda: gps_now_ns)
    saved: float = field(default_factory=time.monotonic)
    shown: float = 0.0
    reserved_from: int = 0
    #: Error of each sink that could not be written, by the sink's name.
    ended: dict[str, OutputError] = field(default_factory=dict)

    async def process(self, queue: _Queue, pumps: list[asyncio.Task[None]], *, replay: bool) -> None:
        """Process the items that the pumps receive until all antennas' sources have ended, then save the state."""
        read_to_ns, due = self.read_to_ns, 0
        self.reserved_from = self.engine.export_state().sequence
        self.save(reserved=self.reserved)
        try:
            while read_to_ns.keys() - {BASE}:  # a base station's stream may have no end
                for pump in pumps:
                    if pump.done() and queue.empty():
                        # raise the error of a source, now that all items received before it have been processed
                        pump.result()
                wait = None if replay else max(self.engine.wait_s(now_ns=time.monotonic_ns()), 0.001)
                item = await next_arrival(queue, pumps, wait_s=wait)
                now = time.monotonic_ns()
                if isinstance(item, Sensed):
                    skipped, units = self.metrics.skipped, self.engine.processor.units
                    skipped[f"lines of the {item.sensor} that are not valid rows"] += item.skipped
                    skipped["ranges to ground units that are not surveyed"] += item.count_unsurveyed(units)
                    self.engine.add_samples(item)
                    if self.hooks.sensed is not None:
                        self.hooks.sensed(item)
                elif item is not None:
                    name, received = item
                    if received is None:
                        read_to_ns.pop(name)
                    elif isinstance(received, int):
                        read_to_ns[name] = max(read_to_ns[name], received - 1)
                    else:
                        tag_ns = self.take(name, received, None if replay else now)
                        read_to_ns[name] = max(read_to_ns[name], tag_ns)
                if self.engine.lag.skipped and not queue.empty() and now < due:
                    # while epochs are skipped, do not poll after each, because a poll may wait for a second channel
                    continue
                due = now + round(5e8 * self.engine.settings.period_s)
                # In a replay, the clock is the time tag up to which all files have been read, so that both epochs of a
                # pair are available.
                clock, sent = (min(read_to_ns.values(), default=END_NS), None) if replay else (now, self.clock())
                outputs = self.emit(clock, sent)
                if queue.empty() or replay:
                    self.in_idle_time(outputs)
            # process epochs that still wait for the other antenna, and send the message that waits for the next period
            if not replay:
                self.emit(END_NS, self.clock())
            for pump in pumps:  # raise the error of a source that failed while items were waiting
                if pump.done():
                    pump.result()
        except asyncio.CancelledError:
            self.save()
            raise
        self.save()

    async def pump(self, name: str, source: str, turn: _Pace | _InTurn | None, queue: _Queue) -> None:
        """Move the items decoded from a source into the queue, and None at the end; epochs from files wait for their
        turn.
        """
        async for received in self.received(name, source):
            if turn is not None and received.epochs:
                if isinstance(turn, _InTurn):
                    # epochs of the other files before this one must not wait until it has been processed
                    await queue.put((name, _gps_ns(received.epochs[0])))
                await turn.wait(name, received.epochs[-1].time[-1])
            await queue.put((name, received))
        if turn is not None:
            turn.ended(name)
        await queue.put((name, None))

    async def listen(self, sensor: str, source: str, queue: _Queue) -> None:
        """Move a sensor's decoded samples into the queue; after the stream's end, no epoch waits for the sensor."""
        lines = SensorLines(sensor=sensor, source=hidden(source))
        async for part in read_source(source, self.engine.settings):
            if isinstance(part, bytes):
                await queue.put(lines.take(part))
            else:
                lines.after_break()
                self.tell(sensor, source, part)
        await queue.put(Sensed(sensor=sensor, until=FOREVER))

    async def received(self, name: str, source: str) -> AsyncIterator[ReceivedData]:
        """Yield the items decoded from a source one by one; lost connections are logged and counted."""
        place = (lambda: self.place) if name == BASE else None
        async for item in arrivals(source, self.streams[name], self.engine.settings, place):
            if isinstance(item, ReceivedData):
                yield item
            else:
                self.tell(name, source, item)

    def tell(self, name: str, source: str, item: Connected | Lost) -> None:
        """Log that a connection was opened or lost, and count lost connections."""
        if isinstance(item, Lost):
            self.metrics.lost[hidden(source)] += 1
            _LOG.warning("%s: %s: %s; next attempt in %.1f s", name, hidden(source), item.reason, item.wait_s)
        else:
            again = f", after {item.broken} breaks" if item.broken else ""
            _LOG.info("%s: connected to %s%s", name, hidden(source), again)

    def take(self, name: str, received: ReceivedData, now_ns: int | None) -> int:
        """Pass the items decoded from one source to the engine; return the last epoch's time tag [ns], or -1 if there
        are no epochs.

        If `now_ns` is None, the time tag of an epoch is used as its time of arrival.
        """
        self.streams[name] = received.after
        skipped = self.metrics.skipped
        skipped.update(received.passed_over)
        skipped["bytes outside messages"] += received.skipped_bytes
        skipped["messages with a bad checksum"] += received.bad_checksums
        if received.navigation is not None:
            self.engine.add_navigation(received.navigation)
        config = self.engine.processor.config
        if received.sbas is not None and config.sbas == "stream":
            messages = from_receiver(received.sbas, source=name, band=config.sbas_band)
            skipped.update({f"SBAS messages: {why}": n for why, n in messages.rejected.items() if n})
            if len(messages):
                self.engine.add_sbas(messages)
        tag_ns = -1
        for epoch in received.epochs:
            tag_ns = _gps_ns(epoch)
            if name == BASE:
                self.engine.add_base(epoch)
                continue
            self.engine.push(name, epoch, now_ns=tag_ns if now_ns is None else now_ns)
        return tag_ns

    def emit(self, now_ns: int, sent_ns: int | None) -> list[LiveOutput]:
        """Pass the outputs of `LiveEngine.poll` to the sinks and observers, and return these outputs."""
        began = time.perf_counter()
        outputs = self.engine.poll(now_ns=now_ns, sent_ns=sent_ns)
        if outputs:
            self.metrics.took(time.perf_counter() - began, outputs)
        for output in outputs:
            if self.engine.settings.gga_s > 0.0:
                self.place = gga_sentence(output) or self.place
            for sink in self.sinks:
                if sink.name not in self.ended:
                    self.send(sink, output)
            if self.hooks.observe is not None:
                self.hooks.observe(output)
        while self.engine.reports:
            _LOG.warning("%s", self.engine.reports.popleft())
        return outputs

    def send(self, sink: Sink, output: LiveOutput) -> None:
        """Pass an output to a sink; a sink that cannot be written receives no further outputs.

        Raise OutputError if no sink is left.
        """
        try:
            sink.send(output)
        except OutputError as error:
            self.ended[sink.name] = error
            _LOG.warning("%s; this output has ended, but the others continue", error)
            if len(self.ended) == len(self.sinks):
                raise

    def in_idle_time(self, outputs: Sequence[LiveOutput]) -> None:
        """Show the status and save the state while no data wait."""
        now = time.monotonic()
        if self.hooks.show is not None and outputs and now - self.shown >= _STATUS_S:
            self.shown = now
            self.hooks.show(status_text(outputs[-1], self.metrics))
        used = outputs[-1].message.sequence - self.reserved_from if outputs else 0
        if outputs and (now - self.saved >= self.engine.settings.state_every_s or 2 * used > self.reserved):
            self.saved, self.reserved_from = now, outputs[-1].message.sequence
            self.save(reserved=self.reserved)

    @property
    def reserved(self) -> int:
        """Number of sequence numbers that are reserved, so that none is sent twice after a crash. The reserve covers
        the messages of ten intervals `state_every_s`.
        """
        settings = self.engine.settings
        return math.ceil(10.0 * settings.state_every_s / settings.period_s)

    def save(self, *, reserved: int = 0) -> None:
        """Pass the state for a restart to `Hooks.save`, if this hook is given."""
        if self.hooks.save is not None:
            streams = {name: state.after_break() for name, state in self.streams.items()}
            self.hooks.save(SavedSession(engine=self.engine.export_state(reserved=reserved), streams=streams))


class _Pace:
    """Common pace of all replayed files: the time from the earliest tag of all files to an epoch's tag, divided by the
    replay speed, is the time from the start of the replay until the epoch is due.
    """

    def __init__(self, speed: float, files: Sequence[str]) -> None:
        self._speed = speed
        self._to_come = set(files)
        self._first: list[np.datetime64] = []
        self._all_known = asyncio.Event()
        self._began = 0.0

    async def wait(self, name: str, tag: np.datetime64) -> None:
        """Wait until an epoch of the file `name` is due."""
        if name in self._to_come:
            self._first.append(tag)
            self.ended(name)
        await self._all_known.wait()
        due = self._began + float((tag - min(self._first)) / np.timedelta64(1, "s")) / self._speed
        await asyncio.sleep(max(0.0, due - asyncio.get_running_loop().time()))

    def now_ns(self) -> int:
        """Return the time of the recording, GPS time since 1980 [ns]; before the first tag, the computer's time."""
        if not self._first or not self._all_known.is_set():
            return gps_now_ns()
        elapsed_s = (asyncio.get_running_loop().time() - self._began) * self._speed
        return int((min(self._first) - GPS_EPOCH).astype("timedelta64[ns]").astype(np.int64)) + round(elapsed_s * 1e9)

    def ended(self, name: str) -> None:
        """Record that the first time tag of a file is known, or that the file has no epochs."""
        self._to_come.discard(name)
        if not self._to_come and not self._all_known.is_set():
            self._began = asyncio.get_running_loop().time()
            self._all_known.set()


class _InTurn:
    """Order in which epochs of files are processed: by time tag; a base station's epoch precedes the train's epochs
    with the same tag.

    An epoch waits until the next epoch of every other file is known, so that files may begin at different times.
    """

    def __init__(self, files: Sequence[str]) -> None:
        #: For each file, the time tag of its waiting epoch and whether the epoch is the train's; None while the file is
        #: being read.
        self._waiting: dict[str, tuple[np.datetime64, bool] | None] = dict.fromkeys(files)

    async def wait(self, name: str, tag: np.datetime64) -> None:
        """Wait until no other file has an epoch that precedes the epoch with time tag `tag` of the file `name`."""
        self._waiting[name] = own = (tag, name != BASE)
        while any(other is None or other < own for other in self._waiting.values()):
            await asyncio.sleep(0)
        self._waiting[name] = None

    def ended(self, name: str) -> None:
        """Record that a file has no more epochs."""
        self._waiting.pop(name, None)


def _gps_ns(epoch: Observations) -> int:
    """Return the time tag of an epoch since the beginning of GPS time [ns]."""
    return int((epoch.time[0] - GPS_EPOCH).astype(np.int64))


def status_text(output: LiveOutput, metrics: Metrics) -> str:
    """Return the status line: time, status, position, speed, satellites, processing time, messages, losses."""
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
