"""Heights for a map that has none: a raster, a profile by chainage or kilometrage, or the 3-D positions of a run."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from typing import Any, Final

import numpy as np
from pyproj import CRS, Transformer

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import ending
from railfix.core.geodesy import ecef_from_geodetic, geodetic_from_ecef
from railfix.io.named_columns import NamedColumns, read_named_columns
from railfix.io.nmea import read_any_positions
from railfix.track.from_positions import SIGMA_OF_QUALITY
from railfix.track.heights import ellipsoidal_heights
from railfix.track.polyline import NearestOnPolyline
from railfix.track.track import SIGMA_HEIGHT_M, Track

#: Endings of rasters, read by GDAL through `rasterio`: GeoTIFF, and ESRI ASCII grid with its .prj file.
RASTERS: Final = (".tif", ".tiff", ".asc")
#: Cells of a raster read at a time.
_WINDOW_CELLS: Final = 4_000_000
#: Positions further than this from the line in plan are of another line [m].
_NEAR_M: Final = 15.0
#: Points further than this from a height along the line have none [m].
_REACH_M: Final = 200.0
#: Standard deviation of the weights of positions along the line [m].
_KERNEL_M: Final = 15.0


def with_heights(
    track: Track,
    path: str | PathLike[str],
    *,
    geoid: str | None = None,
    height_datum: str | None = None,
    sigma_m: float | None = None,
) -> Track:
    """The track with the heights of a second source in place of its own, and their standard deviation.

    Parameters
    ----------
    path : path
        Raster (`RASTERS`); CSV with ``chainage_m`` or ``kilometrage_m`` and ``height_m`` (ellipsoidal) or
        ``elevation_m`` (orthometric), its accuracy as the column ``sigma_m`` or the line ``# sigma_m:``; or a log of
        positions as `railfix.io.nmea.read_any_positions` reads it.
    geoid, height_datum : str, optional
        Geoid of orthometric heights; datum of a raster, which needs it.
    sigma_m : float, optional [m]
        Standard deviation of the heights, in place of that of the source; a raster needs it.

    Raises
    ------
    InputFileError
        The file has no heights for a part of the line.
    SettingsError
        A raster without its height datum or its standard deviation.
    """
    if ending(path) in RASTERS:
        return _from_raster(track, path, geoid=geoid, height_datum=height_datum, sigma_m=sigma_m)
    if ending(path) == ".csv":
        table = read_named_columns(path)
        by_place = {"chainage_m", "kilometrage_m"} & set(table.cells)
        if by_place and not {"latitude_deg", "x_m"} & set(table.cells):
            return _from_profile(track, table, geoid, sigma_m)
    return _from_positions(track, path, sigma_m)


def _from_raster(
    track: Track,
    path: str | PathLike[str],
    *,
    geoid: str | None,
    height_datum: str | None,
    sigma_m: float | None,
) -> Track:
    """Heights of a raster at the points of the track, linear between the middles of its cells."""
    try:
        import rasterio
    except ImportError:
        raise InputFileError(
            path, "reading a raster needs rasterio; install it with: pip install 'railfix[maps]'"
        ) from None
    if height_datum is None:
        raise SettingsError(f"{path}: the height datum of a raster is not in it; give --height-datum")
    if sigma_m is None:
        raise SettingsError(f"{path}: the accuracy of a raster is not in it; give --height-sigma")
    try:
        with rasterio.open(path) as raster:
            if raster.crs is None:
                raise InputFileError(path, "names no CRS; put a .prj file beside it, or write it as GeoTIFF")
            to_raster = Transformer.from_crs(
                CRS.from_user_input(track.provenance.frame).to_2d(),
                CRS.from_wkt(raster.crs.to_wkt()).to_2d(),
                always_xy=True,
            )
            x, y = (np.asarray(v) for v in to_raster.transform(track.longitude_deg, track.latitude_deg))
            turn = ~raster.transform
            column, row = turn.a * x + turn.b * y + turn.c, turn.d * x + turn.e * y + turn.f
            heights = _sample(raster, np.stack([row, column]) - 0.5)
    except rasterio.errors.RasterioError as error:
        raise InputFileError(path, f"GDAL cannot read this raster ({str(error).splitlines()[0]})") from None
    missing = np.flatnonzero(np.isnan(heights))
    if len(missing):
        raise InputFileError(
            path,
            f"{len(missing)} of {len(track)} points of the map have no height, the first at chainage "
            f"{track.chainage_m[missing[0]]:.0f} m; give a raster of the whole line",
        )
    height, model = ellipsoidal_heights(
        heights, track.latitude_deg, track.longitude_deg, datum=height_datum, geoid=geoid, geoid_m=None, path=str(path)
    )
    note = (
        f"heights of the raster {path}, sigma {sigma_m:.2f} m: those of the ground, which on bridges and in tunnels "
        "are not the track's"
    )
    return _replace(track, height, sigma_m, height_datum, model, note)


def _sample(raster: Any, place: Floats) -> Floats:
    """Values of a raster at rows and columns, shape (2, n), from the middles of its cells; NaN where it has none.

    Read in windows about neighbouring points, so that memory does not grow with the raster.
    """
    from scipy.ndimage import map_coordinates

    low = np.floor(place.min(axis=1)).astype(np.int64)
    size = np.floor(place.max(axis=1)).astype(np.int64) + 2 - low
    if size.prod() > _WINDOW_CELLS and place.shape[1] > 1:
        half = place.shape[1] // 2
        return np.concatenate([_sample(raster, place[:, :half]), _sample(raster, place[:, half:])])
    window = ((low[0], low[0] + size[0]), (low[1], low[1] + size[1]))
    cells = raster.read(1, window=window, boundless=True, masked=True, out_dtype="float64").filled(np.nan)
    return np.asarray(map_coordinates(cells, place - low[:, None], order=1, mode="constant", cval=np.nan))


def _from_profile(track: Track, table: NamedColumns, geoid: str | None, sigma_m: float | None) -> Track:
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
    if sigma_m is not None:
        sigma = sigma_m
    elif "sigma_m" in table:
        sigma = float(np.max(table.numbers("sigma_m")))
    else:
        sigma = float(table.metadata.get("sigma_m", SIGMA_HEIGHT_M))
    note = f"heights of the profile {table.path} by {by}, sigma {sigma:.2f} m"
    return _replace(track, height, sigma, datum, model, note)


def _from_positions(track: Track, path: str | PathLike[str], sigma_m: float | None) -> Track:
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
    fitted, spread = _smooth(target, place, height, sigma)
    spread = spread if sigma_m is None else sigma_m
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
    return _replace(track, fitted, spread, "ellipsoidal", "", notes)


def _smooth(target: Floats, place: Floats, height: Floats, sigma: Floats) -> tuple[Floats, float]:
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


def _replace(track: Track, height: Floats, sigma: float, datum: str, geoid: str, note: str) -> Track:
    provenance = replace(track.provenance, height_datum_used=datum, geoid=geoid, notes=(*track.provenance.notes, note))
    return replace(track, height_m=height, sigma_height_m=sigma, provenance=provenance)
