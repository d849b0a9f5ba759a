"""P3's triangle by its radius: false stops, and time until faults are found, by code fixes and by CLAS-grade ones.

Run ``python tests/studies/triangle_score.py`` (some seconds). Errors of fixes are Gauss-Markov over 100 s, a part of
them common to the three receivers; their sizes (`FIXES`) are assumed. The limit of the sides is the one that
`limits_for_false_stops` gives with the radius.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Final

import numpy as np

import paths  # noqa: F401
from railfix.core.arrays import Floats
from railfix.ground.demo import PLAN_M
from railfix.ground.triangle import STOPPING, YEAR_S, TriangleLimits, compare_triangle, limits_for_false_stops

#: Name, standard deviation of a fix and of the part of its own, an axis [m].
FIXES: Final = (("single code fixes", 2.0, 0.7), ("CLAS-grade fixes", 0.06, 0.03))
#: False stops a year that the radius is for.
STOPS_A_YEAR: Final = (10.0, 1.0, 0.1)
INDEPENDENT_S: Final = 100.0
#: Speeds with which an error grows [m/s].
RAMPS_MPS: Final = (0.1, 1.0)
SEEDS: Final = 200


def errors(rng: np.random.Generator, epochs: int, sigma_m: float, own_sigma_m: float) -> Floats:
    """Errors of three receivers, one epoch a second, shape (T, 3, 2) [m]."""
    keep = np.exp(-1.0 / INDEPENDENT_S)
    drive = rng.normal(size=(epochs, 4, 2)) * np.sqrt(1.0 - keep**2)
    walk = np.empty_like(drive)
    walk[0] = rng.normal(size=(4, 2))
    for t in range(1, epochs):
        walk[t] = keep * walk[t - 1] + drive[t]
    return np.asarray(own_sigma_m * walk[:, :3] + np.sqrt(sigma_m**2 - own_sigma_m**2) * walk[:, 3:])


def found_after(limits: TriangleLimits, sigma_m: float, own_m: float, ramp_mps: float, receivers: slice) -> Floats:
    """Error of the fault when the trains are stopped, of every seed [m]."""
    epochs = int(4.0 * limits.radius_m / ramp_mps) + 60
    fault = np.zeros((epochs, 3, 2))
    fault[:, receivers, 0] = ramp_mps * np.arange(epochs)[:, None]
    sizes = []
    for seed in range(SEEDS):
        fixes = PLAN_M + errors(np.random.default_rng(seed), epochs, sigma_m, own_m) + fault
        stops = np.isin(compare_triangle(PLAN_M, fixes, limits=limits).verdict, list(STOPPING))
        sizes.append(ramp_mps * int(np.argmax(stops)) if stops.any() else np.inf)
    return np.array(sizes)


def report() -> Iterator[str]:
    """The table."""
    yield (
        "fixes              false stops  radius   side   drawn per 1e6     one receiver, 0.1 m/s    all three, 0.1 m/s"
        "    all three, 1 m/s\n"
        "                   a year          [m]    [m]   of asked          s, p50 / p95             s, p50 / p95"
        "          s, p50 / p95"
    )
    for name, sigma, own in FIXES:
        for stops in STOPS_A_YEAR:
            limits = limits_for_false_stops(sigma, own, stops_per_year=stops, independent_s=INDEPENDENT_S)
            rng, samples = np.random.default_rng(7), 1_000_000
            common = rng.normal(0.0, np.sqrt(sigma**2 - own**2), (samples, 1, 2))
            drawn = compare_triangle(
                PLAN_M, PLAN_M + common + rng.normal(0.0, own, (samples, 3, 2)), limits=limits
            ).verdict
            share = np.count_nonzero(np.isin(drawn, list(STOPPING)))
            asked = stops * INDEPENDENT_S / YEAR_S * samples
            cells = []
            for ramp, receivers in ((0.1, slice(0, 1)), (0.1, slice(0, 3)), (1.0, slice(0, 3))):
                after = found_after(limits, sigma, own, ramp, receivers) / ramp
                cells.append(f"{np.median(after):.0f} / {np.quantile(after, 0.95):.0f}")
            yield (
                f"{name:18s} {stops:11g} {limits.radius_m:7.2f} {limits.side_m:6.2f} {share:8d} of {asked:5.1f}"
                + "".join(f"{cell:>25s}" for cell in cells)
            )


def main() -> int:
    for line in report():
        print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
