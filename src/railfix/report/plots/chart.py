"""Charts: axes with layers of numbers, independent of the drawing program.

A `Chart` is axes with layers of numbers. The functions of `railfix.report.plots` make charts from tables and
arrays; `railfix.report.plots.draw_chart` draws one with matplotlib, and `railfix.report` puts the same one into
a page, so a notebook and the report show the same numbers.

Long series are thinned when a chart is made (`railfix.report.plots.columns`); the caption has the counts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import Floats, Integers, Strings

#: Colours distinguishable with colour blindness (Okabe and Ito), with a contrast of 3 to 1 or more on white.
BLUE, RED, GREEN, PURPLE, BLACK, GREY = "#0072b2", "#d55e00", "#00805e", "#a3487e", "#000000", "#767676"
#: Positions on the map, of the filter along the track, and conventional, in every chart.
CONSTRAINED: Final = BLUE
FILTERED: Final = GREEN
CONVENTIONAL: Final = RED
#: Ordered classes, from small (dark blue) to large (dark red), none grey as the line is.
ORDERED: Final = ("#0b559f", "#3d8ec4", "#a88400", "#e0762f", "#b30000")
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

    #: NaN is not drawn, shape (P,).
    x: Floats
    y: Floats

    shape: Shape = "dot"
    size: float = 3.0  #: Width in pixels of a page.
    #: Time since the start of the run; a click on a point shows the sky at that time; shape (P,).
    epoch_s: Floats | None = None


@dataclass(frozen=True, kw_only=True)
class Curve(_Layer):
    """A line through P points, broken where one is NaN."""

    x: Floats
    y: Floats
    width: float = 1.5
    dash: Literal["solid", "dashed", "dotted"] = "solid"


@dataclass(frozen=True, kw_only=True)
class Band(_Layer):
    """The area between two lines of P points, broken where one is NaN."""

    x: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True, kw_only=True)
class Bars(_Layer):
    """Upright bars from `left` to `right`, each B long."""

    left: Floats
    right: Floats
    height: Floats


@dataclass(frozen=True, kw_only=True)
class Cells(_Layer):
    """Numbers of points in the cells of a grid; darker cells have more."""

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

    names: tuple[str, ...]
    #: NaN is not drawn, shape (N,).
    low: Floats
    mid: Floats
    high: Floats


@dataclass(frozen=True, kw_only=True)
class Marks(_Layer):
    """Text at points."""

    #: Shape (P,).
    x: Floats
    y: Floats
    words: tuple[str, ...]  #: Lines separated by line feeds.
    place: Literal["beside", "on"] = "beside"  #: Beside a cross at the point, or centred on it without a cross.


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
    def shared_axis(self) -> Literal["time", "chainage", ""]:
        """Quantity on the x axis that other charts share: they are zoomed together."""
        if self.start is not None:
            return "time"
        return "chainage" if self.x_label.startswith("chainage") else ""

    @property
    def empty(self) -> bool:
        """Whether no layer has anything to draw."""
        return not any(_draw(layer) for layer in self.layers)


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
        """Whether there is no satellite."""
        return not len(self.satellite)


def _draw(layer: Layer) -> bool:
    """Whether a layer has anything to draw; text alone does not count."""
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
