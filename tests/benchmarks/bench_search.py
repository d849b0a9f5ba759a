"""Time of the section search per epoch on a line of 1 km and on one of 200 km, and what it looks at.

Two layouts: a train running at 72 km/h, 10 Hz, and epochs at random places of the whole line, where the
processor's cache holds little of a long line. The search itself knows nothing of the epoch before.
With eight satellites there is a 3-D position to start from; with three the search goes coarse to fine.
The two lines take turns, and the ratio is the median of the rounds::

    python tests/benchmarks/bench_search.py [--epochs 2000] [--rounds 9]
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))

import synthetic
from railfix.positioning.normal_equations import SinglePoint, point_position
from railfix.positioning.range_arrays import Ranges
from railfix.positioning.search_index import SearchIndex
from railfix.positioning.section_search import find_section
from railfix.track.trajectory import Trajectory

LENGTHS_M = (1_000.0, 200_000.0)
#: Selection with a 3-D position.
RATIO = 1.5


def places(line: Trajectory, epochs: int, layout: str) -> np.ndarray:
    """Arc lengths of the epochs: "train" at 72 km/h and 10 Hz from the middle, turning at the ends; or "random"."""
    if layout == "random":
        return np.random.default_rng(3).uniform(5.0, line.arc_m[-1] - 5.0, epochs)
    free = line.arc_m[-1] - 10.0
    return 5.0 + np.abs((free / 2.0 + 2.0 * np.arange(epochs) + free) % (2.0 * free) - free)


def case(line: Trajectory, epochs: int, satellites: int, layout: str) -> tuple[Ranges, SinglePoint]:
    """Ranges with noise of a metre, and their 3-D positions."""
    ranges = synthetic.ranges(line, places(line, epochs, layout))
    if satellites < ranges.weight.shape[1]:
        ranges = replace(ranges, weight=np.where(np.arange(ranges.weight.shape[1]) < satellites, ranges.weight, 0.0))
    return ranges, point_position(ranges, np.broadcast_to(line.ecef_m.mean(axis=0), (epochs, 3)))


def microseconds(ranges: Ranges, index: SearchIndex, point: SinglePoint) -> float:
    """Time an epoch of one call over all epochs [us]."""
    begin = time.perf_counter()
    find_section(ranges, index, point)
    return 1e6 * (time.perf_counter() - begin) / len(ranges)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=9)
    options = parser.parse_args()
    lines = [synthetic.line(length) for length in LENGTHS_M]
    indices = [SearchIndex(line) for line in lines]
    few = max(options.epochs // 10, 1)
    for layout, satellites, epochs in (
        ("train", 8, options.epochs),
        ("random", 8, options.epochs),
        ("train", 3, few),
        ("random", 3, few),
    ):
        cases = [case(line, epochs, satellites, layout) for line in lines]
        looked = [
            float(find_section(ranges, index, point).evaluations.mean())
            for index, (ranges, point) in zip(indices, cases, strict=True)
        ]
        times = np.array(
            [
                [microseconds(ranges, index, point) for index, (ranges, point) in zip(indices, cases, strict=True)]
                for _ in range(options.rounds)
            ]
        )
        ratio = float(np.median(times[:, 1] / times[:, 0]))
        how = "3-D position" if satellites > 3 else "coarse to fine"
        print(f"{layout}: {satellites} satellites, {epochs} epochs a call, {how}")
        for length, line, spent, points in zip(LENGTHS_M, lines, np.median(times, axis=0), looked, strict=True):
            head = f"  {length / 1e3:5.0f} km, {len(line):6d} points"
            print(f"{head}: {spent:8.2f} us an epoch, {points:7.1f} points looked at")
        print(f"  200 km / 1 km: {ratio:.2f}" + (f" (wanted: under {RATIO})" if satellites > 3 else ""))


if __name__ == "__main__":
    main()
