"""Charts of protection levels: against the error (Stanford diagram), and over time with what they are made of."""

from __future__ import annotations

from collections import Counter
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.integrity.stanford import Region, Stanford
from railfix.report.plots.chart import BLACK, BLUE, CYCLE, GREY, RED, Cells, Chart, Curve, Layer, Marks, Points
from railfix.report.plots.columns import floats, since, start_of, words
from railfix.report.plots.thinning import counts_sentence, spread

#: Parts of the level, and the level itself.
_PARTS: Final = (
    ("fault-free part", "protection_fault_free_m"),
    ("part of one fault", "protection_one_fault_m"),
    ("part of two faults", "protection_two_faults_m"),
    ("RAIM's level", "raim_level_m"),
    ("level", "protection_level_m"),
)


#: Regions with the words that stand in the picture, and where: from 0 to the alarm limit, and on to the end (1 to 2).
_REGIONS: Final = (
    (Region.NOMINAL, "nominal", 0.35, 0.78),
    (Region.MISLEADING, "misleading", 0.7, 0.24),
    (Region.HAZARDOUS, "hazardously\nmisleading", 1.5, 0.5),
    (Region.UNAVAILABLE, "unavailable", 0.6, 1.7),
    (Region.UNAVAILABLE_MISLEADING, "unavailable,\nmisleading", 1.7, 1.28),
)


def stanford(diagram: Stanford, *, title: str = "Stanford diagram") -> Chart:
    """Protection level over the size of the error, counted in cells, with the epochs of each region written into it.

    Values beyond the axes stand in their last cells. The darkness of a cell grows with the logarithm of its epochs.
    """
    width = diagram.edges_m[1] - diagram.edges_m[0]
    edges = np.append(diagram.edges_m[:-1], diagram.edges_m[-2] + width)
    top, limit = float(edges[-1]), diagram.alarm_limit_m
    judged = int(diagram.histogram.sum())
    regions = ", ".join(
        f"{region.name.lower().replace('_', ' and ')} {diagram.counts[region]:,}"
        f" ({100 * diagram.counts[region] / max(judged, 1):.3f} %)"
        for region, *_ in _REGIONS
    )
    kept = "; ".join(
        f"{c.window_s:g} s {100 * c.probability:.2f} %" for c in diagram.continuity if np.isfinite(c.probability)
    )
    line, across = np.array([0.0, top]), np.array([limit, limit])
    return Chart(
        name="stanford",
        title=title,
        caption=f"{judged:,} epochs with an error: {regions}. Available: {100 * diagram.available_rate:.2f} % of all "
        f"epochs{'; available windows that stay so: ' + kept if kept else ''}. Right of the diagonal the error exceeds "
        f"the level. Values above {top:g} m, infinite levels among them, are in the last cells. Darker cells have more "
        "epochs, on a logarithmic scale.",
        x_label="size of the error along the line [m]",
        y_label="protection level [m]",
        layers=(
            Cells(label="epochs", colour=BLACK, x_edges=edges, y_edges=edges, counts=diagram.histogram),
            Curve(label="error = level", colour=GREY, x=line, y=line),
            Curve(label=f"alarm limit {limit:g} m", colour=RED, x=line, y=across, dash="dashed"),
            Curve(label="", colour=RED, x=across, y=np.array([0.0, limit]), dash="dashed"),
            _regions(diagram, top),
        ),
        x_range=(0.0, top),
        y_range=(0.0, top),
        width="half",
    )


def _regions(diagram: Stanford, top_m: float) -> Marks:
    """The regions that the axes show, by name and epochs."""
    limit = diagram.alarm_limit_m

    def place(value: float) -> float:
        return limit * min(value, 1.0) + max(value - 1.0, 0.0) * (top_m - limit)

    shown = [region for region in _REGIONS if top_m > 1.2 * limit or max(region[2:]) < 1.0]
    return Marks(
        label="",
        colour=BLACK,
        x=np.array([place(x) for _, _, x, _ in shown]),
        y=np.array([place(y) for _, _, _, y in shown]),
        words=tuple(f"{name}\n{diagram.counts[region]:,}" for region, name, _, _ in shown),
        place="on",
    )


def levels_over_time(positions: pl.DataFrame, alarm_limit_m: float, *, title: str = "Protection level") -> Chart:
    """Protection level and its parts over time, against the alarm limit; empty where the run has no levels.

    Parameters
    ----------
    positions : polars.DataFrame
        Of one antenna, columns of `railfix.pipeline.result_columns.POSITION_COLUMNS`.
    alarm_limit_m : float [m]
    title : str
    """
    start = start_of(positions)
    x = since(positions, start)
    return _levels(positions, x, alarm_limit_m, name="levels", title=title, x_label="GPS time", start=start)


def levels_over_chainage(
    positions: pl.DataFrame, alarm_limit_m: float, *, title: str = "Protection level over chainage"
) -> Chart:
    """The same over the chainage of the positions; those without a position are left out."""
    x = floats(positions, "chainage_m")
    x_label = "chainage of the position [m]"
    return _levels(positions, x, alarm_limit_m, name="levels-chainage", title=title, x_label=x_label, start=None)


def _levels(
    positions: pl.DataFrame,
    x: Floats,
    alarm_limit_m: float,
    *,
    name: str,
    title: str,
    x_label: str,
    start: np.datetime64 | None,
) -> Chart:
    layers: list[Layer] = []
    shown = total = 0
    largest = alarm_limit_m
    epoch = since(positions, start_of(positions))
    for (label, column), colour in zip(_PARTS, (*CYCLE[2:6], BLUE), strict=True):
        level = floats(positions, column)
        level = np.where(np.isfinite(level + x), level, np.nan)
        rows = spread(x, level)
        if not len(rows) or not (level[rows] > 0.0).any():
            continue
        shown, total = shown + len(rows), total + int(np.isfinite(level).sum())
        largest = max(largest, float(np.percentile(level[rows], 98.0)))
        layers.append(Points(label=label, colour=colour, x=x[rows], y=level[rows], size=2.5, epoch_s=epoch[rows]))
    if layers:
        line = np.array([np.nanmin(x), np.nanmax(x)])
        limit = np.full(2, alarm_limit_m)
        layers.append(Curve(label=f"alarm limit {alarm_limit_m:g} m", colour=RED, x=line, y=limit, dash="dashed"))
    infinite = int(np.isinf(floats(positions, "protection_level_m")).sum())
    caption = [_count(positions), f"Values beyond {1.2 * largest:.1f} m are cut off"]
    caption[1] += f", {infinite:,} levels are infinite and not drawn." if infinite else "."
    if any(label in {layer.label for layer in layers} for label, _ in _PARTS[:3]):
        caption.append(
            "Each part spends its share of the risk alone; the level spends the whole and can be below a part."
        )
    return Chart(
        name=name,
        title=title,
        caption=" ".join(caption).strip() + counts_sentence(shown, total),
        x_label=x_label,
        y_label="protection level [m]",
        layers=tuple(layers),
        start=start,
        y_range=(0.0, 1.2 * largest),
    )


def _count(positions: pl.DataFrame) -> str:
    """Epochs by status and cause of the level, in words."""
    sentences = []
    for column, what in (("protection_status", "Epochs"), ("protection_cause", "What sets the level")):
        if column in positions.columns:
            counts = Counter(words(positions, column).tolist())
            listed = ", ".join(f"{word or 'none'} {count:,}" for word, count in counts.most_common())
            sentences.append(f"{what}: {listed}.")
    return " ".join(sentences)
