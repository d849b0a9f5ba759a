"""The picture of the probabilities of tracks over the time at rest."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING

import numpy as np

from railfix.report.plots.draw import save_figure

if TYPE_CHECKING:
    from railfix.run.which_track import TrackDecision


def plot_track_decision(decision: TrackDecision, path: str | PathLike[str], *, risk: float) -> None:
    """Draw the probability of not being each track over time, with the risk allowed.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6), dpi=120)
    above, below = figure.subplots(2, 1, sharex=True)
    shares = np.array([p.probability for p in decision.posteriors])
    for k, name in enumerate(decision.posteriors[-1].names):
        if shares[:, k].max() > 1e-3:
            above.plot(decision.seconds, shares[:, k], marker=".", label=name)
            below.semilogy(decision.seconds, np.maximum(1.0 - shares[:, k], 1e-12), marker=".", label=name)
    below.axhline(risk, color="black", linestyle="--", label="risk allowed")
    above.set_ylabel("probability")
    below.set_ylabel("probability of another track")
    below.set_xlabel("time at rest [s]")
    above.set_title(f"track: {decision.track}")
    below.legend(loc="best", fontsize=7)
    save_figure(figure, path)
