"""Where a receiver's bytes come from: files, TCP, serial lines, NTRIP casters, standard input."""

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
from typing import TypeVar, cast
from urllib.parse import parse_qs, unquote, urlsplit

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import open_stream
from railfix.live.settings import LiveSettings

Item = TypeVar("Item")
#: The present position as a GGA sentence, empty while there is none.
Place = Callable[[], bytes]
#: Sends to the other end of a connection until cancelled.
Send = Callable[[asyncio.StreamWriter], Coroutine[None, None, None]]

_BLOCK = 4096
_FORMS = (
    "a file, tcp://HOST:PORT, serial:DEVICE?baud=115200, ntrip://[USER:PASSWORD@]HOST:PORT/MOUNT (ntrips:// over TLS), "
    "or - (standard input)"
)
#: NTRIP, plain and over TLS.
_NTRIP = ("ntrip", "ntrips")
#: Longest wait for a connection, and for the first line of an answer [s].
_CONNECT_S = 10.0
#: Longest wait for a byte of a serial line in one call [s].
_SERIAL_S = 0.05
#: Wait for what has come already [s].
_ONCE_MORE_S = 0.02
#: Wait for a first position to send to a caster [s].
_NO_PLACE_S = 1.0
#: Longest header of a caster's answer [bytes].
_HEADER_BYTES = 65_536


@dataclass(frozen=True)
class Connected:
    """A connection was opened; `broken` is how many times it had been lost before."""

    broken: int


@dataclass(frozen=True)
class Lost:
    """A connection broke; the next attempt follows after `wait_s`."""

    reason: str
    wait_s: float


def check_source(source: str) -> None:
    """Raise SettingsError where a source is none of the forms that can be opened."""
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
    """Return a source as it may be shown: without the password."""
    parts = urlsplit(source)
    return source if parts.password is None else source.replace(f":{parts.password}@", ":***@", 1)


async def read_source(
    source: str, settings: LiveSettings, place: Place | None = None
) -> AsyncIterator[bytes | Connected | Lost]:
    """Yield bytes of a source as they arrive; connections that break are opened again, see `LiveSettings.reconnect`.

    `place` gives the present GGA sentence, which a caster is sent every `LiveSettings.gga_s`; none while it is empty.
    InputFileError: when the source cannot be opened, or breaks and is not opened again.
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
    """Yield bytes of a connection, opened again with growing waits where it breaks; empty bytes say that it is open."""
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
    """Return what a call waits for, or raise TimeoutError.

    It is asked once more at the end: what came while this program itself was busy counts. (`asyncio.wait_for` may lose
    a cancellation that comes at the same moment.)
    """
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            return await call()
    async with asyncio.timeout(_ONCE_MORE_S):
        return await call()


async def _tcp(
    source: str, request: bytes, silence_s: float, *, tls: ssl.SSLContext | None = None, send: Send | None = None
) -> AsyncIterator[bytes]:
    """Yield empty bytes once connected, then what arrives; `send` writes to the other end meanwhile."""
    parts = urlsplit(source)
    try:
        async with asyncio.timeout(_CONNECT_S):
            reader, writer = await asyncio.open_connection(parts.hostname, parts.port, ssl=tls)
    except ssl.SSLCertVerificationError as error:
        why = f"its certificate is not accepted ({error.verify_message})"
        hint = "; a certificate of its own goes into --live ntrip_certificates=FILE"
        raise InputFileError(hidden(source), why + hint) from None
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).lower().replace("_", " ")
        raise InputFileError(hidden(source), f"does not speak TLS there ({reason}); is it ntrip://?") from None
    except (OSError, TimeoutError) as error:
        over = "" if tls is None else " over TLS"
        raise InputFileError(hidden(source), f"cannot be connected to{over} ({str(error) or 'no answer'})") from None
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
    """Yield the bytes of a mount point of an NTRIP caster, version 2, or 1 where the caster answers so.

    With `LiveSettings.gga_s` it gets the train's position: in the request where that is known (NTRIP 2), and as lines
    from then on, for the virtual station that it makes there.
    """
    parts = urlsplit(source)
    if settings.gga_s == 0.0:
        place = None
    head = [
        f"GET {parts.path} HTTP/1.1",
        f"Host: {parts.hostname}:{parts.port}",
        "Ntrip-Version: Ntrip/2.0",
        "User-Agent: NTRIP railfix",
        "Connection: close",
    ]
    if parts.username is not None:
        login = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
        head.append("Authorization: Basic " + base64.b64encode(login.encode()).decode())
    if place is not None and (sentence := place()):
        head.append("Ntrip-GGA: " + sentence.decode("ascii").strip())
    request = ("\r\n".join(head) + "\r\n\r\n").encode()
    answer, answered, body = b"", False, None
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
        if answered:
            if content := data if body is None else body.take(data):
                yield content
            continue
        answer += data
        first = answer.split(b"\r\n", 1)[0]
        if first.startswith(b"ICY 200") and b"\r\n" in answer:
            rest = answer.split(b"\r\n", 1)[1].removeprefix(b"\r\n")
        elif first.startswith(b"HTTP/") and b"\r\n\r\n" in answer:
            header, rest = answer.split(b"\r\n\r\n", 1)
            if b" 200" not in first:
                raise _refuse(source, first)
            body = _Chunks() if b"transfer-encoding: chunked" in header.lower() else None
        elif b"\r\n" in answer and not first.startswith((b"HTTP/", b"ICY 200")):
            raise _refuse(source, first)
        elif len(answer) > _HEADER_BYTES:
            raise InputFileError(hidden(source), "the caster's answer has no end of its header")
        else:
            continue
        answered = True
        open_to_lines.set()
        yield b""
        if content := rest if body is None else body.take(rest):
            yield content
    if not answered:
        hint = "" if tls is not None else "; does it expect TLS (ntrips://)?"
        raise InputFileError(hidden(source), f"the caster has closed the connection without an answer{hint}")


def _tls(source: str, certificates: Path | None) -> ssl.SSLContext:
    """Return TLS with the certificates that the system trusts, and those of a file."""
    context = ssl.create_default_context()
    if certificates is not None:
        try:
            context.load_verify_locations(certificates)
        except OSError as error:
            why = "holds no certificate in PEM" if isinstance(error, ssl.SSLError) else str(error.strerror)
            raise SettingsError(f"ntrip_certificates: {certificates}: {why}; needed for {hidden(source)}") from None
    return context


def _refuse(source: str, first: bytes) -> InputFileError:
    text = first[:80].decode("latin-1")
    hint = "; is the mount point right?" if "SOURCETABLE" in text else ""
    hint = "; are user and password right?" if "401" in text else hint
    return InputFileError(hidden(source), f"the caster answers {text!r}{hint}")


class _Chunks:
    """The body of an HTTP answer that comes in chunks (RFC 9112, 7.1)."""

    def __init__(self) -> None:
        self._buffer = b""
        self._left = 0

    def take(self, data: bytes) -> bytes:
        """Content of some more bytes; InputFileError when what stands where the length of a chunk should be is none."""
        self._buffer += data
        content = b""
        while self._buffer:
            if self._left:
                part = self._buffer[: self._left]
                self._buffer, self._left = self._buffer[len(part) :], self._left - len(part)
                content += part
                continue
            line, end, rest = self._buffer.removeprefix(b"\r\n").partition(b"\r\n")
            if not end and len(line) < _BLOCK:
                break
            try:
                self._left = int(line.split(b";")[0] or b"0", 16)
            except ValueError:
                raise InputFileError("the caster", f"sends {line[:20]!r} in place of the length of a chunk") from None
            self._buffer = rest
        return content


def _baud(source: str) -> int:
    text = parse_qs(urlsplit(source).query).get("baud", ["115200"])[0]
    if not text.isdigit() or not urlsplit(source).path:
        raise SettingsError(f"source {source!r}: expected {_FORMS}")
    return int(text)


async def _serial(source: str, silence_s: float) -> AsyncIterator[bytes]:
    """Yield empty bytes once the line is open, then what arrives; a thread reads, so that no byte overflows."""
    try:
        import serial
    except ModuleNotFoundError:
        raise SettingsError(f"source {source!r}: serial lines need pyserial; install railfix[live]") from None
    try:
        port = serial.Serial(urlsplit(source).path, _baud(source), timeout=_SERIAL_S)
    except (OSError, ValueError) as error:
        raise InputFileError(source, f"cannot be opened ({error})") from None
    loop, arrived, ended = asyncio.get_running_loop(), asyncio.Queue[bytes | OSError](), threading.Event()

    def read() -> None:
        item: bytes | OSError = b""
        while not ended.is_set() and isinstance(item, bytes):
            try:
                # The first byte, waited for, and what has come with it: nothing waits for more than there is.
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
