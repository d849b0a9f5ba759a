"""The constrained position: one distance along the line, and the receiver clocks.

P1 2.2(3): the antenna is at ``R = r_i + d e_i`` on the section between two points of its
trajectory. Unknown are d and one clock a constellation. The map is not exact: its plan error
across the track and its height error are common to all satellites of an epoch, so they are
carried as an added covariance ``H_m S_m H_m^T`` - computed here as two more unknowns with that
covariance as their prior, which is the same thing (the matrix inversion lemma).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats, Indices, Integers
from railfix.core.settings import Settings
from railfix.kernels import compiled_by
from railfix.positioning.normal_equations import RangeArrays, Ranges, after_step, inverse_3x3, reduced_equations
from railfix.track.trajectory import Trajectory


class ConstrainedLimits(Settings):
    """Limits of the iteration along the line.

    Attributes
    ----------
    tolerance_m : float
        Last step inside a section: one of 5 m leaves 0.03 mm (`after_step`).
    max_iterations : int
        Steps, walks into a neighbouring section included.
    """

    tolerance_m: float = Field(default=5.0, gt=0)
    max_iterations: int = Field(default=40, ge=1)


@dataclass(frozen=True, kw_only=True)
class Constrained:
    """Positions along the line, T epochs.

    Attributes
    ----------
    arc_m : ndarray, shape (T,) [m]
        Along the trajectory; NaN where the iteration did not settle or was not started.
    section : ndarray of int, shape (T,)
        Section that the position lies on, -1 where there is none.
    sigma_m : ndarray, shape (T,) [m]
        Standard deviation along the line from the weights and the map error.
    exact_map_sigma_m : ndarray, shape (T,) [m]
        The part of it that the weights give, as if the map were exact.
    dilution : ndarray, shape (T,)
        Along-track dilution: sigma along the line for unit, equal weights and an exact map. Infinite where the
        satellites stand across the track.
    overshoot_m : ndarray, shape (T,) [m]
        How far beyond an end of the line the ranges pull a position clamped to it; 0 elsewhere.
    clock_m : ndarray, shape (T, G) [m]
    wsse : ndarray, shape (T,)
        Weighted sum of squared residuals, map error allowed for.
    residual_m : ndarray, shape (T, M) [m]
        Code - range - clock at the position on the line.
    iterations : ndarray of int, shape (T,)
    """

    arc_m: Floats
    section: Indices
    sigma_m: Floats
    exact_map_sigma_m: Floats
    dilution: Floats
    overshoot_m: Floats
    clock_m: Floats
    wsse: Floats
    residual_m: Floats
    iterations: Integers


def _along(system: Floats, axes: Floats, plan_m: float, height_m: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Step and sigma (also of an exact map) along the section, and the least WSSE, map error allowed for."""
    matrix = axes @ system[:, :3, :3] @ axes.swapaxes(1, 2)
    matrix[:, 1, 1] += 1.0 / plan_m**2
    matrix[:, 2, 2] += 1.0 / height_m**2
    vector = np.einsum("tij,tj->ti", axes, system[:, :3, 3])
    # Schur complement of the map error: what remains depends on the distance along the line alone.
    coupling = matrix[:, 0, 1:]
    a, b, c = matrix[:, 1, 1], matrix[:, 1, 2], matrix[:, 2, 2]
    determinant = a * c - b * b
    solve = (
        np.stack([(c * coupling[:, 0] - b * coupling[:, 1]), (a * coupling[:, 1] - b * coupling[:, 0])], axis=1)
        / np.where(determinant > 0, determinant, np.nan)[:, None]
    )
    information = matrix[:, 0, 0] - np.einsum("ti,ti->t", coupling, solve)
    gradient = vector[:, 0] - np.einsum("ti,ti->t", solve, vector[:, 1:])
    exact = 1.0 / np.sqrt(np.where(matrix[:, 0, 0] > 0, matrix[:, 0, 0], np.nan))
    observable = information > 1e-12 * matrix[:, 0, 0]
    safe = np.where(observable, information, 1.0)
    step = np.where(observable, gradient / safe, np.nan)
    sigma = np.where(observable, 1.0 / np.sqrt(safe), np.nan)
    whole = np.einsum("tij,tj->ti", inverse_3x3(matrix), vector)
    least = system[:, 3, 3] - np.einsum("ti,ti->t", whole, vector)
    return step, sigma, exact, least


def constrained_position(
    ranges: Ranges, trajectory: Trajectory, vertex: Indices, *, limits: ConstrainedLimits | None = None
) -> Constrained:
    """Positions along the line of all epochs at once, each started at a point of the trajectory.

    Newton steps inside a section (P1 2.2(3), algorithm of one unknown after the clocks are
    eliminated); a step that leaves the section stops at its end and goes on from there in the
    neighbouring one. Where both neighbours of a point send the step back to it, the point itself
    is the answer. At an open end of the line the position is clamped and `overshoot_m` is how
    far beyond it the ranges pull; at one where the line is closed it goes on beyond it.

    Parameters
    ----------
    ranges : Ranges
        T epochs.
    trajectory : Trajectory
        V points.
    vertex : ndarray of int, shape (T,)
        Point to start from, as `section.search` picks it; -1 leaves the epoch without a position.
    limits : ConstrainedLimits, optional

    Returns
    -------
    Constrained
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
    return iterated_along(
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


@compiled_by("ranges")
def iterated_along(
    ranges: RangeArrays, line: SectionArrays, vertex: Indices, tolerance_m: float, most: int
) -> tuple[Indices, Floats, Floats, Floats, Integers]:
    """Iterate positions along the line.

    Parameters
    ----------
    ranges : RangeArrays
    line : SectionArrays
    vertex : ndarray of int, shape (T,)
        Point to start from; -1: none.
    tolerance_m, most
        Last step, and number of steps.

    Returns
    -------
    section : ndarray of int, shape (T,)
    solved : ndarray, shape (6, T)
        Distance along the section [m]; `sigma_m`, `exact_map_sigma_m`, `wsse`, `overshoot_m` and `dilution` of
        `Constrained`.
    clock_m, residual_m, iterations
        Of `Constrained`.
    """
    start_ecef_m, tangent, across, up, length_m, plan_m, height_m = line
    epochs, channels = ranges.code_m.shape
    chosen, iterations = np.full(epochs, -1, dtype=np.intp), np.zeros(epochs, dtype=np.int64)
    clock, residual = np.full((epochs, len(ranges.starts)), np.nan), np.full((epochs, channels), np.nan)
    solved = np.full((6, epochs), np.nan)
    solved[4] = 0.0
    last = len(length_m) - 1

    active = np.flatnonzero(vertex >= 0)
    section = np.minimum(vertex[active], last)
    along = np.where(vertex[active] > last, length_m[section], 0.0)
    entered = np.zeros(len(active), dtype=np.int8)  # -1 through the lower end, +1 through the upper, 0 not just now
    for _ in range(most):
        if not len(active):
            break
        some = slice(None) if len(active) == epochs else active
        place = start_ecef_m[section] + along[:, None] * tangent[section]
        system, means, rows, seen = reduced_equations(ranges.take(some), place)
        axes = np.stack([tangent[section], across[section], up[section]], axis=1)
        step, deviation, exact, least = _along(system, axes, plan_m, height_m)
        target = along + step
        below, above = target < 0.0, target > length_m[section]
        inside = ~below & ~above  # NaN targets are inside and settle as "no position"
        ended = (below & (section == 0) & (along == 0.0)) | (above & (section == last) & (along == length_m[section]))
        turned = (below & (entered < 0)) | (above & (entered > 0))
        settled = (inside & ~(np.abs(step) > tolerance_m)) | ended | turned

        iterations[active] += 1
        done = active[settled]
        final = np.where(inside, target, along)
        chosen[done] = np.where(np.isfinite(final), section, -1)[settled]
        results = (final, deviation, exact, least, np.where(ended, np.abs(step), 0.0))
        solved[:5, done] = np.stack(results)[:, settled]
        last_step = (np.where(inside, step, 0.0)[:, None] * tangent[section])[settled]
        clock[done], residual[done] = after_step(means[settled], rows[settled], seen[settled], last_step)

        down, upward = below & (section > 0), above & (section < last)
        section = section - down + upward
        along = np.where(down, length_m[section], np.where(upward, 0.0, np.clip(target, 0.0, length_m[section])))
        entered = np.where(down, 1, np.where(upward, -1, 0)).astype(np.int8)
        going = ~settled
        active, section, along, entered = active[going], section[going], along[going], entered[going]

    # Sigma along the line for ranges of unit sigma and an exact map: geometry alone.
    at = np.flatnonzero(chosen >= 0)
    place = start_ecef_m[chosen[at]] + solved[0, at, None] * tangent[chosen[at]]
    unit = ranges.take(at)
    system = reduced_equations(unit._replace(weight=(unit.weight > 0).astype(np.float64)), place)[0]
    information = np.einsum("ti,tij,tj->t", tangent[chosen[at]], system[:, :3, :3], tangent[chosen[at]])
    with np.errstate(divide="ignore"):
        solved[5, at] = 1.0 / np.sqrt(np.maximum(information, 0.0))
    return chosen, solved, clock, residual, iterations
