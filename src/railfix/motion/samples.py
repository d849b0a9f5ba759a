"""Samples of the sensors on board, as frozen arrays; GPS time, not falling; NaN where not measured.

Formulas of the Doppler radar and two-way ranges (P2 3). The relative speed error of a radar that looks down at the
angle alpha is ``tan(alpha)`` times the angle's error.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks, RowArrays, Strings, freeze_rows, join_rows
from railfix.core.constants import SPEED_OF_LIGHT

#: Sensors on board by the names of their samples.
SENSORS: Final = ("tachometer", "inertial", "radar", "ranging", "balises")


@dataclass(frozen=True, kw_only=True)
class Samples(RowArrays):
    """N samples: read-only arrays with one row each."""

    #: Instant of each sample, shape (N,).
    time: Datetimes = field(default_factory=lambda: np.empty(0, dtype="datetime64[ns]"))

    def __post_init__(self) -> None:
        freeze_rows(self, "samples")

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True, kw_only=True)
class TachometerPulses(Samples):
    """Pulses of a tachometer, N of them."""

    #: Number of the pulse: a gap means lost pulses; shape (N,).
    pulse: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    #: 1 when the vehicle moves forward, -1 backward, 0 where the sensor does not report it; shape (N,).
    direction: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))


@dataclass(frozen=True, kw_only=True)
class InertialSamples(Samples):
    """Samples of an inertial unit fixed to the vehicle body, N of them."""

    #: Specific force forward, right, down; about (0, 0, -9.8) at rest; shape (N, 3).
    force_mps2: Floats = field(default_factory=lambda: np.empty((0, 3)))
    #: Angular rate about forward (roll), right (pitch), down (yaw); shape (N, 3).
    rate_radps: Floats = field(default_factory=lambda: np.empty((0, 3)))


@dataclass(frozen=True, kw_only=True)
class RadarSpeeds(Samples):
    """Speeds over ground of a Doppler radar, N of them."""

    #: Forward positive; NaN without a signal; shape (N,).
    speed_mps: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class StationRanges(Samples):
    """Two-way ranges to N radio stations near the track."""

    #: Name of the station on the ground, shape (N,).
    station: Strings = field(default_factory=lambda: np.empty(0, dtype="<U1"))
    range_m: Floats = field(default_factory=lambda: np.empty(0))  #: Shape (N,).
    #: Standard deviation that the device reports; NaN where it reports none; shape (N,).
    sigma_m: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class GroundUnits:
    """Positions of U surveyed radio stations near the track."""

    name: Strings  #: Shape (U,).
    ecef_m: Floats  #: Shape (U, 3).

    def __len__(self) -> int:
        return len(self.name)


@dataclass(frozen=True, kw_only=True)
class BaliseReadings(Samples):
    """Balises passed by the train's reader, at `time`; for a group, the reading that matches the list."""

    balise: Strings = field(default_factory=lambda: np.empty(0, dtype="<U1"))  #: Identity, shape (N,).
    #: Standard deviation along the line that the reader reports; NaN where it reports none; shape (N,).
    sigma_m: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class ListedBalises:
    """Balises, or reporting points without one, along a line, M of them."""

    name: Strings  #: Shape (M,).
    chainage_m: Floats  #: Shape (M,).
    sigma_m: Floats  #: Standard deviation of the chainage, shape (M,).
    virtual: Masks  #: Points whose passing is reported, without a balise; shape (M,).

    def __len__(self) -> int:
        return len(self.name)

    def find_index(self, names: Strings) -> Indices:
        """Return the rows of the balises with these names, -1 for a balise that is not listed."""
        rows = {str(self.name[k]): k for k in np.flatnonzero(~self.virtual)}
        return np.array([rows.get(str(name), -1) for name in names], dtype=np.intp)


@dataclass(frozen=True, kw_only=True)
class SensorSamples:
    """Samples of all sensors on board received since the previous chunk."""

    tachometer: TachometerPulses = field(default_factory=TachometerPulses)
    inertial: InertialSamples = field(default_factory=InertialSamples)
    radar: RadarSpeeds = field(default_factory=RadarSpeeds)
    ranging: StationRanges = field(default_factory=StationRanges)
    #: Each has no rows where the sensor is absent or has sent nothing.
    balises: BaliseReadings = field(default_factory=BaliseReadings)
    #: Sensors without samples up to the epoch (live): their values since the previous epoch are unknown.
    #: Their samples may arrive with the next epoch.
    silent: frozenset[str] = frozenset()

    @property
    def tables(self) -> dict[str, Samples]:
        """Samples by sensor."""
        return {name: getattr(self, name) for name in SENSORS}

    def between(self, begin: np.datetime64, end: np.datetime64) -> SensorSamples:
        """Return the samples after a first instant (all where it is NaT) up to a second one."""
        parts: dict[str, Any] = {}
        for name, rows in self.tables.items():
            first = 0 if np.isnat(begin) else int(np.searchsorted(rows.time, begin, side="right"))
            last = int(np.searchsorted(rows.time, end, side="right"))
            parts[name] = rows.take(slice(first, last))
        return SensorSamples(**parts, silent=self.silent)

    def merge(self, later: SensorSamples) -> SensorSamples:
        """Return both sets of samples in order of time; late samples are sorted in."""
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
    """Return the range by the delay of an answer: ``r = (dt_A - dt_B) c / 2`` (P2 3.3, equation 1)."""
    return np.asarray((delay_s - answer_s) * SPEED_OF_LIGHT / 2.0)


def radar_speed_mps(shift_hz: Floats, carrier_hz: float, angle_rad: float) -> Floats:
    """Return the speed by a Doppler shift: ``v = c f_d / (2 f_0 cos(alpha))`` (P2 3.1, figure 9)."""
    return np.asarray(SPEED_OF_LIGHT * shift_hz / (2.0 * carrier_hz * np.cos(angle_rad)))
