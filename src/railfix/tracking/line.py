"""Trajectory as used by the filter: points and smooth axes at any arc length, even beyond the ends."""

from __future__ import annotations

from functools import cached_property
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.geodesy import geodetic_from_ecef
from railfix.kernels.tracking.layout import LINE, VERTEX, Records
from railfix.ranges.atmosphere import geomagnetic_latitude
from railfix.track.trajectory import Trajectory

#: Standard deviation of the position displacement along the line by a horizontal gradient of the ionosphere [m], for
#: geomagnetic latitudes up to 20, 20 to 55, and above 55 deg: 2/9 of the vertical-delay sigmas without SBAS (9 m, 4.5
#: m, 6 m) in DO-229D J.2.3. `GnssEpochs.tilt_scale` multiplies this sigma and `slow_code_m` at each epoch.
TILT_M: Final = (2.0, 1.0, 1.33)
_TILT_LATITUDES_DEG: Final = (20.0, 55.0)


class Line:
    """Trajectory of V points with smooth axes. Open lines go on straight at their ends; closed lines form loops."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.trajectory = trajectory
        self.arc_m: Floats = trajectory.arc_m  #: Arc lengths of the points, shape (V,).
        self.ecef_m: Floats = trajectory.ecef_m  #: Points, shape (V, 3).
        self.segment: Floats = trajectory.tangent  #: Unit vectors of the segments, shape (V - 1, 3).
        self.joins_m = trajectory.joins_m
        #: Standard deviations of the map error across the line, and in height [m].
        self.sigma_plan_m, self.sigma_height_m = trajectory.sigma_plan_m, trajectory.sigma_height_m

    @cached_property
    def axes(self) -> Floats:
        """Axes at the points, shape (V, 3, 3); the rows are tangent (mean of adjacent segments), right and up."""
        segment, up = self.segment, self.trajectory.up
        tangent = np.concatenate([segment[:1], segment[:-1] + segment[1:], segment[-1:]])
        tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
        right = np.cross(tangent, np.concatenate([up[:1], up]))
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        return np.stack([tangent, right, np.cross(right, tangent)], axis=1)

    @cached_property
    def gradient(self) -> Floats:
        """Gradient of each segment, climb divided by horizontal length, shape (V - 1,)."""
        return self.trajectory.gradient_permille / 1e3

    def at(self, arc_m: Floats) -> tuple[Floats, Floats]:
        """Return points [m], shape (H, 3), and axes, shape (H, 3, 3), at arc lengths [m], shape (H,).

        The rows of the axes are tangent, right and up, interpolated between vertices.
        """
        arc_m = arc_m + self.round_m(arc_m) if self.closed else arc_m
        index = self.arc_m[1:-1].searchsorted(arc_m, side="right")
        along = arc_m - self.arc_m[index]
        share = np.minimum(np.maximum(along / (self.arc_m[index + 1] - self.arc_m[index]), 0.0), 1.0)[:, None, None]
        axes = (1.0 - share) * self.axes[index] + share * self.axes[index + 1]
        axes = axes / np.sqrt((axes * axes).sum(axis=-1, keepdims=True))
        return self.ecef_m[index] + along[:, None] * self.segment[index], axes

    @cached_property
    def closed(self) -> bool:
        """True if at least one end of the line is joined to a point of the line."""
        return bool(np.isfinite(self.joins_m).any())

    def round_m(self, arc_m: Floats) -> Floats:
        """Return the shift [m] that moves positions beyond an end of a closed line back onto the line; 0 if on it."""
        back = np.zeros(np.shape(arc_m))
        first, last = self.arc_m[0], self.arc_m[-1]
        for excess, turn in ((arc_m - last, last - self.joins_m[1]), (first - arc_m, first - self.joins_m[0])):
            if turn == turn:
                back -= np.fmax(np.ceil(excess / abs(turn)), 0.0) * turn
        return back

    def nearest_m(self, arc_m: Floats, to_m: Floats) -> Floats:
        """Return arc lengths [m]; on a closed line, they are shifted by whole laps to be nearest to `to_m` [m]."""
        if not self.closed:
            return arc_m
        back = self.round_m(to_m)
        inside = to_m + back
        (before, after), first, last = self.joins_m, self.arc_m[0], self.arc_m[-1]
        nearest = arc_m
        for other in (
            np.where(arc_m >= after, arc_m + (last - after), np.nan),
            np.where(arc_m <= before, arc_m - (before - first), np.nan),
            arc_m + back,
        ):
            nearest = np.where(np.abs(other - inside) < np.abs(nearest - inside), other, nearest)
        return np.asarray(nearest - back)

    @cached_property
    def records(self) -> tuple[Records, Records]:
        """Records of the vertices, shape (V,), and of the line, shape (1,), for the recursion."""
        vertex, line = np.zeros(len(self.arc_m), dtype=VERTEX), np.zeros(1, dtype=LINE)
        for name in ("arc_m", "ecef_m", "axes"):
            vertex[name] = getattr(self, name)
        for name, values in (("segment", self.segment), ("gradient", self.gradient), ("middle_m", self._middle_m)):
            vertex[name][:-1] = values
        line["sigma_plan_m"], line["sigma_height_m"] = self.sigma_plan_m, self.sigma_height_m
        latitude_deg, longitude_deg, _ = geodetic_from_ecef(self.ecef_m[0])
        magnetic_deg = 180.0 * abs(geomagnetic_latitude(latitude_deg / 180.0, longitude_deg / 180.0))
        line["tilt_m"] = TILT_M[int(np.searchsorted(_TILT_LATITUDES_DEG, magnetic_deg))]
        (before, after), first, last = self.joins_m, self.arc_m[0], self.arc_m[-1]
        line["start_m"], line["end_m"] = first if np.isnan(before) else -np.inf, last if np.isnan(after) else np.inf
        line["start_turn_m"], line["end_turn_m"] = np.nan_to_num(before - first), np.nan_to_num(last - after)
        return vertex, line

    def gradient_at(self, arc_m: Floats) -> Floats:
        """Return the gradient at arc lengths [m], interpolated between segment middles, shape (H,)."""
        arc_m = arc_m + self.round_m(arc_m) if self.closed else arc_m
        return np.interp(arc_m, self._middle_m, self.gradient)

    @cached_property
    def _middle_m(self) -> Floats:
        return 0.5 * (self.arc_m[1:] + self.arc_m[:-1])
