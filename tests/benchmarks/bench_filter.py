"""Time of the filter along the track: a chunk and an epoch at a time, numpy and compiled.

``python tests/benchmarks/bench_filter.py [--rounds 5]`` prints microseconds an antenna-epoch, the median of the rounds:
a simulated ride at 10 Hz with 10 satellites of two constellations; the filter alone, and the chain of single epochs
without and with it on the logs of the demonstration.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))
import tracking_cases
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import Config
from railfix.run.processor_setup import make_processor
from railfix.simulate.demonstration import demo_inputs
from railfix.track import read_track
from railfix.track.vehicle import antenna_trajectory, read_vehicle
from railfix.tracking import GnssEpochs, Line, SensorEpochs, TrackingLimits, track
from railfix.tracking.levels import LevelState, track_with_levels

EPOCHS = 2000


def median_us(action: object, epochs: int, rounds: int) -> float:
    assert callable(action)
    spent = []
    for _ in range(rounds):
        began = time.process_time()
        action()
        spent.append(1e6 * (time.process_time() - began) / epochs)
    return float(np.median(spent))


def once_a_second(epochs: GnssEpochs, line: Line) -> None:
    track_with_levels(epochs, line, None, LevelState(), TrackingLimits(), SensorEpochs())


def filter_alone(rounds: int) -> None:
    ride = tracking_cases.ride(EPOCHS // 10, rate_hz=10.0, noise=1.0)
    line, epochs = ride.line, tracking_cases.part(ride.epochs, slice(0, EPOCHS))
    first, _ = track(epochs, line)
    assert np.isfinite(first.arc_m[10:]).all()
    _, state = track(tracking_cases.part(epochs, slice(0, 1000)), line)
    one = tracking_cases.part(epochs, slice(1000, 1001))
    short = tracking_cases.part(epochs, slice(0, 200))
    _, levelled = track(tracking_cases.part(epochs, slice(900, 1000)), line, levels=True)
    track(one, line, state)
    for label, run, count in (
        ("a chunk", lambda: track(epochs, line), len(epochs)),
        ("epoch by epoch", lambda: [track(one, line, state) for _ in range(100)], 100),
        ("a chunk with levels once a second", lambda: once_a_second(epochs, line), len(epochs)),
        ("a chunk with levels at each epoch", lambda: track(short, line, levels=True), len(short)),
        ("epoch by epoch with levels", lambda: [track(one, line, levelled, levels=True) for _ in range(100)], 100),
    ):
        print(f"{label:41s} {median_us(run, count, rounds):8.1f} us an antenna-epoch", flush=True)


def chain(rounds: int) -> None:
    inputs = demo_inputs()
    assert inputs.vehicle is not None
    line, vehicle = read_track(inputs.track), read_vehicle(inputs.vehicle)
    logs = {"front": read_observations(inputs.front), "rear": read_observations(inputs.rear)}
    paths = {name: antenna_trajectory(line, vehicle, name) for name in logs}
    navigation = read_navigation(inputs.nav)
    epochs = sum(len(log) for log in logs.values())
    for which in ("off", "track"):
        config = Config(filter=which)
        run = lambda config=config: make_processor(config, navigation, paths).process(logs)  # noqa: E731
        run()
        spent = median_us(run, epochs, rounds)
        print(f"demonstration, filter {which:10s}     {spent:8.1f} us an antenna-epoch", flush=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}")
    filter_alone(rounds)
    chain(rounds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
