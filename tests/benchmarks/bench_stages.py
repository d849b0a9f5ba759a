"""Where the time of `railfix run` goes, stage by stage, in one process.

The two logs of an hour at 10 Hz of `bench_run.py` are simulated first, or taken from ``--run``. Each stage's own time
without the stages inside it, the least of the rounds; threads that polars starts count as everything else::

    python tests/benchmarks/bench_stages.py [--run FOLDER] [--rounds 3] [--filter off|track] [--level on|off]
"""

from __future__ import annotations

import argparse
import compileall
import importlib
import os
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

sys.path.insert(0, str(Path(__file__).resolve().parent))

import bench_run
import railfix
from railfix.kernels import numba_version

#: Stages: name, module in which the function is looked up when it is called, function.
STAGES: Final = (
    ("corrections, weights", "railfix.pipeline.processor", "correct_ranges"),
    ("satellite orbits and clocks", "railfix.ranges.sources", "satellite_states"),
    ("approximate position", "railfix.pipeline.range_stage", "approximate_position"),
    ("angles", "railfix.ranges.corrected", "SeenFrom.of"),
    ("atmosphere", "railfix.ranges.sources", "model_delays"),
    ("screens of one antenna", "railfix.pipeline.processor", "screen_antennas"),
    ("screens of the antenna pair", "railfix.pipeline.processor", "screen_pairs"),
    ("screens of the antenna pair", "railfix.pipeline.processor", "screen_positions"),
    ("screens of the antenna pair", "railfix.pipeline.processor", "EpochProcessor._pair"),
    ("rest of positioning", "railfix.pipeline.processor", "position_stage"),
    ("conventional position", "railfix.positioning.inter_system", "point_position"),
    ("robust fits", "railfix.positioning.inter_system", "_agreeing"),
    ("noise scales", "railfix.pipeline.fault_stage", "noise_scale"),
    ("section search", "railfix.positioning.line_fix", "find_section"),
    ("constrained position", "railfix.positioning.line_fix", "position_on_line"),
    ("persistent range biases", "railfix.pipeline.fault_stage", "reject_persistent_biases"),
    ("fault detection", "railfix.pipeline.fault_stage", "exclude_faults"),
    ("test of the map", "railfix.pipeline.position_stage", "map_offset"),
    ("linear model", "railfix.integrity.persistent_biases", "linear_model"),
    ("protection level", "railfix.pipeline.level_stage", "protection_levels"),
    ("open places", "railfix.pipeline.level_stage", "places_beyond_the_level"),
    ("results", "railfix.pipeline.processor", "antenna_results"),
    ("results", "railfix.run.tally", "AntennaTally.add"),
    ("filter: measurements", "railfix.pipeline.along_track", "gnss_epochs"),
    ("filter: preparation", "railfix.tracking.filter", "prepare_chunk"),
    ("filter: preparation", "railfix.tracking.filter", "Recursion.__init__"),
    ("filter: recursion", "railfix.tracking.filter", "Recursion.run"),
    ("filter: starts and searches", "railfix.pipeline.along_track", "track"),
    ("filter: positions", "railfix.pipeline.processor", "along_track"),
    ("filter: rows of train.csv", "railfix.run.tally", "train_table"),
    ("tables", "railfix.run.tally", "positions_table"),
    ("tables", "railfix.run.output", "OutputFolder.append_csv"),
    ("tables", "railfix.run.output", "OutputFolder.append_parquet"),
    ("tables", "railfix.run.output", "OutputFolder.commit"),
)


class Stages(threading.local):
    """Own time of each stage; times of stages inside it are taken off. Rows are written by a thread of its own."""

    def __init__(self, spent: defaultdict[str, float]) -> None:
        self.spent = spent
        self._inside: list[float] = []

    def timed(self, name: str, action: Callable[..., Any]) -> Callable[..., Any]:
        """Return the same function, its time noted."""

        def measured(*arguments: Any, **named: Any) -> Any:
            self._inside.append(0.0)
            begin = time.thread_time()
            try:
                return action(*arguments, **named)
            finally:
                whole = time.thread_time() - begin
                self.spent[name] += whole - self._inside.pop()
                if self._inside:
                    self._inside[-1] += whole

        return measured

    def iterated(self, name: str, source: Callable[..., Iterator[Any]]) -> Callable[..., Iterator[Any]]:
        """Return the same generator function, the time of its steps noted."""

        def measured(*arguments: Any, **named: Any) -> Iterator[Any]:
            step = self.timed(name, source(*arguments, **named).__next__)
            while True:
                try:
                    item = step()
                except StopIteration:
                    return
                yield item

        return measured


def watched() -> Stages:
    """Put a stopwatch into every stage."""
    stages = Stages(defaultdict(float))
    for name, module, path in STAGES:
        holder: Any = importlib.import_module(module)
        *classes, function = path.split(".")
        for part in classes:
            holder = getattr(holder, part)
        setattr(holder, function, stages.timed(name, getattr(holder, function)))
    from railfix.run import driver

    driver.align_logs = stages.iterated("reading", driver.align_logs)
    return stages


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="folder of a simulated run, made with --plain")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--filter", choices=("off", "track"), default="off")
    parser.add_argument("--level", choices=("on", "off"), default="on", help="of the filter")
    options = parser.parse_args()
    if "PYTHONDONTWRITEBYTECODE" in os.environ:  # an installed package has its compiled modules
        compileall.compile_dir(Path(railfix.__file__).parent, quiet=1)
        os.execve(sys.executable, [sys.executable, *sys.argv], bench_run.as_installed())
    from railfix.pipeline.config import parse_config
    from railfix.run import RunInputs, RunOptions, run_files

    with tempfile.TemporaryDirectory(prefix="railfix-bench-") as scratch:
        folder = options.run or Path(scratch) / "hour"
        if options.run is None:
            bench_run.simulate(folder)
        inputs = RunInputs(
            front=(folder / "front.rnx",),
            rear=(folder / "rear.rnx",),
            nav=(folder / "nav.rnx",),
            track=(folder / "track.csv",),
            vehicle=folder / "vehicle.toml",
        )
        stages = watched()
        least: dict[str, float] = {}
        epochs = 0
        for number in range(options.rounds + 1):
            stages.spent.clear()
            begin = time.process_time()
            config = parse_config({"filter": options.filter, "tracking": {"level": options.level}})
            summary = run_files(inputs, config, out=Path(scratch) / f"out{number}", options=RunOptions())
            whole = time.process_time() - begin
            epochs = summary.tally.epochs
            spent = {**stages.spent, "all": whole, "everything else": whole - sum(stages.spent.values())}
            if number:  # the first round warms up
                least = {name: min(value, least.get(name, value)) for name, value in spent.items()}
        print(f"{epochs} antenna-epochs, kernels: {numba_version()}; least of {options.rounds} rounds")
        for name, value in least.items():
            print(f"{name:32s} {value:6.3f} s  {1e6 * value / epochs:6.1f} us")


if __name__ == "__main__":
    main()
