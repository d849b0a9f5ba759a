"""Campaign of many simulated logs: processes, a Dask cluster, a shell loop of ``railfix run``, a kill in the middle.

``python tests/studies/campaign_scale.py [--logs 100] [--seconds 20]`` prints the time of each, the largest resident
memory of its processes together, and whether the data sets are equal but for times.
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import polars as pl

import paths  # noqa: F401
from railfix.simulate import write_run
from railfix.simulate.scenario_file import load_recipe
from test_campaign import CLUSTER, same_but_for_times

CAMPAIGN = """
front = "logs/{run}/front.rnx"
rear = "logs/{run}/rear.rnx"
nav = "logs/{run}/nav.rnx"
track = ["logs/{run}/track.csv"]
vehicle = "logs/{run}/vehicle.toml"
"""
RAILFIX = [sys.executable, "-m", "railfix"]


def resident_mb(group: int) -> float:
    """Resident memory of a process group, shared pages counted by share [MB]."""
    total = 0.0
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if os.getpgid(int(folder.name)) == group:
                text = (folder / "smaps_rollup").read_text()
                total += float(text.split("Pss:")[1].split()[0]) / 1024.0
        except (OSError, IndexError):
            continue
    return total


def processor_s() -> float:
    """Processor time of the processes that have ended [s]."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def timed(words: list[str], *, kill_after: int | None = None) -> tuple[float, float]:
    """Time [s] and largest memory [MB] of a command; killed after so many lines of progress."""
    began, peak = time.perf_counter(), [0.0]
    with subprocess.Popen(
        words, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as process:
        done = threading.Event()

        def watch() -> None:
            while not done.wait(0.5):
                peak[0] = max(peak[0], resident_mb(process.pid))

        watcher = threading.Thread(target=watch)
        watcher.start()
        assert process.stderr is not None
        for number, _ in enumerate(process.stderr, start=1):
            if number == kill_after:
                os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        done.set()
        watcher.join()
    if kill_after is None and process.returncode != 0:
        raise SystemExit(f"{' '.join(words)} ended with {process.returncode}")
    return time.perf_counter() - began, peak[0]


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a log, 10 Hz, two antennas")
    parser.add_argument("--keep", type=Path, help="folder that stays")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = arguments.keep or Path(place)
        recipe = load_recipe("demo")
        began, names = time.perf_counter(), [f"{k:03d}" for k in range(arguments.logs)]
        for k, name in enumerate(names):
            if not (folder / "logs" / name).is_dir():
                scenario = recipe.scenario(changes={"seed": k + 1, "duration_s": arguments.seconds})
                write_run(scenario, folder / "logs" / name, packing="plain")
        print(f"{len(names)} logs of {arguments.seconds:g} s simulated in {time.perf_counter() - began:.0f} s")
        (folder / "campaign.toml").write_text(CAMPAIGN)

        def campaign(out: str, *options: str) -> list[str]:
            return [*RAILFIX, "campaign", str(folder / "campaign.toml"), "--out", str(folder / out), *options]

        before = processor_s()
        took, peak = timed(campaign("processes"))
        each = (processor_s() - before) / len(names)
        print(f"two processes: {took:.1f} s, {peak:.0f} MB, {each:.2f} s of processor a log")
        took, _ = timed(campaign("killed"), kill_after=len(names) // 2)
        positioned = len(list((folder / "killed").rglob("run.json")))
        print(f"killed after {took:.1f} s with {positioned} runs done")
        took, _ = timed(campaign("killed"))
        print(f"continued: {took:.1f} s; equal runs: {same_but_for_times(folder / 'killed', folder / 'processes')}")
        with subprocess.Popen(
            [sys.executable, "-c", CLUSTER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as cluster:
            assert cluster.stdout is not None
            address = cluster.stdout.readline().strip()
            took, _ = timed(campaign("cluster", "--scheduler", address))
            cluster.communicate()
        print(f"two workers of Dask: {took:.1f} s; "
              f"equal runs: {same_but_for_times(folder / 'cluster', folder / 'processes')}")  # fmt: skip
        began, before = time.perf_counter(), processor_s()
        for name in names[:20]:
            log = folder / "logs" / name
            words = ["--front", "front.rnx", "--rear", "rear.rnx", "--nav", "nav.rnx", "--track", "track.csv"]
            words = [str(log / word) if "." in word else word for word in [*words, "--vehicle", "vehicle.toml"]]
            out = str(folder / "loop" / name)
            subprocess.run([*RAILFIX, "run", *words, "--out", out], stdout=subprocess.DEVNULL, check=True)
        took, each = time.perf_counter() - began, (processor_s() - before) / len(names[:20])
        print(f"shell loop of railfix run over {len(names[:20])} logs: {took:.1f} s, {each:.2f} s of processor a log")
        rows = pl.scan_parquet(folder / "processes" / "runs" / "**" / "positions.parquet", hive_partitioning=True)
        print(f"rows of the data set: {rows.select(pl.len()).collect().item():,}")


if __name__ == "__main__":
    main()
