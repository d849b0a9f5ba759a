"""Targets of live messages end to end: MQTT broker, slow and broken readers, forms; what a person sees of a session."""

from __future__ import annotations

import asyncio
import logging
import os
import pty
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from io import StringIO
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

import railfix
from railfix.cli import app
from railfix.core.errors import OutputError, SettingsError
from railfix.io.train_message import TrainMessage, decode, from_json
from railfix.live import sinks
from railfix.live.console import Metrics, SessionLog
from railfix.live.engine import LiveOutput
from railfix.live.forms import forms
from railfix.live.session import Hooks, _Session
from railfix.live.settings import LiveSettings
from railfix.live.sinks import MqttTarget, Outlet, open_sink
from railfix.simulate.demonstration import demo_files
from ubx_made import log_of

pytestmark = pytest.mark.requirement("A8")
RUNNER = CliRunner(env={"COLUMNS": "100", "TERM": "dumb", "NO_COLOR": "1"})


def output(sequence: int, **values: Any) -> LiveOutput:
    message = TrainMessage(train=1, sequence=sequence, time_ns=1, sent_ns=1, line=1, **values)
    return LiveOutput(message=message, result=None)


def test_a_slow_reader_delays_nothing_and_loses_what_does_not_fit() -> None:
    """A pipe that nobody reads: 5000 messages are handed over meanwhile, the rest is counted."""
    release, taken = threading.Event(), list[int]()

    def stuck(item: int) -> None:
        release.wait(20)
        taken.append(item)

    outlet = Outlet("slow", stuck, waiting=100)
    for k in range(5000):
        outlet.send(k)
    assert not taken
    assert outlet.dropped >= 5000 - 102
    release.set()
    outlet.close()
    assert len(taken) + outlet.dropped == 5000
    assert taken == sorted(taken)


def test_what_a_stuck_target_has_not_taken_at_the_end_is_lost_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sinks, "_CLOSE_S", 0.05)
    release = threading.Event()
    outlet = Outlet("stuck", lambda _: bool(release.wait(20)), waiting=100)
    for k in range(5):
        outlet.send(k)
    outlet.close()
    release.set()
    assert outlet.dropped == 5


def test_a_replay_waits_and_loses_nothing() -> None:
    taken = list[int]()

    def slow(item: int) -> None:
        time.sleep(0.001)
        taken.append(item)

    outlet = Outlet("slow", slow, waiting=3, full="wait")
    for k in range(50):
        outlet.send(k)
    outlet.close()
    assert taken == list(range(50))


def test_a_target_that_refuses_is_counted_and_a_defect_is_raised() -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    outlet = Outlet("disk", full, waiting=10)
    for k in range(5):
        outlet.send(k)
    outlet.close()
    assert (outlet.failed, outlet.failure) == (5, "cannot be written (No space left on device)")
    strict = Outlet("disk", full, waiting=10, full="wait")
    strict.send(1)
    with pytest.raises(OutputError, match="disk: cannot be written"):
        strict.close()

    def defect(_: int) -> None:
        raise ZeroDivisionError

    broken = Outlet("defect", defect, waiting=10)
    broken.send(1)
    broken.close()
    with pytest.raises(ZeroDivisionError):
        broken.send(2)


def test_readers_of_a_server_and_datagrams() -> None:
    """Everybody who connects gets the messages from then on; datagrams carry no length."""

    async def run() -> tuple[list[TrainMessage], list[TrainMessage]]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind(("127.0.0.1", 0))
            receiver.settimeout(5)
            port = free_port()
            server = await open_sink(f"json@tcp-server://127.0.0.1:{port}")
            udp = await open_sink(f"cbor@udp://127.0.0.1:{receiver.getsockname()[1]}")
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            await asyncio.sleep(0.05)
            for k in range(3):
                server.send(output(k))
                udp.send(output(k))
            lines = [await asyncio.wait_for(reader.readline(), 5) for _ in range(3)]
            udp.close()
            datagrams = [receiver.recv(2000) for _ in range(3)]
            assert (server.dropped, server.failed, udp.dropped, udp.failed) == (0, 0, 0, 0)
            writer.close()
            server.close()
        return [from_json(line.decode()) for line in lines], [decode(data) for data in datagrams]

    over_tcp, over_udp = asyncio.run(run())
    assert over_tcp == over_udp == [output(k).message for k in range(3)]


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def started_broker(folder: Path, port: int, *, password: bool) -> subprocess.Popen[bytes]:
    program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
    if program is None:
        pytest.skip("no MQTT broker: mosquitto (Debian package of that name) is not installed")
    lines = [f"listener {port} 127.0.0.1", "persistence false"]
    if password:
        words = ["mosquitto_passwd", "-b", "-c", str(folder / "passwords"), "train", "p:s"]
        subprocess.run(words, check=True, timeout=20, capture_output=True)
        (folder / "passwords").chmod(0o644)
        lines += ["allow_anonymous false", f"password_file {folder / 'passwords'}", "user root"]
    else:
        lines.append("allow_anonymous true")
    (folder / "broker.conf").write_text("\n".join(lines) + "\n")
    process = subprocess.Popen(
        [program, "-c", str(folder / "broker.conf")], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    until = time.monotonic() + 10
    while time.monotonic() < until:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return process
        time.sleep(0.05)
    raise AssertionError("the broker does not listen")


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[int]:
    port = free_port()
    process = started_broker(tmp_path, port, password=False)
    yield port
    process.terminate()
    process.wait(10)


@pytest.fixture
def subscribed(broker: int) -> Iterator[tuple[int, list[bytes]]]:
    paho = pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")
    enums = pytest.importorskip("paho.mqtt.enums", reason="paho-mqtt is not installed")
    got: list[bytes] = []
    ready = threading.Event()
    client = paho.Client(enums.CallbackAPIVersion.VERSION2)
    client.on_message = lambda _client, _data, message: got.append(message.payload)
    client.on_subscribe = lambda *_: ready.set()
    client.on_connect = lambda *_: client.subscribe("railway/train 7", qos=1)
    client.connect("127.0.0.1", broker)
    client.loop_start()
    assert ready.wait(10)
    yield broker, got
    client.disconnect()
    client.loop_stop()


@pytest.mark.parametrize("form", ["json", "cbor"])
def test_mqtt(subscribed: tuple[int, list[bytes]], form: str) -> None:
    """Every message arrives under its topic, in order."""
    port, got = subscribed

    async def run() -> None:
        sink = await open_sink(f"{form}@mqtt://127.0.0.1:{port}/railway/train 7")
        for k in range(50):
            sink.send(output(k))
        await asyncio.to_thread(sink.close)
        assert (sink.dropped, sink.failed) == (0, 0)

    asyncio.run(run())
    until = time.monotonic() + 10
    while len(got) < 50 and time.monotonic() < until:
        time.sleep(0.02)
    messages = [from_json(data.decode()) if form == "json" else decode(data) for data in got]
    assert [message.sequence for message in messages] == list(range(50))


def test_mqtt_broker_that_goes_away_and_comes_back(tmp_path: Path) -> None:
    """Messages in between are counted as refused; the connection is opened again."""
    pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")
    port = free_port()
    process = started_broker(tmp_path, port, password=False)

    async def run() -> None:
        nonlocal process
        sink = await open_sink(f"json@mqtt://127.0.0.1:{port}/x")
        await until(lambda: delivered(sink, 1) == 0)
        process.terminate()
        process.wait(10)
        await until(lambda: delivered(sink, 2) > 0)
        assert sink.failure.startswith("cannot be written (the broker is not connected")
        process = started_broker(tmp_path, port, password=False)
        await until(lambda: delivered(sink, 3) == 0)
        await asyncio.to_thread(sink.close)

    def delivered(sink: Any, number: int) -> int:
        """How many more were refused after one message."""
        before = sink.failed
        sink.send(output(number))
        time.sleep(0.1)
        return int(sink.failed - before)

    async def until(reached: Any) -> None:
        end = time.monotonic() + 15
        while not await asyncio.to_thread(reached):
            assert time.monotonic() < end
            await asyncio.sleep(0.1)

    try:
        asyncio.run(run())
    finally:
        process.terminate()
        process.wait(10)


def test_mqtt_connection_that_breaks_while_a_message_is_handed_over() -> None:
    """paho reports it by the return code, and raises RuntimeError once such a message is asked for."""
    client = pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")
    broken, codes = client.MQTT_ERR_NO_CONN, []

    def publish(*_: object, **__: object) -> Any:
        info = client.MQTTMessageInfo(1)
        info.rc = codes.pop(0)
        return info

    target = object.__new__(MqttTarget)
    target.form, target.topic, target._waiting, target._sent = forms(LiveSettings())["json"], "x", 5, deque()
    target._client = SimpleNamespace(is_connected=lambda: True, publish=publish)
    codes += [0, broken, 0, 0]
    target.send(output(1))
    with pytest.raises(OutputError, match="the broker is not connected"):
        target.send(output(2))
    target.send(output(3))
    target.send(output(4))
    assert len(target._sent) == 3


def test_mqtt_broker_that_asks_for_a_password(tmp_path: Path) -> None:
    pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")
    if shutil.which("mosquitto_passwd") is None:
        pytest.skip("mosquitto_passwd (Debian package mosquitto) is not installed")
    port = free_port()
    process = started_broker(tmp_path, port, password=True)

    async def run(login: str) -> None:
        sink = await open_sink(f"json@mqtt://{login}127.0.0.1:{port}/x")
        sink.send(output(1))
        await asyncio.to_thread(sink.close)
        assert sink.failed == 0
        assert "p%3As" not in sink.name

    try:
        asyncio.run(run("train:p%3As@"))
        for login in ("", "train:wrong@"):
            with pytest.raises(OutputError, match="has refused the connection"):
                asyncio.run(run(login))
    finally:
        process.terminate()
        process.wait(10)


def test_mqtt_without_a_broker() -> None:
    pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")
    with pytest.raises(OutputError, match="the connection cannot be opened"):
        asyncio.run(open_sink(f"json@mqtt://127.0.0.1:{free_port()}/x"))


def test_a_session_that_does_not_begin_leaves_no_file(tmp_path: Path) -> None:
    words = ["live", "--front", f"tcp://127.0.0.1:{free_port()}", "--track", str(demo_files()["track"])]
    done = RUNNER.invoke(app, [*words, "--send", f"json@{tmp_path / 'messages'}"])
    assert "the connection cannot be opened" in " ".join(done.output.split())
    assert not list(tmp_path.iterdir())
    (kept := tmp_path / "kept").write_text("messages of yesterday")
    for more in ((), ("--metrics", "127.0.0.1:99999")):
        done = RUNNER.invoke(app, [*words, "--send", f"json@{kept}", "--overwrite", *more])
        assert done.exit_code
        assert kept.read_text() == "messages of yesterday"
    for result, left in ((None, "messages of yesterday"), (object(), '{"version":1,')):  # without and with an epoch
        sink = asyncio.run(open_sink(f"json@{kept}", overwrite="replace"))
        sink.send(output(1))
        sink.send(replace(output(2), result=result))  # type: ignore[arg-type]
        sink.close()
        assert kept.read_text().startswith(left)
    assert kept.read_text().count('"sequence":') == 2


def test_a_reference_out_of_reach_is_an_error(tmp_path: Path) -> None:
    words = ["live", "--front", str(demo_files()["front"]), "--track", str(demo_files()["track"])]
    done = RUNNER.invoke(app, [*words, "--send", "etcs@-", "--live", "reference_m=400000"])
    assert done.exit_code == 4
    assert "choose one nearer" in " ".join(done.output.split())
    with pytest.raises(SettingsError, match="FORM@TARGET"):
        asyncio.run(open_sink(f"packet0@{tmp_path}/x"))


@pytest.mark.requirement("A8")
def test_a_sink_that_cannot_be_written_ends_alone_until_none_is_left() -> None:
    class Target:
        dropped = failed = 0

        def __init__(self, name: str, most: int) -> None:
            self.name, self.most, self.taken = name, most, 0

        def send(self, _: LiveOutput) -> None:
            if self.taken == self.most:
                raise OutputError(f"{self.name}: cannot be written (No space left on device)")
            self.taken += 1

        def close(self) -> None:
            """Nothing is held."""

    small, large = Target("small", 1), Target("large", 3)
    session = _Session(engine=None, sinks=[small, large], metrics=Metrics(), hooks=Hooks())  # type: ignore[arg-type]
    for _ in range(3):
        for sink in (small, large):
            if sink.name not in session.ended:
                session.send(sink, output(1))
    assert (small.taken, large.taken) == (1, 3)
    assert [str(error) for error in session.ended.values()] == ["small: cannot be written (No space left on device)"]
    with pytest.raises(OutputError, match="large: cannot be written"):
        session.send(large, output(1))


@pytest.mark.slow
@pytest.mark.requirement("A8")
def test_an_output_on_a_full_disk_ends_alone(tmp_path: Path) -> None:
    """The other output has every message; the exit code is that of outputs."""
    files = demo_files()
    part = tmp_path / "front.rnx"
    railfix.write_observations(railfix.read_observations(files["front"])[:150], part)
    words = ["live", "--front", str(part), "--track", str(files["track"]), "--nav", str(files["nav"]), "--overwrite"]
    words += ["--set", "filter=off", "--live", "no_input=skip"]
    good = tmp_path / "good"
    done = RUNNER.invoke(app, [*words, "--send", "json@/dev/full", "--send", f"json@{good}"])
    assert done.exit_code == 8, done.output
    assert len(good.read_text().splitlines()) == 150
    said = " ".join(done.output.split())
    assert "/dev/full: cannot be written (No space left on device); this output has ended, but the others" in said
    alone = RUNNER.invoke(app, [*words, "--send", "json@/dev/full"])
    assert alone.exit_code == 8


@pytest.mark.parametrize(("terminal", "status"), [*product((True, False), repeat=2)])
def test_a_status_line_is_drawn_on_a_terminal_alone_and_removed(
    monkeypatch: pytest.MonkeyPatch, terminal: bool, status: bool
) -> None:
    screen = StringIO()
    monkeypatch.setattr(screen, "isatty", lambda: terminal)
    monkeypatch.setattr("sys.stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    log = SessionLog(None, LiveSettings(), status=status)
    for write, words in ((log.show, "at 1 m"), (log.say, "a note"), (log.show, "at 2 m")):
        write(words)
    log.close()
    text, drawn = screen.getvalue(), terminal and status
    assert ("at 1 m" in text, "at 2 m" in text, "railfix live: a note\n" in text) == (drawn, drawn, True)
    assert text.endswith("\x1b[1A\x1b[2K" if drawn else "a note\n"), "the line above the cursor is erased"


def test_the_log_rotates(tmp_path: Path) -> None:
    log = SessionLog(tmp_path / "log", LiveSettings(log_bytes=1000, log_files=2))
    for k in range(100):
        log.say(f"sentence number {k}")
    log.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["log", "log.1", "log.2"]
    assert all(path.stat().st_size <= 1000 for path in tmp_path.iterdir())
    assert "sentence number 99" in (tmp_path / "log").read_text()
    logger = logging.getLogger("railfix.live")
    assert not [handler for handler in logger.handlers if type(handler).__module__.startswith("railfix")]
    assert logger.propagate
    with pytest.raises(OutputError, match="cannot be opened as a log file"):
        SessionLog(tmp_path / "nowhere" / "log", LiveSettings())


def program(*words: str) -> list[str]:
    return [sys.executable, "-m", "railfix", "live", *words]


@pytest.mark.slow
def test_hangup_metrics_and_the_end_by_a_signal(tmp_path: Path) -> None:
    """SIGHUP reloads nothing and says so, in the log and in the metrics; SIGTERM ends with the state written."""
    log = tmp_path / "log.ubx"
    log.write_bytes(log_of(railfix.read_observations(demo_files()["front"])[:400]))
    files, port = demo_files(), free_port()
    words = ["--front", str(log), "--track", str(files["track"]), "--nav", str(files["nav"]), "--speed", "1"]
    words += ["--send", f"json@{tmp_path / 'messages'}", "--log", str(tmp_path / "log"), "--state", str(tmp_path / "s")]
    process = subprocess.Popen(
        program(*words, "--metrics", f"127.0.0.1:{port}"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        until = time.monotonic() + 60
        while time.monotonic() < until and not (tmp_path / "messages").exists():
            time.sleep(0.1)
        while time.monotonic() < until and (tmp_path / "messages").read_text().count("\n") < 10:
            time.sleep(0.1)
        process.send_signal(signal.SIGHUP)
        text = ""
        while time.monotonic() < until and "railfix_hangups_total 1" not in text:
            text = asked(port)
        assert "railfix_hangups_total 1" in text
        assert "railfix_between_messages_seconds" in text
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=30)
    finally:
        process.kill()
    assert process.returncode == 143, said
    assert "SIGHUP: nothing is reloaded" in (tmp_path / "log").read_text()
    assert "messages" in said
    assert (tmp_path / "s").stat().st_size > 1000


def asked(port: int) -> str:
    with socket.create_connection(("127.0.0.1", port), timeout=5) as connection:
        connection.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
        data = b""
        while part := connection.recv(65_536):
            data += part
    return data.decode()


@pytest.mark.slow
def test_a_status_line_on_a_terminal_alone(tmp_path: Path) -> None:
    """On a terminal the status is renewed in place; into a file not a word of it goes."""
    log = tmp_path / "log.ubx"
    log.write_bytes(log_of(railfix.read_observations(demo_files()["front"])[:20]))
    files = demo_files()
    words = ["--front", str(log), "--track", str(files["track"]), "--nav", str(files["nav"]), "--speed", "10"]
    words += ["--send", f"json@{tmp_path / 'messages'}", "--overwrite"]
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "150"}
    process = subprocess.Popen(program(*words), stdout=subprocess.DEVNULL, stderr=theirs, env=environment)
    os.close(theirs)
    seen = b""
    while True:
        try:
            part = os.read(ours, 4096)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        seen += part
    os.close(ours)
    assert process.wait(60) == 0
    text = seen.decode(errors="replace")
    assert "GPST" in text
    assert "satellites" in text
    plain = RUNNER.invoke(app, ["live", *words])
    assert plain.exit_code == 0, plain.output
    assert "satellites" not in plain.stderr
    assert "messages" in plain.stderr
