"""Samples of the on-board sensors as read-only arrays, and formulas for Doppler radar and two-way ranges (P2 3).

Times are GPS times in ascending order. Missing values are NaN. If a radar beam points by an angle alpha below the
direction of travel, the relative error of the speed is ``tan(alpha)`` times the error of alpha.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks, RowArrays, Strings, freeze_rows, join_rows
from railfix.core.constants import SPEED_OF_LIGHT

#: Names of the on-board sensors, which are fields of `SensorSamples`.
SENSORS: Final = ("tachometer", "inertial", "radar", "ranging", "balises")


@dataclass(frozen=True, kw_only=True)
class Samples(RowArrays):
    """N samples of one sensor, as read-only arrays with one row per sample."""

    #: Instant of each sample, shape (N,).
    time: Datetimes = field(default_factory=lambda: np.empty(0, dtype="datetime64[ns]"))

    def __post_init__(self) -> None:
        freeze_rows(self, "samples")

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, kw_only=True)
class TachometerPulses(Samples):
    """N pulses of a tachometer."""

    #: Consecutive number of each pulse, shape (N,). Missing numbers are lost pulses.
    pulse: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    #: 1 if the vehicle moves forward, -1 if backward, 0 if the sensor does not report the direction; shape (N,).
    direction: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))


@dataclass(frozen=True, kw_only=True)
class InertialSamples(Samples):
    """N samples of an inertial measurement unit fixed to the vehicle body."""

    #: Specific force along the forward, right and down axes; about (0, 0, -9.8) at rest; shape (N, 3).
    force_mps2: Floats = field(default_factory=lambda: np.empty((0, 3)))
    #: Angular rate about the forward (roll), right (pitch) and down (yaw) axes; shape (N, 3).
    rate_radps: Floats = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True, kw_only=True)
class RadarSpeeds(Samples):
    """N speeds over ground, measured by a Doppler radar."""

    #: Speed, positive forward; NaN without a signal; shape (N,).
    speed_mps: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class StationRanges(Samples):
    """N two-way ranges to radio stations near the track."""

    #: Name of the radio station, shape (N,).
    station: Strings = field(default_factory=lambda: np.empty(0, dtype="<U1"))
    range_m: Floats = field(default_factory=lambda: np.empty(0))  #: Distance to the station, shape (N,).
    #: Standard deviation of the distance, reported by the ranging device; NaN if not reported; shape (N,).
    sigma_m: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class GroundUnits:
    """Positions of U surveyed radio stations near the track."""

    name: Strings  #: Name of each station, shape (U,).
    ecef_m: Floats  #: Position of each station's antenna, shape (U, 3).

    def __len__(self) -> int:
        return len(self.name)


@dataclass(frozen=True, kw_only=True)
class BaliseReadings(Samples):
    """N readings of balises by the train. Of a group of balises, only the balise in the balise list is included."""

    balise: Strings = field(default_factory=lambda: np.empty(0, dtype="<U1"))  #: Identity of the balise, shape (N,).
    #: Sigma of the balise's detected position along the line, shape (N,); NaN if the reader does not report it.
    sigma_m: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class ListedBalises:
    """M balises and virtual balises along a line. A virtual balise is a point whose passage railfix reports."""

    name: Strings  #: Name of each balise, shape (M,).
    chainage_m: Floats  #: Chainage of each balise, shape (M,).
    sigma_m: Floats  #: Standard deviation of the chainage, shape (M,).
    virtual: Masks  #: True for virtual balises, shape (M,).

    def __len__(self) -> int:
        return len(self.name)

    def find_index(self, names: Strings) -> Indices:
        """Return the rows of physical balises with given names; -1 for a name that is not listed or is virtual."""
        rows = {str(self.name[k]): k for k in np.flatnonzero(~self.virtual)}
        return np.array([rows.get(str(name), -1) for name in names], dtype=np.intp)


@dataclass(frozen=True, kw_only=True)
class SensorSamples:
    """Samples of all on-board sensors received since the previous chunk; empty for a sensor without samples."""

    tachometer: TachometerPulses = field(default_factory=TachometerPulses)
    inertial: InertialSamples = field(default_factory=InertialSamples)
    radar: RadarSpeeds = field(default_factory=RadarSpeeds)
    ranging: StationRanges = field(default_factory=StationRanges)
    balises: BaliseReadings = field(default_factory=BaliseReadings)
    #: In live positioning, sensors whose samples up to the epoch have not arrived. Their values since the previous
    #: epoch are unknown, but may arrive with the next epoch.
    silent: frozenset[str] = frozenset()

    @property
    def tables(self) -> dict[str, Samples]:
        """Samples by the name of the sensor."""
        return {name: getattr(self, name) for name in SENSORS}

    def between(self, begin: np.datetime64, end: np.datetime64) -> SensorSamples:
        """Return the samples after `begin` up to and including `end`; if `begin` is NaT, all samples up to `end`."""
        parts: dict[str, Any] = {}
        for name, rows in self.tables.items():
            first = 0 if np.isnat(begin) else int(np.searchsorted(rows.time, begin, side="right"))
            last = int(np.searchsorted(rows.time, end, side="right"))
            parts[name] = rows.take(slice(first, last))
        return SensorSamples(**parts, silent=self.silent)

    def merge(self, later: SensorSamples) -> SensorSamples:
        """Return these and later samples in order of time, with `silent` from `later`."""
        parts: dict[str, Any] = {}
        for name, after in later.tables.items():
            before: Samples = getattr(self, name)
            parts[name] = both = join_rows([before, after])
            if len(before) and len(after) and after.time[0] < before.time[-1]:
                parts[name] = both.take(np.argsort(both.time, kind="stable"))
        return SensorSamples(**parts, silent=later.silent)

    def __bool__(self) -> bool:
        tables = self.tachometer, self.inertial, self.radar, self.ranging, self.balises
        return sum(map(len, tables)) > 0


def two_way_range_m(delay_s: Floats, answer_s: float) -> Floats:
    """Return the two-way range [m]: ``(delay_s - answer_s) c / 2`` (P2 3.3, equation 1).

    `delay_s` is the time from the request to the reception of the answer, `answer_s` the station's processing time.
    """
    return np.asarray((delay_s - answer_s) * SPEED_OF_LIGHT / 2.0)


def radar_speed_mps(shift_hz: Floats, carrier_hz: float, angle_rad: float) -> Floats:
    """Return the speed from the Doppler shift of a radar [m/s]: ``v = c f_d / (2 f_0 cos(alpha))`` (P2 3.1, figure 9).

    `angle_rad` (alpha) is the angle between the beam and the direction of travel.
    """
    return np.asarray(SPEED_OF_LIGHT * shift_hz / (2.0 * carrier_hz * np.cos(angle_rad)))
