"""Heights for a map that has none: a profile by chainage or kilometrage, or the 3-D positions of a run."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import ending
from railfix.core.geodesy import ecef_from_geodetic, geodetic_from_ecef
from railfix.io.named_columns import NamedColumns, read_named_columns
from railfix.io.nmea import read_any_positions
from railfix.track.from_positions import SIGMA_OF_QUALITY
from railfix.track.heights import ellipsoidal_heights
from railfix.track.polyline import NearestOnPolyline
from railfix.track.track import SIGMA_HEIGHT_M, Track

#: Positions further than this from the line in plan are of another line [m].
_NEAR_M: Final = 15.0
#: Points further than this from a height along the line have none [m].
_REACH_M: Final = 200.0
#: Standard deviation of the weights of positions along the line [m].
_KERNEL_M: Final = 15.0


def with_heights(track: Track, path: str | PathLike[str], *, geoid: str | None = None) -> Track:
    """The track with the heights of a second source, and their standard deviation.

    Parameters
    ----------
    track : Track
        With heights of 0, which are not used.
    path : path
        CSV with ``chainage_m`` or ``kilometrage_m`` and ``height_m`` (ellipsoidal) or ``elevation_m`` (orthometric),
        its accuracy as the column ``sigma_m`` or the line ``# sigma_m:``; or a log of positions as
        `railfix.io.nmea.read_any_positions` reads it.
    geoid : str, optional
        Of ``elevation_m``.

    Raises
    ------
    InputFileError
        The file has no heights for a part of the line.
    """
    if ending(path) == ".csv":
        table = read_named_columns(path)
        by_place = {"chainage_m", "kilometrage_m"} & set(table.cells)
        if by_place and not {"latitude_deg", "x_m"} & set(table.cells):
            return _from_profile(track, table, geoid)
    return _from_positions(track, path)


def _from_profile(track: Track, table: NamedColumns, geoid: str | None) -> Track:
    by = "chainage_m" if "chainage_m" in table else "kilometrage_m"
    datum = "ellipsoidal" if "height_m" in table else "orthometric"
    column = "height_m" if datum == "ellipsoidal" else "elevation_m"
    if column not in table:
        raise InputFileError(table.path, "there is no column height_m nor elevation_m", line=table.header_line)
    known, heights = table.numbers(by), table.numbers(column)
    if len(known) < 2 or not (np.diff(known) > 0.0).all():
        raise InputFileError(table.path, f"{by} must rise from row to row, with at least two rows")
    places = track.chainage_m if by == "chainage_m" else track.kilometrage_m
    if np.isnan(places).any():
        raise InputFileError(table.path, f"the profile is by {by}, which the map does not have; give chainage_m")
    outside = (places < known[0] - 1.0) | (places > known[-1] + 1.0)
    if outside.any():
        raise InputFileError(
            table.path,
            f"the profile runs from {known[0]:g} to {known[-1]:g} m, the map from {places.min():.1f} to "
            f"{places.max():.1f} m",
        )
    height, model = ellipsoidal_heights(
        np.interp(places, known, heights),
        track.latitude_deg,
        track.longitude_deg,
        datum=datum,
        geoid=geoid,
        geoid_m=None,
        path=table.path,
    )
    if "sigma_m" in table:
        sigma = float(np.max(table.numbers("sigma_m")))
    else:
        sigma = float(table.metadata.get("sigma_m", SIGMA_HEIGHT_M))
    note = f"heights of the profile {table.path} by {by}, sigma {sigma:.2f} m"
    return _replaced(track, height, sigma, datum, model, note)


def _from_positions(track: Track, path: str | PathLike[str]) -> Track:
    log = read_any_positions(path)
    latitude, longitude, height = geodetic_from_ecef(log.ecef_m)
    plan = NearestOnPolyline(ecef_from_geodetic(track.latitude_deg, track.longitude_deg, np.zeros(len(track))))
    segment, along, offset = plan(ecef_from_geodetic(latitude, longitude, np.zeros(len(log))))
    near = np.isfinite(offset) & (offset < _NEAR_M)
    if near.sum() < 2:
        raise InputFileError(path, f"{int(near.sum())} of {len(log)} positions lie within {_NEAR_M:g} m of the map")
    by_quality = np.array([SIGMA_OF_QUALITY.get(int(q), SIGMA_OF_QUALITY[5])[1] for q in log.quality])
    sigma = np.where(np.isfinite(log.sigma_m[:, 2]), np.maximum(log.sigma_m[:, 2], by_quality), by_quality)
    place = (track.chainage_m[segment] + along)[near]
    order = np.argsort(place)
    place, height, sigma = place[order], height[near][order], sigma[near][order]
    target = track.chainage_m
    fitted, spread = _smoothed(target, place, height, sigma)
    if np.isnan(fitted).any():
        first = float(target[np.isnan(fitted)][0])
        raise InputFileError(
            path,
            f"{int(np.isnan(fitted).sum())} of {len(track)} points of the map have no position within {_REACH_M:g} m, "
            f"the first at chainage {first:.0f} m; give positions of the whole line",
        )
    notes = (
        f"heights of the antenna positions {path}, sigma {spread:.2f} m: use the map without a vehicle file, or "
        "lower it by the height of that antenna"
    )
    return _replaced(track, fitted, spread, "ellipsoidal", "", notes)


def _smoothed(target: Floats, place: Floats, height: Floats, sigma: Floats) -> tuple[Floats, float]:
    """Weighted straight lines through the heights about each target, and their median standard deviation.

    Errors of neighbouring positions are common to them, so the standard deviation is that of one position.
    """
    fitted = np.full(len(target), np.nan)
    for k, at in enumerate(target):
        low, high = np.searchsorted(place, [at - 3.0 * _KERNEL_M, at + 3.0 * _KERNEL_M])
        x = place[low:high] - at
        if high - low >= 3 and x[0] < 0.0 < x[-1]:
            y, w = height[low:high], np.exp(-0.5 * (x / _KERNEL_M) ** 2) / sigma[low:high] ** 2
            mean, centre = float(w @ y) / w.sum(), float(w @ x) / w.sum()
            variance = float(w @ (x - centre) ** 2)
            slope = float(w @ ((x - centre) * (y - mean))) / variance if variance > 1.0e-9 * w.sum() else 0.0
            fitted[k] = mean - slope * centre
    missing = np.isnan(fitted)
    if missing.any():
        nearest = np.clip(np.searchsorted(place, target), 1, len(place) - 1)
        gap = np.minimum(np.abs(target - place[nearest - 1]), np.abs(place[nearest] - target))
        fill = missing & (gap <= _REACH_M)
        fitted[fill] = np.interp(target[fill], place, height)
    return fitted, float(np.median(sigma))


def _replaced(track: Track, height: Floats, sigma: float, datum: str, geoid: str, note: str) -> Track:
    provenance = replace(track.provenance, height_datum_used=datum, geoid=geoid, notes=(*track.provenance.notes, note))
    return replace(track, height_m=height, sigma_height_m=sigma, provenance=provenance)
