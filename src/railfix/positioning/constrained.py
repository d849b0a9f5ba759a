"""The constrained position, one distance along the line and the receiver clocks; and the 3-D single point.

P1 2.2(3): the antenna is at ``R = r_i + d e_i`` on the section between two points of its trajectory. The map's plan and
height errors are two more unknowns with their covariance as prior, the same as an added covariance ``H_m S_m H_m^T``.
The single point is the reference method of P1 section 5.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from pydantic import Field

from railfix import kernels
from railfix.core.arrays import Floats, Indices, Integers
from railfix.core.settings import Settings
from railfix.positioning.normal_equations import Ranges
from railfix.track.trajectory import Trajectory


class ConstrainedLimits(Settings):
    """Limits of the iteration along the line."""

    #: Last step inside a section: one of 5 m leaves 0.03 mm (`after_step`).
    tolerance_m: float = Field(default=5.0, gt=0)
    max_iterations: int = Field(default=40, ge=1)  #: Steps, walks into a neighbouring section included.


@dataclass(frozen=True, kw_only=True)
class Constrained:
    """Positions along the line, T epochs."""

    arc_m: Floats  #: Along the trajectory; NaN where the iteration did not settle or was not started; shape (T,).
    section: Indices  #: Section that the position lies on, -1 where there is none; shape (T,).
    sigma_m: Floats  #: Standard deviation along the line from the weights and the map error, shape (T,).
    exact_map_sigma_m: Floats  #: The part of it that the weights give, as if the map were exact; shape (T,).
    #: Sigma along the line for unit, equal weights and an exact map; infinite where undetermined; shape (T,).
    dilution: Floats
    #: How far beyond an end of the line the ranges pull a position clamped to it; 0 elsewhere; shape (T,).
    overshoot_m: Floats
    clock_m: Floats  #: Shape (T, G).
    wsse: Floats  #: Weighted sum of squared residuals, map error allowed for; shape (T,).
    residual_m: Floats  #: Code - range - clock at the position on the line, shape (T, M).
    iterations: Integers  #: Shape (T,).


def constrained_position(
    ranges: Ranges, trajectory: Trajectory, vertex: Indices, *, limits: ConstrainedLimits | None = None
) -> Constrained:
    """Compute positions along the line of all epochs at once, each started at a point of the trajectory (-1: none).

    Newton steps inside a section (P1 2.2(3)); a step that leaves it stops at its end and goes on in the neighbouring
    one. Where both neighbours of a point send the step back, the point is the answer. At an open end the position is
    clamped and `overshoot_m` is how far beyond it the ranges pull.
    """
    limits = limits or ConstrainedLimits()
    start = np.where(ranges.n_used - ranges.n_clocks >= 1, vertex, -1)
    section, solved, clock, residual, iterations = _from(start, ranges, trajectory, limits)
    for end, join in zip((0, len(trajectory) - 2), trajectory.joins_m, strict=True):
        pulled = np.flatnonzero((solved[4] > 0.0) & (section == end))
        if not np.isnan(join) and len(pulled):
            there = np.full(len(pulled), np.argmin(np.abs(trajectory.arc_m - join)))
            other = _from(there, ranges.take(pulled), trajectory, limits)
            better = other[1][3] < solved[3, pulled]
            rows = pulled[better]
            solved[:, rows] = other[1][:, better]
            for array, new in zip((section, clock, residual), (other[0], *other[2:4]), strict=True):
                array[rows] = new[better]
            iterations[pulled] += other[4]
    along, sigma, exact, wsse, overshoot, dilution = solved
    return Constrained(
        arc_m=trajectory.arc_m[np.maximum(section, 0)] + along,
        section=section,
        sigma_m=sigma,
        exact_map_sigma_m=exact,
        dilution=dilution,
        overshoot_m=overshoot,
        clock_m=clock,
        wsse=wsse,
        residual_m=residual,
        iterations=iterations,
    )


def _from(
    vertex: Indices, ranges: Ranges, trajectory: Trajectory, limits: ConstrainedLimits
) -> tuple[Indices, Floats, Floats, Floats, Integers]:
    """`iterated_along` of a trajectory, from points of it."""
    return kernels.ranges.iterated_along(
        ranges.arrays,
        SectionArrays(
            trajectory.ecef_m[:-1],
            trajectory.tangent,
            trajectory.across,
            trajectory.up,
            trajectory.length_m,
            trajectory.sigma_plan_m,
            trajectory.sigma_height_m,
        ),
        vertex,
        limits.tolerance_m,
        limits.max_iterations,
    )


class SectionArrays(NamedTuple):
    """Sections of a line, S of them, and the sigmas of its map."""

    start_ecef_m: Floats  # (S, 3)
    tangent: Floats  # (S, 3)
    across: Floats  # (S, 3)
    up: Floats  # (S, 3)
    length_m: Floats  # (S,)
    plan_m: float
    height_m: float


class SinglePointLimits(Settings):
    """Limits of the iteration, and of the validation of its position (`conventional_status`)."""

    tolerance_m: float = Field(default=1.0, gt=0)  #: The last step: one of 1 m leaves 0.01 mm (`after_step`).
    max_iterations: int = Field(default=12, ge=1)  #: Steps at most.
    #: Probability that noise alone fails the chi-square test of the residuals.
    false_alarm: float = Field(default=1e-3, gt=0, lt=0.5)
    #: Largest position dilution of precision; 30, as RTKLIB has for the geometric one.
    dilution_limit: float = Field(default=30.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class SinglePoint:
    """3-D positions, T epochs."""

    ecef_m: Floats  #: NaN with too few satellites, singular geometry, or no convergence; shape (T, 3).
    clock_m: Floats  #: Shape (T, G).
    matrix: Floats  #: Normal matrix at the position, shape (T, 3, 3) [1/m^2].
    covariance_m2: Floats  #: Of the position, from the weights; shape (T, 3, 3).
    wsse: Floats  #: Shape (T,).
    residual_m: Floats  #: Shape (T, M).

    def take(self, epochs: Indices) -> SinglePoint:
        """The positions of some epochs, by index."""
        return SinglePoint(**{item.name: getattr(self, item.name)[epochs] for item in fields(self)})


def single_point(ranges: Ranges, start_ecef_m: Floats, *, limits: SinglePointLimits | None = None) -> SinglePoint:
    """Compute single-point positions of all epochs at once, from starts within a few thousand kilometres, shape (T, 3)
    [m].
    """
    limits = limits or SinglePointLimits()
    place, clock, matrix, covariance, wsse, residual = kernels.ranges.iterated_points(
        ranges.arrays,
        np.ascontiguousarray(start_ecef_m, dtype=np.float64),
        np.asarray(ranges.n_used - ranges.n_clocks >= 3),
        limits.tolerance_m,
        limits.max_iterations,
    )
    return SinglePoint(
        ecef_m=place, clock_m=clock, matrix=matrix, covariance_m2=covariance, wsse=wsse, residual_m=residual
    )
