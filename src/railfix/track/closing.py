"""Joins of lines that close on themselves: rings, loops at a terminus, courses run several times."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats

#: A line goes on where its end comes this close to another place of it [m]: no other track is as near.
_CLOSED_M: Final = 3.0
#: In the same direction: cosine of the angle between them.
_SAME_WAY: Final = 0.9
#: Places this near along the line are the end itself [m].
_END_M: Final = 100.0


def joins_m(arc_m: Floats, ecef_m: Floats) -> tuple[float, float]:
    """Return the arc lengths at which a closed line goes on before its start and after its end; NaN at an open end.

    From the rising arc lengths of V points and the points, shape (V, 3).
    """
    segment = np.diff(ecef_m, axis=0)
    segment /= np.linalg.norm(segment, axis=1, keepdims=True)
    return _beside(arc_m, ecef_m, segment, 0), _beside(arc_m, ecef_m, segment, -1)


def _beside(arc_m: Floats, ecef_m: Floats, segment: Floats, end: int) -> float:
    """Arc length of the nearest other place of the line to one of its ends, in the same direction; NaN without."""
    from_end = ecef_m[end] - ecef_m[:-1]
    length = np.diff(arc_m)
    along = np.clip((from_end * segment).sum(axis=1), 0.0, length)
    apart = np.linalg.norm(from_end - along[:, None] * segment, axis=1)
    arc = arc_m[:-1] + along
    other = np.abs(arc - arc_m[end]) > _END_M
    other &= (apart < _CLOSED_M) & (segment @ segment[end] > _SAME_WAY)
    return float(arc[other][np.argmin(apart[other])]) if other.any() else float("nan")
