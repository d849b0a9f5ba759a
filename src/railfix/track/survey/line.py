"""Survey of a line: the runs of ordinary receivers to one map with its standard deviations along the line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Integers
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.track.from_positions import ANTENNA_PATH
from railfix.track.survey.adjustment import Adjusted, adjust
from railfix.track.survey.equations import ReferenceLine
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

#: Adjustments with the line; after each of them the passes are found again.
_ROUNDS: Final = 3
#: The directions have a track each where they lie apart by more than so many standard deviations of what a run may be
#: off: three of the difference of two.
_OTHER_TRACK: Final = 3.0 * 2.0**0.5
#: Way over which a change of direction is looked for [m].
_TURN_M: Final = 40.0
#: Points that show the direction at an end of the line.
_END_POINTS: Final = 8
#: Quantile of the standard deviations along the line that is that of the whole map.
_OF_THE_MAP: Final = 95.0


@dataclass(frozen=True, kw_only=True)
class Survey:
    """A surveyed line."""

    track: Track  #: Its standard deviations are the 95th percentiles of those along it.
    #: Standard deviations of each point across the line and in height, shape (V,).
    sigma_plan_m: Floats
    sigma_height_m: Floats
    passes: Integers  #: Number of passes at each point, shape (V,).
    runs_ecef_m: tuple[Floats, ...]  #: Adjusted positions of each run, shape (n, 3).
    scale: tuple[float, ...]  #: Standard deviation of the positions or codes of each run against those stated.
    beside_m: float  #: Way of the runs that does not lie on the line.
    closed: bool


def survey_line(runs: Sequence[SurveyRun], *, limits: SurveyLimits | None = None, name: str = "survey") -> Survey:
    """Adjust runs over one line to its map.

    The runs are adjusted alone, then with each other as passes of one line: laps, both directions and parts of the
    line. The course is that of the longest leg until it repeats itself, extended by the others.

    Parameters
    ----------
    runs : sequence of SurveyRun
        Over one line, each with three positions or more.
    limits : SurveyLimits, optional
    name : str

    Raises
    ------
    ValueError
        The runs never move, or lie apart.
    """
    limits = limits or SurveyLimits()
    origin = np.nanmean(np.concatenate([run.ecef_m for run in runs]), axis=0)
    latitude, longitude, _ = geodetic_from_ecef(origin)
    axes = np.asarray(enu_axes(latitude, longitude))
    plain = [replace(run, signals=None) for run in runs]
    near = adjust(plain, [_filled(run) for run in runs], limits=limits).ecef_m
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
    found = _survey(runs, legs, passes, ties, adjusted, course, moved, beside, name)
    if not apart:
        return found
    note = (
        f"the runs of one direction lie {apart:.1f} m beside those of the other: another track, left out; give the "
        "runs of each track by themselves"
    )
    notes = (*found.track.provenance.notes, note)
    return replace(found, track=replace(found.track, provenance=replace(found.track.provenance, notes=notes)))


def _filled(run: SurveyRun) -> Floats:
    """Positions with those that lack interpolated in time, shape (n, 3) [m]."""
    known = np.isfinite(run.ecef_m[:, 0])
    return np.stack([np.interp(run.seconds, run.seconds[known], run.ecef_m[known, i]) for i in range(3)], axis=1)


def _reference_line(course: Course, origin: Floats, axes: Floats) -> ReferenceLine:
    way = course.direction
    across = np.stack([way[:, 1], -way[:, 0], np.zeros(len(way))], axis=1) @ axes
    up = np.broadcast_to(axes[2], across.shape)
    return ReferenceLine(ecef_m=course.point_m @ axes + origin, across=across, up=up, closed=course.closed)


def _repeats(runs: Sequence[SurveyRun], ties: Ties) -> list[Floats]:
    """How often each run passes the place of each of its rows, shape (n,) each."""
    found = []
    for r, run in enumerate(runs):
        mine = ties.run == r
        count = np.bincount(ties.point[mine], minlength=int(ties.point.max(initial=0)) + 1)
        rows, first = np.unique(ties.row[mine, 1], return_index=True)
        often = count[ties.point[mine]][first].astype(np.float64)
        found.append(np.interp(np.arange(len(run)), rows, often) if len(rows) else np.ones(len(run)))
    return found


def _without_loose_ends(plan_m: Floats) -> slice:
    """Points of an open line without those at its ends that do not lead on: noise of runs that stand there."""
    first, last = 0, len(plan_m)
    spacing = float(np.median(np.linalg.norm(np.diff(plan_m, axis=0), axis=1)))
    while last - first > _END_POINTS:
        end, start = plan_m[last - _END_POINTS : last], plan_m[first : first + _END_POINTS][::-1]
        loose = [float((p[-1] - p[-2]) @ (p[-3] - p[0])) < 0.5 * spacing * _length(p[-3] - p[0]) for p in (end, start)]
        last, first = last - int(loose[0]), first + int(loose[1])
        if not any(loose):
            break
    return slice(first, last)


def _advancing(plan_m: Floats) -> Indices:
    """Points that lead on from the last by half a spacing or more: where runs stand, noise makes others."""
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


def _length(step_m: Floats) -> float:
    return float(np.linalg.norm(step_m))


def _survey(
    runs: Sequence[SurveyRun],
    legs: Sequence[Leg],
    passes: Sequence[Pass],
    ties: Ties,
    adjusted: Adjusted,
    course: Course,
    ecef: Floats,
    beside: float,
    name: str,
) -> Survey:
    """Make the map of the adjusted line: points that no pass crosses are left out, a closed one ends where it began."""
    count = np.bincount(ties.point, minlength=len(course))
    kept = np.flatnonzero(count > 0)
    closed = course.closed and len(kept) == len(course)
    plan = course.point_m[kept, :2]
    kept = kept[_advancing(plan)] if closed else kept[_without_loose_ends(plan)]
    kept = kept if closed else kept[_advancing(course.point_m[kept, :2])]
    order = np.append(kept, kept[0]) if closed else kept
    if len(order) < 3:
        raise ValueError("the runs have no line in common; give runs over one line")
    sigma = adjusted.line_sigma_m[order]
    sigma_plan, sigma_height = (float(np.percentile(sigma[:, axis], _OF_THE_MAP)) for axis in range(2))
    against = sum(len(each.place) for each in passes if each.sign < 0) / max(sum(len(e.place) for e in passes), 1)
    driven = sum(float(leg.arc_m[-1]) for leg in legs)
    length = float(np.linalg.norm(np.diff(ecef[order], axis=0), axis=1).sum())
    notes = [
        ANTENNA_PATH,
        f"surveyed from {len(runs)} run(s) of {driven:,.0f} m together, {driven / length:.1f} times the line, "
        f"{against:.0%} of it against its direction; each point is passed {count[order].min()} to {count[order].max()} "
        "times",
        f"accuracy of the map {sigma_plan:.2f} m in plan and {sigma_height:.2f} m in height: 95th percentiles along it",
    ]
    if beside > 0.02 * driven:
        notes.append(
            f"{beside:,.0f} m of the runs do not lie on the line and are not used: branches, or wrong positions"
        )
    track = Track.from_ecef(
        ecef[order],
        name=name,
        sigma_plan_m=sigma_plan,
        sigma_height_m=sigma_height,
        provenance=Provenance(files=tuple(run.name for run in runs), notes=tuple(notes)),
    )
    return Survey(
        track=track,
        sigma_plan_m=sigma[:, 0],
        sigma_height_m=sigma[:, 1],
        passes=count[order],
        runs_ecef_m=adjusted.ecef_m,
        scale=adjusted.scale,
        beside_m=beside,
        closed=closed,
    )
