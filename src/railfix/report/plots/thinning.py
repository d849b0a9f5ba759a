"""Fewer points that look the same: the extremes of every short piece are kept."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices

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
    order = np.argsort(piece.astype(np.uint16 if pieces < 65536 else np.intp), kind="stable")
    value, owner = y[rows][order], piece[order]
    first = np.flatnonzero(np.r_[True, np.diff(owner) > 0])
    of_piece = np.repeat(np.arange(len(first)), np.diff(np.r_[first, len(order)]))
    kept = []
    for extreme in (np.minimum.reduceat(value, first), np.maximum.reduceat(value, first)):
        equal = np.flatnonzero(value == extreme[of_piece])
        kept.append(equal[np.flatnonzero(np.r_[True, np.diff(of_piece[equal]) > 0])])
    return np.asarray(np.unique(rows[order[np.concatenate(kept)]]), dtype=np.intp)


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
    left, low = (float(v[rows].min()) if len(rows) else 0.0 for v in (x, y))
    while len(rows) > points:
        # rows and columns of the grid as one number each cell
        across, up = ((v[rows] / cell).astype(np.int64) for v in (x - left, y - low))
        _, first = np.unique(across * (int(up.max()) + 1) + up, return_index=True)
        rows = rows[np.sort(first)]
        cell *= 1.5
    return rows


def spread(x: Floats, y: Floats, *, points: int = POINTS) -> Indices:
    """Rows that look like all: the extremes of every short piece, and one row a cell of a fine grid.

    Parameters
    ----------
    x, y : ndarray, shape (P,)
        Rows with NaN are left out.
    points : int
        How many rows at most; all, if there are no more.

    Returns
    -------
    ndarray of int
        Rows in rising order.
    """
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(rows) <= points:
        return rows
    outer = extremes(x, y, points=points // 3)
    across, up = x[rows], y[rows]
    low, high = np.percentile(up, (1.0, 99.0))
    wide, tall = float(np.ptp(across)) or 1.0, float(high - low) or 1.0
    inner = one_a_cell(400.0 * across / wide, 120.0 * up / tall, cell=1.0, points=points - len(outer))
    return np.asarray(np.union1d(outer, rows[inner]), dtype=np.intp)


def told(shown: int, whole: int) -> str:
    """A sentence on what thinning left, empty if it left all."""
    if shown == whole:
        return ""
    return f" Shown are {shown:,} of {whole:,} points, the extremes of every short piece among them."
