"""P1 3.2 and 3.3 on the simulated test line: figure 7, table 4 and figure 8.

The part ``test-line`` of `p1_experiment`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np

from p1_ride import Bench, Campaign, Found, Way, ridden, together
from railfix.simulate import Scenario
from railfix.simulate.sbas import SbasSettings
from railfix.simulate.scenario_file import load_recipe

#: Figure 7: mask of 30 degrees, nothing else; GPS, as its receiver of 2010.
FIGURE_7: Final = {"preset": "p1", "screens": ["elevation"], "elevation": {"mask_deg": 30.0}}
#: Table 4: mask of 20 degrees, the two antennas' positions within 5 m of their spacing.
TABLE_4: Final = {"preset": "p1", "screens": ["elevation", "antenna_spacing"]}
#: P1 table 4: rate, mean and standard deviation.
P1_TABLE_4: Final = {"G": (99.09, 2.14, 1.98), "G+J": (99.15, 1.97, 1.99), "G with L1-SAIF": (96.41, 0.88, 1.83)}
#: The service's own errors, as in the scenario commercial-full.
SERVICE: Final = SbasSettings(clock_sigma_m=0.1)
#: P1 table 3: its four days; two round trips of each are simulated here, GPS time.
DAYS: Final = tuple(np.datetime64(f"2011-12-{start}:30:15", "ns") for start in ("06T02", "07T03", "08T01", "12T04"))


def figure_7_scenario() -> Scenario:
    """Table 2: 2010/8/19, 12 min 34 s at 5 Hz, two round trips."""
    return load_recipe("p1-test-line").scenario().replaced(sensors=None)


def table_4_scenario(day: int) -> Scenario:
    """Table 3: two receivers at 10 Hz, antennas 18.14 m apart; one QZSS satellite, as there was then."""
    base = figure_7_scenario()
    vehicle = base.vehicle.replaced(front=(9.07, 0.25, 3.95), rear=(-9.07, 0.25, 3.95))
    sky = base.sky.replaced(unhealthy=(*base.sky.unhealthy, "J02", "J03", "J04"))
    return base.replaced(start=DAYS[day], seed=400 + day, rate_hz=10.0, vehicle=vehicle, sky=sky, sbas=SERVICE)


def figure_7() -> Campaign:
    """Conventional and constrained, front antenna looked at."""
    ways = (Way("conventional", FIGURE_7, "conventional"), Way("constrained", FIGURE_7))
    return ridden(Bench(figure_7_scenario(), "figure 7", ways, ("G",), None))


def table_4(days: Sequence[int] = range(len(DAYS))) -> Campaign:
    """GPS and GPS+QZS over the days, and with corrections of GPS as those of L1-SAIF."""
    ways = (Way("constrained", TABLE_4), Way("corrected", TABLE_4, sbas=True))
    return together([ridden(Bench(table_4_scenario(d), f"day {d + 1}", ways, ("G", "GJ"), None)) for d in days])


def size(found: Found, part: Any) -> str:
    """Horizontal error of some epochs."""
    value = found.horizontal_m[part & np.isfinite(found.error_m)]
    if not len(value):
        return f"{'-':>8s}{'-':>8s}{'-':>8s}"
    return f"{value.mean():8.2f}{np.quantile(value, 0.95):8.2f}{value.max():8.2f}"


def figure_7_lines(campaign: Campaign) -> Iterator[str]:
    """Horizontal error by minutes, and of the whole."""
    conventional, constrained = (campaign.found["G", way][0] for way in ("conventional", "constrained"))
    passage = campaign.passages[0]
    minute = (passage.time - passage.time[0]) // np.timedelta64(60, "s")
    yield "minute  chainage [m]   conventional [m]           constrained [m]"
    yield "                       mean     p95     max     mean     p95     max"
    for m in range(int(minute.max()) + 1):
        part = minute == m
        low, high = passage.chainage_m[part].min(), passage.chainage_m[part].max()
        yield f"{m:6d}  {low:5.0f} ..{high:5.0f} {size(conventional, part)} {size(constrained, part)}"
    whole = np.ones(len(minute), dtype=np.bool_)
    yield f"all                    {size(conventional, whole)[1:]} {size(constrained, whole)}"
    for name, found in (("conventional", conventional), ("constrained", constrained)):
        share = np.isfinite(found.error_m).mean()
        yield f"{name}: positions at {100 * share:.2f} % of {len(minute)} epochs"


def table_4_lines(campaign: Campaign) -> Iterator[str]:
    """Rate, mean and standard deviation of both antennas, P1's beside."""
    yield "                    rate %   mean [m]   std [m]   largest [m]   P1: rate %   mean    std"
    rows = (("G", "G", "constrained"), ("G+J", "GJ", "constrained"), ("G with L1-SAIF", "G", "corrected"))
    for name, letters, way in rows:
        error = np.concatenate([f.error_m for f in campaign.found[letters, way]])
        good = error[np.isfinite(error)]
        rate, mean, std = P1_TABLE_4[name]
        yield (
            f"{name:18s}{100 * len(good) / len(error):8.2f} {good.mean():+10.2f} {good.std():9.2f} "
            f"{np.abs(good).max():13.2f} {rate:12.2f} {mean:+6.2f} {std:6.2f}"
        )


def by_day_lines(campaign: Campaign) -> Iterator[str]:
    """Mean and standard deviation day by day: the means are the sky's, not the method's."""
    for letters in ("G", "GJ"):
        cells = []
        for run in dict.fromkeys(p.run for p in campaign.passages):
            pairs = zip(campaign.passages, campaign.found[letters, "constrained"], strict=True)
            error = np.concatenate([f.error_m for p, f in pairs if p.run == run])
            cells.append(f"{run} {np.nanmean(error):+.2f} / {np.nanstd(error):.2f}")
        yield f"{'+'.join(letters):6s} mean / std [m]: " + ", ".join(cells)


def figure_8_lines(campaign: Campaign, *, step_m: float = 60.0) -> Iterator[str]:
    """One way toward the end of the line: error and satellites, GPS and GPS+QZS."""
    passage = campaign.passages[0]
    end = int(np.argmax(passage.chainage_m))
    first = np.zeros(len(passage.time), dtype=np.bool_)
    first[:end] = True
    yield "chainage [m]   G: mean    std    sats    G+J: mean    std    sats"
    for low in np.arange(0.0, 756.0, step_m):
        part = first & (passage.chainage_m >= low) & (passage.chainage_m < low + step_m)
        cells = []
        for letters in ("G", "GJ"):
            found = campaign.found[letters, "constrained"][0]
            error = found.error_m[part]
            has = np.isfinite(error).any()
            mean, std = (np.nanmean(error), np.nanstd(error)) if has else (np.nan, np.nan)
            cells.append(f"{mean:+9.2f} {std:6.2f} {found.n_used[part].mean():7.1f}")
        yield f"{low:5.0f} ..{low + step_m:5.0f} {cells[0]}     {cells[1]}"


def line_report() -> Iterator[str]:
    """Figure 7, table 4, figure 8."""
    yield "figure 7: horizontal error of the front antenna, mask 30 deg"
    yield from figure_7_lines(figure_7())
    campaign = table_4()
    yield "\ntable 4: error along the line of both antennas, mask 20 deg, antennas within 5 m of their spacing"
    yield from table_4_lines(campaign)
    yield from by_day_lines(campaign)
    yield "\nfigure 8: the first way toward the end of the line, front antenna"
    yield from figure_8_lines(campaign)
