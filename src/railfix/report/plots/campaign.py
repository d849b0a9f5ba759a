"""Charts of the runs of a campaign: their lines with the worst places, and errors or levels by run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import polars as pl

from railfix.core.arrays import Floats
from railfix.report.plots.chart import CONSTRAINED, FILTERED, Chart, Layer, Points, RangeBars
from railfix.report.plots.columns import floats, points
from railfix.report.plots.line import ECEF, ERROR_CLASSES, LEVEL_CLASSES, LocalFrame, size_classes

#: Quantities by their column: what the legend says, limits of the classes [m], and the colour of bars.
_QUANTITIES = {
    "error_m": ("error", ERROR_CLASSES, CONSTRAINED),
    "protection_level_m": ("level", LEVEL_CLASSES, FILTERED),
    "along_sigma_m": ("standard deviation", ERROR_CLASSES, CONSTRAINED),
}


def campaign_plan(places: pl.DataFrame, quantity: str) -> Chart:
    """Plan of the places of all runs, coloured by the size of a quantity; the largest are drawn last.

    Parameters
    ----------
    places : polars.DataFrame
        Columns ``x_m``, ``y_m``, ``z_m`` [m, ECEF] and `quantity` [m].
    quantity : str
        ``error_m``, ``protection_level_m`` or ``along_sigma_m``.
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
        caption=f"Each run in pieces of the line; a point is the epoch with the largest {named} of its piece.{where}",
        equal=True,
    )  # fmt: skip


def campaign_bars(names: Sequence[str], low: Floats, middle: Floats, high: Floats, quantity: str) -> Chart:
    """Bars of a quantity by run, from `low` to `high` with a mark at `middle`, each of shape (runs,) [m]."""
    named, _, colour = _QUANTITIES[quantity]
    top = float(np.nanmax(high[np.isfinite(high)], initial=0.0)) or 1.0
    bars = RangeBars(label=named, colour=colour, names=tuple(names), low=low, mid=middle, high=high)
    return Chart(
        name=f"campaign-{named.split()[0]}", title=f"{named.capitalize()} by run", x_label=f"{named} [m]", y_label="",
        x_range=(0.0, 1.04 * top), layers=(bars,),
        caption="From the median to the largest; the mark is the 95th percentile.",
    )  # fmt: skip
