"""Speed of satellite states and delays: one hour at 10 Hz with 18 channels, and one live epoch.

Run as a program; nothing else should run on the machine::

    python tests/benchmarks/bench_orbits.py [--rounds 5]
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))

from orbit_cases import TOE, navigation
from railfix.gnss.navigation import Navigation, PreciseEphemeris
from railfix.gnss.orbits import satellite_states
from railfix.ranges.atmosphere import klobuchar_delay_m, saastamoinen_delay_m

EPOCHS = 36_000
GEC = [f"G{n:02d}" for n in range(1, 9)] + [f"E{n:02d}" for n in range(1, 7)] + ["C03", "C20", "C21", "C22"]
CHANNELS = {"18 channels of G E C": GEC, "22 channels of G E C R": [*GEC, "R01", "R02", "R03", "R04"]}


def made(names: list[str]) -> Navigation:
    rows = []
    for name in names:
        kind = {"message": "INAV"} if name[0] == "E" else {}
        for hour in range(-3, 4):
            toe = TOE + np.timedelta64(hour * (900 if name[0] == "R" else 3600), "s")
            rows.append({"satellite": name, "toe": toe, "transmitted": toe - np.timedelta64(300, "s"), **kind})
    return navigation(*rows)


def best(call: Callable[[], object], rounds: int) -> float:
    def once() -> float:
        began = time.perf_counter()
        call()
        return time.perf_counter() - began

    call()
    return min(once() for _ in range(rounds))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    epochs = TOE - np.timedelta64(1500, "s") + np.arange(EPOCHS) * np.timedelta64(50, "ms")
    for title, names in CHANNELS.items():
        nav = made(names)
        satellite = np.array(names)
        signal = np.array(["2I" if n[0] == "C" else "1C" for n in names])
        code = np.full((EPOCHS, len(names)), 2.3e7)
        hour = best(lambda n=nav, s=satellite, g=signal, c=code: satellite_states(epochs, s, g, c, n), rounds)
        live = [
            best(
                lambda i=i, n=nav, s=satellite, g=signal, c=code: satellite_states(epochs[i : i + 1], s, g, c[:1], n), 1
            )
            for i in range(0, EPOCHS, 60)
        ]
        print(f"{title}: {EPOCHS} epochs {hour:.3f} s; one epoch median {np.median(live) * 1e3:.3f} ms, "
              f"99th percentile {np.percentile(live, 99) * 1e3:.3f} ms")  # fmt: skip
    names = GEC
    t = np.arange(-20, 21) * np.timedelta64(900, "s")
    place = np.random.default_rng(0).normal(0.0, 2e7, (len(t), len(names), 3))
    precise = PreciseEphemeris(
        time=TOE + t, satellite=np.array(names), position_ecef_m=place, clock_s=np.zeros((len(t), len(names)))
    )
    nav, satellite, signal = replace(made(names), precise=precise), np.array(names), np.full(len(names), "1C")
    code = np.full((EPOCHS, len(names)), 2.3e7)
    print(f"precise, 18 channels: {best(lambda: satellite_states(epochs, satellite, signal, code, nav), rounds):.3f} s")
    rng = np.random.default_rng(1)
    elevation, azimuth = rng.uniform(5, 90, code.shape), rng.uniform(0, 360, code.shape)
    latitude, longitude, height = np.full(EPOCHS, 35.0), np.full(EPOCHS, 139.0), np.full(EPOCHS, 50.0)
    coefficients = np.array([1.1e-8, 2.2e-8, -1.2e-7, -6.0e-8, 1.3e5, 1.6e5, -2.0e5, -2.6e5])
    carrier = np.full(len(names), 1.57542e9)
    ion = best(
        lambda: klobuchar_delay_m(epochs, latitude, longitude, elevation, azimuth, coefficients, carrier), rounds
    )
    trop = best(lambda: saastamoinen_delay_m(latitude, height, elevation), rounds)
    print(f"ionosphere {ion:.3f} s, troposphere {trop:.3f} s for {EPOCHS} epochs of 18 channels")


if __name__ == "__main__":
    main()
