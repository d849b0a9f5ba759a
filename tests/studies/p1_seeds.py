"""P1 chapter 5 on lines that nothing was chosen on, with intervals, and without each screen in turn.

Run ``python tests/studies/p1_seeds.py PART`` for the tables of docs/paper-experiments.md:

======== ===========================================================================
seeds    the first ten minutes of twenty lines and places of seeds of their own: station, tall buildings, town
city     twenty runs of the scenario `city`, whose surroundings are fitted to recordings, of the same seeds
screens  the lines of P1's chapter 5 with preset `p1`, each screen left out in turn
======== ===========================================================================
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from p1_experiment import (
    DEFAULT,
    FILTERED,
    GOAL_M,
    HEAD,
    WAYS,
    YARDSTICK,
    commercial,
    everywhere,
    extent,
    main_table,
    row,
)
from p1_ride import Bench, Campaign, Way, cn0_curve, ridden, together
from p1_rtklib import ABSENT, PROGRAM
from railfix.core.arrays import Floats
from railfix.screens import SCREENS
from railfix.simulate.scenario_file import load_recipe

#: Seeds that no setting was chosen on.
SEEDS: Final = tuple(range(501, 521))
SYSTEMS: Final = ("G", "GJ")
DURATION_S: Final = 600.0
#: Conventional, RTKLIB's and railfix's positions.
SEED_WAYS: Final = (*WAYS[:3], Way("p1", {"preset": "p1"}), Way("strict", DEFAULT, "checked", largest_sigma_m=10.0))
#: In the city the filter too; GPS, and with BeiDou as its receivers have it.
CITY_WAYS: Final = (*SEED_WAYS, Way("filter", FILTERED, "filtered"))
CITY_SYSTEMS: Final = ("G", "GC")
#: Without each screen of P1 in turn.
_NAMES: Final = tuple(screen.name for screen in SCREENS)
SCREEN_WAYS: Final = (
    YARDSTICK,
    Way("p1", {"preset": "p1"}),
    *(
        Way(f"without {name}", {"preset": "p1", "screens": [n for n in _NAMES if n != name]})
        for name in _NAMES
        if name != "elevation"
    ),
)
#: Draws of the bootstrap over the lines.
_DRAWS: Final = 4000
PARTS: Final = ("seeds", "city", "screens")


def interval(values: Floats, weights: Floats) -> tuple[float, float, float]:
    """Weighted mean over lines, and 95 % of it by drawing lines again."""
    drawn = np.random.default_rng(1).integers(0, len(values), (_DRAWS, len(values)))
    means = (values * weights)[drawn].sum(axis=1) / weights[drawn].sum(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    return float(np.average(values, weights=weights)), float(low), float(high)


def seeds_report(campaigns: Sequence[Campaign]) -> Iterator[str]:
    """Rate, share of large errors and largest error over the lines, with intervals over lines."""
    yield f"{len(campaigns)} lines; {extent(together(campaigns))}"
    if PROGRAM is None:
        yield ABSENT
    yield (
        f"{'':21s}{'rate % (95 % over lines)':>27s}{'over 10 m, per 10 000':>27s}"
        f"{'largest [m]: median, least, most':>36s}  lines under 10 m"
    )
    for letters, name in campaigns[0].found:
        rate, large, most, observed = [], [], [], []
        for one in campaigns:
            error = np.concatenate([f.error_m for f in one.found[letters, name]])
            seen = np.concatenate([p.observed for p in one.passages])
            size = np.abs(error[np.isfinite(error)])
            observed.append(np.count_nonzero(seen))
            rate.append(100.0 * np.count_nonzero(np.isfinite(error) & seen) / observed[-1])
            large.append(1e4 * np.count_nonzero(size > GOAL_M) / len(size))
            most.append(size.max())
        cells = [
            "{:.2f} ({:.2f} .. {:.2f})".format(*interval(np.array(values), np.array(observed, dtype=float)))
            for values in (rate, large)
        ]
        spread = f"{np.median(most):.1f}, {min(most):.1f} .. {max(most):.1f}"
        under = sum(value < GOAL_M for value in most)
        yield f"{'+'.join(letters):7s}{name:14s}{cells[0]:>27s} {cells[1]:>26s}{spread:>36s}  {under:d} of {len(most)}"


def screens_report(campaign: Campaign) -> Iterator[str]:
    """What each screen of P1 brings on the lines of its chapter 5."""
    yield extent(campaign)
    yield from HEAD.splitlines()
    for letters, way in campaign.found:
        found, base = campaign.found[letters, way], campaign.found[letters, YARDSTICK.name]
        yield row(f"{'+'.join(letters):4s} {way}", campaign.passages, found, base, everywhere)


def report(part: str, folder: Path) -> Iterator[str]:
    """The lines of one part."""
    if part == "screens":
        yield from screens_report(commercial(folder, ways=SCREEN_WAYS, systems=SYSTEMS))
        return
    make = city if part == "city" else first_minutes
    campaigns = []
    for number, seed in enumerate(SEEDS):
        campaigns.append(make(folder, number))
        print(f"seed {seed}", file=sys.stderr, flush=True)
    yield from seeds_report(campaigns)
    if part == "city":
        yield "\nall lines"
        yield from main_table(together(campaigns), everywhere)


def first_minutes(folder: Path, number: int) -> Campaign:
    """First minutes of a run of the scenario p1-commercial on a line and place of a seed."""
    return commercial(folder, (number % 4,), SEEDS[number], SEED_WAYS, SYSTEMS, DURATION_S)


def city(folder: Path, number: int) -> Campaign:
    """Run of the scenario city on a line and place of a seed."""
    seed = SEEDS[number]
    changes = {"seed": seed, "place_seed": seed, "line": {"generated": {"seed": seed}}}
    scenario = load_recipe("city").scenario(changes=changes)
    return ridden(Bench(scenario, f"city-{seed}", CITY_WAYS, CITY_SYSTEMS, cn0_curve(folder, "city")))


def main(arguments: Sequence[str]) -> int:
    if len(arguments) != 1 or arguments[0] not in PARTS:
        print(f"give one of {', '.join(PARTS)}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        for line in report(arguments[0], Path(folder)):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
