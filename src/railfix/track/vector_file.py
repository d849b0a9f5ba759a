"""Lines of map files of geographic information systems, read through GDAL by `pyogrio`.

GeoPackage, Shapefile, FlatGeobuf, GML, GPX, KML, DXF and OpenStreetMap; each line of each layer is a
segment, without heights where its coordinates have none.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from os import PathLike
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import ending, open_stream
from railfix.track.crs import frame_degrees, older_datum_note, unit_of_heights, used_crs
from railfix.track.heights import check_height_datum, stated_heights
from railfix.track.openstreetmap import is_of_openstreetmap, metadata_of, no_track, read_osm_xml, with_left_out
from railfix.track.segment import ATTRIBUTES, NO_HEIGHTS, MapReading, Segment
from railfix.track.track import UNNAMED

#: Endings of files that are read here.
ENDINGS: Final = (".gpkg", ".shp", ".fgb", ".gml", ".gpx", ".kml", ".dxf", ".osm", ".pbf")
INSTALL: Final = "install it with: pip install 'railfix[maps]'"
#: Bytes of a text file that are looked at before GDAL reads it.
_LOOKED_AT: Final = 1 << 20
#: Columns that name a line, in this order.
_NAMES: Final = ("name", "id", "track_id", "line", "osm_id", "@id", "fid")


def read_layers(path: str | PathLike[str], *, geometry: str) -> list[tuple[str | None, list[dict[str, Any]], Any]]:
    """Read all features of a kind of geometry ("LineString"), or whatever their geometry ("none").

    One entry a layer: CRS or None, properties of each feature, shapely geometries. InputFileError: when pyogrio is
    missing, or GDAL cannot read the file.
    """
    try:
        import pyogrio
        import shapely
    except ImportError:
        raise InputFileError(path, f"reading {ending(path)} maps needs pyogrio and shapely; {INSTALL}") from None
    _check_text(path)
    layers = []
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Measured", UserWarning)  # measures are no heights and not read
            found = [
                pyogrio.raw.read(path, layer=layer, read_geometry=geometry != "none")
                for layer, _ in pyogrio.list_layers(path)
            ]
        for meta, _, blob, values in found:
            if blob is None and geometry != "none":
                continue
            size = len(values[0]) if len(values) else 0
            with np.errstate(invalid="ignore"):  # of NaN, which is rejected later
                shapes = np.full(size, None) if blob is None else np.asarray(shapely.from_wkb(blob), dtype=object)
            usable = [k for k, s in enumerate(shapes) if geometry == "none" or (s and s.geom_type.endswith(geometry))]
            fields = [str(name) for name in meta["fields"]]
            rows = [{name: column[k] for name, column in zip(fields, values, strict=True)} for k in usable]
            if usable:
                layers.append((meta["crs"], rows, shapes[usable]))
    except (pyogrio.errors.DataSourceError, pyogrio.errors.FeatureError) as error:
        raise InputFileError(path, f"GDAL cannot read this file ({str(error).splitlines()[0]})") from None
    return layers


def _check_text(path: str | PathLike[str]) -> None:
    """Reject coordinates that GDAL reads as others: decimal commas, heights above the ground."""
    kind = ending(path)
    if kind not in (".gpx", ".kml"):
        return
    with open_stream(path, content="bytes") as stream:
        text = stream.read(_LOOKED_AT)
    if comma := re.search(rb"""\bl(?:at|on)\s*=\s*["'][-+\d]+,\d*""", text):
        raise InputFileError(path, f"{comma[0].decode()}: has a comma in a number; a point was expected")
    if mode := re.search(rb"<altitudeMode>\s*(relativeTo\w+|clampTo\w+)\s*<", text):
        raise InputFileError(
            path, f"its altitudeMode is {mode[1].decode()}, no height of the track; write absolute heights or none"
        )


def read_vector_segments(path: str | PathLike[str], reading: MapReading) -> list[Segment]:
    """Read the lines of a map file as segments, in the order of the file.

    The CRS is that of a file without one (an error where the file names another one); height datum and geoid are those
    of coordinates with heights: a segment whose heights are all 0 counts as one without. InputFileError, SettingsError.
    """
    check_height_datum(reading.height_datum)
    segments: list[Segment] = []
    left_out: Counter[str] = Counter()
    for named, rows, parts in _features(path):
        of_layer = replace(reading, crs=used_crs(path, reading.crs, named))
        for row, lines in zip(rows, parts, strict=True):
            if why := no_track(row, of_openstreetmap=is_of_openstreetmap(row)):
                left_out[why] += 1
                continue
            stated = metadata_of(row) | _accuracy(row)
            own = stated.get("name") or name_of(row, fallback=f"line {len(segments) + 1}")
            for k, points in enumerate(lines):
                name = own + (f", part {k + 1}" if k else "")
                segments.append(plan_segment(points, of_layer, path=str(path), name=name, stated=stated))
    return with_left_out(path, segments, left_out)


def _features(
    path: str | PathLike[str],
) -> Iterator[tuple[str | None, list[dict[str, Any]], list[list[Floats]]]]:
    """CRS, columns and lines of the features of each layer; of OSM XML without GDAL, which needs sorted nodes."""
    if ending(path) == ".osm":
        ways = read_osm_xml(path)
        yield "EPSG:4326", [way.row for way in ways], [[way.points_deg] for way in ways]
        return
    for named, rows, shapes in read_layers(path, geometry="LineString"):
        lines = [s.geoms if s.geom_type.startswith("Multi") else [s] for s in shapes]
        yield named, rows, [[np.array(part.coords, dtype=np.float64) for part in own] for own in lines]


def _accuracy(row: Mapping[str, Any]) -> dict[str, str]:
    """Accuracy that a feature states."""
    keys = ("sigma_plan_m", "sigma_height_m")
    return {key: str(row[key]) for key in keys if row.get(key) is not None and row[key] == row[key]}


def plan_segment(
    coordinates: Floats, reading: MapReading, *, path: str, name: str, stated: Mapping[str, str] | None = None
) -> Segment:
    """A segment of coordinates in map order, shape (n, 2 or 3); points repeated in plan are left out.

    `stated` is the accuracy that the file states.
    """
    source = f"{path} ({name})"
    if not np.isfinite(coordinates[:, :2]).all():
        raise InputFileError(source, "a coordinate is not finite")
    kept = np.concatenate([[True], (np.diff(coordinates[:, :2], axis=0) != 0.0).any(axis=1)])
    values = coordinates[kept]
    if len(values) < 2:
        raise InputFileError(source, "a track needs at least two different points")
    crs = reading.crs
    if crs is None and (np.abs(values[:, :2]) > (360.0, 90.0)).any():
        raise InputFileError(source, "names no CRS, and its coordinates are no degrees; give --crs")
    used = crs or "EPSG:4326"
    latitude, longitude, frame = frame_degrees(used, values[:, 0], values[:, 1], path=source)
    height, model, datum = np.full(len(values), np.nan), "", NO_HEIGHTS
    known = np.isfinite(values[:, 2]) if values.shape[1] == 3 else np.zeros(len(values), dtype=np.bool_)
    if known.any() and not known.all():
        raise InputFileError(
            source,
            f"{int((~known).sum())} of {len(known)} points have no height, the first is point {np.argmin(known) + 1}; "
            "mend them, or write the line without heights",
        )
    if known.any() and values[:, 2].any():
        height, model, datum = stated_heights(
            values[:, 2] * unit_of_heights(crs), latitude, longitude, reading, path=source
        )
    return Segment(
        source=source,
        file=path,
        latitude_deg=latitude,
        longitude_deg=longitude,
        height_m=height,
        crs=crs or UNNAMED,
        frame=frame if crs else "EPSG:4979",
        height_datum=datum,
        geoid=model,
        metadata={**(stated or {}), "name": name},
        notes=older_datum_note(crs),
        **dict.fromkeys(ATTRIBUTES, np.full(len(values), np.nan)),
    )


def name_of(row: Mapping[str, Any], *, fallback: str) -> str:
    """Name of a feature by the first of `_NAMES` that it has."""
    lower = {key.lower(): value for key, value in row.items()}
    for key in _NAMES:
        value = lower.get(key)
        if value is not None and value == value and str(value) not in ("", "nan"):
            return str(value)
    return fallback
