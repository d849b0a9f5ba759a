"""Range errors measured by a base station at a known position, which are used to correct a train's ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, TypeVar

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Strings
from railfix.core.settings import Settings
from railfix.core.timescale import seconds, timedelta
from railfix.gnss.navigation import Navigation
from railfix.ranges.atmosphere import SeenFrom
from railfix.ranges.channels import Channels
from railfix.ranges.sources import BaseDifferences, CorrectionSource, SourceDelays, SourceSatellites

Values = TypeVar("Values", Floats, Integers)
#: A station epoch may be up to this time [s] later than the train's epoch, because the two receiver clocks differ.
_SAME_S: Final = 0.05
#: Code errors older than this [s] are not used; they change by centimetres in 30 s without selective availability.
LONGEST_AGE_S: Final = 60.0
#: Phase errors older than this [s] are not used. Phase errors change by millimetres in a second.
_PHASE_AGE_S: Final = 1.1
#: Part of the sigma of corrected ranges that is proportional to the distance between station and train [m/km]; it
#: covers differences of ionospheric, tropospheric and orbit errors.
_PER_KM_M: Final = 0.004
LONGEST_KM: Final = 100.0  #: Ranges are not corrected if the train is farther than this from the station [km].


class BaseLimits(Settings):
    """Settings of the corrections by a base station."""

    #: Sigma of the station's smoothed multipath in the corrections [m]; the noise of the train's receiver is added.
    sigma_m: float = Field(default=0.3, gt=0)
    #: Random walk of an ambiguity [m/sqrt(s)]; with a base station, it replaces `PhaseLimits.drift_m`.
    drift_m: float = Field(default=0.001, ge=0)


@dataclass(frozen=True, kw_only=True)
class BaseErrors:
    """Range errors measured by a base station, B epochs by S channels."""

    ecef_m: Floats  #: Position of the station, shape (3,).
    time: Datetimes  #: Time tags of the station, shape (B,).
    #: Satellite and signal of each channel, shape (S,).
    satellite: Strings
    signal: Strings
    #: Corrected code minus geometric range and minus the receiver clock offset of the constellation, shape (B, S); NaN
    #: where no code was observed.
    code_m: Floats
    #: Corrected phase minus geometric range and minus a clock offset common to all channels, shape (B, S). The
    #: ambiguity remains.
    phase_m: Floats
    arc: Integers  #: Carrier-phase arc number, shape (B, S).

    def __len__(self) -> int:
        return len(self.time)

    def merge(self, later: BaseErrors) -> BaseErrors:
        """Return these errors followed by `later`, for every channel that occurs in at least one of the two."""
        parts = (self, later)
        keys = sorted({key for part in parts for key in part.keys})
        return replace(
            later,
            time=np.concatenate([part.time for part in parts]),
            satellite=np.array([satellite for satellite, _ in keys], dtype="<U3"),
            signal=np.array([signal for _, signal in keys], dtype="<U2"),
            code_m=np.concatenate([_on(part.code_m, part.keys, keys, np.nan) for part in parts]),
            phase_m=np.concatenate([_on(part.phase_m, part.keys, keys, np.nan) for part in parts]),
            arc=np.concatenate([_on(part.arc, part.keys, keys, -1) for part in parts]),
        )

    @property
    def keys(self) -> list[tuple[str, str]]:
        """Satellite and signal of each channel."""
        return list(zip(self.satellite.tolist(), self.signal.tolist(), strict=True))

    def drop_before(self, time: np.datetime64) -> BaseErrors:
        """Return the epochs from `time` on, only with channels whose code error is known at one of these epochs."""
        rows = self.time >= time
        seen = np.isfinite(self.code_m[rows]).any(axis=0)
        return replace(
            self,
            time=self.time[rows],
            satellite=self.satellite[seen],
            signal=self.signal[seen],
            **{name: getattr(self, name)[rows][:, seen] for name in ("code_m", "phase_m", "arc")},
        )

    def at(
        self, time: Datetimes, satellite: Strings, signal: Strings, receiver_ecef_m: Floats, limits: BaseLimits
    ) -> BaseDifferences:
        """Return the station's newest errors for the train's T epochs and K channels.

        `receiver_ecef_m` are approximate positions of the train, shape (T, 3).

        For a channel that the station does not observe, another signal of the same band is used; the errors of the two
        signals are assumed to differ by a constant that is common to all satellites of a constellation. Where the
        station has no recent error, or is farther than `LONGEST_KM` from the train, the errors are NaN and the arcs -1.
        """
        shape = (len(time), len(satellite))
        of_band = {(name, code[:1]): k for k, (name, code) in enumerate(self.keys)}
        own = {key: k for k, key in enumerate(self.keys)}
        wanted = zip(satellite.tolist(), signal.tolist(), strict=True)
        column = np.array([own.get(key, of_band.get((key[0], key[1][:1]), -1)) for key in wanted], dtype=np.intp)
        row = np.searchsorted(self.time, time + timedelta(np.array(_SAME_S)), side="right") - 1
        distance_km = np.linalg.norm(receiver_ecef_m - self.ecef_m, axis=1) / 1e3
        if not len(self) or not len(self.satellite):
            nothing = np.full(shape, np.nan)
            return BaseDifferences(code_m=nothing, phase_m=nothing, arc=np.full(shape, -1), sigma_m=nothing)
        age = np.where(row >= 0, seconds(time - self.time[row]), np.inf)
        near = (distance_km <= LONGEST_KM)[:, None] & (column >= 0)
        at = np.ix_(row, column)
        code = np.where(near & (age <= LONGEST_AGE_S)[:, None], self.code_m[at], np.nan)
        fresh = near & (age <= _PHASE_AGE_S)[:, None]
        sigma = np.hypot(limits.sigma_m, _PER_KM_M * distance_km)
        return BaseDifferences(
            code_m=code,
            phase_m=np.where(fresh, self.phase_m[at], np.nan),
            arc=np.where(fresh, self.arc[at], -1),
            sigma_m=np.broadcast_to(sigma[:, None], shape),
        )


def _on(values: Values, own: Sequence[tuple[str, str]], keys: Sequence[tuple[str, str]], blank: float) -> Values:
    """Rearrange `values` from the channels `own` to the channels `keys`; `blank` for channels that are not in `own`."""
    place = {key: k for k, key in enumerate(keys)}
    columns: Indices = np.array([place[key] for key in own], dtype=np.intp)
    full = np.full((len(values), len(keys)), blank, dtype=values.dtype)
    full[:, columns] = values
    return full


@dataclass(frozen=True, kw_only=True)
class BaseStationSource:
    """Correction source that adds the range errors measured by a base station to the corrections of another source."""

    other: CorrectionSource  #: Source of satellite positions, clocks and delays.
    errors: BaseErrors
    limits: BaseLimits
    floor_sigma_m: float  #: Error floor (`CodeNoise`) of codes without a station correction [m].
    second: Literal["none", "optional", "required"] = "none"

    @property
    def navigation(self) -> Navigation:
        """Navigation records of the satellites."""
        return self.other.navigation

    def satellites(
        self, time: Datetimes, channels: Channels, code_m: Floats, *, max_age_s: float | None = None
    ) -> SourceSatellites:
        """Return the satellites of the source `other`."""
        return self.other.satellites(time, channels, code_m, max_age_s=max_age_s)

    def delays(self, time: Datetimes, channels: Channels, satellites: SourceSatellites, seen: SeenFrom) -> SourceDelays:
        """Return the delays of the source `other`, the station's errors, and the sigma of the corrected ranges."""
        given = self.other.delays(time, channels, satellites, seen)
        base = self.errors.at(time, channels.satellite, channels.signal, seen.receiver_ecef_m, self.limits)
        differenced = np.isfinite(base.code_m)
        nominal, beyond = (np.where(differenced, base.sigma_m, each) for each in (given.nominal_m, given.sigma_m))
        beyond = np.where(differenced, beyond, np.hypot(beyond, self.floor_sigma_m))
        by_elevation = np.where(differenced, 0.0, given.nominal_elevation_sigma_m)
        return SourceDelays(given.delays, beyond, nominal, by_elevation, base, "included")
