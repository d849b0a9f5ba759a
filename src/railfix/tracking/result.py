"""What the filter returns: places, speeds and what measured them, epoch by epoch."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from railfix.core.arrays import Codes, Datetimes, Floats, Integers, Masks
from railfix.tracking.bank import SCALE_BOUND, Branches, compute_level, speed_bound_mps, uncovered
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.robust import mean_weight
from railfix.tracking.rows import Kind, Rows
from railfix.tracking.state import TrackState, Unknown


class TrackStatus(IntEnum):
    """What the filter says of an epoch."""

    #: One place, from measurements of this epoch.
    TRACKING = 0
    #: Several places are possible; the most probable one is given.
    SEVERAL_BRANCHES = 1
    #: No measurement of this epoch, or none that is believed: the predicted place.
    COASTING = 2
    #: Measurements contradict the track: places are sought again.
    LOST = 3
    #: No place: predicted too far.
    EXPIRED = 4
    #: No place yet: no epoch so far had redundant codes.
    NOT_STARTED = 5
    #: No place: the satellites have put the train away from the line for some time.
    OFF_MAP = 6
    #: One place, but 3-D positions of the last minutes lie beside or above the line: the map is wrong here, or it is
    #: another track.
    MAP_OFFSET = 7
    #: One place, but not as far from that of the other antenna as the antennas are apart, or not as fast, within the
    #: last 20 s: one of the two is wrong.
    ANTENNAS_DISAGREE = 8
    #: One place, but measurements contradict it or one of the sub-filters that bound it: nothing bounds its error.
    DOUBTFUL = 9

    @property
    def text(self) -> str:
        """The word written to files: ``several_branches``."""
        return self.name.lower()


#: Statuses whose level bounds the error: beside the map, on one of several branches or on a track in doubt, no
#: sub-filter does.
BOUNDED: Final = (TrackStatus.TRACKING, TrackStatus.COASTING)
_IS_BOUNDED: Final = np.array([status in BOUNDED for status in TrackStatus])


def is_bounded(status: Codes) -> Masks:
    """Return whether a status is one of `BOUNDED`, element by element."""
    return np.asarray(_IS_BOUNDED[status])


@dataclass(frozen=True, kw_only=True)
class Tracked:
    """Places of T epochs; NaN where there is none.

    Attributes
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    status : ndarray of int8, shape (T,)
        `TrackStatus`.
    arc_m, sigma_m : ndarray, shape (T,) [m]
        Of the most probable hypothesis; the standard deviation has the straight distance to the others in it.
    speed_mps, speed_sigma_mps, acceleration_mps2 : ndarray, shape (T,)
    probability : ndarray, shape (T,)
        Of the hypothesis given.
    hypotheses : ndarray of int, shape (T,)
    code_weight, motion_weight : ndarray, shape (T,)
        Mean weights of codes, and of Dopplers and phases.
    wheel_scale, force_offset_mps2, radar_scale : ndarray, shape (T,)
    map_scale : ndarray, shape (T,)
        Factor on the error of the map's lengths, 1 where codes do not contradict them (`misfit`).
    level_m, ground_level_m, level_noise_m, separation_m : ndarray, shape (T,) [m]
        `bank.Level`: of the error along the line, of the straight distance; NaN where levels are off.
    level_speed_mps : ndarray, shape (T,)
        `bank.speed_bound_mps`.
    amount_m : ndarray, shape (T,) [m]
        Over- and under-reading amount: the level, and never less than the bound of the scale times the way since
        codes were used (SUBSET-026 3.6.8).
    used : ndarray of int, shape (T, len(Kind))
        Measurements of each kind with a weight of more than a half.
    innovation : ndarray, shape (T, 3, K)
        Before the update, of codes, phases and Dopplers.
    sensed : ndarray, shape (T, len(Kind) - 3)
        The same of the sensors, in the order of `Kind`; of several ranges the last.
    weight : ndarray, shape (T, 3, K)
        0 for codes that are left out.
    faulty : ndarray of bool, shape (T, K)
        Codes that are left out (`railfix.tracking.faulty`).
    """

    time: Datetimes
    status: Codes
    arc_m: Floats
    sigma_m: Floats
    speed_mps: Floats
    speed_sigma_mps: Floats
    acceleration_mps2: Floats
    probability: Floats
    hypotheses: Integers
    code_weight: Floats
    motion_weight: Floats
    wheel_scale: Floats
    force_offset_mps2: Floats
    radar_scale: Floats
    map_scale: Floats
    level_m: Floats
    ground_level_m: Floats
    level_noise_m: Floats
    level_speed_mps: Floats
    separation_m: Floats
    amount_m: Floats
    used: Integers
    innovation: Floats
    sensed: Floats
    weight: Floats
    faulty: Masks

    def __len__(self) -> int:
        return len(self.time)

    @classmethod
    def empty(cls, time: Datetimes, channels: int) -> Tracked:
        """Nothing known at T epochs, to be filled in."""
        size = len(time)
        names = (
            "arc_m", "sigma_m", "speed_mps", "speed_sigma_mps", "acceleration_mps2", "probability", "code_weight",
            "motion_weight", "wheel_scale", "force_offset_mps2", "radar_scale", "map_scale", "level_m",
            "ground_level_m", "level_noise_m", "level_speed_mps", "separation_m", "amount_m",
        )  # fmt: skip
        return cls(
            time=time,
            status=np.full(size, TrackStatus.NOT_STARTED, dtype=np.int8),
            hypotheses=np.zeros(size, dtype=np.int64),
            used=np.zeros((size, len(Kind)), dtype=np.int64),
            innovation=np.full((size, 3, channels), np.nan),
            sensed=np.full((size, len(Kind) - 3), np.nan),
            weight=np.full((size, 3, channels), np.nan),
            faulty=np.zeros((size, channels), dtype=np.bool_),
            **{name: np.full(size, np.nan) for name in names},
        )


def write_rows(result: Tracked, epoch: int, rows: Rows, innovation: Floats, weight: Floats) -> None:
    """Innovations and weights of the best hypothesis."""
    end = rows.bounds[2]
    weight = weight.copy()
    weight[rows.codes][result.faulty[epoch, rows.column[rows.codes]]] = 0.0
    result.innovation[epoch, rows.kind[:end], rows.column[:end]] = innovation[:end]
    result.weight[epoch, rows.kind[:end], rows.column[:end]] = weight[:end]
    result.sensed[epoch, rows.kind[end:] - 3] = innovation[end:]
    result.used[epoch] = np.bincount(rows.kind[weight > 0.5], minlength=len(Kind))
    result.code_weight[epoch] = mean_weight(weight[None], rows.codes)[0]
    result.motion_weight[epoch] = mean_weight(weight[None], rows.motion)[0]


def write_place(
    result: Tracked,
    epoch: int,
    state: TrackState,
    line: Line,
    dt: float,
    *,
    measured: bool,
    lost: bool,
    limits: TrackingLimits,
) -> None:
    """Write place, speed and status of the most probable hypothesis, and count how long branches have been open."""
    mean, covariance = state.mean[0], state.covariance[0]
    sigma = float(np.sqrt(covariance[Unknown.PLACE, Unknown.PLACE]))
    result.hypotheses[epoch] = state.hypotheses
    result.probability[epoch] = np.exp(state.log_probability[0])
    if sigma > limits.expired_sigma_m:
        result.status[epoch] = TrackStatus.EXPIRED
        return
    branches = _branches(state, line)
    spread = float(branches.probability @ (branches.sigma_m**2 + branches.ground_m**2))
    result.arc_m[epoch] = mean[Unknown.PLACE]
    result.sigma_m[epoch] = np.sqrt((1.0 - branches.probability.sum()) * sigma**2 + spread)
    result.speed_mps[epoch] = mean[Unknown.SPEED]
    result.speed_sigma_mps[epoch] = np.sqrt(covariance[Unknown.SPEED, Unknown.SPEED])
    result.acceleration_mps2[epoch] = mean[Unknown.ACCELERATION]
    result.wheel_scale[epoch] = mean[Unknown.WHEEL]
    result.force_offset_mps2[epoch] = mean[Unknown.FORCE_OFFSET]
    result.radar_scale[epoch] = mean[Unknown.RADAR]
    result.map_scale[epoch] = state.map_scale
    open_s = limits.level_hold_s if uncovered(branches, limits) else state.open_s - dt
    state.open_s = max(open_s, 0.0)
    if state.bank is not None:
        level = compute_level(state.bank, branches, float(mean[Unknown.PLACE]), sigma, limits)
        ground = float("inf") if state.withheld_s > 0.0 else level.ground_m
        along = float("inf") if max(state.withheld_s, state.open_s) > 0.0 else level.along_m
        result.level_m[epoch], result.ground_level_m[epoch] = along, ground
        result.level_noise_m[epoch], result.separation_m[epoch] = level.noise_m, level.separation_m
        result.amount_m[epoch] = max(along, SCALE_BOUND * state.unaided_m)
        result.level_speed_mps[epoch] = speed_bound_mps(
            state.bank, float(mean[Unknown.SPEED]), float(result.speed_sigma_mps[epoch]), limits
        )
    if lost:
        status = TrackStatus.LOST
    elif state.open_s > 0.0:
        status = TrackStatus.SEVERAL_BRANCHES
    elif state.withheld_s > 0.0:
        status = TrackStatus.DOUBTFUL
    else:
        status = TrackStatus.TRACKING if measured else TrackStatus.COASTING
    result.status[epoch] = status


def _branches(state: TrackState, line: Line) -> Branches:
    """Hypotheses beside the most probable one."""
    place = state.mean[:, Unknown.PLACE]
    points, _ = line.at(place)
    return Branches(
        probability=np.exp(state.log_probability[1:]),
        apart_m=np.abs(place[1:] - place[0]),
        ground_m=np.asarray(np.linalg.norm(points[1:] - points[0], axis=1)),
        sigma_m=np.sqrt(state.covariance[1:, Unknown.PLACE, Unknown.PLACE]),
    )
