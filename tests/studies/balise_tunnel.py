"""Level of the filter through the longest tunnel of `commercial-run`, with and without balises: ``python
tests/studies/balise_tunnel.py``.

The front antenna at 1 Hz, from 90 s before the tunnel of 1.3 km to 30 s after it, sensors as `railfix simulate
commercial-run` has them, balises every 250 m. Then one that is missed, and one that is read as its neighbour. For each
choice: level in the middle and at the end of the tunnel, its largest value, largest error in the tunnel and epochs of
the whole stretch whose error is over the level.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

import paths  # noqa: F401
from railfix.motion.samples import BaliseReadings
from railfix.pipeline.balises import VERDICTS
from railfix.simulate.scenario_file import load_recipe
from railfix.simulate.settings import BaliseSettings
from sensed_ride import Ride, made
from tunnel_score import tunnels

BALISES = BaliseSettings(spacing_m=250.0, along_m=2.0, noise_sigma_m=0.3)
SENSORS = ("code", "phase", "doppler", "wheel", "force")
BEFORE_S, AFTER_S = 90, 30


def read_as(case: Ride, names: dict[str, str | None]) -> Ride:
    """The ride with balises read under other names, or not at all."""
    own = case.samples.balises
    kept = np.array([names.get(name, name) is not None for name in own.balise.tolist()])
    read = np.array([names.get(name, name) for name in own.balise[kept].tolist()])
    readings = BaliseReadings(time=own.time[kept], balise=read, sigma_m=own.sigma_m[kept])
    return replace(case, samples=replace(case.samples, balises=readings))


def report() -> Iterator[str]:
    scenario = load_recipe("commercial-run").scenario()
    assert scenario.sensors is not None
    case = made(scenario.replaced(rate_hz=1.0, sensors=scenario.sensors.replaced(balises=BALISES)))
    inside = max(tunnels(case), key=lambda rows: rows.stop - rows.start)
    span = slice(inside.start - BEFORE_S, inside.stop + AFTER_S)
    log, rows = case.observations[span], slice(BEFORE_S, BEFORE_S + inside.stop - inside.start)
    times = case.samples.balises.time
    within = (times > case.observations.time[inside.start]) & (times < case.observations.time[inside.stop - 1])
    names = case.samples.balises.balise[within].tolist()
    yield f"tunnel of {rows.stop - rows.start} s, balises in it: {', '.join(names)}"
    yield f"{'':28s}{'middle':>8s}{'end':>8s}{'largest':>9s}{'error':>8s}{'over':>6s}  named"
    with_balises = (*SENSORS, "balise")
    choices = {
        "no balises": (case, SENSORS),
        "balises": (case, with_balises),
        f"{names[1]} missed": (read_as(case, {names[1]: None}), with_balises),
        f"{names[1]} read as {names[2]}": (read_as(case, {names[1]: names[2]}), with_balises),
        f"{names[1]} alone, read as {names[2]}": (
            read_as(case, {name: names[2] if name == names[1] else None for name in names}), with_balises,
        ),
    }  # fmt: skip
    for name, (own, sources) in choices.items():
        found = own.run(observations=log, filter_sources=sources, sensors={"balise": {"ahead_m": 2.0}})
        error, level = np.abs(found.chainage_m - case.chainage_m[span]), found.tracked.level_m
        named = [f"{p.balise} {VERDICTS[p.verdict]}" for p in found.passings if VERDICTS[p.verdict] != "read"]
        yield (
            f"{name:28s}{level[(rows.start + rows.stop) // 2]:8.1f}{level[rows.stop - 1]:8.1f}{level[rows].max():9.1f}"
            f"{error[rows].max():8.2f}{int((error > level).sum()):6d}  {', '.join(named)}"
        )


def main() -> int:
    for text in report():
        print(text, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
