"""Time of the centre for one second of a hundred trains at 1 Hz: ``python tests/studies/ground_scale.py``.

Reports in, supervision, one commit, authorities out; the links are left out (`tests/benchmarks/bench_links.py`).
"""

from __future__ import annotations

import tempfile
import time

import paths  # noqa: F401
from disturbed_traffic import traffic
from railfix.ground.control import ControlCentre
from railfix.ground.store import Store
from railfix.ground.traffic import line_with_loops
from railfix.io.train_message import encode


def main() -> None:
    """Print the times."""
    run, seconds, sent, now = traffic(1, trains=100, layout=line_with_loops(60)), 20, [0], [0.0]

    def send(_train: int, _data: bytes) -> None:
        sent[0] += 1

    with tempfile.TemporaryDirectory() as folder, Store(f"sqlite:///{folder}/centre.db") as store:
        control = ControlCentre(
            supervision=run.centre, store=store, curves={}, send=send, clock=lambda: now[0], wall_ns=lambda: 0
        )
        reports = [
            [(number, encode(train.message(float(second)))) for number, train in run.trains.items()]
            for second in range(seconds)
        ]
        processor, clock = time.process_time(), time.perf_counter()
        for each in reports:
            now[0] += 1.0
            for number, payload in each:
                control.report(number, payload)
            control.step()
        processor, clock = time.process_time() - processor, time.perf_counter() - clock
    print(f"{control.reports} reports, {sent[0]} authorities, {run.centre.routes_set} routes in {seconds} s of traffic")
    print(f"a second of traffic: {processor / seconds:.3f} s of processor, {clock / seconds:.3f} s")


if __name__ == "__main__":
    main()
