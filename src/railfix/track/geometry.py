"""Geometry of a track map for its quality checks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Floats, Integers
from railfix.core.geodesy import enu_axes
from railfix.track.track import Track

#: Length over which the curvature of the points is compared with the radius of the map [m].
_BEND_WINDOW_M = 40.0


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """Spacing, curvature and gradients of a track of V points."""

    spacing_m: Floats  #: Length of each segment, shape (V - 1,).
    #: Horizontal turn at each point, positive to the right; NaN at the ends and at duplicates; shape (V,).
    turn_deg: Floats
    reach_m: Floats  #: Mean length of the two segments at each point; NaN where `turn_deg` is; shape (V,).
    #: Arc minus chord at the middle of each segment, ``L^2 / (8 R)``, positive in a right curve; R from the map where
    #: both ends have it, else from the circle through neighbouring points; shape (V - 1,).
    mid_chord_m: Floats
    gradient_permille: Floats  #: Gradient from the heights; NaN at duplicates; shape (V - 1,).
    height_spike_m: Floats  #: Height over the straight line between the neighbours; NaN at the ends; shape (V,).
    #: Mean curvature over about 40 m from `Track.radius_m`, NaN where it is not known throughout, and from the points;
    #: positive to the right; shape (V,) [1/m].
    map_curvature: Floats
    point_curvature: Floats


def geometry_of(track: Track) -> Geometry:
    """Compute the geometry of a track; duplicate points are skipped."""
    spacing = np.diff(track.chainage_m)
    kept = np.concatenate([[0], np.flatnonzero(spacing > 0.0) + 1])
    if len(kept) < 2:
        kept = np.array([0, len(track) - 1])
    plan, climb = _plan_steps(track, kept)
    length = np.hypot(plan[:, 0], plan[:, 1])
    length = np.where(length > 0.0, length, np.nan)  # a point straight above another
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
        map_curvature=_mean_of_map(track, curvature_of_map),
        point_curvature=_bend(track, kept, turn),
    )


def _scatter(values: Floats, places: Integers, size: int) -> Floats:
    result = np.full(size, np.nan)
    result[places] = values
    return result


def _plan_steps(track: Track, kept: Integers) -> tuple[Floats, Floats]:
    """Compute the steps between points, east and north, shape (n, 2), and their height differences [m]."""
    latitude, longitude = track.latitude_deg[kept], track.longitude_deg[kept]
    axes = enu_axes((latitude[1:] + latitude[:-1]) / 2.0, _middle_longitude(longitude))
    steps = np.einsum("nij,nj->ni", axes, np.diff(track.ecef_m[kept], axis=0))
    return steps[:, :2], np.diff(track.height_m[kept])


def _middle_longitude(longitude_deg: Floats) -> Floats:
    """Compute the longitude midway between neighbours, also across the date line."""
    step = (np.diff(longitude_deg) + 180.0) % 360.0 - 180.0
    return longitude_deg[:-1] + step / 2.0


def _turns(plan: Floats) -> tuple[Floats, Floats]:
    """Compute the right turn between neighbouring steps [rad] and their mean length [m], shapes (n - 1,)."""
    cross = plan[:-1, 1] * plan[1:, 0] - plan[:-1, 0] * plan[1:, 1]
    dot = np.einsum("ni,ni->n", plan[:-1], plan[1:])
    length = np.hypot(plan[:, 0], plan[:, 1])
    return np.arctan2(cross, dot), (length[:-1] + length[1:]) / 2.0


def _circle_curvature(plan: Floats) -> Floats:
    """Compute the curvature of the circle through each point and its neighbours, shape (n + 1,) [1/m]; NaN at ends."""
    turn, _ = _turns(plan)
    across = plan[:-1] + plan[1:]
    chord = np.hypot(across[:, 0], across[:, 1])
    curvature = 2.0 * np.sin(turn) / np.where(chord > 0.0, chord, np.nan)
    inner = np.where(np.isnan(curvature), 0.0, curvature)
    if not inner.size:
        return np.full(len(plan) + 1, np.nan)
    return np.concatenate([[np.nan], inner, [np.nan]])


def _mean_of_map(track: Track, curvature: Floats) -> Floats:
    """Compute the mean of the map's curvature over the same window, shape (V,) [1/m]; NaN where it is not known."""
    along = track.chainage_m
    low, high = np.maximum(along - _BEND_WINDOW_M / 2.0, along[0]), np.minimum(along + _BEND_WINDOW_M / 2.0, along[-1])
    unknown = np.isnan(curvature)

    def between(values: Floats) -> Floats:
        total = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2.0 * np.diff(along))])
        return np.asarray(np.interp(high, along, total) - np.interp(low, along, total))

    whole, without = between(np.where(unknown, 0.0, curvature)), between(unknown.astype(np.float64))
    return np.where((without > 0.0) | (high <= low), np.nan, whole / np.where(high > low, high - low, 1.0))


def _bend(track: Track, kept: Integers, turn: Floats) -> Floats:
    """Compute the curvature of the points over a window [1/m], shape (V,), to average the noise of single points."""
    along = track.chainage_m
    heading = np.concatenate([[0.0], np.cumsum(turn)])
    middle = (along[kept][1:] + along[kept][:-1]) / 2.0
    low, high = along - _BEND_WINDOW_M / 2.0, along + _BEND_WINDOW_M / 2.0
    low, high = np.maximum(low, middle[0]), np.minimum(high, middle[-1])
    width = high - low
    change = np.interp(high, middle, heading) - np.interp(low, middle, heading)
    return np.where(width > 0.0, change / np.where(width > 0.0, width, 1.0), 0.0)


def windowed_gradients(track: Track, *, window_m: float) -> tuple[Floats, Floats]:
    """Mean gradient [permille] of the attribute and of the heights over a window around each point, shapes (V,).

    NaN where the window has points without a gradient, or less than half of it is on the track.
    """
    along, gradient = track.chainage_m, track.gradient_permille
    mean = (gradient[1:] + gradient[:-1]) / 2.0
    unknown = np.concatenate([[0], np.cumsum(np.isnan(mean))])
    climb = np.concatenate([[0.0], np.cumsum(np.where(np.isnan(mean), 0.0, mean) * np.diff(along))])
    low = np.maximum(along - window_m / 2.0, along[0])
    high = np.minimum(along + window_m / 2.0, along[-1])
    last = np.minimum(np.searchsorted(along, high, side="left"), len(along) - 1)
    first = np.maximum(np.searchsorted(along, low, side="right") - 1, 0)
    enough = (high - low >= window_m / 2.0) & (unknown[last] == unknown[first])
    width = np.where(enough, high - low, np.nan)
    order = np.concatenate([[True], np.diff(along) > 0.0])
    attribute = (np.interp(high, along[order], climb[order]) - np.interp(low, along[order], climb[order])) / width
    height = track.height_m[order]
    from_heights = 1e3 * (np.interp(high, along[order], height) - np.interp(low, along[order], height)) / width
    return attribute, from_heights
