"""Charts of whole runs: the runs of a campaign, processing time, and satellite service along a line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.core.timescale import seconds
from railfix.report.plots.chart import (
    BLUE,
    CONSTRAINED,
    FILTERED,
    GREEN,
    GREY,
    RED,
    Chart,
    Curve,
    Layer,
    Points,
    RangeBars,
    floats,
    points,
)
from railfix.report.plots.draw import draw_chart, save_figure
from railfix.report.plots.line import ECEF, ERROR_CLASSES, LEVEL_CLASSES, LocalFrame, size_classes

if TYPE_CHECKING:
    import polars as pl

#: By column name: name of the quantity, limits of its classes [m], and colour of its bars.
_QUANTITIES = {
    "error_m": ("error", ERROR_CLASSES, CONSTRAINED),
    "protection_level_m": ("level", LEVEL_CLASSES, FILTERED),
    "along_sigma_m": ("standard deviation", ERROR_CLASSES, CONSTRAINED),
}


def campaign_plan(places: pl.DataFrame, quantity: str) -> Chart:
    """Return a plan of the positions (``x_m``, ``y_m``, ``z_m``) of all runs, coloured by classes of a quantity.

    `quantity` is a key of ``_QUANTITIES``; points with larger values are drawn over points with smaller values.
    """
    named, edges, _ = _QUANTITIES[quantity]
    placed = points(places, *ECEF)
    rows = np.isfinite(placed[:, 0])
    layers: list[Layer] = []
    where = ""
    if rows.any():
        frame = LocalFrame.around(placed[rows])
        east, north = frame.plane(placed).T
        for label, colour, mask in size_classes(np.abs(floats(places, quantity)), edges, named, f"no {named}"):
            if (rows & mask).any():
                layers.append(Points(label=label, colour=colour, x=east[rows & mask], y=north[rows & mask], size=4.0))
        where = f" Origin at latitude and longitude {frame.latitude_deg:.5f}, {frame.longitude_deg:.5f}."
    return Chart(
        name="campaign-plan", title="Lines of the runs", x_label="east [m]", y_label="north [m]", layers=tuple(layers),
        caption=f"The line of each run is divided into pieces; a point is the epoch with the largest {named} in a "
        f"piece.{where}",
        equal=True,
    )  # fmt: skip


def campaign_bars(names: Sequence[str], low: Floats, middle: Floats, high: Floats, quantity: str) -> Chart:
    """Return a chart with one bar per run from `low` to `high` and a mark at `middle`, each of shape (runs,) [m]."""
    named, _, colour = _QUANTITIES[quantity]
    top = float(np.nanmax(high[np.isfinite(high)], initial=0.0)) or 1.0
    bars = RangeBars(label=named, colour=colour, names=tuple(names), low=low, mid=middle, high=high)
    return Chart(
        name=f"campaign-{named.split()[0]}", title=f"{named.capitalize()} by run", x_label=f"{named} [m]", y_label="",
        x_range=(0.0, 1.04 * top), layers=(bars,),
        caption="Each bar extends from the median to the largest value; the mark is the 95th percentile.",
    )  # fmt: skip


def processing_time(chunks: Mapping[str, Sequence[Any]]) -> Chart:
    """Return a chart of the mean processing time per epoch in each chunk of a run; `chunks` is from ``run.json``."""
    time = np.array([str(t) for t in chunks["first_epoch_gpst"]], dtype="datetime64[ns]")
    epochs = np.array(chunks["epochs"], dtype=np.float64)
    spent = np.array(chunks["positioning_s"], dtype=np.float64)
    start = time.min() if len(time) else np.datetime64(0, "ns")
    x = seconds(time - start)
    mean_ms = 1e3 * spent / np.maximum(epochs, 1.0)
    whole = 1e3 * spent.sum() / max(epochs.sum(), 1.0)
    return Chart(
        name="processing-time",
        title="Time per epoch",
        caption=f"Each value is the mean over one of {len(x):,} chunks of up to {epochs.max(initial=0):,.0f} epochs of "
        "all antennas, drawn at the first epoch of the chunk. The time for reading and writing files is not included. "
        f"The mean over the run is {whole:.3f} ms per epoch and antenna. A chunk is processed as a whole; live "
        "operation, which processes each epoch separately, takes longer per epoch.",
        x_label="GPS time",
        y_label="ms per epoch",
        layers=(
            Curve(label="", colour=GREY, x=x, y=mean_ms, width=1.0),
            Points(label="mean of a chunk", colour=BLUE, x=x, y=mean_ms, size=6.0),
        ),
        start=start,
        y_range=(0.0, 1.15 * float(mean_ms.max(initial=0.1))),
    )


def service_charts(service: pl.DataFrame, limit_m: float) -> tuple[Chart, ...]:
    """Return charts of the satellite service over chainage.

    The charts show used satellites, distances of 3-D positions from the line, fractions of epochs, and protection
    levels.

    `service` is the table of `compute_service`, `limit_m` the alarm limit [m].
    """
    level = [("median", "level_median_m", BLUE), ("exceeded in 5 % of epochs", "level_p95_m", RED)]
    ends = np.array([service["from_m"].min(), service["to_m"].max()], dtype=float)
    limit = Curve(label="alarm limit", colour=GREEN, x=ends, y=np.full(2, limit_m), dash="dashed")
    fractions = [
        ("ok, single epochs", "ok_share", BLUE),
        ("filter with a level", "tracking_share", RED),
        (f"level within {limit_m:g} m", "within_limit_share", GREEN),
    ]
    satellites = [("median", "satellites_median", BLUE), ("fewer in 5 % of epochs", "satellites_p5", RED)]
    distance = [("exceeded in 5 % of epochs", "reflection_p95_m", RED)]
    panels: tuple[tuple[str, str, list[Any], dict[str, Any]], ...] = (
        ("Satellites used", "satellites", satellites, {"y_range": None}),
        ("Distance of the 3-D position from the line", "distance [m]", distance, {}),
        ("Fraction of epochs", "fraction of epochs", fractions, {"y_range": (-0.03, 1.03)}),
        ("Protection level", "protection level [m]", level, {"y_scale": "log"}),
    )
    return tuple(
        Chart(
            name=f"service-{number}",
            title=title,
            caption="",
            x_label="chainage [m]",
            y_label=unit,
            layers=(*(_steps(service, *column) for column in columns), *((limit,) if columns is level else ())),
            **scales,
        )
        for number, (title, unit, columns, scales) in enumerate(panels)
    )


def plot_service(service: pl.DataFrame, path: str | PathLike[str], *, title: str, limit_m: float) -> None:
    """Write the charts of `service_charts` as one picture (PNG or SVG); raise OutputError if it cannot be written."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 10), layout="constrained")
    figure.suptitle(f"Satellite service: {title}")
    charts = service_charts(service, limit_m)
    for chart, panel in zip(charts, figure.subplots(len(charts), 1, sharex=True), strict=True):
        draw_chart(chart, panel)
    save_figure(figure, path)


def _steps(service: pl.DataFrame, label: str, column: str, colour: str) -> Curve:
    """Return the curve of a column whose values are constant in each stretch, with gaps where values are missing."""
    begin, end = service["from_m"].to_numpy(), service["to_m"].to_numpy()
    value = service[column].cast(float).fill_null(float("nan")).to_numpy()
    value = np.where(np.isfinite(value), value, np.nan)
    x = np.stack([begin, end, end], axis=1).ravel()
    y = np.stack([value, value, np.full(len(value), np.nan)], axis=1).ravel()
    return Curve(label=label, colour=colour, x=x, y=y, width=2.0)
