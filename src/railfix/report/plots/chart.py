"""Charts described by axes and layers of numbers, independently of the library that draws them.

Functions of `railfix.report.plots` return charts of tables and arrays; long series are thinned without changing their
appearance. `railfix.report.plots.draw_chart` draws a chart with matplotlib, and `railfix.report` includes it in a page,
so that a notebook and the report show the same numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import ClassVar, Final, Literal

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Indices, Integers, Strings
from railfix.core.timescale import seconds
from railfix.evaluate.evaluation_inputs import floats, words

#: Colours that colour-blind readers can distinguish (Okabe and Ito), with a contrast of at least 3:1 on white.
BLUE: Final[str] = "#0072b2"
RED: Final[str] = "#d55e00"
GREEN: Final[str] = "#00805e"
PURPLE: Final[str] = "#a3487e"
BLACK: Final[str] = "#000000"
GREY: Final[str] = "#767676"
#: Colours in all charts: positions computed with the map, filter along the track, and conventional positions.
CONSTRAINED: Final[str] = BLUE
FILTERED: Final[str] = GREEN
CONVENTIONAL: Final[str] = RED
#: Colours of ordered classes, from small (dark blue) to large (dark red); none is grey, the colour of the line.
ORDERED: Final[tuple[str, ...]] = ("#0b559f", "#3d8ec4", "#a88400", "#e0762f", "#b30000")
#: Colours of classes without an order.
CYCLE: Final = (BLUE, RED, GREEN, PURPLE, BLACK, "#8c6d00", "#56b4e9", GREY)

Shape = Literal["dot", "square", "cross", "ring"]
Scale = Literal["linear", "symlog", "log"]


@dataclass(frozen=True, kw_only=True)
class _Layer:
    """Values that are drawn in one colour; `label` is the entry in the legend, "" for no entry."""

    label: str
    colour: str

    def __post_init__(self) -> None:
        """Raise ValueError if the arrays differ in length."""
        lengths = [len(value) for value in vars(self).values() if isinstance(value, np.ndarray | tuple)]
        if len(set(lengths)) > 1:
            raise ValueError(f"{self.label}: arrays of lengths {lengths}, expected equal lengths")


@dataclass(frozen=True, kw_only=True)
class Points(_Layer):
    """P separate points."""

    kind: ClassVar[str] = "points"
    shape: Shape = "dot"
    size: float = 3.0  #: Width of a point on a page [pixels].
    #: Coordinates, shape (P,); points with NaN are not drawn.
    x: Floats
    y: Floats

    #: Time of each point [s], as in the sky plot, shape (P,); a click on a point shows the sky at its time.
    epoch_s: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class Curve(_Layer):
    """Line through P points, interrupted at points with NaN."""

    kind: ClassVar[str] = "line"
    width: float = 1.5
    dash: Literal["solid", "dashed", "dotted"] = "solid"
    x: Floats
    y: Floats


@dataclass(frozen=True, kw_only=True)
class Band(_Layer):
    """Area between two lines with P points each, interrupted at points with NaN."""

    kind: ClassVar[str] = "band"
    x: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True, kw_only=True)
class Bars(_Layer):
    """B vertical bars, each from `left` to `right` on the x axis."""

    kind: ClassVar[str] = "bars"
    left: Floats
    right: Floats
    height: Floats


@dataclass(frozen=True, kw_only=True)
class Cells(_Layer):
    """Numbers of points in the A x B cells of a grid; darker cells have more points."""

    kind: ClassVar[str] = "cells"
    #: Edges of the cells along x and y, shapes (A + 1,) and (B + 1,).
    x_edges: Floats
    y_edges: Floats
    counts: Integers  #: Number of points in each cell, shape (A, B).

    def __post_init__(self) -> None:
        if self.counts.shape != (len(self.x_edges) - 1, len(self.y_edges) - 1):
            raise ValueError(f"{self.label}: counts of shape {self.counts.shape} do not fit the edges")


@dataclass(frozen=True, kw_only=True)
class RangeBars(_Layer):
    """N horizontal bars from `low` to `high` with a mark at `mid`, one per name, from top to bottom."""

    kind: ClassVar[str] = "ranges"
    names: tuple[str, ...]
    #: Lower end, mark and upper end of each bar, shape (N,); bars with NaN are not drawn.
    low: Floats
    mid: Floats
    high: Floats


@dataclass(frozen=True, kw_only=True)
class Marks(_Layer):
    """Text labels at P points of a chart."""

    kind: ClassVar[str] = "marks"
    #: Coordinates of the texts, shape (P,).
    x: Floats
    y: Floats
    words: tuple[str, ...]  #: Text at each point; a line feed begins a new line of the text.
    #: Position of the text: "beside" a cross at the point, or centred "on" the point without a cross.
    place: Literal["beside", "on"] = "beside"


Layer = Points | Curve | Band | Bars | Cells | RangeBars | Marks


@dataclass(frozen=True, kw_only=True)
class Chart:
    """Chart with two axes."""

    name: str  #: Short name of the chart for files and page elements, such as ``error-time``.
    title: str
    caption: str  #: Explanation of the chart, with the number of omitted points.

    x_label: str
    y_label: str
    layers: tuple[Layer, ...]  #: Layers in the order in which they are drawn.
    start: np.datetime64 | None = None  #: GPS time at which `x` is 0; None if the x axis is not time.
    x_scale: Scale = "linear"
    y_scale: Scale = "linear"
    y_linear: float = 1.0  #: A symlog y axis is linear up to this absolute value.
    #: Range of each axis; None if the data determine it.
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    equal: bool = False  #: Whether the axes are east and north with equal scales; an arrow to the north is then drawn.
    width: Literal["wide", "half"] = "wide"  #: Width of the chart in a page.

    @property
    def common_axis(self) -> Literal["time", "chainage", ""]:
        """Quantity on the x axis, by which charts are zoomed together; "" for a chart that is zoomed alone."""
        if self.start is not None:
            return "time"
        return "chainage" if self.x_label.startswith("chainage") else ""

    @property
    def empty(self) -> bool:
        """Whether no layer has anything to draw."""
        return not any(_has_content(layer) for layer in self.layers)


@dataclass(frozen=True, kw_only=True)
class SkyEpochs:
    """Satellites in view of an antenna for sky plots: R rows in K epochs."""

    name: str
    title: str
    caption: str
    start: np.datetime64  #: GPS time from which `epoch_s` counts.
    epoch_s: Floats  #: Times of the epochs in ascending order [s], shape (K,).
    first: Integers  #: Index of the first row of each epoch; the last value is R; shape (K + 1,).
    #: Satellite and signal of each row, shape (R,).
    satellite: Strings
    signal: Strings
    #: Direction and C/N0 of the satellite of each row, shape (R,); NaN if the C/N0 is unknown.
    azimuth_deg: Floats
    elevation_deg: Floats
    cn0_dbhz: Floats
    reason: Strings = field(repr=False)  #: First rejection reason of each row, or ``used``; shape (R,).

    @property
    def empty(self) -> bool:
        """Whether there are no satellites."""
        return not len(self.satellite)


def _has_content(layer: Layer) -> bool:
    """Return whether a layer has anything to draw other than text."""
    if isinstance(layer, Marks):
        return False
    if isinstance(layer, Cells):
        return bool(layer.counts.any())
    if isinstance(layer, Bars):
        return bool((layer.height > 0).any())
    if isinstance(layer, Band):
        return bool(np.isfinite(layer.low).any())
    if isinstance(layer, RangeBars):
        return bool(np.isfinite(layer.mid).any())
    return bool((np.isfinite(layer.x) & np.isfinite(layer.y)).any())


__all__ = ["find_start", "floats", "nice_step", "points", "since", "words"]


def points(table: pl.DataFrame, *names: str) -> Floats:
    """Return columns of a table as one array, shape (rows, columns); NaN for absent values."""
    return np.stack([floats(table, name) for name in names], axis=1)


def find_start(table: pl.DataFrame) -> np.datetime64:
    """Return the earliest time of a table; raise ValueError if the table is empty."""
    if not len(table):
        raise ValueError("the table has no rows")
    return np.datetime64(table["time_gpst"].to_numpy().min(), "ns")


def since(table: pl.DataFrame, start: np.datetime64) -> Floats:
    """Return the times of a table, counted from `start` [s]."""
    return seconds(table["time_gpst"].to_numpy().astype("datetime64[ns]") - start)


def nice_step(rough: float) -> float:
    """Return the smallest number that is 1, 2 or 5 times a power of ten, and not less than `rough`."""
    power = 10.0 ** np.floor(np.log10(max(rough, 1e-9)))
    return float(next(power * k for k in (1.0, 2.0, 5.0, 10.0) if power * k >= rough * (1.0 - 1e-9)))


#: Maximum number of points in a layer: more than two per pixel of the widest chart in a page (1150 pixels).
POINTS: Final = 3000
_GOLDEN: Final = (5**0.5 - 1.0) / 2.0


def extremes(x: Floats, y: Floats, *, points: int = POINTS) -> Indices:
    """Return the ascending indices of all points that have the smallest or largest `y` in one of `points` / 2 equal
    pieces of the x range.

    Points with NaN are omitted. If at most `points` points are left, the indices of all of them are returned.
    """
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(rows) <= points:
        return rows
    pieces = max(points // 2, 1)
    low, high = float(x[rows].min()), float(x[rows].max())
    piece = np.minimum((pieces * ((x[rows] - low) / ((high - low) or 1.0))).astype(np.intp), pieces - 1)
    order = np.argsort(piece.astype(np.uint16 if pieces < 65536 else np.intp), kind="stable")
    value, owner = y[rows][order], piece[order]
    first = np.flatnonzero(np.r_[True, np.diff(owner) > 0])
    of_piece = np.repeat(np.arange(len(first)), np.diff(np.r_[first, len(order)]))
    kept = []
    for extreme in (np.minimum.reduceat(value, first), np.maximum.reduceat(value, first)):
        equal = np.flatnonzero(value == extreme[of_piece])
        kept.append(equal[np.flatnonzero(np.r_[True, np.diff(of_piece[equal]) > 0])])
    return np.asarray(np.unique(rows[order[np.concatenate(kept)]]), dtype=np.intp)


def one_per_cell(x: Floats, y: Floats, *, cell: float, points: int = POINTS) -> Indices:
    """Return the indices of at most one point per square cell; if there are few points, return all indices.

    Points with NaN are omitted. If more than `points` points are left, one per cell is selected; the width of the cells
    is first `cell`, and is increased until at most `points` points are selected. Otherwise all points are selected.
    """
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    left, low = (float(v[rows].min()) if len(rows) else 0.0 for v in (x, y))
    while len(rows) > points:
        # the row and the column of a cell are combined into one number
        across, up = ((v[rows] / cell).astype(np.int64) for v in (x - left, y - low))
        _, first = np.unique(across * (int(up.max()) + 1) + up, return_index=True)
        rows = rows[np.sort(first)]
        cell *= 1.5
    return rows


def spread(x: Floats, y: Floats, *, points: int = POINTS) -> Indices:
    """Return the indices of at most `points` points that represent a series.

    Points with NaN are omitted. If at most `points` points are left, all are selected. Otherwise `extremes` selects a
    fifth of the points, and a golden-ratio sequence spreads the rest evenly over the series.
    """
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(rows) <= points:
        return rows
    outline = extremes(x, y, points=points // 5)
    # the low-discrepancy sequence is uniform in [0, 1), so that rows below a threshold are evenly distributed
    order = (np.arange(len(rows)) * _GOLDEN) % 1.0
    sample = rows[order < (points - len(outline)) / len(rows)]
    return np.asarray(np.union1d(outline, sample)[:points], dtype=np.intp)


def thin_points(series: Iterable[Points]) -> tuple[list[Layer], str]:
    """Return layers with the points that `spread` selects from each series, and a sentence on the number of points."""
    layers: list[Layer] = []
    shown = total = 0
    for whole in series:
        rows = spread(whole.x, whole.y)
        shown, total = shown + len(rows), total + int(np.isfinite(whole.x + whole.y).sum())
        epoch_s = None if whole.epoch_s is None else whole.epoch_s[rows]
        layers.append(replace(whole, x=whole.x[rows], y=whole.y[rows], epoch_s=epoch_s))
    return layers, counts_sentence(shown, total)


def counts_sentence(shown: int, total: int) -> str:
    """Return a sentence on the number of points shown, beginning with a space; "" if all points are shown."""
    if shown == total:
        return ""
    return f" {shown:,} of {total:,} points are shown, including the extremes."
