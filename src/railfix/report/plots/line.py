"""Charts of the positions on the line: in plan (P1 figure 6), their spacing (figure 12), satellites used."""

from __future__ import annotations

from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Masks
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.core.reasons import Status
from railfix.report.plots.chart import (
    BLACK,
    CONSTRAINED,
    CONVENTIONAL,
    CYCLE,
    GREY,
    ORDERED,
    Bars,
    Chart,
    Layer,
    Line,
    Marks,
    Points,
)
from railfix.report.plots.columns import floats, nice_step, points, since, start_of, words
from railfix.report.plots.thinning import one_a_cell, spread, told

_ECEF: Final = ("x_m", "y_m", "z_m")
#: Classes of the size of an error [m].
_CLASSES: Final = (0.0, 1.0, 2.0, 5.0, 10.0, np.inf)
_TRACK_PIECES: Final = 1500
_MARKS: Final = 12


def plan(positions: pl.DataFrame, *, error_m: Floats | None = None, title: str = "The line in plan") -> Chart:
    """Positions and line in local metres, with marks of the kilometrage (P1 figure 6).

    Parameters
    ----------
    positions : polars.DataFrame
        Of one antenna, columns of `railfix.pipeline.tables.POSITION_COLUMNS`.
    error_m : ndarray, shape (rows,), optional [m]
        Errors along the line; colours the positions by their size, instead of by their status.
    title : str

    Returns
    -------
    Chart
        Without layers where there is no position.
    """
    ecef, conventional = points(positions, *_ECEF), points(positions, *(f"conventional_{name}" for name in _ECEF))
    has = np.isfinite(ecef[:, 0])
    name, labels = "plan", ("east [m]", "north [m]")
    if not has.any():
        return Chart(name=name, title=title, caption="", x_label=labels[0], y_label=labels[1], layers=(), equal=True)
    origin = ecef[has].mean(axis=0)
    latitude, longitude, _ = geodetic_from_ecef(origin)
    axes = enu_axes(latitude, longitude)
    here, there = (ecef - origin) @ axes.T, (conventional - origin) @ axes.T
    cell = float(np.ptp(here[has, :2], axis=0).max()) / 3000.0 or 0.01
    kept = one_a_cell(there[:, 0], there[:, 1], cell=cell)
    layers: list[Layer] = [
        Points(
            label="conventional",
            colour=GREY,
            shape="cross",
            x=there[kept, 0],
            y=there[kept, 1],
        ),
        _line_of(here[has], floats(positions, "chainage_m")[has]),
    ]
    shown, whole = len(kept), int(np.isfinite(there[:, 0]).sum())
    epoch = since(positions, start_of(positions))
    for label, colour, mask in _classes(positions, error_m):
        rows = np.flatnonzero(has & mask)
        kept = rows[one_a_cell(here[rows, 0], here[rows, 1], cell=cell)]
        shown, whole = shown + len(kept), whole + len(rows)
        if len(kept):
            layers.append(
                Points(
                    label=f"{label} ({len(rows):,})",
                    colour=colour,
                    x=here[kept, 0],
                    y=here[kept, 1],
                    size=4.0,
                    epoch_s=epoch[kept],
                )
            )
    layers.append(_kilometrage(positions.filter(pl.Series(has)), here[has]))
    where = f"{float(latitude):.5f}, {float(longitude):.5f}"
    thinned = "" if shown == whole else f" Of positions closer together than can be seen one is drawn ({shown:,})."
    coloured = "the size of their error" if error_m is not None else "their status"
    return Chart(
        name=name,
        title=title,
        caption=f"Positions on the map by {coloured}, the conventional ones in grey; the line as far as positions "
        f"reach. Origin at latitude and longitude {where}.{thinned}",
        x_label=labels[0],
        y_label=labels[1],
        layers=tuple(layers),
        equal=True,
    )


def _classes(positions: pl.DataFrame, error_m: Floats | None) -> list[tuple[str, str, Masks]]:
    """Label, colour and rows of each class of positions."""
    if error_m is None:
        status = words(positions, "status")
        return [
            (s.text, CYCLE[i % len(CYCLE)], status == s.text) for i, s in enumerate(Status) if (status == s.text).any()
        ]
    size = np.abs(error_m)
    found = [("no reference", BLACK, np.isnan(size))]
    for low, high, colour in zip(_CLASSES[:-1], _CLASSES[1:], ORDERED, strict=True):
        label = f"from {low:g} to {high:g} m" if np.isfinite(high) else f"{low:g} m and more"
        found.append((label, colour, (size >= low) & (size < high)))
    return found


def _line_of(here: Floats, chainage_m: Floats) -> Line:
    """The line as the positions show it: the middle of each short piece, broken at wide gaps."""
    order = np.argsort(chainage_m, kind="stable")
    chainage, place = chainage_m[order], here[order]
    width = max(float(np.ptp(chainage)) / _TRACK_PIECES, 0.5)
    first = np.flatnonzero(np.r_[True, np.diff(np.floor(chainage / width)) > 0])
    x, y, at = place[first, 0], place[first, 1], chainage[first]
    gap = np.flatnonzero(np.diff(at) > 20 * width + 50.0) + 1
    return Line(
        label="line",
        colour="#9a9a9a",
        x=np.insert(x, gap, np.nan),
        y=np.insert(y, gap, np.nan),
        width=4.0,
    )


def _kilometrage(positions: pl.DataFrame, here: Floats) -> Marks:
    """About a dozen marks at round places: the line's own marking, or the chainage where it has none."""
    along = floats(positions, "kilometrage_m")
    label = "kilometrage"
    if not np.isfinite(along).any():
        along, label = floats(positions, "chainage_m"), "chainage"
    low, high = float(np.nanmin(along)), float(np.nanmax(along))
    step = nice_step((high - low) / _MARKS)
    found_x, found_y, texts = [], [], []
    for mark in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step:
        row = int(np.nanargmin(np.abs(along - mark)))
        if abs(along[row] - mark) <= 0.2 * step:
            found_x.append(here[row, 0])
            found_y.append(here[row, 1])
            texts.append(f"{mark:,.0f} m" if step < 1000 else f"{mark / 1000:g} km")
    return Marks(label=label, colour=BLACK, x=np.array(found_x), y=np.array(found_y), words=tuple(texts))


def interval(table: pl.DataFrame, prefix: str = "") -> tuple[Floats, Floats]:
    """Distance from each position to the one before while the train ran.

    Parameters
    ----------
    table : polars.DataFrame
        Of one antenna, in order of time. Of an evaluation (`railfix.evaluate.EPOCH_COLUMNS`) the distances
        of the reference are taken; of positions alone (`railfix.pipeline.tables.POSITION_COLUMNS`), their own.
    prefix : "" or the start of the names of the conventional ones
        Which positions.

    Returns
    -------
    ndarray, ndarray, shape (P,) [m]
        Place of each position but the first, and the distance; where the train stood there is none.
    """
    if f"{prefix}interval_m" in table.columns:
        place, distance = floats(table, "chainage_m"), floats(table, f"{prefix}interval_m")
        ran = distance > 0.0
        return place[ran], distance[ran]
    place = floats(table, f"{prefix}chainage_m")
    at = place[np.isfinite(place)]
    return at[1:], np.abs(np.diff(at))


_FIXES: Final = (
    ("conventional", "conventional_", CONVENTIONAL, "square"),
    ("on the map", "", CONSTRAINED, "dot"),
)


def interval_over_chainage(table: pl.DataFrame, *, title: str = "Positioning interval") -> Chart:
    """Distance from each position to the one before, over the place (P1 figure 12).

    Parameters
    ----------
    table : polars.DataFrame
        See `interval`.
    title : str

    Returns
    -------
    Chart
    """
    layers: list[Layer] = []
    shown = whole = 0
    said = []
    for label, prefix, colour, shape in _FIXES:
        x, y = interval(table, prefix)
        rows = spread(x, y)
        shown, whole = shown + len(rows), whole + len(x)
        layers.append(Points(label=label, colour=colour, shape=shape, x=x[rows], y=y[rows]))  # type: ignore[arg-type]
        if len(y):
            said.append(f"{label} {y.max():.2f} m")
    return Chart(
        name="interval-chainage",
        title=title,
        caption=f"Distance along the line from each position to the one before. {_by(table)} "
        f"The longest: {', '.join(said)}.{told(shown, whole)}",
        x_label="chainage [m]",
        y_label="from the position before [m]",
        layers=tuple(layers),
        width="half",
    )


def interval_distribution(table: pl.DataFrame, *, title: str = "Positioning interval, distribution") -> Chart:
    """How many positions are how far from the one before (P1 figure 12).

    Parameters
    ----------
    table : polars.DataFrame
        See `interval`.
    title : str

    Returns
    -------
    Chart
    """
    found = {label: interval(table, prefix)[1] for label, prefix, _, _ in _FIXES}
    largest = max((float(y.max()) for y in found.values() if len(y)), default=1.0)
    step = nice_step(max(largest, 1e-3) / 40.0)
    edges = np.arange(0.0, largest + 2.0 * step, step)
    layers = []
    for side, (label, _, colour, _) in enumerate(_FIXES):
        counts, _ = np.histogram(found[label], bins=edges)
        left = edges[:-1] + 0.5 * side * step
        layers.append(
            Bars(label=label, colour=colour, left=left, right=left + 0.5 * step, height=counts.astype(np.float64))
        )
    return Chart(
        name="interval-distribution",
        title=title,
        caption=f"Positions by their distance from the one before, in classes of {step:g} m. {_by(table)}",
        x_label="from the position before [m]",
        y_label="positions",
        layers=tuple(layers),
        y_scale="log",
        width="half",
    )


def _by(table: pl.DataFrame) -> str:
    if "interval_m" in table.columns:
        return "Distances that the train ran by the reference; where it stood there is none."
    return "Without a reference the positions themselves tell the distance, their noise included."


def satellites_over_time(positions: pl.DataFrame, *, title: str = "Satellites") -> Chart:
    """Satellites used and refused at each epoch.

    Parameters
    ----------
    positions : polars.DataFrame
        Of one antenna.
    title : str

    Returns
    -------
    Chart
    """
    start = start_of(positions)
    x = since(positions, start)
    layers: list[Layer] = []
    shown = whole = 0
    for label, column, colour in (("refused", "n_rejected", CONVENTIONAL), ("used", "n_used", CONSTRAINED)):
        y = floats(positions, column)
        rows = spread(x, y)
        shown, whole = shown + len(rows), whole + len(x)
        layers.append(Points(label=label, colour=colour, x=x[rows], y=y[rows], epoch_s=x[rows]))
    return Chart(
        name="satellites",
        title=title,
        caption=f"Satellites with a pseudorange.{told(shown, whole)}",
        x_label="GPS time",
        y_label="satellites",
        layers=tuple(layers),
        start=start,
    )
