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

from railfix.core.arrays import Datetimes, Floats
from railfix.core.timescale import seconds
from railfix.tracking.bank import SCALE_BOUND
from railfix.tracking.epochs import GnssEpochs, SensorEpochs
from railfix.tracking.filter import track
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.result import Tracked, is_bounded
from railfix.tracking.state import TrackState
from railfix.tracking.thinned import Since, thinned

_KEPT: Final = (
    "arc_m", "speed_mps", "level_m", "level_noise_m", "level_speed_mps", "separation_m", "amount_m",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class LevelState:
    """State of the filter with sub-filters after a chunk.

    Attributes
    ----------
    track : TrackState or None
    since : Since
    time : datetime64[ns]
        Of its last epoch.
    values : ndarray, shape (7,)
        Its place, speed, level with parts and amount there.
    """

    track: TrackState | None = None
    since: Since = field(default_factory=Since)
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    values: Floats = field(default_factory=lambda: np.full(len(_KEPT), np.nan))


def with_levels(
    tracked: Tracked,
    epochs: GnssEpochs,
    line: Line,
    state: LevelState,
    limits: TrackingLimits,
    sensors: SensorEpochs,
) -> tuple[Tracked, LevelState]:
    """Return the places with their levels, and the state for the next epochs.

    Parameters
    ----------
    tracked : Tracked
        By the filter without sub-filters, T epochs.
    epochs : GnssEpochs
    line : Line
    state : LevelState
        Left by the epochs before.
    limits : TrackingLimits
    sensors : SensorEpochs
    """
    taken, some, sensed, since = thinned(epochs, sensors, state.since, limits.level_period_s)
    place, after = track(some, line, state.track, limits=limits, sensors=sensed, levels=True)
    bounded = is_bounded(place.status)
    columns = np.stack([getattr(place, name) for name in _KEPT], axis=1)
    columns[:, _KEPT.index("level_m")] = np.where(bounded, place.level_m, np.inf)
    number = np.searchsorted(taken, np.arange(len(epochs)), side="right")
    times = np.concatenate([[state.time], place.time])
    values = np.concatenate([state.values[None], columns])
    arc, speed, level, noise, of_speed, separation, amount = values[number].T
    tau = _since(times[number], tracked.time)
    change = tracked.arc_m - line.nearest_m(arc, tracked.arc_m) - speed * tau
    widened = np.abs(change) + of_speed * tau + 0.5 * limits.level_acceleration_mps2 * tau**2
    known = np.isfinite(tracked.arc_m)
    level = np.where(known, np.where(np.isfinite(level + widened), level + widened, np.inf), np.nan)
    amount = np.fmax(level, amount + SCALE_BOUND * np.abs(speed) * tau)
    tracked = replace(
        tracked,
        level_m=level,
        level_noise_m=np.where(known, noise, np.nan),
        level_speed_mps=np.where(known, of_speed, np.nan),
        separation_m=np.where(known, separation, np.nan),
        amount_m=np.where(known, amount, np.nan),
    )
    return tracked, LevelState(track=after, since=since, time=times[-1], values=values[-1])


def _since(last: Datetimes, time: Datetimes) -> Floats:
    """Seconds since the last epoch with sub-filters; NaN before the first."""
    return np.where(np.isnat(last), np.nan, seconds(time - last))
