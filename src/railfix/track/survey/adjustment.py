"""Least-squares adjustment of all runs of a survey, and of the line that their passes share.

Errors follow Student's t distribution: iteratively reweighted least squares (K. Lange, R. Little and J. Taylor, Robust
statistical modeling using the t distribution, Journal of the American Statistical Association 84, 1989), so that
outliers lose their weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from railfix.core.arrays import Floats
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.track.survey import equations as eq
from railfix.track.survey.equations import Equations, ReferenceLine, RunColumns
from railfix.track.survey.passes import Ties
from railfix.track.survey.runs import SurveyLimits, SurveyRun

#: Rounds of reweighting at most, and the change of a solution that ends them [m].
_ROUNDS: Final = 15
_SETTLED_M: Final = 0.02
#: Median of the norm of one, two and three standard normal variables.
_MEDIAN: Final = {1: 0.6745, 2: 1.1774, 3: 1.5382}
#: Scales of the stated standard deviations that residuals may show.
_SCALES: Final = (0.2, 10.0)
#: Loose prior for conditioning: standard deviation of every unknown [m].
_ANYWHERE_M: Final = 1e5
#: Points of the line whose standard deviation is computed at most, others are interpolated, and columns at a time.
_SIGMAS: Final = 200
_COLUMNS: Final = 20


@dataclass(frozen=True, kw_only=True)
class Adjusted:
    """Result of an adjustment."""

    ecef_m: tuple[Floats, ...]  #: Positions of each run, its offset taken off; shape (n, 3).
    #: Points of the line across and above the reference line, and their standard deviations; of shape (0, 2) where they
    #: were not asked for; shape (J, 2).
    line_m: Floats
    line_sigma_m: Floats
    #: Mean weight of the positions or codes of each row, about 1 without outliers; 0 without any; shape (n,).
    weight: tuple[Floats, ...]
    scale: tuple[float, ...]  #: Standard deviation of the positions or codes of each run against those stated.


def adjust(
    runs: Sequence[SurveyRun],
    near_ecef_m: Sequence[Floats],
    *,
    line: ReferenceLine | None = None,
    ties: Ties | None = None,
    repeats: Sequence[Floats] | None = None,
    limits: SurveyLimits | None = None,
    sigmas: Literal["none", "line"] = "none",
) -> Adjusted:
    """Adjust the positions of all runs, with the line where its passes are known.

    Parameters
    ----------
    runs : sequence of SurveyRun
    near_ecef_m : sequence of ndarray, shape (n, 3) [m]
        Approximate positions of every row, right to a kilometre.
    line, ties : ReferenceLine and Ties, optional
    repeats : sequence of ndarray, shape (n,), optional
        How often the run passes the place of each row: minutes later reflections are the same there, so all passes
        together count as one.
    limits : SurveyLimits, optional
    sigmas : {"none", "line"}
        Whether the standard deviations of the line are computed, which takes longer than the adjustment.
    """
    limits = limits or SurveyLimits()
    origin = np.mean(near_ecef_m[0], axis=0)
    columns: list[RunColumns] = []
    for run in runs:
        columns.append(RunColumns.from_first(run, columns[-1].end if columns else 0))
    start = columns[-1].end
    unknowns = start + (0 if line is None else 2 * len(line))
    systems: list[Equations] = []
    measured: list[int] = []
    for r, (run, of_run) in enumerate(zip(runs, columns, strict=True)):
        near = near_ecef_m[r] - origin
        latitude, longitude, _ = geodetic_from_ecef(np.mean(near_ecef_m[r], axis=0))
        axes = np.asarray(enu_axes(latitude, longitude))
        share = independent_share(run, near, limits) / (1.0 if repeats is None else repeats[r])
        measured.append(len(systems))
        if run.signals is None:
            systems.append(eq.position_equations(run, of_run, axes, origin, share, unknowns))
        else:
            systems.append(eq.code_equations(run.signals, of_run, near, origin, share, unknowns))
            systems.append(eq.change_equations(run.signals, of_run, near, origin, unknowns))
        systems.append(eq.motion_equations(run, of_run, axes, limits, unknowns))
        systems.append(eq.offset_equations(run, of_run, axes, unknowns))
    if line is not None and ties is not None:
        systems.append(eq.tie_equations(line, ties, columns, start, origin, limits, unknowns))
        systems.append(eq.bend_equations(line, start, unknowns))
    solution, weights, scales = _solve(systems, unknowns, limits)
    sigma = np.zeros((0, 2)) if sigmas == "none" else _line_sigmas(systems, weights, scales, start, unknowns, limits)
    return Adjusted(
        ecef_m=tuple(solution[c.row[:, None] + np.arange(3)] + origin for c in columns),
        line_m=solution[start:].reshape(-1, 2),
        line_sigma_m=sigma,
        weight=tuple(_of_rows(weights[i], run) for i, run in zip(measured, runs, strict=True)),
        scale=tuple(scales[i] for i in measured),
    )


def independent_share(run: SurveyRun, near_m: Floats, limits: SurveyLimits) -> Floats:
    """Share of each row in an independent position, by the time and the way since the row before, shape (n,)."""
    since = np.diff(run.seconds, prepend=run.seconds[0] - 2.0 * limits.correlation_s)
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(near_m, axis=0), axis=1)])
    by_time = since / np.maximum(2.0 * limits.correlation_s, 1e-9)
    by_way = way / np.maximum(2.0 * limits.correlation_m, 1e-9)
    return np.asarray(np.minimum(1.0, by_time + by_way))


def _solve(
    systems: Sequence[Equations], unknowns: int, limits: SurveyLimits
) -> tuple[Floats, list[Floats], list[float]]:
    """Solve by reweighting; return the solution, and weights and scale of each kind of equations."""
    weights = [np.ones(len(system.share)) for system in systems]
    scales = [1.0 for _ in systems]
    solution = np.zeros(unknowns)
    for _ in range(_ROUNDS):
        before = solution
        right = np.zeros(unknowns)
        for system, weight, scale in zip(systems, weights, scales, strict=True):
            factor = np.repeat(weight * system.share / scale**2, system.size)
            right += system.matrix.T @ (factor * system.value)
        solution = _factorised(_normal_matrix(systems, weights, scales, unknowns)).solve(right)
        for i, system in enumerate(systems):
            norm = np.linalg.norm((system.value - system.matrix @ solution).reshape(-1, system.size), axis=1)
            if system.scaled and len(norm):
                scales[i] = float(np.clip(np.median(norm) / _MEDIAN[system.size], *_SCALES))
            if system.robust:
                weights[i] = (limits.freedom + system.size) / (limits.freedom + (norm / scales[i]) ** 2)
        if np.abs(solution - before).max(initial=0.0) < _SETTLED_M:
            break
    return solution, weights, scales


def _normal_matrix(
    systems: Sequence[Equations], weights: Sequence[Floats], scales: Sequence[float], unknowns: int
) -> sp.csc_array:
    matrix = sp.vstack([system.matrix for system in systems], format="csr")
    factors = [
        np.repeat(weight * system.share / scale**2, system.size)
        for system, weight, scale in zip(systems, weights, scales, strict=True)
    ]
    weighted = sp.diags_array(np.concatenate(factors)) @ matrix
    return sp.csc_array(matrix.T @ weighted + sp.eye_array(unknowns) / _ANYWHERE_M**2)


def _factorised(normal: sp.csc_array) -> Any:
    """Factorise a symmetric positive definite matrix."""
    return splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _line_sigmas(
    systems: Sequence[Equations],
    weights: Sequence[Floats],
    scales: Sequence[float],
    start: int,
    unknowns: int,
    limits: SurveyLimits,
) -> Floats:
    """Standard deviations of the points of the line, shape (J, 2) [m].

    With Student's t errors an observation informs by (freedom + size) / (freedom + size + 2), not by its weight at the
    end of the reweighting, which is largest where errors happen to be small.
    """
    expected = [
        np.full(len(weight), (limits.freedom + system.size) / (limits.freedom + system.size + 2.0))
        if system.robust
        else weight
        for system, weight in zip(systems, weights, strict=True)
    ]
    lower = [np.minimum(a, b) for a, b in zip(expected, weights, strict=True)]
    factor = _factorised(_normal_matrix(systems, lower, scales, unknowns))
    count = (unknowns - start) // 2
    chosen = np.unique(np.linspace(0, count - 1, min(count, _SIGMAS)).astype(np.intp))
    sigma = np.empty((len(chosen), 2))
    for axis in range(2):
        columns = start + 2 * chosen + axis
        for low in range(0, len(columns), _COLUMNS):
            part = columns[low : low + _COLUMNS]
            right = np.zeros((unknowns, len(part)))
            right[part, np.arange(len(part))] = 1.0
            sigma[low : low + _COLUMNS, axis] = np.sqrt(factor.solve(right)[part, np.arange(len(part))])
    return np.stack([np.interp(np.arange(count), chosen, sigma[:, axis]) for axis in range(2)], axis=1)


def _of_rows(weight: Floats, run: SurveyRun) -> Floats:
    """Mean weight of each row, shape (n,)."""
    rows = np.flatnonzero(np.isfinite(run.ecef_m).all(axis=1)) if run.signals is None else run.signals.row
    count = np.bincount(rows, minlength=len(run))
    return np.asarray(np.bincount(rows, weights=weight, minlength=len(run)) / np.maximum(count, 1))
