"""Protection level at every epoch, from a second filter, which has sub-filters and runs at a lower rate.

The sub-filters, at least one per satellite (`railfix.tracking.bank`), require much computing time, and codes of
neighbouring epochs have nearly the same errors. The second filter therefore processes only one epoch per
`level_period_s`, by default 1 s. The equations that propagate the protection level to other epochs are in
docs/filter-equations.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Codes, Floats, Indices, copy_with
from railfix.core.epoch_rows import join_epochs, take_epochs
from railfix.core.timescale import seconds
from railfix.kernels.tracking import constants
from railfix.tracking.epochs import BaliseEpochs, GnssEpochs, SensorEpochs
from railfix.tracking.filter import track
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.result import Tracked, TrackStatus, is_bounded
from railfix.tracking.state import TrackState

#: Sensors whose values between two selected epochs are accumulated.
_SUMMED: Final = (("wheel_m", "wheel_sigma_m"), ("radar_m", "radar_sigma_m"), ("force_mps2", "force_sigma_mps2"))
_MEAN: Final = np.array([False, False, True])  #: True for sensors whose values are averaged, not summed.
#: Largest difference between filter and sub-filter that noise alone explains, in standard deviations of the filtered
#: position: first for positions whose error is not bounded, then for positions with a bounded error.
_EXPLAINED: Final = (3.0, 4.0)
#: Largest finite protection level [m]. Larger levels, from sub-filters without measurements, are set to infinity.
LARGEST_LEVEL_M: Final = 1000.0
_KEPT: Final = (
    "arc_m", "speed_mps", "level_m", "ground_level_m", "level_noise_m", "level_speed_mps", "separation_m",
    "unchecked_prior", "amount_m", "status",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class AccumulatedIncrement:
    """Measurements accumulated since the last selected epoch."""

    #: Time of the first epoch. An epoch is selected where the rounded number of periods since `start` increases.
    start: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    number: int = -1  #: Number of periods from `start` to the last selected epoch; -1 before the first selected epoch.
    epochs: int = 0  #: Number of epochs since the last selected epoch.
    #: Channels whose carrier phase has continued since the last selected epoch; None if the last epoch was selected.
    unbroken: frozenset[str] | None = None
    #: Sums of wheel distances [m], radar distances [m] and forces [m/s2]; sums of their variances; each of shape (3,).
    total: Floats = field(default_factory=lambda: np.zeros(3))
    variance: Floats = field(default_factory=lambda: np.zeros(3))
    balises: BaliseEpochs | None = None  #: Last balises read since the last selected epoch, stored as one epoch.


def decimate_epochs(
    epochs: GnssEpochs, sensors: SensorEpochs, since: AccumulatedIncrement, period_s: float
) -> tuple[Indices, GnssEpochs | None, SensorEpochs, AccumulatedIncrement]:
    """Select one epoch per period.

    Return the indices, the GNSS measurements and the sensor measurements of the selected epochs, and the measurements
    accumulated after the last selected epoch. `since` has the measurements accumulated in the previous chunk.

    A carrier phase is used only if it continued through all epochs since the previous selected epoch. Distances between
    selected epochs are summed, forces are averaged, and balises are assigned to the next selected epoch. Positions from
    features and ranges to ground units are used at selected epochs only.
    """
    if not len(epochs):
        return np.empty(0, dtype=np.intp), None, SensorEpochs(), since
    start = epochs.time[0] if np.isnat(since.start) else since.start
    number = np.floor(seconds(epochs.time - start) / period_s + 0.5).astype(np.int64)
    before = np.maximum.accumulate(np.concatenate([[since.number], number]))
    taken = (before[1:] > before[:-1]).nonzero()[0]
    value, variance = _columns(sensors, len(epochs))
    # Row 0 has the sums from the previous chunk; row t + 1 is epoch t. An interval ends with a selected epoch: if
    # epochs 1 and 3 are selected, the intervals are rows 0 to 2 and rows 3 to 4; rows 5 onwards remain.
    goes_on = np.ones((len(epochs) + 1, len(epochs.channel)), dtype=np.bool_)
    if since.unbroken is not None:
        goes_on[0] = [name in since.unbroken for name in epochs.channel.tolist()]
    goes_on[1:] = epochs.phase_joined & np.isfinite(epochs.phase_m)
    total, square = np.concatenate([since.total[None], value]), np.concatenate([since.variance[None], variance])
    balises, left_balises = _balises(sensors, since, np.searchsorted(taken, np.arange(len(epochs))), len(taken))
    edges = np.concatenate([[0], taken + 2])
    rest, end, first = slice(int(edges[-1]), None), int(edges[-1]), edges[:-1]
    size = edges[1:] - edges[:-1]
    size[:1] += since.epochs - 1
    unbroken = epochs.channel[goes_on[rest].all(axis=0)].tolist()
    left = copy_with(
        since, start=start, number=int(before[-1]),
        epochs=len(total[rest]) if len(taken) else since.epochs + len(epochs),
        unbroken=None if len(taken) and end == len(total) else frozenset(unbroken),
        total=total[rest].sum(axis=0), variance=square[rest].sum(axis=0), balises=left_balises,
    )  # fmt: skip
    if not len(taken):
        return taken, None, SensorEpochs(), left
    some = copy_with(
        epochs if len(taken) == len(epochs) else epochs.take(taken),
        phase_joined=np.logical_and.reduceat(goes_on[:end], first, axis=0) & goes_on[taken + 1],
    )
    share = np.where(_MEAN, 1.0 / np.maximum(size, 1)[:, None], 1.0)
    total, square = (np.add.reduceat(values[:end], first, axis=0) * share for values in (total, square))
    sensed = SensorEpochs(
        wheel_sign=sensors.wheel_sign, balises=balises, place_m=take_epochs(sensors.place_m, taken),
        place_sigma_m=take_epochs(sensors.place_sigma_m, taken), ranges=sensors.ranges and sensors.ranges.take(taken),
    )  # fmt: skip
    for column, names in enumerate(_SUMMED):
        if getattr(sensors, names[0]) is not None:
            sensed = replace(sensed, **{names[0]: total[:, column], names[1]: np.sqrt(square[:, column])})
    return taken, some, sensed, left


def _columns(sensors: SensorEpochs, epochs: int) -> tuple[Floats, Floats]:
    """Return the values and variances of the sensors in `_SUMMED`, shape (T, 3); NaN for a missing sensor."""
    value, variance = np.full((epochs, 3), np.nan), np.full((epochs, 3), np.nan)
    for column, (name, sigma) in enumerate(_SUMMED):
        if getattr(sensors, name) is not None:
            value[:, column], variance[:, column] = getattr(sensors, name), getattr(sensors, sigma) ** 2
    return value, variance


def _balises(
    sensors: SensorEpochs, since: AccumulatedIncrement, interval: Indices, taken: int
) -> tuple[BaliseEpochs | None, BaliseEpochs | None]:
    """Return the balises of the selected epochs, and the balises read after the last selected epoch."""
    if sensors.balises is None and since.balises is None:
        return None, None
    rows = join_epochs([since.balises or BaliseEpochs.none(1), sensors.balises or BaliseEpochs.none(len(interval))])
    parts = rows.find_latest(np.concatenate([[0], interval]), taken + 1)
    return take_epochs(parts, slice(taken)), take_epochs(parts, slice(taken, None))


@dataclass(frozen=True, kw_only=True)
class LevelState:
    """State of the filter with sub-filters after a chunk."""

    track: TrackState | None = None
    every: bool = True  #: True while this filter has used every epoch and therefore equals the main filter.
    since: AccumulatedIncrement = field(default_factory=AccumulatedIncrement)
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: Last epoch of this filter.
    #: Results `_KEPT` of this filter at its last epoch, shape (10,); NaN before the first epoch.
    values: Floats = field(default_factory=lambda: np.full(len(_KEPT), np.nan))


def track_with_levels(
    epochs: GnssEpochs,
    line: Line,
    track_state: TrackState | None,
    state: LevelState,
    limits: TrackingLimits,
    sensors: SensorEpochs,
) -> tuple[Tracked, TrackState, LevelState]:
    """Return positions with protection levels, and the states of the main filter and of the filter with sub-filters.

    If the filter with sub-filters processes every epoch, its positions are returned, and the main filter does not run.
    """
    taken, some, decimated_sensors, since = decimate_epochs(epochs, sensors, state.since, limits.level_period_s)
    with_bank, after = None, state.track
    if some is not None:
        with_bank, after = track(some, line, state.track, limits=limits, sensors=decimated_sensors, levels=True)
    every = state.every and len(taken) == len(epochs)
    if every and with_bank is not None and after is not None:
        tracked, track_state = with_bank, copy_with(after, bank=None)
    else:
        tracked, track_state = track(epochs, line, track_state, limits=limits, sensors=sensors)
    state = copy_with(state, track=after, since=since, every=every)
    tracked, state = carried_levels(tracked, taken, with_bank, line, state, limits)
    return tracked, track_state, state


def carried_levels(
    tracked: Tracked,
    taken: Indices,
    with_bank: Tracked | None,
    line: Line,
    state: LevelState,
    limits: TrackingLimits,
) -> tuple[Tracked, LevelState]:
    """Return the main filter's results, with protection levels propagated from the epochs of the second filter.

    `tracked` are the main filter's results. The second filter, which has sub-filters, ran at the epochs `taken`, with
    the results `with_bank` (None if `taken` is empty). `state` is the second filter's state before the chunk; the
    second filter's state after the chunk is returned, too.
    """
    number = taken.searchsorted(np.arange(len(tracked)), side="right")
    times, values = np.array([state.time]), state.values[None]
    if with_bank is not None:
        columns = np.array([getattr(with_bank, name) for name in _KEPT], dtype=np.float64).T
        columns[:, _KEPT.index("level_m")] = np.where(is_bounded(with_bank.status), with_bank.level_m, np.inf)
        times, values = np.concatenate([times, with_bank.time]), np.concatenate([values, columns])
    arc, speed, level, ground, noise, of_speed, separation, unchecked, amount, status = values[number].T
    tau = seconds(tracked.time - times[number])  # NaN at epochs before the second filter's first epoch
    carried = line.nearest_m(arc, tracked.arc_m) + speed * tau
    # Growth of the position error since the second filter's last epoch: V tau + a tau^2 / 2, with the speed bound V.
    growth_m = of_speed * tau + 0.5 * limits.level_acceleration_mps2 * tau**2
    known = np.isfinite(tracked.arc_m)

    def widened(bound_m: Floats, change_m: Floats) -> Floats:
        total = bound_m + change_m + growth_m
        return np.where(known, np.where(np.isfinite(total), total, np.inf), np.nan)

    both = known & np.isfinite(carried)
    points = [line.at(np.where(both, place_m, 0.0))[0] for place_m in (tracked.arc_m, carried)]
    straight = np.where(both, np.linalg.norm(points[0] - points[1], axis=1), np.nan)
    bounded = is_bounded(tracked.status)
    level = np.where(bounded | ~known, widened(level, np.abs(tracked.arc_m - carried)), np.inf)
    amount = np.fmax(level, amount + constants.SCALE_BOUND * np.abs(speed) * tau)
    reported = _status(tracked.status, status, level)
    # The sigma of a doubtful position includes the whole largest separation. For other positions, it only includes the
    # part of the separation that noise does not explain.
    doubt = (reported == TrackStatus.DOUBTFUL) | ~np.isfinite(ground)
    explained = np.where(is_bounded(reported), _EXPLAINED[1], _EXPLAINED[0]) * tracked.sigma_m
    apart = np.where(np.isnan(separation), 0.0, separation)
    spread = np.where(doubt, apart, np.sqrt(np.maximum(apart**2 - explained**2, 0.0)))
    tracked = copy_with(
        tracked, status=reported, sigma_m=np.hypot(tracked.sigma_m, spread), level_m=_useful(level),
        ground_level_m=_useful(widened(ground, straight)), level_noise_m=np.where(known, noise, np.nan),
        level_speed_mps=np.where(known, of_speed, np.nan), separation_m=np.where(known, separation, np.nan),
        unchecked_prior=np.where(known, unchecked, np.nan),
        amount_m=_useful(np.where(known, amount, np.nan)),
    )  # fmt: skip
    return tracked, copy_with(state, time=times[-1], values=values[-1])


def _useful(level_m: Floats) -> Floats:
    """Return the protection levels, with infinity for values above `LARGEST_LEVEL_M`."""
    return np.where(level_m > LARGEST_LEVEL_M, np.inf, level_m)


def _status(status: Codes, of_level: Floats, level_m: Floats) -> Codes:
    """Replace `TRACKING` and `COASTING` by `of_level` or `DOUBTFUL` where the protection level is not finite."""
    reason = np.where(np.isfinite(of_level), of_level, TrackStatus.DOUBTFUL).astype(np.int8)
    reason = np.where(is_bounded(reason), np.int8(TrackStatus.DOUBTFUL), reason)
    return np.where(is_bounded(status) & ~np.isfinite(level_m), reason, status).astype(np.int8)
