"""Normal equations of ranges without receiver clocks, constrained positions, and 3-D single point positions.

Subtracting the weighted mean over the satellites of a constellation from their residuals and design rows is equivalent
to solving for the clock of the constellation (the Schur complement of the clock block). Where the biases between the
clocks are known with a sigma (`InterSystemBiases`), each mean minus the bias is an observation of a common clock, and
the common clock is eliminated likewise.

P1 2.2(3): the antenna is at ``R = r_i + d e_i`` on the section between two points of its trajectory. The map's plan and
height errors are two unknowns with their covariance as prior, which is equivalent to an additional covariance
``H_m S_m H_m^T`` of the ranges. The single point is the reference method of P1 section 5.
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
    vector: Floats  #: Right-hand side; the least-squares step is ``matrix^-1 vector``; shape (T, 3) [1/m].
    wsse: Floats  #: Weighted sum of squared residuals at the position itself, shape (T,).
    #: Receiver clock of each group at the position; NaN where the group has no satellite; shape (T, G).
    clock_m: Floats
    residual_m: Floats  #: Code - range - clock; 0 where the weight is 0; shape (T, M).
    clock_slope: Floats  #: Decrease of `clock_m` per metre of a step along each axis, shape (T, 3, G).
    design: Floats  #: Decrease of `residual_m` per metre of a step along each axis, shape (T, 3, M).


def normal_equations(ranges: Ranges, place_ecef_m: Floats) -> NormalEquations:
    """Return the normal equations of `ranges` linearised at one position per epoch, shape (T, 3) [m]."""
    system, means, rows, seen = kernels.ranges.reduced_equations(ranges.arrays, kernel_array(place_ecef_m))
    return NormalEquations(
        matrix=system[:, :3, :3], vector=system[:, :3, 3], wsse=system[:, 3, 3],
        clock_m=np.where(seen, means[:, 3], np.nan), residual_m=rows[:, 3], clock_slope=means[:, :3],
        design=rows[:, :3],
    )  # fmt: skip


def misfit(ranges: Ranges, place_ecef_m: Floats, epochs: Indices | None = None) -> Floats:
    """Return the weighted sum of squared residuals at positions (n, 3) [m], with the clocks eliminated, shape (n,).

    Same as `normal_equations(...).wsse`, without the derivatives. `epochs` has the index of each position's epoch; by
    default, there is one position per epoch, in order.
    """
    of = np.arange(len(ranges)) if epochs is None else epochs
    return kernels.ranges.misfits(ranges.arrays, kernel_array(place_ecef_m), of)


class ConstrainedLimits(Settings):
    """Limits of the iteration along the line."""

    #: Step length below which the iteration ends inside a section; the error is 0.03 mm (`railfix.kernels.ranges`).
    tolerance_m: float = Field(default=5.0, gt=0)
    max_iterations: int = Field(default=40, ge=1)  #: Largest number of steps, including steps to another section.


@dataclass(frozen=True, kw_only=True, repr=False)
class Constrained(NotebookTable):
    """Positions along the line, T epochs."""

    arc_m: Floats  #: Arc length; NaN where the iteration did not converge or was not started; shape (T,).
    section: Indices  #: Section that contains the position, -1 without a position; shape (T,).
    sigma_m: Floats  #: Standard deviation along the line from the weights and the map error, shape (T,).
    exact_map_sigma_m: Floats  #: Part of `sigma_m` from the weights alone, as for an exact map; shape (T,).
    #: Sigma along the line for unit weights and an exact map; infinite where not determined; shape (T,).
    dilution: Floats
    #: Distance beyond an end of the line that the ranges imply if the position is clamped to the end; else 0; (T,).
    overshoot_m: Floats
    clock_m: Floats  #: Receiver clock of each group, shape (T, G).
    wsse: Floats  #: Weighted sum of squared residuals, with the map error taken into account; shape (T,).
    residual_m: Floats  #: Code - range - clock at the position on the line, shape (T, M).
    iterations: Integers  #: Number of steps, shape (T,).


def position_on_line(
    ranges: Ranges, line: Line, vertex: Indices, *, limits: ConstrainedLimits | None = None
) -> Constrained:
    """Compute the distance along the line by constrained least squares (P1 2.2(3)): ``R = r_i + d e_i``.

    The iteration consists of Newton steps in d inside a section, with the receiver clocks eliminated. A step beyond an
    end of the section stops at this end, and the iteration continues in the neighbouring section. Where the steps from
    both neighbouring sections lead back to their common point, that point is the solution. At an open end of the line,
    the position is clamped to the end, and `overshoot_m` is the distance beyond the end implied by the ranges.

    Parameters
    ----------
    ranges : Ranges
        Returned by `weighted_ranges`.
    line : Trajectory, SearchIndex or AntennaRows
        Trajectory of the antenna.
    vertex : ndarray of int, shape (T,)
        Initial point (`Section.vertex` of `find_section`); -1 where no position is computed.
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
    """Return arc lengths (T,), and the results of `_from` with the epochs on the last axis.

    Where the position is clamped to an end of a closed line, the iteration is repeated from the point at which the line
    continues. The better fit is kept.
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
    """Run `kernels.ranges.iterate_along` on a trajectory from its points `vertex`."""
    line = SectionArrays(
        trajectory.ecef_m[:-1], trajectory.tangent, trajectory.across, trajectory.up, trajectory.length_m,
        trajectory.sigma_plan_m, trajectory.sigma_height_m,
    )  # fmt: skip
    return kernels.ranges.iterate_along(ranges.arrays, line, vertex, limits.tolerance_m, limits.max_iterations)


class SectionArrays(NamedTuple):
    """Arrays of the S sections of a line, and the sigmas of its map."""

    start_ecef_m: Floats  # (S, 3)
    tangent: Floats  # (S, 3)
    across: Floats  # (S, 3)
    up: Floats  # (S, 3)
    length_m: Floats  # (S,)
    plan_m: float
    height_m: float


class SinglePointLimits(Settings):
    """Limits of the iterative solution of 3-D positions, and of its validation (`conventional_status`)."""

    tolerance_m: float = Field(default=1.0, gt=0)  #: Step length below which the iteration ends; the error is 0.01 mm.
    max_iterations: int = Field(default=12, ge=1)  #: Largest number of steps.
    #: False-alarm probability of the chi-square test of the residuals.
    false_alarm: float = Field(default=1e-3, gt=0, lt=0.5)
    #: Largest position dilution of precision; RTKLIB limits the geometric dilution of precision to 30.
    dilution_limit: float = Field(default=30.0, gt=0)


@dataclass(frozen=True, kw_only=True, repr=False)
class SinglePoint(RowArrays, NotebookTable):
    """3-D positions, T epochs."""

    ecef_m: Floats  #: NaN with too few satellites, singular geometry, or no convergence; shape (T, 3).
    clock_m: Floats  #: Receiver clock of each group, shape (T, G).
    matrix: Floats  #: Normal matrix at the position, shape (T, 3, 3) [1/m^2].
    covariance_m2: Floats  #: Covariance of the position, from the weights; shape (T, 3, 3).
    wsse: Floats  #: Weighted sum of squared residuals, shape (T,).
    residual_m: Floats  #: Code - range - clock, shape (T, M).


def point_position(ranges: Ranges, near_ecef_m: ArrayLike, *, limits: SinglePointLimits | None = None) -> SinglePoint:
    """Compute 3-D positions without the map (P1 5, conventional method), with a clock per constellation unless tied.

    Parameters
    ----------
    ranges : Ranges
        Returned by `weighted_ranges`.
    near_ecef_m : array_like, shape (3,) or (T, 3) [m]
        Initial positions, accurate to a few thousand kilometres.
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
