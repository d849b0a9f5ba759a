"""Filter results per epoch: positions, speeds, protection levels, innovations and weights."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from railfix.core.arrays import Codes, Datetimes, Floats, Integers, Masks
from railfix.core.notebook import NotebookTable
from railfix.kernels.tracking.index import TrackStatus as TrackStatus
from railfix.kernels.tracking.layout import Results, record_of
from railfix.tracking.epochs import Kind

#: Statuses in which the protection level bounds the error. The error is not bounded if the train is off the map, if
#: several branches are possible, or if the position is doubtful.
BOUNDED: Final = (TrackStatus.TRACKING, TrackStatus.COASTING)
_IS_BOUNDED: Final = np.array([status in BOUNDED for status in TrackStatus])


def is_bounded(status: Codes) -> Masks:
    """Return a mask of statuses that are in `BOUNDED`."""
    return np.asarray(_IS_BOUNDED[status])


@dataclass(frozen=True, kw_only=True, repr=False)
class Tracked(NotebookTable):
    """Filter results of T epochs with K channels; NaN where unknown."""

    time: Datetimes  #: Time of each epoch, shape (T,).
    status: Codes  #: Values of `TrackStatus`, shape (T,).
    #: Arc length and standard deviation of the most probable hypothesis, shape (T,). The standard deviation covers the
    #: straight distance to other hypotheses, and differences from sub-filters beyond those due to noise.
    arc_m: Floats
    sigma_m: Floats
    speed_mps: Floats  #: Speed along the line, shape (T,).
    speed_sigma_mps: Floats  #: Standard deviation of the speed, shape (T,).
    acceleration_mps2: Floats  #: Acceleration along the line, shape (T,).
    probability: Floats  #: Probability of the reported hypothesis, shape (T,).
    hypotheses: Integers  #: Number of hypotheses, shape (T,).
    code_weight: Floats  #: Mean weight of the codes that are not excluded, shape (T,).
    motion_weight: Floats  #: Mean weight of Dopplers and phases, shape (T,).
    wheel_scale: Floats  #: Estimated scale-factor error of the wheel, shape (T,).
    force_offset_mps2: Floats  #: Estimated accelerometer offset, shape (T,).
    radar_scale: Floats  #: Estimated scale-factor error of the radar, shape (T,).
    #: Factor of the assumed error of map lengths, shape (T,); 1 if codes do not contradict the map lengths.
    map_scale: Floats
    level_m: Floats  #: Protection level of the error along the line, shape (T,); NaN where levels are off.
    #: Protection level of the straight distance to the train, shape (T,); covers other branches and lateral map errors.
    ground_level_m: Floats
    level_noise_m: Floats  #: Protection level for noise alone, without faults or other branches, shape (T,).
    #: Bound of the speed error, used to propagate protection levels to later epochs, shape (T,).
    level_speed_mps: Floats
    #: Largest difference between the positions of the filter and a sub-filter, shape (T,); NaN where levels are off.
    separation_m: Floats
    #: Probability of faults that the level does not cover, such as a fault of the only constellation, shape (T,).
    unchecked_prior: Floats
    #: Over- and under-reading amount (SUBSET-026 3.6.8), shape (T,): the protection level, but at least the largest
    #: scale error (`SCALE_BOUND`) times the distance since codes were used.
    amount_m: Floats
    used: Integers  #: Number of measurements of each kind with a weight above a half, shape (T, len(Kind)).
    innovation: Floats  #: Innovations of codes, phase changes and Dopplers, shape (T, 3, K).
    #: Innovations of the sensors in the order of `Kind`, shape (T, len(Kind) - 3); of several ranges, only the last.
    sensed: Floats
    weight: Floats  #: Weights of codes, phase changes and Dopplers, shape (T, 3, K); 0 for excluded codes.
    faulty: Masks  #: True for excluded codes (`railfix.kernels.tracking.adaptation`), shape (T, K).

    def __len__(self) -> int:
        return len(self.time)

    @classmethod
    def empty(cls, time: Datetimes, channels: int) -> Tracked:
        """Return results without positions for the given times and number of channels."""
        return cls.from_records(time, new_results(len(time), channels))

    @classmethod
    def from_records(cls, time: Datetimes, results: Results) -> Tracked:
        """Convert the result records of the recursion."""
        columns = {name: np.ascontiguousarray(results.epoch[name]) for name in EPOCH_RESULT.names or ()}
        columns |= {
            name: np.ascontiguousarray(np.moveaxis(results.channel[name], -1, 1)) for name in ("innovation", "weight")
        }
        return cls(time=time, **columns, faulty=np.ascontiguousarray(results.channel["faulty"]))


#: Data types of the columns.
_TYPES: Final = {"Codes": np.int8, "Integers": np.int64, "Floats": np.float64}
#: Shapes of columns with more than one number per epoch.
_SHAPES: Final = {"used": (len(Kind),), "sensed": (len(Kind) - 3,)}
_OF_CHANNELS: Final = ("innovation", "weight", "faulty")
#: Record types of the results of one epoch and of one channel in the recursion.
EPOCH_RESULT: Final = record_of({
    f.name: (_TYPES[str(f.type)], _SHAPES.get(f.name, ()))
    for f in fields(Tracked)
    if f.name not in ("time", *_OF_CHANNELS)
})  # fmt: skip
CHANNEL_RESULT: Final = record_of({"innovation": (float, (3,)), "weight": (float, (3,)), "faulty": bool})


def new_results(epochs: int, channels: int) -> Results:
    """Return records of epochs without positions, with the status NOT_STARTED."""
    results = Results(np.zeros(epochs, dtype=EPOCH_RESULT), np.zeros((epochs, channels), dtype=CHANNEL_RESULT))
    for name, (kind, *_) in (EPOCH_RESULT.fields or {}).items():
        if kind.base == np.float64:
            results.epoch[name] = np.nan
    results.epoch["status"] = TrackStatus.NOT_STARTED
    results.channel["innovation"] = results.channel["weight"] = np.nan
    return results
