"""P1's experiments on simulated lines: chapter 5 (tables 4 to 6, figures 10 to 12) and 3.2.

Run ``python tests/studies/p1_experiment.py PART`` for the tables of docs/paper-experiments.md, one part at a time:

========== =====================================================================
short      the first two minutes of that, in seconds
commercial 145.2 km of the scenario p1-commercial: every configuration beside P1
corrected  GPS alone on those lines and on five of other seeds, with and without simulated SBAS corrections
filtered   the filter along the track on the lines of "commercial", without sensors and with two
static     two and three satellites, standing at many points of the test line
========== =====================================================================

Nothing is written; the simulated signals go from the simulator to the positioning in memory.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from p1_ride import (
    LARGE_M,
    Bench,
    Breaking,
    Campaign,
    Found,
    Passage,
    Way,
    cn0_curve,
    in_ways,
    intervals_m,
    ridden,
    together,
)
from p1_rtklib import ABSENT, PROGRAM
from p1_static import static_report
from railfix.core.arrays import Masks
from railfix.core.reasons import Status
from railfix.simulate import Scenario
from railfix.simulate.scenario_file import load_recipe
from railfix.simulate.settings import SbasSettings

#: P1, chapter 5: largest error and positioning rate, conventional and by P1's method.
P1_LARGEST_M: Final = (65.8, 10.2)
P1_RATE: Final = (86.7, 84.6)
#: The goal: largest error, and points of positioning rate that it may cost.
GOAL_M: Final = 10.0
GOAL_POINTS: Final = P1_RATE[0] - P1_RATE[1]
#: An error from here on is another place.
WRONG_PLACE_M: Final = 50.0
#: Ways of the scenario without a tunnel, chainage [m]: the rate of P1 is of a line without tunnels.
WITHOUT_TUNNELS_M: Final = ((0.0, 20_300.0), (28_800.0, 40_000.0))
#: Seeds of lines and places besides the shipped ones, and the run of the scenario (hour, direction) on each.
OTHER_RUNS: Final = ((11, 0), (12, 2), (13, 3), (14, 1), (15, 0))
#: P1's systems, and with Galileo.
SYSTEMS: Final = ("G", "GJ", "GJE")


#: P1 table 6, "common": the mask of 20 degrees and 30 dB-Hz alone.
COMMON: Final = {"preset": "p1", "screens": ["elevation", "cn0"], "cn0": {"deficit_dbhz": None}}
#: The defaults; what drops failed checks is done afterwards, so that the positions dropped can be looked at.
DEFAULT: Final = {"preset": "default"}
#: What rates are compared with: every conventional position, those that fail the usual checks among them.
YARDSTICK: Final = Way("conventional", COMMON, "conventional")
WAYS: Final = (
    YARDSTICK,
    Way("validated", COMMON, "validated"),
    Way("RTKLIB", COMMON, "rtklib"),
    Way("constrained", COMMON),
    Way("p1", {"preset": "p1"}),
    Way("default, drop", DEFAULT, "checked"),
    Way("strict", DEFAULT, "checked", largest_sigma_m=10.0),
)
#: The filter along the track beside the conventional positions.
FILTERED: Final = {"preset": "default", "filter": "track"}
FILTER_WAYS: Final = (
    YARDSTICK,
    Way("filter", FILTERED, "filtered"),
    Way("filter, wheel, inertial", FILTERED, "filtered", sensors=True),
)
FILTER_SYSTEMS: Final = ("GJ", "GJE")
#: Uncorrected and corrected, side by side; the messages are of GPS, as those of P1.
CORRECTED_WAYS: Final = tuple(
    replace(way, name=f"{way.name}{word}", sbas=sbas) for way in WAYS for word, sbas in (("", False), (", SBAS", True))
)
#: Large errors this near in time are one line of the list [epochs].
BURST_EPOCHS: Final = 50
#: Length of the short part [s].
SHORT_S: Final = 120.0
#: Lines of the list of large errors of a way and choice of systems.
MOST_BURSTS: Final = 3


HEAD: Final = (
    "                           rate %            lost                        |error| [m]            "
    "           over    over  interval [m]\n"
    "systems way                observed   all  points   mean    std     p50    p95     p99     max"
    "    10 m    50 m    p95      max"
)


def row(
    name: str,
    passages: Sequence[Passage],
    found: Sequence[Found],
    yardstick: Sequence[Found],
    where: Callable[[Passage], Masks],
) -> str:
    """Figures of one way in one line."""
    masks = [where(p) for p in passages]
    error = np.concatenate([f.error_m[m] for f, m in zip(found, masks, strict=True)])
    other = np.concatenate([f.error_m[m] for f, m in zip(yardstick, masks, strict=True)])
    observed = np.concatenate([p.observed[m] for p, m in zip(passages, masks, strict=True)])
    good = error[np.isfinite(error)]
    size = np.abs(good)
    rate, base = (np.count_nonzero(np.isfinite(e) & observed) / np.count_nonzero(observed) for e in (error, other))
    apart = np.concatenate([intervals_m(p, f, m) for p, f, m in zip(passages, found, masks, strict=True)])
    p50, p95, p99 = np.quantile(size, (0.5, 0.95, 0.99))
    return (
        f"{name:27s}{100 * rate:7.2f} {100 * len(good) / len(error):6.2f} {100 * (base - rate):+6.2f} "
        f"{good.mean():+7.2f} {good.std():6.2f} {p50:7.2f} {p95:6.2f} {p99:7.2f} {size.max():8.1f} "
        f"{np.count_nonzero(size > GOAL_M):7d} {np.count_nonzero(size > WRONG_PLACE_M):7d} "
        f"{np.quantile(apart, 0.95):6.1f} {apart.max():8.1f}"
    )


def everywhere(passage: Passage) -> Masks:
    return np.ones(len(passage.time), dtype=np.bool_)


def without_tunnels(passage: Passage) -> Masks:
    return in_ways(passage.chainage_m, WITHOUT_TUNNELS_M)


def main_table(campaign: Campaign, where: Callable[[Passage], Masks]) -> Iterator[str]:
    """Every way of every choice of systems in a line."""
    if PROGRAM is None:
        yield ABSENT
    yield from HEAD.splitlines()
    for letters, way in campaign.found:
        yardstick = campaign.found[letters, YARDSTICK.name + (", SBAS" if way.endswith(", SBAS") else "")]
        name = f"{'+'.join(letters):7s} {way}"
        yield row(name, campaign.passages, campaign.found[letters, way], yardstick, where)


def goal_table(campaign: Campaign) -> Iterator[str]:
    """Points of the rate lost and largest error, run by run, and whether that is the goal."""
    runs = list(dict.fromkeys(p.run for p in campaign.passages))
    yield f"{'points lost / largest [m]':27s}" + "".join(f"{run:>18s}" for run in [*runs, "all"])
    for letters in SYSTEMS:
        yardstick = campaign.found[letters, YARDSTICK.name]
        for name in ("p1", "default, drop", "strict"):
            founds = campaign.found[letters, name]
            cells = []
            for run in [*runs, ""]:
                triples = zip(campaign.passages, yardstick, founds, strict=True)
                part = [triple for triple in triples if not run or triple[0].run == run]
                observed = sum(np.count_nonzero(p.observed) for p, _, _ in part)
                had = sum(np.count_nonzero(np.isfinite(base.error_m)) for _, base, _ in part)
                size = np.abs(np.concatenate([f.error_m[np.isfinite(f.error_m)] for _, _, f in part]))
                lost = 100.0 * (had - len(size)) / observed
                goal = "*" if size.max() < GOAL_M and lost <= GOAL_POINTS else " "
                cells.append(f"{lost:+.2f} / {size.max():.1f} {goal}")
            yield f"{'+'.join(letters):6s}{name:21s}" + "".join(f"{cell:>18s}" for cell in cells)
    yield f"* the goal: under {GOAL_M:g} m, at most {GOAL_POINTS:.1f} points lost"


def extent(campaign: Campaign) -> str:
    """Epochs and way of a campaign."""
    fronts = [p for p in campaign.passages if p.antenna == "front"]
    km = sum(float(np.abs(np.diff(p.chainage_m)).sum()) for p in fronts) / 1e3
    epochs = sum(len(p.time) for p in campaign.passages)
    observed = sum(np.count_nonzero(p.observed) for p in campaign.passages)
    return f"{len(fronts)} runs, {km:.1f} km, {epochs} epochs of two antennas, {observed} of them observed"


def commercial(
    folder: Path,
    runs: Sequence[int] = (0, 1, 2, 3),
    seed: int | None = None,
    ways: Sequence[Way] = WAYS,
    systems: Sequence[str] = SYSTEMS,
    duration_s: float | None = None,
) -> Campaign:
    """The scenario p1-commercial, or its runs on another line and place; whole, or so much from their start."""
    curve, recipe = cn0_curve(folder), load_recipe("p1-commercial")
    campaigns = []
    for number in runs:
        other = {} if seed is None else {"seed": seed, "place_seed": seed, "line": {"generated": {"seed": seed}}}
        scenario = recipe.scenario(number, changes=other)
        if not any(way.sensors for way in ways):
            scenario = scenario.replaced(sensors=None)
        if any(way.sbas for way in ways):
            scenario = scenario.replaced(sbas=SbasSettings(clock_sigma_m=0.1))
        if duration_s is not None:
            scenario = scenario.replaced(duration_s=duration_s)
        name = recipe.names[number] if seed is None else f"seed-{seed}"
        campaigns.append(ridden(Bench(scenario, name, ways, systems, curve)))
    return together(campaigns)


def short_scenario() -> Scenario:
    """The first minutes of the first run: a station, tall buildings, town."""
    return load_recipe("p1-commercial").scenario(0).replaced(sensors=None, duration_s=SHORT_S)


def short_report(folder: Path) -> Iterator[str]:
    """Main table of the short run."""
    campaign = ridden(Bench(short_scenario(), "short", WAYS, SYSTEMS, cn0_curve(folder)))
    yield extent(campaign)
    yield from main_table(campaign, everywhere)


def commercial_report(campaign: Campaign) -> Iterator[str]:
    """The tables of chapter 5."""
    yield extent(campaign)
    yield f"P1: largest error {P1_LARGEST_M[0]} m to {P1_LARGEST_M[1]} m, rate {P1_RATE[0]} % to {P1_RATE[1]} %"
    yield "\nall ways"
    yield from main_table(campaign, everywhere)
    yield "\nways without tunnels"
    yield from main_table(campaign, without_tunnels)
    yield ""
    yield from goal_table(campaign)
    yield ""
    yield from breaking_lines(campaign, "strict")


def corrected_report(folder: Path) -> Iterator[str]:
    """GPS with and without SBAS corrections, P1's figures beside their like: all data, and ways without tunnels."""
    names = ("commercial lines", "other lines")
    shipped = commercial(folder, ways=CORRECTED_WAYS, systems=("G",))
    others = [commercial(folder, (n,), seed, CORRECTED_WAYS, ("G",)) for seed, n in OTHER_RUNS]
    for name, campaign in zip(names, (shipped, together(others)), strict=True):
        yield f"{name}: {extent(campaign)}"
        yield f"all data (P1, corrected by MSAS: largest error {P1_LARGEST_M[0]} m to {P1_LARGEST_M[1]} m)"
        yield from main_table(campaign, everywhere)
        yield f"ways without tunnels (P1: rate {P1_RATE[0]} % to {P1_RATE[1]} %)"
        yield from main_table(campaign, without_tunnels)
        yield ""


def filtered_report(folder: Path) -> Iterator[str]:
    """The filter along the track beside the conventional positions, line by line as each is done."""
    campaigns = []
    for number in range(4):
        campaigns.append(commercial(folder, (number,), ways=FILTER_WAYS, systems=FILTER_SYSTEMS))
        yield ""
        yield extent(campaigns[-1])
        yield from main_table(campaigns[-1], everywhere)
    campaign = together(campaigns)
    yield "\nall lines"
    yield extent(campaign)
    yield from main_table(campaign, everywhere)
    yield "\nways without tunnels"
    yield from main_table(campaign, without_tunnels)
    yield "\nbeyond the portals: epochs without observations"
    yield from unobserved_lines(campaign)
    for way in FILTER_WAYS[1:]:
        yield from breaking_lines(campaign, way.name)


def unobserved_lines(campaign: Campaign) -> Iterator[str]:
    """Errors of the filter at epochs without observations."""
    for (letters, way), found in campaign.found.items():
        pairs = zip(campaign.passages, found, strict=True)
        error = np.concatenate([f.error_m[~p.observed] for p, f in pairs])
        size = np.abs(error[np.isfinite(error)])
        if len(size):
            p50, p95 = np.quantile(size, (0.5, 0.95))
            yield f"{'+'.join(letters):7s} {way:24s}{len(size):7d} epochs: {p50:.2f} / {p95:.2f} / {size.max():.2f} m"


def breaking_lines(campaign: Campaign, way: str) -> Iterator[str]:
    """The largest errors of a way, each with what it is made of; of many epochs together in time the largest."""
    for letters in dict.fromkeys(letters for letters, _ in campaign.found):
        items = campaign.breaking.get((letters, way), [])
        yield f"{'+'.join(letters)} {way}: {len(items)} epochs of {LARGE_M:g} m and more"
        bursts: list[list[Breaking]] = []
        for item in items:
            last = bursts[-1][-1] if bursts else None
            if last is None or item.passage != last.passage or item.epoch - last.epoch > BURST_EPOCHS:
                bursts.append([])
            bursts[-1].append(item)
        largest = [(max(burst, key=lambda one: abs(one.error_m)), len(burst)) for burst in bursts]
        for item, together_in_time in sorted(largest, key=lambda one: -abs(one[0].error_m))[:MOST_BURSTS]:
            passage, found = campaign.passages[item.passage], campaign.found[letters, way][item.passage]
            t = item.epoch
            yield (
                f"{passage.run} {passage.antenna:5s} {str(passage.time[t])[11:21]} {passage.chainage_m[t]:6.0f} m "
                f"{passage.environment[t]:9s} {passage.speed_mps[t]:4.1f} m/s {item.error_m:+7.1f} m "
                f"{Status(int(found.status[t])).text} own {found.own_sigma_m[t]:.1f} m dilution {item.dilution:.1f} "
                f"late {item.late} of {found.n_used[t]}: {item.signals}"
                + (f" (largest of {together_in_time})" if together_in_time > 1 else "")
            )


def report(part: str, folder: Path) -> Iterator[str]:
    """The lines of one part."""
    if part == "commercial":
        yield from commercial_report(commercial(folder))
    elif part == "short":
        yield from short_report(folder)
    elif part == "filtered":
        yield from filtered_report(folder)
    elif part == "corrected":
        yield from corrected_report(folder)
    else:
        yield from static_report()


PARTS: Final = ("short", "commercial", "corrected", "filtered", "static")


def main(arguments: Sequence[str]) -> int:
    if len(arguments) != 1 or arguments[0] not in PARTS:
        print(f"give one of {', '.join(PARTS)}", file=sys.stderr)
        return 2
    begin, busy = time.perf_counter(), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        for line in report(arguments[0], Path(folder)):
            print(line, flush=True)
    seconds = f"{time.perf_counter() - begin:.0f} s, {time.process_time() - busy:.0f} s of CPU"
    print(seconds, file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
