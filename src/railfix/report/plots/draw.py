"""Drawing of charts with matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import Parameter, signature
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, ParamSpec, cast

import numpy as np
import polars as pl
from polars.exceptions import ColumnNotFoundError

from railfix.core.errors import SettingsError
from railfix.core.staged_files import stage_file
from railfix.core.timescale import timedelta
from railfix.report.plots.chart import (
    BLUE,
    RED,
    Band,
    Bars,
    Cells,
    Chart,
    Curve,
    Layer,
    Marks,
    Points,
    RangeBars,
    SkyEpochs,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

P = ParamSpec("P")

_MARKERS: Final = {"dot": "o", "square": "s", "cross": "x", "ring": "o"}
_DASHES: Final = {"solid": "-", "dashed": "--", "dotted": ":"}


def plotter(chart_of: Callable[P, Chart]) -> Callable[..., Axes]:
    """Return a function that draws the chart returned by `chart_of`.

    The function has the parameters of `chart_of` and the parameter `ax`.

    It raises SettingsError if a table is not a polars table, or lacks a column.
    """
    own = signature(chart_of)
    of_table = next(iter(own.parameters.values())).annotation == "pl.DataFrame"

    @wraps(chart_of)
    def draw(*args: Any, ax: Axes | None = None, **kwargs: Any) -> Axes:
        if of_table and args and not isinstance(args[0], pl.DataFrame):
            hint = "give positions_table or train_table of a result, or an evaluation, with the rows of one antenna"
            raise SettingsError(f"{draw.__name__}: expected a polars table, got {type(args[0]).__name__}; {hint}")
        try:
            chart = chart_of(*args, **kwargs)
        except ColumnNotFoundError as error:
            raise SettingsError(f"{draw.__name__}: the table lacks a column ({error})") from None
        return draw_chart(chart, ax)

    draw.__name__ = draw.__qualname__ = f"plot_{chart_of.__name__}"
    draw.__annotations__ = {**chart_of.__annotations__, "ax": "Axes | None", "return": "Axes"}
    draw.__doc__ = (
        f"{chart_of.__doc__}\n\n    Draws into the axes `ax`, or into a new figure; the axes are returned.\n    "
    )
    del draw.__wrapped__
    ax = Parameter("ax", Parameter.KEYWORD_ONLY, default=None, annotation="Axes | None")
    draw.__signature__ = own.replace(parameters=[*own.parameters.values(), ax], return_annotation="Axes")  # type: ignore[attr-defined]
    return draw


def _size(chart: Chart) -> tuple[float, float]:
    """Return the width and height of a figure for a chart [inch]."""
    return (10.0, 7.0) if chart.equal else (10.0 if chart.width == "wide" else 6.0, 4.2)


def draw_figure(chart: Chart) -> Figure:
    """Draw a chart into a new figure that is independent of matplotlib.pyplot, and return the figure."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=_size(chart), layout="constrained")
    draw_chart(chart, figure.subplots())
    return figure


def save_figure(figure: Figure, path: str | PathLike[str]) -> Path:
    """Write a figure as SVG if the name ends in ``.svg``, otherwise as PNG, and return the path.

    Raise OutputError if the file cannot be written.
    """
    with stage_file(path, what="picture") as staged:
        figure.savefig(staged, format="svg" if str(path).endswith(".svg") else "png", dpi=110)
    return Path(path)


def draw_chart(chart: Chart, ax: Axes | None = None) -> Axes:
    """Draw a chart into matplotlib axes, or into a new figure of matplotlib.pyplot, and return the axes."""
    axes = new_axes(_size(chart)) if ax is None else ax
    for layer in chart.layers:
        _draw(layer, axes, chart)
    axes.set_title(chart.title, fontsize="medium")
    axes.set_xlabel(chart.x_label)
    axes.set_ylabel(chart.y_label)
    _scales(chart, axes)
    if not any(isinstance(layer, RangeBars) for layer in chart.layers):
        axes.grid(alpha=0.3)
    if any(text for text in axes.get_legend_handles_labels()[1]):
        axes.legend(fontsize="small", markerscale=2.5, loc="best")
    return axes


def new_axes(size: tuple[float, float], **axes: Any) -> Axes:
    """Return axes in a new figure of matplotlib.pyplot, which a notebook shows; `size` is in inches."""
    from matplotlib import pyplot

    _, made = pyplot.subplots(figsize=size, layout="constrained", subplot_kw=axes)
    return made


def draw_sky(sky: SkyEpochs, time: np.datetime64, *, ax: Axes | None = None) -> Axes:
    """Draw the satellites at the epoch nearest to a GPS time into polar axes, and return the axes.

    Raise ValueError if there are no satellites, or `ax` is not polar.
    """
    if sky.empty:
        raise ValueError("there are no satellites to draw")
    polar: Any = new_axes((6.0, 6.0), projection="polar") if ax is None else ax
    if polar.name != "polar":
        raise ValueError("the sky plot requires polar axes; create them with subplot_kw={'projection': 'polar'}")
    k = int(np.argmin(np.abs(sky.start + timedelta(sky.epoch_s) - time)))
    rows = slice(int(sky.first[k]), int(sky.first[k + 1]))
    polar.set_theta_zero_location("N")
    polar.set_theta_direction(-1)
    polar.set_rlim(90.0, 0.0)
    bearing, elevation = np.radians(sky.azimuth_deg[rows]), sky.elevation_deg[rows]
    used = sky.reason[rows] == "used"
    for mask, colour, marker, label in ((used, BLUE, "o", "used"), (~used, RED, "x", "rejected")):
        polar.plot(bearing[mask], elevation[mask], marker, color=colour, label=label)
    for where, high, name, cn0 in zip(bearing, elevation, sky.satellite[rows], sky.cn0_dbhz[rows], strict=True):
        text = f"{name}\n{cn0:.0f}" if np.isfinite(cn0) else str(name)
        polar.annotate(text, (where, high), textcoords="offset points", xytext=(5, 0), fontsize=8)
    moment = np.datetime_as_string(sky.start + timedelta(sky.epoch_s[k]), unit="ms")
    polar.set_title(f"{sky.title}, {moment}; C/N0 in dB-Hz", fontsize="medium")
    polar.legend(loc="lower left", bbox_to_anchor=(-0.1, -0.1), fontsize="small")
    return cast("Axes", polar)


def _scales(chart: Chart, axes: Axes) -> None:
    if chart.x_scale != "linear":
        axes.set_xscale(chart.x_scale)
    if chart.y_scale == "symlog":
        axes.set_yscale("symlog", linthresh=chart.y_linear)
    elif chart.y_scale == "log":
        axes.set_yscale("log")
    if chart.x_range is not None:
        axes.set_xlim(*chart.x_range)
    if chart.y_range is not None:
        axes.set_ylim(*chart.y_range)
    if chart.equal:
        axes.set_aspect("equal", adjustable="datalim" if chart.x_range is None else "box")
        axes.annotate(
            "N",
            xy=(0.97, 0.97),
            xytext=(0.97, 0.87),
            xycoords="axes fraction",
            ha="center",
            arrowprops={"arrowstyle": "-|>", "color": "black"},
        )


def _along(chart: Chart, x: Any) -> Any:
    """Return values of the x axis for matplotlib: times if the chart has a start, otherwise the values."""
    return x if chart.start is None else chart.start + timedelta(x)


def _draw(layer: Layer, axes: Axes, chart: Chart) -> None:
    look: dict[str, Any] = {"color": layer.colour, "label": layer.label}
    match layer:
        case Points():
            axes.plot(
                _along(chart, layer.x), layer.y, _MARKERS[layer.shape], ms=layer.size * 0.8,
                mfc="none" if layer.shape == "ring" else layer.colour, rasterized=len(layer.x) > 1000, **look,
            )  # fmt: skip
        case Curve():
            axes.plot(_along(chart, layer.x), layer.y, _DASHES[layer.dash], lw=layer.width, **look)
        case Band():
            axes.fill_between(_along(chart, layer.x), layer.low, layer.high, alpha=0.25, lw=0, **look)
        case Bars():
            axes.bar(layer.left, layer.height, layer.right - layer.left, align="edge", alpha=0.6, **look)
        case Cells():
            from matplotlib.colors import LogNorm

            counts = np.ma.masked_equal(layer.counts, 0).T
            axes.pcolormesh(layer.x_edges, layer.y_edges, counts, cmap="Greys", norm=LogNorm(vmin=0.3), rasterized=True)
        case RangeBars():
            at = np.arange(len(layer.names), dtype=np.float64)
            axes.hlines(at, layer.low, layer.high, lw=6, alpha=0.4, **look)
            axes.plot(layer.mid, at, "|", color=layer.colour, ms=14, mew=2.5)
            axes.set_yticks(at, layer.names)
            axes.set_ylim(len(layer.names) - 0.5, -0.5)
            axes.grid(axis="x", alpha=0.3)
        case Marks():
            _marks(layer, axes)


def _marks(layer: Marks, axes: Axes) -> None:
    if layer.place == "on":
        ground = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.5}
        for x, y, word in zip(layer.x, layer.y, layer.words, strict=True):
            axes.text(x, y, word, ha="center", va="center", fontsize=8, color=layer.colour, bbox=ground)
        return
    axes.plot(layer.x, layer.y, "+", color=layer.colour, ms=7)
    for x, y, word in zip(layer.x, layer.y, layer.words, strict=True):
        axes.annotate(word, (x, y), textcoords="offset points", xytext=(4, 4), fontsize=8, color=layer.colour)
