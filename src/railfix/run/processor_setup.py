"""Set up the epoch processor of a run with the files that the settings name, and read a base-station log."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.gnss.joined_observations import concatenate
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations
from railfix.integrity.protection.support_message import read_integrity_support
from railfix.motion.samples import GroundUnits, ListedBalises
from railfix.pipeline.base_station_stage import Stations
from railfix.pipeline.config import Config
from railfix.pipeline.feature_fixes import TrackFeatures
from railfix.pipeline.processor import EpochProcessor
from railfix.pipeline.range_stage import Models
from railfix.ranges.cn0_curve_file import read_cn0_curve
from railfix.ranges.error_model import read_error_model
from railfix.ranges.sbas import SbasState, read_sbas
from railfix.run.inputs import RunOptions
from railfix.run.sources import Log
from railfix.track import Track
from railfix.track.trajectory import Trajectory


def with_measured_priors(config: Config) -> Config:
    """Return settings with the fault priors, and the sections without a protection level, of their error model.

    The settings remain unchanged if they have no error model, if they specify a fault prior, or if the error model has
    no bounds of fault priors. If the settings specify sections without a protection level, they are kept.
    """
    given = config.risk.model_fields_set & {"local_prior", "side_prior", "priors"}
    if config.error_model is None or given:
        return config
    rate = read_error_model(config.error_model).faults
    if rate is None or not rate.bounds_priors:
        return config
    risk = config.risk.replaced(local_prior=rate.upper, side_prior=rate.side_upper, priors="measured")
    return config.replaced(risk=risk, no_level_m=config.no_level_m or rate.no_level_m)


def sbas_corrections(config: Config) -> SbasState | None:
    """Return the SBAS corrections, or None if the settings do not use SBAS.

    The settings name the files with the recorded messages. With ``sbas = "stream"``, messages arrive during the run,
    and the state before the first message is returned. With ``sbas_prn = "best"``, the GEO is selected from the
    recorded messages. Raise InputFileError if a file is missing or malformed. Raise SettingsError if there is no
    message of the requested GEO, or if the best GEO is requested for a stream.
    """
    if not config.sbas:
        return None
    prn, limits, band = config.sbas_prn, config.sbas_limits, config.sbas_band
    if config.sbas != "stream":
        messages = read_sbas(list(config.sbas), band=band)
        try:
            return SbasState.from_log(messages, prn=prn, limits=limits, band=band)
        except ValueError as error:
            raise SettingsError(f"sbas_prn = {prn}: {error}") from None
    if prn == "best":
        raise SettingsError(
            "sbas_prn = best: the best GEO is known only after all messages are received; give its PRN (sbas_prn = 137)"
        )
    return SbasState(prn=prn, limits=limits, band=band)


def make_processor(
    config: Config,
    navigation: Navigation,
    trajectories: Mapping[str, Trajectory],
    *,
    track: Track | None = None,
    units: GroundUnits | None = None,
    balises: ListedBalises | None = None,
    base_ecef_m: Floats | Literal["stream"] | None = None,
) -> EpochProcessor:
    """Return a processor with all navigation records, and with the content of the files that the settings name.

    `trajectories` has the trajectory of each antenna. `track` is required for positioning by line features. `units` are
    the surveyed ground units of two-way ranging, and `balises` the balise positions. `base_ecef_m` is the base-station
    position [m]; with "stream", it is taken from the headers of the station's observations. Raise InputFileError if a
    file that the settings name is missing or malformed. Raise SettingsError if SBAS is combined with precise orbits, or
    if there is no SBAS message of the requested GEO.
    """
    if config.sbas and navigation.precise is not None:
        raise SettingsError("SBAS corrects broadcast records, not precise orbits; use either --sbas or --sp3")
    features = {} if track is None else {name: TrackFeatures(track, path) for name, path in trajectories.items()}
    return EpochProcessor(
        config,
        trajectories,
        navigation=navigation,
        corrections=sbas_corrections(config),
        models=Models(
            error_model=None if config.error_model is None else read_error_model(config.error_model),
            cn0_curve=None if config.cn0_curve is None else read_cn0_curve(config.cn0_curve),
            support=None if config.integrity_support is None else read_integrity_support(config.integrity_support),
        ),
        stations=Stations(units, base_ecef_m, balises, features),
    )


#: A base-station epoch that is later than the train's epoch by at most this is assumed to be of the same instant.
_SAME_INSTANT = np.timedelta64(50, "ms")


def parse_position(text: str, option: str) -> Floats:
    """Parse a position LAT,LON,HEIGHT [deg, deg, m] and return it in ECEF, shape (3,) [m].

    Raise SettingsError if the text is not such a position. The message names the option `option`.
    """
    try:
        latitude, longitude, height = (float(part) for part in text.split(","))
    except ValueError:
        raise SettingsError(f"{option} {text!r}: expected LAT,LON,HEIGHT, for example 35.63,139.74,60") from None
    if not (-90.0 <= latitude <= 90.0 and -180.0 <= longitude <= 360.0 and -1e4 < height < 1e5):
        raise SettingsError(f"{option} {text!r}: expected a latitude to 90 degrees, a longitude and a height in metres")
    return ecef_from_geodetic(latitude, longitude, height)


class BaseLog:
    """Log of a base station. Without a `place` (LAT,LON,HEIGHT), the station's position is from the log's header.

    Raise InputFileError if the log has no epoch, or if neither `place` nor the header states the position.
    """

    def __init__(self, log: Log, place: str | None) -> None:
        self._parts = log.parts()
        self._waiting = next(self._parts, None)
        if self._waiting is None:
            raise InputFileError(log.paths[0], "has no epoch in the requested time")
        header = self._waiting.header
        self.span = self._waiting.time[0], self._waiting.time[-1]  #: First and last time of the epochs read so far.
        self.ecef_m = header.approximate_ecef_m if place is None else parse_position(place, "--base-place")
        if not np.linalg.norm(np.nan_to_num(self.ecef_m)) > 1e6:
            raise InputFileError(log.paths[0], "its header has no position; give the station's position (--base-place)")

    def until(self, time: np.datetime64) -> Observations | None:
        """Return the epochs up to `time` that have not been returned before, or None if there are none."""
        parts = list(self._until(time + _SAME_INSTANT))
        return concatenate(parts) if parts else None

    def _until(self, end: np.datetime64) -> Iterator[Observations]:
        while self._waiting is not None:
            part = self._waiting
            count = int(np.searchsorted(part.time, end, side="right"))
            if count:
                yield part[:count]
            if count < len(part):
                self._waiting = part[count:]
                return
            self._waiting = next(self._parts, None)
            if self._waiting is not None and len(self._waiting):
                self.span = self.span[0], self._waiting.time[-1]


def check_base_place(base: object, place: str | None) -> None:
    """Raise SettingsError if a base-station position is specified without the station's observations."""
    if not base and place is not None:
        raise SettingsError("--base-place is given without --base; give the observations of the base station, too")


def base_log(paths: tuple[Path, ...], options: RunOptions) -> BaseLog | None:
    """Open the log of a base station. Return None if there are no files."""
    check_base_place(paths, options.base_place)
    if not paths:
        return None
    log = Log(paths=paths, chunk_epochs=options.chunk_epochs, reading=options.logs)
    return BaseLog(log, options.base_place)
