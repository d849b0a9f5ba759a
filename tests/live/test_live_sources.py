"""Sources of live streams end to end: serial lines, TCP, NTRIP casters of both versions; breaks, silence, restarts."""

from __future__ import annotations

import asyncio
import base64
import gzip
import logging
import os
import threading
import time
import tty
from collections.abc import Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import railfix
from railfix.cli import app
from railfix.core.errors import InputFileError
from railfix.core.timescale import to_week
from railfix.gnss.observations import Observations
from railfix.io.receiver.framing import find_frames
from railfix.io.receiver.log import StreamState, decode
from railfix.io.receiver.rtcm import find_unfinished_epoch
from railfix.live.console import Metrics
from railfix.live.engine import LiveEngine, LiveOutput
from railfix.live.session import Hooks, run_session
from railfix.live.settings import LiveSettings
from railfix.live.sources import Connected, Lost, read_source
from railfix.live.stream import ReceiverState, receive_bytes, single_epochs
from railfix.simulate.demonstration import demo_files
from ubx_made import log_of

pytestmark = pytest.mark.requirement("A8")
RUNNER = CliRunner(env={"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"})
EPOCHS = 12
QUICK = LiveSettings(
    period_s=1.0, no_input="skip", reconnect="off", reconnect_first_s=0.02, reconnect_longest_s=0.04, silence_s=0.3
)


@pytest.fixture(scope="module")
def log() -> bytes:
    """The first epochs of the demonstration's front antenna as UBX."""
    return log_of(railfix.read_observations(demo_files()["front"])[:EPOCHS])


@pytest.fixture(scope="module")
def tags(log: bytes) -> list[np.datetime64]:
    piece, _ = decode(log, StreamState(), at_end=True)
    assert len(piece.measurements.time) == EPOCHS
    return list(piece.measurements.time)


def engine(settings: LiveSettings = QUICK) -> LiveEngine:
    files = demo_files()
    path = railfix.Trajectory.from_antenna_path(railfix.read_track([files["track"]]))
    return LiveEngine(
        railfix.EpochProcessor(railfix.Config(), {"front": path}, navigation=railfix.read_navigation(files["nav"])),
        settings,
    )


async def session(source: str, settings: LiveSettings = QUICK) -> tuple[list[np.datetime64], Metrics]:
    """Tags of the epochs that a session on one source has processed."""
    outputs: list[LiveOutput] = []
    metrics = await run_session(
        engine(settings), {"front": source}, [], speed=None, hooks=Hooks(observe=outputs.append)
    )
    with_rows = [o.result for o in outputs if o.result is not None and o.part != "message"]
    return [result.antennas["front"].time[-1] for result in with_rows], metrics


Answer = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Coroutine[Any, Any, None]]


async def listening(answer: Answer) -> tuple[asyncio.Server, int]:
    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    return server, server.sockets[0].getsockname()[1]


def in_fragments(data: bytes, seed: int) -> list[bytes]:
    cuts = np.sort(np.random.default_rng(seed).integers(0, len(data), 30))
    return [bytes(part) for part in np.split(np.frombuffer(data, np.uint8), cuts) if len(part)]


def test_a_serial_line(log: bytes, tags: list[np.datetime64]) -> None:
    """A pair of pseudo-terminals: every epoch arrives; the end of the line is an error that names it."""
    pytest.importorskip("serial", reason="pyserial is not installed")
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    name = os.ttyname(theirs)

    opened = threading.Event()

    class Opened(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if "connected to serial" in record.getMessage():
                opened.set()

    def write() -> None:
        assert opened.wait(20)  # what is sent before the line is opened is lost, as on a real one
        for part in in_fragments(log, 1):
            os.write(ours, part)
            time.sleep(0.005)
        until = time.monotonic() + 20
        while len(outputs) < EPOCHS and time.monotonic() < until:
            time.sleep(0.02)
        os.close(ours)  # what was not yet read is lost with it

    logger, handler = logging.getLogger("railfix.live"), Opened()
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    outputs: list[LiveOutput] = []
    writer = threading.Thread(target=write)
    writer.start()
    seen: list[np.datetime64] = []

    async def run() -> None:
        try:
            await run_session(
                engine(), {"front": f"serial:{name}?baud=115200"}, [], speed=None, hooks=Hooks(observe=outputs.append)
            )
        finally:
            seen.extend(o.result.antennas["front"].time[-1] for o in outputs if o.result is not None)

    with pytest.raises(InputFileError, match=r"the line broke|has sent nothing"):
        asyncio.run(run())
    logger.removeHandler(handler)
    writer.join()
    os.close(theirs)
    assert seen == tags


def caster(log: bytes, version: int, *, chunked: bool = True) -> tuple[Answer, list[bytes]]:
    """A caster with one mount point that asks for a password; the requests it got."""
    requests: list[bytes] = []
    login = base64.b64encode(b"train:pa:ss").decode().encode()

    async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request = await reader.readuntil(b"\r\n\r\n")
        requests.append(request)
        if b"Authorization: Basic " + login not in request:
            writer.write(b"HTTP/1.1 401 Unauthorized\r\nNtrip-Version: Ntrip/2.0\r\n\r\n")
        elif not request.startswith(b"GET /ROOF HTTP/1.1\r\n"):
            writer.write(b"SOURCETABLE 200 OK\r\nContent-Type: text/plain\r\n\r\nENDSOURCETABLE\r\n")
        elif version == 1:
            writer.write(b"ICY 200 OK\r\n\r\n")
            for part in in_fragments(log, 2):
                writer.write(part)
                await writer.drain()
        else:
            head = b"HTTP/1.1 200 OK\r\nNtrip-Version: Ntrip/2.0\r\nContent-Type: gnss/data\r\n"
            writer.write(head + (b"Transfer-Encoding: chunked\r\n\r\n" if chunked else b"\r\n"))
            for part in in_fragments(log, 3):
                writer.write(b"%x\r\n%b\r\n" % (len(part), part) if chunked else part)
                await writer.drain()
            writer.write(b"0\r\n\r\n" if chunked else b"")
        await writer.drain()
        writer.close()

    return answer, requests


@pytest.mark.parametrize(("version", "chunked"), [(1, False), (2, True), (2, False)])
def test_a_caster(log: bytes, tags: list[np.datetime64], version: int, chunked: bool) -> None:
    answer, requests = caster(log, version, chunked=chunked)

    async def run() -> list[np.datetime64]:
        server, port = await listening(answer)
        seen, metrics = await session(f"ntrip://train:pa%3Ass@127.0.0.1:{port}/ROOF")
        server.close()
        assert metrics.skipped["bytes outside messages"] == 0
        return seen

    assert asyncio.run(run()) == tags
    assert b"Ntrip-Version: Ntrip/2.0\r\n" in requests[0]


@pytest.mark.parametrize(
    ("place", "says"),
    [("train:wrong@{at}/ROOF", "check user and password"), ("train:pa%3Ass@{at}/NOWHERE", "check the mount point")],
)
def test_what_a_caster_refuses_ends_the_session(log: bytes, place: str, says: str) -> None:
    """Also with reconnecting on: the first connection must succeed. The password is not shown."""
    answer, _ = caster(log, 2)

    async def run() -> None:
        server, port = await listening(answer)
        try:
            await session("ntrip://" + place.format(at=f"127.0.0.1:{port}"), QUICK.replaced(reconnect="on"))
        finally:
            server.close()

    with pytest.raises(InputFileError, match=says) as error:
        asyncio.run(run())
    assert "wrong" not in str(error.value)
    assert "***" in str(error.value)


def test_a_broken_connection_is_opened_again(
    log: bytes, tags: list[np.datetime64], caplog: pytest.LogCaptureFixture
) -> None:
    """Cut off in the middle of a message twice: the rest comes over new connections, told and counted."""
    frames = find_frames(np.frombuffer(log, np.uint8))
    third, sixth = int(frames.frame_start[3]), int(frames.frame_start[6])
    pieces = [log[: third + 20], log[third : sixth + 30], log[sixth:]]
    served = 0

    async def answer(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal served
        if served < len(pieces):
            writer.write(pieces[served])
            served += 1
        await writer.drain()
        writer.close()

    async def run() -> tuple[list[np.datetime64], Metrics]:
        server, port = await listening(answer)
        outputs: list[LiveOutput] = []
        metrics = Metrics()
        task = asyncio.create_task(
            run_session(
                engine(QUICK.replaced(reconnect="on")),
                {"front": f"tcp://127.0.0.1:{port}"},
                [],
                speed=None,
                hooks=Hooks(observe=outputs.append, metrics=metrics),
            )
        )
        while sum(o.result is not None for o in outputs) < EPOCHS and not task.done():
            await asyncio.sleep(0.01)
        task.cancel()
        server.close()
        return [o.result.antennas["front"].time[-1] for o in outputs if o.result is not None], metrics

    with caplog.at_level(logging.INFO, logger="railfix.live"):
        seen, metrics = asyncio.run(run())
    assert seen == tags
    assert sum(metrics.lost.values()) >= 2
    assert "has closed the connection; next attempt in" in caplog.text
    assert "after 2 breaks" in caplog.text
    assert 'railfix_connections_lost_total{source="tcp://127.0.0.1' in metrics.text()


def test_waits_double_and_silence_is_a_break() -> None:
    """A peer that accepts and says nothing, then one that is gone: waits of 20, 40, 40 ms."""

    async def silent(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()
        writer.close()

    async def run() -> list[bytes | Connected | Lost]:
        server, port = await listening(silent)
        stream = read_source(f"tcp://127.0.0.1:{port}", QUICK.replaced(reconnect="on", silence_s=0.1))
        found = [await anext(stream), await anext(stream)]
        server.close()
        await server.wait_closed()
        found += [await anext(stream) for _ in range(3)]
        await stream.aclose()  # type: ignore[attr-defined]
        return found

    first, second, *later = asyncio.run(asyncio.wait_for(run(), 20))
    assert first == Connected(0)
    assert isinstance(second, Lost)
    assert "has sent nothing for 0.1 s" in second.reason
    assert [part.wait_s for part in (second, *later) if isinstance(part, Lost)] == [0.02, 0.04, 0.04, 0.04]
    assert "the connection cannot be opened" in str(later[-1])


def test_a_message_cut_off_by_a_break_does_not_swallow_the_next(log: bytes) -> None:
    frames = find_frames(np.frombuffer(log, np.uint8))
    second = int(frames.frame_start[1])
    items = list(receive_bytes(log[: second + 40], ReceiverState()))
    state = items[-1].after
    assert sum(len(item.epochs) for item in items) == 1
    items = list(receive_bytes(log[second:], state.after_break()))
    assert sum(len(item.epochs) for item in items) == EPOCHS - 1


def shifted(observations: Observations, by: np.timedelta64) -> Observations:
    return replace(observations, time=observations.time + by)


def test_a_receiver_restarted_with_older_tags(tmp_path: Path) -> None:
    """In a stream of bytes: the engine hears of the older tags, and restarts after three of them."""
    observations = railfix.read_observations(demo_files()["front"])[:30]
    early = shifted(observations[20:30], -np.timedelta64(3600, "s"))
    path = tmp_path / "log.ubx"
    path.write_bytes(log_of(observations[:20]) + log_of(early))
    machine, outputs = engine(), list[LiveOutput]()
    asyncio.run(run_session(machine, {"front": str(path)}, [], speed=None, hooks=Hooks(observe=outputs.append)))
    assert machine.counts["restart"] == 1
    assert machine.counts["out of order"] == 3
    assert sum(o.result is not None for o in outputs) == 20 + 8


def test_the_week_rolls_over(tmp_path: Path) -> None:
    """Epochs on both sides of a week's end are one second apart."""
    observations = railfix.read_observations(demo_files()["front"])[:20]
    _, second = to_week(observations.time[10])
    shift = np.timedelta64(round((604_800 - float(second)) * 1e9), "ns")
    path = tmp_path / "log.ubx"
    path.write_bytes(log_of(shifted(observations, shift)))
    read = railfix.read_observations(path)
    week, _ = to_week(read.time)
    assert np.unique(week).tolist() == [int(week[0]), int(week[0]) + 1]
    assert np.array_equal(np.diff(read.time), np.diff(observations.time))


def test_rtcm_live_is_dated_by_the_clock() -> None:
    """Observations of RTCM 3 carry no week: of a live stream it is this one, of a file that of --date."""
    data = msm7(np.arange(5) * 1000 + 200_000_000)
    now = np.datetime64(time.time_ns(), "ns")

    async def answer(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(data)
        await writer.drain()
        writer.close()

    async def run() -> list[np.datetime64]:
        server, port = await listening(answer)
        seen, _ = await session(f"tcp://127.0.0.1:{port}")
        server.close()
        return seen

    seen = asyncio.run(run())
    assert len(seen) == 5
    assert abs(seen[0] - now) <= np.timedelta64(84 * 3600 + 20, "s")


def test_a_date_for_rtcm_in_run_and_convert(tmp_path: Path) -> None:
    """One option for both: without it the log cannot be dated, with it its epochs are those of that week."""
    files, path = demo_files(), tmp_path / "log.rtcm3"
    path.write_bytes(msm7(np.arange(5) * 1000 + 200_000_000))
    run = ["run", "--front", str(path), "--nav", str(files["nav"]), "--track", str(files["track"])]
    convert = ["convert", str(path), "--out", str(tmp_path / "log.rnx")]
    for words in ([*run, "--out", str(tmp_path / "run")], convert):
        undated = RUNNER.invoke(app, words)
        assert undated.exit_code == 3
        assert "give a date (date, --date)" in " ".join(undated.output.split())
    assert RUNNER.invoke(app, [*convert, "--date", "2024-03-05"]).exit_code == 0
    dated = railfix.read_observations(tmp_path / "log.rnx")
    assert dated.time[0] == np.datetime64("2024-03-05T07:33:20")
    done = RUNNER.invoke(app, [*run, "--out", str(tmp_path / "run"), "--date", "2024-03-05"])
    assert done.exit_code == 7, done.output  # dated, but its codes are nonsense: no position


def test_an_epoch_without_its_last_message_does_not_hold_up_the_stream() -> None:
    """A caster that sets the flag "more messages follow" on all of them: an epoch ends where the next one begins."""
    data = msm7(np.arange(40) * 1000 + 200_000_000, more=True)
    assert find_unfinished_epoch(find_frames(np.frombuffer(data, np.uint8))) is not None
    state = ReceiverState(stream=StreamState(time=np.datetime64("2025-08-12", "ns")))
    epochs = 0
    for place in range(0, len(data), 50):
        items = list(receive_bytes(data[place : place + 50], state))
        state = items[-1].after
        epochs += sum(len(item.epochs) for item in items)
        assert len(state.stream.rest) < 300
    assert epochs == 39
    whole, _ = decode(data, StreamState(time=np.datetime64("2025-08-12", "ns")), at_end=True)
    assert len(whole.measurements.time) == 40


def msm7(tow_ms: np.ndarray, *, more: bool = False) -> bytes:
    """RTCM 3 messages 1077 of four satellites, one signal each."""
    from railfix.core.checksums import crc24q

    out = b""
    for k, tow in enumerate(tow_ms.tolist()):
        fields = [(1077, 12), (0, 12), (tow, 30), (int(more), 1), (0, 3 + 7 + 2 + 2 + 1 + 3)]
        fields += [(0b1111 << 60, 64), (1 << 30, 32), (15, 4)]
        fields += [(70 + n, 8) for n in range(4)] + [(0, 4)] * 4 + [(100 * n, 10) for n in range(4)] + [(5, 14)] * 4
        fields += [(100, 20)] * 4 + [(100, 24)] * 4 + [(500 + k % 100, 10)] * 4 + [(0, 1)] * 4 + [(640, 10)] * 4
        fields += [(3, 15)] * 4
        text = "".join(f"{value:0{length}b}" for value, length in fields)
        body = int(text.ljust(-(-len(text) // 8) * 8, "0"), 2).to_bytes(-(-len(text) // 8), "big")
        framed = b"\xd3" + len(body).to_bytes(2, "big") + body
        crc = int(crc24q(np.frombuffer(framed, np.uint8), np.array([0]), np.array([len(framed)]))[0])
        out += framed + crc.to_bytes(3, "big")
    return out


def test_a_file_is_replayed_at_its_speed(log: bytes, tmp_path: Path) -> None:
    """12 epochs at 10 Hz, twice as fast: 0.55 s, epoch by epoch."""
    path = tmp_path / "log.ubx"
    path.write_bytes(log)
    arrivals: list[float] = []

    def observe(output: LiveOutput) -> None:
        if output.part != "message":
            arrivals.append(time.monotonic())

    hooks = Hooks(observe=observe)
    asyncio.run(run_session(engine(), {"front": str(path)}, [], speed=2.0, hooks=hooks))
    assert len(arrivals) == EPOCHS
    assert arrivals[-1] - arrivals[0] > 0.9 * 0.1 * (EPOCHS - 1) / 2.0


def test_a_packed_log_is_a_stream_too(log: bytes, tags: list[np.datetime64], tmp_path: Path) -> None:
    path = tmp_path / "log.ubx.gz"
    path.write_bytes(gzip.compress(log))
    seen, _ = asyncio.run(session(str(path)))
    assert seen == tags
    assert len(single_epochs(railfix.read_observations(path))) == EPOCHS
