"""The end of a live session by a signal, whatever its channels, its broker and its data do."""

from __future__ import annotations

import asyncio
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import railfix
from railfix.live.sinks import MqttTarget
from railfix.live.stream import next_arrival
from railfix.simulate.demonstration import demo_files
from test_live_sinks import broker as broker
from test_live_sinks import log_of, output, program

pytestmark = pytest.mark.requirement("A8")


@pytest.fixture
def deaf_broker() -> Iterator[int]:
    """Port of a broker that takes connections and reads nothing afterwards."""
    held: list[socket.socket] = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer() -> None:
            connection, _ = server.accept()
            connection.recv(1000)
            connection.sendall(b"\x20\x02\x00\x00")
            held.append(connection)

        threading.Thread(target=answer, daemon=True).start()
        yield server.getsockname()[1]
    for connection in held:
        connection.close()


def test_a_broker_that_reads_no_more_does_not_hold_the_end_up(deaf_broker: int) -> None:
    pytest.importorskip("paho.mqtt.client", reason="paho-mqtt is not installed")
    target = MqttTarget(lambda _: b"x" * 1_000_000, f"mqtt://127.0.0.1:{deaf_broker}/x", waiting=50)
    for k in range(30):
        target.send(output(k))
    begun = time.monotonic()
    target.close()
    assert not target._sent[-1].is_published()
    assert time.monotonic() - begun < 4.0


def test_signals_act_while_data_wait() -> None:
    async def run() -> list[int]:
        queue, acted = asyncio.Queue[int](), list[int]()
        queue.put_nowait(1)
        asyncio.get_running_loop().call_soon(acted.append, 1)  # as handlers of signals are called
        assert await next_arrival(queue, []) == 1
        return acted

    assert asyncio.run(run()) == [1]


#: A program that is ended by a signal in a callback from C, as the compiler of kernels makes them.
CALLBACK = """
import ctypes, os, signal, time, typer
from railfix.__main__ import raise_exit
from railfix.cli.command import run_program

signal.signal(signal.SIGTERM, raise_exit)
app = typer.Typer()

@ctypes.CFUNCTYPE(None)
def called():
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.1)

@app.command()
def work():
    called()
    print("lost", flush=True)
    time.sleep(30.0)

run_program(app)
"""


def test_a_second_signal_ends_the_program_when_a_callback_of_the_compiler_lost_the_first() -> None:
    """Python reports an exception in a callback from C and goes on, as with Ctrl-C: the next signal must count."""
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", CALLBACK], stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout.readline() == "lost\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 143


@pytest.mark.slow
@pytest.mark.parametrize("begun", [False, True], ids=["while it starts", "at work"])
def test_two_channels_with_a_broker_end_by_a_signal(tmp_path: Path, broker: int, begun: bool) -> None:
    log, files = tmp_path / "log.ubx", demo_files()
    log.write_bytes(log_of(railfix.read_observations(files["front"])[:400]))
    words = ["--front", str(log), "--track", str(files["track"]), "--nav", str(files["nav"]), "--speed", "1"]
    words += ["--send", f"json@{tmp_path / 'messages'}", "--send", f"json@mqtt://127.0.0.1:{broker}/x"]
    process = subprocess.Popen(program(*words, "--channels", "2"), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        until = time.monotonic() + 300
        while begun and time.monotonic() < until and not (tmp_path / "messages").exists():
            time.sleep(0.1)
        time.sleep(0.0 if begun else 10.0)  # kernels are compiled or loaded
        while begun and time.monotonic() < until and (tmp_path / "messages").read_text().count("\n") < 10:
            time.sleep(0.1)
        assert not begun or (tmp_path / "messages").exists()
        process.send_signal(signal.SIGTERM)
        sent = time.monotonic()
        process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 143
    assert time.monotonic() - sent < 20.0
