"""Points, axes and gradient of the line at an arc length, as in `railfix.tracking.line.Line`."""

from __future__ import annotations

import math

import numpy as np

from railfix.core.arrays import Floats
from railfix.kernels.compiling import inner
from railfix.kernels.tracking.layout import Record, Records


@inner
def wrap_arc(vertex: Records, line: Record, arc: float) -> float:
    """Return the arc length, shifted by whole laps into the line if it is beyond a closed end (`Line.round_m`)."""
    first, last = vertex[0].arc_m, vertex[-1].arc_m
    if arc > last and line.end_turn_m > 0.0:
        return float(arc - math.ceil((arc - last) / line.end_turn_m) * line.end_turn_m)
    if arc < first and line.start_turn_m > 0.0:
        return float(arc + math.ceil((first - arc) / line.start_turn_m) * line.start_turn_m)
    return arc


@inner
def nearest_arc(vertex: Records, line: Record, place: float, to: float) -> float:
    """Return arc length `place` plus the whole laps that bring it nearest to arc length `to` (`Line.nearest_m`)."""
    inside = wrap_arc(vertex, line, to)
    nearest = place
    if line.end_turn_m > 0.0 and place >= vertex[-1].arc_m - line.end_turn_m:
        other = place + line.end_turn_m
        nearest = other if abs(other - inside) < abs(nearest - inside) else nearest
    if line.start_turn_m > 0.0 and place <= vertex[0].arc_m + line.start_turn_m:
        other = place - line.start_turn_m
        nearest = other if abs(other - inside) < abs(nearest - inside) else nearest
    return nearest + to - inside


@inner
def write_point(vertex: Records, line: Record, arc: float, point: Floats, axes: Floats) -> None:
    """Write the point [m], shape (3,), and axes (tangent, right, up), shape (3, 3), of the line at an arc length."""
    arc = wrap_arc(vertex, line, arc)
    v = np.searchsorted(vertex["arc_m"][1:-1], arc, side="right")
    here, after = vertex[v], vertex[v + 1]
    along = arc - here.arc_m
    share = min(max(along / (after.arc_m - here.arc_m), 0.0), 1.0)
    for k in range(3):
        point[k] = here.ecef_m[k] + along * here.segment[k]
        square = 0.0
        for c in range(3):
            axes[k, c] = (1.0 - share) * here.axes[k, c] + share * after.axes[k, c]
            square += axes[k, c] * axes[k, c]
        length = math.sqrt(square)
        for c in range(3):
            axes[k, c] /= length


@inner
def gradient_at(vertex: Records, line: Record, arc: float) -> float:
    """Return the gradient at an arc length, interpolated linearly between segment middles."""
    arc = wrap_arc(vertex, line, arc)
    segments = len(vertex) - 1
    if segments == 1 or arc <= vertex[0].middle_m:
        return float(vertex[0].gradient)
    v = min(int(np.searchsorted(vertex["middle_m"][:segments], arc, side="right")), segments - 1)
    before, after = vertex[v - 1], vertex[v]
    share = min((arc - before.middle_m) / (after.middle_m - before.middle_m), 1.0)
    return float((1.0 - share) * before.gradient + share * after.gradient)


@inner
def excess_beyond_end(line: Record, arc: float, sigma: float) -> float:
    """Return the distance of a position beyond an open end of the line [m]; 0 up to two standard deviations.

    The line is continued straight beyond the end, because the train may leave the map.
    """
    excess = abs(min(max(arc, line.start_m), line.end_m) - arc)
    return excess if excess > 2.0 * sigma else 0.0
