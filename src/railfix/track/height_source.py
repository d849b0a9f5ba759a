"""Heights for a map without heights: from a raster, a profile along the line, or the 3-D positions of a run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Final

import numpy as np
from pyproj import CRS

from railfix.core.arrays import Floats, places_in_groups
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.extras import needs_extra
from railfix.core.files import FilePath, ending
from railfix.core.geodesy import ecef_from_geodetic, geodetic_from_ecef
from railfix.io.file_kind import find_kind
from railfix.io.named_columns import NamedColumns, read_named_columns
from railfix.io.position_log import PositionLog
from railfix.io.positions import read_positions
from railfix.track.georeference import NEGLIGIBLE_M, EllipsoidalHeights, Georeference, to_map
from railfix.track.heights import GEOIDS, ellipsoidal_heights, own_height_datum
from railfix.track.map_from_positions import SIGMA_OF_QUALITY
from railfix.track.track import SIGMA_HEIGHT_M, Track
from railfix.track.trajectory import NearestOnPolyline

#: File name endings of rasters, which are read with GDAL: GeoTIFF, ESRI ASCII grid with a .prj file, SRTM, DTED and
#: others.
RASTERS: Final = (
    ".tif", ".tiff", ".asc", ".vrt", ".hgt", ".dt0", ".dt1", ".dt2", ".img", ".bil", ".flt", ".jp2", ".grd", ".xyz",
)  # fmt: skip
HeightSource = FilePath | PositionLog  #: File with heights, or positions in memory.
_SPACING_M: Final = 50.0  #: Points are added where the points of the map are farther apart than this [m].
_WINDOW_CELLS: Final = 4_000_000  #: Largest number of raster cells that are read at once.
_NEAR_M: Final = 15.0  #: Positions farther than this from the line in plan are not used [m].
#: Every point of the map needs a position of the log within this distance along the line [m].
_REACH_M: Final = 200.0
#: Standard deviation of the Gaussian weights along the line for RTK fixed positions [m].
_KERNEL_M: Final = 15.0
#: Standard deviation of the Gaussian weights along the line for single-point positions, whose errors persist for
#: hundreds of metres [m]. These weights cause a height error of about 5 m in a vertical curve of 2 km radius.
_LARGEST_KERNEL_M: Final = 150.0
#: Constants of the robust locally weighted regression (Cleveland 1979, doi:10.1080/01621459.1979.10481038): multiple of
#: the median deviation at which a height loses its weight, and number of reweighting iterations.
_ROBUST, _WEIGHED_AGAIN = 6.0, 2


def check_raster(path: FilePath, *, geoid: str | None, height_datum: str | None, sigma_m: float | None) -> None:
    """Raise SettingsError that names all missing options for a raster.

    Raise InputFileError if the raster cannot be read or has no CRS.
    """
    with _open_raster(path) as (_, crs):
        own = crs.is_compound
    asked = []
    if height_datum is None and not own:
        asked.append("height_datum (--height-datum), orthometric (above the sea, as in most rasters) or ellipsoidal")
    if height_datum != "ellipsoidal" and geoid is None and not own:
        asked.append(f"geoid (--geoid) for orthometric heights ({GEOIDS})")
    if sigma_m is None:
        asked.append("sigma_height_m (--height-sigma), the accuracy of the heights in metres")
    if asked:
        raise SettingsError(f"{path}: the raster does not state the reference of its heights; give {', '.join(asked)}")


def with_heights(
    track: Track,
    source: HeightSource,
    *,
    geoid: str | None = None,
    height_datum: str | None = None,
    sigma_m: float | None = None,
) -> Track:
    """Return the track with heights from `source`, and with the standard deviation of these heights.

    The source is a raster (`RASTERS`), a CSV table by chainage or kilometrage, or a position log. A raster requires
    `height_datum` and `sigma_m`. Points are added so that heights are at most 50 m apart. Raise InputFileError if the
    source lacks heights for a part of the line.
    """
    track = _dense(track)
    if isinstance(source, PositionLog):
        return _from_positions(track, source, sigma_m, reach_m=np.inf)
    if ending(source) in RASTERS:
        return _from_raster(track, source, geoid=geoid, height_datum=height_datum, sigma_m=sigma_m)
    if find_kind(source) == "table":
        table = read_named_columns(source)
        by_place = {"chainage_m", "kilometrage_m"} & set(table.cells)
        if by_place and not {"latitude_deg", "x_m"} & set(table.cells):
            return _from_profile(track, table, geoid, sigma_m)
    return _from_positions(track, read_positions(source), sigma_m, reach_m=_REACH_M)


def _dense(track: Track) -> Track:
    """Return the track with added points between points that are more than `_SPACING_M` apart."""
    pieces = np.ceil(np.diff(track.chainage_m) / _SPACING_M).astype(np.intp)
    if not (pieces > 1).any():
        return track
    pieces = np.maximum(pieces, 1)
    start, piece = places_in_groups(pieces)
    share = piece / pieces[start]

    def between(values: Floats) -> Floats:
        return np.append(values[start] + share * (values[start + 1] - values[start]), values[-1])

    ecef = np.stack([between(column) for column in track.ecef_m.T], axis=-1)
    latitude, longitude, _ = geodetic_from_ecef(ecef)
    linear = ("height_m", "kilometrage_m", "cant_m", "gradient_permille")
    columns: dict[str, Any] = {name: between(getattr(track, name)) for name in linear}
    columns |= {
        name: np.append(getattr(track, name)[start], getattr(track, name)[-1]) for name in ("radius_m", "section")
    }
    return replace(track, latitude_deg=latitude, longitude_deg=longitude, **columns)


@contextmanager
def _open_raster(path: FilePath) -> Iterator[tuple[Any, CRS]]:
    """Open a raster, and yield it with its CRS; raise InputFileError if it has no CRS or cannot be read."""
    with needs_extra(f"{path}: a raster"):
        import rasterio
    try:
        with rasterio.open(path) as raster:
            if raster.crs is None:
                raise InputFileError(path, "states no CRS; put a .prj file next to it, or write it as GeoTIFF")
            yield raster, CRS.from_wkt(raster.crs.to_wkt())
    except rasterio.errors.RasterioError as error:
        raise InputFileError(path, f"GDAL cannot read this raster ({str(error).splitlines()[0]})") from None


def _from_raster(
    track: Track, path: FilePath, *, geoid: str | None, height_datum: str | None, sigma_m: float | None
) -> Track:
    """Return the track with the heights of a raster, by linear interpolation between the centres of cells."""
    check_raster(path, geoid=geoid, height_datum=height_datum, sigma_m=sigma_m)
    with _open_raster(path) as (raster, crs):
        datum, model = own_height_datum(crs.to_wkt(), height_datum, geoid, path=str(path))
        place = _place(track)
        x, y = to_map(crs.to_2d().to_wkt(), place, path=str(path))
        turn = ~raster.transform
        column, row = turn.a * x + turn.b * y + turn.c, turn.d * x + turn.e * y + turn.f
        heights = _sample(raster, np.stack([row, column]) - 0.5)
    missing = np.flatnonzero(np.isnan(heights))
    if len(missing):
        raise InputFileError(
            path,
            f"{len(missing)} of {len(track)} points of the map have no height, the first at chainage "
            f"{track.chainage_m[missing[0]]:.0f} m; give a raster of the whole line",
        )
    above = ellipsoidal_heights(heights, place, datum=str(datum), geoid=model, path=str(path))
    note = (
        f"heights of the raster {path}, sigma {sigma_m or 0.0:.2f} m: heights of the ground, which on "
        "bridges and in tunnels are not the heights of the track"
    )
    return _replace(track, above, float(sigma_m or 0.0), note)


def _sample(raster: Any, place: Floats) -> Floats:
    """Interpolate a raster at rows and columns, shape (2, n); NaN where the raster has no value.

    The raster is read in windows around successive points. The result has shape (n,).
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
        raise table.header_error("there is no column height_m or elevation_m")
    known, heights = table.numbers(by), table.numbers(column)
    if len(known) < 2 or not (np.diff(known) > 0.0).all():
        raise InputFileError(table.path, f"{by} must rise from row to row, and at least two rows are required")
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
    heights = np.interp(places, known, heights)
    above = ellipsoidal_heights(heights, _place(track), datum=datum, geoid=geoid, path=table.path)
    if sigma_m is not None:
        sigma = sigma_m
    elif "sigma_m" in table:
        sigma = float(np.max(table.numbers("sigma_m")))
    else:
        sigma = float(table.metadata.get("sigma_m", SIGMA_HEIGHT_M))
    if sigma_m is None and above.accuracy_m >= NEGLIGIBLE_M:
        sigma = float(np.hypot(sigma, above.accuracy_m))
    note = f"heights of the profile {table.path} by {by}, sigma {sigma:.2f} m"
    return _replace(track, above, sigma, note)


def _from_positions(track: Track, log: PositionLog, sigma_m: float | None, *, reach_m: float) -> Track:
    latitude, longitude, height = geodetic_from_ecef(log.ecef_m)
    plan = NearestOnPolyline(ecef_from_geodetic(track.latitude_deg, track.longitude_deg, np.zeros(len(track))))
    segment, along, offset = plan(ecef_from_geodetic(latitude, longitude, np.zeros(len(log))))
    near = np.isfinite(offset) & (offset < _NEAR_M)
    if near.sum() < 2:
        raise InputFileError(log.path, f"{int(near.sum())} of {len(log)} positions are within {_NEAR_M:g} m of the map")
    by_quality = np.array([SIGMA_OF_QUALITY.get(int(q), SIGMA_OF_QUALITY[5])[1] for q in log.quality])
    sigma = np.where(np.isfinite(log.sigma_m[:, 2]), np.maximum(log.sigma_m[:, 2], by_quality), by_quality)
    place = (track.chainage_m[segment] + along)[near]
    order = np.argsort(place)
    place, height, sigma = place[order], height[near][order], sigma[near][order]
    target = track.chainage_m
    fitted = _smooth(target, place, height, sigma, reach_m=reach_m)
    # averaging does not reduce the standard deviation, because successive positions have common errors
    spread = float(np.median(sigma)) if sigma_m is None else sigma_m
    if np.isnan(fitted).any():
        first = float(target[np.isnan(fitted)][0])
        raise InputFileError(
            log.path,
            f"{int(np.isnan(fitted).sum())} of {len(track)} points of the map have no position within {reach_m:g} m, "
            f"the first at chainage {first:.0f} m; give positions of the whole line",
        )
    note = (
        f"heights of the antenna positions {log.path}, sigma {spread:.2f} m: use the map without a vehicle file, or "
        "lower its heights by the height of the antenna"
    )
    return _replace(track, EllipsoidalHeights(height_m=fitted, datum="ellipsoidal"), spread, note)


def _smooth(target: Floats, place: Floats, height: Floats, sigma: Floats, *, reach_m: float) -> Floats:
    """Return heights at the chainages `target`, smoothed by local straight lines; NaN where no position is in reach."""
    kernel = float(np.clip(_KERNEL_M * np.median(sigma) / SIGMA_HEIGHT_M, _KERNEL_M, _LARGEST_KERNEL_M))
    weight = 1.0 / sigma**2
    for _ in range(_WEIGHED_AGAIN if kernel > _KERNEL_M else 0):
        off = np.abs(height - _local_lines(place, place, height, weight, kernel))
        off = np.where(np.isnan(off), 0.0, off) / max(_ROBUST * float(np.nanmedian(off)), 1e-6)
        weight = np.maximum(1.0 - off**2, 1e-3) ** 2 / sigma**2
    fitted = _local_lines(target, place, height, weight, kernel)
    missing = np.isnan(fitted)
    if missing.any():
        nearest = np.clip(np.searchsorted(place, target), 1, len(place) - 1)
        gap = np.minimum(np.abs(target - place[nearest - 1]), np.abs(place[nearest] - target))
        fill = missing & (gap <= reach_m)
        if reach_m == np.inf and not missing.all():  # interpolate between smoothed heights, not single positions
            place, height = target[~missing], fitted[~missing]
        fitted[fill] = np.interp(target[fill], place, height)
    return fitted


def _local_lines(target: Floats, place: Floats, height: Floats, weight: Floats, kernel_m: float) -> Floats:
    """Return heights at chainages `target` from locally weighted straight lines; NaN where there are no positions."""
    fitted = np.full(len(target), np.nan)
    bounds = np.searchsorted(place, [target - 3.0 * kernel_m, target + 3.0 * kernel_m]).T
    for k, (low, high) in enumerate(bounds.tolist()):
        x = place[low:high] - target[k]
        if high - low >= 3 and x[0] < 0.0 < x[-1]:
            y, w = height[low:high], np.exp(-0.5 * (x / kernel_m) ** 2) * weight[low:high]
            mean, centre = float(w @ y) / w.sum(), float(w @ x) / w.sum()
            variance = float(w @ (x - centre) ** 2)
            slope = float(w @ ((x - centre) * (y - mean))) / variance if variance > 1.0e-9 * w.sum() else 0.0
            fitted[k] = mean - slope * centre
    return fitted


def _place(track: Track) -> Georeference:
    """Return the georeference of a track's points."""
    return Georeference(
        latitude_deg=track.latitude_deg, longitude_deg=track.longitude_deg, frame=track.provenance.frame
    )


def _replace(track: Track, heights: EllipsoidalHeights, sigma: float, note: str) -> Track:
    notes = (*track.provenance.notes, note, *heights.notes)
    provenance = replace(track.provenance, height_datum_used=heights.datum, geoid=heights.geoid, notes=notes)
    return replace(track, height_m=heights.height_m, sigma_height_m=sigma, provenance=provenance)
