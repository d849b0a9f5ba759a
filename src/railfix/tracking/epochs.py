"""Measurements of the filter: arrays of T epochs by K channels, and of T epochs for sensors."""

from __future__ import annotations

from dataclasses import fields, replace
from enum import IntEnum
from typing import Literal

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings, dataclass


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
    """Corrected GNSS measurements of one antenna; NaN where there is none or it must not be used.

    Attributes
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    satellite : ndarray of str, shape (K,)
    clock : ndarray of str, shape (K,)
        Letter of the receiver clock of each channel's codes.
    sat_ecef_m, sat_velocity_mps : ndarray, shape (T, K, 3)
        Satellites at transmission.
    code_m, code_sigma_m : ndarray, shape (T, K) [m]
        Corrected pseudorange and its standard deviation, the receiver's noise scale included.
    phase_m : ndarray, shape (T, K) [m]
        Corrected carrier phase.
    phase_joined : ndarray of bool, shape (T, K)
        Whether the phase continues that of the epoch before without a cycle slip.
    rate_mps : ndarray, shape (T, K) [m/s]
        Range rate by the Doppler with the satellite clock and the troposphere's change taken off.
    cn0_dbhz : ndarray, shape (T, K)
    off_map : ndarray of bool, shape (T,)
        Epochs at which the train is known to be away from the line: places are forgotten, nothing is used.
    near_ecef_m : ndarray, shape (T, 3) [m], or None
        Position without the line, right to some hundred metres, for the velocity across it; NaN or None: not looked at.
    """

    time: Datetimes
    satellite: Strings
    clock: Strings
    sat_ecef_m: Floats
    sat_velocity_mps: Floats
    code_m: Floats
    code_sigma_m: Floats
    phase_m: Floats
    phase_joined: Masks
    rate_mps: Floats
    cn0_dbhz: Floats
    off_map: Masks
    near_ecef_m: Floats | None = None

    def __len__(self) -> int:
        return len(self.time)

    def take(self, rows: Indices | slice) -> GnssEpochs:
        """Return some of the epochs; what belongs to channels stays whole."""
        of_channels = ("satellite", "clock")
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in of_channels}
        values = {name: value[rows] for name, value in values.items() if value is not None}
        return replace(self, **values)


@dataclass(frozen=True, kw_only=True)
class RangeEpochs:
    """Ranges to ground units since the epoch before, up to R an epoch; NaN where there is none.

    Attributes
    ----------
    range_m, sigma_m, age_s : ndarray, shape (T, R)
        Measured so long before the epoch.
    unit_ecef_m : ndarray, shape (T, R, 3) [m]
    lever_m : ndarray, shape (3,) [m]
        From the trajectory's point to the vehicle's unit: along rising arc length, to the right, up.
    """

    range_m: Floats
    sigma_m: Floats
    age_s: Floats
    unit_ecef_m: Floats
    lever_m: Floats

    def take(self, rows: Indices) -> RangeEpochs:
        """Return the ranges of some of the epochs."""
        names = ("range_m", "sigma_m", "age_s", "unit_ecef_m")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


@dataclass(frozen=True, kw_only=True)
class BaliseEpochs:
    """Balises read since the epoch before, by turns: NaN, and any time, where there is none.

    Attributes
    ----------
    time : ndarray of datetime64[ns], shape (T, 2)
        At which each was passed.
    place_m, sigma_m : ndarray, shape (T, 2) [m]
        Arc length of the trajectory's point then.
    """

    time: Datetimes
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
    """Sensor measurements at the same epochs, shape (T,) each, NaN where there is none; None without the sensor.

    Attributes
    ----------
    wheel_m, wheel_sigma_m : ndarray or None [m]
        Way since the epoch before by the wheel, + toward rising chainage.
    wheel_sign : {"measured", "unknown"}
        "unknown": the distance has no sign and takes that of the speed.
    radar_m, radar_sigma_m : ndarray or None [m]
        The same by the radar: over a distance the swings of the body cancel (P2 3.2).
    force_mps2, force_sigma_mps2 : ndarray or None [m/s2]
        Mean specific force along rising chainage since the epoch before, gravity on the gradient included.
    place_m, place_sigma_m : ndarray or None [m]
        Arc length, by a feature of the line.
    balises : BaliseEpochs or None
    ranges : RangeEpochs or None
        Two-way ranges to ground units.
    """

    wheel_m: Floats | None = None
    wheel_sigma_m: Floats | None = None
    wheel_sign: Literal["measured", "unknown"] = "measured"
    radar_m: Floats | None = None
    radar_sigma_m: Floats | None = None
    force_mps2: Floats | None = None
    force_sigma_mps2: Floats | None = None
    place_m: Floats | None = None
    place_sigma_m: Floats | None = None
    balises: BaliseEpochs | None = None
    ranges: RangeEpochs | None = None


@dataclass(frozen=True, kw_only=True)
class Previous:
    """The last epoch: what a change of the carrier phase is taken from.

    Attributes
    ----------
    satellite : ndarray of str, shape (K,)
    sat_ecef_m : ndarray, shape (K, 3) [m]
    phase_m : ndarray, shape (K,) [m]
    """

    satellite: Strings
    sat_ecef_m: Floats
    phase_m: Floats
