"""Time of the centre for one second of a hundred trains at 1 Hz: ``python tests/ground_scale.py``."""

from __future__ import annotations

import tempfile
import time

from railfix.ground.centre import CentreLimits, TrainRecord, report_received
from railfix.ground.interlocking import extended
from railfix.ground.store import Store
from railfix.ground.traffic import line_with_loops, traffic


def main() -> None:
    """Print the times."""
    run, seconds = traffic(1, trains=100, layout=line_with_loops(60)), 10
    records = {number: TrainRecord(train=number) for number in run.trains}
    with tempfile.TemporaryDirectory() as folder, Store(f"sqlite:///{folder}/centre.db") as store:
        processor, clock = time.process_time(), time.perf_counter()
        for second in range(seconds):
            for number, train in run.trains.items():
                message = train.message(float(second))
                records[number], _ = report_received(records[number], message, float(second), limits=CentreLimits())
            store.save(*records.values())
        processor, clock = time.process_time() - processor, time.perf_counter() - clock
    print(f"reports and store: {processor / seconds:.3f} s of processor, {clock / seconds:.3f} s")
    for _ in range(5):
        run.step()
    processor = time.process_time()
    for _ in range(seconds):
        extended(run.state, run.layout, limits=run.limits)
    print(f"authorities: {(time.process_time() - processor) / seconds:.3f} s of processor")


if __name__ == "__main__":
    main()
