"""Positions of a train from lines: garbage between them, recordings, and the documented pipe from receiver logs."""

from __future__ import annotations

import asyncio
import io
import json
import os
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path

import pytest

from railfix.ground.centre import CentreLimits, Rejection, TrainRecord, report_received
from railfix.ground.positions import LONGEST_LINE, gps_now_ns, read_positions, standard_input
from railfix.io.train_message import MessageStatus, TrainMessage, Unknown, to_json
from railfix.simulate.demonstration import demo_files

pytestmark = pytest.mark.requirement("F2")

ROOT = Path(__file__).parents[2]
PLACED = TrainMessage(
    train=1, sequence=1, time_ns=1_393_643_430_000_000_000, sent_ns=1_393_643_430_100_000_000, line=0, chainage_cm=3500,
    over_cm=300, under_cm=300, facing=1, direction=0, standstill=True, status=MessageStatus.POSITION, length_cm=4000,
)  # fmt: skip


def read(lines: list[str], **options: str) -> tuple[list[TrainMessage], list[str], list[float]]:
    """Messages, rejections, and when each message came."""
    rejected: list[str] = []
    times: list[float] = []

    async def source() -> AsyncIterator[str]:
        for line in lines:
            yield line

    async def work() -> list[TrainMessage]:
        found = []
        async for message in read_positions(source(), rejected=rejected.append, **options):  # type: ignore[arg-type]
            found.append(message)
            times.append(time.monotonic())
        return found

    return asyncio.run(work()), rejected, times


def test_a_line_that_is_no_message_is_rejected_and_the_next_one_counts() -> None:
    later = PLACED.replaced(sequence=2)
    messages, rejected, _ = read([to_json(PLACED), "garbage", "", '{"version": 1}', "\x00" * 40, to_json(later)])
    assert messages == [PLACED, later]
    assert rejected[0] == "line 2: position message: is not JSON"
    assert [why.split(":")[0] for why in rejected] == ["line 2", "line 4", "line 5"]


def test_a_recording_is_reported_at_its_own_pace_and_as_of_now() -> None:
    """Three places 0.2 s apart, recorded in 2024; the second one was sent late, which delays nothing."""
    step = 200_000_000
    recorded = [
        PLACED.replaced(sequence=k, time_ns=PLACED.time_ns + k * step, sent_ns=PLACED.sent_ns + k * step + late)
        for k, late in enumerate((0, 10**12, 0))
    ]
    begin = gps_now_ns()
    messages, rejected, times = read(list(map(to_json, recorded)), clock="replay")
    assert not rejected
    assert [m.time_ns - messages[0].time_ns for m in messages] == [0, step, 2 * step]
    assert 0 <= messages[0].time_ns - begin < 10**9
    assert all(0 <= m.sent_ns - m.time_ns < 10**9 for m in messages)
    assert times[2] - times[0] >= 0.39
    live, _, _ = read(list(map(to_json, recorded)))
    assert live == recorded


def test_a_line_without_an_end_is_cut_and_the_next_one_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = socket.socketpair()
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(ours.makefile("rb", buffering=0)))  # type: ignore[arg-type]
    ours.close()  # the file has it

    def send() -> None:
        theirs.sendall(b"first\n" + b"x" * (3 * LONGEST_LINE) + b"xxx\nlast\nunended")
        theirs.close()

    async def work() -> list[str]:
        return [line async for line in standard_input()]

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    lines = asyncio.run(asyncio.wait_for(work(), 20.0))
    assert [len(line) for line in lines] == [5, LONGEST_LINE, 4, 7]
    assert (lines[0], lines[2:]) == ("first", ["last", "unended"])


def test_what_the_centre_cannot_know_is_a_reason_of_its_own() -> None:
    for values, reason in (
        ({}, None),
        ({"facing": 0}, Rejection.NO_FACING),
        ({"unknown": Unknown.FRONT_END}, Rejection.NO_FRONT_END),
        ({"unknown": Unknown.LENGTH}, None),  # the interlocking says so, and stops the train
        ({"status": MessageStatus.DOUBTFUL}, Rejection.NO_PLACE),
    ):
        message = PLACED.replaced(**values)
        assert report_received(TrainRecord(train=1), message, 0.0, limits=CentreLimits())[1] is reason


class OwnProcess:
    """A command of the shell in a process group of its own, whose lines are waited for no longer than a time."""

    def __init__(self, words: str, folder: Path) -> None:
        self._errors = folder / f"errors {id(self)}.txt"  # a pipe that nobody reads would hold the process up
        with self._errors.open("w") as errors:
            self.process = subprocess.Popen(
                ["bash", "-c", words], cwd=folder, stdout=subprocess.PIPE, stderr=errors, text=True,
                start_new_session=True,
            )  # fmt: skip
        self._lines: queue.Queue[str] = queue.Queue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as stdout:
            for line in stdout:
                self._lines.put(line)
        self._lines.put("")

    def line(self, seconds: float) -> str:
        """Return the next line; fail with what the command wrote of errors where none comes in time."""
        with suppress(queue.Empty):
            if line := self._lines.get(timeout=max(seconds, 0.01)):
                return line
        pytest.fail(f"no line within {seconds:.0f} s: {self._errors.read_text()[-2000:]}")

    def end(self, sent: signal.Signals) -> str:
        """End the group by a signal, and by force where that takes longer than a minute; return the other lines."""
        for number in (sent, signal.SIGKILL):
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, number)
            with suppress(subprocess.TimeoutExpired):
                self.process.wait(60.0)
                break
        self._reader.join(10.0)
        return "".join(iter(lambda: self._lines.get(timeout=1.0), ""))


@pytest.mark.slow
def test_the_documented_pipe_takes_a_recorded_run_to_the_centre(tmp_path: Path) -> None:
    """The three commands of docs/ground.md, with the demonstration's logs: its train stands in the first station."""
    text = (ROOT / "docs" / "ground.md").read_text()
    keys, centre, pipe = (line.strip() for line in re.findall(r"^    (railfix .*)$", text, re.MULTILINE)[:3])
    assert keys.startswith("railfix ground keys")
    assert centre.startswith("railfix ground centre line.toml")
    assert "railfix live ... --send json@- | railfix ground train 1" in pipe
    ports = []
    for host in ("127.0.1.1", "127.0.2.1"):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind((host, 0))
            ports.append(f"{host}:{probe.getsockname()[1]}")
    (tmp_path / "line.toml").write_text(f"""
keys = "keys"
listen = {{ A = "{ports[0]}", B = "{ports[1]}" }}
stations = [{{ name = "West", begin_m = -400, end_m = 300 }}, {{ name = "East", begin_m = 600, end_m = 1100 }}]
trains = [{{ number = 1, station = "West", track = 1, direction = 1, front_m = 32, length_m = 23.2 }}]
""")
    (tmp_path / "secret.txt").write_text("a password for the test")
    (tmp_path / "secret.txt").chmod(0o600)
    files = demo_files()
    log = " ".join(f"--{name} {files[name]}" for name in ("front", "rear", "track", "vehicle", "nav"))
    pipe = pipe.replace("live ...", f"live {log}").replace("10.0.1.1:4433", ports[0]).replace("10.0.2.1:4433", ports[1])
    command = f"{sys.executable} -m railfix "

    def run(words: str) -> OwnProcess:
        return OwnProcess(words.replace("railfix ", command), tmp_path)

    made = run(keys.replace(" --train 2", ""))
    assert made.process.wait(240.0) == 0
    made.end(signal.SIGTERM)
    running, train = run(centre + " --page 127.0.0.1:0"), None
    try:
        assert "page" in running.line(240.0)
        train = run(f"{pipe} --replay")
        ends: dict[int, int] = {}  # of authorities, by the report that the centre has stored
        until = time.monotonic() + 400.0  # the kernels may have to be compiled
        while len(ends.keys() - {0}) < 8:
            line = json.loads(train.line(until - time.monotonic()))
            assert "rejected" not in line
            ends |= {line["report"]: line["end_cm"]} if "end_cm" in line else {}
        assert max(ends.values()) > 30_000  # into the next station
    finally:
        if train is not None:
            train.end(signal.SIGKILL)
        output = running.end(signal.SIGTERM)
    used = re.search(r"reports used\W+(\d+)", output)
    rejected = re.search(r"reports rejected\W+(.+?)\s*│", output)
    # the filter has no place with a bound in the first seconds
    without = re.fullmatch(r"none|without a position (\d+)", rejected.group(1))
    assert int(used.group(1)) >= 8 - int(without.group(1) or 0) >= 4
