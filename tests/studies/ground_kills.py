"""A centre that is killed again and again while its trains report: ``python tests/studies/ground_kills.py [KILLS]``.

Four trains run over links on a line of twelve stations, a report a second each. The centre is a process that SIGKILL
ends at a random instant and that is started again on its database. After each kill the database has every report that
an authority has answered, the number of every authority and its end; at each authority no two trains hold track in
common. Printed: what was lost, and the time without a centre.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import random
import tempfile
import time
from collections import Counter
from itertools import combinations
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from ground_load import BEARERS_OF, centre_file
from railfix.ground.interlocking import HEAD, Interlocking, from_documents
from railfix.ground.layout import overlap
from railfix.ground.links import TrainLinks, first_sequence
from railfix.ground.serve import run_centre
from railfix.ground.store import Store
from railfix.ground.traffic import SimulatedTrain, line_with_loops
from railfix.ground.train import Authority, OnBoard
from railfix.io.train_message import encode

#: Station and direction of each train at the start.
PLACES = ((0, 1), (2, 1), (11, -1), (9, -1))
LINE = line_with_loops(12)


def serve(path: Path, ready: Connection) -> None:
    """Run a centre until it is killed."""
    asyncio.run(run_centre(path, password="secret", announce=ready.send))


class KilledCentre:
    """Centre, its trains, and what went wrong."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.trains = folder, dict[int, SimulatedTrain]()
        for number, (station, direction) in enumerate(PLACES, start=1):
            inner = LINE.stations[station].inner_m
            front = inner[1] - 100.0 if direction > 0 else inner[0] + 100.0
            self.trains[number] = SimulatedTrain(
                number=number, front_m=front, tracks={station: 1 if direction > 0 else 2}, sequence=first_sequence(),
                on_board=OnBoard(direction=direction, end_m=front),
            )  # fmt: skip
        self.path = centre_file(folder, LINE, self.trains)
        self.newest: dict[int, Authority] = {}
        self.lost: Counter[str] = Counter(dict.fromkeys(("reports", "authorities", "ends", "track in common"), 0))
        self.counted: Counter[str] = Counter()
        self.without_s: list[float] = []
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["railfix.ground.serve", "railfix.ground.traffic"])
        self._context = context
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
            self.newest[number] = authority
            self.counted["authorities"] += 1

    async def run_train(self, number: int) -> None:
        """Report once a second."""
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
        with Store(f"sqlite:///{self.folder / 'centre.db'}") as store:
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

    async def run(self, kills: int, seconds: float) -> None:
        """Kill and start again, so often or for so long."""
        rng, end = random.Random(1), time.monotonic() + seconds
        await self.start()
        running = [asyncio.create_task(self.run_train(number)) for number in self.trains]
        while self.counted["kills"] < kills and time.monotonic() < end:
            before = dict(self.newest)
            while any(self.newest.get(number) is before.get(number) for number in self.trains):
                await asyncio.sleep(0.02)
            await asyncio.sleep(rng.uniform(0.0, 1.0))
            assert self.process is not None
            self.process.kill()
            killed = time.monotonic()
            self.process.join()
            self.counted["kills"] += 1
            self.check()
            await self.start()
            self.without_s.append(time.monotonic() - killed)
        for task in running:
            task.cancel()
        await asyncio.gather(*running, return_exceptions=True)
        assert self.process is not None
        self.process.kill()


def main() -> None:
    """Print what was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("kills", type=int, nargs="?", default=200)
    parser.add_argument("--seconds", type=float, default=3600.0, help="end after this time, however few kills")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        centre = KilledCentre(Path(name))
        begun = {number: train.front_m for number, train in centre.trains.items()}
        asyncio.run(centre.run(given.kills, given.seconds))
    way_m = sum(abs(train.front_m - begun[number]) for number, train in centre.trains.items())
    print(f"{centre.counted['kills']} kills, {centre.counted['reports']} reports, "
          f"{centre.counted['authorities']} authorities; the trains ran {way_m / 1000.0:.1f} km")  # fmt: skip
    print("lost: " + ", ".join(f"{name} {count}" for name, count in centre.lost.items()))
    shown = np.percentile(centre.without_s, [50, 100])
    print(f"without a centre: median {shown[0]:.2f} s, longest {shown[1]:.2f} s")
    raise SystemExit(int(any(centre.lost.values())))


if __name__ == "__main__":
    main()
