"""Normal equations without receiver clocks, constrained positions on the line, and 3-D single-point positions.

The clock of a constellation is eliminated by subtracting the weighted mean over its satellites from their residuals and
design rows. This is equivalent to solving for the clock (Schur complement of the clock block). With known biases
(`InterSystemBiases`), the mean of a constellation minus its bias is an observation of a common clock, which is
eliminated in the same way.

In P1 2.2(3), the antenna is at ``R = r_i + d e_i`` on the section between two points of its trajectory. The plan and
height errors of the map are two unknowns with design columns H_m and prior covariance S_m. This is equivalent to adding
the covariance ``H_m S_m H_m^T`` to the ranges. The single-point position is the reference method of P1 section 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix import kernels
from railfix.core.arrays import Floats, Indices, Integers, RowArrays, kernel_array
from railfix.core.epoch_rows import EVERY
from railfix.core.notebook import NotebookTable
from railfix.core.settings import Settings
from railfix.positioning.antenna_rows import AntennaRows, Line
from railfix.positioning.range_arrays import Ranges
from railfix.track.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """Normal equations of a position from ranges, with the receiver clocks eliminated."""

    matrix: Floats  #: Normal matrix of the position in ECEF, shape (T, 3, 3) [1/m^2].
    vector: Floats  #: Right-hand side, shape (T, 3) [1/m]. The least-squares step is ``matrix^-1 vector``.
    wsse: Floats  #: Weighted sum of squared residuals at the linearisation position, shape (T,).
    #: Receiver clock of each group at the linearisation position, shape (T, G); NaN for groups without satellites.
    clock_m: Floats
    residual_m: Floats  #: Code - distance - clock, shape (T, M); 0 where the weight is 0.
    clock_slope: Floats  #: Decrease of `clock_m` per metre of a step along each axis, shape (T, 3, G).
    design: Floats  #: Decrease of `residual_m` per metre of a step along each axis, shape (T, 3, M).


def normal_equations(ranges: Ranges, place_ecef_m: Floats) -> NormalEquations:
    """Return the normal equations of `ranges`, linearised at positions of shape (T, 3) [m]."""
    system, means, rows, seen = kernels.ranges.reduced_equations(ranges.arrays, kernel_array(place_ecef_m))
    return NormalEquations(
        matrix=system[:, :3, :3], vector=system[:, :3, 3], wsse=system[:, 3, 3],
        clock_m=np.where(seen, means[:, 3], np.nan), residual_m=rows[:, 3], clock_slope=means[:, :3],
        design=rows[:, :3],
    )  # fmt: skip


def misfit(ranges: Ranges, place_ecef_m: Floats, epochs: Indices | None = None) -> Floats:
    """Return the weighted sum of squared residuals at n positions, shape (n,), with the clocks eliminated.

    The result equals `normal_equations(...).wsse`. `epochs` has the index of each position's epoch; by default, there
    is one position per epoch.
    """
    of = np.arange(len(ranges)) if epochs is None else epochs
    return kernels.ranges.misfits(ranges.arrays, kernel_array(place_ecef_m), of)


class ConstrainedLimits(Settings):
    """Limits of the iteration along the line."""

    #: Step length below which the iteration ends; the remaining error is at most 0.03 mm.
    tolerance_m: float = Field(default=5.0, gt=0)
    max_iterations: int = Field(default=40, ge=1)  #: Largest number of steps and section changes.


@dataclass(frozen=True, kw_only=True, repr=False)
class Constrained(NotebookTable):
    """Positions along the line, T epochs."""

    arc_m: Floats  #: Arc length, shape (T,); NaN without a position or without convergence.
    section: Indices  #: Index of the section that contains the position, shape (T,); -1 without a position.
    sigma_m: Floats  #: Standard deviation along the line from the weights and the map error, shape (T,).
    exact_map_sigma_m: Floats  #: Standard deviation along the line for an exact map, shape (T,).
    #: Standard deviation along the line for unit weights and an exact map, shape (T,); infinite if undetermined.
    dilution: Floats
    #: Distance from the end of the line to the best-fitting position beyond it, shape (T,); 0 if not at an end.
    overshoot_m: Floats
    clock_m: Floats  #: Receiver clock of each group, shape (T, G).
    wsse: Floats  #: Weighted sum of squared residuals, including the map error, shape (T,).
    residual_m: Floats  #: Code - distance - clock at the position on the line, shape (T, M).
    iterations: Integers  #: Number of steps, shape (T,).


def position_on_line(
    ranges: Ranges, line: Line, vertex: Indices, *, limits: ConstrainedLimits | None = None
) -> Constrained:
    """Compute the distance along the line by constrained least squares (P1 2.2(3)): ``R = r_i + d e_i``.

    Within a section, the iteration uses Newton steps in d, with the receiver clocks eliminated. A step beyond an end of
    the section stops at this end, and the iteration continues in the neighbouring section. If the steps in two
    neighbouring sections lead back to their common point, this point is the solution. Positions beyond an end of the
    line are clamped to the end; `overshoot_m` is their distance from the end before clamping.

    Parameters
    ----------
    ranges : Ranges
        Returned by `weighted_ranges`.
    line : Trajectory, SearchIndex or AntennaRows
        Trajectory of the antenna.
    vertex : ndarray of int, shape (T,)
        Initial trajectory point (`Section.vertex` of `find_section`); -1 for epochs without a position.
    limits : ConstrainedLimits, optional
    """
    limits = limits or ConstrainedLimits()
    lines = ((line, EVERY),) if isinstance(line, Trajectory) else AntennaRows.on(line).lines
    enough = ranges.redundancy >= 0
    parts = []
    for trajectory, rows in lines:
        start = np.full(len(vertex), -1, dtype=np.intp)
        start[rows] = np.where(enough[rows], vertex[rows], -1)
        parts.append(_on_line(ranges, trajectory, start, limits))
    first = parts[0]
    for part, (_, rows) in zip(parts[1:], lines[1:], strict=True):
        for whole, own in zip(first, part, strict=True):
            whole[..., rows] = own[..., rows]
    arc, section, solved, clock, residual, iterations = first
    _, sigma, exact, wsse, overshoot, dilution = solved
    return Constrained(
        arc_m=arc, section=section, sigma_m=sigma, exact_map_sigma_m=exact, dilution=dilution, overshoot_m=overshoot,
        clock_m=clock.T, wsse=wsse, residual_m=residual.T, iterations=iterations,
    )  # fmt: skip


def _on_line(
    ranges: Ranges, trajectory: Trajectory, start: Indices, limits: ConstrainedLimits
) -> tuple[Floats, Indices, Floats, Floats, Floats, Integers]:
    """Return arc lengths, and the results of `_from`; all arrays have epochs on their last axis.

    If a position is clamped to an end of a closed line, the iteration is repeated from the point where the line passes
    this end again, and the better fit is returned.
    """
    section, solved, clock, residual, iterations = _from(start, ranges, trajectory, limits)
    for end, join in zip((0, len(trajectory) - 2), trajectory.joins_m, strict=True):
        pulled = ((solved[4] > 0.0) & (section == end)).nonzero()[0]
        if not np.isnan(join) and len(pulled):
            there = np.full(len(pulled), np.argmin(np.abs(trajectory.arc_m - join)))
            other = _from(there, ranges.take(pulled), trajectory, limits)
            better = other[1][3] < solved[3, pulled]
            rows = pulled[better]
            solved[:, rows] = other[1][:, better]
            for array, new in zip((section, clock, residual), (other[0], *other[2:4]), strict=True):
                array[rows] = new[better]
            iterations[pulled] += other[4]
    arc = trajectory.arc_m[np.maximum(section, 0)] + solved[0]
    return arc, section, solved, clock.T, residual.T, iterations


def _from(
    vertex: Indices, ranges: Ranges, trajectory: Trajectory, limits: ConstrainedLimits
) -> tuple[Indices, Floats, Floats, Floats, Integers]:
    """Run `kernels.ranges.iterate_along`, starting at the trajectory points `vertex`."""
    line = SectionArrays(
        trajectory.ecef_m[:-1], trajectory.tangent, trajectory.across, trajectory.up, trajectory.length_m,
        trajectory.sigma_plan_m, trajectory.sigma_height_m,
    )  # fmt: skip
    return kernels.ranges.iterate_along(ranges.arrays, line, vertex, limits.tolerance_m, limits.max_iterations)


class SectionArrays(NamedTuple):
    """Arrays of S line sections, and the map sigmas."""

    start_ecef_m: Floats  # (S, 3)
    tangent: Floats  # (S, 3)
    across: Floats  # (S, 3)
    up: Floats  # (S, 3)
    length_m: Floats  # (S,)
    plan_m: float
    height_m: float


class SinglePointLimits(Settings):
    """Limits of the iteration for 3-D positions, and of the validation of these positions (`conventional_status`)."""

    tolerance_m: float = Field(default=1.0, gt=0)  #: Step length below which the iteration ends.
    max_iterations: int = Field(default=12, ge=1)  #: Largest number of steps; there is no position without convergence.
    #: False-alarm probability of the chi-square test of the residuals.
    false_alarm: float = Field(default=1e-3, gt=0, lt=0.5)
    #: Largest position dilution of precision of a valid position. RTKLIB: 30 for the geometric dilution of precision.
    dilution_limit: float = Field(default=30.0, gt=0)


@dataclass(frozen=True, kw_only=True, repr=False)
class SinglePoint(RowArrays, NotebookTable):
    """3-D positions, T epochs."""

    ecef_m: Floats  #: Position, shape (T, 3); NaN with too few satellites, singular geometry or no convergence.
    clock_m: Floats  #: Receiver clock of each group, shape (T, G).
    matrix: Floats  #: Normal matrix at the position, shape (T, 3, 3) [1/m^2].
    covariance_m2: Floats  #: Position covariance according to the weights, shape (T, 3, 3).
    wsse: Floats  #: Weighted sum of squared residuals, shape (T,).
    residual_m: Floats  #: Code - distance - clock, shape (T, M).


def point_position(ranges: Ranges, near_ecef_m: ArrayLike, *, limits: SinglePointLimits | None = None) -> SinglePoint:
    """Compute 3-D positions without the map (P1 5, conventional method), with one clock per constellation or tied
    clocks.

    Parameters
    ----------
    ranges : Ranges
        Returned by `weighted_ranges`.
    near_ecef_m : array_like, shape (3,) or (T, 3) [m]
        Initial positions, with errors of up to a few thousand kilometres.
    limits : SinglePointLimits, optional
    """
    limits = limits or SinglePointLimits()
    place, clock, matrix, covariance, wsse, residual = kernels.ranges.iterate_points(
        ranges.arrays, kernel_array(np.broadcast_to(near_ecef_m, (len(ranges), 3))),
        ranges.space_redundancy >= 0,
        limits.tolerance_m, limits.max_iterations,
    )  # fmt: skip
    return SinglePoint(
        ecef_m=place, clock_m=clock, matrix=matrix, covariance_m2=covariance, wsse=wsse, residual_m=residual
    )
