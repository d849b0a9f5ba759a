"""Recordings beside the checkout with the filter and its level: epochs a second.

``python tests/benchmarks/bench_recordings.py [m8t f9p ...] [--rounds 5]`` prints, for each, the best and the median
of the rounds: epochs a second of wall and of processor time, after a first round that loads the compiled kernels.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "studies"))
import paths
import belief_campaign
from railfix.pipeline.config import parse_config
from railfix.run.processor_setup import make_processor


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["m8t", "f9p"])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--filter", choices=("off", "track"), default="track")
    args = parser.parse_args()
    known = belief_campaign.cases(paths.DATA)
    for name in args.names:
        case = known[name]()
        rates = []
        for _ in range(args.rounds + 1):
            processor = make_processor(
                parse_config({"filter": args.filter}), case.navigation, {"front": case.trajectory}
            )
            wall, processor_s = time.perf_counter(), time.process_time()
            processor.process({"front": case.observations})
            rates.append((time.perf_counter() - wall, time.process_time() - processor_s))
        epochs = len(case.observations.time)
        wall, own = (epochs / np.array(rates[1:])).T
        print(
            f"{name}: {epochs} epochs, filter {args.filter}: {np.max(wall):.0f} a second at best, median "
            f"{np.median(wall):.0f}; of processor time {np.max(own):.0f}, {np.median(own):.0f}",
            flush=True,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
