"""Points, axes and gradient of the line at an arc length (`railfix.tracking.line.Line`)."""

from __future__ import annotations

import math

from railfix.core.arrays import Floats
from railfix.kernels.compiling import borrowing
from railfix.kernels.tracking.layout import PLACE, Course, Work


@borrowing
def on_course(course: Course, arc: float) -> float:
    """Arc length on the line of a place beyond an end of a closed one (`railfix.tracking.line.Line.round_m`)."""
    first, last = course.arc_m[0], course.arc_m[-1]
    if arc > last and course.end_turn_m > 0.0:
        return float(arc - math.ceil((arc - last) / course.end_turn_m) * course.end_turn_m)
    if arc < first and course.start_turn_m > 0.0:
        return float(arc + math.ceil((first - arc) / course.start_turn_m) * course.start_turn_m)
    return arc


@borrowing
def nearest_to(course: Course, place: float, to: float) -> float:
    """Arc length of a place that is nearest to another (`railfix.tracking.line.Line.nearest_m`)."""
    inside = on_course(course, to)
    nearest = place
    if course.end_turn_m > 0.0 and place >= course.arc_m[-1] - course.end_turn_m:
        other = place + course.end_turn_m
        nearest = other if abs(other - inside) < abs(nearest - inside) else nearest
    if course.start_turn_m > 0.0 and place <= course.arc_m[0] + course.start_turn_m:
        other = place - course.start_turn_m
        nearest = other if abs(other - inside) < abs(nearest - inside) else nearest
    return nearest + to - inside


@borrowing
def point_at(course: Course, arc: float, point: Floats, axes: Floats, p: int) -> None:
    """Write point and axes of the line at an arc length into row `p`."""
    arc = on_course(course, arc)
    low, high = 1, len(course.arc_m) - 1
    while low < high:
        half = (low + high) // 2
        if course.arc_m[half] <= arc:
            low = half + 1
        else:
            high = half
    i = low - 1
    along = arc - course.arc_m[i]
    share = min(max(along / (course.arc_m[i + 1] - course.arc_m[i]), 0.0), 1.0)
    for k in range(3):
        point[p, k] = course.ecef_m[i, k] + along * course.segment[i, k]
        square = 0.0
        for c in range(3):
            axes[p, k, c] = (1.0 - share) * course.axes[i, k, c] + share * course.axes[i + 1, k, c]
            square += axes[p, k, c] * axes[p, k, c]
        square = math.sqrt(square)
        for c in range(3):
            axes[p, k, c] /= square


@borrowing
def find_ends(course: Course, now: float, before: float, work: Work) -> None:
    """Write points and axes now and at the epoch before, and the change of the tangent between to the right and up."""
    point_at(course, now, work.point, work.axes, 0)
    point_at(course, before, work.point, work.axes, 1)
    axes, bend = work.axes, work.bend
    for k in range(2):
        bend[k] = 0.0
        for c in range(3):
            bend[k] += (axes[0, 0, c] - axes[1, 0, c]) * axes[0, k + 1, c]


@borrowing
def gradient_at(course: Course, arc: float) -> float:
    """Gradient of the line, linear between the middles of segments."""
    middle_m, gradient = course.middle_m, course.gradient
    arc = on_course(course, arc)
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
def onto_line(course: Course, reach_m: float, work: Work, h: int) -> float:
    """Put a place a little beyond an end on the line; return how far.

    Projection on the constraint along the correlations (D. Simon, Kalman filtering with state constraints, 2010); a
    place within two sigmas of it is noise, and one further out than a start may be wrong is left: the map may end
    before the line.
    """
    mean, covariance = work.new_mean, work.new_covariance
    excess = min(max(mean[h, PLACE], course.start_m), course.end_m) - mean[h, PLACE]
    variance = covariance[h, PLACE, PLACE]
    if abs(excess) > 2.0 * math.sqrt(variance) and abs(excess) <= reach_m:
        for c in range(covariance.shape[1]):
            mean[h, c] += covariance[h, c, PLACE] / variance * excess
        return float(abs(excess))
    return 0.0
