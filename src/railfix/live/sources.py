"""Sources of a receiver's bytes: files, TCP, serial lines, NTRIP casters, standard input."""

from __future__ import annotations

import asyncio
import base64
import io
import ssl
import sys
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar, cast
from urllib.parse import parse_qs, unquote, urlsplit

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.extras import needs_extra
from railfix.core.files import open_stream
from railfix.live.settings import LiveSettings

Item = TypeVar("Item")
#: Function that returns the present position as a GGA sentence, or empty bytes if there is no position.
Place = Callable[[], bytes]
#: Function that writes to a connection until the function is cancelled.
Send = Callable[[asyncio.StreamWriter], Coroutine[None, None, None]]

_BLOCK = 4096
_FORMS = (
    "a file, tcp://HOST:PORT, serial:DEVICE?baud=115200, ntrip://[USER:PASSWORD@]HOST:PORT/MOUNT (ntrips:// over TLS), "
    "or - (standard input)"
)
_NTRIP = ("ntrip", "ntrips")  #: URL schemes of NTRIP without TLS and with TLS.
_CONNECT_S = 10.0  #: A connection that is not open after this time has failed [s].
_SERIAL_S = 0.05  #: Timeout of one read of a serial line [s].
#: A read that has timed out is repeated with this timeout, to get bytes that arrived while the program was busy [s].
_ONCE_MORE_S = 0.02
_NO_PLACE_S = 1.0  #: While there is no position to send to a caster, a new attempt is made after at most this time [s].
_HEADER_BYTES = 65_536  #: A caster's answer with a longer header is rejected [bytes].
#: Number of first bytes of a caster's stream that are examined, to reject content that is not a receiver's stream.
_TELLING_BYTES: Final = 16
_OK: Final = 200  #: HTTP status code of a successful answer.


@dataclass(frozen=True)
class Connected:
    """Event: a connection has been opened; `broken` is the number of times that the connection has broken before."""

    broken: int


@dataclass(frozen=True)
class Lost:
    """Event: a connection has broken; the next attempt to open it follows after `wait_s`."""

    reason: str
    wait_s: float


def check_source(source: str) -> None:
    """Raise SettingsError if a source is not in a supported form."""
    parts = urlsplit(source)
    if parts.scheme in ("tcp", *_NTRIP):
        try:
            port = parts.port
        except ValueError:
            port = None
        if not parts.hostname or port is None or (parts.scheme in _NTRIP and not parts.path.strip("/")):
            raise SettingsError(f"source {hidden(source)!r}: expected {_FORMS}")
    elif parts.scheme == "serial":
        _baud(source)
    elif parts.scheme and parts.scheme != "file" and not Path(source).exists():
        raise SettingsError(f"source {source!r}: expected {_FORMS}")


def is_file(source: str) -> bool:
    """Return whether a source is a recorded file."""
    return source != "-" and urlsplit(source).scheme not in ("tcp", "serial", *_NTRIP)


def hidden(source: str) -> str:
    """Return a source with its password masked, for messages and logs."""
    parts = urlsplit(source)
    return source if parts.password is None else source.replace(f":{parts.password}@", ":***@", 1)


async def read_source(
    source: str, settings: LiveSettings, place: Place | None = None
) -> AsyncIterator[bytes | Connected | Lost]:
    """Yield the bytes of a source as they arrive, and the events of the connection.

    A connection that breaks is opened again, if `LiveSettings.reconnect` is "on". `place` returns the present position
    as a GGA sentence; a sentence that is not empty is sent to a caster every `LiveSettings.gga_s`. Raise InputFileError
    if the source cannot be opened, or if the connection breaks and is not opened again.
    """
    parts = urlsplit(source)
    if source == "-":
        async for data in _standard_input():
            yield data
    elif is_file(source):
        async for data in _file(source.removeprefix("file:")):
            yield data
    else:
        opened: dict[str, Callable[[], AsyncIterator[bytes]]] = {
            "tcp": lambda: _tcp(source, b"", settings.silence_s),
            "ntrip": lambda: _ntrip(source, settings, place),
            "ntrips": lambda: _ntrip(source, settings, place),
            "serial": lambda: _serial(source, settings.silence_s),
        }
        async for part in _keep_open(opened[parts.scheme], settings):
            yield part


async def _keep_open(
    opened: Callable[[], AsyncIterator[bytes]], settings: LiveSettings
) -> AsyncIterator[bytes | Connected | Lost]:
    """Yield the bytes and events of a connection. A connection that breaks is opened again, after waits that increase.

    `opened` returns an iterator that yields empty bytes once the connection is open, and then the received bytes.
    """
    broken, wait_s, ever_open = 0, settings.reconnect_first_s, False
    while True:
        reason = "the other end has closed the connection"
        try:
            async for data in opened():
                if data:
                    wait_s = settings.reconnect_first_s
                    yield data
                else:
                    ever_open = True
                    yield Connected(broken)
        except InputFileError as error:
            if not ever_open or settings.reconnect == "off":
                raise
            reason = error.message
        if settings.reconnect == "off":
            return
        broken += 1
        yield Lost(reason, wait_s)
        await asyncio.sleep(wait_s)
        wait_s = min(2.0 * wait_s, settings.reconnect_longest_s)


async def _file(path: str) -> AsyncIterator[bytes]:
    with open_stream(path, content="bytes") as stream:
        while block := stream.read(16 * _BLOCK):
            yield block
            await asyncio.sleep(0)


async def _within(seconds: float, call: Callable[[], Awaitable[Item]]) -> Item:
    """Return the result of a call; raise TimeoutError if the call takes too long.

    After a timeout, the call is repeated once with the timeout `_ONCE_MORE_S`, because data may have arrived while this
    program was busy. `asyncio.wait_for` is not used, because it may lose a cancellation.
    """
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            return await call()
    async with asyncio.timeout(_ONCE_MORE_S):
        return await call()


async def _tcp(
    source: str, request: bytes, silence_s: float, *, tls: ssl.SSLContext | None = None, send: Send | None = None
) -> AsyncIterator[bytes]:
    """Yield empty bytes once connected, then received bytes, while `send` writes to the other end.

    Raise InputFileError if the connection cannot be opened, breaks, or is silent for `silence_s`.
    """
    parts = urlsplit(source)
    try:
        async with asyncio.timeout(_CONNECT_S):
            reader, writer = await asyncio.open_connection(parts.hostname, parts.port, ssl=tls)
    except ssl.SSLCertVerificationError as error:
        why = f"the server's certificate is not accepted ({error.verify_message})"
        hint = "; if you trust the certificate, give it by --live ntrip_certificates=FILE"
        raise InputFileError(hidden(source), why + hint) from None
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).lower().replace("_", " ")
        without = "the server does not use TLS on this port"
        raise InputFileError(hidden(source), f"{without} ({reason}); for a server without TLS give ntrip://") from None
    except (OSError, TimeoutError) as error:
        over = "" if tls is None else " over TLS"
        raise InputFileError(
            hidden(source), f"the connection cannot be opened{over} ({str(error) or 'no answer'})"
        ) from None
    sending = None if send is None else asyncio.create_task(send(writer))
    try:
        if request:
            writer.write(request)
            await writer.drain()
        yield b""
        while data := await _within(silence_s, lambda: reader.read(_BLOCK)):
            yield data
    except TimeoutError:
        raise InputFileError(hidden(source), f"has sent nothing for {silence_s:g} s") from None
    except OSError as error:
        raise InputFileError(hidden(source), f"the connection broke ({error})") from None
    finally:
        if sending is not None:
            sending.cancel()
        writer.close()


async def _ntrip(source: str, settings: LiveSettings, place: Place | None) -> AsyncIterator[bytes]:
    """Yield the bytes of an NTRIP caster's mount point; the request is NTRIP 2, but the answer may be NTRIP 1.

    If `LiveSettings.gga_s` is not 0, the train's position is sent to the caster, as a virtual reference station
    requires. A position that is already known is part of the request (NTRIP 2); later positions are sent as lines.
    """
    if settings.gga_s == 0.0:
        place = None
    parts, answer = urlsplit(source), _Answer(source)
    request = answer.request(b"" if place is None else place())
    open_to_lines = asyncio.Event()

    async def report(writer: asyncio.StreamWriter) -> None:
        await open_to_lines.wait()
        while place is not None and not writer.is_closing():
            if sentence := place():
                writer.write(sentence)
            await asyncio.sleep(settings.gga_s if sentence else min(settings.gga_s, _NO_PLACE_S))

    tls = _tls(source, settings.ntrip_certificates) if parts.scheme == "ntrips" else None
    send = None if place is None else report
    async for data in _tcp(source, request, settings.silence_s, tls=tls, send=send):
        content = answer.take(data)
        if answer.begun and not open_to_lines.is_set():
            open_to_lines.set()
            yield b""
        if content:
            yield content
        answer.check()
        if answer.ended:
            return
    if not answer.begun:
        hint = "" if tls is not None else "; it may expect TLS (ntrips://)"
        raise InputFileError(hidden(source), f"the caster has closed the connection without an answer{hint}")


class _Answer:
    """Decoder of a caster's answer: HTTP 1.1 by h11 (NTRIP 2), or ``ICY 200 OK`` and bytes (NTRIP 1).

    `begun` is true once the mount point sends a stream, and `ended` once the caster has ended the stream.
    """

    def __init__(self, source: str) -> None:
        with needs_extra(f"source {hidden(source)!r}: NTRIP"):
            import h11
        self._h11, self._source = h11, source
        self._client: Any = h11.Connection(our_role=h11.CLIENT, max_incomplete_event_size=_HEADER_BYTES)
        self._first: bytes | None = b""  # bytes of the answer's first line; None once the line is complete
        self._content = b""  # first bytes of the content
        self._broken: InputFileError | None = None
        self._plain = self.begun = self.ended = False

    def request(self, sentence: bytes) -> bytes:
        """Return the request for the mount point; it contains the GGA sentence `sentence`, unless this is empty.

        Raise SettingsError if no valid request can be made from the source.
        """
        parts = urlsplit(self._source)
        head = [
            ("Host", f"{parts.hostname}:{parts.port}"), ("Ntrip-Version", "Ntrip/2.0"),
            ("User-Agent", "NTRIP railfix"), ("Connection", "close"),
        ]  # fmt: skip
        if parts.username is not None:
            login = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
            head.append(("Authorization", "Basic " + base64.b64encode(login.encode()).decode()))
        if sentence:
            head.append(("Ntrip-GGA", sentence.decode("ascii").strip()))
        try:
            request = self._h11.Request(method="GET", target=parts.path, headers=head)
            return bytes(self._client.send(request) + self._client.send(self._h11.EndOfMessage()))
        except self._h11.LocalProtocolError as error:
            raise SettingsError(f"source {hidden(self._source)!r}: gives no valid NTRIP request ({error})") from None

    def take(self, data: bytes) -> bytes:
        """Return the content decoded from further bytes of the answer; raise InputFileError if the content is not a
        receiver's stream.
        """
        if self._first is not None:
            self._first += data
            if b"\n" not in self._first and len(self._first) < _HEADER_BYTES:
                return b""
            data, self._first = self._first, None
            line = data.split(b"\n", 1)[0].strip()
            if line.startswith(b"ICY 200"):
                self._plain = self.begun = True
                data = data.split(b"\n", 1)[1].removeprefix(b"\r\n")
            elif not line.startswith(b"HTTP/"):
                raise _refuse(self._source, line)
        content = data if self._plain else self._decode(data)
        if content and len(self._content) < _TELLING_BYTES:
            self._content += content[:_TELLING_BYTES]
            self._check_content(self._content)
        return content

    def _decode(self, data: bytes) -> bytes:
        """Return the content decoded from HTTP bytes."""
        content = bytearray()
        try:
            self._client.receive_data(data)
            while (event := self._client.next_event()) is not self._h11.NEED_DATA:
                if isinstance(event, self._h11.Response):
                    self._check_head(event)
                    self.begun = True
                elif isinstance(event, self._h11.Data):
                    content += event.data
                elif isinstance(event, self._h11.EndOfMessage):
                    self.ended = True
                    break
        except self._h11.RemoteProtocolError as error:  # bytes received before the error are still returned
            self._broken = InputFileError(hidden(self._source), f"the caster's answer is not HTTP ({error})")
        return bytes(content)

    def check(self) -> None:
        """Raise InputFileError if bytes that were passed to `take` should be HTTP but are not."""
        if self._broken is not None:
            raise self._broken

    def _check_head(self, response: Any) -> None:
        """Raise InputFileError if the answer's header announces an error, a source table, an HTML page or compressed
        content.
        """
        if response.status_code != _OK:
            raise _refuse(self._source, f"{response.status_code} {response.reason.decode('latin-1')}".encode())
        head = {bytes(name).lower(): bytes(value).lower().strip() for name, value in response.headers}
        kind, coding = head.get(b"content-type", b""), head.get(b"content-encoding", b"identity")
        if kind.startswith(b"gnss/sourcetable"):
            raise self._no_stream("its source table")
        if kind.startswith(b"text/html"):
            raise self._no_stream("an HTML page")
        if coding != b"identity":
            raise self._no_stream(
                f"content with the encoding {coding.decode('latin-1')[:20]!r}, which was not requested"
            )

    def _check_content(self, content: bytes) -> None:
        """Raise InputFileError if the first bytes belong to compressed content, an HTML page or a source table."""
        if content.startswith(b"\x1f\x8b"):
            raise self._no_stream("compressed content (gzip), which was not requested")
        if content.lstrip()[:14].lower().startswith((b"<!doctype html", b"<html")):
            raise self._no_stream("an HTML page")
        if content.startswith((b"STR;", b"CAS;", b"NET;", b"SOURCETABLE")):
            raise self._no_stream("its source table")

    def _no_stream(self, what: str) -> InputFileError:
        return InputFileError(
            hidden(self._source),
            f"the caster sends {what}, not a receiver's stream; check host and mount point",
        )


def _tls(source: str, certificates: Path | None) -> ssl.SSLContext:
    """Return a TLS context that trusts the certificates of the system and of a PEM file.

    Raise SettingsError if the file cannot be read or contains no certificate.
    """
    context = ssl.create_default_context()
    if certificates is not None:
        try:
            context.load_verify_locations(certificates)
        except OSError as error:
            why = "contains no PEM certificate" if isinstance(error, ssl.SSLError) else str(error.strerror)
            raise SettingsError(f"ntrip_certificates: {certificates}: {why}; needed for {hidden(source)}") from None
    return context


def _refuse(source: str, first: bytes) -> InputFileError:
    text = first[:80].decode("latin-1")
    hint = "; check the mount point" if "SOURCETABLE" in text else ""
    hint = "; check user and password" if "401" in text else hint
    return InputFileError(hidden(source), f"the caster answers {text!r}{hint}")


def _baud(source: str) -> int:
    text = parse_qs(urlsplit(source).query).get("baud", ["115200"])[0]
    if not text.isdigit() or not urlsplit(source).path:
        raise SettingsError(f"source {source!r}: expected {_FORMS}")
    return int(text)


async def _serial(source: str, silence_s: float) -> AsyncIterator[bytes]:
    """Yield empty bytes once the serial line is open, then received bytes.

    A thread reads the line, so that no bytes are lost while the program is busy. Raise InputFileError if the line
    cannot be opened, breaks, or is silent for `silence_s`.
    """
    with needs_extra(f"source {source!r}: a serial line"):
        import serial
    try:
        port = serial.Serial(urlsplit(source).path, _baud(source), timeout=_SERIAL_S)
    except (OSError, ValueError) as error:
        raise InputFileError(source, f"cannot be opened ({error})") from None
    loop, arrived, ended = asyncio.get_running_loop(), asyncio.Queue[bytes | OSError](), threading.Event()

    def read() -> None:
        item: bytes | OSError = b""
        while not ended.is_set() and isinstance(item, bytes):
            try:
                # Wait for one byte, then read all other bytes that have arrived.
                item = bytes(port.read(1))
                item += bytes(port.read(port.in_waiting)) if item else b""
            except OSError as error:
                item = error
            if item and not loop.is_closed():
                loop.call_soon_threadsafe(arrived.put_nowait, item)

    thread = threading.Thread(target=read, name=f"railfix {source}", daemon=True)
    thread.start()
    try:
        yield b""
        while isinstance(item := await _within(silence_s, arrived.get), bytes):
            yield item
        raise InputFileError(source, f"the line broke ({item})")
    except TimeoutError:
        raise InputFileError(source, f"has sent nothing for {silence_s:g} s") from None
    finally:
        ended.set()
        thread.join(1.0)
        port.close()


async def _standard_input() -> AsyncIterator[bytes]:
    source = cast("io.BufferedReader", sys.stdin.buffer)
    while data := await asyncio.to_thread(source.read1, _BLOCK):
        yield data
