"""The picture of a track map's quality report."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.geodesy import enu_axes
from railfix.report.plots.draw import save_figure
from railfix.track import Track, TrackQuality

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_COLOURS: Final = {"error": "#c1272d", "warning": "#e08e0b"}
_LINE: Final = "#1f4e79"
#: Panel along the line in which each kind of finding is marked; those not named stand in the plan only.
_PANELS: Final = {
    "mid-chord": "mid-chord",
    "duplicate": "spacing",
    "near duplicate": "spacing",
    "spacing": "spacing",
    "kink": "turn",
    "gradient": "gradient",
    "gradient attribute": "gradient",
    "height spike": "gradient",
    "cant": "cant",
    "radius": "cant",
    "radius side": "cant",
}


def _plan(track: Track) -> tuple[Floats, Floats]:
    """East and north of the points from the first [m]."""
    axes = enu_axes(track.latitude_deg[0], track.longitude_deg[0])
    enu = (track.ecef_m - track.ecef_m[0]) @ axes.T
    return enu[:, 0], enu[:, 1]


def plot_track_quality(quality: TrackQuality, path: str | PathLike[str]) -> None:
    """Draw plan, mid-chord deviation, spacing, turns, gradient and cant, with the findings marked, as a PNG file.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 14), layout="constrained")
    names = ("mid-chord", "spacing", "turn", "gradient", "cant")
    grid = figure.add_gridspec(1 + len(names), 1, height_ratios=[2.6] + [1.0] * len(names))
    _draw_plan(figure.add_subplot(grid[0]), quality)
    panels = {name: figure.add_subplot(grid[i + 1]) for i, name in enumerate(names)}
    _draw_panels(panels, quality)
    save_figure(figure, path)


def _draw_plan(axes: Axes, quality: TrackQuality) -> None:
    track = quality.track
    east, north = _plan(track)
    axes.plot(east, north, "-", color=_LINE, linewidth=1.2)
    axes.plot(east[0], north[0], "o", color=_LINE, markersize=6, label="start")
    for severity, found in (("error", quality.errors), ("warning", quality.warnings)):
        at = [finding.first for finding in found]
        if at:
            axes.plot(
                east[at], north[at], "x", color=_COLOURS[severity], markersize=7, label=f"{severity}s ({len(at)})"
            )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east of the first point [m]")
    axes.set_ylabel("north [m]")
    axes.set_title(f"{track.name}: {len(track)} points, {track.chainage_m[-1]:,.0f} m")
    axes.legend(loc="best", fontsize=8)
    axes.grid(visible=True, alpha=0.3)


def _draw_panels(panels: dict[str, Axes], quality: TrackQuality) -> None:
    track, geometry, limits = quality.track, quality.geometry, quality.limits
    along = track.chainage_m
    middle = (along[1:] + along[:-1]) / 2.0
    curves = {
        "mid-chord": (middle, np.abs(geometry.mid_chord_m), "chord from arc [m]", limits.mid_chord_m),
        "spacing": (middle, geometry.spacing_m, "spacing [m]", limits.spacing_m),
        "turn": (along, geometry.turn_deg, "turn at a point [deg]", None),
        "gradient": (middle, geometry.gradient_permille, "gradient [per mille]", None),
        "cant": (along, 1e3 * track.cant_m, "cant [mm]", None),
    }
    for name, (x, y, label, limit) in curves.items():
        axes = panels[name]
        if np.isfinite(y).any():
            axes.plot(x, y, "-", color=_LINE, linewidth=0.9)
        else:
            axes.text(0.5, 0.5, "the map has none", transform=axes.transAxes, ha="center", va="center", color="0.4")
        if limit is not None and np.nanmax(y, initial=0.0) > limit / 4.0:
            axes.axhline(limit, color=_COLOURS["error"], linewidth=0.8, linestyle="--")
        axes.set_ylabel(label, fontsize=8)
        axes.set_xlim(along[0], along[-1])
        axes.grid(visible=True, alpha=0.3)
    stated = track.gradient_permille
    if np.isfinite(stated).any():
        panels["gradient"].plot(along, stated, "-", color="0.5", linewidth=0.9, label="stated in the map")
        panels["gradient"].legend(loc="best", fontsize=7)
    for finding in quality.findings:
        if finding.kind in _PANELS:
            last = max(along[finding.last], along[finding.first] + 0.002 * along[-1])
            colour = _COLOURS[finding.severity]
            panels[_PANELS[finding.kind]].axvspan(finding.chainage_m, last, color=colour, alpha=0.35, linewidth=0)
    list(panels.values())[-1].set_xlabel("chainage [m]")
