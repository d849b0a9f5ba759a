"""Read track maps from GeoJSON (RFC 7946) and from CSV with named columns, and write CSV track maps."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, SettingsError, check_type
from railfix.core.files import FilePath, read_text
from railfix.core.notebook import plural
from railfix.core.settings import misspelt
from railfix.core.staged_files import write_whole
from railfix.io.named_columns import NamedColumns, read_named_columns, with_usual_names
from railfix.track.crs import choose_crs, find_crs, unit_of_heights
from railfix.track.georeference import Georeference, georeference
from railfix.track.heights import check_height_datum, heights_of_file
from railfix.track.route import RINF_NAMES, RINF_SECTIONS, MapReading, Segment, make_segment
from railfix.track.track import Track
from railfix.track.vector_file import (
    get_metadata,
    get_name,
    is_of_openstreetmap,
    no_track,
    plan_segment,
    read_overpass,
    with_left_out,
)

#: CRS of a GeoJSON file that does not name it: longitude and latitude on WGS 84 (RFC 7946, section 4).
RFC_CRS: Final = "OGC:CRS84"
#: Property that identifies a connection of two tracks (`railfix.track.network_read`).
RELATION: Final = "netelementA"
#: Key that is added to the properties of a line; the value has all properties and the id of the line's feature.
_FEATURE: Final = "@feature"
_MEMBERS: Final = ("height_datum", "geoid", "name", "sigma_plan_m", "sigma_height_m")


def _lines(path: str, node: dict[str, Any], label: str, inherited: dict[str, Any]) -> Iterator[_GeojsonLine]:
    """Yield each LineString in a GeoJSON object, with the properties and members of the objects that contain it.

    Raise InputFileError if an object has no lines or no geometry.
    """
    kind = node.get("type")
    own = {key: node[key] for key in _MEMBERS if key in node}
    if kind == "FeatureCollection":
        features = node.get("features")
        if not isinstance(features, list) or not features:
            raise InputFileError(path, "the FeatureCollection has no features")
        for number, feature in enumerate(features, start=1):
            if not isinstance(feature, dict):
                raise InputFileError(path, f"feature {number} is not an object")
            if len(features) > 1 and _is_no_line(feature):
                continue
            identity = _identity(feature) if len(features) > 1 else {}
            yield from _lines(path, feature, f"feature {number}", inherited | own | identity)
    elif kind == "Feature":
        properties = node.get("properties") or {}
        geometry = node.get("geometry")
        if isinstance(properties, dict) and RELATION in properties:
            return
        if not isinstance(properties, dict) or not isinstance(geometry, dict):
            raise InputFileError(path, f"{label or 'the feature'} has no geometry")
        stated = {key: value for key, value in properties.items() if value is not None}
        identity = {} if node.get("id") is None else {"@id": str(node["id"])}
        yield from _lines(path, geometry, label, inherited | own | stated | {_FEATURE: identity | stated})
    elif kind == "LineString":
        yield _GeojsonLine(path, label, node.get("coordinates"), inherited | own, -1)
    elif kind == "MultiLineString":
        parts = node.get("coordinates")
        if not isinstance(parts, list) or not parts:
            raise InputFileError(path, f"{label or 'the geometry'} has no coordinates")
        for number, part in enumerate(parts):
            where = f"{label}, part {number + 1}" if label else f"part {number + 1}"
            yield _GeojsonLine(path, where, part, inherited | own, number)
    else:
        where = f"{label}: " if label else ""
        raise InputFileError(
            path, f"{where}type {kind!r}; LineString or MultiLineString (or features of them) was expected"
        )


def _is_no_line(feature: dict[str, Any]) -> bool:
    """Return whether a feature is a point or an area (such as a station), or has no geometry."""
    geometry = feature.get("geometry")
    if geometry is None and "geometry" in feature:
        return True
    return isinstance(geometry, dict) and geometry.get("type") in ("Point", "MultiPoint", "Polygon", "MultiPolygon")


def _identity(feature: dict[str, Any]) -> dict[str, str]:
    """Return the name of a feature, or its id if it has no name, as property "name"; empty if it has neither."""
    properties, identity = feature.get("properties"), feature.get("id")
    name = get_name(
        properties if isinstance(properties, dict) else {}, fallback="" if identity is None else str(identity)
    )
    return {"name": name} if name else {}


class _GeojsonLine:
    """Coordinates of one LineString and the properties that apply to it."""

    def __init__(self, path: str, label: str, coordinates: Any, properties: dict[str, Any], part: int) -> None:
        self.path = path
        self.source = f"{path} ({label})" if label else path
        self.feature: dict[str, Any] = properties.pop(_FEATURE, {})
        self.properties = properties
        self.part = part
        self.coordinates = self._coordinates(coordinates)

    def error(self, message: str) -> InputFileError:
        return InputFileError(self.source, message)

    def _coordinates(self, coordinates: Any) -> Floats:
        if not isinstance(coordinates, list) or len(coordinates) < 2:
            raise self.error("a track needs at least two points")
        sizes = {len(point) if isinstance(point, list) else 0 for point in coordinates}
        if sizes != {2} and not sizes <= {3, 4}:
            raise self.error("all points must be [longitude, latitude, height], or all [longitude, latitude]")
        try:
            values = np.array([point[:3] for point in coordinates], dtype=np.float64)
        except (TypeError, ValueError):
            raise self.error("a coordinate is not a number") from None
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise self.error(f"point {int(np.argmax(bad)) + 1} has a coordinate that is not finite")
        return values

    def text(self, key: str) -> str | None:
        value = self.properties.get(key)
        if value is None or isinstance(value, str):
            return value
        raise self.error(f"{key} is {value!r}; a text was expected")

    def array(self, key: str, blank: float) -> Floats | None:
        """Return a property, shape (n,), with `blank` for null values of points; None if the property is missing."""
        value = self.properties.get(key)
        if value is None:
            return None
        if self.part >= 0 and isinstance(value, list) and self.part < len(value) and isinstance(value[self.part], list):
            value = value[self.part]
        if not isinstance(value, list) or len(value) != len(self.coordinates):
            size = len(value) if isinstance(value, list) else "a single value"
            raise self.error(f"property {key}: {size} for {len(self.coordinates)} points; give one value per point")
        try:
            return np.array([blank if item is None else item for item in value], dtype=np.float64)
        except (TypeError, ValueError):
            raise self.error(f"property {key} has a value that is not a number") from None


def _crs_member(path: str, document: dict[str, Any]) -> str | None:
    """Return the CRS of the ``crs`` member (GeoJSON 2008, section 3), which many programs write; None without it."""
    member = document.get("crs")
    if member is None:
        return None
    try:
        return str(member["properties"]["name"])
    except (TypeError, KeyError):
        raise InputFileError(path, "the 'crs' member has no properties.name; give crs (--crs)") from None


def _in_frame(path: str, crs: str, values: Floats) -> Georeference:
    """Georeference coordinates in the order easting, northing (or longitude, latitude).

    `values` has one row per point; columns after the first two are ignored.

    Raise InputFileError if the CRS is geographic and the coordinates are not degrees of longitude and latitude.
    """
    if find_crs(crs, path=path).is_geographic:
        over = np.abs(values[:, 1]) > 90.0
        if over.any() or (np.abs(values[:, 0]) > 360.0).any():
            point = values[int(np.argmax(over))]
            raise InputFileError(
                path,
                f"{crs}: [{point[0]:g}, {point[1]:g}] is not [longitude, latitude]; exchange swapped values, or give "
                "the CRS of projected coordinates (crs, --crs)",
            )
    return georeference(crs, values[:, 0], values[:, 1], path=path)


def read_geojson_segments(path: FilePath, reading: MapReading) -> list[Segment]:
    """Read the lines of a GeoJSON file as segments; `reading` states what the file does not, such as the CRS.

    Overpass JSON files (OpenStreetMap) are also read. Raise InputFileError if the file is not valid.
    """
    text = read_text(path)
    try:
        document = json.loads(text)
    except json.JSONDecodeError as error:
        raise InputFileError(path, f"this is not JSON ({error.msg})", line=error.lineno) from None
    except RecursionError:
        raise InputFileError(path, "this JSON is nested too deeply for a GeoJSON object") from None
    if not isinstance(document, dict):
        raise InputFileError(path, "this is JSON, but not a GeoJSON object")
    if "elements" in document and "type" not in document:
        return _of_overpass(str(path), document, reading)
    used = choose_crs(path, reading.crs, _crs_member(str(path), document)) or RFC_CRS
    lines = list(_lines(str(path), document, "", {}))
    of_openstreetmap = any(is_of_openstreetmap(line.feature) for line in lines)
    reasons = [no_track(line.feature, of_openstreetmap=of_openstreetmap) for line in lines]
    segments = [_segment(line, used, reading) for line, why in zip(lines, reasons, strict=True) if not why]
    empty = [f"feature {k} without geometry" for k in _without_geometry(document)]
    return with_left_out(path, segments, Counter([*empty, *(why for why in reasons if why)]))


def _without_geometry(document: dict[str, Any]) -> list[int]:
    """Return the numbers (from 1) of features without geometry (null, RFC 7946, 3.2) that are not connections."""
    features = [f if isinstance(f, dict) else {} for f in document.get("features") or ()]
    empty = [f.get("geometry", ...) is None and RELATION not in (f.get("properties") or {}) for f in features]
    return [number for number, without in enumerate(empty, start=1) if without]


def _of_overpass(path: str, document: dict[str, Any], reading: MapReading) -> list[Segment]:
    """Return the ways of an Overpass JSON document as segments; a note states which ways are left out as non-tracks."""
    of_file = replace(reading, crs=choose_crs(path, reading.crs, "EPSG:4326"))
    ways = [(way, no_track(way.row, of_openstreetmap=True)) for way in read_overpass(path, document["elements"])]
    segments = [
        plan_segment(way.points_deg, of_file, path=path, name=own["name"], stated=own, nodes=way.nodes)
        for way, why in ways
        if not why and (own := get_metadata(way.row))
    ]
    return with_left_out(path, segments, Counter(why for _, why in ways if why))


def _segment(line: _GeojsonLine, crs: str, reading: MapReading) -> Segment:
    for wrong, right in misspelt(line.properties, (*OPTIONAL_COLUMNS, "geoid_m", *_MEMBERS)).items():
        if right not in line.properties:
            raise line.error(f"property {wrong!r} is unknown; did you mean {right!r}?")
    place = _in_frame(line.source, crs, line.coordinates)
    of_way = get_metadata(line.feature)
    heights = None
    if line.coordinates[:, 2:].any():  # if all heights are 0, they count as missing
        heights = heights_of_file(
            line.coordinates[:, 2] * unit_of_heights(crs), place, replace(reading, crs=crs), path=line.source,
            datum=line.text("height_datum"), geoid=line.text("geoid"), geoid_m=line.array("geoid_m", np.nan),
        )  # fmt: skip
    return make_segment(
        place,
        heights,
        source=f"{line.path} ({of_way['name']})" if "name" in of_way else line.source,
        file=line.path,
        crs=crs,
        metadata={key: str(line.properties[key]) for key in _MEMBERS if key in line.properties} | of_way,
        attributes=attributes(line.array),
    )


#: Optional columns: name of the `Track` attribute, conversion factor, and value of an empty cell.
OPTIONAL_COLUMNS: Final[dict[str, tuple[str, float, float]]] = {
    "kilometrage_m": ("kilometrage_m", 1.0, np.nan),
    "cant_mm": ("cant_m", 1e-3, np.nan),
    "radius_m": ("radius_m", 1.0, np.inf),
    "gradient_permille": ("gradient_permille", 1.0, np.nan),
}
#: Columns with standard deviations of each point, for information only; positioning uses the map's metadata instead.
SIGMA_COLUMNS: Final = ("sigma_plan_m", "sigma_height_m")
KNOWN_COLUMNS: Final = (
    "latitude_deg", "longitude_deg", "height_m", "elevation_m", "geoid_m", *OPTIONAL_COLUMNS, *SIGMA_COLUMNS,
)  # fmt: skip
#: Keys that are used in ``# key: value`` lines above the header; lines with other keys are ignored.
KNOWN_METADATA: Final = ("name", "crs", "height_datum", "geoid", "sigma_plan_m", "sigma_height_m", "note")


def attributes(read: Callable[[str, float], Floats | None]) -> dict[str, Floats]:
    """Return the optional attributes of points in the units of `Track`. `read(column, blank)` returns a column or None.

    Attributes of missing columns are left out. A radius of 0, which means straight track, becomes infinite.
    """
    found: dict[str, Floats] = {}
    for column, (name, factor, blank) in OPTIONAL_COLUMNS.items():
        if (values := read(column, blank)) is not None:
            found[name] = np.where(values == 0.0, np.inf, values) if name == "radius_m" else values * factor
    return found


def read_csv_segment(path: FilePath, reading: MapReading) -> Segment:
    """Read a CSV track map as one segment of a route.

    The coordinates are latitude and longitude. Raise InputFileError or SettingsError if the file is not valid or
    contradicts `reading`.
    """
    check_height_datum(reading.height_datum)
    table = _with_map_names(read_named_columns(path), reading.height_datum)
    notes = (*_check_columns(table), *filter(None, table.metadata.get("note", "").split("; ")))
    latitude, longitude = table.numbers("latitude_deg"), table.numbers("longitude_deg")
    check_degrees(table, latitude, longitude)
    datum = _datum(table, reading.height_datum)
    heights = table.numbers("height_m" if datum == "ellipsoidal" else "elevation_m")
    if len(table) < 2:
        raise InputFileError(path, f"{plural(table, 'point')}; a track needs at least two")
    crs = choose_crs(path, reading.crs, table.metadata.get("crs"))
    place = _place(crs, latitude, longitude, path=table.path)
    geoid_m = table.numbers("geoid_m") if datum == "orthometric" and "geoid_m" in table else None
    above = None
    if heights.any():  # if all heights are 0, they count as missing
        above = heights_of_file(
            heights, place, replace(reading, crs=None, height_datum=datum), path=table.path,
            geoid=table.metadata.get("geoid"), geoid_m=geoid_m,
        )  # fmt: skip
    return make_segment(
        place,
        above,
        source=table.path,
        file=table.path,
        crs=crs,
        metadata={key: value for key, value in table.metadata.items() if key in KNOWN_METADATA},
        notes=notes,
        attributes=attributes(lambda column, blank: table.numbers(column, blank=blank) if column in table else None),
    )


def _with_map_names(table: NamedColumns, height_datum: str | None) -> NamedColumns:
    """Replace the column names of other programs by those that railfix uses.

    The height column is renamed according to the height datum. Raise InputFileError if the datum is not given.
    """
    places = with_usual_names(table, ("latitude_deg", "longitude_deg"))
    named = with_usual_names(places, ("height_m",))
    theirs = named.usual.get("height_m")
    if theirs is None or "elevation_m" in places:
        return places
    if height_datum is None:
        raise table.header_error(
            f"the column {theirs!r} does not state the datum of its heights; give height_datum (--height-datum), "
            "ellipsoidal or orthometric, or name the column height_m (ellipsoidal) or elevation_m (orthometric)"
        )
    cells = {("elevation_m" if height_datum == "orthometric" and name == "height_m" else name): column
             for name, column in named.cells.items()}  # fmt: skip
    return replace(named, cells=cells)


def _check_columns(table: NamedColumns) -> tuple[str, ...]:
    """Return notes on unused columns; raise InputFileError if coordinates are missing or a column is misspelt."""
    close = misspelt(table.cells, KNOWN_COLUMNS)
    for wrong, right in close.items():
        if right not in table:
            raise table.header_error(f"column {wrong!r} is unknown; did you mean {right!r}?")
    for wrong, right in misspelt(table.metadata, KNOWN_METADATA).items():
        if right not in table.metadata:
            raise InputFileError(
                table.path, f"the line '# {wrong}: {table.metadata[wrong]}' is unknown; did you mean '# {right}'?"
            )
    for name in ("latitude_deg", "longitude_deg"):
        if name not in table:
            message = f"there is no column {name!r}; the columns are {', '.join(table.cells)}"
            if any(cell.lower() in RINF_NAMES for cell in table.cells):
                message += f"; {RINF_SECTIONS}"
            raise table.header_error(message)
    if ("height_m" in table) == ("elevation_m" in table):
        what = "both 'height_m' and 'elevation_m'" if "height_m" in table else "neither 'height_m' nor 'elevation_m'"
        message = f"{what}; exactly one is needed, height_m (ellipsoidal) or elevation_m (orthometric, from levelling)"
        raise table.header_error(message)
    used = [name for name in KNOWN_COLUMNS if name != "geoid_m" or "elevation_m" in table]
    extra = [name for name in table.cells if name not in used]
    return (f"{table.path}: columns not used: {', '.join(extra)}",) if extra else ()


def _datum(table: NamedColumns, asked: str | None) -> str:
    datum = "ellipsoidal" if "height_m" in table else "orthometric"
    for source, stated in (("height_datum", asked), ("the line '# height_datum'", table.metadata.get("height_datum"))):
        if stated is not None and stated != datum:
            column, other = ("height_m", "elevation_m") if datum == "ellipsoidal" else ("elevation_m", "height_m")
            what = f"{source} is {stated!r}, but the column {column} is {datum}"
            raise table.header_error(f"{what}; name the column {other}, or remove the setting")
    return datum


def check_degrees(table: NamedColumns, latitude_deg: Floats, longitude_deg: Floats) -> None:
    """Raise InputFileError if the coordinates cannot be latitudes and longitudes in degrees."""
    outside = np.abs(latitude_deg) > 90.0
    if outside.any():
        row = int(np.argmax(outside))
        value = latitude_deg[row]
        hint = "check whether latitude and longitude are swapped"
        if abs(value) > 360.0:
            hint = "give degrees, not minutes, seconds, or metres in a grid (only GeoJSON files may be in a grid)"
        raise table.error(row, f"latitude_deg {value:g} is over 90; {hint}")
    outside = np.abs(longitude_deg) > 360.0
    if outside.any():
        row = int(np.argmax(outside))
        raise table.error(row, f"longitude_deg {longitude_deg[row]:g} is over 360; degrees were expected")
    if len(table) and (np.abs(latitude_deg) <= np.pi / 2).all() and (np.abs(longitude_deg) <= np.pi).all():
        raise table.error(0, "all coordinates are near 0, 0: radians were given, degrees were expected")


def _place(crs: str | None, latitude: Floats, longitude: Floats, *, path: str) -> Georeference:
    """Georeference latitudes and longitudes, which are in a geographic CRS, by default WGS 84.

    Raise SettingsError if the CRS is not geographic or its unit is not the degree.
    """
    if crs is None:
        return Georeference(latitude_deg=latitude, longitude_deg=longitude)
    system = find_crs(crs, path=path)
    if not system.is_geographic:
        raise SettingsError(
            f"{path}: {crs} is {system.name}, but the columns are latitude and longitude; "
            "projected coordinates are read from GeoJSON"
        )
    unit = system.axis_info[0].unit_name
    if unit != "degree":
        raise SettingsError(f"{path}: {crs} is {system.name}, in {unit}s, but the columns are in degrees")
    return georeference(crs, longitude, latitude, path=path)


def write_track_csv(track: Track, path: FilePath, *, sigma_m: Floats | None = None) -> None:
    """Write a track as CSV with ellipsoidal heights.

    Attributes without any value are omitted. Coordinates are written to 1e-10 degrees and 0.1 mm. `sigma_m`, shape (V,
    2) [m], are the standard deviations of each point in plan and in height; they become additional columns. No file
    remains if writing fails.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    check_type(track, Track, "track")
    columns = {
        "latitude_deg": [f"{v:.10f}" for v in track.latitude_deg],
        "longitude_deg": [f"{v:.10f}" for v in track.longitude_deg],
        "height_m": [f"{v:.4f}" for v in track.height_m],
    }
    for column, (name, factor, _) in OPTIONAL_COLUMNS.items():
        values = getattr(track, name) / factor
        if not np.isnan(values).all():
            unknown = "nan" if column == "radius_m" else ""  # a blank cell is straight track
            columns[column] = [unknown if np.isnan(v) else f"{v:.10g}" for v in values]
    if sigma_m is not None:
        columns |= {name: [f"{v:.3f}" for v in sigma_m[:, i]] for i, name in enumerate(SIGMA_COLUMNS)}
    lines = [
        f"# name: {track.name}",
        f"# crs: {track.provenance.frame}",
        "# height_datum: ellipsoidal",
        f"# sigma_plan_m: {track.sigma_plan_m:g}",
        f"# sigma_height_m: {track.sigma_height_m:g}",
        *(f"# note: {note}" for note in track.provenance.notes),
        ",".join(columns),
        *(",".join(row) for row in zip(*columns.values(), strict=True)),
    ]
    write_whole(path, "\n".join(lines) + "\n")
