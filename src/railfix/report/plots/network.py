"""The picture of a network of tracks."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.files import staged_file

if TYPE_CHECKING:
    from railfix.track.network import Network
    from railfix.track.network_check import NetworkQuality
    from railfix.track.network_match import Matched, PlanLog

_COLOURS: Final = {
    "gap": "#c1272d",
    "kink": "#e08e0b",
    "joint": "#c1272d",
    "too near": "#7b3294",
    "dead end": "#888888",
}
#: Tracks that are named in the picture at most.
_NAMED: Final = 60


def plot_network(
    network: Network,
    path: str | PathLike[str],
    *,
    quality: NetworkQuality | None = None,
    run: tuple[PlanLog, Matched] | None = None,
) -> None:
    """Draw the tracks with their names, findings of the check, and the positions of a run.

    Parameters
    ----------
    network : Network
    path : path
        PNG or SVG file; it appears whole or not at all.
    quality : NetworkQuality, optional
    run : (PlanLog, Matched), optional
        Positions, coloured by the probability of their track.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 9), dpi=120)
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for track, name in zip(network.tracks, network.names, strict=True):
        axes.plot(track.longitude_deg, track.latitude_deg, color="#1f4e79", linewidth=0.8)
        if len(network.tracks) <= _NAMED:
            middle = len(track.latitude_deg) // 2
            axes.annotate(name, (track.longitude_deg[middle], track.latitude_deg[middle]), fontsize=5)
    for kind, colour in _COLOURS.items():
        found = [f for f in quality.findings if f.kind == kind] if quality is not None else []
        if found:
            axes.plot(
                [f.longitude_deg for f in found],
                [f.latitude_deg for f in found],
                "o",
                color=colour,
                fillstyle="none",
                label=f"{kind} ({len(found)})",
            )
    if run is not None:
        log, matched = run
        shown = axes.scatter(
            log.longitude_deg, log.latitude_deg, c=matched.probability, s=4, cmap="RdYlGn", vmin=0.0, vmax=1.0, zorder=3
        )
        figure.colorbar(shown, label="probability of the track", shrink=0.6)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc="best")
    axes.set_aspect(1.0 / np.cos(np.radians(float(np.mean(axes.get_ylim())))))
    axes.set_xlabel("longitude [deg]")
    axes.set_ylabel("latitude [deg]")
    with staged_file(path) as staged:
        figure.savefig(staged, format="svg" if str(path).endswith(".svg") else "png")
