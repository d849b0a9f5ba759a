"""`railfix run` against RTKLIB's single point (`rnx2rtkp`) on the same two logs of an hour at 10 Hz.

The two 86 MB logs are simulated first (or taken from ``--run``). Both programs are whole processes,
started in turn; medians of the rounds, and their ratio, are printed::

    python tests/benchmarks/bench_run.py [--run FOLDER] [--rounds 3] [--screens all|mask] [--filter off|track]
        [--level on|off] [--hours 3]
"""

from __future__ import annotations

import argparse
import compileall
import cProfile
import os
import pstats
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

import railfix

#: RTKLIB with the same models; it has no screens beyond the mask.
RTKLIB_SETTINGS = """pos1-posmode=single
pos1-frequency=l1
pos1-elmask=20
pos1-ionoopt=brdc
pos1-tropopt=saas
pos1-sateph=brdc
pos1-navsys=57
out-solformat=llh
out-timesys=gpst
"""
MASK_ONLY = 'screens = ["elevation"]\n'


@dataclass(frozen=True)
class Spent:
    """One run of a program."""

    wall_s: float
    used_s: float
    peak_mb: float


def run(command: list[str]) -> Spent:
    """Run a program to its end; its own processor time and memory."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begin = time.perf_counter()
    watched = "import resource, subprocess, sys\nr = subprocess.run(sys.argv[1:], stdout=-3, stderr=-3).returncode\n"
    watched += "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)\nsys.exit(r)"
    program = [sys.executable, "-c", watched, *command]
    done = subprocess.run(program, stdout=subprocess.PIPE, check=True, text=True, env=as_installed())
    wall = time.perf_counter() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Spent(wall, used, float(done.stdout) / 1024.0)


def as_installed() -> dict[str, str]:
    """Return the environment without what keeps Python from its compiled modules, which an installed package has."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}


def simulate(folder: Path, hours: int = 1) -> None:
    """Hours of a train on 20 km of line each, 18 satellites on two signals, two antennas."""
    options = f"--seconds {3600 * hours} --set line.length_m={20000 * hours} --set sky.systems=GJEC"
    options += " --set sky.satellites_at_most=18 --set receiver.signals_per_satellite=2 --plain --overwrite"
    command = [sys.executable, "-m", "railfix", "simulate", "demo", "--out", str(folder), *options.split()]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def railfix_command(folder: Path, out: Path, config: Path | None, tracking: list[str]) -> list[str]:
    command = [sys.executable, "-m", "railfix", "run", "--front", f"{folder}/front.rnx", "--rear", f"{folder}/rear.rnx"]
    command += ["--nav", f"{folder}/nav.rnx", "--track", f"{folder}/track.csv", "--vehicle", f"{folder}/vehicle.toml"]
    command += tracking
    return [*command, "--out", str(out), *(["--config", str(config)] if config else [])]


def first_hour(folder: Path) -> list[str]:
    """Return the options of `railfix run` for the first hour of a log."""
    with (folder / "front.rnx").open() as log:
        first = next(row for row in log if row.startswith(">"))
    start = datetime(*(int(word) for word in first.split()[1:6]))  # type: ignore[arg-type]
    return ["--end", (start + timedelta(hours=1)).isoformat()]


def line(name: str, rounds: list[Spent]) -> float:
    wall, used, peak = (float(np.median([getattr(r, k) for r in rounds])) for k in ("wall_s", "used_s", "peak_mb"))
    spread = f"{min(r.wall_s for r in rounds):.2f} to {max(r.wall_s for r in rounds):.2f}"
    print(f"{name:28s} wall {wall:6.2f} s ({spread})   processor {used:6.2f} s   peak memory {peak:5.0f} MB")
    return wall


def compare(
    folder: Path, scratch: Path, *, rounds: int, config: Path | None, tracking: list[str], hours: int = 1
) -> tuple[float, float]:
    """Print what both programs take, and return their wall times; rnx2rtkp's is NaN where it is not installed."""
    own: list[Spent] = []
    other: list[Spent] = []
    compileall.compile_dir(Path(railfix.__file__).parent, quiet=1)
    conf = scratch / "single.conf"
    conf.write_text(RTKLIB_SETTINGS)
    for number in range(rounds):
        own.append(run(railfix_command(folder, scratch / f"out{number}", config, tracking)))
        shutil.rmtree(scratch / f"out{number}")
        if shutil.which("rnx2rtkp"):
            spent = [
                run(["rnx2rtkp", "-k", str(conf), "-o", f"{scratch}/{a}.pos", f"{folder}/{a}.rnx", f"{folder}/nav.rnx"])
                for a in ("front", "rear")
            ]
            total = Spent(sum(s.wall_s for s in spent), sum(s.used_s for s in spent), max(s.peak_mb for s in spent))
            other.append(total)
    wall = line("railfix run, two antennas", own)
    print(f"{'':28s} {72_000 * hours / wall:8.0f} positions a second")
    theirs = float("nan")
    if other:
        theirs = line("rnx2rtkp, one log, then the other", other)
        ratio = float(np.median([b.wall_s / a.wall_s for a, b in zip(own, other, strict=True)]))
        print(f"{'':28s} {72_000 * hours / theirs:8.0f} positions a second")
        wanted = 2.5 if "track" in tracking else 4.5
        print(f"railfix is {ratio:.2f} times as fast (wanted: {wanted})")
    return wall, theirs


def profiled(folder: Path, scratch: Path, config: Path | None, tracking: list[str]) -> None:
    from railfix.__main__ import main as railfix_main

    def once() -> None:
        sys.argv = ["railfix", *railfix_command(folder, scratch / "profiled", config, tracking)[3:]]
        try:
            railfix_main()
        except SystemExit as left:
            if left.code:
                raise

    profile = cProfile.Profile()
    action: Callable[[], None] = once
    profile.runcall(action)
    # at its end the program discards what is left for its standard output
    pstats.Stats(profile, stream=sys.stderr).sort_stats("tottime").print_stats(25)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, help="folder of a simulated run, made with --plain")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--screens", choices=("all", "mask"), default="all", help="mask: as RTKLIB, elevation only")
    parser.add_argument("--filter", choices=("off", "track"), default="off", help="off: single epochs, as rnx2rtkp")
    parser.add_argument("--level", choices=("on", "off"), default="on", help="of the filter")
    parser.add_argument("--hours", type=int, default=1, help="longer logs as well: what each further hour takes")
    parser.add_argument("--profile", action="store_true", help="print where the time of one more run goes")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="railfix-bench-") as name:
        scratch = Path(name)
        folder = options.run or scratch / "hour"
        if options.run is None:
            simulate(folder)
        config = None
        if options.screens == "mask":
            config = scratch / "mask.toml"
            config.write_text(MASK_ONLY)
        size = sum((folder / f"{a}.rnx").stat().st_size for a in ("front", "rear")) / 1e6
        what = f"screens: {options.screens}, filter: {options.filter}, its level: {options.level}"
        tracking = ["--filter", options.filter, "--set", f"tracking.level={options.level}"]
        print(f"two logs of an hour at 10 Hz, {size:.0f} MB in all, {what}")
        chosen: dict[str, Any] = {"rounds": options.rounds, "config": config, "tracking": tracking}
        first = compare(folder, scratch, **chosen)
        if options.hours > 1:
            longer = scratch / "hours"
            simulate(longer, options.hours)
            print(f"logs of {options.hours} hours")
            command = railfix_command(longer, scratch / "first", config, tracking)
            line("railfix run, their first hour", [run([*command, *first_hour(longer)])])
            whole = compare(longer, scratch, hours=options.hours, **chosen)
            own, theirs = ((b - a) / (options.hours - 1) for a, b in zip(first, whole, strict=True))
            print(f"a further hour: railfix {own:.2f} s, rnx2rtkp {theirs:.2f} s, {theirs / own:.2f} times as fast")
        if options.profile:
            profiled(folder, scratch, config, tracking)


if __name__ == "__main__":
    main()
