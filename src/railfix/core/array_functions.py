"""Medians that ignore NaN, and the cheapest path through layers of nodes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks


def masked_median(values: Floats, known: Masks) -> Floats:
    """Return the median of the known values of each row, shape (T,); NaN for a row without known values."""
    return medians(np.where(known, values, np.nan))


def cheapest_path(costs: Sequence[Floats], steps: Iterable[Floats]) -> list[int]:
    """Return the index of one node per layer for which the sum of node and step costs is smallest (Viterbi algorithm).

    `costs` has the node costs of each layer, shape (n,). `steps` has the step costs to the n nodes of each layer except
    the first, from the m nodes of the layer before, shape (n, m).
    """
    total, came = costs[0], list[Indices]()
    for cost, step in zip(costs[1:], steps, strict=True):
        reached = total + step
        came.append(reached.argmin(axis=1))
        total = reached.min(axis=1) + cost
    path = [int(total.argmin())]
    for before in reversed(came):
        path.append(int(before[path[-1]]))
    return path[::-1]


def medians(values: Floats) -> Floats:
    """Return the medians along the last axis, ignoring NaN; NaN if all values are NaN."""
    low, high = middle_values(values)
    return np.asarray((low + high) / 2.0)


def middle_values(values: Floats) -> tuple[Floats, Floats]:
    """Return the lower and the upper median along the last axis, ignoring NaN; NaN if all values are NaN."""
    *shape, width = values.shape
    if not width:
        return np.full(shape, np.nan), np.full(shape, np.nan)
    rows = values.reshape(-1, width).copy()
    rows.sort()  # NaN last
    count, row = (rows == rows).sum(axis=1), np.arange(len(rows))
    low, high = rows[row, np.maximum(count - 1, 0) // 2], rows[row, np.minimum(count // 2, width - 1)]
    return low.reshape(shape), high.reshape(shape)
