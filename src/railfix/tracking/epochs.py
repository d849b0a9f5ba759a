"""Measurements of the filter: arrays of T epochs by K channels, and of T epochs for sensors."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Literal

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings


class Kind(IntEnum):
    """Kind of a measurement."""

    CODE = 0
    PHASE = 1
    DOPPLER = 2
    WHEEL = 3
    RADAR = 4
    FORCE = 5
    PLACE = 6  # by a feature of the line
    BALISE = 7  # and the one read after it: balises take turns, so that the level can do without either
    NEXT_BALISE = 8
    RANGE = 9  # to a ground unit


@dataclass(frozen=True, kw_only=True)
class GnssEpochs:
    """Corrected GNSS measurements of one antenna; NaN where there is none or it must not be used."""

    time: Datetimes  #: Shape (T,).
    satellite: Strings  #: Shape (K,).
    signal: Strings  #: With the satellite the name of the channel, which no other one has; shape (K,).
    clock: Strings  #: Letter of the receiver clock of each channel's codes; shape (K,).
    #: Satellites at transmission; shape (T, K, 3).
    sat_ecef_m: Floats
    sat_velocity_mps: Floats
    #: Pseudorange with satellite clock, group delay and atmosphere applied, and its standard deviation, the receiver's
    #: noise scale included; shape (T, K).
    code_m: Floats
    code_sigma_m: Floats
    phase_m: Floats  #: Carrier phase with satellite clock and troposphere applied; shape (T, K).
    phase_joined: Masks  #: Whether the phase continues that of the epoch before without a cycle slip; shape (T, K).
    #: Range rate by the Doppler, + where the range grows. The drift of the satellite's clock and the change of the
    #: troposphere, some millimetres a second, may be left in it; shape (T, K).
    rate_mps: Floats
    cn0_dbhz: Floats  #: Shape (T, K).
    #: Epochs at which the train is known to be away from the line: places are forgotten, nothing is used; shape (T,).
    off_map: Masks
    #: Position without the line, right to some hundred metres, for the velocity across it; NaN or None: not looked at;
    #: shape (T, 3).
    near_ecef_m: Floats | None = None

    def __len__(self) -> int:
        return len(self.time)

    @property
    def channel(self) -> Strings:
        """Names of the channels, shape (K,)."""
        return np.char.add(self.satellite, self.signal)

    def take(self, rows: Indices | slice) -> GnssEpochs:
        """Return some of the epochs; what belongs to channels stays whole."""
        of_channels = ("satellite", "signal", "clock")
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in of_channels}
        values = {name: value[rows] for name, value in values.items() if value is not None}
        return replace(self, **values)


@dataclass(frozen=True, kw_only=True)
class RangeEpochs:
    """Ranges to ground units since the epoch before, up to R an epoch; NaN where there is none."""

    #: Ranges, standard deviations, and how long before the epoch each was measured; shape (T, R).
    range_m: Floats
    sigma_m: Floats
    age_s: Floats
    unit_ecef_m: Floats  #: Shape (T, R, 3).
    #: From the trajectory's point to the vehicle's unit: along rising arc length, to the right, up; shape (3,).
    lever_m: Floats

    def take(self, rows: Indices) -> RangeEpochs:
        """Return the ranges of some of the epochs."""
        names = ("range_m", "sigma_m", "age_s", "unit_ecef_m")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


@dataclass(frozen=True, kw_only=True)
class BaliseEpochs:
    """Balises read since the epoch before, by turns: NaN, and any time, where there is none."""

    time: Datetimes  #: When each was passed; shape (T, 2).
    #: Arc length of the trajectory's point then, and its standard deviation; shape (T, 2).
    place_m: Floats
    sigma_m: Floats

    @classmethod
    def none(cls, epochs: int) -> BaliseEpochs:
        """Return epochs without a balise."""
        place_m, sigma_m = np.full((2, epochs, 2), np.nan)
        return cls(time=np.zeros((epochs, 2), dtype="datetime64[ns]"), place_m=place_m, sigma_m=sigma_m)

    def find_latest(self, interval: Indices, intervals: int) -> BaliseEpochs:
        """Return the last balise of each turn in each interval; `interval` has that of each epoch, shape (T,)."""
        row = np.full((intervals, 2), -1, dtype=np.intp)
        epoch, turn = np.nonzero(np.isfinite(self.place_m))
        np.maximum.at(row, (interval[epoch], turn), epoch)
        turns = np.arange(2)
        return BaliseEpochs(
            time=self.time[row, turns],
            place_m=np.where(row >= 0, self.place_m[row, turns], np.nan),
            sigma_m=self.sigma_m[row, turns],
        )


@dataclass(frozen=True, kw_only=True)
class SensorEpochs:
    """Sensor measurements at the same epochs, shape (T,) each, NaN where there is none; None without the sensor."""

    #: Distance since the epoch before by the wheel, + toward rising chainage.
    wheel_m: Floats | None = None
    wheel_sigma_m: Floats | None = None
    #: "unknown": the distance has no sign and takes that of the speed.
    wheel_sign: Literal["measured", "unknown"] = "measured"
    #: The same by the radar: over a distance the swings of the body cancel (P2 3.2).
    radar_m: Floats | None = None
    radar_sigma_m: Floats | None = None
    #: Mean specific force along rising chainage since the epoch before, gravity on the gradient included.
    force_mps2: Floats | None = None
    force_sigma_mps2: Floats | None = None
    #: Arc length, by a feature of the line.
    place_m: Floats | None = None
    place_sigma_m: Floats | None = None
    balises: BaliseEpochs | None = None  #: Balises read.
    ranges: RangeEpochs | None = None  #: Two-way ranges to ground units.


@dataclass(frozen=True, kw_only=True)
class Previous:
    """The last epoch, from which changes of the carrier phase are computed."""

    channel: Strings  #: Shape (K,).
    sat_ecef_m: Floats  #: Shape (K, 3).
    phase_m: Floats  #: Shape (K,).
