"""Observations of a base station, read in step with those of the train."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.gnss.observations import Observations, concatenate
from railfix.motion.samples import SensorSamples
from railfix.run.options import RunOptions
from railfix.run.sources import Log

#: Time tags of the base station up to this after those of the train are of the same instant.
_SAME_INSTANT = np.timedelta64(50, "ms")


def place_of(text: str, option: str) -> Floats:
    """Return a position given as LAT,LON,HEIGHT on the command line, ECEF, shape (3,) [m]."""
    try:
        latitude, longitude, height = (float(part) for part in text.split(","))
    except ValueError:
        raise SettingsError(f"{option} {text!r}: expected LAT,LON,HEIGHT, for example 35.63,139.74,60") from None
    if not (-90.0 <= latitude <= 90.0 and -180.0 <= longitude <= 360.0 and -1e4 < height < 1e5):
        raise SettingsError(f"{option} {text!r}: expected a latitude to 90 degrees, a longitude and a height in metres")
    return ecef_from_geodetic(latitude, longitude, height)


class BaseLog:
    """Log of a base station.

    Parameters
    ----------
    log : Log
    place : str or None
        LAT,LON,HEIGHT; None takes the position of the log's header.

    Attributes
    ----------
    ecef_m : ndarray, shape (3,) [m]

    Raises
    ------
    InputFileError
        Neither gives a position.
    """

    def __init__(self, log: Log, place: str | None) -> None:
        self._parts = log.parts()
        self._waiting = next(self._parts, None)
        if self._waiting is None:
            raise InputFileError(log.paths[0], "has no epoch in the time asked for")
        header = self._waiting.header
        self.ecef_m = header.approximate_ecef_m if place is None else place_of(place, "--base-place")
        if not np.linalg.norm(np.nan_to_num(self.ecef_m)) > 1e6:
            raise InputFileError(log.paths[0], "its header has no position; give that of the station (--base-place)")

    def until(self, time: np.datetime64) -> Observations | None:
        """Return the epochs up to a time that have not been returned before."""
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


@dataclass(frozen=True)
class Beside:
    """What is measured beside the antennas: by sensors on board, and by a base station."""

    sensors: SensorSamples
    base: BaseLog | None


def base_log(paths: tuple[Path, ...], options: RunOptions) -> BaseLog | None:
    """Return the log of a base station; None without files."""
    if not paths:
        if options.base_place is not None:
            raise SettingsError("--base-place is given without --base; give the observations of the base station, too")
        return None
    log = Log(
        paths=paths, chunk_epochs=options.chunk_epochs, broken_lines=options.broken_lines, date=options.logs.instant
    )
    return BaseLog(log, options.base_place)
