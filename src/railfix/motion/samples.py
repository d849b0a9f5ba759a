"""Samples of the sensors on board, as frozen arrays; GPS time, not falling; NaN where not measured."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks, Strings, freeze_rows

#: Sensors on board by the names of their samples.
SENSORS: Final = ("tachometer", "inertial", "radar", "ranging", "balises")


@dataclass(frozen=True, kw_only=True)
class Samples:
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
    """Two-way ranges to radio stations beside the track, N of them."""

    #: Name of the station on the ground, shape (N,).
    station: Strings = field(default_factory=lambda: np.empty(0, dtype="<U1"))
    range_m: Floats = field(default_factory=lambda: np.empty(0))  #: Shape (N,).
    #: Standard deviation that the device reports; NaN where it reports none; shape (N,).
    sigma_m: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class GroundUnits:
    """Surveyed radio stations beside the track, U of them."""

    name: Strings  #: Shape (U,).
    ecef_m: Floats  #: Shape (U, 3).

    def __len__(self) -> int:
        return len(self.name)


@dataclass(frozen=True, kw_only=True)
class BaliseReadings(Samples):
    """Balises that the train's reader has passed, at `time`; of a group the reading that the list places."""

    balise: Strings = field(default_factory=lambda: np.empty(0, dtype="<U1"))  #: Identity, shape (N,).
    #: Standard deviation along the line that the reader reports; NaN where it reports none; shape (N,).
    sigma_m: Floats = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True, kw_only=True)
class ListedBalises:
    """Balises, or places without one, along a line, M of them."""

    name: Strings  #: Shape (M,).
    chainage_m: Floats  #: Shape (M,).
    sigma_m: Floats  #: Standard deviation of the chainage, shape (M,).
    virtual: Masks  #: Places whose passing is reported; there is no balise; shape (M,).

    def __len__(self) -> int:
        return len(self.name)

    def index_of(self, names: Strings) -> Indices:
        """Return the rows of the balises of these names, -1 for one that is not listed."""
        rows = {str(self.name[k]): k for k in np.flatnonzero(~self.virtual)}
        return np.array([rows.get(str(name), -1) for name in names], dtype=np.intp)


@dataclass(frozen=True, kw_only=True)
class SensorSamples:
    """Samples of all sensors on board received since the chunk before."""

    tachometer: TachometerPulses = field(default_factory=TachometerPulses)
    inertial: InertialSamples = field(default_factory=InertialSamples)
    radar: RadarSpeeds = field(default_factory=RadarSpeeds)
    ranging: StationRanges = field(default_factory=StationRanges)
    #: Each without rows where the sensor is absent or has sent nothing.
    balises: BaliseReadings = field(default_factory=BaliseReadings)
    #: Sensors not yet heard up to the epoch that the samples are given with (live): what they say since the epoch
    #: before is not known. Their samples may come with the next epoch.
    silent: frozenset[str] = frozenset()

    @property
    def tables(self) -> dict[str, Samples]:
        """Samples by sensor."""
        return {name: getattr(self, name) for name in SENSORS}

    def between(self, begin: np.datetime64, end: np.datetime64) -> SensorSamples:
        """Return the samples after one instant (all where it is NaT) up to another."""
        parts: dict[str, Any] = {}
        for name, rows in self.tables.items():
            first = 0 if np.isnat(begin) else int(np.searchsorted(rows.time, begin, side="right"))
            last = int(np.searchsorted(rows.time, end, side="right"))
            parts[name] = type(rows)(**{f.name: getattr(rows, f.name)[first:last] for f in fields(rows)})
        return SensorSamples(**parts, silent=self.silent)

    def joined(self, later: SensorSamples) -> SensorSamples:
        """Return these samples and others in order of time; some of the others may be older than some of these."""
        parts: dict[str, Any] = {}
        for name, after in later.tables.items():
            before: Any = getattr(self, name)
            values = {f.name: np.concatenate([getattr(before, f.name), getattr(after, f.name)]) for f in fields(after)}
            if len(before) and len(after) and after.time[0] < before.time[-1]:
                order = np.argsort(values["time"], kind="stable")
                values = {column: rows[order] for column, rows in values.items()}
            parts[name] = type(after)(**values)
        return SensorSamples(**parts, silent=later.silent)

    def __bool__(self) -> bool:
        return any(len(rows) > 0 for rows in self.tables.values())
