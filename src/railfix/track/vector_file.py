"""Lines of map files of geographic information systems, read through GDAL by `pyogrio`.

GeoPackage, Shapefile, FlatGeobuf, GML, GPX, KML, DXF and OpenStreetMap; each line of each layer is a
segment, without heights where its coordinates have none.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from os import PathLike
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import ending, open_stream
from railfix.track.crs import frame_degrees, older_datum_note, unit_of_heights, used_crs
from railfix.track.heights import check_height_datum, stated_heights
from railfix.track.segment import ATTRIBUTES, NO_HEIGHTS, MapReading, Segment
from railfix.track.track import UNNAMED

#: Endings of files that are read here.
ENDINGS: Final = (".gpkg", ".shp", ".fgb", ".gml", ".gpx", ".kml", ".dxf", ".osm", ".pbf")
INSTALL: Final = "install it with: pip install 'railfix[maps]'"
#: Bytes of a text file that are looked at before GDAL reads it.
_LOOKED_AT: Final = 1 << 20
#: Columns that name a line, in this order.
_NAMES: Final = ("name", "id", "track_id", "line", "osm_id", "@id", "fid")
#: Values of OpenStreetMap's tag railway that are tracks on which trains run.
_OSM_RAILWAYS: Final = ("rail", "light_rail", "subway", "tram", "narrow_gauge", "preserved", "monorail")
#: Values of that tag that are no such tracks, by which a feature of OpenStreetMap is known.
_OSM_OTHERS: Final = (
    "abandoned", "construction", "disused", "dismantled", "demolished", "funicular", "historic", "loading_ramp",
    "miniature", "planned", "platform", "platform_edge", "proposed", "razed", "removed", "station", "traverser",
    "turntable", "yard",
)  # fmt: skip


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
    if kind not in (".osm", ".gpx", ".kml"):
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
    for named, rows, shapes in read_layers(path, geometry="LineString"):
        of_layer = replace(reading, crs=used_crs(path, reading.crs, named))
        for row, shape in zip(rows, shapes, strict=True):
            if why := no_track(row, of_openstreetmap=is_of_openstreetmap(row)):
                left_out[why] += 1
                continue
            for k, part in enumerate(shape.geoms if shape.geom_type.startswith("Multi") else [shape]):
                name = name_of(row, fallback=f"line {len(segments) + 1}") + (f", part {k + 1}" if k else "")
                points = np.array(part.coords, dtype=np.float64)
                segments.append(plan_segment(points, of_layer, path=str(path), name=name, stated=_accuracy(row)))
    notes = left_out_note(path, left_out)
    segments[:1] = [replace(s, notes=(*s.notes, *notes)) for s in segments[:1]]
    if not segments:
        why = "".join(f" ({note})" for note in notes)
        raise InputFileError(path, f"there is no line in this file; a track map needs LineStrings{why}")
    return segments


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
        metadata={"name": name, **(stated or {})},
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


def no_track(row: Mapping[str, Any], *, of_openstreetmap: bool) -> str:
    """Why a feature is no track: of OpenStreetMap those not tagged as railways that run; empty for tracks."""
    railway = _railway(row)
    if railway in _OSM_RAILWAYS or not (of_openstreetmap or railway in _OSM_OTHERS):
        return ""
    return f"railway={railway}" if railway else "no railway"


def is_of_openstreetmap(row: Mapping[str, Any]) -> bool:
    """Whether a feature is one of OpenStreetMap, as GDAL, osmtogeojson and Overpass write them."""
    names = (str(row.get(key) or "") for key in ("@id", "id"))
    return "osm_id" in row or any(re.fullmatch(r"(way|relation|node)/\d+", name) for name in names)


def _railway(row: Mapping[str, Any]) -> str | None:
    tags, railway = row.get("other_tags"), row.get("railway")
    if railway is None and isinstance(row.get("tags"), dict):
        railway = row["tags"].get("railway")
    if railway is None and isinstance(tags, str) and '"railway"=>"' in tags:
        railway = tags.split('"railway"=>"', 1)[1].split('"', 1)[0]
    return railway if isinstance(railway, str) and railway else None


def left_out_note(path: str | PathLike[str], reasons: Counter[str]) -> tuple[str, ...]:
    """A note on the lines of a file that are no tracks."""
    if not reasons:
        return ()
    return (f"{path}: lines left out that are no tracks: " + ", ".join(f"{n} {why}" for why, n in reasons.items()),)
