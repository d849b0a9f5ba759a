"""Picture of links: response rate by place and running direction, round trips over time and over place."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.ground.link_quality import LinkMeter, LinkName

ANSWERED: Final = "#0b6e99"
MISSED: Final = "#e5989b"


def coverage(meters: Iterable[LinkMeter]) -> dict[int, dict[int, tuple[int, int]]]:
    """Return answered and sent frames by direction and place, summed over meters of one bearer."""
    total: dict[int, dict[int, tuple[int, int]]] = defaultdict(dict)
    for meter in meters:
        for (place, direction), (answered, sent) in meter.coverage.items():
            before = total[direction].get(place, (0, 0))
            total[direction][place] = (before[0] + answered, before[1] + sent)
    return dict(total)


def round_trips(meters: Iterable[LinkMeter]) -> tuple[Floats, Floats, Floats]:
    """Return time from the first frame [s], chainage [m] and round trip [s] of all frames, NaN: not answered."""
    results = sorted(result for meter in meters for result in meter.results)
    table = np.array(results, dtype=np.float64).reshape(-1, 3)
    return table[:, 0] - table[:1, 0].sum(), table[:, 1], table[:, 2]


def draw_coverage(path: Path, bearers: Mapping[LinkName, list[LinkMeter]]) -> None:
    """Draw the links of trains, by bearer.

    A row for each bearer and direction with the response rate along the line (P5, figure 7); and one for each bearer
    with the round trips over time and over place (P5, figures 9 and 10), unanswered frames at the foot.
    """
    from matplotlib.figure import Figure

    rows = [
        (f"bearer {name}, {'rising' if direction > 0 else 'falling'}", places, meters[0].limits.place_m)
        for name, meters in bearers.items()
        for direction, places in sorted(coverage(meters).items(), reverse=True)
    ]
    figure = Figure(figsize=(10, 1.2 + 1.1 * len(rows) + 1.8 * len(bearers)), layout="constrained")
    grid = figure.add_gridspec(2, 1, height_ratios=[max(1.1 * len(rows), 1.1), 1.8 * len(bearers)])
    rates, trips = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])
    for axes, (label, places, step) in zip(
        rates.subplots(max(len(rows), 1), 1, sharex=True, squeeze=False)[:, 0], rows, strict=False
    ):
        for place, (answered, sent) in places.items():
            rate = answered / sent
            axes.bar((place + 0.5) * step, 100.0 * rate, width=step, color=ANSWERED, linewidth=0)
            axes.bar((place + 0.5) * step, 100.0 * (1.0 - rate), width=step, bottom=100.0 * rate, color=MISSED)
        axes.set(ylabel="%", ylim=(0, 100), title=label)
    rates.supxlabel("chainage of the front [m]")
    rates.suptitle("Response rate along the line: answered (blue), not answered (red)")
    pairs = trips.subplots(len(bearers), 2, sharex="col", sharey=True, squeeze=False)
    for (name, meters), both in zip(bearers.items(), pairs, strict=True):
        sent_s, chainage_m, trip_s = round_trips(meters)
        missed = np.isnan(trip_s)
        for axes, over in zip(both, (sent_s, chainage_m), strict=True):
            axes.plot(over[~missed], 1e3 * trip_s[~missed], ".", color=ANSWERED, markersize=3)
            axes.plot(over[missed], np.zeros(np.count_nonzero(missed)), "|", color=MISSED, markersize=8)
        both[0].set(ylabel=f"bearer {name} [ms]")
    pairs[-1, 0].set(xlabel="time [s]")
    pairs[-1, 1].set(xlabel="chainage of the front [m]")
    trips.suptitle("Round trip over time and place; not answered (red)")
    figure.savefig(path, dpi=110)
