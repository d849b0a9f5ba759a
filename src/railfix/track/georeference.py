"""Transformation of map coordinates to latitude and longitude in a modern frame, and accuracy of the transformation.

A PROJ operation (https://proj.org) is used only if its area of use contains the map and its grids are installed.
Ballpark operations, which do not change the datum, are not used.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from textwrap import shorten
from typing import Final

import numpy as np
from pyproj import CRS, Transformer

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track.crs import (
    LARGEST_SCALE,
    MARGIN_DEG,
    REGIONAL,
    TRANSIT,
    WORST_M,
    Box,
    Operations,
    contains,
    find_crs,
    find_operations,
    get_geodetic_frame,
    is_in_area,
    kind_of_frame,
    known_accuracy_m,
    name_operation,
    rank_operation,
)

#: Projections of web and world maps. Their scale is not checked, because it differs greatly from 1.
_UNEVEN: Final = (
    "Popular Visualisation Pseudo Mercator", "Mercator (variant A)", "Mercator (variant B)", "Equidistant Cylindrical",
)  # fmt: skip
#: All maps in a cell of this size are transformed by the same operation [deg].
_CELL_DEG: Final = 0.25
#: Standard deviation below which a transformation error is negligible compared with the error of a map [m].
NEGLIGIBLE_M: Final = 0.1
#: An operation with a missing grid is reported as better if its accuracy is below this fraction of the accuracy of the
#: operation that is used.
_BETTER: Final = 0.9


@dataclass(frozen=True, kw_only=True)
class Georeference:
    """Coordinates of n points of a map in a modern frame, and the transformation to this frame."""

    latitude_deg: Floats  #: Latitude, shape (n,).
    longitude_deg: Floats  #: Longitude, shape (n,).
    frame: str = "EPSG:4979"  #: Geographic CRS of the coordinates.
    operation: str = ""  #: Name of the PROJ operation that changed the datum; "" if the map is in a modern frame.
    accuracy_m: float = 0.0  #: Standard deviation of the operation in plan; NaN if unknown.
    notes: tuple[str, ...] = ()

    @property
    def box(self) -> Box:
        """South, north, west and east bounds of the points [deg]."""
        return _box(self.latitude_deg, self.longitude_deg)


@dataclass(frozen=True, kw_only=True)
class EllipsoidalHeights:
    """Ellipsoidal heights of n points of a map, and the conversion that was applied to the heights of the file."""

    height_m: Floats  #: Ellipsoidal height, shape (n,).
    datum: str  #: Height datum of the file, "ellipsoidal" or "orthometric".
    geoid: str = ""  #: Geoid model or operation that was used; "" for ellipsoidal heights.
    accuracy_m: float = 0.0  #: Standard deviation of the geoid model or operation; NaN if unknown.
    notes: tuple[str, ...] = ()


def _box(latitude_deg: Floats, longitude_deg: Floats) -> Box:
    """Return the bounds of points [deg]; the east bound exceeds 180 if the points cross the date line."""
    west = float(longitude_deg.min())
    if float(longitude_deg.max()) - west > 180.0:
        longitude_deg = longitude_deg % 360.0
    return (
        float(latitude_deg.min()), float(latitude_deg.max()),
        float(longitude_deg.min()), float(longitude_deg.max()),
    )  # fmt: skip


def _cells(box: Box) -> Box:
    """Return a box extended to full cells, so that all parts of a map are transformed by the same operation."""
    south, north, west, east = box
    low = [float(np.floor(v / _CELL_DEG) * _CELL_DEG) for v in (south, west)]
    high = [float(np.ceil(v / _CELL_DEG) * _CELL_DEG) for v in (north, east)]
    return max(low[0], -90.0), min(high[0], 90.0), low[1], high[1]


def georeference(crs: str, x: Floats, y: Floats, *, path: str) -> Georeference:
    """Transform map coordinates to latitude and longitude in a modern frame.

    Parameters
    ----------
    crs : str
        Coordinate reference system of the map.
    x, y : ndarray, shape (n,)
        Easting and northing, or longitude and latitude, in the units of the CRS. All values must be finite.
    path : str
        Name of the file for error messages.

    Returns
    -------
    Georeference
        Coordinates in a modern frame, and the name and accuracy of the operation that changed the datum.

    Raises
    ------
    InputFileError
        The coordinates are outside the area of use of the CRS, or are coordinates of another grid.
    SettingsError
        PROJ has no operation from the datum of the CRS at this location, or the grid of the operation is not installed.
    """
    latitude, longitude = _in_degrees(crs, x, y)
    _check_area(crs, latitude, longitude, path=path)
    system = find_crs(crs)
    if system.is_projected:
        _check_scale(crs, np.stack([x, y], axis=-1), latitude, longitude, path=path)
    if not system.is_bound and kind_of_frame(crs) != "older datum":
        return Georeference(latitude_deg=latitude, longitude_deg=longitude, frame=_find_frame(crs))
    chosen = _find_chosen(crs, _box(latitude, longitude), path=path)
    moved = [np.asarray(v, np.float64) for v in chosen.transformer.transform(x, y)]
    if not np.isfinite(moved).all():
        raise SettingsError(
            f"{path}: the grid of {chosen.name!r} does not cover all points; give a map in ETRS89 or WGS 84"
        )
    return Georeference(
        latitude_deg=moved[1],
        longitude_deg=moved[0],
        frame=chosen.frame,
        operation=chosen.name,
        accuracy_m=chosen.accuracy_m,
        notes=(chosen.note,),
    )


def to_map(crs: str, place: Georeference, *, path: str) -> tuple[Floats, Floats]:
    """Transform positions to the coordinates of a CRS, shape (n,) each (inverse of `georeference`).

    Modern frames are treated as equal, which causes errors of up to 2 m. Raise SettingsError if PROJ has no installed
    operation for the positions.
    """
    if not find_crs(crs).is_bound and kind_of_frame(crs) != "older datum":
        conversion, unit, origin = _to_datum(crs)
        degrees = (place.longitude_deg - origin) / unit, place.latitude_deg / unit
        x, y = conversion.transform(*degrees, direction="INVERSE")
    else:
        operation = _find_chosen(crs, place.box, path=path).transformer
        x, y = operation.transform(place.longitude_deg, place.latitude_deg, direction="INVERSE")
    return np.asarray(x, np.float64), np.asarray(y, np.float64)


def _find_chosen(crs: str, box: Box, *, path: str) -> _Chosen:
    """Return the operation from a CRS to a modern frame within a box; raise SettingsError if there is none."""
    chosen = _choose_operation(crs, _cells(box))
    if isinstance(chosen, str):
        chosen = _choose_operation(crs, box)
    if isinstance(chosen, str):
        raise SettingsError(f"{path}: {chosen}")
    return chosen


@dataclass(frozen=True, kw_only=True)
class _Chosen:
    transformer: Transformer
    frame: str
    name: str
    accuracy_m: float
    note: str


@lru_cache(maxsize=256)
def _choose_operation(crs: str, box: Box) -> _Chosen | str:
    """Return the best operation from an older datum to a modern frame in a box, or why there is no operation."""
    source = find_crs(crs).to_2d()
    known = {code: find_operations(source, CRS.from_user_input(code).to_2d(), box) for code in _targets(crs, box)}
    datum = "its own datum" if source.is_bound else get_geodetic_frame(crs).name
    datum = "a CRS without a datum" if datum == "unknown" else datum
    missing = next((m for operations in known.values() if (m := operations.describe_lacking(crs))), "")
    found = [(code, operations.usable[0]) for code, operations in known.items() if operations.usable]
    code, best = min(found, key=lambda item: rank_operation(item[1]), default=("", None))
    accuracy = _accuracy(crs, known[code].usable, box) if best is not None else np.nan
    if best is None or accuracy > WORST_M:
        where = f"latitude {(box[0] + box[1]) / 2.0:.2f}, longitude {(box[2] + box[3]) / 2.0:.2f}"
        why = f"; {missing}" if missing else ""
        return (
            f"PROJ has no installed operation from {datum} to a modern frame at {where}{why}"
            f"{'; or ' if missing else '; '}give a map in WGS 84 or a modern frame of the region"
        )
    lacking = [
        o for operations in known.values() for o in operations.lacking
        if not known_accuracy_m(o.accuracy) >= _BETTER * accuracy
    ]  # fmt: skip
    better = Operations(usable=(), lacking=tuple(lacking)).describe_lacking(crs)
    to, name = CRS.from_user_input(code).name, name_operation(best.description, crs)
    size = f"accuracy {accuracy:g} m" if np.isfinite(accuracy) else "accuracy unknown"
    area = "" if best.area_of_use is None else f", of {shorten(best.area_of_use.name, 60)}"
    note = f"map: {datum} is transformed to {to} by PROJ's {name!r} ({size}{area})"
    return _Chosen(
        transformer=best,
        frame=code,
        name=name,
        accuracy_m=accuracy,
        note=note + (f"; better: {better}" if better else ""),
    )


def _targets(crs: str, box: Box) -> Iterable[str]:
    """Return the modern frames to which a map may be transformed: the frames of its region, then WGS 84."""
    if get_geodetic_frame(crs).name == TRANSIT:  # ITRF90, to which the transformation is known
        return ("EPSG:7902",)
    if find_crs(crs).is_bound:  # +towgs84
        return ("EPSG:4326",)
    areas = {code: CRS.from_user_input(code).area_of_use for code in REGIONAL.values()}
    return (*(code for code, area in areas.items() if contains(area, box)), "EPSG:4326")


def _accuracy(crs: str, usable: tuple[Transformer, ...], box: Box) -> float:
    """Return the accuracy of the first operation [m]: PROJ's value, or a larger one implied by other operations.

    The first operation may be wrong by the difference of its result from another operation's result, minus the accuracy
    of the other operation. The result is NaN if PROJ states no accuracy for the first operation.
    """
    stated = usable[0].accuracy if usable[0].accuracy >= 0.0 else np.nan
    conversion, unit, origin = _to_datum(crs)
    middle = ((box[2] + box[3]) / 2.0 - origin) / unit, (box[0] + box[1]) / 2.0 / unit
    x, y = conversion.transform(*middle, direction="INVERSE")
    places = np.array([operation.transform(x, y)[:2] for operation in usable])
    points = ecef_from_geodetic(places[:, 1], places[:, 0], np.zeros(len(places)))
    apart = np.linalg.norm(points - points[0], axis=1)
    own = np.array([known_accuracy_m(operation.accuracy) for operation in usable])
    worst = float(np.max(np.where(np.isfinite(apart), apart - own, 0.0), initial=0.0))
    return stated if not worst > stated else float(np.ceil(10.0 * worst) / 10.0)


def _check_area(crs: str, latitude_deg: Floats, longitude_deg: Floats, *, path: str) -> None:
    """Raise InputFileError for points outside the area of use of a CRS's geodetic frame.

    The area of use of the projection is not checked, because projections are also used outside their areas.
    """
    south, north, west, east = _bounds(crs)
    of_latitude = south <= latitude_deg.min() and latitude_deg.max() <= north
    if of_latitude and west <= longitude_deg.min() and longitude_deg.max() <= east:
        return
    finite = np.isfinite(latitude_deg) & np.isfinite(longitude_deg) & (np.abs(latitude_deg) <= 90.0)
    if not finite.all():
        raise InputFileError(
            path, f"some coordinates are outside the CRS {crs}; give the right CRS (--crs), in the unit of the file"
        )
    geodetic = get_geodetic_frame(crs)
    outside, area = ~is_in_area(geodetic, latitude_deg, longitude_deg, margin_deg=MARGIN_DEG), geodetic.area_of_use
    if area is None or not outside.any():
        return
    lat, lon = latitude_deg[outside][:1], longitude_deg[outside][:1]
    swapped = find_crs(crs).is_geographic and is_in_area(geodetic, lon, lat, margin_deg=MARGIN_DEG).all()
    raise InputFileError(
        path,
        f"latitude {lat[0]:.4f}, longitude {lon[0]:.4f} is outside the area of use of {geodetic.name} (latitude "
        f"{area.south:g} to {area.north:g}, longitude {area.west:g} to {area.east:g}); "
        + ("latitude and longitude are swapped" if swapped else f"check whether {crs} is the right CRS"),
    )


@lru_cache(maxsize=64)
def _bounds(crs: str) -> Box:
    """Return the area of use of a CRS's geodetic frame, extended by `MARGIN_DEG`; an empty box if unknown."""
    area = get_geodetic_frame(crs).area_of_use
    if area is None:
        return (np.inf, -np.inf, np.inf, -np.inf)
    return (area.south - MARGIN_DEG, area.north + MARGIN_DEG, area.west - MARGIN_DEG, area.east + MARGIN_DEG)


def _check_scale(crs: str, xy: Floats, latitude: Floats, longitude: Floats, *, path: str) -> None:
    """Raise InputFileError if the line's lengths in the grid and on the ground differ.

    Different lengths show that the coordinates belong to another grid.
    """
    system = find_crs(crs)
    method = "" if system.coordinate_operation is None else system.coordinate_operation.method_name
    if len(xy) < 2 or method in _UNEVEN:
        return
    unit = system.axis_info[0].unit_conversion_factor
    grid = float(np.hypot(*np.diff(xy, axis=0).T).sum()) * unit
    ellipsoid = get_geodetic_frame(crs).get_geod()
    ground = float(ellipsoid.line_length(longitude, latitude)) if ellipsoid is not None else grid
    if ground > 0.0 and abs(grid / ground - 1.0) > LARGEST_SCALE:
        raise InputFileError(
            path,
            f"the line is {grid:.0f} m long in {system.name}, but {ground:.0f} m on the ground; the "
            "coordinates belong to another grid: give the right crs (--crs)",
        )


@lru_cache(maxsize=32)
def _to_datum(crs: str) -> tuple[Transformer, float, float]:
    """Return the conversion of a CRS to angles on its datum, the unit of the angles, and the prime meridian [deg]."""
    system, datum = find_crs(crs), CRS.from_user_input(_find_frame(crs)).to_2d()
    plan = system.source_crs if system.is_bound and system.source_crs is not None else system
    meridian = datum.prime_meridian
    origin = 0.0 if meridian is None else meridian.longitude * np.degrees(meridian.unit_conversion_factor)
    conversion = Transformer.from_crs(plan.to_2d(), datum, always_xy=True)
    return conversion, float(np.degrees(datum.axis_info[0].unit_conversion_factor)), float(origin)


def _in_degrees(crs: str, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Convert coordinates in a CRS to latitude and longitude on the datum of the CRS, shape (n,) each [deg]."""
    conversion, unit, origin = _to_datum(crs)
    longitude, latitude = (np.asarray(v, np.float64) for v in conversion.transform(x, y))
    return (latitude, longitude) if (unit, origin) == (1.0, 0.0) else (latitude * unit, longitude * unit + origin)


@lru_cache(maxsize=32)
def _find_frame(crs: str) -> str:
    geodetic = get_geodetic_frame(crs)
    authority = geodetic.to_authority()
    return geodetic.to_wkt() if authority is None else ":".join(authority)
