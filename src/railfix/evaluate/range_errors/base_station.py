"""Common range errors per satellite, measured by a nearby reference station."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Strings
from railfix.core.errors import InputFileError
from railfix.core.geodesy import ecef_from_geodetic, geodetic_from_ecef, range_with_rotation
from railfix.core.reasons import Reason
from railfix.evaluate.bracket import bracket
from railfix.evaluate.range_errors.robust_clock import robust_clock
from railfix.gnss.observations import Observations
from railfix.io.logs import scan_observations
from railfix.pipeline.carrier_stage import CarrierState, smoothed, with_slips
from railfix.pipeline.channels import ChannelBook
from railfix.pipeline.corrected_ranges import correct_ranges
from railfix.pipeline.processor import EpochProcessor
from railfix.positioning.antenna_rows import AntennaRows
from railfix.positioning.section_search import SearchIndex
from railfix.track import Track
from railfix.track.trajectory import Trajectory

#: Half length of the north-south track through the station on which its ranges are corrected [deg]; about 50 m.
_HALF_LINE_DEG = 0.0005


@dataclass(frozen=True, kw_only=True)
class BaseStation:
    """Common errors by satellite, B epochs of the station by S satellites.

    Attributes
    ----------
    name : str
    time : ndarray of datetime64[ns], shape (B,)
    satellite : ndarray of str, shape (S,)
    error_m : ndarray, shape (B, S) [m]
        Corrected pseudorange minus range and receiver clock; NaN where not observed.
    smoothed : bool
        Whether the pseudoranges were smoothed by carrier phase.
    """

    name: str
    time: Datetimes
    satellite: Strings
    error_m: Floats
    smoothed: bool

    def at(self, time: Datetimes, satellite: Strings, *, largest_gap_s: float) -> Floats:
        """Errors at other times, interpolated linearly between the station's epochs, shape (T, K) [m].

        NaN for satellites that the station does not see, outside its log and in gaps.
        """
        column = {name: i for i, name in enumerate(self.satellite.tolist())}
        known = [k for k, name in enumerate(satellite.tolist()) if name in column]
        result = np.full((len(time), len(satellite)), np.nan)
        if len(self.time) > 1:
            chosen = self.error_m[:, [column[str(name)] for name in satellite[known]]]
            result[:, known] = bracket(time, self.time, largest_gap_s=largest_gap_s).of(chosen)
        return result


def base_station(
    parts: Iterable[Observations], processor: EpochProcessor, position_ecef_m: Floats, *, name: str
) -> BaseStation:
    """Common range errors from the log of a station at a known position.

    Its pseudoranges are corrected like those of the train, with the same settings, and smoothed by carrier phase
    where available, which reduces the station's own noise. The station's own multipath remains.

    Parameters
    ----------
    parts : iterable of Observations
        Parts of its log, in order of time.
    processor : EpochProcessor
        Of the train; its settings, ephemerides, ionosphere and SBAS also correct the station's pseudoranges.
    position_ecef_m : ndarray, shape (3,) [m]
    name : str
    """
    latitude, longitude, height = (float(x) for x in geodetic_from_ecef(position_ecef_m))
    ends = ecef_from_geodetic(latitude + np.array([-1.0, 1.0]) * _HALF_LINE_DEG, longitude, height)
    index = SearchIndex(Trajectory.from_track(Track.from_ecef(ends)))
    config, received = processor.config, processor.received
    book = ChannelBook(config)
    state, phases = CarrierState(), False
    times: list[Datetimes] = []
    errors: list[dict[str, Floats]] = []
    for obs in parts:
        corrected = correct_ranges(obs, book.of(obs, received.navigation), config, received, AntennaRows.of(index))
        corrected, state = with_slips(corrected, config, state)
        corrected, state = smoothed(corrected, config, state)
        phases |= bool(np.isfinite(obs.phase_cycles).any())
        distance, _ = range_with_rotation(corrected.satellites.position_ecef_m, position_ecef_m)
        residual = np.where(corrected.reason == Reason.USED, corrected.corrected_code_m - distance, np.nan)
        clock = robust_clock(residual, corrected.sigma_m, corrected.groups).clock_m
        owner = np.zeros(residual.shape[1], dtype=np.intp)
        for g, group in enumerate(corrected.groups):
            owner[group] = g
        error = residual - clock[:, owner]
        of_satellite: dict[str, Floats] = {}
        for k, satellite in enumerate(corrected.satellite.tolist()):
            before = of_satellite.get(satellite)
            of_satellite[satellite] = error[:, k] if before is None else np.where(np.isnan(before), error[:, k], before)
        times.append(obs.time)
        errors.append(of_satellite)
    names = sorted({satellite for part in errors for satellite in part})
    blank = [np.full(len(time), np.nan) for time in times]
    table = [
        np.stack([part.get(satellite, empty) for satellite in names], axis=1)
        for part, empty in zip(errors, blank, strict=True)
        if names
    ]
    return BaseStation(
        name=name,
        time=np.concatenate(times) if times else np.empty(0, dtype="datetime64[ns]"),
        satellite=np.array(names, dtype=np.str_),
        error_m=np.concatenate(table) if table else np.empty((0, 0)),
        smoothed=phases,
    )


def base_station_from_files(
    paths: Sequence[Path], processor: EpochProcessor, *, position_ecef_m: Floats | None = None
) -> BaseStation:
    """Common range errors from RINEX files; the position is that of the header where none is given.

    Raises
    ------
    InputFileError
        No position is known, or no error could be computed.
    """
    parts = list(scan_observations(paths, epochs=20_000))
    place = position_ecef_m if position_ecef_m is not None else parts[0].header.approximate_ecef_m
    if place is None or not np.isfinite(place).all() or np.linalg.norm(place) < 1e6:
        raise InputFileError(paths[0], "its header has no position; give that of the station (--base-position)")
    station = base_station(parts, processor, np.asarray(place), name=parts[0].header.marker or paths[0].name)
    if not np.isfinite(station.error_m).any():
        raise InputFileError(paths[0], "gives no range error of any satellite; is the navigation file of the same day?")
    return station
