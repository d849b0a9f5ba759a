"""Table and picture of docs/paper-experiments.md from the kept outputs.

``python tests/studies/p1_page.py`` writes both.

The table is that of P1's chapter 5 (ways without tunnels). The picture docs/pictures/p1-lines.png shows, of twenty
lines each, the share of errors over 10 m with its 95 % interval, and the largest error.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from matplotlib.figure import Figure

import paths

PAGE: Final = paths.ROOT / "docs" / "paper-experiments.md"
PICTURE: Final = paths.ROOT / "docs" / "pictures" / "p1-lines.png"
RESULTS: Final = paths.ROOT / "tests" / "references" / "results"
#: Columns of a row of figures (`p1_experiment.HEAD`): rate, points lost, p95, largest, errors over 10 m.
_COLUMNS: Final = (0, 2, 6, 8, 9)
_CHECKED: Final = ("conventional", "validated", "RTKLIB")
SINGLE: Final = (*_CHECKED, "p1", "strict")
#: Part, systems as printed, ending of the ways' names, ways.
_BLOCKS: Final = (
    ("commercial", "G", "", (*_CHECKED, "constrained", "p1", "strict")),
    ("corrected", "G", ", SBAS", SINGLE),
    ("commercial", "G+J", "", SINGLE),
    ("commercial", "G+J+E", "", SINGLE),
    ("filtered", "G+J", "", ("filter",)),
    ("filtered", "G+J+E", "", ("filter", "filter, wheel, inertial")),
)
#: Parts with twenty lines each, and the titles of their panels.
PARTS: Final = {"seeds": "twenty lines", "city": "twenty lines in a city"}
_COLOURS: Final = ("#0072b2", "#d55e00")
_LINE: Final = re.compile(
    r"(?P<systems>\S+) +(?P<way>\S+) +[\d.]+ \([^)]*\) +(?P<mean>[\d.]+) \((?P<low>[\d.]+) \.\. (?P<high>[\d.]+)\) +"
    r"(?P<median>[\d.]+), (?P<least>[\d.]+) \.\. (?P<most>[\d.]+) "
)


class Lines(NamedTuple):
    """Twenty lines of a way: errors over 10 m of 10 000 (mean, 95 % interval), largest error (median, least, most)."""

    systems: str
    way: str
    share: tuple[float, float, float]
    largest_m: tuple[float, float, float]


def kept(part: str) -> str:
    """Kept output of a part of P1's experiment."""
    return (RESULTS / f"p1-{part}.txt").read_text(encoding="utf-8")


def figures(part: str, heading: str, name: str) -> list[str]:
    """Figures of a way in the first table under a heading of a part."""
    block = kept(part).split(heading, 1)[1]
    return next(line for line in block.splitlines() if line.startswith(name)).removeprefix(name).split()


def table() -> Iterator[str]:
    """Lines of the table."""
    yield "| systems | method | rate %, points lost | p95, largest m | over 10 m |"
    yield "|---|---|---|---|---:|"
    yield "| P1, MSAS | conventional | 86.7 | 65.8 | |"
    yield "| | map and screens | 84.6, 2.1 | 10.2 | |"
    for part, systems, ending, ways in _BLOCKS:
        for number, way in enumerate(ways):
            found = figures(part, "ways without tunnels", f"{systems:7s} {way}{ending} ")
            first = systems + ending if number == 0 else ""
            rate, lost, p95, largest, over = (found[k].replace("+", "") for k in _COLUMNS)
            cells = [first, way, f"{rate}, {lost}", f"{p95}, {largest}", over]
            yield f"| {' | '.join(cells)} |".replace("|  |", "| |")


def page(text: str) -> str:
    """Page with the table as it is now."""
    lines = text.splitlines()
    first = next(k for k, line in enumerate(lines) if line.startswith("|"))
    after = next(k for k in range(first, len(lines)) if not lines[k].startswith("|"))
    return "\n".join([*lines[:first], *table(), *lines[after:]]) + "\n"


def lines_of(part: str) -> list[Lines]:
    """Figures of the twenty lines of a part."""
    found = []
    for line in kept(part).splitlines():
        if match := _LINE.match(line):
            share, largest = (
                (float(match[a]), float(match[b]), float(match[c]))
                for a, b, c in (("mean", "low", "high"), ("median", "least", "most"))
            )
            found.append(Lines(match["systems"], match["way"], share, largest))
    return found


def draw() -> Figure:
    """Share of large errors and largest error of twenty lines each, way by way."""
    figure = Figure(figsize=(8.0, 0.5 + 2.3 * len(PARTS)), layout="constrained")
    panels = figure.subplots(len(PARTS), 2, sharex="col", squeeze=False)
    for row, (part, title) in zip(panels, PARTS.items(), strict=True):
        found = lines_of(part)
        ways = list(dict.fromkeys(one.way for one in found))
        for number, systems in enumerate(dict.fromkeys(one.systems for one in found)):
            own = [one for one in found if one.systems == systems]
            height = [ways.index(one.way) + 0.25 * number - 0.12 for one in own]
            for axes, name in zip(row, ("share", "largest_m"), strict=True):
                middle, low, high = zip(*(getattr(one, name) for one in own), strict=True)
                axes.hlines(height, low, high, color=_COLOURS[number], lw=2.0)
                axes.plot(middle, height, "o", ms=4.0, color=_COLOURS[number], label=systems)
        for axes in row:
            axes.set_yticks(range(len(ways)), ways)
            axes.invert_yaxis()
            axes.grid(alpha=0.3)
            axes.set_title(title, fontsize="medium")
        row[0].set_xscale("symlog", linthresh=1.0)
        row[1].set_xscale("log")
        row[1].axvline(10.0, color="#808080", lw=0.8)
        row[1].legend(loc="lower right")
    panels[-1, 0].set_xlim(left=0.0)
    panels[-1, 0].set_xlabel("errors over 10 m, of 10 000 (95 % interval)")
    panels[-1, 1].set_xlabel("largest error of a line [m] (least to most)")
    return figure


def main() -> int:
    """Write table and picture."""
    Path(PAGE).write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    draw().savefig(PICTURE, dpi=100, metadata={"Software": None})
    return 0


if __name__ == "__main__":
    sys.exit(main())
