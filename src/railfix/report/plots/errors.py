"""Charts of errors and of protection levels.

Tables of errors have one row per epoch of one antenna, as in `railfix.evaluate.Evaluation.epochs`, with the columns
``time_gpst``, ``chainage_m`` (of the reference), ``error_m`` and ``conventional_error_m`` (positive toward the end of
the line), and optionally ``status``, ``along_sigma_m``, ``reference_good`` and columns of protection levels.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.core.notebook import plural
from railfix.evaluate.accuracy import PASSED
from railfix.evaluate.epoch_table import level_columns
from railfix.integrity.stanford import Region, Stanford
from railfix.report.plots.chart import (
    BLACK,
    BLUE,
    CONSTRAINED,
    CONVENTIONAL,
    CYCLE,
    FILTERED,
    GREEN,
    GREY,
    PURPLE,
    RED,
    Band,
    Cells,
    Chart,
    Curve,
    Layer,
    Marks,
    Points,
    RangeBars,
    find_start,
    floats,
    nice_step,
    since,
    thin_points,
    words,
)

_ERROR_LABEL: Final = "error along the line [m]"
_SIGN: Final = "Positive errors are toward the end of the line."
#: The x axis is divided into this number of pieces; the largest sigma and protection level of each piece are drawn.
_PIECES: Final = 600
_SERIES: Final = (
    ("conventional", "conventional_error_m", CONVENTIONAL, "square"),
    ("single epochs", "error_m", CONSTRAINED, "dot"),
)


def error_over_time(errors: pl.DataFrame, *, filtered: pl.DataFrame | None = None) -> Chart:
    """Return a chart of the errors of positions on the map and of conventional positions (P1 figures 7 and 10).

    The chart also shows the stated sigma and the protection level of single epochs.

    Both tables refer to the same antenna, and are in order of time. `filtered` has the errors of the filter along the
    track.
    """
    return _errors(errors, filtered, find_start(errors))


def error_over_chainage(errors: pl.DataFrame, *, filtered: pl.DataFrame | None = None) -> Chart:
    """Return the chart of `error_over_time` with the chainage of the reference as x axis (P1 figure 8)."""
    return _errors(errors, filtered, None)


def _errors(errors: pl.DataFrame, filtered: pl.DataFrame | None, start: np.datetime64 | None) -> Chart:
    """Return a chart of errors over the time since `start`, or over chainage if `start` is None."""

    def axis(table: pl.DataFrame) -> Floats:
        return floats(table, "chainage_m") if start is None else since(table, start)

    x = axis(errors)
    layers: list[Layer] = []
    caption = [_SIGN]
    at, sigma = _greatest(x, floats(errors, "along_sigma_m"))
    if len(at):
        layers.append(Band(label="± sigma of single epochs", colour=CONSTRAINED, x=at, low=-sigma, high=sigma))
        caption.append("The band is the largest stated sigma of single epochs in each short piece of the axis.")
    levels = []
    drawn_levels = [name for name in level_columns(errors) if np.isfinite(floats(errors, name)).any()]
    for column, colour in zip(drawn_levels, (PURPLE, GREEN, BLACK, GREY), strict=False):
        level = floats(errors, column)
        at, most = _greatest(x, np.where(np.isfinite(level), level, np.nan))
        if len(at):
            levels.append(most)
            name_of = "protection level" if len(drawn_levels) == 1 else column.removesuffix("_m").replace("_", " ")
            for sign, label in ((1.0, f"± {name_of} of single epochs"), (-1.0, "")):
                layers.append(Curve(label=label, colour=colour, x=at, y=sign * most, width=1.0, dash="dashed"))
            caption.append(
                f"The {name_of} of single epochs is finite at {100 * np.isfinite(level).mean():.1f} % of the epochs."
            )
    failed = errors.filter(~pl.col("status").is_in(PASSED)) if "status" in errors.columns else errors.clear()
    passed = errors.join(failed.select("time_gpst"), on="time_gpst", how="anti") if len(failed) else errors
    series = [(*entry, table) for entry, table in zip(_SERIES, (errors, passed), strict=True)]
    if failed["error_m"].is_not_null().any():
        series.append(("single epochs, failed a check", "error_m", BLACK, "cross", failed))
    if filtered is not None:
        series.append(("filter along the track", "error_m", FILTERED, "dot", filtered))
    drawn, thinned = thin_points(
        Points(
            label=label, colour=colour, shape=shape, x=axis(table), y=good_errors(table, column),  # type: ignore[arg-type]
            epoch_s=since(table, find_start(errors)),
        )
        for label, column, colour, shape, table in series
    )  # fmt: skip
    layers += drawn
    every = np.concatenate([good_errors(table, column) for _, column, _, _, table in series])
    scale = error_scale(every)
    if scale["y_scale"] == "symlog":
        caption.append(f"The scale is logarithmic beyond ± {scale['y_linear']:g} m.")
    if levels and np.isfinite(every).any():
        # a few large levels would make the errors too small to read; the axis ends above errors and median level
        top = 1.25 * max(float(np.nanmax(np.abs(every))), *(float(np.nanmedian(most)) for most in levels))
        scale["y_range"] = (-top, top)
        if max(float(np.nanmax(most)) for most in levels) > top:
            caption.append(f"Levels beyond ± {top:.1f} m are cut off.")
    quantity = "chainage" if start is None else "time"
    return Chart(
        name=f"error-{quantity}",
        title=f"Error along the line over {quantity}",
        caption=" ".join(caption) + thinned,
        x_label="chainage of the reference [m]" if start is None else "GPS time",
        y_label=_ERROR_LABEL,
        layers=tuple(layers),
        start=start,
        **scale,
    )


def good_errors(errors: pl.DataFrame, column: str) -> Floats:
    """Return the errors in a column [m]; NaN where the column ``reference_good``, if there is one, is false."""
    values = floats(errors, column)
    return np.where(errors["reference_good"].to_numpy(), values, np.nan) if "reference_good" in errors else values


def error_scale(error_m: Floats) -> dict[str, Any]:
    """Return the fields of `Chart` for the scale of an error axis; the scale is symlog if a few errors are outliers."""
    size = np.abs(error_m[np.isfinite(error_m)])
    if not len(size):
        return {"y_scale": "linear"}
    usual, largest = float(np.percentile(size, 98)), float(size.max())
    if largest <= 8.0 * max(usual, 0.5):
        return {"y_scale": "linear"}
    return {"y_scale": "symlog", "y_linear": nice_step(max(usual, 1.0))}


def _greatest(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the centre of each piece of the x axis that has data, and the largest y in the piece; NaN marks gaps."""
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if not len(rows):
        return np.empty(0), np.empty(0)
    low, high = float(x[rows].min()), float(x[rows].max())
    width = ((high - low) or 1.0) / _PIECES
    piece = np.minimum(((x[rows] - low) / width).astype(np.intp), _PIECES - 1)
    most = np.full(_PIECES, np.nan)
    np.fmax.at(most, piece, y[rows])
    here = np.isfinite(most)
    # isolated empty pieces are not gaps: they are due to the spacing of the epochs
    inside = np.flatnonzero(here)
    spacing = np.percentile(np.diff(inside), 98) if len(inside) > 1 else 1.0
    gap = np.flatnonzero(np.diff(inside) > 3 * spacing)
    middle = low + (inside + 0.5) * width
    return np.insert(middle, gap + 1, np.nan), np.insert(most[inside], gap + 1, np.nan)


def error_ranges(runs: Mapping[str, pl.DataFrame]) -> Chart:
    """Return a chart of the minimum, mean and maximum errors of constrained and conventional positions (P1 figure 11).

    `runs` has a table of errors for each run, by the name of the run.
    """
    names: list[str] = []
    values: list[Floats] = []
    for run, errors in runs.items():
        for label, column, _, _ in reversed(_SERIES):
            names.append(f"{run}, {label}")
            error = good_errors(errors, column)
            values.append(error[np.isfinite(error)])
    layers = []
    for label, _, colour, _ in reversed(_SERIES):
        mine = [v if name.endswith(f", {label}") else np.empty(0) for name, v in zip(names, values, strict=True)]
        layers.append(
            RangeBars(
                label=label,
                colour=colour,
                names=tuple(names),
                low=np.array([v.min() if len(v) else np.nan for v in mine]),
                mid=np.array([v.mean() if len(v) else np.nan for v in mine]),
                high=np.array([v.max() if len(v) else np.nan for v in mine]),
            )
        )
    return Chart(
        name="error-ranges",
        title="Range of the errors",
        caption=f"Each bar extends from the lowest to the highest error, including positions that failed a check; the "
        f"mark is the mean. {_SIGN}",
        x_label=_ERROR_LABEL,
        y_label="",
        layers=tuple(layers),
    )


def errors_of_runs(runs: Mapping[str, pl.DataFrame]) -> Chart:
    """Return a chart of the errors of several runs over the chainage of the references (P1 figure 8).

    `runs` has a table of errors for each run, by the name of the run.
    """
    layers, thinned = thin_points(
        Points(
            label=run, colour=CYCLE[number % len(CYCLE)], x=floats(errors, "chainage_m"),
            y=good_errors(errors, "error_m"), epoch_s=since(errors, find_start(errors)),
        )
        for number, (run, errors) in enumerate(runs.items())
    )  # fmt: skip
    every = [np.empty(0), *(good_errors(errors, "error_m") for errors in runs.values())]
    return Chart(
        name="errors-of-runs",
        title="Errors of all runs over chainage",
        caption=f"Single epochs. {_SIGN}{thinned}",
        x_label="chainage of the reference [m]",
        y_label=_ERROR_LABEL,
        layers=tuple(layers),
        **error_scale(np.concatenate(every)),
    )


#: Label and column of each part of the protection level, of the RAIM level, and of the protection level itself.
_PARTS: Final = (
    ("fault-free part", "protection_fault_free_m"),
    ("one-fault part", "protection_one_fault_m"),
    ("two-fault part", "protection_two_faults_m"),
    ("RAIM level", "raim_level_m"),
    ("level", "protection_level_m"),
)


#: Labels of the Stanford diagram: region, text, x and y of the label; x and y are 1 at the alarm limit, and 2 at the
#: end of the axis.
_REGIONS: Final = (
    (Region.NOMINAL, "nominal", 0.35, 0.78),
    (Region.MISLEADING, "misleading", 0.7, 0.24),
    (Region.HAZARDOUS, "hazardously\nmisleading", 1.5, 0.5),
    (Region.UNAVAILABLE, "unavailable", 0.6, 1.7),
    (Region.UNAVAILABLE_MISLEADING, "unavailable,\nmisleading", 1.7, 1.28),
)


def stanford(diagram: Stanford, *, title: str = "Stanford diagram") -> Chart:
    """Return a chart of the protection level over the absolute error; each cell shows its number of epochs.

    Each region is labelled with its number of epochs. Values beyond the axes are counted in the last cells.
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
        caption=f"{judged:,} epochs have an error: {regions}. Levels are available at "
        f"{100 * diagram.available_rate:.2f} % of all epochs"
        f"{'; windows that begin with an available level and keep it: ' + kept if kept else ''}. "
        f"Right of the diagonal the error exceeds the level. Values above {top:g} m, including infinite levels, are "
        "counted in the last cells. Darker cells have more epochs, on a logarithmic scale.",
        x_label="absolute error along the line [m]",
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
    """Return labels with the name and the number of epochs of each region; `top_m` is the end of the axes [m]."""
    limit = diagram.alarm_limit_m

    def place(value: float) -> float:
        return limit * min(value, 1.0) + max(value - 1.0, 0.0) * (top_m - limit)

    return Marks(
        label="",
        colour=BLACK,
        x=np.array([place(x) for _, _, x, _ in _REGIONS]),
        y=np.array([place(y) for _, _, _, y in _REGIONS]),
        words=tuple(f"{name}\n{diagram.counts[region]:,}" for region, name, _, _ in _REGIONS),
        place="on",
    )


def levels_over_time(positions: pl.DataFrame, alarm_limit_m: float) -> Chart:
    """Return a chart of the protection level of one antenna, and of the parts of this level, over time.

    `positions` is the table of positions. The chart is empty if the run has no protection levels.
    """
    return _levels(positions, alarm_limit_m, find_start(positions))


def levels_over_chainage(positions: pl.DataFrame, alarm_limit_m: float) -> Chart:
    """Return the chart of `levels_over_time` over chainage, without epochs that have no position."""
    return _levels(positions, alarm_limit_m, None)


def _levels(positions: pl.DataFrame, alarm_limit_m: float, start: np.datetime64 | None) -> Chart:
    """Return a chart of levels over the time since `start`, or over chainage if `start` is None."""
    # the axis ends at twice the alarm limit, because larger levels are of little interest
    top = 2.0 * alarm_limit_m
    epoch = since(positions, find_start(positions))
    x = floats(positions, "chainage_m") if start is None else epoch
    series = []
    for (label, column), colour in zip(_PARTS, (*CYCLE[2:6], BLUE), strict=True):
        level = floats(positions, column)
        level = np.where(np.isfinite(level + x), level, np.nan)
        if (level > 0.0).any():
            series.append(Points(label=label, colour=colour, x=x, y=level, size=2.5, epoch_s=epoch))
    layers, thinned = thin_points(series)
    if layers:
        line = np.array([np.nanmin(x), np.nanmax(x)])
        limit = np.full(2, alarm_limit_m)
        layers.append(Curve(label=f"alarm limit {alarm_limit_m:g} m", colour=RED, x=line, y=limit, dash="dashed"))
    infinite = int(np.isinf(floats(positions, "protection_level_m")).sum())
    caption = [_count(positions), f"Values beyond {top:g} m, twice the alarm limit, are cut off"]
    caption[1] += f"; not drawn: {plural(infinite, 'infinite level')}." if infinite else "."
    if any(label in {layer.label for layer in layers} for label, _ in _PARTS[:3]):
        caption.append(
            "Each part is the level that its fraction of the risk requires; the level itself uses the whole risk, and "
            "can therefore be smaller than a part."
        )
    return Chart(
        name="levels-chainage" if start is None else "levels",
        title="Protection level of single epochs" + (" over chainage" if start is None else ""),
        caption=" ".join(caption).strip() + thinned,
        x_label="chainage of the position [m]" if start is None else "GPS time",
        y_label="protection level [m]",
        layers=tuple(layers),
        start=start,
        y_range=(0.0, top),
    )


def _count(positions: pl.DataFrame) -> str:
    """Return sentences with the numbers of epochs by status of the level, and by largest contribution to the level."""
    sentences = []
    for column, what in (("protection_status", "Epochs"), ("protection_cause", "Largest contribution to the level")):
        if column in positions.columns:
            counts = Counter(words(positions, column).tolist())
            listed = ", ".join(f"{word or 'none'} {count:,}" for word, count in counts.most_common())
            sentences.append(f"{what}: {listed}.")
    return " ".join(sentences)
