"""Spans of time in which nothing that a GEO says changes: what is looked up once need not be looked up again."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Indices, Integers
from railfix.core.timescale import timedelta

Answer = TypeVar("Answer", bound=np.generic)


class Spans:
    """Instants at which an answer can change: receptions, and receptions plus each time-out.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (N,)
        Reception of all messages.
    timeouts_s : sequence of float
    """

    def __init__(self, time: Datetimes, timeouts_s: Sequence[float]) -> None:
        ends = [time, *(time + timedelta(np.asarray(float(seconds))) for seconds in timeouts_s)]
        self._edges = np.unique(np.concatenate(ends)) if len(time) else time

    def number(self, time: Datetimes) -> Integers:
        """Number of the span of instants; an instant that is an edge has a number of its own."""
        before = np.searchsorted(self._edges, time, side="left")
        return np.asarray(before + np.searchsorted(self._edges, time, side="right"), dtype=np.int64)


def once_each(span: Integers, point: Integers, points: int) -> tuple[Indices, Indices]:
    """First row of each different combination of span and four points, and the combination of each row.

    Parameters
    ----------
    span : ndarray of int, shape (M,)
    point : ndarray of int, shape (M, 4)
        From -1 to below `points`.
    points : int

    Returns
    -------
    first : ndarray of int, shape (U,)
    which : ndarray of int, shape (M,)
    """
    # Runs of one span have one number; that a span has two where it comes twice does no harm.
    key = np.cumsum(np.r_[False, span[1:] != span[:-1]])[: len(span)].astype(np.int64)
    pairs = (point[:, ::2] + 1) * (points + 1) + point[:, 1::2] + 1
    # Numbered anew half-way, so that the keys stay small however long the log is.
    _, key = np.unique(key * (points + 1) ** 2 + pairs[:, 0], return_inverse=True)
    _, first, which = np.unique(key * (points + 1) ** 2 + pairs[:, 1], return_index=True, return_inverse=True)
    return first, which


def looked_up(
    answer: Callable[[Integers, Datetimes], NDArray[Answer]],
    span: Integers,
    point: Integers,
    time: Datetimes,
    points: int,
) -> NDArray[Answer]:
    """What `answer` says of four points at an instant, asked once for each span: shape (M, ...)."""
    first, which = once_each(span, point, points)
    return np.asarray(answer(point[first], time[first])[which])
