"""Spacing, curvature and gradients of a track."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Floats, Integers
from railfix.core.geodesy import enu_axes
from railfix.track.track import Track

#: Length over which curvatures are averaged, both from the points and from the map's radius [m].
_BEND_WINDOW_M = 40.0


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """Spacing, curvature and gradients of a track of V points."""

    spacing_m: Floats  #: Length of each segment, shape (V - 1,).
    #: Change of direction at each point, positive to the right, shape (V,); NaN at the ends and at duplicates.
    turn_deg: Floats
    reach_m: Floats  #: Mean length of the two segments at each point, shape (V,); NaN where `turn_deg` is NaN.
    #: Distance from chord to arc at the middle of each segment, ``L^2 / (8 R)``, positive in a right curve; shape (V -
    #: 1,). The radius R is from the map if the map has a radius at both ends of the segment, otherwise from circles
    #: through neighbouring points.
    mid_chord_m: Floats
    gradient_permille: Floats  #: Gradient from the heights, shape (V - 1,); NaN at duplicate points.
    #: Height of each point above the straight line between its neighbours, shape (V,); NaN at the ends.
    height_spike_m: Floats
    #: Curvature from `Track.radius_m`, averaged over 40 m, positive to the right, shape (V,) [1/m]; NaN where unknown.
    map_curvature: Floats
    #: Curvature from the points, averaged over 40 m, positive to the right, shape (V,) [1/m].
    point_curvature: Floats


def compute_geometry(track: Track) -> Geometry:
    """Compute the geometry of a track, without its duplicate points."""
    spacing = np.diff(track.chainage_m)
    kept = np.concatenate([[0], np.flatnonzero(spacing > 0.0) + 1])
    if len(kept) < 2:
        kept = np.array([0, len(track) - 1])
    plan, climb = _plan_steps(track, kept)
    length = np.hypot(plan[:, 0], plan[:, 1])
    length = np.where(length > 0.0, length, np.nan)  # NaN for a point straight above the previous point
    turn, reach = _turns(plan)
    height = track.height_m[kept]
    share = length[:-1] / (length[:-1] + length[1:])
    spike = height[1:-1] - (height[:-2] * (1.0 - share) + height[2:] * share)
    curvature_of_map = np.where(np.isinf(track.radius_m), 0.0, 1.0 / track.radius_m)
    circle = _circle_curvature(plan)
    curvature = np.where(
        np.isnan(curvature_of_map[kept[:-1]] + curvature_of_map[kept[1:]]),
        np.nanmean(np.stack([circle[:-1], circle[1:]]), axis=0) if len(kept) > 2 else 0.0,
        (curvature_of_map[kept[:-1]] + curvature_of_map[kept[1:]]) / 2.0,
    )
    segments, points = kept[1:] - 1, kept[1:-1]
    return Geometry(
        spacing_m=spacing,
        turn_deg=_scatter(np.degrees(turn), points, len(track)),
        reach_m=_scatter(reach, points, len(track)),
        mid_chord_m=_scatter(length**2 * curvature / 8.0, segments, len(spacing)),
        gradient_permille=_scatter(1e3 * climb / length, segments, len(spacing)),
        height_spike_m=_scatter(spike, points, len(track)),
        map_curvature=_mean_over(track.chainage_m, curvature_of_map, *_windows(track.chainage_m, _BEND_WINDOW_M)),
        point_curvature=_bend(track, kept, turn),
    )


def _windows(along: Floats, window_m: float) -> tuple[Floats, Floats]:
    """Return start and end chainages of windows centred on points, cut off at the line's ends, shape (V,) [m]."""
    return np.maximum(along - window_m / 2.0, along[0]), np.minimum(along + window_m / 2.0, along[-1])


def _scatter(values: Floats, places: Integers, size: int) -> Floats:
    result = np.full(size, np.nan)
    result[places] = values
    return result


def _plan_steps(track: Track, kept: Integers) -> tuple[Floats, Floats]:
    """Compute the steps east and north between points, shape (n, 2), and the height differences, shape (n,) [m]."""
    latitude, longitude = track.latitude_deg[kept], track.longitude_deg[kept]
    half_step = ((np.diff(longitude) + 180.0) % 360.0 - 180.0) / 2.0  # also across the date line
    axes = enu_axes((latitude[1:] + latitude[:-1]) / 2.0, longitude[:-1] + half_step)
    steps = np.einsum("nij,nj->ni", axes, np.diff(track.ecef_m[kept], axis=0))
    return steps[:, :2], np.diff(track.height_m[kept])


def _turns(plan: Floats) -> tuple[Floats, Floats]:
    """Compute the right turns between successive steps [rad], and the mean lengths of both steps [m]."""
    cross = plan[:-1, 1] * plan[1:, 0] - plan[:-1, 0] * plan[1:, 1]
    dot = np.einsum("ni,ni->n", plan[:-1], plan[1:])
    length = np.hypot(plan[:, 0], plan[:, 1])
    return np.arctan2(cross, dot), (length[:-1] + length[1:]) / 2.0


def _circle_curvature(plan: Floats) -> Floats:
    """Compute the curvature of the circle through each point and its neighbours, shape (n + 1,) [1/m].

    The curvature is positive to the right, and NaN at the ends.
    """
    turn, _ = _turns(plan)
    across = plan[:-1] + plan[1:]
    chord = np.hypot(across[:, 0], across[:, 1])
    curvature = 2.0 * np.sin(turn) / np.where(chord > 0.0, chord, np.nan)
    inner = np.where(np.isnan(curvature), 0.0, curvature)
    if not inner.size:
        return np.full(len(plan) + 1, np.nan)
    return np.concatenate([[np.nan], inner, [np.nan]])


def _mean_over(along: Floats, values: Floats, low: Floats, high: Floats) -> Floats:
    """Compute means of a piecewise linear function from `low` to `high`; NaN where a value in this range is unknown."""
    unknown = np.isnan(values)

    def between(part: Floats) -> Floats:
        total = np.concatenate([[0.0], np.cumsum((part[1:] + part[:-1]) / 2.0 * np.diff(along))])
        return np.asarray(np.interp(high, along, total) - np.interp(low, along, total))

    whole, without = between(np.where(unknown, 0.0, values)), between(unknown.astype(np.float64))
    return np.where((without > 0.0) | (high <= low), np.nan, whole / np.where(high > low, high - low, 1.0))


def _bend(track: Track, kept: Integers, turn: Floats) -> Floats:
    """Compute the curvature as change of heading over a window, to average out noise, shape (V,) [1/m]."""
    along = track.chainage_m
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    middle = (along[kept][1:] + along[kept][:-1]) / 2.0
    low, high = along - _BEND_WINDOW_M / 2.0, along + _BEND_WINDOW_M / 2.0
    low, high = np.maximum(low, middle[0]), np.minimum(high, middle[-1])
    width = high - low
    change = np.interp(high, middle, heading) - np.interp(low, middle, heading)
    return np.where(width > 0.0, change / np.where(width > 0.0, width, 1.0), 0.0)


def mean_gradients(track: Track, *, window_m: float) -> tuple[Floats, Floats]:
    """Compute mean gradients over a window, both from the map's gradients and from the heights, shape (V,) [permille].

    A mean gradient is NaN where gradients are unknown, and where the line covers less than half of the window.
    """
    different = np.concatenate([[True], np.diff(track.chainage_m) > 0.0])
    along, height = track.chainage_m[different], track.height_m[different]
    low, high = _windows(track.chainage_m, window_m)
    width = np.where(high - low >= window_m / 2.0, high - low, np.nan)
    attribute = _mean_over(track.chainage_m, track.gradient_permille, low, high)
    from_heights = 1e3 * (np.interp(high, along, height) - np.interp(low, along, height)) / width
    return np.where(np.isnan(width), np.nan, attribute), from_heights
