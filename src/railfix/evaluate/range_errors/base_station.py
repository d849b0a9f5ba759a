"""Common range errors per satellite, measured by a nearby reference station."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Strings
from railfix.core.errors import InputFileError
from railfix.evaluate.along_track import bracket
from railfix.gnss.observations import Observations
from railfix.io.logs import scan_observations
from railfix.pipeline.base_station import BaseStation
from railfix.pipeline.carrier_stage import CarrierState
from railfix.pipeline.processor import EpochProcessor


@dataclass(frozen=True, kw_only=True)
class CommonErrors:
    """Common errors by satellite, B epochs of the station by S satellites."""

    name: str
    time: Datetimes  #: Shape (B,).
    satellite: Strings  #: Shape (S,).
    error_m: Floats  #: Corrected pseudorange minus range and receiver clock; NaN where not observed; shape (B, S).
    smoothed: bool  #: Whether the pseudoranges were smoothed by carrier phase.

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
) -> CommonErrors:
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
    station, carrier, phases = BaseStation(processor.config, position_ecef_m), CarrierState(), False
    times: list[Datetimes] = []
    errors: list[dict[str, Floats]] = []
    for obs in parts:
        measured, carrier = station.errors(obs, processor.received, carrier, position_ecef_m)
        phases |= bool(np.isfinite(obs.phase_cycles).any())
        of_satellite: dict[str, Floats] = {}
        for k, satellite in enumerate(measured.satellite.tolist()):
            error, before = measured.code_m[:, k], of_satellite.get(satellite)
            of_satellite[satellite] = error if before is None else np.where(np.isnan(before), error, before)
        times.append(obs.time)
        errors.append(of_satellite)
    names = sorted({satellite for part in errors for satellite in part})
    blank = [np.full(len(time), np.nan) for time in times]
    table = [
        np.stack([part.get(satellite, empty) for satellite in names], axis=1)
        for part, empty in zip(errors, blank, strict=True)
        if names
    ]
    return CommonErrors(
        name=name,
        time=np.concatenate(times) if times else np.empty(0, dtype="datetime64[ns]"),
        satellite=np.array(names, dtype=np.str_),
        error_m=np.concatenate(table) if table else np.empty((0, 0)),
        smoothed=phases,
    )


def base_station_from_files(
    paths: Sequence[Path], processor: EpochProcessor, *, position_ecef_m: Floats | None = None
) -> CommonErrors:
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
