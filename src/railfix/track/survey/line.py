"""Survey of a line: one map, with standard deviations, by adjustment of several runs with ordinary receivers.

Errors are assumed to follow Student's t distribution, for which the adjustment uses iteratively reweighted least
squares (Lange, Little and Taylor 1989).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from railfix.core.arrays import Floats, Indices, Integers
from railfix.core.geodesy import axes_at
from railfix.core.notebook import plural
from railfix.track.map_from_positions import ANTENNA_PATH
from railfix.track.survey import equations as eq
from railfix.track.survey.equations import Equations, ReferenceLine, RunColumns
from railfix.track.survey.passes import (
    Course,
    Leg,
    Pass,
    Ties,
    find_course,
    find_legs,
    find_passes,
    find_ties,
    without_other_track,
)
from railfix.track.survey.runs import SurveyLimits, SurveyRun
from railfix.track.track import Provenance, Track

_ADJUSTMENT_ROUNDS: Final = 15  #: Largest number of reweighting iterations.
_SETTLED_M: Final = 0.02  #: The iterations end when the solution changes by less than this value [m].
#: Median of the norm of one, two and three standard normal variables.
_MEDIAN: Final = {1: 0.6745, 2: 1.1774, 3: 1.5382}
#: Limits of the factor that scales stated standard deviations. The lower limit is necessary because residuals do not
#: show errors that are common to all satellites.
_SCALES: Final = (0.5, 10.0)
_ANYWHERE_M: Final = 1e5  #: Standard deviation of the loose prior of each unknown, for conditioning [m].
#: Largest number of points for which standard deviations are computed; the values of other points are interpolated.
_SIGMAS: Final = 200
_COLUMNS: Final = 20  #: Number of columns of the inverse matrix that are computed at once.


@dataclass(frozen=True, kw_only=True)
class Adjusted:
    """Result of an adjustment."""

    #: Adjusted positions of each run, corrected for the run's offset, shape (n, 3).
    ecef_m: tuple[Floats, ...]
    #: Shifts of the line's points from the reference line, across and upward, shape (J, 2); (0, 2) without a line.
    line_m: Floats
    line_sigma_m: Floats  #: Standard deviations of `line_m`, shape (J, 2); (0, 2) if not requested.
    #: Mean weight of the positions or codes in each row of each run, shape (n,). It is about 1 if the row has no
    #: outliers, and 0 if it has no observation.
    weight: tuple[Floats, ...]
    scale: tuple[float, ...]  #: Ratio of actual to stated standard deviation of the positions or codes of each run.


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
    """Adjust the positions of all runs and, if `line` and `ties` are given, the points of the line.

    `near_ecef_m` are approximate positions of each run, shape (n, 3). `repeats` states, for each row, how often the run
    passes the position of the row; the row's weight is divided by this number. With ``sigmas="line"``, `line_sigma_m`
    is computed.
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
        axes = axes_at(np.mean(near_ecef_m[r], axis=0))
        share = independent_share(run, near, limits) / (1.0 if repeats is None else repeats[r])
        measured.append(len(systems))
        if run.signals is None:
            systems.append(eq.position_equations(run, of_run, axes, origin, share, unknowns))
        else:
            systems.append(eq.code_equations(run.signals, of_run, near, origin, share, unknowns))
            systems += eq.change_equations(run.signals, of_run, near, origin, share, unknowns)
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
    """Return the weight of each row relative to a position with independent error, shape (n,).

    The weight increases with the time and the distance since the previous row. It is 1 if the time is at least twice
    the correlation time, or the distance twice the correlation length.
    """
    since = np.diff(run.seconds, prepend=run.seconds[0] - 2.0 * limits.correlation_s)
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(near_m, axis=0), axis=1)])
    by_time = since / np.maximum(2.0 * limits.correlation_s, 1e-9)
    by_way = way / np.maximum(2.0 * limits.correlation_m, 1e-9)
    return np.asarray(np.minimum(1.0, by_time + by_way))


def _solve(
    systems: Sequence[Equations], unknowns: int, limits: SurveyLimits
) -> tuple[Floats, list[Floats], list[float]]:
    """Solve by iterative reweighting; return the solution, and for each of the `systems` its weights and scale."""
    weights = [np.ones(len(system.share)) for system in systems]
    scales = [1.0 for _ in systems]
    solution = np.zeros(unknowns)
    for _ in range(_ADJUSTMENT_ROUNDS):
        before = solution
        right = np.zeros(unknowns)
        for system, weight, scale in zip(systems, weights, scales, strict=True):
            factor = np.repeat(weight * system.share / scale**2, system.size)
            right += system.matrix.T @ (factor * system.value)
        solution = _factorise(_normal_matrix(systems, weights, scales, unknowns)).solve(right)
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


def _factorise(normal: sp.csc_array) -> Any:
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
    """Compute the standard deviations of the line's points, across and in height, shape (J, 2) [m].

    The expected information of an observation with Student's t errors is ``(freedom + size) / (freedom + size + 2)``
    times the information with normal errors. The information of an observation is multiplied by the smaller of this
    factor and the robust weight.
    """
    expected = [
        np.full(len(weight), (limits.freedom + system.size) / (limits.freedom + system.size + 2.0))
        if system.robust
        else weight
        for system, weight in zip(systems, weights, strict=True)
    ]
    lower = [np.minimum(a, b) for a, b in zip(expected, weights, strict=True)]
    factor = _factorise(_normal_matrix(systems, lower, scales, unknowns))
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
    """Return the mean weight of the observations in each row, shape (n,)."""
    rows = np.flatnonzero(np.isfinite(run.ecef_m).all(axis=1)) if run.signals is None else run.signals.row
    count = np.bincount(rows, minlength=len(run))
    return np.asarray(np.bincount(rows, weights=weight, minlength=len(run)) / np.maximum(count, 1))


_ROUNDS: Final = 3  #: Number of adjustments that include the line. The passes are searched before each adjustment.
#: Passes in opposite directions are assigned to separate tracks if they are farther apart than this number of standard
#: deviations of a run's offset. The value is three standard deviations of the difference of two offsets.
_OTHER_TRACK: Final = 3.0 * 2.0**0.5
_TURN_M: Final = 40.0  #: Reversals are found from the directions over half of this length before and after a point [m].
_END_POINTS: Final = 8  #: Number of points from which the direction at an end of the line is computed.
_OF_THE_MAP: Final = 95.0  #: The map's accuracy is this percentile of the standard deviations along the line.


@dataclass(frozen=True, kw_only=True)
class Survey:
    """Result of the survey of a line."""

    track: Track  #: Surveyed map; its standard deviations are the 95th percentiles along the line.
    #: Standard deviations of each point across the line and in height, shape (V,).
    sigma_plan_m: Floats
    sigma_height_m: Floats
    passes: Integers  #: Number of passes at each point, shape (V,).
    runs_ecef_m: tuple[Floats, ...]  #: Adjusted positions of each run, shape (n, 3).
    scale: tuple[float, ...]  #: Ratio of actual to stated standard deviation of the positions or codes of each run.
    beside_m: float  #: Total length of the parts of runs that are off the line.
    closed: bool  #: Whether the line is closed.


def survey_line(runs: Sequence[SurveyRun], *, limits: SurveyLimits | None = None, name: str = "survey") -> Survey:
    """Adjust runs to the map of one line.

    First, each run is adjusted on its own. Then all runs are adjusted together as passes of the line. Raise ValueError
    if no run moves, or the runs have no line in common.
    """
    limits = limits or SurveyLimits()
    origin = np.nanmean(np.concatenate([run.ecef_m for run in runs]), axis=0)
    axes = axes_at(origin)
    plain = [replace(run, signals=None) for run in runs]
    near = adjust(plain, [_interpolate_positions(run) for run in runs], limits=limits).ecef_m
    adjusted = adjust(runs, near, limits=limits) if any(run.signals is not None for run in runs) else None
    positions = near if adjusted is None else adjusted.ecef_m
    course: Course | None = None
    tolerance = _OTHER_TRACK * max(float(np.hypot(run.common_sigma_m[0], limits.apart_m)) for run in runs)
    for k in range(_ROUNDS):
        local = [(ecef - origin) @ axes.T for ecef in positions]
        legs = [leg for r, run in enumerate(runs) for leg in find_legs(r, local[r], run.seconds, limits, _TURN_M)]
        if not legs:
            raise ValueError(f"no run moves by {limits.spacing_m:g} m; positions of a line were expected")
        course = find_course(legs, limits) if course is None else course
        passes, beside = find_passes(course, legs, limits)
        whole = sum(len(each.place) for each in passes)
        passes, apart = without_other_track(course, legs, passes, limits, tolerance)
        beside += limits.spacing_m * (whole - sum(len(each.place) for each in passes))
        ties = find_ties(course, legs, passes)
        line = _reference_line(course, origin, axes)
        adjusted = adjust(
            runs, positions, line=line, ties=ties, repeats=_repeats(runs, ties), limits=limits,
            sigmas="line" if k == _ROUNDS - 1 else "none",
        )  # fmt: skip
        moved = line.ecef_m + adjusted.line_m[:, :1] * line.across + adjusted.line_m[:, 1:] * line.up
        course = replace(course, point_m=(moved - origin) @ axes.T)
        positions = adjusted.ecef_m
    assert adjusted is not None
    assert course is not None
    order, count = _points_of_line(course, ties)
    sigma = np.hypot(adjusted.line_sigma_m[order], _unseen_sigma(runs))
    sigma_plan, sigma_height = (float(np.percentile(sigma[:, axis], _OF_THE_MAP)) for axis in range(2))
    notes = _notes(runs, legs, passes, count, moved[order], (sigma_plan, sigma_height), beside, apart)
    track = Track.from_ecef(
        moved[order],
        name=name,
        sigma_plan_m=sigma_plan,
        sigma_height_m=sigma_height,
        provenance=Provenance(files=tuple(run.name for run in runs), notes=notes),
    )
    return Survey(
        track=track,
        sigma_plan_m=sigma[:, 0],
        sigma_height_m=sigma[:, 1],
        passes=count,
        runs_ecef_m=adjusted.ecef_m,
        scale=adjusted.scale,
        beside_m=beside,
        closed=course.closed and order[0] == order[-1],
    )


def _unseen_sigma(runs: Sequence[SurveyRun]) -> Floats:
    """Return standard deviations in plan and height to be added for the common error of a single run, shape (2,) [m].

    Without a second run, the common error is not observable. The addition doubles the contribution of
    `SurveyRun.common_sigma_m` to the standard deviation. Without the addition, sigmas of single runs with low-cost
    receivers were half of the actual errors.
    """
    return np.sqrt(3.0) * np.array(runs[0].common_sigma_m) if len(runs) == 1 else np.zeros(2)


def _interpolate_positions(run: SurveyRun) -> Floats:
    """Interpolate missing positions of a run in time, and return all positions, shape (n, 3) [m]."""
    known = np.isfinite(run.ecef_m[:, 0])
    return np.stack([np.interp(run.seconds, run.seconds[known], run.ecef_m[known, i]) for i in range(3)], axis=1)


def _reference_line(course: Course, origin: Floats, axes: Floats) -> ReferenceLine:
    way = course.direction
    across = np.stack([way[:, 1], -way[:, 0], np.zeros(len(way))], axis=1) @ axes
    up = np.broadcast_to(axes[2], across.shape)
    return ReferenceLine(ecef_m=course.point_m @ axes + origin, across=across, up=up, closed=course.closed)


def _repeats(runs: Sequence[SurveyRun], ties: Ties) -> list[Floats]:
    """Return how often each run passes the position of each of its rows, shape (n,)."""
    found = []
    for r, run in enumerate(runs):
        mine = ties.run == r
        count = np.bincount(ties.point[mine], minlength=int(ties.point.max(initial=0)) + 1)
        rows, first = np.unique(ties.row[mine, 1], return_index=True)
        often = count[ties.point[mine]][first].astype(np.float64)
        found.append(np.interp(np.arange(len(run)), rows, often) if len(rows) else np.ones(len(run)))
    return found


def _without_loose_ends(plan_m: Floats) -> slice:
    """Return the range of an open line's points that remains after removal of end points that do not advance.

    Such end points are position noise at standstill.
    """
    first, last = 0, len(plan_m)
    spacing = float(np.median(np.linalg.norm(np.diff(plan_m, axis=0), axis=1)))
    while last - first > _END_POINTS:
        end, start = plan_m[last - _END_POINTS : last], plan_m[first : first + _END_POINTS][::-1]
        loose = [
            float((p[-1] - p[-2]) @ (p[-3] - p[0])) < 0.5 * spacing * np.linalg.norm(p[-3] - p[0]) for p in (end, start)
        ]
        last, first = last - int(loose[0]), first + int(loose[1])
        if not any(loose):
            break
    return slice(first, last)


def _points_ahead(plan_m: Floats) -> Indices:
    """Return the indices of points that advance by at least half a spacing; other points are noise at standstill."""
    reach = _END_POINTS // 2
    index = np.arange(len(plan_m))
    way = plan_m[np.minimum(index + reach, len(index) - 1)] - plan_m[np.maximum(index - reach, 0)]
    way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
    least = 0.5 * float(np.median(np.linalg.norm(np.diff(plan_m, axis=0), axis=1)))
    kept = [0]
    for k in range(1, len(plan_m)):
        if float((plan_m[k] - plan_m[kept[-1]]) @ way[k]) >= least:
            kept.append(k)
    return np.array(kept, dtype=np.intp)


def _points_of_line(course: Course, ties: Ties) -> tuple[Indices, Integers]:
    """Return the indices of the line's points that have passes, and the number of passes at these points.

    The first point of a closed line is repeated at the end. Raise ValueError if fewer than three points remain.
    """
    count = np.bincount(ties.point, minlength=len(course))
    kept = np.flatnonzero(count > 0)
    closed = course.closed and len(kept) == len(course)
    plan = course.point_m[kept, :2]
    kept = kept[_points_ahead(plan)] if closed else kept[_without_loose_ends(plan)]
    kept = kept if closed else kept[_points_ahead(course.point_m[kept, :2])]
    order = np.append(kept, kept[0]) if closed else kept
    if len(order) < 3:
        raise ValueError("the runs have no line in common; give runs over one line")
    return order, count[order]


def _notes(
    runs: Sequence[SurveyRun],
    legs: Sequence[Leg],
    passes: Sequence[Pass],
    count: Integers,
    ecef_m: Floats,
    sigma_m: tuple[float, float],
    beside: float,
    apart: float,
) -> tuple[str, ...]:
    """Return notes to the user on the runs, the accuracy of the map, and gaps."""
    against = sum(len(each.place) for each in passes if each.sign < 0) / max(sum(len(e.place) for e in passes), 1)
    driven = sum(float(leg.arc_m[-1]) for leg in legs)
    length = float(np.linalg.norm(np.diff(ecef_m, axis=0), axis=1).sum())
    notes = [
        ANTENNA_PATH,
        f"surveyed from {plural(runs, 'run')} of {driven:,.0f} m in total, {driven / length:.1f} times the length of "
        f"the line; {against:.0%} of this distance was against the direction of the line; each point is passed "
        f"{count.min()} to {count.max()} times",
        f"accuracy of the map {sigma_m[0]:.2f} m in plan and {sigma_m[1]:.2f} m in height (95th percentiles along the "
        f"line)",
    ]
    steps = np.concatenate([np.diff(leg.arc_m) for leg in legs])
    if len(bridged := steps[steps > _TURN_M]):
        notes.append(
            f"{plural(bridged, 'gap')} in the runs bridged by a curve, the longest {bridged.max():.0f} m; within a "
            "gap, the accuracy is assumed to be the accuracy at the ends of the gap"
        )
    if len(runs) == 1:
        plan, height = (2.0 * value for value in runs[0].common_sigma_m)
        notes.append(
            f"one run cannot show the error that is common to all its positions: the accuracy of the map includes "
            f"{plan:.1f} m in plan and {height:.1f} m in height for this error; add runs on other days"
        )
    if beside > 0.02 * driven:
        notes.append(f"{beside:,.0f} m of the runs are off the line (branches or wrong positions) and not used")
    if apart:
        notes.append(
            f"the runs of one direction are {apart:.1f} m beside the runs of the other direction; they are assumed to "
            "be on another track, and are left out; survey each track separately"
        )
    return tuple(notes)
