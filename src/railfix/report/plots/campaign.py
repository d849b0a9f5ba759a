"""Charts of whole runs: of a campaign, of processing time, of satellite service along a line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.core.timescale import seconds
from railfix.report.plots.chart import (
    BLUE,
    CONSTRAINED,
    FILTERED,
    GREY,
    Chart,
    Curve,
    Layer,
    Points,
    RangeBars,
    floats,
    points,
)
from railfix.report.plots.draw import save_figure
from railfix.report.plots.line import ECEF, ERROR_CLASSES, LEVEL_CLASSES, LocalFrame, size_classes

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.axes import Axes

#: Quantities by their column: text of the legend, limits of the classes [m], and the colour of bars.
_QUANTITIES = {
    "error_m": ("error", ERROR_CLASSES, CONSTRAINED),
    "protection_level_m": ("level", LEVEL_CLASSES, FILTERED),
    "along_sigma_m": ("standard deviation", ERROR_CLASSES, CONSTRAINED),
}


def campaign_plan(places: pl.DataFrame, quantity: str) -> Chart:
    """Plan of the positions (``x_m``, ``y_m``, ``z_m``) of all runs, coloured by a quantity, the largest last."""
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
        caption=f"Each run in pieces of the line; a point is the epoch with the largest {named} of its piece.{where}",
        equal=True,
    )  # fmt: skip


def campaign_bars(names: Sequence[str], low: Floats, middle: Floats, high: Floats, quantity: str) -> Chart:
    """Return the bars of a quantity by run, from `low` to `high` with a mark at `middle`, each of shape (runs,) [m]."""
    named, _, colour = _QUANTITIES[quantity]
    top = float(np.nanmax(high[np.isfinite(high)], initial=0.0)) or 1.0
    bars = RangeBars(label=named, colour=colour, names=tuple(names), low=low, mid=middle, high=high)
    return Chart(
        name=f"campaign-{named.split()[0]}", title=f"{named.capitalize()} by run", x_label=f"{named} [m]", y_label="",
        x_range=(0.0, 1.04 * top), layers=(bars,),
        caption="From the median to the largest; the mark is the 95th percentile.",
    )  # fmt: skip


def processing_time(chunks: Mapping[str, Sequence[Any]]) -> Chart:
    """Return the time an epoch over the run, the mean of each chunk; of ``chunks`` of ``run.json``."""
    time = np.array([str(t) for t in chunks["first_epoch_gpst"]], dtype="datetime64[ns]")
    epochs = np.array(chunks["epochs"], dtype=np.float64)
    spent = np.array(chunks["positioning_s"], dtype=np.float64)
    start = time.min() if len(time) else np.datetime64(0, "ns")
    x = seconds(time - start)
    mean_ms = 1e3 * spent / np.maximum(epochs, 1.0)
    whole = 1e3 * spent.sum() / max(epochs.sum(), 1.0)
    return Chart(
        name="processing-time",
        title="Time an epoch",
        caption=f"Mean of each of {len(x):,} chunks of up to {epochs.max(initial=0):,.0f} epochs of all antennas, at "
        f"the time of the first; reading and writing not included. Over the run {whole:.3f} ms an epoch and antenna. A "
        "chunk is positioned as a whole: live, epoch by epoch, each takes longer.",
        x_label="GPS time",
        y_label="ms an epoch",
        layers=(
            Curve(label="", colour=GREY, x=x, y=mean_ms, width=1.0),
            Points(label="mean of a chunk", colour=BLUE, x=x, y=mean_ms, size=6.0),
        ),
        start=start,
        y_range=(0.0, 1.15 * float(mean_ms.max(initial=0.1))),
    )


_BLUE: Final = "#1f4e79"
_ORANGE: Final = "#e08e0b"
_GREEN: Final = "#2e7d32"


def plot_service(service: pl.DataFrame, path: str | PathLike[str], *, title: str, limit_m: float) -> None:
    """Draw satellites, reflections, fractions and levels of `compute_service` by chainage."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 10), layout="constrained")
    panels = figure.subplots(4, 1, sharex=True)
    figure.suptitle(f"Where satellites can serve: {title}")
    _steps(panels[0], service, {"satellites_median": ("median", _BLUE), "satellites_p5": ("5 %", _ORANGE)})
    panels[0].set(ylabel="satellites used", ylim=(0.0, None))
    _steps(panels[1], service, {"reflection_p95_m": ("95 %", _ORANGE)})
    panels[1].set(ylabel="3-D position from the line [m]", ylim=(0.0, None))
    shares = {
        "ok_share": ("ok, single epochs", _BLUE),
        "tracking_share": ("filter with a level", _ORANGE),
        "within_limit_share": (f"level within {limit_m:g} m", _GREEN),
    }
    _steps(panels[2], service, shares)
    panels[2].set(ylabel="share of epochs", ylim=(-0.03, 1.03))
    _steps(panels[3], service, {"level_median_m": ("median", _BLUE), "level_p95_m": ("95 %", _ORANGE)})
    panels[3].axhline(limit_m, color=_GREEN, linestyle="--", label="alarm limit")
    panels[3].set(ylabel="level [m]", xlabel="chainage [m]", yscale="log")
    for panel in panels:
        panel.grid(alpha=0.3)
        panel.legend(loc="best", fontsize="small")
    save_figure(figure, path)


def _steps(axes: Axes, service: pl.DataFrame, columns: dict[str, tuple[str, str]]) -> None:
    """Draw columns as constant by stretch, with gaps where values are missing."""
    begin, end = service["from_m"].to_numpy(), service["to_m"].to_numpy()
    for name, (label, colour) in columns.items():
        value = service[name].cast(float).fill_null(float("nan")).to_numpy()
        value = np.where(np.isfinite(value), value, np.nan)
        x = np.stack([begin, end, end], axis=1).ravel()
        y = np.stack([value, value, np.full(len(value), np.nan)], axis=1).ravel()
        axes.plot(x, y, color=colour, label=label, linewidth=2.0)
