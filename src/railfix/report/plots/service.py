"""The picture of where satellites can serve on a line."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.report.plots.draw import save_figure

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.axes import Axes

_BLUE: Final = "#1f4e79"
_ORANGE: Final = "#e08e0b"
_GREEN: Final = "#2e7d32"


def plot_service(service: pl.DataFrame, path: str | PathLike[str], *, title: str, limit_m: float) -> None:
    """Draw satellites, reflections, shares and levels of `compute_service` by chainage.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
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
    """Draw columns as constant by stretch; a gap where there is no number."""
    begin, end = service["from_m"].to_numpy(), service["to_m"].to_numpy()
    for name, (label, colour) in columns.items():
        value = service[name].cast(float).fill_null(float("nan")).to_numpy()
        value = np.where(np.isfinite(value), value, np.nan)
        x = np.stack([begin, end, end], axis=1).ravel()
        y = np.stack([value, value, np.full(len(value), np.nan)], axis=1).ravel()
        axes.plot(x, y, color=colour, label=label, linewidth=2.0)
