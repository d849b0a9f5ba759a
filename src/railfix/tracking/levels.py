"""Level of the filtered position at every epoch, from a filter with sub-filters over epochs a second apart.

The bank of `railfix.tracking.bank` costs as many filters as there are satellites, and codes of neighbouring epochs tell
the same. So a second filter with its bank takes one epoch a second. With its place s, its speed v, their levels L and
V, tau after its last epoch, and the acceleration below a, an error of the place p of the filter itself is at most::

    |p - s - v tau| + L + V tau + a tau^2 / 2

with the risk of L and that of V, which is a hundredth of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Codes, Datetimes, Floats, Indices
from railfix.core.timescale import seconds
from railfix.kernels.tracking.constants import SCALE_BOUND
from railfix.tracking.epochs import GnssEpochs, SensorEpochs
from railfix.tracking.filter import track
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.result import Tracked, TrackStatus, is_bounded
from railfix.tracking.state import TrackState
from railfix.tracking.thinned import AccumulatedIncrement, thinned

#: A sub-filter this many standard deviations off is explained by them where a place has no level.
_EXPLAINED: Final = 3.0
_KEPT: Final = (
    "arc_m", "speed_mps", "level_m", "ground_level_m", "level_noise_m", "level_speed_mps", "separation_m", "amount_m",
    "status",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class LevelState:
    """State of the filter with sub-filters after a chunk.

    Attributes
    ----------
    track : TrackState or None
    since : AccumulatedIncrement
    time : datetime64[ns]
        Of its last epoch.
    values : ndarray, shape (9,)
        Its place, speed, levels with parts, amount and status there.
    every : bool
        It has taken every epoch so far: it is the filter itself.
    """

    track: TrackState | None = None
    every: bool = True
    since: AccumulatedIncrement = field(default_factory=AccumulatedIncrement)
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    values: Floats = field(default_factory=lambda: np.full(len(_KEPT), np.nan))


def track_with_levels(
    epochs: GnssEpochs,
    line: Line,
    track_state: TrackState | None,
    state: LevelState,
    limits: TrackingLimits,
    sensors: SensorEpochs,
) -> tuple[Tracked, TrackState, LevelState]:
    """Return the places of the filter with their levels, its state, and that of the filter with sub-filters.

    Where the filter with sub-filters takes every epoch its places are those of the filter, which then does not run.
    """
    taken, some, sensed, since = thinned(epochs, sensors, state.since, limits.level_period_s)
    place, after = track(some, line, state.track, limits=limits, sensors=sensed, levels=True)
    every = state.every and len(taken) == len(epochs)
    if every:
        tracked, track_state = place, replace(after, bank=None)
    else:
        tracked, track_state = track(epochs, line, track_state, limits=limits, sensors=sensors)
    state = replace(state, track=after, since=since, every=every)
    tracked, state = carried_levels(tracked, epochs, taken, place, line, state, limits)
    return tracked, track_state, state


def carried_levels(
    tracked: Tracked,
    epochs: GnssEpochs,
    taken: Indices,
    place: Tracked,
    line: Line,
    state: LevelState,
    limits: TrackingLimits,
) -> tuple[Tracked, LevelState]:
    """Return places with the levels of the epochs that the filter with sub-filters took, carried to all epochs.

    Parameters
    ----------
    tracked : Tracked
        By the filter, T epochs.
    epochs : GnssEpochs
    taken : ndarray of int
        Epochs that the filter with sub-filters took.
    place : Tracked
        Its places there.
    line : Line
    state : LevelState
        Its last epoch before these.
    limits : TrackingLimits
    """
    columns = np.stack([getattr(place, name) for name in _KEPT], axis=1).astype(np.float64)
    columns[:, _KEPT.index("level_m")] = np.where(is_bounded(place.status), place.level_m, np.inf)
    number = np.searchsorted(taken, np.arange(len(epochs)), side="right")
    times = np.concatenate([[state.time], place.time])
    values = np.concatenate([state.values[None], columns])
    arc, speed, level, ground, noise, of_speed, separation, amount, status = values[number].T
    tau = _since(times[number], tracked.time)
    carried = line.nearest_m(arc, tracked.arc_m) + speed * tau
    since_m = of_speed * tau + 0.5 * limits.level_acceleration_mps2 * tau**2
    known = np.isfinite(tracked.arc_m)

    def widened(bound_m: Floats, change_m: Floats) -> Floats:
        total = bound_m + change_m + since_m
        return np.where(known, np.where(np.isfinite(total), total, np.inf), np.nan)

    both = known & np.isfinite(carried)
    points = [line.at(np.where(both, place_m, 0.0))[0] for place_m in (tracked.arc_m, carried)]
    straight = np.where(both, np.linalg.norm(points[0] - points[1], axis=1), np.nan)
    bounded = is_bounded(tracked.status)
    level = np.where(bounded | ~known, widened(level, np.abs(tracked.arc_m - carried)), np.inf)
    amount = np.fmax(level, amount + SCALE_BOUND * np.abs(speed) * tau)
    told = _status(tracked.status, status, level)
    # In doubt the sub-filter furthest off may be the one that is right; without a level one that the standard deviation
    # does not explain.
    doubt = (told == TrackStatus.DOUBTFUL) | ~np.isfinite(ground)
    explained = np.where(is_bounded(told), np.inf, _EXPLAINED * tracked.sigma_m)
    apart = np.nan_to_num(separation)
    spread = np.where(doubt, apart, np.sqrt(np.maximum(apart**2 - explained**2, 0.0)))
    tracked = replace(
        tracked,
        status=told,
        sigma_m=np.hypot(tracked.sigma_m, spread),
        level_m=level,
        ground_level_m=widened(ground, straight),
        level_noise_m=np.where(known, noise, np.nan),
        level_speed_mps=np.where(known, of_speed, np.nan),
        separation_m=np.where(known, separation, np.nan),
        amount_m=np.where(known, amount, np.nan),
    )
    return tracked, replace(state, time=times[-1], values=values[-1])


def _status(status: Codes, of_level: Floats, level_m: Floats) -> Codes:
    """Statuses of places: one without a level is neither tracking nor coasting."""
    reason = np.where(np.isfinite(of_level), of_level, TrackStatus.DOUBTFUL).astype(np.int8)
    reason = np.where(is_bounded(reason), np.int8(TrackStatus.DOUBTFUL), reason)
    return np.where(is_bounded(status) & ~np.isfinite(level_m), reason, status).astype(np.int8)


def _since(last: Datetimes, time: Datetimes) -> Floats:
    """Seconds since the last epoch with sub-filters; NaN before the first."""
    return np.where(np.isnat(last), np.nan, seconds(time - last))
