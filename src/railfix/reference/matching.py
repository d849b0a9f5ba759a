"""Fixes on the antenna's trajectory: which pass of the line, where on it, how far off it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices
from railfix.core.timescale import nearest_rows, seconds, timedelta
from railfix.track.trajectory import Trajectory, passes_of

_OUT_OF_REACH_M = 1e6  #: A pass out of reach costs this much more than any other choice [m].
_JITTER_M = 2.0  #: Positions may jitter by this much more than the train can run [m].


def match(
    time: Datetimes, ecef_m: Floats, trajectory: Trajectory, *, lateral_m: float, height_m: float, max_speed_mps: float
) -> tuple[Floats, Floats, Floats, Indices]:
    """Put F positions in order of time on a trajectory: the shortest chain of passes within `max_speed_mps`.

    Returns arc length, NaN where no pass is near enough; distance to the right and above, there or at the nearest
    point; and segment, shapes (F,).
    """
    count = len(ecef_m)
    nearest, _ = trajectory.nearest(ecef_m)
    section, _ = trajectory.segment_at(nearest)
    offset = ecef_m - trajectory.at_arc(nearest)
    arc = np.full(count, np.nan)
    lateral, height = _beside(offset, trajectory, section)
    passes = passes_of(ecef_m, trajectory, float(np.hypot(lateral_m, height_m)))
    beside, above = _beside(passes.offset_m, trajectory, passes.segment)
    # beyond the ends of the line there is nothing to be on
    beyond = np.abs(passes.along_m - passes.foot_m) > 0.5
    beyond &= (passes.segment == 0) | (passes.segment == len(trajectory.length_m) - 1)
    within = (np.abs(beside) <= lateral_m) & (np.abs(above) <= height_m) & ~beyond
    near = np.flatnonzero(passes.lowest & ~passes.again & within)
    since = seconds(time - time[0]) if count else np.empty(0)
    along = trajectory.arc_m[passes.segment] + passes.foot_m
    chosen = near[_chain(passes.position[near], along[near], beside[near], since, max_speed_mps)]
    at = passes.position[chosen]
    arc[at], section[at] = along[chosen], passes.segment[chosen]
    lateral[at], height[at] = beside[chosen], above[chosen]
    return arc, lateral, height, section


def _beside(offset: Floats, trajectory: Trajectory, section: Indices) -> tuple[Floats, Floats]:
    """Components of offsets to the right, and square to the path and that."""
    right, along = trajectory.across[section], trajectory.tangent[section]
    return np.einsum("fi,fi->f", offset, right), np.einsum("fi,fi->f", offset, np.cross(right, along))


def _chain(position: Indices, arc_m: Floats, lateral_m: Floats, time_s: Floats, max_speed_mps: float) -> Indices:
    """One pass a position: the cheapest chain from the first to the last (dynamic programming)."""
    found, first = np.unique(position, return_index=True)
    if len(found) == len(position):
        return np.arange(len(found))
    edges = np.append(first, len(position)).tolist()
    cost = np.abs(lateral_m[edges[0] : edges[1]])
    came: list[Indices] = []
    for k, (begin, end) in enumerate(pairwise(edges[1:])):
        start = edges[k]
        way = np.abs(arc_m[begin:end, None] - arc_m[None, start:begin])
        reach = max_speed_mps * (time_s[found[k + 1]] - time_s[found[k]]) + _JITTER_M
        # The shortest way counts; a second pass of a crossing costs what it is longer by.
        total = cost + way + np.where(way > reach, _OUT_OF_REACH_M, 0.0)
        came.append(total.argmin(axis=1))
        cost = total.min(axis=1) + np.abs(lateral_m[begin:end])
    best = int(np.argmin(cost))
    chosen = [edges[-2] + best]
    for k in range(len(came) - 1, -1, -1):
        best = int(came[k][best])
        chosen.append(edges[k] + best)
    return np.array(chosen[::-1], dtype=np.intp)


SAME_INSTANT_NS: Final = 20_000_000  #: Tags that differ by no more belong to one instant [ns].
#: Speeds further apart leave the distance between them unknown [s], with this variance [m2].
LONGEST_STEP_S: Final = 2.5
UNKNOWN_M2: Final = 1e8


@dataclass(frozen=True, kw_only=True)
class Speeds:
    """Speeds of one antenna along its path; only instants at which there is one, rising in time."""

    time: Datetimes
    speed_mps: Floats
    sigma_mps: Floats

    def way(self, time: Datetimes) -> tuple[Floats, Floats]:
        """Return the distance travelled (trapezoidal rule) [m] and its variance by white noise [m2]; NaN outside."""
        if len(self.time) < 2:
            return np.full(len(time), np.nan), np.full(len(time), np.nan)
        known, at = seconds(self.time - self.time[0]), seconds(time - self.time[0])
        step = np.diff(known)
        way = np.cumsum(step * (self.speed_mps[1:] + self.speed_mps[:-1]) / 2.0)
        white = step**2 * (self.sigma_mps[1:] ** 2 + self.sigma_mps[:-1] ** 2) / 2.0
        variance = np.cumsum(np.where(step > LONGEST_STEP_S, UNKNOWN_M2, white))
        ways = [np.interp(at, known, np.append(0.0, v), left=np.nan, right=np.nan) for v in (way, variance)]
        return ways[0], ways[1]


def combine_speeds(time: Datetimes, sources: Sequence[Speeds]) -> tuple[Floats, Floats]:
    """Combine speeds of all sources, weighted by their variances, shapes (N,); NaN where there is none."""
    weight, total = np.zeros(len(time)), np.zeros(len(time))
    for source in sources:
        at = nearest_rows(time, source.time, within_ns=SAME_INSTANT_NS)
        rows = np.flatnonzero(at >= 0)
        w = source.sigma_mps[rows] ** -2.0
        np.add.at(weight, at[rows], w)
        np.add.at(total, at[rows], w * source.speed_mps[rows])
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(weight > 0, total / weight, np.nan), np.where(weight > 0, weight**-0.5, np.nan)


def instants(rows: Datetimes, others: Sequence[Datetimes]) -> Datetimes:
    """Return the instants of a reference: rows of the log, receiver epochs, regular steps elsewhere."""
    merged = rows
    for other in others:
        new = other[(other > rows[0]) & (other < rows[-1])]
        merged = np.union1d(merged, new[nearest_rows(merged, new, within_ns=SAME_INSTANT_NS) < 0])
    usual = float(np.median(seconds(np.diff(rows))))
    step = seconds(np.diff(merged))
    pieces = np.where(step > 1.5 * usual, np.ceil(step / usual - 1e-6), 1.0).astype(np.int64)
    first = np.repeat(np.arange(len(step)), pieces)
    number = np.arange(len(first)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    filled = merged[first] + timedelta(step[first] * number / pieces[first])
    return np.append(filled, merged[-1])
