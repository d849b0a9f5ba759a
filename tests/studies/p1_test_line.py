"""P1 3.2 and 3.3 on the simulated test line: figure 7, table 4 and figure 8.

The part ``test-line`` of `p1_experiment`; ``figure-8`` writes the picture docs/pictures/p1-figure-8.png.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import paths
from p1_ride import Bench, Campaign, Found, Passage, Way, ridden, together
from p1_rtklib import ABSENT, PROGRAM
from railfix.core.arrays import Masks
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.simulate import Scenario, Simulation
from railfix.simulate.scenario_file import load_recipe
from railfix.simulate.settings import SbasSettings

PICTURE: Final = paths.ROOT / "docs" / "pictures" / "p1-figure-8.png"
#: Figure 7: mask of 30 degrees, nothing else; GPS, as its receiver of 2010.
FIGURE_7: Final = {"preset": "p1", "screens": ["elevation"], "elevation": {"mask_deg": 30.0}}
#: Table 4: mask of 20 degrees, the two antennas' positions within 5 m of their spacing.
TABLE_4: Final = {"preset": "p1", "screens": ["elevation", "antenna_spacing"]}
#: P1 table 4: rate, mean and standard deviation.
P1_TABLE_4: Final = {"G": (99.09, 2.14, 1.98), "G+J": (99.15, 1.97, 1.99), "G with L1-SAIF": (96.41, 0.88, 1.83)}
#: Its rows: systems and way.
TABLE_4_ROWS: Final = {"G": ("G", "constrained"), "G+J": ("GJ", "constrained"), "G with L1-SAIF": ("G", "corrected")}
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
    conventional = (Way("conventional", FIGURE_7, "conventional"), Way("RTKLIB", FIGURE_7, "rtklib"))
    ways = (*conventional, Way("constrained", FIGURE_7))
    return ridden(Bench(figure_7_scenario(), "figure 7", ways, ("G",), None))


def table_4(days: Sequence[int] = range(len(DAYS))) -> Campaign:
    """GPS and GPS+QZS over the days, and with corrections of GPS as those of L1-SAIF; RTKLIB's positions beside."""
    on_line = Way("constrained", TABLE_4), Way("corrected", TABLE_4, sbas=True)
    ways = (*on_line, Way("RTKLIB", TABLE_4, "rtklib"), Way("RTKLIB corrected", TABLE_4, "rtklib", sbas=True))
    return together([ridden(Bench(table_4_scenario(d), f"day {d + 1}", ways, ("G", "GJ"), None)) for d in days])


def size(found: Found, part: Any) -> str:
    """Horizontal error of some epochs."""
    value = found.horizontal_m[part & np.isfinite(found.error_m)]
    if not len(value):
        return f"{'-':>8s}{'-':>8s}{'-':>8s}"
    return f"{value.mean():8.2f}{np.quantile(value, 0.95):8.2f}{value.max():8.2f}"


def figure_7_lines(campaign: Campaign) -> Iterator[str]:
    """Horizontal error by minutes, and of the whole."""
    founds = {way: found[0] for (_, way), found in campaign.found.items()}
    passage = campaign.passages[0]
    minute = (passage.time - passage.time[0]) // np.timedelta64(60, "s")
    yield "minute  chainage [m]" + "".join(f"{way + ' [m]':>24s}" for way in founds)
    yield " " * 20 + "    mean     p95     max" * len(founds)
    for m in range(int(minute.max()) + 1):
        part = minute == m
        low, high = passage.chainage_m[part].min(), passage.chainage_m[part].max()
        yield f"{m:6d}  {low:5.0f} ..{high:5.0f}" + "".join(size(found, part) for found in founds.values())
    whole = np.ones(len(minute), dtype=np.bool_)
    yield f"{'all':20s}" + "".join(size(found, whole) for found in founds.values())
    for name, found in founds.items():
        share = np.isfinite(found.error_m).mean()
        yield f"{name}: positions at {100 * share:.2f} % of {len(minute)} epochs"


def table_4_lines(campaign: Campaign) -> Iterator[str]:
    """Rate, mean and standard deviation of both antennas, P1's beside."""
    yield "                        rate %   mean [m]   std [m]   largest [m]   P1: rate %   mean    std"
    for name, (letters, way) in TABLE_4_ROWS.items():
        for row, key in ((name, way), (f"  RTKLIB {name}", "RTKLIB corrected" if way == "corrected" else "RTKLIB")):
            if (letters, key) not in campaign.found:
                continue
            error = np.concatenate([f.error_m for f in campaign.found[letters, key]])
            good = error[np.isfinite(error)]
            theirs = "{:12.2f} {:+6.2f} {:6.2f}".format(*P1_TABLE_4[name]) if row == name else ""
            yield (
                f"{row:24s}{100 * len(good) / len(error):6.2f} {good.mean():+10.2f} {good.std():9.2f} "
                f"{np.abs(good).max():13.2f} {theirs}".rstrip()
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


def first_way(passage: Passage) -> Masks:
    """Epochs of the first way toward the end of the line."""
    return np.arange(len(passage.time)) < np.argmax(passage.chainage_m)


def figure_8_lines(campaign: Campaign, *, step_m: float = 60.0) -> Iterator[str]:
    """Error and satellites used on the first way toward the end of the line, by chainage."""
    passage = campaign.passages[0]
    yield "chainage [m]" + "".join(f"{name + ': mean    std  sats':>34s}" for name in TABLE_4_ROWS)
    for low in np.arange(0.0, 756.0, step_m):
        part = first_way(passage) & (passage.chainage_m >= low) & (passage.chainage_m < low + step_m)
        cells = []
        for key in TABLE_4_ROWS.values():
            found = campaign.found[key][0]
            good = found.error_m[part][np.isfinite(found.error_m[part])]
            mean, std = (good.mean(), good.std()) if len(good) else (np.nan, np.nan)
            cells.append(f"{mean:+22.2f} {std:6.2f}{found.n_used[part].mean():5.1f}")
        yield f"{low:5.0f} ..{low + step_m:5.0f}" + "".join(cells)


def figure_8() -> Figure:
    """P1's figure 8 on the first way of the first day: errors along the line, the line itself, and the sky."""
    simulation = Simulation(table_4_scenario(0))
    campaign = table_4((0,))
    passage = campaign.passages[0]
    part = first_way(passage) & (passage.speed_mps > 0.0)
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, height_ratios=(3, 2))
    errors, plan, sky = (
        figure.add_subplot(grid[0, :]), figure.add_subplot(grid[1, 0]), figure.add_subplot(grid[1, 1], polar=True),
    )  # fmt: skip
    for name, key in TABLE_4_ROWS.items():
        errors.plot(passage.chainage_m[part], campaign.found[key][0].error_m[part], ".", ms=2.0, label=name)
    errors.set(xlabel="chainage [m]", ylabel="error along the line [m]")
    errors.grid(alpha=0.3)
    errors.legend(markerscale=5.0)
    draw_line(plan, simulation, passage, part)
    draw_sky(sky, simulation, middle=int(np.flatnonzero(part)[part.sum() // 2]))
    return figure


def draw_line(axes: Axes, simulation: Simulation, passage: Passage, part: Masks) -> None:
    """Plan of the way, a mark each 100 m."""
    latitude, longitude, _ = geodetic_from_ecef(passage.ecef_m[part][0])
    east, north, _ = enu_axes(latitude, longitude) @ (passage.ecef_m[part] - passage.ecef_m[part][0]).T
    axes.plot(east, north, color="#404040")
    chainage = passage.chainage_m[part]
    for mark in np.arange(100.0, chainage[-1], 100.0):
        k = int(np.argmin(np.abs(chainage - mark)))
        axes.annotate(f"{mark:.0f}", (east[k], north[k]), fontsize="small")
    axes.set(xlabel="east [m]", ylabel="north [m]", aspect="equal", title=simulation.scenario.line.name)


def draw_sky(axes: Axes, simulation: Simulation, *, middle: int) -> None:
    """Satellites over the mask of 20 degrees at an epoch."""
    before = 0
    for piece in simulation.pieces("front"):
        count = len(piece.observations)
        if middle < before + count:
            break
        before += count
    t = middle - before
    elevation, azimuth = piece.geometry.elevation_deg[t], piece.geometry.azimuth_deg[t]
    for name, up, around, code in zip(
        piece.observations.satellite, elevation, azimuth, piece.observations.code_m[t], strict=True
    ):
        if up >= 20.0 and np.isfinite(code) and name[0] in "GJ":
            axes.plot(np.radians(around), 90.0 - up, "o", color="#d55e00" if name[0] == "J" else "#0072b2")
            axes.annotate(name, (np.radians(around), 90.0 - up), fontsize="small")
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_rlim(0.0, 70.0)
    axes.set_rgrids((0.0, 30.0, 60.0), ("90", "60", "30"))


def line_report() -> Iterator[str]:
    """Figure 7, table 4, figure 8."""
    if PROGRAM is None:
        yield ABSENT
    yield "figure 7: horizontal error of the front antenna, mask 30 deg"
    yield from figure_7_lines(figure_7())
    campaign = table_4()
    yield "\ntable 4: error along the line of both antennas, mask 20 deg, antennas within 5 m of their spacing"
    yield from table_4_lines(campaign)
    yield from by_day_lines(campaign)
    yield "\nfigure 8: the first way toward the end of the line, front antenna"
    yield from figure_8_lines(campaign)
