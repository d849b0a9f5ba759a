"""Settings of a reference, and checks that accept or reject RTK fixes (P1 3.1(2), 4.2(2), P2 3.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntFlag
from itertools import pairwise
from typing import Any, Final, Literal

import numpy as np
from pydantic import Field

from railfix.core.array_functions import cheapest_path
from railfix.core.arrays import Bits, Datetimes, Floats, Indices, Integers, Masks
from railfix.core.geodesy import sigma_along
from railfix.core.nearest_times import nearest_rows
from railfix.core.options import option
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.io.position_log import PositionLog
from railfix.positioning.doppler_speed import DopplerSpeedLimits
from railfix.track.passes import find_segments_near
from railfix.track.trajectory import Trajectory


def _positive(default: float) -> Any:
    return Field(default, gt=0.0, allow_inf_nan=False)


def _limit(text: str, default: float | None, metavar: str, name: str) -> Any:
    return option(text, default, name=name, metavar=metavar, panel="Limits", gt=0.0, allow_inf_nan=False)


_TRAVEL_SHARE: Final = 0.005  #: Fraction of the distance travelled that is added to the limit `travel_m`.
#: Fixes that disagree with their neighbours are rejected for at most twice this time [s]. If the disagreement lasts
#: longer, the measured distance travelled is assumed to be wrong.
_TRAVEL_HOLD_S: Final = 10.0
_FIX_FLOOR_M: Final = 0.01  #: Smaller standard deviations of a fix along the track are raised to this value [m].
#: Standard deviation of the train's acceleration [m/s2] in the model of R. A. Singer (1970). Trains accelerate and
#: brake by 0.5 to 1 m/s2 for some seconds.
MOTION_MPS2: Final = 0.5
MOTION_S: Final = 5.0  #: Correlation time of the train's acceleration [s].
ACCELERATION_BIAS_MPS2: Final = 0.05  #: Standard deviation of the accelerometer's initial offset [m/s2].


class ReferenceSettings(Settings):
    """Limits and noise parameters for building a reference; they are recorded in ``reference.json``."""

    #: Fixes with a smaller ratio of the ambiguity test are rejected, if the log has ratios (RTKLIB's default is 3).
    ratio: float = _limit("Fixes with a smaller ambiguity ratio (if logged) are rejected.", 3.0, "RATIO", "--ratio")
    #: Pairs of fixes are rejected if their distance differs from the antenna spacing by more than this (P2 3.3: 5 cm).
    spacing_m: float = _limit(
        "Tolerance of the measured distance between the antennas; other fixes are rejected.", 0.05, "M", "--spacing"
    )
    #: Whether a fix of one antenna is rejected if the other antenna's log has no fix at that time.
    unpaired: Literal["reject", "keep"] = "reject"
    #: Fixes at a larger lateral distance from the antenna's trajectory are rejected. The value is about three standard
    #: deviations of the map error (P1 4.1(3)).
    lateral_m: float = _limit("Fixes at a larger lateral distance from the path are rejected.", 1.0, "M", "--lateral")
    #: Fixes at a larger distance above or below the antenna's trajectory are rejected.
    height_m: float = _limit("Fixes farther above or below the antenna's path are rejected.", 2.0, "M", "--height")
    #: Two fixes disagree if their distance along the track differs from the measured distance travelled by more than
    #: this value plus terms for distance and noise (P2 3.3).
    travel_m: float = _positive(0.10)
    #: Where the line passes a point several times, only those passes are considered that the train can reach without
    #: exceeding this speed.
    max_speed_mps: float = _positive(100.0)
    #: Gaps between good fixes are bridged up to this duration.
    max_gap_s: float = _limit("Gaps between good fixes are bridged up to this duration.", 60.0, "S", "--max-gap")
    #: Positions at bridged instants are omitted if their standard deviation exceeds this value.
    max_sigma_m: float = _limit("Bridged positions with a larger sigma are omitted.", 1.0, "M", "--max-sigma")
    #: Assumed standard deviation of a fix along the track, if the log states none.
    fix_sigma_m: float = _positive(0.03)

    doppler: DopplerSpeedLimits = Field(default_factory=DopplerSpeedLimits)
    #: Standard deviation of the time-correlated error of the Doppler speed. The setting is only used if there are too
    #: few fixes to estimate the standard deviation.
    doppler_bias_mps: float = _positive(0.02)
    #: Correlation time of the error of the Doppler speed.
    doppler_bias_s: float = _positive(10.0)
    #: Distance per tachometer pulse: wheel circumference over pulses per turn; None to estimate it from the fixes.
    pulse_m: float | None = _limit(
        "Distance per tachometer pulse (circumference over pulses per turn); by default estimated from the fixes.",
        None,
        "M",
        "--pulse",
    )
    wheel_scale: float = _positive(0.01)  #: Relative standard deviation of the distance per pulse.
    slip_m: float = _positive(0.005)  #: Random error of the wheel's distance [m per square root of m].
    #: Noise density of the accelerometer [m/s2 per square root of Hz].
    acceleration_mps2: float = _positive(0.02)


#: Positions of two antennas belong to one instant if their time tags differ by at most this value [ns].
_PAIR_NS: Final = 5_000_000
#: Number of earlier sequences of agreeing fixes that `_best_chain` considers as predecessors of a sequence.
_LOOK_BACK: Final = 60
#: Noise term of the limit `ReferenceSettings.travel_m`: this number of standard deviations of the compared difference.
_TRAVEL_SIGMAS: Final = 3.0
_FIX: Final = 1


class FixRejection(IntFlag):
    """Reasons to reject a position as a reference; 0 if it is accepted."""

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
        """Names of the bits that are set, as in ``fixes.csv``."""
        return " ".join(flag.name.lower() for flag in FixRejection if flag and flag in self and flag.name)


@dataclass(frozen=True, kw_only=True)
class Fixes:
    """Positions of one antenna with reasons for rejection, n rows in order of time."""

    time: Datetimes  #: GPS time, shape (n,).
    ecef_m: Floats  #: Position in ECEF, shape (n, 3).
    quality: Integers  #: Solution quality as in `PositionLog`, shape (n,).
    ratio: Floats  #: Ratio of the ambiguity test, shape (n,); NaN where the log states none.
    sigma_enu_m: Floats  #: Standard deviations east, north, up; NaN where the log has none; shape (n, 3).
    rejection: Bits  #: `FixRejection` bits; a row that fails a check is not checked further; shape (n,).
    #: Distance between the antennas minus their distance on the vehicle; NaN where not checked; shape (n,).
    spacing_m: Floats
    arc_m: Floats  #: Arc length of the nearest point of the trajectory, shape (n,); NaN where not checked.
    lateral_m: Floats  #: Offset of the position to the right of the trajectory, shape (n,); NaN where not checked.
    height_m: Floats  #: Height of the position above the trajectory, shape (n,); NaN where not checked.
    sigma_m: Floats  #: Standard deviation of the position along the track, shape (n,).
    #: Distance from the previous good fix minus the measured distance travelled, shape (n,); NaN without a measurement.
    travel_m: Floats

    def __len__(self) -> int:
        return len(self.time)

    @property
    def good(self) -> Indices:
        """Indices of the accepted rows."""
        return np.flatnonzero(self.rejection == 0)

    def counts(self) -> dict[str, int]:
        """Return the number of rows by reason for rejection, beginning with the accepted rows ("good")."""
        counted = {"good": int((self.rejection == 0).sum())}
        for flag in FixRejection:
            if flag:
                counted[flag.text] = int((self.rejection & flag != 0).sum())
        return counted


def judge_alone(log: PositionLog, settings: ReferenceSettings) -> Fixes:
    """Check each row of a log separately. In a log without quality flags, every row counts as an RTK fixed solution."""
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
        **dict.fromkeys(("spacing_m", "arc_m", "lateral_m", "height_m", "sigma_m", "travel_m"), blank),
    )


def _reject(rejection: Bits, mask: Masks, reason: FixRejection) -> None:
    """Set a reason, in place, for the rows in a mask that have no reason yet."""
    rejection[mask & (rejection == 0)] |= reason


def judge_pair(fixes: Fixes, other: Fixes, distance_m: float, settings: ReferenceSettings) -> Fixes:
    """Check the distances between simultaneous positions of the two antennas (limit in P2 3.3: 5 cm)."""
    rows = np.flatnonzero(other.rejection & ~np.int64(_OF_THE_PAIR) == 0)
    rejection, spacing = fixes.rejection.copy(), np.full(len(fixes), np.nan)
    there, place = other.time[rows], other.ecef_m[rows]
    nearest = nearest_rows(there, fixes.time, within_ns=_PAIR_NS)
    paired = (nearest >= 0) & (rejection == 0)
    if len(rows):
        # At 30 m/s, a difference of 1 ms between time tags causes an error of 3 cm. The other antenna's position is
        # therefore moved to the time of this row.
        velocity = np.gradient(place, seconds(there - there[0]), axis=0) if len(rows) > 1 else np.zeros_like(place)
        late_s = (fixes.time - there[nearest]).astype(np.int64) / 1e9
        moved = place[nearest] + late_s[:, None] * velocity[nearest]
        apart = np.linalg.norm(fixes.ecef_m - moved, axis=1) - distance_m
        spacing = np.where(paired, apart, np.nan)
    if settings.unpaired == "reject":
        _reject(rejection, ~paired, FixRejection.UNPAIRED)
    with np.errstate(invalid="ignore"):
        _reject(rejection, np.abs(spacing) > settings.spacing_m, FixRejection.SPACING)
    return replace(fixes, rejection=rejection, spacing_m=spacing)


#: Rejection reasons of rows that are still used to check positions of the other antenna.
_OF_THE_PAIR: Final = FixRejection.UNPAIRED | FixRejection.SPACING


_OUT_OF_REACH_M = 1e6  #: Cost of a step to a pass that the train cannot reach in time [m]; it exceeds all other costs.
_JITTER_M = 2.0  #: Tolerance for the jitter of positions, added to the distance that the train can travel [m].


def match(
    time: Datetimes, ecef_m: Floats, trajectory: Trajectory, *, lateral_m: float, height_m: float, max_speed_mps: float
) -> tuple[Floats, Floats, Floats, Indices]:
    """Match F positions in order of time to a trajectory, by the shortest chain of passes that a train can travel.

    A pass is a stretch of the line near a position; a position at a crossing has several passes.

    Return arc lengths, offsets to the right, offsets upward, and segments, shapes (F,). The arc length is NaN where no
    pass is within the limits; the other values then refer to the nearest point of the trajectory.
    """
    count = len(ecef_m)
    nearest, _ = trajectory.nearest(ecef_m)
    section, _ = trajectory.segment_at(nearest)
    offset = ecef_m - trajectory.at_arc(nearest)
    arc = np.full(count, np.nan)
    lateral, height = _beside(offset, trajectory, section)
    passes = find_segments_near(ecef_m, trajectory, float(np.hypot(lateral_m, height_m)))
    beside, above = _beside(passes.offset_m, trajectory, passes.segment)
    # a position beyond an end of the line has no perpendicular foot on the line
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
    """Return the components of offsets to the right and upward, both perpendicular to the path."""
    right, along = trajectory.across[section], trajectory.tangent[section]
    return np.einsum("fi,fi->f", offset, right), np.einsum("fi,fi->f", offset, np.cross(right, along))


def _chain(position: Indices, arc_m: Floats, lateral_m: Floats, time_s: Floats, max_speed_mps: float) -> Indices:
    """Return the indices of passes, one for each position, that form the chain of lowest cost."""
    found, first = np.unique(position, return_index=True)
    if len(found) == len(position):
        return np.arange(len(found))
    reach = max_speed_mps * np.diff(time_s[found]) + _JITTER_M
    # The cost of a step is its distance, so that a detour by another pass of a crossing adds its length to the cost.
    ways = (np.abs(after[:, None] - before) for before, after in pairwise(np.split(arc_m, first[1:])))
    steps = (way + np.where(way > limit, _OUT_OF_REACH_M, 0.0) for way, limit in zip(ways, reach, strict=True))
    return np.asarray(first + cheapest_path(np.split(np.abs(lateral_m), first[1:]), steps))


def judge_place(fixes: Fixes, trajectory: Trajectory, settings: ReferenceSettings) -> Fixes:
    """Check the offsets of rows from the trajectory; return the fixes with arc lengths and sigmas along the track."""
    rows = fixes.good
    rejection = fixes.rejection.copy()
    arc, lateral, height, sigma = (np.full(len(fixes), np.nan) for _ in range(4))
    if len(rows):
        arc[rows], lateral[rows], height[rows], section = match(
            fixes.time[rows],
            fixes.ecef_m[rows],
            trajectory,
            lateral_m=settings.lateral_m,
            height_m=settings.height_m,
            max_speed_mps=settings.max_speed_mps,
        )
        along = sigma_along(fixes.sigma_enu_m[rows], fixes.ecef_m[rows], trajectory.tangent[section])
        sigma[rows] = np.where(np.isnan(along), settings.fix_sigma_m, np.maximum(along, _FIX_FLOOR_M))
        missed = np.isnan(arc) & (rejection == 0)
        _reject(rejection, missed & ~(np.abs(lateral) <= settings.lateral_m), FixRejection.OFF_TRACK)
        _reject(rejection, missed & ~(np.abs(height) <= settings.height_m), FixRejection.OFF_HEIGHT)
        # The remaining rows are beyond an end of the line.
        _reject(rejection, missed, FixRejection.OFF_TRACK)
    return replace(fixes, rejection=rejection, arc_m=arc, lateral_m=lateral, height_m=height, sigma_m=sigma)


def judge_travel(
    fixes: Fixes, travelled: Callable[[Datetimes], tuple[Floats, Floats]], settings: ReferenceSettings
) -> Fixes:
    """Reject rows whose distances from other rows disagree with the distance travelled (P2 3.3).

    Successive rows that agree form a run, and the best chain of runs is kept (`_best_chain`). `travelled` returns the
    cumulative distance along rising chainage [m] and its variance [m2] at given times.
    """
    rows = fixes.good
    if len(rows) < 2:
        return fixes
    way, variance = travelled(fixes.time[rows])
    offset = fixes.arc_m[rows] - way

    def agrees(i: Indices, j: Indices) -> Masks:
        spread = np.abs(variance[j] - variance[i]) + fixes.sigma_m[rows[i]] ** 2 + fixes.sigma_m[rows[j]] ** 2
        limit = settings.travel_m + _TRAVEL_SHARE * np.abs(way[j] - way[i]) + _TRAVEL_SIGMAS * np.sqrt(spread)
        # Where the distance travelled was not measured, the fixes count as agreeing.
        return np.asarray(~(np.abs(offset[j] - offset[i]) > limit))

    keep = _best_chain(agrees, seconds(fixes.time[rows] - fixes.time[rows[0]]), _TRAVEL_HOLD_S)
    rejection, travel = fixes.rejection.copy(), np.full(len(fixes), np.nan)
    rejection[rows[~keep]] |= FixRejection.TRAVEL
    kept = np.flatnonzero(keep)
    travel[rows[kept[1:]]] = np.diff(offset[kept])
    return replace(fixes, rejection=rejection, travel_m=travel)


def _best_chain(agrees: Callable[[Indices, Indices], Masks], time_s: Floats, hold_s: float) -> Masks:
    """Return the mask of the fixes in the best chain of runs.

    A run is a sequence of successive fixes that agree with each other. The best chain maximises the total duration of
    its runs, minus `hold_s` for each pair of successive runs that disagree.
    """
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
