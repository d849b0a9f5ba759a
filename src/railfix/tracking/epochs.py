"""Measurements of the filter: arrays of shape (T epochs, K channels) for GNSS, and (T,) for sensors."""

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
    PLACE = 6  # position from a feature of the line
    BALISE = 7  # alternates with NEXT_BALISE, so that the protection level can exclude one of two successive balises
    NEXT_BALISE = 8
    RANGE = 9  # two-way range to a ground unit


@dataclass(frozen=True, kw_only=True)
class GnssEpochs:
    """Corrected GNSS measurements of one antenna; NaN where a measurement is absent or must not be used."""

    time: Datetimes  #: Time of each epoch, shape (T,).
    satellite: Strings  #: Satellite of each channel, shape (K,).
    signal: Strings  #: Signal of each channel, shape (K,); satellite and signal identify a channel uniquely.
    clock: Strings  #: Letter of the receiver clock that affects each channel's codes, shape (K,).
    sat_ecef_m: Floats  #: Satellite position at transmission, shape (T, K, 3).
    sat_velocity_mps: Floats  #: Satellite velocity at transmission, shape (T, K, 3).
    code_m: Floats  #: Pseudorange corrected for satellite clock, group delay and atmosphere, shape (T, K).
    code_sigma_m: Floats  #: Standard deviation of the code, including the receiver's noise scale, shape (T, K).
    phase_m: Floats  #: Carrier phase corrected for satellite clock and troposphere, shape (T, K).
    phase_joined: Masks  #: True where the phase continues from the previous epoch without a cycle slip, shape (T, K).
    #: Range rate from the Doppler, positive for an increasing range, shape (T, K). Satellite clock drift and
    #: tropospheric rate, a few millimetres per second each, need not be corrected.
    rate_mps: Floats
    cn0_dbhz: Floats  #: Carrier-to-noise density, shape (T, K).
    #: True where the train is known to be away from the line, shape (T,). At these epochs the filter is reset, and no
    #: measurement is used.
    off_map: Masks
    #: Error of the ionospheric model divided by its error in a quiet ionosphere, shape (T,); None if all are 1. Values
    #: above 1 increase sigma and protection level. The value is 0 for ionosphere-free codes.
    tilt_scale: Floats | None = None
    #: Position computed without the line, accurate to a few hundred metres, shape (T, 3). The antenna velocity is
    #: computed at this position, and is not available where the position is NaN or None.
    near_ecef_m: Floats | None = None

    def __len__(self) -> int:
        return len(self.time)

    @property
    def channel(self) -> Strings:
        """Channel names, satellite and signal joined, shape (K,)."""
        return np.char.add(self.satellite, self.signal)

    def take(self, rows: Indices | slice) -> GnssEpochs:
        """Return the selected epochs with all channels."""
        of_channels = ("satellite", "signal", "clock")
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in of_channels}
        values = {name: value[rows] for name, value in values.items() if value is not None}
        return replace(self, **values)


@dataclass(frozen=True, kw_only=True)
class RangeEpochs:
    """Two-way ranges to ground units, measured since the previous epoch, up to R per epoch; NaN where absent."""

    range_m: Floats  #: Measured ranges, shape (T, R).
    sigma_m: Floats  #: Standard deviations of the ranges, shape (T, R).
    age_s: Floats  #: Ages of the ranges at the epoch, shape (T, R).
    unit_ecef_m: Floats  #: Position of each range's ground unit, shape (T, R, 3).
    #: Lever arm from the trajectory to the vehicle's ranging unit: forward along the line, right, up, shape (3,).
    lever_m: Floats

    def take(self, rows: Indices) -> RangeEpochs:
        """Return the ranges of the selected epochs."""
        names = ("range_m", "sigma_m", "age_s", "unit_ecef_m")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


@dataclass(frozen=True, kw_only=True)
class BaliseEpochs:
    """Balises read since the previous epoch, in two alternating columns; NaN where absent."""

    time: Datetimes  #: Time at which each balise was passed, shape (T, 2); arbitrary where no balise was read.
    place_m: Floats  #: Arc length of the train along the trajectory at `time`, shape (T, 2).
    sigma_m: Floats  #: Standard deviation of the arc length, shape (T, 2).

    @classmethod
    def none(cls, epochs: int) -> BaliseEpochs:
        """Return the measurements of T epochs at which no balise was read."""
        place_m, sigma_m = np.full((2, epochs, 2), np.nan)
        return cls(time=np.zeros((epochs, 2), dtype="datetime64[ns]"), place_m=place_m, sigma_m=sigma_m)

    def find_latest(self, interval: Indices, intervals: int) -> BaliseEpochs:
        """Return the last balise of each column in each interval.

        `interval`, shape (T,), is the index of the interval of each epoch; `intervals` is the number of intervals.
        """
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
    """Sensor measurements at the GNSS epochs, shape (T,) each; NaN where absent, None if there is no such sensor."""

    wheel_m: Floats | None = None  #: Wheel distance since the previous epoch, positive toward increasing chainage.
    wheel_sigma_m: Floats | None = None  #: Standard deviation of the wheel distance.
    #: "unknown" if the wheel distance has no sign. The filter then assigns the sign of the speed.
    wheel_sign: Literal["measured", "unknown"] = "measured"
    #: Radar distance since the previous epoch. Over the interval, oscillations of the vehicle body cancel (P2 3.2).
    radar_m: Floats | None = None
    radar_sigma_m: Floats | None = None
    #: Mean specific force since the previous epoch, toward increasing chainage, including gravity on a gradient.
    force_mps2: Floats | None = None
    force_sigma_mps2: Floats | None = None
    place_m: Floats | None = None  #: Arc length measured by recognising a feature of the line, such as a curve.
    place_sigma_m: Floats | None = None  #: Standard deviation of the arc length.
    balises: BaliseEpochs | None = None  #: Balises read since the previous epoch.
    ranges: RangeEpochs | None = None  #: Two-way ranges to ground units since the previous epoch.


@dataclass(frozen=True, kw_only=True)
class Previous:
    """Last epoch of the previous chunk; the first phase changes of a chunk are computed from it."""

    channel: Strings  #: Channel names, shape (K,).
    sat_ecef_m: Floats  #: Satellite positions, shape (K, 3).
    phase_m: Floats  #: Corrected carrier phases, shape (K,); NaN where absent.
