"""Points, axes and gradient of the line at an arc length (`railfix.tracking.line.Line`)."""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.layout import ARC, LineArrays, Work


@borrowing
def on_course(line: LineArrays, arc: float) -> float:
    """Return the arc length on the line of a place beyond its end if closed (`railfix.tracking.line.Line.round_m`)."""
    first, last = line.arc_m[0], line.arc_m[-1]
    if arc > last and line.end_turn_m > 0.0:
        return float(arc - math.ceil((arc - last) / line.end_turn_m) * line.end_turn_m)
    if arc < first and line.start_turn_m > 0.0:
        return float(arc + math.ceil((first - arc) / line.start_turn_m) * line.start_turn_m)
    return arc


@borrowing
def nearest_to(line: LineArrays, place: float, to: float) -> float:
    """Return the arc length of a place that is nearest to another (`railfix.tracking.line.Line.nearest_m`)."""
    inside = on_course(line, to)
    nearest = place
    if line.end_turn_m > 0.0 and place >= line.arc_m[-1] - line.end_turn_m:
        other = place + line.end_turn_m
        nearest = other if abs(other - inside) < abs(nearest - inside) else nearest
    if line.start_turn_m > 0.0 and place <= line.arc_m[0] + line.start_turn_m:
        other = place - line.start_turn_m
        nearest = other if abs(other - inside) < abs(nearest - inside) else nearest
    return nearest + to - inside


@borrowing
def point_at(line: LineArrays, arc: float, point: Floats, axes: Floats, p: int) -> None:
    """Write point and axes of the line at an arc length into row `p`."""
    arc = on_course(line, arc)
    low, high = 1, len(line.arc_m) - 1
    while low < high:
        half = (low + high) // 2
        if line.arc_m[half] <= arc:
            low = half + 1
        else:
            high = half
    i = low - 1
    along = arc - line.arc_m[i]
    share = min(max(along / (line.arc_m[i + 1] - line.arc_m[i]), 0.0), 1.0)
    for k in range(3):
        point[p, k] = line.ecef_m[i, k] + along * line.segment[i, k]
        square = 0.0
        for c in range(3):
            axes[p, k, c] = (1.0 - share) * line.axes[i, k, c] + share * line.axes[i + 1, k, c]
            square += axes[p, k, c] * axes[p, k, c]
        square = math.sqrt(square)
        for c in range(3):
            axes[p, k, c] /= square


@borrowing
def find_ends(line: LineArrays, now: float, before: float, work: Work) -> None:
    """Write points and axes now and at the epoch before, and the change of the tangent between to the right and up."""
    point_at(line, now, work.point, work.axes, 0)
    point_at(line, before, work.point, work.axes, 1)
    axes, bend = work.axes, work.bend
    for k in range(2):
        bend[k] = 0.0
        for c in range(3):
            bend[k] += (axes[0, 0, c] - axes[1, 0, c]) * axes[0, k + 1, c]


@borrowing
def gradient_at(line: LineArrays, arc: float) -> float:
    """Return the gradient of the line, linear between the middles of segments."""
    middle_m, gradient = line.middle_m, line.gradient
    arc = on_course(line, arc)
    low, high = 0, len(middle_m)
    while low < high:
        half = (low + high) // 2
        if middle_m[half] <= arc:
            low = half + 1
        else:
            high = half
    if low == 0:
        return float(gradient[0])
    if low == len(middle_m):
        return float(gradient[low - 1])
    share = (arc - middle_m[low - 1]) / (middle_m[low] - middle_m[low - 1])
    return float((1.0 - share) * gradient[low - 1] + share * gradient[low])


@borrowing
def beyond_end(line: LineArrays, work: Work, h: int) -> float:
    """Return how far a place is beyond an open end, 0 within two of its standard deviations, which are noise.

    It goes on straight there: put back onto the end, it would stand while the train drives off the map.
    """
    arc = work.new_mean[h, ARC]
    excess = abs(min(max(arc, line.start_m), line.end_m) - arc)
    return excess if excess > 2.0 * math.sqrt(work.new_covariance[h, ARC, ARC]) else 0.0
