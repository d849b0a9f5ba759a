"""Picture of the coverage of links: response rate by place and running direction."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

from railfix.ground.link_quality import LinkMeter, LinkName


def coverage(meters: Iterable[LinkMeter]) -> dict[int, dict[int, tuple[int, int]]]:
    """Return answered and sent frames by direction and place, summed over meters of one bearer."""
    total: dict[int, dict[int, tuple[int, int]]] = defaultdict(dict)
    for meter in meters:
        for (place, direction), (answered, sent) in meter.coverage.items():
            before = total[direction].get(place, (0, 0))
            total[direction][place] = (before[0] + answered, before[1] + sent)
    return dict(total)


def draw_coverage(path: Path, bearers: Mapping[LinkName, list[LinkMeter]]) -> None:
    """Draw the response rate along the line, a row for each bearer and direction (P5, figure 7)."""
    from matplotlib.figure import Figure

    rows = [
        (f"bearer {name}, {'rising' if direction > 0 else 'falling'}", places, meters[0].limits.place_m)
        for name, meters in bearers.items()
        for direction, places in sorted(coverage(meters).items(), reverse=True)
    ]
    figure = Figure(figsize=(10, 1.2 + 1.1 * len(rows)), layout="constrained")
    for axes, (label, places, step) in zip(
        figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0], rows, strict=True
    ):
        for place, (answered, sent) in places.items():
            rate = answered / sent
            axes.bar((place + 0.5) * step, 100.0 * rate, width=step, color="#0b6e99", linewidth=0)
            axes.bar((place + 0.5) * step, 100.0 * (1.0 - rate), width=step, bottom=100.0 * rate, color="#e5989b")
        axes.set(ylabel="%", ylim=(0, 100), title=label)
    figure.supxlabel("chainage of the front [m]")
    figure.suptitle("Response rate along the line: answered (blue), not answered (red)")
    figure.savefig(path, dpi=110)
