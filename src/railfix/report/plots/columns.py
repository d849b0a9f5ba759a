"""Columns of the tables as arrays, and long series thinned without changing their appearance."""

from __future__ import annotations

from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Indices, Strings
from railfix.core.timescale import seconds
from railfix.evaluate.run_folder import floats

__all__ = ["floats", "nice_step", "points", "since", "start_of", "words"]


def points(table: pl.DataFrame, *names: str) -> Floats:
    """Columns side by side, shape (rows, columns)."""
    return np.stack([floats(table, name) for name in names], axis=1)


def words(table: pl.DataFrame, name: str) -> Strings:
    """A text column, blank where it is null."""
    return np.array(table[name].cast(pl.String).fill_null("").to_numpy(), dtype=np.str_)


def start_of(table: pl.DataFrame) -> np.datetime64:
    """Earliest time of a table; ValueError where it is empty."""
    if not len(table):
        raise ValueError("the table has no rows")
    return np.datetime64(table["time_gpst"].to_numpy().min(), "ns")


def since(table: pl.DataFrame, start: np.datetime64) -> Floats:
    """Times of a table since a start [s]."""
    return seconds(table["time_gpst"].to_numpy().astype("datetime64[ns]") - start)


def nice_step(rough: float) -> float:
    """1, 2 or 5 times a power of ten, at least `rough`."""
    power = 10.0 ** np.floor(np.log10(max(rough, 1e-9)))
    return float(next(power * k for k in (1.0, 2.0, 5.0, 10.0) if power * k >= rough * (1.0 - 1e-9)))


#: Largest number of points in a layer of a chart.
POINTS: Final = 6000
_GOLDEN: Final = (5**0.5 - 1.0) / 2.0


def extremes(x: Floats, y: Floats, *, points: int = POINTS) -> Indices:
    """Rows of the smallest and the largest `y` in each piece of `x`, in rising order; rows with NaN are left out.

    All rows where there are at most `points`, else two of each of `points` / 2 equal pieces of `x` at most.
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
    """Rows in rising order of which no two lie in one square cell; rows with NaN are left out.

    The cells, at first of width `cell`, grow until at most `points` rows are left.
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
    """At most `points` rows with the same density as all rows, and the extremes of each piece of `x`, in rising order.

    Rows with NaN are left out, the others are sampled uniformly by the golden-ratio sequence, which has no period in
    common with satellites or epochs; a fifth of the points are extremes, so that the outline and single outliers stay.
    """
    rows = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(rows) <= points:
        return rows
    outline = extremes(x, y, points=points // 5)
    # the rows of the smallest members of a uniform sequence in [0, 1)
    order = (np.arange(len(rows)) * _GOLDEN) % 1.0
    sample = rows[order < (points - len(outline)) / len(rows)]
    return np.asarray(np.union1d(outline, sample)[:points], dtype=np.intp)


def counts_sentence(shown: int, total: int) -> str:
    """A sentence on the thinning, empty if there was none."""
    if shown == total:
        return ""
    return f" {shown:,} of {total:,} points are shown, the extremes among them."
