"""What protection levels, an error model and SBAS add to an epoch of a batch, against what solving takes.

Logs of one antenna are simulated first: GPS, QZSS and Galileo of a made sky; the same, and GPS alone, of the
navigation file recorded with the hour of MSAS messages of 2025, at that hour (with the recordings beside the
checkout; GPS time 17:00 to 18:00, and the messages come first, so the logs begin at 17:20). Each is then positioned by
one choice of settings after the other, round by round, chunk by chunk as `railfix run` does, from observations in
memory::

    python tests/benchmarks/bench_integrity.py [--seconds 1800] [--rounds 7] [--profile]

"Solving" is the whole of `EpochProcessor.process` without levels and SBAS: satellites, corrections, screens, search,
position, RAIM. Processor time; the least and the median of the rounds.
"""

from __future__ import annotations

import argparse
import cProfile
import os
import pstats
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from railfix.core.geodesy import elevation_azimuth, geodetic_from_ecef
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.io import read_navigation, read_observations
from railfix.pipeline.config import parse_config
from railfix.pipeline.processor import EpochProcessor
from railfix.ranges.error_model import ErrorModel, write_error_model
from railfix.ranges.error_model_fit import ErrorModelFit, ErrorSamples, fit_bins
from railfix.ranges.sbas import SbasCorrections, read_sbas
from railfix.ranges.sbas.troposphere import rtca_troposphere_m, rtca_troposphere_sigma_m
from railfix.run.driver import RunOptions
from railfix.run.processor_setup import make_processor
from railfix.track import read_track
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import antenna_trajectory, read_vehicle

RECORDINGS = Path(__file__).resolve().parents[3] / "shared" / "data" / "sbas" / "msas_20250215"
MESSAGES, NAVIGATION = RECORDINGS / "046r_sbas_prn137.txt", RECORDINGS / "046r_rnx.nav"


@dataclass(frozen=True)
class Log:
    """A log in memory with what positions it."""

    observations: Observations
    navigation: Navigation
    trajectory: Trajectory


@dataclass
class Choice:
    """Settings and the time that they took."""

    name: str
    settings: dict[str, Any]
    microseconds: list[float]


def simulated(folder: Path, seconds: int, *options: str) -> Log:
    """The front antenna's log of a simulated run."""
    command = [sys.executable, "-m", "railfix", "simulate", "demo", "--out", str(folder), "--seconds", str(seconds)]
    words = [word for option in options for word in ("--set", option)]
    subprocess.run([*command, *words, "--plain", "--overwrite"], check=True, stdout=subprocess.DEVNULL)
    track, vehicle = read_track(folder / "track.csv"), read_vehicle(folder / "vehicle.toml")
    return Log(
        read_observations(folder / "front.rnx"),
        read_navigation(folder / "nav.rnx"),
        antenna_trajectory(track, vehicle, "front"),
    )


def made_error_model(path: Path) -> Path:
    """A model with all its bins, of errors of 1 m / sin(elevation) that nobody recorded."""
    rng, n = np.random.default_rng(1), 200_000
    elevation = rng.uniform(5.0, 90.0, n)
    samples = ErrorSamples(
        error_m=rng.standard_normal(n) / np.sin(np.radians(elevation)),
        elevation_deg=elevation,
        relative_azimuth_deg=rng.uniform(0.0, 360.0, n),
        cn0_dbhz=rng.uniform(25.0, 55.0, n),
        block=np.arange(n, dtype=np.int64),
        used=np.ones(n, dtype=np.bool_),
        sigma_m=np.ones(n),
        chainage_m=np.full(n, np.nan),
    )
    fit = ErrorModelFit()
    of_all = fit_bins(samples, samples.used, fit)
    write_error_model(ErrorModel(bins=fit.bins, before=of_all, after=of_all, covers="local"), path)
    return path


def once(processor: EpochProcessor, log: Log) -> float:
    """Processor time of the whole log [us an epoch]."""
    size, state = RunOptions().chunk_epochs, None
    begin = time.process_time()
    for first in range(0, len(log.observations), size):
        _, state = processor.process({"front": log.observations[first : first + size]}, state)
    return 1e6 * (time.process_time() - begin) / len(log.observations)


def rounds_of(log: Log, choices: list[Choice], rounds: int) -> None:
    """All choices in turn, a first round of each not counted."""
    processors = [make_processor(parse_config(c.settings), log.navigation, {"front": log.trajectory}) for c in choices]
    for number in range(rounds + 1):
        for choice, processor in zip(choices, processors, strict=True):
            spent = once(processor, log)
            if number:
                choice.microseconds.append(spent)


def table(title: str, log: Log, choices: list[Choice]) -> None:
    """Times, and what each choice adds to the first one."""
    used = make_processor(parse_config({"filter": "off"}), log.navigation, {"front": log.trajectory}).process(
        {"front": log.observations[:3000]}
    )[0]
    print(f"\n{title}: {len(log.observations)} epochs, {np.median(used.antennas['front'].n_used):.0f} satellites used")
    print(f"{'':44s} us an epoch        added to solving: median of the rounds")
    first = np.array(choices[0].microseconds)
    for choice in choices:
        spent = np.array(choice.microseconds)
        added = spent - first
        print(
            f"{choice.name:44s} {spent.min():5.1f} {np.median(spent):5.1f}   "
            f"{np.median(added):+7.1f} us  {100.0 * np.median(added / first):+5.0f} %"
        )


def parts_of_sbas(log: Log, rounds: int) -> None:
    """The engine's own functions on what the run gives them, chunk by chunk: least of the rounds."""
    config = parse_config({"filter": "off", "protection": "off", "sbas": [str(MESSAGES)]})
    found = make_processor(config, log.navigation, {"front": log.trajectory}).process({"front": log.observations})[0]
    result, engine = found.antennas["front"], SbasCorrections.from_log(read_sbas(MESSAGES))
    satellite, size = result.satellite[result.columns], RunOptions().chunk_epochs
    place = log.trajectory.ecef_m[0]
    latitude, longitude, height = (float(x) for x in geodetic_from_ecef(place))
    least: dict[str, float] = {}
    for _ in range(rounds):
        spent: dict[str, float] = {}
        for first in range(0, len(result), size):
            rows = slice(first, first + size)
            when, at = result.time[rows], result.corrected.satellites.position_ecef_m[rows]
            here = np.broadcast_to(place, (len(when), 3))
            elevation, azimuth = elevation_azimuth(at, here)
            sight = (at - place) / np.linalg.norm(at - place, axis=-1, keepdims=True)
            lat, lon, up = (np.full(len(when), value) for value in (latitude, longitude, height))
            fixes = engine.satellites(when, satellite, log.navigation)
            calls: dict[str, Callable[[], object]] = {
                "satellites": lambda w=when: engine.satellites(w, satellite, log.navigation),
                "ionosphere": lambda w=when, a=lat, o=lon, e=elevation, z=azimuth: engine.ionosphere(w, a, o, e, z),
                "delta_udre": lambda w=when, f=fixes, s=sight, a=lat, o=lon: engine.delta_udre(w, f, s, a, o),
                "troposphere": lambda w=when, a=lat, h=up, e=elevation: (
                    rtca_troposphere_m(w, a, h, e),
                    rtca_troposphere_sigma_m(e),
                ),
            }
            for name, call in calls.items():
                begin = time.process_time()
                call()
                spent[name] = spent.get(name, 0.0) + 1e6 * (time.process_time() - begin) / len(result)
        least = {name: min(value, least.get(name, np.inf)) for name, value in spent.items()}
    print("of SBAS, us an epoch: " + ", ".join(f"{name} {value:.1f}" for name, value in least.items()))


def profiled(log: Log, settings: dict[str, Any]) -> None:
    """Where the time of one choice goes."""
    processor = make_processor(parse_config(settings), log.navigation, {"front": log.trajectory})
    once(processor, log)
    profile = cProfile.Profile()
    profile.runcall(once, processor, log)
    stats = pstats.Stats(profile)
    print(f"\nseconds of {len(log.observations)} epochs")
    stats.sort_stats("cumtime").print_stats(r"railfix/(sbas|protect|prepar|pipeline|sbas_use|error_model)", 45)
    stats.sort_stats("tottime").print_stats(25)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=1800, help="of the simulated logs, at 10 Hz; at most 2300")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--profile", action="store_true", help="print where the time of SBAS with levels goes")
    options = parser.parse_args()
    print(f"{os.cpu_count()} processors, load {os.getloadavg()[0]:.1f}; least and median of {options.rounds} rounds")
    with tempfile.TemporaryDirectory(prefix="railfix-bench-") as name:
        scratch = Path(name)
        off, model = {"protection": "off"}, {"error_model": str(made_error_model(scratch / "model.toml"))}
        log = simulated(scratch / "made", options.seconds)
        choices = [
            Choice("solving", off, []),
            Choice("with levels", {}, []),
            Choice("with error model", off | model, []),
            Choice("with error model and levels", model, []),
        ]
        rounds_of(log, choices, options.rounds)
        table("made sky, GPS, QZSS, Galileo", log, choices)
        if not MESSAGES.is_file():
            print(f"the real recordings are not at {RECORDINGS}: SBAS is not measured", file=sys.stderr)
            return 1
        sbas = {"sbas": [str(MESSAGES)]}
        for systems, title in (("GJE", "GPS, QZSS, Galileo"), ("G", "GPS")):
            hour = ["start=2025-02-15T17:20:00", f"sky.nav={NAVIGATION}", f"sky.systems={systems}"]
            hour += ["sky.unhealthy=[]", "sky.ionosphere_scale=0"]
            log = simulated(scratch / f"hour{systems}", options.seconds, *hour)
            choices = [
                Choice("solving", off, []),
                Choice("with levels", {}, []),
                Choice("with SBAS", off | sbas, []),
                Choice("with SBAS and levels", sbas, []),
                Choice("with SBAS, error model and levels", sbas | model, []),
            ]
            rounds_of(log, choices, options.rounds)
            table(f"{title} of 2025-02-15, 17:20", log, choices)
            parts_of_sbas(log, options.rounds)
        if options.profile:
            profiled(log, sbas)
    print(f"load {os.getloadavg()[0]:.1f} at the end")
    return 0


if __name__ == "__main__":
    sys.exit(main())
