"""Reader of lines in map files of geographic information systems (through GDAL), and of OpenStreetMap files.

OpenStreetMap ways are recognised by their ids and tags (https://wiki.openstreetmap.org/wiki/Key:railway). Export
programs write the tags as columns, as an object or JSON text (`tags`), as hstore text (`other_tags` of GDAL), or as a
class (`fclass` in the shapefiles of Geofabrik). These programs write the id in many forms.
"""

from __future__ import annotations

import json
import re
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, Final
from xml.etree.ElementTree import ParseError, iterparse

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.extras import needs_extra
from railfix.core.files import FilePath, open_stream, unpacked_file
from railfix.io.file_kind import KIND_WORDS, find_kind
from railfix.io.xml_lines import read_gpx_lines, read_kml_lines
from railfix.track.crs import choose_crs, unit_of_heights
from railfix.track.georeference import georeference
from railfix.track.heights import check_height_datum, heights_of_file
from railfix.track.route import MapReading, Segment, make_segment

#: Assumed standard deviation in plan [m] of OpenStreetMap tracks, which are drawn from aerial images.
SIGMA_M: Final = 2.0
ORIGIN: Final = {"origin": "OpenStreetMap"}  #: Metadata entry of a segment from OpenStreetMap.
#: Values of the tag `railway` for tracks in use.
_RAILWAYS: Final = ("rail", "light_rail", "subway", "tram", "narrow_gauge", "preserved", "monorail", "rack")
#: Values of the tag `railway` for other features, which are not tracks in use.
_OTHERS: Final = (
    "abandoned", "construction", "disused", "dismantled", "demolished", "funicular", "historic", "loading_ramp",
    "miniature", "planned", "platform", "platform_edge", "proposed", "razed", "removed", "station", "traverser",
    "turntable", "yard",
)  # fmt: skip
#: Columns that can contain the id of a feature. The first four are written only by OpenStreetMap export programs.
_IDS: Final = ("osm_id", "osmid", "osm_way_id", "full_id", "@id", "id")
_KINDS: Final = ("@type", "osm_type", "element_type", "element", "type")
_ID: Final = re.compile(r"[^\w-]*(way|relation|[wr])?[^\w-]*(-?\d+)\)?")
_HSTORE: Final = re.compile(r'"((?:[^"\\]|\\.)*)"=>"((?:[^"\\]|\\.)*)"')


CROSSING: Final = "x"  #: Prefix of the id of a node at which tracks cross without a connection.
_LEFT_OUT: Final = "@left out"  #: Key in `Way.row` for the reason why a way with valid tags is left out.


@dataclass(frozen=True, kw_only=True)
class Way:
    """Way of an OpenStreetMap file."""

    row: dict[str, Any]  #: Tags and id of the way.
    points_deg: np.ndarray[Any, np.dtype[np.float64]]  #: Longitude and latitude of the points, shape (n, 2).
    #: Node ids of the points; empty if the file has no node ids. The id of a crossing without a connection begins with
    #: `CROSSING`.
    nodes: tuple[str, ...] = ()


def get_tags(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of a feature, with its OpenStreetMap tags added."""
    tags = dict(row)
    for name in ("tags", "all_tags", "other_tags"):
        value = row.get(name)
        if isinstance(value, str) and value.lstrip().startswith("{"):
            try:
                value = json.loads(value)
            except json.JSONDecodeError:
                continue
        elif isinstance(value, str):
            value = dict(_HSTORE.findall(value))
        if isinstance(value, Mapping):
            tags |= {key: text for key, text in value.items() if tags.get(key) in (None, "")}
    if tags.get("railway") in (None, ""):
        classes = (tags.get(key) for key in ("fclass", "type"))
        tags["railway"] = next((c for c in classes if c in _RAILWAYS or c in _OTHERS), None)
    return tags


def is_of_openstreetmap(row: Mapping[str, Any]) -> bool:
    """Return whether the id or the element kind of a feature shows that the feature is from OpenStreetMap."""
    names = (str(row.get(key) or "") for key in ("@id", "id"))
    of_id = any(row.get(key) is not None for key in _IDS[:4])
    of_kind = any(row.get(key) in ("way", "relation") for key in _KINDS)
    return of_id or of_kind or any(re.fullmatch(r"(way|relation|node)/\d+|[wrn]\d+", name) for name in names)


def no_track(row: Mapping[str, Any], *, of_openstreetmap: bool) -> str:
    """Return the reason why a feature is not a track in use, or "" if it is a track in use.

    Features from OpenStreetMap must have the tag of a railway in use; other features need no tag.
    """
    if row.get(_LEFT_OUT):
        return str(row[_LEFT_OUT])
    railway = get_tags(row).get("railway")
    railway = railway if isinstance(railway, str) and railway else None
    if railway in _RAILWAYS or not (of_openstreetmap or railway in _OTHERS):
        return ""
    return f"railway={railway}" if railway else "no railway"


def get_metadata(row: Mapping[str, Any]) -> dict[str, str]:
    """Return the origin, name ("way/7 Main Line") and non-zero level of a feature from OpenStreetMap.

    Name and level require an id. If a feature is not recognised as from OpenStreetMap, only the origin is returned,
    provided that the feature has the tag of a railway in use.
    """
    tags = get_tags(row)
    if not is_of_openstreetmap(row):
        return ORIGIN if tags.get("railway") in _RAILWAYS else {}
    found = next((m for key in _IDS if (m := _ID.fullmatch(str(tags.get(key) or "")))), None)
    if found is None:
        return ORIGIN
    kind = "relation" if str(found[1]).startswith("r") else "way"
    level = {"level": str(find_level(tags))} if find_level(tags) else {}
    words = [f"{kind}/{found[2]}", *(str(tags[key]) for key in ("name", "ref") if tags.get(key))]
    return {"name": " ".join(words[:2]), **ORIGIN, **level}


def find_level(tags: Mapping[str, Any]) -> int:
    """Return the level of a way from the tags `layer`, `bridge` and `tunnel`; the ground has level 0."""
    try:
        return int(str(tags.get("layer") or ""))
    except ValueError:
        above = tags.get("bridge") not in (None, "", "no")
        return int(above) - int(tags.get("tunnel") not in (None, "", "no"))


def with_left_out(path: FilePath, segments: list[Segment], reasons: Counter[str]) -> list[Segment]:
    """Add to the first segment a note on the lines that were left out, and return the segments.

    Raise InputFileError if there is no segment.
    """
    left_out = ", ".join(f"{n} {why}" for why, n in reasons.items())
    note = f"{path}: these lines are not tracks and are left out: {left_out}"
    if not segments:
        why = f" ({note})" if reasons else ""
        raise InputFileError(path, f"there is no track in this file; LineStrings were expected{why}")
    return [replace(segments[0], notes=(*segments[0].notes, note)), *segments[1:]] if reasons else segments


def read_osm_xml(path: FilePath) -> list[Way]:
    """Read the railway ways of an OSM XML file; the elements can be in any order.

    Raise InputFileError if the file is not XML or has no railway way.
    """
    nodes: dict[str, tuple[float, float]] = {}
    crossings: set[str] = set()
    ways: list[tuple[dict[str, Any], list[Any]]] = []
    try:
        with open_stream(path, content="bytes") as stream:
            for _, element in iterparse(stream):
                kind = element.tag
                if kind == "node":
                    nodes[str(element.get("id"))] = _place(path, element.get("lon"), element.get("lat"))
                    if any(_is_crossing({tag.get("k"): tag.get("v")}) for tag in element.iterfind("tag")):
                        crossings.add(str(element.get("id")))
                elif kind == "way":
                    row = {str(tag.get("k")): tag.get("v") for tag in element.iterfind("tag")}
                    if row.get("railway"):
                        points = [nd.get("ref") if nd.get("lat") is None else _place(path, nd.get("lon"), nd.get("lat"))
                                  for nd in element.iterfind("nd")]  # fmt: skip
                        ways.append((row | {"@id": f"way/{element.get('id')}"}, points))
                if kind in ("node", "way", "relation"):
                    element.clear()
    except ParseError as error:
        raise InputFileError(path, f"this is not XML ({error})") from None
    return _ways(path, ways, nodes, crossings)


def _is_crossing(tags: Mapping[Any, Any]) -> bool:
    """Return whether a node is a crossing of unconnected tracks (no slip switch)."""
    return tags.get("railway") == "railway_crossing" and not tags.get("railway:switch")


def read_overpass(path: str, elements: Any) -> list[Way]:
    """Read the railway ways from the elements of an Overpass JSON file.

    Each way must have a geometry (`out geom`), or its nodes must be in the file. Raise InputFileError if elements are
    not valid or there is no railway way.
    """
    if not isinstance(elements, list) or not all(isinstance(e, dict) for e in elements):
        raise InputFileError(path, "'elements' must be a list of objects, as in Overpass files")
    nodes = {str(e["id"]): _place(path, e.get("lon"), e.get("lat")) for e in elements if e.get("type") == "node"}
    crossings = {str(e["id"]) for e in elements if e.get("type") == "node" and _is_crossing(e.get("tags") or {})}
    ways = []
    for element in elements:
        if element.get("type") != "way" or not (element.get("tags") or {}).get("railway"):
            continue
        points: list[Any] = [str(ref) for ref in element.get("nodes") or []]
        if geometry := element.get("geometry"):
            points = [None if p is None else _place(path, p.get("lon"), p.get("lat")) for p in geometry]
        ways.append((element["tags"] | {"@id": f"way/{element.get('id')}"}, points))
    return _ways(path, ways, nodes, crossings)


def _place(path: FilePath, lon: Any, lat: Any) -> tuple[float, float]:
    for text in (lon, lat):
        if "," in str(text):
            raise InputFileError(path, f"{text} has a comma in a number; a decimal point was expected")
    try:
        return float(lon), float(lat)
    except (TypeError, ValueError):
        raise InputFileError(path, f"a node has longitude {lon!r}, latitude {lat!r}; numbers were expected") from None


def _ways(
    path: FilePath,
    ways: Iterable[tuple[dict[str, Any], list[Any]]],
    nodes: Mapping[str, tuple[float, float]],
    crossings: Set[str],
) -> list[Way]:
    """Return ways with points; a way that is partly outside the file's area is divided into parts.

    A way without two successive known points is returned without points, but with a reason (`_LEFT_OUT`). Raise
    InputFileError if no way has two successive points.
    """
    found, short = [], []
    for row, refs in ways:
        points = [(ref, nodes.get(ref)) if isinstance(ref, str) else ("", ref) for ref in refs]
        parts = [list(part) for inside, part in groupby(points, key=lambda p: p[1] is not None) if inside]
        if not any(len(part) > 1 for part in parts):
            why = f"{row['@id']} (the file has {sum(map(len, parts))} of its {len(refs)} nodes)"
            short.append(Way(row={**row, _LEFT_OUT: why}, points_deg=np.empty((0, 2))))
        for part in (part for part in parts if len(part) > 1):
            ids = tuple(f"{CROSSING}{ref}" if ref in crossings else ref for ref, _ in part)
            places = np.array([place for _, place in part], dtype=np.float64)
            found.append(Way(row=row, points_deg=places, nodes=ids if all(ids) else ()))
    if not found and short:
        raise InputFileError(path, f"{short[0].row[_LEFT_OUT]}; also request the nodes from Overpass (out geom;)")
    if not found:
        raise InputFileError(path, "none of the ways in this file has the tag 'railway'")
    return [*found, *short]


#: Columns that can contain the name of a line, the preferred column first.
_NAMES: Final = ("name", "id", "track_id", "line", "osm_id", "@id", "fid")


def read_layers(path: FilePath, *, geometry: str) -> list[tuple[str | None, list[dict[str, Any]], Any]]:
    """Read the features of each layer of a file through GDAL.

    Return the CRS of each layer, and the properties and geometries of its features. Only features whose geometry type
    ends with `geometry` ("LineString") are read. If `geometry` is "none", all features are read without geometry. Raise
    InputFileError if GDAL cannot read the file.
    """
    with needs_extra(f"{path}: {KIND_WORDS[find_kind(path)]}"):
        import pyogrio
        import shapely
    layers = []
    pyogrio.set_gdal_config_options({"OSM_USE_CUSTOM_INDEXING": "NO"})  # ids of nodes in .osm.pbf may be negative
    try:
        with warnings.catch_warnings():
            # measures (M values) are not heights, and are not used
            warnings.filterwarnings("ignore", "Measured", UserWarning)
            with unpacked_file(path) as file:
                found = [
                    pyogrio.raw.read(file, layer=layer, read_geometry=geometry != "none")
                    for layer, _ in pyogrio.list_layers(file)
                ]
        for meta, _, blob, values in found:
            if blob is None and geometry != "none":
                continue
            size = len(values[0]) if len(values) else 0
            with np.errstate(invalid="ignore"):  # NaN is rejected later
                shapes = np.full(size, None) if blob is None else np.asarray(shapely.from_wkb(blob), dtype=object)
            usable = [k for k, s in enumerate(shapes) if geometry == "none" or (s and s.geom_type.endswith(geometry))]
            fields = [str(name) for name in meta["fields"]]
            rows = [{name: column[k] for name, column in zip(fields, values, strict=True)} for k in usable]
            if usable:
                layers.append((meta["crs"], rows, shapes[usable]))
    except (pyogrio.errors.DataSourceError, pyogrio.errors.FeatureError) as error:
        raise InputFileError(path, f"GDAL cannot read this file ({str(error).splitlines()[0]})") from None
    return layers


def read_vector_segments(path: FilePath, reading: MapReading) -> list[Segment]:
    """Read the lines of a map file as segments; `reading` states what the file does not, such as the CRS.

    Raise InputFileError if the file has no track, or a line is not valid.
    """
    check_height_datum(reading.height_datum)
    segments: list[Segment] = []
    left_out: Counter[str] = Counter()
    for named, rows, parts, nodes in _features(path):
        of_layer = replace(reading, crs=choose_crs(path, reading.crs, named))
        for row, lines, own_nodes in zip(rows, parts, nodes, strict=True):
            if why := no_track(row, of_openstreetmap=is_of_openstreetmap(row)):
                left_out[why] += 1
                continue
            stated = get_metadata(row) | _accuracy(row)
            own = stated.get("name") or get_name(row, fallback=f"line {len(segments) + 1}")
            for k, points in enumerate(lines):
                name = own + (f", part {k + 1}" if k else "")
                segments.append(
                    plan_segment(points, of_layer, path=str(path), name=name, stated=stated, nodes=own_nodes)
                )
    return with_left_out(path, segments, left_out)


def _features(
    path: FilePath,
) -> Iterator[tuple[str | None, list[dict[str, Any]], list[list[Floats]], list[tuple[str, ...]]]]:
    """Yield CRS, columns, lines and node ids of the features of each layer; KML, GPX and OSM XML do not need GDAL."""
    kind = find_kind(path)
    if kind in ("kml", "gpx"):
        found = read_kml_lines(path) if kind == "kml" else read_gpx_lines(path)
        own = [[line.points if np.isfinite(line.points[:, 2]).any() else line.points[:, :2]] for line in found]
        yield "EPSG:4326", [line.fields for line in found], own, [()] * len(own)
        return
    if kind == "osm":
        ways = read_osm_xml(path)
        yield "EPSG:4326", [way.row for way in ways], [[way.points_deg] for way in ways], [way.nodes for way in ways]
        return
    for named, rows, shapes in read_layers(path, geometry="LineString"):
        lines = [s.geoms if s.geom_type.startswith("Multi") else [s] for s in shapes]
        points = [[np.array(part.coords, dtype=np.float64) for part in parts] for parts in lines]
        yield named, rows, points, [()] * len(points)


def _accuracy(row: Mapping[str, Any]) -> dict[str, str]:
    """Return the standard deviations that are stated in the attributes of a feature, as metadata."""
    keys = ("sigma_plan_m", "sigma_height_m")
    return {key: str(row[key]) for key in keys if row.get(key) is not None and row[key] == row[key]}


def plan_segment(
    coordinates: Floats,
    reading: MapReading,
    *,
    path: str,
    name: str,
    stated: Mapping[str, str] | None = None,
    nodes: tuple[str, ...] = (),
) -> Segment:
    """Create a segment from coordinates in easting-northing or longitude-latitude order, shape (n, 2) or (n, 3).

    Points that repeat the previous point in plan are left out. If all heights are 0, they count as missing. Raise
    InputFileError if fewer than two points remain, some but not all heights are missing, or coordinates are not valid.
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
        raise InputFileError(source, "names no CRS, and its coordinates are not in degrees; give crs (--crs)")
    used = crs or "EPSG:4326"
    place = georeference(used, values[:, 0], values[:, 1], path=source)
    heights = None
    known = np.isfinite(values[:, 2]) if values.shape[1] == 3 else np.zeros(len(values), dtype=np.bool_)
    if known.any() and not known.all():
        raise InputFileError(
            source,
            f"{int((~known).sum())} of {len(known)} points have no height, the first is point {np.argmin(known) + 1}; "
            "correct them, or write the line without heights",
        )
    if known.any() and values[:, 2].any():
        heights = heights_of_file(values[:, 2] * unit_of_heights(crs), place, reading, path=source)
    place = place if crs else replace(place, frame="EPSG:4979")
    metadata = {**(stated or {}), "name": name}
    segment = make_segment(place, heights, source=source, file=path, crs=crs, metadata=metadata)
    return replace(segment, nodes=tuple(id_ for id_, own in zip(nodes, kept, strict=True) if own)) if nodes else segment


def get_name(row: Mapping[str, Any], *, fallback: str) -> str:
    """Return the name of a feature from the first column of `_NAMES` that has a value, otherwise `fallback`."""
    lower = {key.lower(): value for key, value in row.items()}
    for key in _NAMES:
        value = lower.get(key)
        if value is not None and value == value and str(value) not in ("", "nan"):
            return str(value)
    return fallback
