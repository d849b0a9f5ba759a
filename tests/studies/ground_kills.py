"""What is killed again and again while trains report: ``python tests/studies/ground_kills.py [KILLS] [--of trains]``.

Four trains run over links on a line of twelve stations, a report a second each. SIGKILL ends the `centre`, the server
of its `database` (PostgreSQL, which Debian installs in /usr/lib/postgresql; psycopg from the package index), or what
the `trains` have on board (``railfix ground train``), one to all four at once, at a random instant; it is started
again. After each kill the database has every report that an authority has answered, the number of every authority and
its end, and no two trains hold track in common. Printed: what was lost, and times.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import multiprocessing
import os
import random
import socket
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from itertools import combinations
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from pathlib import Path

import numpy as np

from ground_load import BEARERS_OF, centre_file
from postgresql_server import Server
from railfix.__main__ import main as main_of_railfix
from railfix.ground.authority import Authority
from railfix.ground.layout import overlap
from railfix.ground.links import TrainLinks
from railfix.ground.on_board import OnBoard
from railfix.ground.serve import run_centre
from railfix.ground.state import HEAD, Interlocking, from_documents
from railfix.ground.store import Store
from railfix.ground.traffic import SimulatedTrain, line_with_loops
from railfix.io.train_message import encode, to_json

#: Station and direction of each train at the start.
PLACES = ((0, 1), (2, 1), (11, -1), (9, -1))
LINE = line_with_loops(12)


def serve(path: Path, ready: Connection) -> None:
    """Run a centre until it is killed."""
    asyncio.run(run_centre(path, password="secret", announce=ready.send))


def carry(words: list[str], there: Connection) -> None:
    """Run ``railfix`` with a connection as its standard input and output, until it is killed."""
    for number in (0, 1):
        os.dup2(there.fileno(), number)
    sys.stdin, sys.stdout = open(0), open(1, "w")  # noqa: SIM115
    sys.argv[1:] = words
    main_of_railfix()


class TrainProgram:
    """``railfix ground train`` as a process, which a simulated train gives its positions and obeys."""

    def __init__(self, train: SimulatedTrain, folder: Path, context: ForkServerContext) -> None:
        self.train, self._folder, self._context = train, folder, context
        self._process: multiprocessing.process.BaseProcess | None = None
        self._reader: asyncio.StreamReader | None = None
        self._writer: asyncio.StreamWriter | None = None

    async def start(self) -> None:
        """Start it; the train has no authority before the program says so."""
        self.train.on_board = OnBoard(direction=self.train.direction, end_m=self.train.front_m)
        addresses = [word for bearer in BEARERS_OF.values() for word in ("--centre", "{}:{}".format(*bearer.centre))]
        local = [word for bearer in BEARERS_OF.values() for word in ("--local", bearer.local)]
        words = ["ground", "train", str(self.train.number), "--keys", str(self._folder / "keys"), *addresses, *local]
        here, there = self._context.Pipe()
        self._process = self._context.Process(target=carry, args=(words, there), daemon=True)
        self._process.start()
        there.close()
        mine = socket.socket(fileno=os.dup(here.fileno()))
        here.close()
        self._reader, self._writer = await asyncio.open_connection(sock=mine)

    async def kill(self) -> None:
        """End it by SIGKILL; the train has no authority any more."""
        assert self._process is not None
        assert self._writer is not None
        self._process.kill()
        await asyncio.to_thread(self._process.join)
        self._writer.close()
        self.train.on_board = OnBoard(direction=self.train.direction, end_m=self.train.front_m)

    def report(self) -> None:
        """Give it a position; a program that has just been killed takes none."""
        if self._writer is not None and not self._writer.is_closing():
            self._writer.write(to_json(self.train.message(time.monotonic())).encode() + b"\n")

    async def listen(self, received: Callable[[int, Authority], None]) -> None:
        """Obey what it writes, and what the one says that is started after it."""
        while True:
            reader = self._reader
            assert reader is not None
            while line := await self._line(reader):
                said = json.loads(line)
                age_s = said.pop("age_s", None)
                if age_s is not None and reader is self._reader:
                    own = {name: said[name] for name in Authority.model_fields}
                    authority = Authority.model_validate(own | {"session": 0})  # its program draws a number
                    assert self.train.on_board.receive(authority)
                    self.train.on_board.answered_s = time.monotonic() - age_s
                    received(self.train.number, authority)
            while reader is self._reader:
                await asyncio.sleep(0.05)

    @staticmethod
    async def _line(reader: asyncio.StreamReader) -> bytes:
        """The next whole line; nothing where the program has ended, in a line or not."""
        try:
            line = await reader.readline()
        except ConnectionError:
            return b""
        return line if line.endswith(b"\n") else b""


class KilledCentre:
    """Centre, its trains, and what went wrong."""

    def __init__(self, folder: Path, of: str) -> None:
        self.of = of
        self.server = Server(folder) if of == "database" else None
        self.programs = dict[int, TrainProgram]()
        self.folder, self.trains = folder, dict[int, SimulatedTrain]()
        for number, (station, direction) in enumerate(PLACES, start=1):
            inner = LINE.stations[station].inner_m
            front = inner[1] - 100.0 if direction > 0 else inner[0] + 100.0
            self.trains[number] = SimulatedTrain(
                number=number, front_m=front, tracks={station: 1 if direction > 0 else 2},
                on_board=OnBoard(direction=direction, end_m=front),
            )  # fmt: skip
        self.address = f"sqlite:///{folder / 'centre.db'}" if self.server is None else Server.ADDRESS
        self.path = centre_file(folder, LINE, self.trains)
        if self.server is not None:
            self.path.write_text(f'database = "{self.address}"\n' + self.path.read_text())
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["railfix.cli", "railfix.ground.serve", "railfix.ground.traffic"])
        self._context = context
        if of == "trains":
            self.programs = {n: TrainProgram(train, folder, context) for n, train in self.trains.items()}
        self.newest: dict[int, Authority] = {}
        self.lost: Counter[str] = Counter(
            dict.fromkeys(("reports", "authorities", "ends", "track in common", "order"), 0)
        )
        self.counted: Counter[str] = Counter()
        self.without_s: list[float] = []
        self.until_authorities_s: list[float] = []
        self.process: multiprocessing.process.BaseProcess | None = None

    async def start(self) -> None:
        """Start a centre, until it can be connected to."""
        here, there = self._context.Pipe()
        self.process = self._context.Process(target=serve, args=(self.path, there), daemon=True)
        self.process.start()
        there.close()
        await asyncio.to_thread(here.recv)

    def received(self, number: int, payload: bytes) -> None:
        """Take an authority on board."""
        authority = Authority.decode(payload)
        if self.trains[number].on_board.receive(authority):
            self.taken(number, authority)

    def taken(self, number: int, authority: Authority) -> None:
        """Note an authority that a train has taken; none is older than the one before."""
        self.lost["order"] += number in self.newest and authority.number <= self.newest[number].number
        self.newest[number] = authority
        self.counted["authorities"] += 1

    async def run_program(self, number: int) -> None:
        """Give a train's program a position once a second."""
        program = self.programs[number]
        await program.start()
        listening = asyncio.create_task(program.listen(self.taken))
        try:
            while True:
                program.train.step(time.monotonic())
                program.report()
                self.counted["reports"] += 1
                await asyncio.wait([listening], timeout=1.0)
                if listening.done():
                    listening.result()
        finally:
            listening.cancel()
            await program.kill()

    async def run_train(self, number: int) -> None:
        """Report once a second."""
        if self.programs:
            await self.run_program(number)
        train = self.trains[number]
        link = TrainLinks(
            number, self.folder / "keys", BEARERS_OF, received=lambda payload: self.received(number, payload)
        )
        await link.start()
        try:
            while True:
                train.step(time.monotonic())
                link.send(encode(train.message(time.monotonic())))
                self.counted["reports"] += 1
                await asyncio.sleep(1.0)
        finally:
            await link.stop()

    def check(self) -> None:
        """Compare the database of a centre that has ended with what its trains know."""
        with Store(self.address) as store:
            records, state = store.records(), from_documents(store.documents(HEAD))
        for number, authority in self.newest.items():
            known = state.trains[number]
            self.lost["reports"] += records[number].sequence < authority.report
            self.lost["authorities"] += state.granted < authority.number
            self.lost["ends"] += known.direction * (authority.end_cm / 100.0 - known.end_m) > 0.0
        self.check_apart(state)

    def check_apart(self, state: Interlocking) -> None:
        """Count pairs of trains that are on, or may run over, the same track."""
        held = {}
        for number, train in self.trains.items():
            ends = (train.rear_m, train.front_m, train.on_board.end_m)
            held[number] = LINE.pieces(min(ends), max(ends), state.trains[number].tracks)
        for one, other in combinations(held.values(), 2):
            self.lost["track in common"] += overlap(one, other)

    async def kill(self, rng: random.Random) -> int:
        """Kill, compare the database with what trains know, and start again; return how many were killed."""
        if self.server is not None:
            self.server.kill()
            await asyncio.to_thread(self.server.start)
            self.check()
        elif self.programs:
            programs = rng.sample(list(self.programs.values()), rng.randint(1, len(self.programs)))
            for program in programs:
                await program.kill()
            self.check()
            for program in programs:
                await program.start()
            return len(programs)
        else:
            assert self.process is not None
            self.process.kill()
            self.process.join()
            self.check()
            await self.start()
        return 1

    async def run(self, kills: int, seconds: float) -> None:
        """Kill and start again, so often or for so long."""
        rng, killed, end = random.Random(1), 0.0, time.monotonic() + seconds
        await self.start()
        running = [asyncio.create_task(self.run_train(number)) for number in self.trains]
        while self.counted["kills"] < kills and time.monotonic() < end:
            before = dict(self.newest)
            while any(self.newest.get(number) is before.get(number) for number in self.trains):
                for task in running:
                    if task.done():
                        task.result()
                await asyncio.sleep(0.02)
            if self.counted["kills"]:
                self.until_authorities_s.append(time.monotonic() - killed)
            await asyncio.sleep(rng.uniform(0.0, 1.0))
            killed = time.monotonic()
            self.counted["kills"] += await self.kill(rng)
            self.without_s.append(time.monotonic() - killed)
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        assert self.process is not None
        self.process.kill()
        if self.server is not None:
            self.server.kill()


def main() -> None:
    """Print what was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kills", type=int, nargs="?", default=200)
    parser.add_argument("--of", choices=("centre", "database", "trains"), default="centre", help="what is killed")
    parser.add_argument("--seconds", type=float, default=3600.0, help="end after this time, however few kills")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        centre = KilledCentre(Path(name), given.of)
        begun = {number: train.front_m for number, train in centre.trains.items()}
        asyncio.run(centre.run(given.kills, given.seconds))
    way_m = sum(abs(train.front_m - begun[number]) for number, train in centre.trains.items())
    print(f"{centre.counted['kills']} kills, {centre.counted['reports']} reports, "
          f"{centre.counted['authorities']} authorities; the trains ran {way_m / 1000.0:.1f} km")  # fmt: skip
    print("lost: " + ", ".join(f"{name} {count}" for name, count in centre.lost.items()))
    for name, times in (
        ("until it runs again", centre.without_s),
        ("until all trains have a new authority", centre.until_authorities_s),
    ):
        print("{}: median {:.2f} s, longest {:.2f} s".format(name, *np.percentile(times, [50, 100])))
    raise SystemExit(int(any(centre.lost.values())))


if __name__ == "__main__":
    main()
