"""Answers of casters that are no stream, and streams in chunks as RFC 9112 has them (requirement A8)."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from railfix.core.errors import InputFileError
from railfix.live.settings import LiveSettings
from railfix.live.sources import Connected, Lost, read_source
from railfix.simulate.demonstration import demo_files

pytestmark = pytest.mark.requirement("A8")
SETTINGS = LiveSettings(reconnect="off", silence_s=2.0)
OK = b"HTTP/1.1 200 OK\r\n"


def received(
    answer: bytes, settings: LiveSettings = SETTINGS, most: int = 100, piece: int = 3, hold_s: float = 0.0
) -> list[bytes | Connected | Lost]:
    """What comes of a caster that sends an answer, in pieces of some bytes, and closes the connection after a time."""

    async def caster(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError), contextlib.closing(writer):
            await reader.readuntil(b"\r\n\r\n")
            for k in range(0, len(answer), piece):
                writer.write(answer[k : k + piece])
                await writer.drain()
            await asyncio.sleep(hold_s)

    async def run() -> list[bytes | Connected | Lost]:
        server = await asyncio.start_server(caster, "127.0.0.1", 0)
        port, parts = server.sockets[0].getsockname()[1], list[bytes | Connected | Lost]()
        source = read_source(f"ntrip://train:secret@127.0.0.1:{port}/VRS", settings, None)
        try:
            async for part in source:
                parts.append(part)
                if len(parts) >= most:
                    break
        finally:
            await source.aclose()  # type: ignore[attr-defined]
            server.close()
            await asyncio.sleep(0.1)  # the server's own end of what failed
        return parts

    return asyncio.run(asyncio.wait_for(run(), 20.0))


@pytest.mark.parametrize(
    "coding", [b"Transfer-Encoding: chunked", b"Transfer-Encoding:chunked", b"TRANSFER-ENCODING:\tChunked"]
)
def test_chunks_are_joined_however_the_header_is_written(coding: bytes) -> None:
    body = b"5\r\ncorre\r\n6;name=value\r\nctions\r\n0\r\n\r\n"
    parts = received(OK + coding + b"\r\n\r\n" + body, hold_s=10.0)  # the last chunk ends the stream
    assert b"".join(part for part in parts if isinstance(part, bytes)) == b"corrections"


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (OK + b"Transfer-Encoding: chunked\r\n\r\n-5\r\n" + bytes(300), "answer is not HTTP"),
        (OK + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n", "answer is not HTTP"),
        (OK + b"Content-Type: gnss/sourcetable\r\n\r\nSTR;A", "check host and mount point"),
        (OK + b"\r\nSTR;MOUNT;here\r\n", "source table, not a receiver's stream"),
        (b"SOURCETABLE 200 OK\r\n", "check the mount point"),
        (OK + b"Content-Type: text/html\r\n\r\n<p>", "an HTML page"),
        (OK + b"\r\n<!DOCTYPE html><html>" + bytes(40), "an HTML page"),
        (OK + b"Content-Encoding: gzip\r\n\r\n" + gzip.compress(b"x" * 50, mtime=0), "encoding 'gzip'"),
        (OK + b"\r\n" + gzip.compress(b"x" * 50, mtime=0), "compressed content"),
        (b"HTTP/1.1 401 Unauthorized\r\n\r\n", "check user and password"),
        (OK + b"X: " + b"y" * 70_000 + b"\r\n\r\n", "answer is not HTTP"),
        (b"\x00" * 70_000, "the caster answers"),
        (b"", "closed the connection without an answer"),
    ],
)  # fmt: skip
def test_an_answer_that_is_no_stream_is_named(answer: bytes, says: str) -> None:
    with pytest.raises(InputFileError, match=says) as error:
        received(answer)
    assert "secret" not in str(error.value)


def test_plain_answers_are_streams() -> None:
    for head in (b"ICY 200 OK\r\n", b"ICY 200 OK\r\n\r\n", OK + b"Content-Length: 11\r\n\r\n", OK + b"\r\n"):
        parts = received(head + b"corrections", piece=100)
        assert b"".join(part for part in parts if isinstance(part, bytes)) == b"corrections"


def test_a_caster_that_breaks_its_chunks_later_is_asked_again() -> None:
    answer = OK + b"Transfer-Encoding: chunked\r\n\r\n2\r\nok\r\n-5\r\n"
    parts = received(answer, LiveSettings(reconnect_first_s=0.05, silence_s=2.0), most=5)
    kinds = [type(part).__name__ if not isinstance(part, bytes) else part for part in parts]
    assert kinds == ["Connected", b"ok", "Lost", "Connected", b"ok"]
    lost = parts[2]
    assert isinstance(lost, Lost)
    assert re.search("answer is not HTTP", lost.reason)


@pytest.mark.slow
def test_a_session_with_such_a_caster_ends_by_sigterm() -> None:
    server = socket.create_server(("127.0.0.1", 0))

    def caster() -> None:
        while True:
            with server.accept()[0] as connection:
                connection.recv(4000)
                connection.sendall(OK + b"Transfer-Encoding: chunked\r\n\r\n1\r\n \r\n-5\r\n" + bytes(300))

    threading.Thread(target=caster, daemon=True).start()
    files = demo_files()
    words = ["--front", f"ntrip://a:b@127.0.0.1:{server.getsockname()[1]}/M", "--track", str(files["track"])]
    process = subprocess.Popen(
        [sys.executable, "-m", "railfix", "live", *words, "--live", "no_input=send", "--send", "json@-"],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        assert process.stdout.readline()
        time.sleep(1.0)
        process.send_signal(signal.SIGTERM)
        assert process.wait(30.0) == 128 + signal.SIGTERM
    finally:
        process.kill()
        process.communicate()
