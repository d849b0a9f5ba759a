"""Log, status line, metrics and checks of a session.

The metrics are served as Prometheus text over HTTP. One check compares the on-board sensors with satellite-derived
positions and speeds. Another check compares 3-D positions with the line. Contradictions are logged.
"""

from __future__ import annotations

import asyncio
import copy
import logging
import logging.handlers
import re
import sys
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import polars as pl
from rich.console import Console
from rich.live import Live
from rich.text import Text

from railfix.core.arrays import Datetimes
from railfix.core.errors import MismatchError, OutputError, SettingsError
from railfix.core.reasons import Status
from railfix.core.timescale import GPS_EPOCH
from railfix.io.train_message import MessageStatus
from railfix.live.engine import LiveOutput
from railfix.live.settings import LiveSettings
from railfix.live.sinks import Outlet, Sink
from railfix.live.stream import FOREVER, Sensed
from railfix.motion.radar_watch import RadarWatch
from railfix.motion.samples import SensorSamples
from railfix.pipeline.processor import EpochProcessor
from railfix.run.checks import ENOUGH_TO_STOP, check_same_place
from railfix.run.sensor_checks import SensorChecks
from railfix.run.tally import AntennaTally, Tally
from railfix.tracking import Kind

_WAITING: Final = 1000  #: Number of log lines that may wait for a slow terminal or disk.


class _Terminal:
    """Display on the standard error output: lines of the log (str), and the status line (`Text`) below them."""

    def __init__(self, *, status: bool) -> None:
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(console=self._console, auto_refresh=False, transient=True) if status else None
        if self._live is not None:
            self._live.start()

    def show(self, item: str | Text) -> None:
        """Print a line of the log, or replace the status line."""
        if isinstance(item, str):
            self._console.print(item, markup=False, soft_wrap=True)
        elif self._live is not None:
            self._live.update(item, refresh=True)

    def close(self) -> None:
        """Remove the status line."""
        if self._live is not None:
            self._live.stop()


class _Behind(logging.Handler):
    """Logging handler that passes log records to an outlet, so that logging never waits for a terminal or disk."""

    def __init__(self, outlet: Outlet[Any], *, line: logging.Formatter | None = None) -> None:
        super().__init__()
        self._outlet, self._line = outlet, line

    def emit(self, record: logging.LogRecord) -> None:
        """Pass a record to the outlet, as a formatted line if there is a formatter."""
        if self._line is None:  # format now, because the arguments may change before the record is written
            record = copy.copy(record)
            record.msg, record.args = record.getMessage(), None
        self._outlet.send(record if self._line is None else self._line.format(record))


class _Rotating(logging.handlers.RotatingFileHandler):
    """Rotating log file that raises write errors instead of printing them."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802, ARG002 (the name and form of logging)
        """Raise the current write error."""
        raise


#: Pattern of the time with which each line of a session's log begins.
_LINE: Final = re.compile(rb"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3} ")


def check_log_file(path: Path) -> None:
    """Raise OutputError if a file exists but is not a session's log, because the new log would be appended to it."""
    try:
        with path.open("rb") as file:
            begin = file.read(64)
    except FileNotFoundError:
        return
    except OSError as error:
        raise OutputError(f"{path}: cannot be opened as a log file ({error.strerror or error})") from None
    if begin and not _LINE.match(begin):
        raise OutputError(f"{path}: is not a log of railfix live, so nothing is appended to it; give another file")


class SessionLog:
    """Log and status line of a session; the log is also written to a rotating file if `path` is given.

    When the file has reached `LiveSettings.log_bytes`, it is renamed to ``path.1``, an earlier ``path.1`` to
    ``path.2``, and so on. The status line is shown only if the standard error output is a terminal. Raise OutputError
    if the file cannot be opened.
    """

    def __init__(self, path: Path | None, settings: LiveSettings, *, status: bool = True) -> None:
        self.shows_status = status and sys.stderr.isatty()
        self._terminal = _Terminal(status=self.shows_status)
        self._logger = logging.getLogger("railfix.live")
        self._logger.setLevel(logging.INFO)
        self._logger.propagate = False
        self._screen: Outlet[str | Text] = Outlet("log", self._terminal.show, waiting=_WAITING)
        self._handlers = [_Behind(self._screen, line=logging.Formatter("railfix live: %(message)s"))]
        self._file: _Rotating | None = None
        self._written: Outlet[logging.LogRecord] | None = None
        if path is not None:
            try:
                self._file = _Rotating(
                    path, maxBytes=settings.log_bytes, backupCount=settings.log_files, encoding="utf-8"
                )
            except OSError as error:
                self.close()
                raise OutputError(f"{path}: cannot be opened as a log file ({error.strerror or error})") from None
            self._file.setFormatter(logging.Formatter("%(asctime)s.%(msecs)03d %(message)s", "%Y-%m-%dT%H:%M:%S"))
            self._written = Outlet("log file", self._file.emit, waiting=_WAITING)
            self._handlers.append(_Behind(self._written))
        for handler in self._handlers:
            self._logger.addHandler(handler)

    def say(self, sentence: str) -> None:
        """Log one sentence."""
        self._logger.info(sentence)

    def show(self, status: str) -> None:
        """Replace the text of the status line, if a status line is shown."""
        if self.shows_status:
            self._screen.send(Text(status, no_wrap=True, overflow="ellipsis"))

    def close(self) -> None:
        """Write the remaining lines; if lines are missing in the log file, print their number."""
        for handler in self._handlers:
            self._logger.removeHandler(handler)
        self._logger.propagate = True
        if self._written is not None and self._file is not None:
            self._written.close()
            self._file.close()
            if missing := self._written.dropped + self._written.failed:
                self._screen.send(f"railfix live: {missing} lines are missing in the log file: {self._written.failure}")
        self._screen.close()
        self._terminal.close()


#: Percentiles of processing times and of intervals between messages are computed from this number of latest values.
_LAST: Final = 1000


@dataclass(kw_only=True)
class Metrics:
    """Counts and processing times of a session."""

    messages: Counter[MessageStatus] = field(default_factory=Counter)
    epochs: Mapping[str, int] = field(default_factory=dict)  #: Number of epochs for each outcome (`LiveEngine.counts`).
    #: Number of unused bytes, messages and lines for each reason.
    skipped: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)  #: Number of times that the connection to each source broke.
    sinks: Sequence[Sink] = ()
    hangups: int = 0  #: Number of SIGHUP signals received.
    processing_s: deque[float] = field(default_factory=lambda: deque(maxlen=_LAST))  #: Processing time per output [s].
    between_s: deque[float] = field(default_factory=lambda: deque(maxlen=_LAST))  #: Intervals between messages [s].

    started: float = field(default_factory=time.monotonic)
    _sent: float | None = None

    def took(self, seconds: float, outputs: Sequence[LiveOutput]) -> None:
        """Count the messages of outputs, and record processing times and intervals between messages.

        `seconds` is the processing time of all outputs together.
        """
        now = time.monotonic()
        for output in outputs:
            self.processing_s.append(seconds / len(outputs))
            if output.part == "rows":
                continue
            self.messages[output.message.status] += 1
            if self._sent is not None:
                self.between_s.append(now - self._sent)
            self._sent = now

    def text(self) -> str:
        """Return the metrics in the text format of Prometheus (version 0.0.4)."""
        lines = _counter("railfix_messages_total", "status", {s.name.lower(): self.messages[s] for s in MessageStatus})
        lines += _counter("railfix_epochs_total", "fate", self.epochs)
        lines += _counter("railfix_skipped_total", "what", self.skipped)
        lines += _counter("railfix_connections_lost_total", "source", self.lost)
        lines += _counter("railfix_sink_dropped_total", "sink", {sink.name: sink.dropped for sink in self.sinks})
        lines += _counter("railfix_sink_failed_total", "sink", {sink.name: sink.failed for sink in self.sinks})
        lines += ["# TYPE railfix_hangups_total counter", f"railfix_hangups_total {self.hangups}"]
        for name, values in (("processing", self.processing_s), ("between_messages", self.between_s)):
            if values:
                lines.append(f"# TYPE railfix_{name}_seconds summary")
                for quantile in (0.5, 0.99, 1.0):
                    value = float(np.quantile(values, quantile))
                    lines.append(f'railfix_{name}_seconds{{quantile="{quantile}"}} {value:.6f}')
        lines.append("# TYPE railfix_uptime_seconds gauge")
        lines.append(f"railfix_uptime_seconds {time.monotonic() - self.started:.1f}")
        return "\n".join(lines) + "\n"

    def summary(self) -> list[str]:
        """Return the lines of the summary at the end of a session."""
        lines = [f"{sum(self.messages.values()):,} messages"]
        lines += [f"  {status.name.lower()}: {number:,}" for status, number in sorted(self.messages.items())]
        lines += [f"epochs {fate}: {number:,}" for fate, number in sorted(self.epochs.items())]
        lines += [f"skipped: {number:,} {what}" for what, number in sorted(self.skipped.items()) if number]
        lines += [f"{source}: connection lost {number:,} times" for source, number in sorted(self.lost.items())]
        for sink in self.sinks:
            if sink.dropped:
                lines.append(f"{sink.name}: {sink.dropped:,} messages dropped because the reader was too slow")
            if sink.failed:
                lines.append(f"{sink.name}: {sink.failed:,} messages refused by the target")
        if self.processing_s:
            p50, p99 = (1e3 * float(np.quantile(self.processing_s, q)) for q in (0.5, 0.99))
            last = len(self.processing_s)
            lines.append(
                f"processing time of the last {last} messages: median {p50:.1f} ms, 99th percentile {p99:.1f} ms"
            )
        return lines


def _counter(name: str, label: str, values: Mapping[str, int]) -> list[str]:
    lines = [f"# TYPE {name} counter"]
    for key, value in sorted(values.items()):
        quoted = key.replace("\\", "\\\\").replace('"', '\\"')
        lines.append(f'{name}{{{label}="{quoted}"}} {value}')
    return lines


async def serve_metrics(metrics: Metrics, address: str) -> asyncio.Server:
    """Serve ``/metrics`` over HTTP; raise SettingsError if the address is not HOST:PORT, or is not available."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdigit():
        raise SettingsError(f"--metrics {address!r}: expected HOST:PORT, for example 127.0.0.1:9100")

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            request = await asyncio.wait_for(reader.readline(), 5.0)
            found = request.split(b" ")[1:2] == [b"/metrics"]
            body = metrics.text().encode() if found else b"not found; see /metrics\n"
            head = f"HTTP/1.1 {'200 OK' if found else '404 Not Found'}\r\nContent-Type: text/plain; version=0.0.4\r\n"
            writer.write(f"{head}Content-Length: {len(body)}\r\nConnection: close\r\n\r\n".encode() + body)
            await writer.drain()
        except (OSError, ValueError):  # the client has disconnected, or has sent a request that is not HTTP
            pass
        finally:
            writer.close()

    try:
        return await asyncio.start_server(answer, host, int(port))
    except (OSError, OverflowError) as error:
        raise SettingsError(f"--metrics {address}: no server can be opened at this address ({error})") from None


WATCHED_NS: Final = 600_000_000_000  #: All sensors are checked once, this time after the first position [ns].
_RADAR_NS: Final = 60_000_000_000  #: Interval between two checks of the radar [ns].
_EVERY_NS: Final = 500_000_000  #: The check of all sensors uses positions that are at least this time apart [ns].
#: Number of chunks of sensor samples that are merged into one block, to save memory.
_PIECES: Final = 256
_NEVER: Final = np.datetime64("NaT", "ns")


class SensorWatch:
    """Check of the on-board sensors against satellite-derived positions and speeds of the first antenna.

    All sensors are checked once (`railfix.run.sensor_checks.SensorChecks`), after `WATCHED_NS` or at the end of the
    session. The radar is also checked repeatedly. For each sensor that contradicts the satellites, `say` is called with
    a sentence for the log.
    """

    def __init__(self, processor: EpochProcessor, say: Callable[[str], None]) -> None:
        self._name, self._trajectory = next(iter(processor.trajectories.items()))
        self._processor, self._say = processor, say
        self._place_ns: list[int] = []
        self._places_m: list[float] = []
        self._speed_ns: list[int] = []
        self._speeds: list[float] = []
        self._shown = 0
        self._samples: list[SensorSamples] = []
        self._blocks: list[SensorSamples] = []
        self._begin = _NEVER
        self._judged = self._has_radar = False
        self._watch, self._radar = RadarWatch(), SensorSamples()

    def take(self, item: LiveOutput | Sensed) -> None:
        """Process an output of the engine, or samples from a sensor's source."""
        if isinstance(item, Sensed):
            self._hear(item)
        elif item.result is not None and self._name in item.result.antennas:
            antenna, track = item.result.antennas[self._name], item.result.fusion.get(self._name)
            time_ns = int((antenna.time[-1] - GPS_EPOCH).astype(np.int64))
            speed = float("nan") if track is None else float(track.tracked.speed_mps[-1])
            measured = track is not None and track.tracked.used[-1, Kind.DOPPLER] and np.isfinite(speed)
            if measured and time_ns > _last(self._speed_ns):
                self._speed_ns.append(time_ns)
                self._speeds.append(speed)
                if time_ns - self._speed_ns[self._shown] >= _RADAR_NS:
                    self._look_at_radar()
            if self._judged:
                return
            if antenna.status[-1] == Status.OK and time_ns >= _last(self._place_ns) + _EVERY_NS:
                self._place_ns.append(time_ns)
                self._places_m.append(float(antenna.chainage_m[-1]))
            if self._place_ns and time_ns - self._place_ns[0] >= WATCHED_NS:
                self.judge()

    def _hear(self, sensed: Sensed) -> None:
        """Store samples for the check of the sensors.

        Samples covering over twice `WATCHED_NS` are dropped; before, the sensors are checked if there is a position.
        """
        table = bool(sensed.until == FOREVER)
        if sensed.samples and not self._judged:
            self._samples.append(sensed.samples)
            if len(self._samples) == _PIECES:  # merge, because a chunk of one row takes as much memory as a hundred
                self._blocks.append(_join(self._samples))
                self._samples = []
            self._begin = np.fmin(self._begin, sensed.until)
            if not table and sensed.until - self._begin > 2 * np.timedelta64(WATCHED_NS, "ns"):
                if self._place_ns:
                    self.judge()
                self._samples, self._blocks, self._begin = [], [], _NEVER
        self._has_radar = self._has_radar or len(sensed.samples.radar) > 0
        if len(sensed.samples.radar):
            self._radar = self._radar.merge(SensorSamples(radar=sensed.samples.radar))
            if not table:
                self._radar = self._radar.between(sensed.until - 2 * np.timedelta64(_RADAR_NS, "ns"), FOREVER)

    def _look_at_radar(self) -> None:
        """Compare the radar speeds with the satellite-derived speeds since the last comparison."""
        time, speeds = _times(self._speed_ns[self._shown :]), np.array(self._speeds[self._shown :])
        now, self._radar = self._radar.between(_NEVER, time[-1]), self._radar.between(time[-1], FOREVER)
        for alarm in self._watch.take_samples(now.radar, time, speeds) if self._has_radar else ():
            self._say(alarm.sentence)
        self._shown = len(self._speeds)
        if self._judged:
            self._forget_speeds()

    def _forget_speeds(self) -> None:
        """Drop the satellite-derived speeds that have been compared with the radar, except the last of them."""
        kept = slice(max(self._shown - 1, 0), None)
        self._speed_ns, self._speeds, self._shown = self._speed_ns[kept], self._speeds[kept], min(self._shown, 1)

    def judge(self) -> None:
        """Compare the sensors with the satellite-derived positions and speeds so far; further calls have no effect."""
        if self._judged:
            return
        self._judged = True
        if self._place_ns and self._speeds and (parts := [*self._blocks, *self._samples]):
            speeds = pl.DataFrame({"time_gpst": _times(self._speed_ns), "speed_mps": self._speeds})
            places = pl.DataFrame({"time_gpst": _times(self._place_ns), "chainage_m": self._places_m})
            samples = _join(parts).between(_NEVER, _times(self._speed_ns)[-1])
            checks, processor = SensorChecks(places=[places], speeds=[speeds]), self._processor
            for note in checks.notes(samples, processor.units, self._trajectory, processor.config.sensors):
                self._say(note)
        self._place_ns, self._places_m, self._samples, self._blocks = [], [], [], []
        self._forget_speeds()


def _last(time_ns: list[int]) -> int:
    return time_ns[-1] if time_ns else -_EVERY_NS


def _times(time_ns: list[int]) -> Datetimes:
    return GPS_EPOCH + np.array(time_ns).astype("timedelta64[ns]")


def _join(parts: list[SensorSamples]) -> SensorSamples:
    """Merge the parts pairwise, so that each sample is copied only a few times."""
    while len(parts) > 1:
        pairs = zip(parts[::2], parts[1::2], strict=False)
        parts = [early.merge(late) for early, late in pairs] + parts[len(parts) // 2 * 2 :]
    return parts[0]


class PlaceWatch:
    """Check, as soon as an antenna has `ENOUGH_TO_STOP` positions, whether 3-D positions lie on the line.

    If the positions do not lie on the line, `say` is called with the error message of `railfix run` for this case.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._tally = Tally(min_satellites=3)
        self._done = False

    def take(self, output: LiveOutput) -> None:
        """Process an output of the engine."""
        if self._done or output.result is None:
            return
        for name, antenna in output.result.antennas.items():
            self._tally.antennas.setdefault(name, AntennaTally()).add_conventional(antenna)
        if any(counts.conventional >= ENOUGH_TO_STOP for counts in self._tally.antennas.values()):
            self._done = True
            try:
                check_same_place(self._tally)
            except MismatchError as error:
                self._say(str(error))
