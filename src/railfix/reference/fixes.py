"""Select the positions for a reference, with the reason for each rejection (P1 3.1(2), 4.2(2), P2 3.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import Final

import numpy as np

from railfix.core.arrays import Bits, Datetimes, Floats, Indices, Integers, Masks
from railfix.core.geodesy import sigma_along
from railfix.core.timescale import seconds
from railfix.io.position_log import PositionLog
from railfix.reference.matching import MatchedReference, match
from railfix.reference.settings import ReferenceSettings
from railfix.track.trajectory import Trajectory

#: Positions of two antennas that are tagged no further apart belong to one instant [ns].
SAME_INSTANT_NS: Final = 5_000_000
#: Runs of agreeing fixes that a run may be joined to, back from it.
_LOOK_BACK: Final = 60
#: Standard deviations of the travelled distance that a difference may have.
_TRAVEL_SIGMAS: Final = 3.0
_FIX: Final = 1


class FixRejection(IntFlag):
    """Reasons to reject a position as a reference; 0: accepted."""

    NONE = 0
    NO_POSITION = 1
    NOT_FIXED = 2
    LOW_RATIO = 4
    REPEATED = 8
    UNPAIRED = 16
    SPACING = 32
    OFF_TRACK = 64
    OFF_HEIGHT = 128
    TRAVEL = 256

    @property
    def text(self) -> str:
        """Names of the bits that are set, as in the output."""
        return " ".join(flag.name.lower() for flag in FixRejection if flag and flag in self and flag.name)


@dataclass(frozen=True, kw_only=True)
class Fixes:
    """Positions of one antenna with the reasons for rejection, n rows in order of time."""

    time: Datetimes  #: Shape (n,).
    ecef_m: Floats  #: Shape (n, 3).
    quality: Integers  #: Shape (n,).
    ratio: Floats  #: NaN where the log has none, shape (n,).
    sigma_enu_m: Floats  #: East, north, up; NaN where the log has none; shape (n, 3).
    rejection: Bits  #: `FixRejection` bits; a row that is rejected at one stage is not checked at the next; shape (n,).
    #: Distance to the other antenna minus that on the vehicle; NaN where it was not checked; shape (n,).
    spacing_m: Floats
    #: Position on the trajectory, and distance from it; NaN where it was not checked; shape (n,).
    arc_m: Floats
    lateral_m: Floats
    height_m: Floats
    sigma_m: Floats  #: Along the track, shape (n,).
    #: Distance from the previous good fix minus the distance travelled; NaN where no sensor measured that; shape (n,).
    travel_m: Floats

    def __len__(self) -> int:
        return len(self.time)

    @property
    def good(self) -> Indices:
        """Rows that are accepted."""
        return np.flatnonzero(self.rejection == 0)

    def counts(self) -> dict[str, int]:
        """Number of rows by reason, the good ones first."""
        counted = {"good": int((self.rejection == 0).sum())}
        for flag in FixRejection:
            if flag:
                counted[flag.text] = int((self.rejection & flag != 0).sum())
        return counted


def judge_alone(log: PositionLog, settings: ReferenceSettings) -> Fixes:
    """Check each row of a log by itself: whether it has a position, is a fix, and its ratio.

    Without qualities (a CSV without the column) all rows are taken as fixed.
    """
    timed = np.flatnonzero(~np.isnat(log.time))
    rows = timed[np.argsort(log.time[timed], kind="stable")]
    time, ecef = log.time[rows], log.ecef_m[rows]
    ratio = np.full(len(rows), np.nan) if log.ratio is None else log.ratio[rows]
    rejection = np.zeros(len(rows), dtype=np.int64)
    _reject(rejection, np.asarray(~np.isfinite(ecef).all(axis=1)), FixRejection.NO_POSITION)
    if log.has_quality:
        _reject(rejection, log.quality[rows] != _FIX, FixRejection.NOT_FIXED)
    with np.errstate(invalid="ignore"):
        _reject(rejection, np.asarray(ratio < settings.ratio), FixRejection.LOW_RATIO)
    repeated = np.zeros(len(rows), dtype=np.bool_)
    repeated[1:] = np.diff(time) == np.timedelta64(0, "ns")
    _reject(rejection, repeated, FixRejection.REPEATED)
    blank = np.full(len(rows), np.nan)
    return Fixes(
        time=time,
        ecef_m=ecef,
        quality=log.quality[rows],
        ratio=ratio,
        sigma_enu_m=log.sigma_m[rows][:, [1, 0, 2]],
        rejection=rejection,
        spacing_m=blank,
        arc_m=blank,
        lateral_m=blank,
        height_m=blank,
        sigma_m=blank,
        travel_m=blank,
    )


def _reject(rejection: Bits, mask: Masks, reason: FixRejection) -> None:
    """Give a reason to rows that have none yet."""
    rejection[mask & (rejection == 0)] |= reason


def judge_pair(fixes: Fixes, other: Fixes, distance_m: float, settings: ReferenceSettings) -> Fixes:
    """The rows of one antenna by their distance to the other antenna's at the same instant (P2 3.3: 5 cm)."""
    rows = np.flatnonzero(other.rejection & ~np.int64(_OF_THE_PAIR) == 0)
    rejection, spacing = fixes.rejection.copy(), np.full(len(fixes), np.nan)
    paired = np.zeros(len(fixes), dtype=np.bool_)
    if len(rows):
        there = other.time[rows].astype(np.int64)
        here = fixes.time.astype(np.int64)
        after = np.clip(np.searchsorted(there, here), 1, max(len(there) - 1, 1))
        after = np.minimum(after, len(there) - 1)
        before = np.maximum(after - 1, 0)
        nearest = np.where(np.abs(there[before] - here) <= np.abs(there[after] - here), before, after)
        paired = (np.abs(there[nearest] - here) <= SAME_INSTANT_NS) & (rejection == 0)
        # At 30 m/s a millisecond between the two receivers' tags is 3 cm: the other one is moved to the same instant.
        late_s = (here - there[nearest]) / 1e9
        moved = other.ecef_m[rows[nearest]] + late_s[:, None] * _velocity(other.time[rows], other.ecef_m[rows])[nearest]
        apart = np.linalg.norm(fixes.ecef_m - moved, axis=1) - distance_m
        spacing = np.where(paired, apart, np.nan)
    if settings.unpaired == "reject":
        _reject(rejection, ~paired, FixRejection.UNPAIRED)
    with np.errstate(invalid="ignore"):
        _reject(rejection, np.abs(spacing) > settings.spacing_m, FixRejection.SPACING)
    return replace(fixes, rejection=rejection, spacing_m=spacing)


def _velocity(time: Datetimes, ecef_m: Floats) -> Floats:
    """Velocities by differences of neighbours, shape (n, 3) [m/s]; 0 for a single position."""
    if len(time) < 2:
        return np.zeros_like(ecef_m)
    return np.asarray(np.gradient(ecef_m, seconds(time - time[0]), axis=0))


#: The other antenna's row counts in a pair whatever this check gave it.
_OF_THE_PAIR: Final = FixRejection.UNPAIRED | FixRejection.SPACING


def judge_place(fixes: Fixes, trajectory: Trajectory, settings: ReferenceSettings) -> Fixes:
    """The rows by their distance to the trajectory, with their place on it and its standard deviation."""
    rows = fixes.good
    rejection = fixes.rejection.copy()
    arc, lateral, height, sigma = (np.full(len(fixes), np.nan) for _ in range(4))
    if len(rows):
        matched = match(
            fixes.time[rows],
            fixes.ecef_m[rows],
            trajectory,
            lateral_m=settings.lateral_m,
            height_m=settings.height_m,
            max_speed_mps=settings.max_speed_mps,
        )
        arc[rows], lateral[rows], height[rows] = matched.arc_m, matched.lateral_m, matched.height_m
        sigma[rows] = _along_sigma(fixes.sigma_enu_m[rows], fixes.ecef_m[rows], trajectory, matched, settings)
        missed = np.isnan(arc) & (rejection == 0)
        _reject(rejection, missed & ~(np.abs(lateral) <= settings.lateral_m), FixRejection.OFF_TRACK)
        _reject(rejection, missed & ~(np.abs(height) <= settings.height_m), FixRejection.OFF_HEIGHT)
        # What is left is beyond an end of the line.
        _reject(rejection, missed, FixRejection.OFF_TRACK)
    return replace(fixes, rejection=rejection, arc_m=arc, lateral_m=lateral, height_m=height, sigma_m=sigma)


def _along_sigma(
    sigma_enu_m: Floats, ecef_m: Floats, trajectory: Trajectory, matched: MatchedReference, settings: ReferenceSettings
) -> Floats:
    """Standard deviation along the track from those east, north and up."""
    sigma = sigma_along(sigma_enu_m, ecef_m, trajectory.tangent[matched.section])
    return np.where(np.isnan(sigma), settings.fix_sigma_m, np.maximum(sigma, settings.fix_floor_m))


def judge_travel(
    fixes: Fixes,
    travelled: Callable[[Datetimes], tuple[Floats, Floats]],
    settings: ReferenceSettings,
) -> Fixes:
    """The rows by the way between them against the way travelled (P2 3.3).

    Neighbours that agree make a run; a wrong fix, or a stretch of them on wrong ambiguities, is a run of its own, and
    so is what follows an error of the sensor. Kept is the chain of runs that holds most fixes, where each joint that
    does not agree counts against it. So a short stretch that agrees with neither side goes, and where long stretches on
    both sides stay apart, the sensor is held wrong and both stay. `travelled` gives the way up to instants and its
    variance since the start, along rising chainage; NaN where unknown.
    """
    rows = fixes.good
    if len(rows) < 2:
        return fixes
    way, variance = travelled(fixes.time[rows])
    offset = fixes.arc_m[rows] - way

    def agrees(i: Indices, j: Indices) -> Masks:
        spread = np.abs(variance[j] - variance[i]) + fixes.sigma_m[rows[i]] ** 2 + fixes.sigma_m[rows[j]] ** 2
        limit = settings.travel_m + settings.travel_share * np.abs(way[j] - way[i]) + _TRAVEL_SIGMAS * np.sqrt(spread)
        # Where the distance travelled was not measured, nothing is rejected.
        return np.asarray(~(np.abs(offset[j] - offset[i]) > limit))

    keep = _best_chain(agrees, seconds(fixes.time[rows] - fixes.time[rows[0]]), settings.travel_hold_s)
    rejection, travel = fixes.rejection.copy(), np.full(len(fixes), np.nan)
    rejection[rows[~keep]] |= FixRejection.TRAVEL
    kept = np.flatnonzero(keep)
    travel[rows[kept[1:]]] = np.diff(offset[kept])
    return replace(fixes, rejection=rejection, travel_m=travel)


def _best_chain(agrees: Callable[[Indices, Indices], Masks], time_s: Floats, hold_s: float) -> Masks:
    """Which fixes are in the chain of runs of most seconds, less `hold_s` for each joint that does not agree."""
    count = len(time_s)
    worth = np.minimum(np.diff(time_s, append=time_s[-1] + np.median(np.diff(time_s))), 1.0)
    every = np.arange(count)
    cuts = np.flatnonzero(~agrees(every[:-1], every[1:])) + 1
    first, last = np.append(0, cuts), np.append(cuts, count) - 1
    total = np.concatenate([[0.0], np.cumsum(worth)])
    size = total[last + 1] - total[first]
    best, came = size.copy(), np.full(len(first), -1)
    for j in range(1, len(first)):
        before = np.arange(max(0, j - _LOOK_BACK), j)
        joint = np.where(agrees(last[before], np.full(len(before), first[j])), 0.0, hold_s)
        score = best[before] - joint
        k = int(np.argmax(score))
        if score[k] > 0.0:
            best[j], came[j] = size[j] + score[k], before[k]
    keep = np.zeros(count, dtype=np.bool_)
    j = int(np.argmax(best))
    while j >= 0:
        keep[first[j] : last[j] + 1] = True
        j = int(came[j])
    return keep
