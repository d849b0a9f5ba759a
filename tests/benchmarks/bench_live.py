"""One live epoch of two antennas, handed to the processor one by one as a receiver would.

Prints median, 99th percentile and largest time an epoch, wall and processor time, over the demonstration
run that comes with railfix, or over another simulated one::

    python tests/benchmarks/bench_live.py [--run FOLDER] [--epochs 1500] [--rounds 3] [--screens all|mask]
                                          [--filter off|track] [--level on|off]
                                          [--gap 600]

The last line has the least processor time of the rounds at each epoch, which other work on the machine changes least.
With ``--gap`` that many seconds are left out in the middle, and the slowest of the 20 epochs after them is printed; the
demonstration is too short for 600 s, the hour of ``bench_run.py`` is not.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from railfix import kernels
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config, parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.run.processor_setup import make_processor
from railfix.simulate.demonstration import demo_files
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle

#: Epochs before the clock starts: caches fill, offsets between clocks become known.
WARM_UP = 50
#: Epoch before which the gap begins.
GAP_AT = 400
#: P1 6: from the receiver's output to the position; and what is aimed at here [ms].
PAPER_MS, GOAL_MS = 40.0, {"off": 4.5, "track": 9.0}
#: Between two epochs [s].
PERIOD_S = 0.1


def files_of(folder: Path | None) -> dict[str, Path]:
    """The files of a simulated run, plain or packed; the demonstration's unless a folder is given."""
    if folder is None:
        return dict(demo_files())
    found = {}
    for name, endings in {"front": ("rnx", "crx.gz"), "rear": ("rnx", "crx.gz"), "nav": ("rnx", "rnx.gz")}.items():
        found[name] = next(p for e in endings if (p := folder / f"{name}.{e}").exists())
    return found | {"track": folder / "track.csv", "vehicle": folder / "vehicle.toml"}


def prepared(
    folder: Path | None, epochs: int, config: Config | None = None
) -> tuple[EpochProcessor, dict[str, Observations]]:
    """The processor and the first epochs of both antennas."""
    files = files_of(folder)
    track, vehicle = read_track(files["track"]), read_vehicle(files["vehicle"])
    observations = {name: read_observations(files[name])[:epochs] for name in ("front", "rear")}
    trajectories = {name: antenna_trajectory(track, vehicle, name) for name in observations}
    return make_processor(config or Config(filter="off"), read_navigation(files["nav"]), trajectories), observations


def milliseconds(
    processor: EpochProcessor, observations: Mapping[str, Observations], gap: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Wall and processor time of each epoch after the warm-up [ms]; `gap` epochs are left out after `GAP_AT`."""
    state = None
    wall, used = [], []
    for k in range(len(observations["front"])):
        if GAP_AT <= k < GAP_AT + gap:
            continue
        part = {name: whole[k : k + 1] for name, whole in observations.items()}
        begin, begin_used = time.perf_counter(), time.process_time()
        _, state = processor.process(part, state)
        wall.append(time.perf_counter() - begin)
        used.append(time.process_time() - begin_used)
    return 1e3 * np.array(wall[WARM_UP:]), 1e3 * np.array(used[WARM_UP:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="folder of `railfix simulate`; the demonstration unless given")
    parser.add_argument("--epochs", type=int, default=1500)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--screens", choices=("all", "mask"), default="all", help="mask: elevation only")
    parser.add_argument("--filter", choices=("off", "track"), default="off")
    parser.add_argument("--level", choices=("on", "off"), default="on", help="of the filter")
    parser.add_argument("--gap", type=float, default=0.0, help="seconds left out, as while nothing is received")
    parser.add_argument("--profile", action="store_true", help="print where the time goes, for one more round")
    options = parser.parse_args()
    screens = {"screens": ["elevation"]} if options.screens == "mask" else {}
    config = parse_config({"filter": options.filter, "tracking": {"level": options.level}, **screens})
    gap = round(options.gap / PERIOD_S)
    loaded = kernels.load()
    processor, observations = prepared(options.run, options.epochs + WARM_UP + gap, config)
    if gap and min(map(len, observations.values())) < GAP_AT + gap + 20:
        raise SystemExit(f"the run is too short for a gap of {options.gap:g} s; give a longer one with --run")
    channels = {name: len(whole.satellite) for name, whole in observations.items()}
    print(f"live epochs of two antennas, {options.epochs} a round, channels {channels}, screens: {options.screens}")
    print(f"kernels: {kernels.numba_version()}, {loaded} loaded from the disk before the first epoch")
    print(f"P1: {PAPER_MS:g} ms; goal for the 99th percentile: {GOAL_MS[options.filter]:g} ms")
    rounds = []
    for number in range(options.rounds):
        times = milliseconds(processor, observations, gap)
        rounds.append(times[1])
        for name, values in zip(("wall", "processor"), times, strict=True):
            p50, p99 = np.percentile(values, [50, 99])
            head = f"round {number + 1} {name:9s}"
            print(
                f"{head} median {p50:6.2f}  p99 {p99:6.2f}  max {values.max():6.2f} ms   p99 / P1 {p99 / PAPER_MS:.3f}"
            )
            if gap:
                first = GAP_AT - WARM_UP
                slowest = values[first : first + 20].max()
                print(f"{'':18s}slowest of the 20 epochs after the gap {slowest:6.2f} ms, {slowest / p50:.2f} medians")
    least = np.min(rounds, axis=0)
    p50, p99 = np.percentile(least, [50, 99])
    print(f"least of the rounds at each epoch, processor: median {p50:.2f}  p99 {p99:.2f}  max {least.max():.2f} ms")
    if options.profile:
        profile = cProfile.Profile()
        profile.runcall(milliseconds, processor, observations)
        pstats.Stats(profile).sort_stats("tottime").print_stats(30)


if __name__ == "__main__":
    main()
