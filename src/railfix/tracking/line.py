"""The trajectory as the filter sees it: points, smooth tangents and axes at arc lengths, beyond its ends too."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from railfix.core.arrays import Floats
from railfix.track.closing import joins_m
from railfix.track.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class Line:
    """Vertices of a trajectory with their axes.

    Attributes
    ----------
    arc_m : ndarray, shape (V,) [m]
    ecef_m : ndarray, shape (V, 3) [m]
    axes : ndarray, shape (V, 3, 3)
        Rows: tangent (mean of the two segments), to the right, up.
    segment : ndarray, shape (V - 1, 3)
        Unit vector of each segment.
    gradient : ndarray, shape (V - 1,)
        Climb over horizontal length of each segment.
    sigma_plan_m, sigma_height_m : float [m]
    """

    arc_m: Floats
    ecef_m: Floats
    axes: Floats
    segment: Floats
    gradient: Floats
    sigma_plan_m: float
    sigma_height_m: float

    @classmethod
    def of(cls, trajectory: Trajectory) -> Line:
        """Axes at the vertices of a trajectory."""
        segment = np.asarray(trajectory.tangent)
        tangent = np.concatenate([segment[:1], segment[:-1] + segment[1:], segment[-1:]])
        tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
        up = np.concatenate([trajectory.up[:1], trajectory.up])
        right = np.cross(tangent, up)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        return cls(
            arc_m=np.asarray(trajectory.arc_m),
            ecef_m=np.asarray(trajectory.ecef_m),
            axes=np.stack([tangent, right, np.cross(right, tangent)], axis=1),
            segment=segment,
            gradient=np.asarray(trajectory.gradient_permille) / 1e3,
            sigma_plan_m=trajectory.sigma_plan_m,
            sigma_height_m=trajectory.sigma_height_m,
        )

    def at(self, arc_m: Floats) -> tuple[Floats, Floats]:
        """Points and axes at arc lengths, straight on beyond the ends.

        Parameters
        ----------
        arc_m : ndarray, shape (H,) [m]

        Returns
        -------
        ecef_m : ndarray, shape (H, 3) [m]
        axes : ndarray, shape (H, 3, 3)
            Rows: tangent, right, up; interpolated between vertices.
        """
        index = np.searchsorted(self.arc_m[1:-1], arc_m, side="right")
        along = arc_m - self.arc_m[index]
        share = np.minimum(np.maximum(along / (self.arc_m[index + 1] - self.arc_m[index]), 0.0), 1.0)[:, None, None]
        axes = (1.0 - share) * self.axes[index] + share * self.axes[index + 1]
        axes = axes / np.sqrt((axes * axes).sum(axis=-1, keepdims=True))
        return self.ecef_m[index] + along[:, None] * self.segment[index], axes

    @cached_property
    def joins_m(self) -> tuple[float, float]:
        """Arc lengths at which a closed line goes on before its start and after its end; NaN at an open end."""
        return joins_m(self.arc_m, self.ecef_m)

    @cached_property
    def bounds_m(self) -> tuple[float, float]:
        """Arc lengths of the open ends; infinite where the line is closed."""
        before, after = self.joins_m
        return (
            float(self.arc_m[0]) if np.isnan(before) else -np.inf,
            float(self.arc_m[-1]) if np.isnan(after) else np.inf,
        )

    def round_m(self, arc_m: Floats) -> Floats:
        """Shift of places beyond an end of a closed line to where it goes on [m]; 0 for others.

        Parameters
        ----------
        arc_m : ndarray [m]
        """
        before, after = np.nan_to_num(self.joins_m, nan=np.inf)
        first, last = self.arc_m[0], self.arc_m[-1]
        return np.where(
            (arc_m > last) & np.isfinite(after),
            after - last,
            np.where((arc_m < first) & np.isfinite(before), before - first, 0.0),
        )

    @cached_property
    def middle_m(self) -> Floats:
        """Arc lengths of the middles of the segments, shape (V - 1,) [m]."""
        return 0.5 * (self.arc_m[1:] + self.arc_m[:-1])

    @cached_property
    def written(self) -> dict[str, Floats | float]:
        """Everything by its name, arrays as writable copies, row by row."""
        names = ("arc_m", "ecef_m", "axes", "segment", "middle_m", "gradient")
        arrays = {name: np.array(getattr(self, name), order="C") for name in names}
        start, end = self.bounds_m
        return {
            **arrays,
            "sigma_plan_m": float(self.sigma_plan_m),
            "sigma_height_m": float(self.sigma_height_m),
            "start_m": start,
            "end_m": end,
        }

    def gradient_at(self, arc_m: Floats) -> Floats:
        """Climb over horizontal length, between the middles of segments, shape (H,)."""
        return np.interp(arc_m, self.middle_m, self.gradient)
