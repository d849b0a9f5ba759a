"""Codes (pseudoranges) and carrier phases of an antenna at rest, optionally as differences from a base station."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import block_diag

from railfix.core.arrays import Datetimes, Floats, Indices, Masks, Strings
from railfix.core.constants import CLOCK_GROUP, SPEED_OF_LIGHT
from railfix.core.errors import MismatchError, NoPositionError
from railfix.core.geodesy import axes_at, range_with_rotation
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.pipeline.channel_book import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.received import known_from_start
from railfix.pipeline.without_map import RangesWithoutMap, locate, ranges_without_map
from railfix.positioning.standstill_phase import MeanPhases
from railfix.positioning.track_choice import StandstillErrors, StandstillFix, standstill_fix
from railfix.ranges.atmosphere import thin_shell_obliquity

#: A satellite is used if it has residuals in at least this fraction of the epochs, so that the means of all satellites
#: are over nearly the same epochs.
_SHARE: Final = 0.9
#: Standard deviation of the remaining satellite and atmospheric errors with a base station within 10 km [m].
_BESIDE_BASE_M: Final = 0.05
#: An antenna is at rest if the median positions in the three thirds of its log differ by at most this in plan [m].
_AT_REST_M: Final = 8.0
#: A change of a double difference between epochs by more than this is taken as a cycle slip [wavelengths].
_SLIP: Final = 0.25
#: A double difference is used if its longest part without a slip has at least this fraction of the epochs.
_UNBROKEN: Final = 0.5
#: RINEX loss-of-lock bits: bit 0 for a cycle slip since the previous epoch, bit 1 for a half-cycle ambiguity.
_LOST, _HALF_CYCLE = 1, 2


@dataclass(frozen=True, kw_only=True)
class StandstillCodes:
    """Code residuals of one antenna at rest, computed for the position `origin_ecef_m`: T epochs, K satellites."""

    time: Datetimes  #: Time tags, shape (T,).
    #: Measured minus computed codes, minus their mean over the satellites of each clock group, shape (T, K). NaN where
    #: a satellite was not used.
    residual_m: Floats
    system: Strings  #: Clock group of each satellite, shape (K,).
    azimuth_deg: Floats  #: Mean azimuth of each satellite, shape (K,).
    elevation_deg: Floats  #: Mean elevation of each satellite, shape (K,).
    common_m: Floats  #: Standard deviation of satellite and atmospheric errors, shape (K,).
    receivers: int  #: Number of receivers in the residuals: 2 if a base station's codes are subtracted, else 1.
    origin_ecef_m: Floats  #: Position for which the residuals are computed, ECEF, shape (3,).
    phases: StandstillPhases | None = None  #: Carrier phases; None without a base station.

    def fix(self, epochs: slice, errors: StandstillErrors) -> StandstillFix | None:
        """Return the mean position over `epochs`, or None if the satellites do not determine a position."""
        seconds = float((self.time[epochs][-1] - self.time[epochs][0]) / np.timedelta64(1, "s"))
        return standstill_fix(
            self.azimuth_deg,
            self.elevation_deg,
            self.system,
            np.nanmean(self.residual_m[epochs], axis=0),
            seconds=seconds,
            common_m=self.common_m,
            errors=errors,
            receivers=self.receivers,
        )


def standstill_codes(
    obs: Observations,
    navigation: Navigation,
    config: Config,
    *,
    base: tuple[Observations, Floats] | None = None,
    origin_ecef_m: Floats | None = None,
) -> StandstillCodes:
    """Return the code residuals of an antenna at rest, and, with a base station, its carrier phases.

    The residuals are computed for the position `origin_ecef_m`; the default is the antenna's median position. `base`
    has the observations and the ECEF position of a base station, shape (3,) [m]. Raise NoPositionError if the log has
    fewer than two positions. Raise MismatchError if the antenna moves, if no satellite is observed over the whole log,
    or if the log and the base station have no epoch or no signal in common.
    """
    received, book = known_from_start(config, navigation=navigation), ChannelBook(config)
    seen = ranges_without_map(obs, received, config, book)
    places = locate(obs, received, config, book).ecef_m
    places = places[np.isfinite(places[:, 0])]
    if len(places) < 2:
        raise NoPositionError("the log has no position; check that the navigation files are from the day of the log")
    # three parts, because a train that returns to its starting position has equal positions at the beginning and end of
    # the log
    thirds = np.array([np.median(part, axis=0) for part in np.array_split(places, min(3, len(places)))])
    level = (thirds - thirds[0]) @ axes_at(places[0])[:2].T
    moved = float(np.linalg.norm(level, axis=1).max())
    if moved > _AT_REST_M:
        raise MismatchError(f"the antenna moves by {moved:.0f} m in the log; give --start and --end of a standstill")
    origin = np.median(places, axis=0) if origin_ecef_m is None else origin_ecef_m
    time, residual, names = obs.time, _residual(seen, origin), seen.corrected.channels.satellite
    columns, phases = np.arange(len(names)), None
    elevation = np.nanmedian(seen.corrected.elevation_deg, axis=0)
    nominal = config.nominal.sigma_m(elevation, np.nanmedian(seen.corrected.ionosphere_m, axis=0))
    nominal = np.hypot(nominal, received.ionosphere_sigma_m * thin_shell_obliquity(elevation))
    if base is not None:
        of_base, base_ecef_m = base
        other = ranges_without_map(of_base, received, config, book)
        mine, its = _common_epochs(obs, of_base)
        columns, opposite = _common_channels(seen, other)
        time = obs.time[mine]
        residual = residual[mine][:, columns] - _residual(other, base_ecef_m)[its][:, opposite]
        phases = _phases((obs, seen, origin, mine, columns), (of_base, other, base_ecef_m, its, opposite))
        nominal = np.full(len(names), _BESIDE_BASE_M)
    kept = np.isfinite(residual).mean(axis=0) >= _SHARE
    if not kept.any():
        raise MismatchError("no satellite is observed over the whole log")
    system = np.array([CLOCK_GROUP[str(name)[0]] for name in names[columns[kept]]])
    residual = residual[:, kept]
    for letter in np.unique(system):
        rows = system == letter
        received = np.isfinite(residual[:, rows]).sum(axis=1, keepdims=True)  # 0 in a tunnel
        residual[:, rows] -= np.nansum(residual[:, rows], axis=1, keepdims=True) / np.maximum(received, 1)
    elevation, azimuth = seen.corrected.elevation_deg[:, columns[kept]], seen.corrected.azimuth_deg[:, columns[kept]]
    turn = np.radians(azimuth)
    return StandstillCodes(
        time=time,
        residual_m=residual,
        system=system,
        azimuth_deg=np.degrees(np.arctan2(np.nanmean(np.sin(turn), axis=0), np.nanmean(np.cos(turn), axis=0))),
        elevation_deg=np.nanmean(elevation, axis=0),
        common_m=nominal[columns[kept]],
        receivers=1 if base is None else 2,
        origin_ecef_m=origin,
        phases=phases,
    )


def _residual(seen: RangesWithoutMap, origin_ecef_m: Floats) -> Floats:
    """Return measured codes minus codes computed for a position [m]; NaN where a code is not used."""
    ranges = seen.ranges
    computed, _ = range_with_rotation(ranges.sat_ecef_m, origin_ecef_m)
    return np.where(ranges.weight > 0.0, ranges.code_m - computed, np.nan)


def _common_epochs(obs: Observations, other: Observations) -> tuple[Indices, Indices]:
    """Return the indices of the epochs in each of two logs that have equal time tags, rounded to 0.1 s.

    Raise MismatchError if there are no such epochs.
    """
    step = np.timedelta64(100, "ms")
    stamps = [np.round((t - obs.time[0]) / step).astype(np.int64) for t in (obs.time, other.time)]
    _, mine, its = np.intersect1d(*stamps, return_indices=True)
    if not len(mine):
        raise MismatchError("log and base station have no epoch in common")
    return mine, its


def _common_channels(seen: RangesWithoutMap, other: RangesWithoutMap) -> tuple[Indices, Indices]:
    """Return the indices, in each of two receivers, of their common channels. Raise MismatchError if there are none."""
    names = [s.corrected.channels.names.tolist() for s in (seen, other)]
    shared = [name for name in names[0] if name in names[1]]
    if not shared:
        raise MismatchError("log and base station have no signal of a satellite in common")
    mine, its = (np.array([of.index(name) for name in shared], dtype=np.intp) for of in names)
    return mine, its


@dataclass(frozen=True, kw_only=True)
class StandstillPhases:
    """Single differences of carrier phases between an antenna at rest and a base station: T epochs, M satellites."""

    #: Measured minus computed single differences, shape (T, M); NaN where a receiver has no usable phase.
    difference_m: Floats
    lost: Masks  #: Whether a receiver reports a cycle slip since the previous epoch, shape (T, M).
    toward: Floats  #: Unit vectors to the satellites (east, north, up), shape (T, M, 3).
    elevation_deg: Floats  #: Elevation of each satellite, shape (T, M).
    wavelength_m: Floats  #: Wavelength of each phase, shape (M,).
    group: Strings  #: Clock group and signal, shape (M,). Double differences are formed within a group.
    distance_m: float  #: Distance between the antenna and the base station [m].

    def mean(self, epochs: slice, errors: StandstillErrors) -> MeanPhases:
        """Return the mean of each double difference over the longest part of `epochs` without a cycle slip.

        The reference satellite of a group is the satellite with the highest mean elevation. Satellites whose longest
        part is shorter than `_UNBROKEN` of the epochs are omitted.
        """
        difference, lost, toward = self.difference_m[epochs], self.lost[epochs], self.toward[epochs]
        least = _UNBROKEN * len(difference)
        elevation = np.where(np.isfinite(difference), self.elevation_deg[epochs], 0.0).sum(axis=0)
        elevation /= np.maximum(np.isfinite(difference).sum(axis=0), 1)
        values, away, wavelengths, blocks = [], [], [], []
        for group in np.unique(self.group):
            columns = np.flatnonzero((self.group == group) & (np.isfinite(difference).sum(axis=0) >= least))
            if len(columns) < 2:
                continue
            reference = int(columns[np.argmax(elevation[columns])])
            own = [k for k in columns.tolist() if k != reference]
            kept = []
            for k in own:
                double = difference[:, k] - difference[:, reference]
                part = _longest_part(double, lost[:, k] | lost[:, reference], _SLIP * float(self.wavelength_m[k]))
                if part.stop - part.start < least:
                    continue
                kept.append(k)
                values.append(float(double[part].mean()))
                away.append(-(toward[part, k] - toward[part, reference]).mean(axis=0))
                wavelengths.append(float(self.wavelength_m[k]))
            variance = errors.phase_sigma_m(elevation, distance_m=self.distance_m) ** 2
            blocks.append(np.diag(variance[kept]) + variance[reference])
        return MeanPhases(
            difference_m=np.array(values),
            away=np.reshape(away, (len(values), 3)),
            wavelength_m=np.array(wavelengths),
            covariance_m2=block_diag(*blocks) if values else np.zeros((0, 0)),
        )


def _longest_part(values: Floats, lost: Masks, slip: float) -> slice:
    """Return the longest run of epochs with values and without a slip, or an empty slice if there are no values."""
    known = np.flatnonzero(np.isfinite(values))
    if not len(known):
        return slice(0, 0)
    gap = (np.diff(known) > 1) | (np.abs(np.diff(values[known])) > slip) | lost[known[1:]]
    bounds = np.concatenate([[0], np.flatnonzero(gap) + 1, [len(known)]])
    longest = int(np.argmax(np.diff(bounds)))
    return slice(int(known[bounds[longest]]), int(known[bounds[longest + 1] - 1]) + 1)


#: Data of one receiver: log, corrected ranges, ECEF position, and indices of the epochs and channels to use.
_Side = tuple[Observations, RangesWithoutMap, Floats, Indices, Indices]


def _phases(train: _Side, base: _Side) -> StandstillPhases:
    """Return single differences of phases. GLONASS is omitted, because its wavelengths differ between satellites."""
    sides, lost = [], []
    for obs, seen, place, epochs, columns in (train, base):
        channel = seen.corrected.channels.columns[columns]
        wavelength = SPEED_OF_LIGHT / seen.corrected.channels.frequency_hz[columns]
        rows = np.ix_(epochs, columns)
        # The code corrections are also applied to the phases. The ionospheric correction then has the wrong sign, but
        # it cancels in the difference.
        corrections = seen.ranges.code_m[rows] - obs.code_m[np.ix_(epochs, channel)]
        lock = obs.loss_of_lock[np.ix_(epochs, channel)]
        phase = obs.phase_cycles[np.ix_(epochs, channel)] * wavelength + corrections
        computed, _ = range_with_rotation(seen.ranges.sat_ecef_m[rows], place)
        usable = (seen.ranges.weight[rows] > 0.0) & (lock & _HALF_CYCLE == 0)
        sides.append(np.where(usable, phase - computed, np.nan))
        lost.append((lock & _LOST > 0) | obs.break_before[epochs][:, None])
    _, seen, origin, epochs, columns = train
    line = seen.ranges.sat_ecef_m[np.ix_(epochs, columns)] - origin
    toward = line @ axes_at(origin).T
    satellite = seen.corrected.channels.satellite[columns]
    kept = np.array([not str(name).startswith("R") for name in satellite], dtype=np.bool_)
    signals = zip(satellite, seen.corrected.channels.signal[columns], strict=True)
    group = np.array([CLOCK_GROUP[str(name)[0]] + str(signal) for name, signal in signals])
    return StandstillPhases(
        difference_m=(sides[0] - sides[1])[:, kept],
        lost=(lost[0] | lost[1])[:, kept],
        toward=(toward / np.linalg.norm(toward, axis=-1, keepdims=True))[:, kept],
        elevation_deg=seen.corrected.elevation_deg[np.ix_(epochs, columns)][:, kept],
        wavelength_m=(SPEED_OF_LIGHT / seen.corrected.channels.frequency_hz[columns])[kept],
        group=group[kept],
        distance_m=float(np.linalg.norm(origin - base[2])),
    )
