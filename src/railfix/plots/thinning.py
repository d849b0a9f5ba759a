"""Fewer points that look the same: the extremes of every short piece are kept."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

#: Points of one layer of a chart.
POINTS: Final = 6000


def extremes(x: Floats, y: Floats, *, points: int = POINTS) -> Indices:
    """Rows that keep the least and the greatest `y` of every piece of `x`.

    Parameters
    ----------
    x, y : ndarray, shape (P,)
        Rows with NaN are left out.
    points : int
        About how many rows are left; all, if there are no more.

    Returns
    -------
    ndarray of int
        Rows in rising order: of each of `points` / 2 equal pieces of `x` two at most.
    """
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(rows) <= points:
        return rows
    pieces = max(points // 2, 1)
    low, high = float(x[rows].min()), float(x[rows].max())
    piece = np.minimum((pieces * ((x[rows] - low) / ((high - low) or 1.0))).astype(np.intp), pieces - 1)
    order = np.lexsort((y[rows], piece))
    edge = np.flatnonzero(np.diff(piece[order])) + 1
    least = order[np.r_[0, edge]]
    greatest = order[np.r_[edge, len(order)] - 1]
    return np.asarray(np.unique(rows[np.r_[least, greatest]]), dtype=np.intp)


def one_a_cell(x: Floats, y: Floats, *, cell: float, points: int = POINTS) -> Indices:
    """Rows of which no two lie in one square cell; the cells grow until few enough are left.

    Parameters
    ----------
    x, y : ndarray, shape (P,)
        Rows with NaN are left out.
    cell : float
        Width of a cell to begin with.
    points : int

    Returns
    -------
    ndarray of int
        Rows in rising order.
    """
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    while len(rows) > points:
        at = np.stack([np.floor(x[rows] / cell), np.floor(y[rows] / cell)], axis=1)
        _, first = np.unique(at, axis=0, return_index=True)
        rows = rows[np.sort(first)]
        cell *= 1.5
    return rows


def envelope(x: Floats, y: Floats, *, points: int = POINTS) -> tuple[Floats, Floats]:
    """A line with the greatest `y` of every piece of rising `x`; NaN stays where a whole piece is NaN.

    Parameters
    ----------
    x : ndarray, shape (P,)
        Rising.
    y : ndarray, shape (P,)
    points : int

    Returns
    -------
    ndarray, ndarray, shape (Q,)
    """
    if len(x) <= points:
        return x, y
    edges = np.linspace(0, len(x), points + 1).astype(np.intp)[:-1]
    greatest = np.maximum.reduceat(np.where(np.isnan(y), -np.inf, y), edges)
    greatest[np.isneginf(greatest)] = np.nan
    return x[edges], greatest


def told(shown: int, whole: int) -> str:
    """A sentence on what thinning left, empty if it left all."""
    if shown == whole:
        return ""
    return f" Shown are {shown:,} of {whole:,} points, the extremes of every short piece among them."
