"""Load of a centre by its trains: ``python tests/studies/ground_load.py [TRAINS ...] [--seconds 20]``.

Two trains a station, each of which asks for a route whenever it reports. ``logic``: the centre alone takes a second's
reports in its steps: supervision, commit to SQLite, authorities. ``links``: ``railfix ground centre`` as a process on
one core, each train with its own addresses, two QUIC links and a report a second, at instants spread over the second;
all trains share a process on the other core. `AT_ONCE` trains connect at a time, and each reports from then on.
Printed: time until all links are there, processor time a second of the centre and of all trains, time from a report to
the authority that answers it, and the reports that none answered.
"""

from __future__ import annotations

import argparse
import asyncio
import gc
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

import paths  # noqa: F401
from railfix.ground.authority import Authority
from railfix.ground.control import ControlCentre
from railfix.ground.keys import write_keys
from railfix.ground.layout import Layout
from railfix.ground.links import Bearer, LinkName, TrainLinks, create_bearers
from railfix.ground.on_board import OnBoard
from railfix.ground.serve import COLLECTION, STEP_S
from railfix.ground.store import Store
from railfix.ground.supervision import Supervision, at_start
from railfix.ground.traffic import SimulatedTrain, line_with_loops
from railfix.io.train_message import encode

CENTRE: dict[LinkName, tuple[str, int]] = {"A": ("127.0.1.1", 4433), "B": ("127.0.2.1", 4433)}
#: Trains that connect at a time: more, and the process of all trains is too slow for its own handshakes.
AT_ONCE = 32


def bearers_of(train: int) -> dict[LinkName, Bearer]:
    """Return the bearers of a train, from addresses of its own."""
    own = f"{train // 250}.{train % 250 + 1}"
    return create_bearers(CENTRE, {"A": f"127.1.{own}", "B": f"127.2.{own}"})


def line(trains: int) -> tuple[Layout, dict[int, SimulatedTrain]]:
    """A line and its trains at rest, two a station, one each way."""
    layout, found = line_with_loops(max(trains // 2, 2)), {}
    for k in range(trains):
        direction = 1 - 2 * (k % 2)
        inner = layout.stations[k // 2].inner_m
        front = inner[1] - 30.0 if direction > 0 else inner[0] + 30.0
        found[k + 1] = SimulatedTrain(
            number=k + 1, front_m=front, tracks={k // 2: 1 + k % 2},
            on_board=OnBoard(direction=direction, end_m=front),
        )  # fmt: skip
    return layout, found


def logic(number: int, seconds: int) -> None:
    """Print the times of the centre without links."""
    layout, trains = line(number)
    now, steps, steps_a_second = [0.0], [], round(1.0 / STEP_S)
    sent: list[tuple[int, bytes]] = []
    supervision = Supervision(layout=layout, state=at_start(layout, [train.at_rest() for train in trains.values()]))

    with tempfile.TemporaryDirectory() as folder, Store(f"sqlite:///{folder}/centre.db") as store:
        centre = ControlCentre(
            supervision=supervision, store=store, curves={}, send=lambda *message: sent.append(message),
            clock=lambda: now[0], wall_ns=lambda: 0,
        )  # fmt: skip
        spent, used = 0.0, 0
        for step in range(round(seconds / STEP_S)):
            now[0] = step * STEP_S
            due = [train for k, train in enumerate(trains.values()) if k % steps_a_second == step % steps_a_second]
            for train in due:
                train.step(now[0])
            reports = [(train.number, encode(train.message(now[0]))) for train in due]
            begin, processor = time.perf_counter(), time.process_time()
            for train_number, payload in reports:
                centre.report(train_number, payload)
            centre.step()
            spent += time.process_time() - processor
            steps.append(time.perf_counter() - begin)
            used += sum(trains[train].on_board.receive(Authority.decode(payload)) for train, payload in sent)
            sent.clear()
    print(
        f"{number:6d}  logic {spent / seconds:7.3f} s/s   steps median {1e3 * np.median(steps):5.1f}"
        f"  p99 {1e3 * np.percentile(steps, 99):6.1f} ms   {centre.reports} reports, {used} authorities",
        flush=True,
    )


def centre_file(folder: Path, layout: Layout, trains: dict[int, SimulatedTrain]) -> Path:
    """Write the file of a centre, its keys and its password."""
    write_keys(folder / "keys", sorted(trains))
    stations = ",\n".join(
        f'{{ name = "{k}", begin_m = {s.begin_m}, end_m = {s.end_m} }}' for k, s in enumerate(layout.stations)
    )
    places = ",\n".join(
        f'{{ number = {t.number}, station = "{station}", track = {track}, direction = {t.direction},'
        f" front_m = {t.front_m}, length_m = {t.length_m}, bound_m = {t.bound_m} }}"
        for t in trains.values()
        for station, track in t.tracks.items()
    )
    path = folder / "line.toml"
    listen = ", ".join(f'{name} = "{host}:{port}"' for name, (host, port) in CENTRE.items())
    path.write_text(f'keys = "keys"\nlisten = {{ {listen} }}\nstations = [{stations}]\ntrains = [{places}]\n')
    (folder / "password").write_text("secret\n")
    (folder / "password").chmod(0o600)
    return path


async def drive(
    folder: Path, trains: dict[int, SimulatedTrain], seconds: int, processor: Callable[[], float]
) -> tuple[list[float], int, float]:
    """Return times from report to authority [s], the number of reports, and the processor time of a second.

    Counting begins 10 s after all trains are connected.
    """
    times: list[float] = []
    reported: dict[tuple[int, int], float] = {}
    begin, counted, connected = float("inf"), 0, 0
    places = asyncio.Semaphore(AT_ONCE)

    def received(number: int, payload: bytes) -> None:
        authority, now = Authority.decode(payload), time.perf_counter()
        trains[number].on_board.receive(authority)
        if (sent := reported.pop((number, authority.report), float("-inf"))) > begin:
            times.append(now - sent)

    async def run(number: int) -> None:
        nonlocal connected, counted
        bearers = bearers_of(number)
        link = TrainLinks(number, folder / "keys", bearers, received=partial(received, number))
        async with places:
            await link.start()
            while len(link.protocols) < len(bearers):
                await asyncio.sleep(0.1)
        connected += 1
        due = np.ceil(time.perf_counter()) + number / len(trains)
        while due < begin + seconds:
            await asyncio.sleep(max(0.0, due - time.perf_counter()))
            now = time.perf_counter()
            trains[number].step(now)
            message = trains[number].message(now)
            reported[number, message.sequence] = now
            counted += now > begin
            link.send(encode(message))
            due += 1.0
        await asyncio.sleep(2.0)
        await link.stop()

    started = time.perf_counter()
    running = [asyncio.create_task(run(number)) for number in trains]
    spent = processor()
    while connected < len(trains):
        await asyncio.sleep(0.1)
    print(
        f"{len(trains):6d}  connected after {time.perf_counter() - started:.1f} s, {processor() - spent:.1f} s of the"
        f" centre's processor, {time.process_time():.1f} s of the trains'",
        flush=True,
    )
    await asyncio.sleep(10.0)
    begin, spent, own = time.perf_counter(), processor(), time.process_time()
    await asyncio.sleep(seconds)
    spent = (processor() - spent) / (time.perf_counter() - begin)
    own = (time.process_time() - own) / (time.perf_counter() - begin)
    print(f"{len(trains):6d}  trains {own:6.3f} s/s", flush=True)
    await asyncio.gather(*running)
    return times, counted, spent


def linked(number: int, seconds: int) -> None:
    """Print the times of the centre as a process, over links."""
    layout, trains = line(number)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = centre_file(folder, layout, trains)
        words = [sys.executable, "-m", "railfix", "ground", "centre", str(path), "--page", "127.0.0.1:0"]
        process = subprocess.Popen(
            ["taskset", "-c", "0", *words, "--password", str(folder / "password")], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        assert "http" in process.stdout.readline()
        os.sched_setaffinity(0, {1})
        try:
            times, reports, share = asyncio.run(drive(folder, trains, seconds, partial(processor_s, process.pid)))
        finally:
            process.terminate()
            process.wait()
    shown = np.percentile(times, [50, 99, 100]) if times else [np.nan] * 3
    print(
        f"{number:6d}  links {share:7.3f} s/s   report to authority median {1e3 * shown[0]:5.0f}"
        f"  p99 {1e3 * shown[1]:6.0f}  largest {1e3 * shown[2]:6.0f} ms"
        f"   {reports} reports, {reports - len(times)} unanswered",
        flush=True,
    )


def processor_s(process: int) -> float:
    """Processor time of a process so far [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Print a line a number of trains."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("trains", type=int, nargs="*", default=[100, 200, 500, 1000])
    parser.add_argument("--seconds", type=int, default=20)
    given = parser.parse_args()
    gc.set_threshold(*COLLECTION)
    for number in given.trains:
        logic(number, given.seconds)
    for number in given.trains:
        linked(number, given.seconds)


if __name__ == "__main__":
    main()
