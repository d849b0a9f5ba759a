"""Lines of map files of geographic information systems, read through GDAL by `pyogrio`.

GeoPackage, Shapefile, FlatGeobuf, GML, GPX, KML, DXF, OpenStreetMap and GeoJSON; each line of each layer is a
segment, without heights where its coordinates have none.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import ending
from railfix.track.crs import frame_degrees, older_datum_note, used_crs
from railfix.track.heights import check_height_datum, stated_heights
from railfix.track.segment import ATTRIBUTES, NO_HEIGHTS, MapReading, Segment
from railfix.track.track import UNNAMED

#: Endings of files that are read here.
ENDINGS: Final = (".gpkg", ".shp", ".fgb", ".gml", ".gpx", ".kml", ".dxf", ".osm", ".pbf")
INSTALL: Final = "install it with: pip install 'railfix[maps]'"
#: Columns that name a line, in this order.
_NAMES: Final = ("name", "id", "track_id", "line", "osm_id", "fid")
#: Values of OpenStreetMap's tag railway that are tracks on which trains run.
_OSM_RAILWAYS: Final = ("rail", "light_rail", "subway", "tram", "narrow_gauge", "preserved", "monorail")


def read_layers(path: str | PathLike[str], *, geometry: str) -> list[tuple[str | None, list[dict[str, Any]], Any]]:
    """Read all features of a kind of geometry ("LineString", "Point"); multi-part lines are taken apart.

    One entry a layer: CRS or None, properties of each feature, shapely geometries. InputFileError: when pyogrio is
    missing, or GDAL cannot read the file.
    """
    try:
        import pyogrio
        import shapely
    except ImportError:
        raise InputFileError(path, f"reading {ending(path)} maps needs pyogrio and shapely; {INSTALL}") from None
    layers = []
    try:
        for layer, _ in pyogrio.list_layers(path):
            meta, _, blob, values = pyogrio.raw.read(path, layer=layer)
            if blob is None:
                continue
            shapes = np.asarray(shapely.from_wkb(blob), dtype=object)
            usable = [k for k, s in enumerate(shapes) if s is not None and s.geom_type.endswith(geometry)]
            fields = [str(name) for name in meta["fields"]]
            rows = [{name: column[k] for name, column in zip(fields, values, strict=True)} for k in usable]
            if usable:
                layers.append((meta["crs"], rows, shapes[usable]))
    except pyogrio.errors.DataSourceError as error:
        raise InputFileError(path, f"GDAL cannot read this file ({str(error).splitlines()[0]})") from None
    return layers


def read_vector_segments(path: str | PathLike[str], reading: MapReading) -> list[Segment]:
    """Read the lines of a map file as segments, in the order of the file.

    The CRS is that of a file without one (an error where the file names another one); height datum and geoid are those
    of coordinates with heights: a segment whose heights are all 0 counts as one without. InputFileError, SettingsError.
    """
    check_height_datum(reading.height_datum)
    segments: list[Segment] = []
    for named, rows, shapes in read_layers(path, geometry="LineString"):
        of_layer = replace(reading, crs=used_crs(path, reading.crs, named))
        for row, shape in zip(rows, shapes, strict=True):
            if not _is_track(row):
                continue
            for k, part in enumerate(shape.geoms if shape.geom_type.startswith("Multi") else [shape]):
                name = _name(row, fallback=f"line {len(segments) + 1}") + (f", part {k + 1}" if k else "")
                points = np.array(part.coords, dtype=np.float64)
                segments.append(plan_segment(points, of_layer, path=str(path), name=name))
    if not segments:
        raise InputFileError(path, "there is no line in this file; a track map needs LineStrings")
    return segments


def plan_segment(coordinates: Floats, reading: MapReading, *, path: str, name: str) -> Segment:
    """A segment of coordinates in map order, shape (n, 2 or 3); points repeated in plan are left out."""
    source = f"{path} ({name})"
    if not np.isfinite(coordinates[:, :2]).all():
        raise InputFileError(source, "a coordinate is not finite")
    kept = np.concatenate([[True], (np.diff(coordinates[:, :2], axis=0) != 0.0).any(axis=1)])
    values = coordinates[kept]
    if len(values) < 2:
        raise InputFileError(source, "a track needs at least two different points")
    crs = reading.crs
    used = crs or "EPSG:4326"
    latitude, longitude, frame = frame_degrees(used, values[:, 0], values[:, 1])
    if not (np.isfinite(latitude).all() and np.isfinite(longitude).all() and (np.abs(latitude) <= 90.0).all()):
        raise InputFileError(source, f"some coordinates lie outside the CRS {used}; is it the right one?")
    height, model, datum = np.full(len(values), np.nan), "", NO_HEIGHTS
    if values.shape[1] == 3 and np.isfinite(values[:, 2]).all() and values[:, 2].any():
        height, model, datum = stated_heights(values[:, 2], latitude, longitude, reading, path=source)
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
        metadata={"name": name},
        notes=older_datum_note(crs),
        **{key: np.full(len(values), np.nan) for key in ATTRIBUTES},
    )


def _name(row: Mapping[str, Any], *, fallback: str) -> str:
    lower = {key.lower(): value for key, value in row.items()}
    for key in _NAMES:
        value = lower.get(key)
        if value is not None and value == value and str(value) not in ("", "nan"):
            return str(value)
    return fallback


def _is_track(row: Mapping[str, Any]) -> bool:
    """Whether a feature is a track: of OpenStreetMap those tagged as railways, else all lines."""
    if "osm_id" not in row:
        return True
    tags = str(row.get("other_tags") or "")
    railway = row.get("railway")
    if railway is None and '"railway"=>"' in tags:
        railway = tags.split('"railway"=>"', 1)[1].split('"', 1)[0]
    return railway in _OSM_RAILWAYS


def geojson_has_heights(text: str) -> bool:
    """Whether the coordinates of a GeoJSON document have three numbers; True for what is no GeoJSON."""
    try:
        node = json.loads(text)
    except (json.JSONDecodeError, RecursionError):
        return True
    return any(len(point) > 2 for point in _points(node)) or not _points(node)


def _points(node: Any) -> Sequence[Sequence[float]]:
    if isinstance(node, dict):
        if node.get("type") == "LineString" and isinstance(node.get("coordinates"), list):
            return [p for p in node["coordinates"] if isinstance(p, list)]
        parts = [*(node.get("features") or []), node.get("geometry")]
        if node.get("type") == "MultiLineString":
            return [p for line in node.get("coordinates") or [] for p in line if isinstance(p, list)]
        return [point for part in parts for point in _points(part)]
    return []
