"""Epochs taken out of a log at a lower rate, with what was measured between them."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.timescale import seconds
from railfix.tracking.epochs import BaliseEpochs, GnssEpochs, SensorEpochs

#: Sensors whose values between two epochs are added, and the one of which the mean is taken.
_SUMMED: Final = (("wheel_m", "wheel_sigma_m"), ("radar_m", "radar_sigma_m"), ("force_mps2", "force_sigma_mps2"))
_MEAN: Final = np.array([False, False, True])


@dataclass(frozen=True, kw_only=True)
class AccumulatedIncrement:
    """What was measured after the last epoch that was taken.

    Attributes
    ----------
    start : datetime64[ns]
        First epoch of the log: epochs are taken where a period from there is rounded to another number.
    number : int
        Of periods from `start` to the last epoch taken; -1 before the first.
    epochs : int
        AccumulatedIncrement then.
    unbroken : frozenset of str or None
        Satellites whose carrier phase went on at all of them; None where there was no epoch.
    total, variance : ndarray, shape (3,)
        Sums over them of the ways by wheel and radar [m] and of the force [m/s2], and of the variances.
    balises : BaliseEpochs or None
        Read since then, as one epoch.
    """

    start: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    number: int = -1
    epochs: int = 0
    unbroken: frozenset[str] | None = None
    total: Floats = field(default_factory=lambda: np.zeros(3))
    variance: Floats = field(default_factory=lambda: np.zeros(3))
    balises: BaliseEpochs | None = None


def thinned(
    epochs: GnssEpochs, sensors: SensorEpochs, since: AccumulatedIncrement, period_s: float
) -> tuple[Indices, GnssEpochs, SensorEpochs, AccumulatedIncrement]:
    """Return which epochs are taken, these with what was measured since the one before, and what to go on with.

    A carrier phase goes on where it did so at all epochs between. Ways between epochs are added, the force is their
    mean; balises at the next epoch taken; places by features and ranges to ground units at the epochs that are taken.

    Parameters
    ----------
    epochs : GnssEpochs
        T epochs.
    sensors : SensorEpochs
    since : AccumulatedIncrement
        Left by the epochs before.
    period_s : float [s]
    """
    if not len(epochs):
        return np.empty(0, dtype=np.intp), epochs, SensorEpochs(), since
    start = epochs.time[0] if np.isnat(since.start) else since.start
    number = np.floor(seconds(epochs.time - start) / period_s + 0.5).astype(np.int64)
    before = np.maximum.accumulate(np.concatenate([[since.number], number]))
    taken = np.flatnonzero(before[1:] > before[:-1])
    joined = epochs.phase_joined & np.isfinite(epochs.phase_m)
    value, variance = _columns(sensors, len(epochs))
    goes_on = np.concatenate([_unbroken(epochs, since)[None], joined])
    total = np.concatenate([since.total[None], value])
    square = np.concatenate([since.variance[None], variance])
    balises, left_balises = _balises(sensors, since, np.searchsorted(taken, np.arange(len(epochs))), len(taken))
    # Rows of the intervals: that left by the epochs before is the first; those after the last epoch taken are left.
    edges = np.concatenate([[0], taken + 2])
    size = np.diff(edges)
    size[:1] += since.epochs - 1
    rest = slice(int(edges[-1]), None)
    left = replace(
        since,
        start=start,
        number=int(before[-1]),
        epochs=len(total[rest]) if len(taken) else since.epochs + len(epochs),
        unbroken=_names(epochs, np.asarray(goes_on[rest].all(axis=0)), anew=len(taken) > 0 and not len(total[rest])),
        total=total[rest].sum(axis=0),
        variance=square[rest].sum(axis=0),
        balises=left_balises,
    )
    if not len(taken):
        return taken, epochs.take(taken), SensorEpochs(), left
    end, first = int(edges[-1]), edges[:-1]
    some = replace(
        epochs.take(taken), phase_joined=np.logical_and.reduceat(goes_on[:end], first, axis=0) & joined[taken]
    )
    share = np.where(_MEAN, 1.0 / np.maximum(size, 1)[:, None], 1.0)
    total, square = (np.add.reduceat(values[:end], first, axis=0) * share for values in (total, square))
    sensed = _sensors(sensors, taken, total, np.sqrt(square))
    return taken, some, replace(sensed, balises=balises), left


def _columns(sensors: SensorEpochs, epochs: int) -> tuple[Floats, Floats]:
    """Values and variances of the sensors that are summed, shape (T, 3); NaN without one."""
    value, variance = np.full((epochs, 3), np.nan), np.full((epochs, 3), np.nan)
    for column, (name, sigma) in enumerate(_SUMMED):
        if getattr(sensors, name) is not None:
            value[:, column], variance[:, column] = getattr(sensors, name), getattr(sensors, sigma) ** 2
    return value, variance


def _balises(
    sensors: SensorEpochs, since: AccumulatedIncrement, interval: Indices, taken: int
) -> tuple[BaliseEpochs | None, BaliseEpochs | None]:
    """Balises at the epochs that are taken, and those read after them, with what was left before."""
    if sensors.balises is None and since.balises is None:
        return None, None
    before = since.balises or BaliseEpochs.none(1)
    own = sensors.balises or BaliseEpochs.none(len(interval))
    rows = BaliseEpochs(**{
        f.name: np.concatenate([getattr(before, f.name), getattr(own, f.name)]) for f in fields(BaliseEpochs)
    })  # fmt: skip
    parts = rows.latest_of(np.concatenate([[0], interval]), taken + 1)
    found, left = (
        BaliseEpochs(**{f.name: getattr(parts, f.name)[part] for f in fields(BaliseEpochs)})
        for part in (slice(taken), slice(taken, None))
    )
    return found, left


def _unbroken(epochs: GnssEpochs, since: AccumulatedIncrement) -> Masks:
    """Which satellites' phases went on at all epochs since the last one that was taken, shape (K,)."""
    if since.unbroken is None:
        return np.ones(len(epochs.satellite), dtype=np.bool_)
    return np.isin(epochs.satellite, list(since.unbroken))


def _names(epochs: GnssEpochs, unbroken: Masks, *, anew: bool) -> frozenset[str] | None:
    return None if anew else frozenset(epochs.satellite[unbroken].tolist())


def _sensors(sensors: SensorEpochs, taken: Indices, total: Floats, sigma: Floats) -> SensorEpochs:
    """Sensors at the epochs that are taken."""
    values: dict[str, Any] = {}
    for column, names in enumerate(_SUMMED):
        if getattr(sensors, names[0]) is not None:
            values |= {names[0]: total[:, column], names[1]: sigma[:, column]}
    for name in ("place_m", "place_sigma_m"):
        if (given := getattr(sensors, name)) is not None:
            values[name] = given[taken]
    ranges = sensors.ranges if sensors.ranges is None else sensors.ranges.take(taken)
    return SensorEpochs(**values, wheel_sign=sensors.wheel_sign, ranges=ranges)
