"""The picture of a surveyed line."""

from __future__ import annotations

from os import PathLike
from typing import Final

from railfix.core.geodesy import enu_axes
from railfix.report.plots.draw import save_figure
from railfix.run.survey import Surveyed

_LINE: Final = "#1f4e79"
_RAW: Final = "#c1272d"


def plot_survey(surveyed: Surveyed, path: str | PathLike[str]) -> None:
    """Draw positions, map and passes in plan, and height and standard deviations along the line.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    survey, track = surveyed.survey, surveyed.survey.track
    axes = enu_axes(track.latitude_deg[0], track.longitude_deg[0])
    figure = Figure(figsize=(10, 12), layout="constrained")
    grid = figure.add_gridspec(3, 1, height_ratios=[3.0, 1.0, 1.0])
    plan, height, sigma = (figure.add_subplot(grid[i]) for i in range(3))
    for number, run in enumerate(surveyed.runs):
        enu = (run.ecef_m - track.ecef_m[0]) @ axes.T
        plan.plot(enu[:, 0], enu[:, 1], ".", color=_RAW, markersize=2, label="positions" if not number else None)
    enu = (track.ecef_m - track.ecef_m[0]) @ axes.T
    plan.plot(enu[:, 0], enu[:, 1], color=_LINE, label="map")
    margin = 0.05 * max(float(enu[:, i].max() - enu[:, i].min()) for i in range(2)) + 20.0
    plan.set(
        xlim=(enu[:, 0].min() - margin, enu[:, 0].max() + margin),
        ylim=(enu[:, 1].min() - margin, enu[:, 1].max() + margin),
        xlabel="east of the first point [m]",
        ylabel="north [m]",
        title=track.name,
    )
    plan.set_aspect("equal", adjustable="box")
    plan.legend(loc="best")
    chainage = track.chainage_m
    height.fill_between(
        chainage, track.height_m - survey.sigma_height_m, track.height_m + survey.sigma_height_m, color=_LINE, alpha=0.2
    )
    height.plot(chainage, track.height_m, color=_LINE)
    height.set(ylabel="height, one sigma [m]")
    sigma.plot(chainage, survey.sigma_plan_m, color=_LINE, label="across")
    sigma.plot(chainage, survey.sigma_height_m, color=_RAW, label="height")
    sigma.set(xlabel="chainage [m]", ylabel="standard deviation [m]", ylim=(0.0, None))
    sigma.legend(loc="best")
    for panel in (height, sigma):
        panel.set_xlim(chainage[0], chainage[-1])
        panel.grid(alpha=0.3)
    save_figure(figure, path)
