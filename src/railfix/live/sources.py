"""Where a receiver's bytes come from: files, TCP, serial lines, NTRIP casters, standard input."""

from __future__ import annotations

import asyncio
import base64
import io
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import cast
from urllib.parse import parse_qs, unquote, urlsplit

import numpy as np

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import open_stream
from railfix.io.receiver.log import StreamState, decode

_BLOCK = 4096
_FORMS = (
    "a file, tcp://HOST:PORT, serial:DEVICE?baud=115200, ntrip://[USER:PASSWORD@]HOST:PORT/MOUNT, or - (standard input)"
)
#: Longest wait for a connection, and for the first line of an answer [s].
_CONNECT_S = 10.0


def check_source(source: str) -> None:
    """Raise where a source is none of the forms that can be opened.

    Raises
    ------
    SettingsError
    """
    parts = urlsplit(source)
    if parts.scheme in ("tcp", "ntrip"):
        try:
            port = parts.port
        except ValueError:
            port = None
        if not parts.hostname or port is None or (parts.scheme == "ntrip" and not parts.path.strip("/")):
            raise SettingsError(f"source {source!r}: expected {_FORMS}")
    elif parts.scheme and parts.scheme not in ("serial", "file") and not Path(source).exists():
        raise SettingsError(f"source {source!r}: expected {_FORMS}")


async def read_source(source: str, *, speed: float | None) -> AsyncIterator[bytes]:
    """Bytes of a source as they arrive.

    Parameters
    ----------
    source : str
    speed : float or None
        For files: times as fast as recorded; None is as fast as they can be read.

    Raises
    ------
    InputFileError
        The source cannot be opened, or ends by an error.
    """
    parts = urlsplit(source)
    if source == "-":
        async for data in _standard_input():
            yield data
    elif parts.scheme == "tcp":
        async for data in _tcp(source, parts.hostname or "", parts.port or 0, b""):
            yield data
    elif parts.scheme == "ntrip":
        async for data in _ntrip(source):
            yield data
    elif parts.scheme == "serial":
        async for data in _serial(source, parts.path or parts.netloc, parse_qs(parts.query)):
            yield data
    else:
        async for data in _file(source.removeprefix("file:"), speed):
            yield data


async def _file(path: str, speed: float | None) -> AsyncIterator[bytes]:
    """A recorded log, block by block, or paced by the time tags of its epochs."""
    loop = asyncio.get_running_loop()
    began, first_tag, state = loop.time(), None, StreamState()
    with open_stream(path, content="bytes") as stream:
        while block := stream.read(_BLOCK if speed is not None else 16 * _BLOCK):
            if speed is not None:
                piece, state = decode(block, state)
                if len(piece.measurements.time):
                    tag = piece.measurements.time[-1]
                    first_tag = tag if first_tag is None else first_tag
                    due = began + float((tag - first_tag) / np.timedelta64(1, "s")) / speed
                    await asyncio.sleep(max(0.0, due - loop.time()))
            yield block
            await asyncio.sleep(0)


async def _tcp(source: str, host: str, port: int, request: bytes) -> AsyncIterator[bytes]:
    try:
        reader, writer = await asyncio.wait_for(asyncio.open_connection(host, port), _CONNECT_S)
    except (OSError, TimeoutError) as error:
        raise InputFileError(source, f"cannot be connected to ({error or 'no answer'})") from None
    try:
        if request:
            writer.write(request)
            await writer.drain()
        while data := await reader.read(_BLOCK):
            yield data
    except OSError as error:
        raise InputFileError(source, f"the connection broke ({error})") from None
    finally:
        writer.close()


async def _ntrip(source: str) -> AsyncIterator[bytes]:
    """A mount point of an NTRIP caster, version 2, or 1 where the caster answers so."""
    parts = urlsplit(source)
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
    request = ("\r\n".join(head) + "\r\n\r\n").encode()
    answer, chunked, answered, body = b"", False, False, _Chunks()
    async for data in _tcp(source, parts.hostname or "", parts.port or 0, request):
        if answered:
            yield body.take(data) if chunked else data
            continue
        answer += data
        first = answer.split(b"\r\n", 1)[0]
        if first.startswith(b"ICY 200") and b"\r\n" in answer:
            answered, rest = True, answer.split(b"\r\n", 1)[1].removeprefix(b"\r\n")
        elif first.startswith(b"HTTP/") and b"\r\n\r\n" in answer:
            header, rest = answer.split(b"\r\n\r\n", 1)
            if b" 200" not in first:
                raise InputFileError(source, f"the caster answers {first.decode('latin-1')!r}")
            answered, chunked = True, b"transfer-encoding: chunked" in header.lower()
        elif b"\r\n" in answer and not first.startswith((b"HTTP/", b"ICY")):
            raise InputFileError(source, f"the caster answers {first[:80].decode('latin-1')!r}")
        elif len(answer) > 65_536:
            raise InputFileError(source, "the caster's answer has no end of its header")
        else:
            continue
        yield body.take(rest) if chunked else rest


class _Chunks:
    """The body of an HTTP answer that comes in chunks (RFC 9112, 7.1)."""

    def __init__(self) -> None:
        self._buffer = b""
        self._left = 0

    def take(self, data: bytes) -> bytes:
        """Content of some more bytes."""
        self._buffer += data
        content = b""
        while self._buffer:
            if self._left:
                part = self._buffer[: self._left]
                self._buffer, self._left = self._buffer[len(part) :], self._left - len(part)
                content += part
                continue
            line, end, rest = self._buffer.removeprefix(b"\r\n").partition(b"\r\n")
            if not end:
                break
            self._buffer, self._left = rest, int(line.split(b";")[0] or b"0", 16)
        return content


async def _serial(source: str, device: str, query: dict[str, list[str]]) -> AsyncIterator[bytes]:
    try:
        import serial
    except ModuleNotFoundError:
        raise SettingsError(f"source {source!r}: serial lines need pyserial; install railfix[live]") from None
    try:
        port = serial.Serial(device, int(query.get("baud", ["115200"])[0]), timeout=0.05)
    except (OSError, ValueError) as error:
        raise InputFileError(source, f"cannot be opened ({error})") from None
    with port:
        while True:
            try:
                data = await asyncio.to_thread(port.read, _BLOCK)
            except OSError as error:
                raise InputFileError(source, f"the line broke ({error})") from None
            if data:
                yield data


async def _standard_input() -> AsyncIterator[bytes]:
    source = cast("io.BufferedReader", sys.stdin.buffer)
    while data := await asyncio.to_thread(source.read1, _BLOCK):
        yield data
