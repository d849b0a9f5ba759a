"""The tunnels of the scenario `commercial-run` with every sensor dropped in turn: ``python
tests/studies/tunnel_score.py``.

The filter of the front antenna at 2 Hz; sensors as `railfix simulate commercial-run` has them. Then the wheel entered
2 % too large, and satellites 50 m off for 20 s from the portal of the longest tunnel on. One line a choice of sensors:
for each tunnel the largest error and that at its end with the stated standard deviation, against 2 m and 0.3 % of the
way.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import numpy as np

import paths  # noqa: F401
from railfix.pipeline.filter_result import AlongTrack
from sensed_ride import Ride, ride

GNSS = ("code", "phase", "doppler")
CHOICES: dict[str, tuple[str, ...]] = {
    "none": (),
    "wheel": ("wheel",),
    "inertial": ("force",),
    "radar": ("radar",),
    "wheel, inertial": ("wheel", "force"),
    "radar, inertial": ("radar", "force"),
    "wheel, radar": ("wheel", "radar"),
    "wheel, radar, inertial": ("wheel", "radar", "force"),
}
SCENARIO = '{"rate_hz": 2.0}'
#: Satellites return this much off for so long.
JUMP_M, JUMP_S = 50.0, 20.0


def tunnels(case: Ride) -> list[slice]:
    """Stretches of more than 5 s without observations."""
    without = ~np.isfinite(case.observations.code_m).any(axis=1)
    edges = np.flatnonzero(np.diff(without.astype(np.int8), prepend=0, append=0))
    pairs = zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
    return [slice(a, b) for a, b in pairs if case.time_s[b - 1] - case.time_s[a] > 5.0]


def allowed_m(case: Ride, rows: slice) -> float:
    """2 m and 0.3 % of the way through a tunnel."""
    return 2.0 + 0.003 * float(abs(case.chainage_m[rows.stop] - case.chainage_m[rows.start - 1]))


def line(name: str, case: Ride, found: AlongTrack) -> str:
    error, sigma = case.error_m(found), found.tracked.sigma_m
    cells = []
    for rows in tunnels(case):
        largest = float(np.nanmax(np.abs(error[rows])))
        mark = " " if largest <= allowed_m(case, rows) else "!"
        cells.append(f"{largest:7.2f}{mark}{error[rows.stop - 1]:+8.2f} ({sigma[rows.stop - 1]:6.2f})")
    outside = np.isfinite(case.observations.code_m).any(axis=1)
    ratio = np.abs(error / sigma)
    return (
        f"{name:24s}" + " |".join(cells) + f" | {np.nanpercentile(np.abs(error[outside]), 95):6.2f} "
        f"{np.nanmax(np.abs(error[outside])):6.2f} | {np.nanpercentile(ratio[outside], 95):5.2f} "
        f"{np.nanpercentile(ratio[~outside], 95):5.2f}"
    )


def report() -> Iterator[str]:
    case = ride(SCENARIO, "commercial-run")
    ways = [abs(case.chainage_m[r.stop] - case.chainage_m[r.start - 1]) for r in tunnels(case)]
    limits = [allowed_m(case, r) for r in tunnels(case)]
    yield "tunnels: " + ", ".join(f"{w:.0f} m (allowed {a:.2f} m)" for w, a in zip(ways, limits, strict=True))
    yield "sensors, each tunnel: largest, at its end (sigma) | outside: p95, largest | error/sigma p95: outside, inside"
    for name, sources in CHOICES.items():
        yield line(name, case, case.run(filter_sources=(*GNSS, *sources)))
    both = (*GNSS, "wheel", "force")
    wrong = {"tachometer": {"wheel_diameter_m": 0.86 * 1.02}}
    yield line("wheel 2 % large, inertial", case, case.run(filter_sources=both, sensors=wrong))
    portal = float(case.time_s[max(tunnels(case), key=lambda r: r.stop - r.start).stop]) - 0.1
    jumped = case.jumped(portal, portal + JUMP_S, JUMP_M)
    yield f"satellites {JUMP_M:.0f} m off for {JUMP_S:.0f} s after the longest tunnel: largest error in that minute"
    for name, settings in (("refused", {}), ("gate open", {"return_sigmas": 1e9})):
        found = case.run(observations=jumped, filter_sources=both, sensors=settings)
        after = (case.time_s >= portal) & (case.time_s < portal + 60.0)
        yield f"{name:24s}{np.nanmax(np.abs(case.error_m(found)[after])):7.2f}"


def main() -> int:
    for text in report():
        print(text, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
