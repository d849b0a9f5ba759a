"""Sinks for messages, specified as ``FORM@TARGET``; targets that may be slow have a queue.

The forms are functions of `railfix.live.forms`. The targets are ``-`` (standard output), a file, ``udp://HOST:PORT``
(one datagram per message), ``tcp-server://HOST:PORT`` (all connected clients) and
``mqtt://[USER:PASSWORD@]HOST:PORT/TOPIC``.
"""

from __future__ import annotations

import asyncio
import os
import queue
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final, Generic, Protocol, TypeVar
from urllib.parse import unquote, urlsplit

from railfix.core.errors import OutputError, SettingsError
from railfix.core.extras import needs_extra
from railfix.live.engine import LiveOutput
from railfix.live.forms import Form, forms, wants, whole_message
from railfix.live.settings import LiveSettings
from railfix.live.sources import hidden

Item = TypeVar("Item")

_CLOSE_S = 5.0  #: When an outlet is closed, items that its target has not taken after this time are dropped [s].


class Outlet(Generic[Item]):
    """Target with its own queue and thread; the thread calls `send` with one item at a time.

    `full` selects the action when the queue is full: "drop" drops and counts the new item (live), "wait" waits for room
    in the queue (replay of recorded files). `dropped` is the number of dropped items, and `failed` the number of items
    that the target refused. `failure` is the reason why the last item was refused, blank if it was accepted.
    """

    def __init__(self, name: str, send: Callable[[Item], None], *, waiting: int, full: str = "drop") -> None:
        self.name, self._send, self._full = name, send, full
        self.dropped = self.failed = 0
        self.failure = ""
        self._defect: Exception | None = None
        self._items: queue.Queue[Item | None] = queue.Queue(waiting)
        self._thread = threading.Thread(target=self._run, name=f"railfix {name}", daemon=True)
        self._thread.start()

    def send(self, item: Item) -> None:
        """Add one item to the queue; with "wait", raise OutputError if the target has refused the last item."""
        if self._defect is not None:
            raise self._defect
        if self._full == "wait":
            if self.failure:
                raise OutputError(f"{self.name}: {self.failure}")
            self._items.put(item)
            return
        try:
            self._items.put_nowait(item)
        except queue.Full:
            self.dropped += 1

    def _run(self) -> None:
        while (item := self._items.get()) is not None:
            try:
                self._send(item)
                self.failure = ""
            except (OSError, OutputError) as error:
                self.failed += 1
                self.failure = f"cannot be written ({getattr(error, 'strerror', None) or error})"
            except Exception as error:  # noqa: BLE001 (a defect: raised when the next item is passed on)
                self._defect = error
                self.failure = f"has stopped because of an internal error ({error!r})"
                self.failed += 1

    def close(self) -> None:
        """Wait some seconds for the remaining items; items that are left after this time are counted as dropped.

        Raise OutputError as `send` does.
        """
        with suppress(queue.Full):  # a thread that does not end is abandoned below
            self._items.put(None, timeout=_CLOSE_S)
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            self.dropped += self._items.qsize()
        if self._full == "wait" and self.failure:
            raise OutputError(f"{self.name}: {self.failure}")


#: A client of a TCP sink is disconnected if more than this number of bytes wait for the client.
_LARGEST_BACKLOG: Final = 1 << 20
_ANSWER_S: Final = 10.0  #: A connection that an MQTT broker has not accepted after this time has failed [s].
#: When an MQTT target is closed, messages that are not sent within this time are lost [s].
_LEFT_S: Final = 2.0
_HELP: Final = (
    "expected FORM@TARGET, where FORM is json, cbor, nmea, tpv, etcs, positions, train or passings, and TARGET is -, a "
    "file, udp://, tcp-server:// or mqtt://"
)


class Sink(Protocol):
    """Target that receives outputs, and counts the messages that do not reach the reader."""

    name: str  #: Name of the sink in counts and error messages.
    dropped: int  #: Number of messages that were dropped because the reader was too slow.
    failed: int  #: Number of messages that the target refused.
    failure: str  #: Reason why the target refused the last message; blank if it was accepted.

    def send(self, item: LiveOutput, /) -> None:
        """Process one output."""

    def close(self) -> None:
        """Send the remaining items, and release resources."""


@dataclass
class ByteTarget:
    """File or standard output, written without a buffer, so that messages reach their reader at once.

    The earlier content of a file is kept until the first epoch's message replaces it. Until then, messages of periods
    without input are held back, so that a session whose sources cannot be opened does not replace the content.
    """

    form: Form
    file: IO[bytes]
    path: Path | None = None  #: Path of the file; None for the standard output.
    #: Messages that are held back while the file has its earlier content; None if the earlier content has been
    #: replaced, or there was none.
    waiting: bytes | None = None

    def send(self, output: LiveOutput) -> None:
        """Write one message."""
        message = self.form(output)
        if self.waiting is not None:
            message = self.waiting + message
            if output.result is None and len(message) < _LARGEST_BACKLOG:
                self.waiting = message
                return
            self.file.truncate(0)
            self.waiting = None
        data = memoryview(message)
        while data:
            data = data[self.file.write(data) :]

    def close(self) -> None:
        """Close the file, and remove it if it is empty; the standard output stays open."""
        if self.path is not None:
            self.file.close()
            if self.path.is_file() and not self.path.stat().st_size:
                self.path.unlink()


@dataclass
class UdpTarget:
    """UDP target, one datagram per message."""

    form: Form
    address: tuple[str, int]
    socket: socket.socket = field(default_factory=lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))

    def send(self, output: LiveOutput) -> None:
        """Send one datagram if the form yields bytes."""
        if data := whole_message(self.form, output):
            self.socket.sendto(data, self.address)

    def close(self) -> None:
        """Close the socket."""
        self.socket.close()


class MqttTarget:
    """MQTT target; messages are published with QoS 0 (at most once), and a broken connection is opened again.

    Raise OutputError if the broker cannot be reached, or refuses the connection.
    """

    def __init__(self, form: Form, url: str, *, waiting: int) -> None:
        with needs_extra("mqtt://"):
            from paho.mqtt import client, enums
        parts = urlsplit(url)
        self.form, self.topic, self._waiting = form, parts.path.strip("/") or "railfix", waiting
        self._sent: deque[Any] = deque()
        self._client = client.Client(enums.CallbackAPIVersion.VERSION2)
        if parts.username is not None:
            self._client.username_pw_set(unquote(parts.username), unquote(parts.password or ""))
        answers: queue.Queue[Any] = queue.Queue()
        self._client.on_connect = lambda _client, _data, _flags, reason, _properties: answers.put(reason)
        try:
            self._client.connect(str(parts.hostname), int(parts.port or 0))
        except OSError as error:
            raise OutputError(
                f"mqtt://{parts.hostname}:{parts.port}: the connection cannot be opened ({error})"
            ) from None
        self._client.loop_start()
        try:
            answer = answers.get(timeout=_ANSWER_S)
        except queue.Empty:
            answer = "no answer"
        self._client.on_connect = None
        if not self._client.is_connected():
            self._client.loop_stop()
            raise OutputError(f"mqtt://{parts.hostname}:{parts.port}: the broker has refused the connection ({answer})")

    def send(self, output: LiveOutput) -> None:
        """Publish one message if the form yields bytes.

        Raise OutputError if there is no connection, or the broker is too slow.
        """
        data = whole_message(self.form, output)
        if not data:
            return
        if not self._client.is_connected():
            self._sent.clear()
            raise OutputError("the broker is not connected")
        while self._sent and self._sent[0].is_published():
            self._sent.popleft()
        if len(self._sent) >= self._waiting:
            raise OutputError("the broker does not keep up")
        sent = self._client.publish(self.topic, data, qos=0)
        if sent.rc:  # the connection has broken since the check above
            raise OutputError("the broker is not connected")
        self._sent.append(sent)

    def close(self) -> None:
        """Send the remaining messages within `_LEFT_S`, and disconnect."""
        until = time.monotonic() + _LEFT_S
        for info in self._sent:
            if self._client.is_connected():
                info.wait_for_publish(max(until - time.monotonic(), 0.0))
        self._client.disconnect()
        # in a thread, because the call would not return while the broker keeps the connection open but reads nothing
        ending = threading.Thread(target=self._client.loop_stop, daemon=True)
        ending.start()
        ending.join(max(until - time.monotonic(), 0.5))


class OutletSink(Outlet[LiveOutput]):
    """Sink with a queue before the target; closing the sink closes the target."""

    def __init__(self, name: str, target: Any, *, waiting: int, full: str) -> None:
        super().__init__(name, target.send, waiting=waiting, full=full)
        self._target = target

    def send(self, item: LiveOutput) -> None:
        """Add one output to the queue, if the form applies to the output."""
        if wants(self._target.form, item):
            super().send(item)

    def close(self) -> None:
        """Send the remaining outputs, and close the target; raise OutputError as `Outlet.close` does."""
        try:
            super().close()
        finally:
            self._target.close()


class TcpServerSink:
    """TCP server that sends messages to all connected clients; slow clients are disconnected."""

    def __init__(self, form: Form, name: str) -> None:
        self.form, self.name = form, name
        self.dropped = self.failed = 0
        self.failure = ""
        self.server: asyncio.Server | None = None
        self._readers: set[asyncio.StreamWriter] = set()

    async def start(self, host: str, port: int) -> None:
        """Open the server; raise OSError if the address is not available."""
        self.server = await asyncio.start_server(self._connect, host, port)

    async def _connect(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._readers.add(writer)
        try:
            while await reader.read(1024):
                pass
        except OSError:  # the client has closed the connection
            pass
        finally:
            self._readers.discard(writer)
            writer.close()

    def send(self, output: LiveOutput) -> None:
        """Send an output to all clients, and disconnect clients that read too slowly."""
        data = self.form(output) if wants(self.form, output) else b""
        for writer in list(self._readers):
            if writer.transport.get_write_buffer_size() > _LARGEST_BACKLOG:
                writer.transport.abort()
                self._readers.discard(writer)
                self.dropped += 1
            else:
                writer.write(data)

    def close(self) -> None:
        """Stop listening and disconnect."""
        if self.server is not None:
            self.server.close()
        for writer in self._readers:
            writer.close()


def parse_file_target(text: str) -> Path | None:
    """Return the file named by a text ``FORM@TARGET``; None if the target is not a file."""
    target = text.partition("@")[2]
    other = target in ("", "-") or urlsplit(target).scheme in ("udp", "tcp-server", "mqtt")
    return None if other else Path(target)


def _open_without_change(path: Path) -> IO[bytes]:
    """Open a file for writing without a buffer, and keep its content. Raise OSError if the file cannot be opened."""
    return open(path, "wb", buffering=0, opener=lambda name, flags: os.open(name, flags & ~os.O_TRUNC, 0o666))


async def open_sink(
    text: str, settings: LiveSettings | None = None, *, overwrite: str = "refuse", full: str = "drop"
) -> Sink:
    """Open the sink specified by a text ``FORM@TARGET``; for `full` see `Outlet`.

    The content of an existing file remains until the first epoch's message. Raise SettingsError if the text has no
    valid form or target. Raise OutputError if the target cannot be opened, or if it is an existing file and `overwrite`
    is "refuse".
    """
    settings = settings or LiveSettings()
    name, at, target = text.partition("@")
    form = forms(settings).get(name)
    if not at or form is None or not target:
        raise SettingsError(f"--send {text!r}: {_HELP}")
    parts, shown = urlsplit(target), f"{name}@{hidden(target)}"
    opened: Any
    if target == "-":
        opened = ByteTarget(form, getattr(sys.stdout.buffer, "raw", sys.stdout.buffer))  # raw stream, without a buffer
    elif parts.scheme in ("udp", "tcp-server", "mqtt"):
        try:
            host, port = parts.hostname, parts.port
        except ValueError:
            host, port = None, None
        if not host or port is None:
            raise SettingsError(f"--send {shown!r}: {_HELP}")
        try:
            if parts.scheme == "tcp-server":
                server = TcpServerSink(form, shown)
                await server.start(host, port)
                return server
            if parts.scheme == "udp":
                opened = UdpTarget(form, (socket.gethostbyname(host), port))
            else:
                opened = await asyncio.to_thread(MqttTarget, form, target, waiting=settings.waiting)
        except OSError as error:
            raise OutputError(f"{shown}: cannot be opened ({error.strerror or error})") from None
    else:
        path = Path(target)
        if path.exists() and overwrite == "refuse":
            raise OutputError(f"{target}: the file exists already; give another file, or add --overwrite")
        try:
            earlier = path.is_file() and path.stat().st_size > 0
            opened = ByteTarget(form, _open_without_change(path), path, b"" if earlier else None)
        except OSError as error:
            raise OutputError(f"{target}: cannot be written ({error.strerror or error})") from None
    return OutletSink(shown, opened, waiting=settings.waiting, full=full)
