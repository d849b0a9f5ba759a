"""The constrained position: one distance along the line, and the receiver clocks.

P1 2.2(3): the antenna is at ``R = r_i + d e_i`` on the section between two points of its
trajectory. Unknown are d and one clock a constellation. The map is not exact: its plan error
across the track and its height error are common to all satellites of an epoch, so they are
carried as an added covariance ``H_m S_m H_m^T`` - computed here as two more unknowns with that
covariance as their prior, which is the same thing (the matrix inversion lemma).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats, Indices, Integers
from railfix.core.settings import Settings
from railfix.positioning.normal_equations import NormalEquations, Ranges, inverse_3x3, normal_equations
from railfix.track.trajectory import Trajectory


class ConstrainedLimits(Settings):
    """Limits of the iteration along the line.

    Attributes
    ----------
    tolerance_m : float
        Last step inside a section: one of 5 m leaves 0.03 mm (`NormalEquations.after`).
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
        Along-track dilution: sigma along the line for unit, equal weights and an exact map.
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


def _along(
    equations: NormalEquations, trajectory: Trajectory, section: Indices
) -> tuple[Floats, Floats, Floats, Floats]:
    """Step and sigma (also of an exact map) along the section, and the least WSSE, map error allowed for."""
    axes = np.stack([trajectory.tangent[section], trajectory.across[section], trajectory.up[section]], axis=1)
    matrix = axes @ equations.matrix @ axes.swapaxes(1, 2)
    matrix[:, 1, 1] += 1.0 / trajectory.sigma_plan_m**2
    matrix[:, 2, 2] += 1.0 / trajectory.sigma_height_m**2
    vector = np.einsum("tij,tj->ti", axes, equations.vector)
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
    least = equations.wsse - np.einsum("ti,ti->t", whole, vector)
    return step, sigma, exact, least


def constrained_position(
    ranges: Ranges, trajectory: Trajectory, vertex: Indices, *, limits: ConstrainedLimits | None = None
) -> Constrained:
    """Positions along the line of all epochs at once, each started at a point of the trajectory.

    Newton steps inside a section (P1 2.2(3), algorithm of one unknown after the clocks are
    eliminated); a step that leaves the section stops at its end and goes on from there in the
    neighbouring one. Where both neighbours of a point send the step back to it, the point itself
    is the answer. At either end of the line the position is clamped and `overshoot_m` is how
    far beyond it the ranges pull.

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
    epochs, channels = ranges.code_m.shape
    arc, sigma, exact_sigma, wsse = np.full((4, epochs), np.nan)
    overshoot = np.zeros(epochs)
    chosen = np.full(epochs, -1, dtype=np.intp)
    clock = np.full((epochs, len(ranges.groups)), np.nan)
    residual = np.full((epochs, channels), np.nan)
    iterations = np.zeros(epochs, dtype=np.int64)
    length, last = trajectory.length_m, len(trajectory.length_m) - 1

    active = np.flatnonzero((vertex >= 0) & (ranges.n_used - ranges.n_clocks >= 1))
    section = np.minimum(vertex[active], last)
    along = np.where(vertex[active] > last, length[section], 0.0)
    entered = np.zeros(len(active), dtype=np.int8)  # -1 through the lower end, +1 through the upper, 0 not just now
    for _ in range(limits.max_iterations):
        if not len(active):
            break
        part = ranges if len(active) == epochs else ranges.take(active)
        place = trajectory.ecef_m[section] + along[:, None] * trajectory.tangent[section]
        equations = normal_equations(part, place)
        step, deviation, exact, least = _along(equations, trajectory, section)
        target = along + step
        below, above = target < 0.0, target > length[section]
        inside = ~below & ~above  # NaN targets are inside and settle as "no position"
        ended = (below & (section == 0) & (along == 0.0)) | (above & (section == last) & (along == length[section]))
        turned = (below & (entered < 0)) | (above & (entered > 0))
        settled = (inside & ~(np.abs(step) > limits.tolerance_m)) | ended | turned

        iterations[active] += 1
        done = active[settled]
        final = np.where(inside, target, along)[settled]
        arc[done] = trajectory.arc_m[section[settled]] + final
        chosen[done] = np.where(np.isfinite(final), section[settled], -1)
        sigma[done], exact_sigma[done], wsse[done] = deviation[settled], exact[settled], least[settled]
        overshoot[done] = np.where(ended, np.abs(step), 0.0)[settled]
        last_step = np.where(inside, step, 0.0)[settled, None] * trajectory.tangent[section[settled]]
        clock[done], residual[done] = equations.after(last_step, settled)

        down = below & (section > 0)
        up = above & (section < last)
        section = section - down + up
        along = np.where(down, length[section], np.where(up, 0.0, np.clip(target, 0.0, length[section])))
        entered = np.where(down, 1, np.where(up, -1, 0)).astype(np.int8)
        going = ~settled
        active, section, along, entered = active[going], section[going], along[going], entered[going]
    return Constrained(
        arc_m=arc,
        section=chosen,
        sigma_m=sigma,
        exact_map_sigma_m=exact_sigma,
        dilution=along_track_dilution(ranges, trajectory, arc, chosen),
        overshoot_m=overshoot,
        clock_m=clock,
        wsse=wsse,
        residual_m=residual,
        iterations=iterations,
    )


def along_track_dilution(ranges: Ranges, trajectory: Trajectory, arc_m: Floats, section: Indices) -> Floats:
    """Sigma along the line for ranges of unit sigma and an exact map: geometry alone, shape (T,).

    Infinite where the satellites stand across the track, NaN where there is no position.
    """
    result = np.full(len(ranges), np.nan)
    at = np.flatnonzero(section >= 0)
    if not len(at):
        return result
    part = ranges if len(at) == len(ranges) else ranges.take(at)
    unit = Ranges(
        sat_ecef_m=part.sat_ecef_m,
        code_m=part.code_m,
        weight=(part.weight > 0).astype(np.float64),
        groups=part.groups,
        ties=part.ties,
    )
    equations = normal_equations(unit, trajectory.at_arc(arc_m[at]))
    tangent = trajectory.tangent[section[at]]
    information = np.einsum("ti,tij,tj->t", tangent, equations.matrix, tangent)
    with np.errstate(divide="ignore"):
        result[at] = 1.0 / np.sqrt(np.maximum(information, 0.0))
    return result
