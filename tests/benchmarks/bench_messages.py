"""Times between the messages of a live session in real time, and their age, at 10 Hz with two antennas.

The logs of a run like the demonstration's, simulated for so long, go as UBX through two TCP connections at their own
pace to `railfix live` in a process of its own; the messages come back as datagrams::

    python tests/benchmarks/bench_messages.py [--seconds 600] [--filter track|off] [--channels 1|2] [--mqtt]

With --mqtt they come back over a broker (mosquitto) instead.
Prints percentiles of the time between two messages, for each quarter as well, and of their age; how many were missing,
and their statuses.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import queue
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

import railfix
from railfix.core.timescale import GPS_EPOCH
from railfix.gnss.observations import Observations
from railfix.io.train_message import MessageStatus, decode

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))
from ubx_made import rawx

PERIOD_S = 0.1
#: For the first message: kernels that are not on disk are compiled before.
LONGEST_WAIT_S = 300.0


async def served(log: Observations, began: float, until: float, ready: asyncio.Queue[int]) -> None:
    """Serve a log epoch by epoch; each one goes out when it is due."""

    async def answer(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(ConnectionError):
            late = max(0, int((time.monotonic() - began) / PERIOD_S))  # a receiver sends nothing of the past
            for k in range(late, len(log)):
                await asyncio.sleep(max(0.0, began + PERIOD_S * k - time.monotonic()))
                writer.write(rawx(log, k))
                await writer.drain()
        writer.close()

    server = await asyncio.start_server(answer, "127.0.0.1", 0)
    await ready.put(server.sockets[0].getsockname()[1])
    await asyncio.sleep(max(0.0, until - time.monotonic()) + 1.0)
    server.close()


async def both(folder: Path, began: float, until: float, ports: list[int], started: threading.Event) -> None:
    ready = asyncio.Queue[int]()
    tasks = []
    for name in ("front", "rear"):
        log = railfix.read_observations(folder / f"{name}.rnx")
        tasks.append(asyncio.create_task(served(log, began, until, ready)))
        ports.append(await ready.get())
    started.set()
    await asyncio.gather(*tasks)


def datagrams() -> tuple[str, Callable[[], bytes]]:
    """Return the target of datagrams, and a function that waits for the next."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(LONGEST_WAIT_S)
    return f"udp://127.0.0.1:{receiver.getsockname()[1]}", lambda: receiver.recv(4000)


def published(held: contextlib.ExitStack) -> tuple[str, Callable[[], bytes]]:
    """Return the target of a broker's topic, and a function that waits for its next message."""
    from paho.mqtt import client, enums

    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    program = shutil.which("mosquitto") or "/usr/sbin/mosquitto"
    broker = subprocess.Popen([program, "-p", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    held.callback(broker.terminate)
    time.sleep(2.0)
    arrived = queue.Queue[bytes]()
    reader = client.Client(enums.CallbackAPIVersion.VERSION2)
    reader.on_message = lambda _client, _data, message: arrived.put(message.payload)
    reader.on_connect = lambda *_: reader.subscribe("railfix")
    reader.connect("127.0.0.1", port)
    reader.loop_start()
    held.callback(reader.loop_stop)
    return f"mqtt://127.0.0.1:{port}/railfix", lambda: arrived.get(timeout=LONGEST_WAIT_S)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--filter", choices=("track", "off"), default="track")
    parser.add_argument("--channels", choices=("1", "2"), default="1")
    parser.add_argument("--mqtt", action="store_true", help="messages over a broker")
    options = parser.parse_args()
    with contextlib.ExitStack() as held:
        folder = Path(held.enter_context(tempfile.TemporaryDirectory())) / "run"
        words = ["simulate", "demo", "--seconds", str(options.seconds), "--out", str(folder), "--plain"]
        subprocess.run([sys.executable, "-m", "railfix", *words], check=True)
        measure(options, folder, *(published(held) if options.mqtt else datagrams()))


def measure(options: argparse.Namespace, folder: Path, target: str, receive: Callable[[], bytes]) -> None:
    """Run the session and print what arrived."""
    began = time.monotonic() + 60.0  # after the logs are read and the program has started
    until, ports, started = began + options.seconds, list[int](), threading.Event()
    threading.Thread(target=lambda: asyncio.run(both(folder, began, until, ports, started)), daemon=True).start()
    started.wait(60)
    words = [sys.executable, "-m", "railfix", "live", "--nav", str(folder / "nav.rnx")]
    words += ["--track", str(folder / "track.csv"), "--vehicle", str(folder / "vehicle.toml")]
    words += ["--front", f"tcp://127.0.0.1:{ports[0]}", "--rear", f"tcp://127.0.0.1:{ports[1]}"]
    words += ["--filter", options.filter, "--channels", options.channels]
    words += ["--send", f"cbor@{target}"]
    first_ns = (railfix.read_observations(folder / "front.rnx")[:1].time[0] - GPS_EPOCH).astype(int)
    process = subprocess.Popen(words, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    arrived, messages = [], []
    try:
        while time.monotonic() < until:
            messages.append(decode(receive()))
            arrived.append(time.monotonic())
    finally:
        process.terminate()
        ending = time.monotonic()
        process.wait(20)
    print(f"ended {time.monotonic() - ending:.1f} s after SIGTERM")
    at = np.array(arrived)
    within = (at > began + 5.0) & (at < until - 1.0)  # the first epochs fill caches
    between = np.diff(at[within]) * 1e3
    kinds = [message.status for message, used in zip(messages, within, strict=True) if used]
    silent = sum(kind is MessageStatus.NO_INPUT for kind in kinds)
    sequence = np.array([message.sequence for message, used in zip(messages, within, strict=True) if used])
    print(f"{len(between) + 1} messages in {at[within][-1] - at[within][0]:.1f} s, {silent} of them without input,")
    print(f"{int(np.sum(np.diff(sequence) - 1))} missing; filter {options.filter}, {options.channels} channel(s)")
    print(", ".join(f"{kind.name.lower()} {count}" for kind, count in Counter(kinds).most_common()))
    measured = [(t, m) for t, m in zip(arrived, messages, strict=True) if m.status is not MessageStatus.NO_INPUT]
    ages = [1e3 * (t - began) - (m.time_ns - first_ns) / 1e6 for t, m in measured if began + 5.0 < t < until - 1.0]
    shown = "  ".join(f"p{q:g} {np.percentile(ages, q):6.1f}" for q in (50, 99, 99.9, 100))
    print(f"age from the epoch on: {shown} ms")
    quantiles = (0.1, 1, 50, 99, 99.9)
    for name, part in [("all", between), *((f"quarter {k + 1}", q) for k, q in enumerate(np.array_split(between, 4)))]:
        values = "  ".join(f"p{q:g} {np.percentile(part, q):6.1f}" for q in quantiles)
        inside = np.mean(np.abs(part - PERIOD_S * 1e3) <= 10.0)
        print(f"{name:10s} {values}  max {part.max():6.1f} ms; within 100 +- 10 ms: {100 * inside:.2f} %")


if __name__ == "__main__":
    main()
