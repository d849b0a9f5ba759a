"""Charts: axes with layers of numbers, independent of the drawing program.

The functions of `railfix.report.plots` make charts from tables and arrays, long series thinned without changing their
appearance; `railfix.report.plots.draw_chart` draws one with matplotlib, and `railfix.report` puts the same one into
a page, so a notebook and the report show the same numbers.
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

#: Colours distinguishable with colour blindness (Okabe and Ito), with a contrast of 3 to 1 or more on white.
BLUE: Final[str] = "#0072b2"
RED: Final[str] = "#d55e00"
GREEN: Final[str] = "#00805e"
PURPLE: Final[str] = "#a3487e"
BLACK: Final[str] = "#000000"
GREY: Final[str] = "#767676"
#: Positions on the map, of the filter along the track, and conventional, in every chart.
CONSTRAINED: Final[str] = BLUE
FILTERED: Final[str] = GREEN
CONVENTIONAL: Final[str] = RED
#: Ordered classes, from small (dark blue) to large (dark red), none grey as the line is.
ORDERED: Final[tuple[str, ...]] = ("#0b559f", "#3d8ec4", "#a88400", "#e0762f", "#b30000")
#: Classes without an order.
CYCLE: Final = (BLUE, RED, GREEN, PURPLE, BLACK, "#8c6d00", "#56b4e9", GREY)

Shape = Literal["dot", "square", "cross", "ring"]
Scale = Literal["linear", "symlog", "log"]


@dataclass(frozen=True, kw_only=True)
class _Layer:
    """Values drawn in one colour under one name of the legend; a blank one is not in the legend."""

    label: str
    colour: str

    def __post_init__(self) -> None:
        """Raise ValueError where the arrays differ in length."""
        lengths = [len(value) for value in vars(self).values() if isinstance(value, np.ndarray | tuple)]
        if len(set(lengths)) > 1:
            raise ValueError(f"{self.label}: arrays of lengths {lengths}, expected equal ones")


@dataclass(frozen=True, kw_only=True)
class Points(_Layer):
    """Points, P of them."""

    kind: ClassVar[str] = "points"
    shape: Shape = "dot"
    size: float = 3.0  #: Width in pixels of a page.
    #: NaN is not drawn, shape (P,).
    x: Floats
    y: Floats

    #: Time since the start of the run; a click on a point shows the sky at that time; shape (P,).
    epoch_s: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class Curve(_Layer):
    """A line through P points, broken where one is NaN."""

    kind: ClassVar[str] = "line"
    width: float = 1.5
    dash: Literal["solid", "dashed", "dotted"] = "solid"
    x: Floats
    y: Floats


@dataclass(frozen=True, kw_only=True)
class Band(_Layer):
    """The area between two lines of P points, broken where one is NaN."""

    kind: ClassVar[str] = "band"
    x: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True, kw_only=True)
class Bars(_Layer):
    """Upright bars from `left` to `right`, each B long."""

    kind: ClassVar[str] = "bars"
    left: Floats
    right: Floats
    height: Floats


@dataclass(frozen=True, kw_only=True)
class Cells(_Layer):
    """Numbers of points in the cells of a grid; darker cells have more."""

    kind: ClassVar[str] = "cells"
    #: Shape (A + 1,), (B + 1,).
    x_edges: Floats
    y_edges: Floats
    counts: Integers  #: Shape (A, B).

    def __post_init__(self) -> None:
        if self.counts.shape != (len(self.x_edges) - 1, len(self.y_edges) - 1):
            raise ValueError(f"{self.label}: counts have shape {self.counts.shape}, not that of the cells")


@dataclass(frozen=True, kw_only=True)
class RangeBars(_Layer):
    """A bar from minimum to maximum with a mark at the mean for each name, from the top down."""

    kind: ClassVar[str] = "ranges"
    names: tuple[str, ...]
    #: NaN is not drawn, shape (N,).
    low: Floats
    mid: Floats
    high: Floats


@dataclass(frozen=True, kw_only=True)
class Marks(_Layer):
    """Text at points."""

    kind: ClassVar[str] = "marks"
    #: Shape (P,).
    x: Floats
    y: Floats
    words: tuple[str, ...]  #: Lines separated by line feeds.
    place: Literal["beside", "on"] = "beside"  #: Text beside a cross at the point, or centred on it without a cross.


Layer = Points | Curve | Band | Bars | Cells | RangeBars | Marks


@dataclass(frozen=True, kw_only=True)
class Chart:
    """One chart."""

    name: str  #: Short, for files and anchors: ``error-time``.
    #: Heading; explanation with the counts of points left out.
    title: str
    caption: str

    x_label: str
    y_label: str
    layers: tuple[Layer, ...]  #: Drawn in this order.
    start: np.datetime64 | None = None  #: `x` is seconds from this time.
    x_scale: Scale = "linear"
    y_scale: Scale = "linear"
    y_linear: float = 1.0  #: A symlog axis is linear up to here.
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    equal: bool = False  #: Equal scales on both axes; a scale bar and north are drawn.
    width: Literal["wide", "half"] = "wide"

    @property
    def common_axis(self) -> Literal["time", "chainage", ""]:
        """Quantity on the x axis that other charts share: they are zoomed together."""
        if self.start is not None:
            return "time"
        return "chainage" if self.x_label.startswith("chainage") else ""

    @property
    def empty(self) -> bool:
        """Whether no layer has anything to draw."""
        return not any(_has_content(layer) for layer in self.layers)


@dataclass(frozen=True, kw_only=True)
class SkyEpochs:
    """Satellites in view of an antenna, R rows over K epochs, for sky plots."""

    name: str
    title: str
    caption: str
    start: np.datetime64
    epoch_s: Floats  #: Rising, from `start`; shape (K,).
    first: Integers  #: Rows of epoch k: first[k] to first[k + 1]; shape (K + 1,).
    #: Shape (R,).
    satellite: Strings
    signal: Strings
    #: Shape (R,).
    azimuth_deg: Floats
    elevation_deg: Floats
    cn0_dbhz: Floats
    reason: Strings = field(repr=False)  #: First reason for its rejection, or ``used``; shape (R,).

    @property
    def empty(self) -> bool:
        """Whether it has no satellites."""
        return not len(self.satellite)


def _has_content(layer: Layer) -> bool:
    """Return whether a layer has anything to draw; text alone does not count."""
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
    """Return columns adjacent, shape (rows, columns)."""
    return np.stack([floats(table, name) for name in names], axis=1)


def find_start(table: pl.DataFrame) -> np.datetime64:
    """Return the earliest time of a table; ValueError where it is empty."""
    if not len(table):
        raise ValueError("the table has no rows")
    return np.datetime64(table["time_gpst"].to_numpy().min(), "ns")


def since(table: pl.DataFrame, start: np.datetime64) -> Floats:
    """Return the times of a table since a start [s]."""
    return seconds(table["time_gpst"].to_numpy().astype("datetime64[ns]") - start)


def nice_step(rough: float) -> float:
    """1, 2 or 5 times a power of ten, at least `rough`."""
    power = 10.0 ** np.floor(np.log10(max(rough, 1e-9)))
    return float(next(power * k for k in (1.0, 2.0, 5.0, 10.0) if power * k >= rough * (1.0 - 1e-9)))


#: Largest number of points in a layer of a chart: more than two per pixel of a wide chart in a page [1150 pixels].
POINTS: Final = 3000
_GOLDEN: Final = (5**0.5 - 1.0) / 2.0


def extremes(x: Floats, y: Floats, *, points: int = POINTS) -> Indices:
    """Rows of the smallest and largest `y` in each of at most `points` / 2 equal pieces of `x`, rising, not NaN."""
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
    """At most `points` rows, no two in one square cell, which grows from width `cell`; rows with NaN left out."""
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    left, low = (float(v[rows].min()) if len(rows) else 0.0 for v in (x, y))
    while len(rows) > points:
        # rows and columns of the grid as one number each cell
        across, up = ((v[rows] / cell).astype(np.int64) for v in (x - left, y - low))
        _, first = np.unique(across * (int(up.max()) + 1) + up, return_index=True)
        rows = rows[np.sort(first)]
        cell *= 1.5
    return rows


def spread(x: Floats, y: Floats, *, points: int = POINTS) -> Indices:
    """At most `points` rows, not NaN: a fifth extremes, the others by the golden-ratio sequence, evenly dense."""
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(rows) <= points:
        return rows
    outline = extremes(x, y, points=points // 5)
    # the rows of the smallest members of a uniform sequence in [0, 1)
    order = (np.arange(len(rows)) * _GOLDEN) % 1.0
    sample = rows[order < (points - len(outline)) / len(rows)]
    return np.asarray(np.union1d(outline, sample)[:points], dtype=np.intp)


def thin_points(series: Iterable[Points]) -> tuple[list[Layer], str]:
    """Return layers with the points that `spread` keeps of each, and a sentence on the thinning."""
    layers: list[Layer] = []
    shown = total = 0
    for whole in series:
        rows = spread(whole.x, whole.y)
        shown, total = shown + len(rows), total + int(np.isfinite(whole.x + whole.y).sum())
        epoch_s = None if whole.epoch_s is None else whole.epoch_s[rows]
        layers.append(replace(whole, x=whole.x[rows], y=whole.y[rows], epoch_s=epoch_s))
    return layers, counts_sentence(shown, total)


def counts_sentence(shown: int, total: int) -> str:
    """Return a sentence on the thinning, empty if there was none."""
    if shown == total:
        return ""
    return f" {shown:,} of {total:,} points are shown, the extremes among them."
