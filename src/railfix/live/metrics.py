"""Counts and times of a session, as Prometheus text over HTTP."""

from __future__ import annotations

import asyncio
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.errors import SettingsError
from railfix.io.train_message import MessageStatus
from railfix.live.engine import LiveOutput
from railfix.live.sinks import Sink

#: Messages that the times are taken of.
_LAST: Final = 1000


@dataclass(kw_only=True)
class Metrics:
    """Counts and times of a session."""

    messages: Counter[MessageStatus] = field(default_factory=Counter)
    epochs: Mapping[str, int] = field(default_factory=dict)  #: What became of the epochs: `LiveEngine.counts`.
    skipped: Counter[str] = field(default_factory=Counter)  #: Bytes and messages of the receivers that were not used.
    lost: Counter[str] = field(default_factory=Counter)  #: Connections that broke, by source.
    sinks: Sequence[Sink] = ()
    hangups: int = 0  #: SIGHUP received; nothing is reloaded by it.
    #: Processing time of the last messages; times between them.
    processing_s: deque[float] = field(default_factory=lambda: deque(maxlen=_LAST))
    between_s: deque[float] = field(default_factory=lambda: deque(maxlen=_LAST))

    started: float = field(default_factory=time.monotonic)
    _sent: float | None = None

    def took(self, seconds: float, outputs: Sequence[LiveOutput]) -> None:
        """Count messages that go out now, and the time they took together."""
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
        """The metrics in the text format of Prometheus (version 0.0.4)."""
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
        """What happened, a line each, for the end of the session."""
        lines = [f"{sum(self.messages.values()):,} messages"]
        lines += [f"  {status.name.lower()}: {number:,}" for status, number in sorted(self.messages.items())]
        lines += [f"epochs {fate}: {number:,}" for fate, number in sorted(self.epochs.items())]
        lines += [f"skipped: {number:,} {what}" for what, number in sorted(self.skipped.items()) if number]
        lines += [f"{source}: connection lost {number:,} times" for source, number in sorted(self.lost.items())]
        for sink in self.sinks:
            if sink.dropped:
                lines.append(f"{sink.name}: {sink.dropped:,} messages dropped for a slow reader")
            if sink.failed:
                lines.append(f"{sink.name}: {sink.failed:,} messages refused by the target")
        if self.processing_s:
            p50, p99 = (1e3 * float(np.quantile(self.processing_s, q)) for q in (0.5, 0.99))
            last = len(self.processing_s)
            lines.append(f"processing of the last {last} messages: median {p50:.1f}, p99 {p99:.1f} ms")
        return lines


def _counter(name: str, label: str, values: Mapping[str, int]) -> list[str]:
    lines = [f"# TYPE {name} counter"]
    for key, value in sorted(values.items()):
        quoted = key.replace("\\", "\\\\").replace('"', '\\"')
        lines.append(f'{name}{{{label}="{quoted}"}} {value}')
    return lines


async def serve_metrics(metrics: Metrics, address: str) -> asyncio.Server:
    """Serve ``/metrics`` over HTTP; SettingsError when the address is not HOST:PORT, or cannot be listened at."""
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
        except (OSError, ValueError):  # whoever asked has gone, or does not ask in HTTP: there is nobody to answer
            pass
        finally:
            writer.close()

    try:
        return await asyncio.start_server(answer, host, int(port))
    except (OSError, OverflowError) as error:
        raise SettingsError(f"--metrics {address}: cannot be listened at ({error})") from None
