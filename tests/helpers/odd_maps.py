"""Odd map files of every format: what is written, how it is read, and what has to come of it.

All are of one line of 1 km, or of one design. A file is `right` (its points are those of the line within 5 cm), `noted`
(right, and what was done with it is said), a fault that the check of maps finds, or refused in one sentence.
"""

from __future__ import annotations

import io
import json
import re
import struct
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyogrio
import shapely
from pyproj import CRS, Transformer

N: Final = 41
#: Longitude, latitude, ellipsoidal height.
LINE: Final = np.stack(
    [np.linspace(11.0, 11.014, N), 48.0 + 1e-4 * np.sin(np.linspace(0, 3, N)), np.linspace(480.0, 490.0, N)], axis=-1
)
_PLAN = Transformer.from_crs("EPSG:4258", "EPSG:25832", always_xy=True).transform(LINE[:, 0], LINE[:, 1])
#: Easting, northing, height.
GRID: Final = np.column_stack([*_PLAN, LINE[:, 2]])
_KILOMETRAGE: Final = np.linspace(0.0, 1045.16, N)
_SWAPPED: Final = [1, 0, 2]
Content = str | bytes | Callable[[Path], None]


@dataclass(frozen=True)
class Odd:
    """A file of a name, its content, what is asked for, and what comes of it: an outcome and words of its sentence."""

    name: str
    content: Content
    outcome: Literal["right", "noted", "found", "refused", "elsewhere"]
    words: str = ""
    asked: dict[str, str] = field(default_factory=lambda: {"height_datum": "ellipsoidal"})


def csv(
    rows: Any = LINE, pattern: str = "{1:.9f},{0:.9f},{2:.4f}", *, more: str = "", crs: str | None = "EPSG:4258"
) -> str:
    """A CSV map; `more` are further columns."""
    head = f"# crs: {crs}\n" if crs else ""
    return head + f"latitude_deg,longitude_deg,height_m{more}\n" + "".join(pattern.format(*p) + "\n" for p in rows)


def _with(column: Any, name: str) -> str:
    return csv(np.column_stack([LINE, column]), "{1:.9f},{0:.9f},{2:.4f},{3:.6f}", more=f",{name}")


def geojson(*lines: Any, crs: str | None = "EPSG:4258", properties: Sequence[dict[str, Any]] = ()) -> str:
    """A GeoJSON map of lines."""
    features = [
        {"type": "Feature", "properties": p, "geometry": {"type": "LineString", "coordinates": np.asarray(c).tolist()}}
        for c, p in zip(lines, properties or [{}] * len(lines), strict=True)
    ]
    named = {"crs": {"type": "name", "properties": {"name": crs}}} if crs else {}
    return json.dumps({"type": "FeatureCollection", "features": features} | named)


def written(driver: str, coordinates: Any, crs: str = "EPSG:4258") -> Callable[[Path], None]:
    """A file that GDAL writes."""

    def write(path: Path) -> None:
        with np.errstate(invalid="ignore"):
            shape = np.array([shapely.to_wkb(shapely.LineString(coordinates))])
        kind = "LineString Z" if coordinates.shape[1] == 3 else "LineString"
        pyogrio.raw.write(path, shape, [], [], driver=driver, geometry_type=kind, crs=crs)

    return write


def _cut(driver: str, last: int) -> Callable[[Path], None]:
    """A file that GDAL writes, without its last bytes."""

    def write(path: Path) -> None:
        written(driver, LINE)(path)
        path.write_bytes(path.read_bytes()[:-last])

    return write


def measured(kind: int) -> Callable[[Path], None]:
    """A shapefile whose points have measures (ESRI Shapefile Technical Description): 13 with heights, 23 without."""

    def write(path: Path) -> None:
        box = struct.pack("<4d", *LINE[:, :2].min(axis=0), *LINE[:, :2].max(axis=0))
        body = struct.pack("<i", kind) + box + struct.pack("<iii", 1, N, 0) + LINE[:, :2].tobytes()
        for values in (LINE[:, 2], _KILOMETRAGE)[kind == 23 :]:
            body += struct.pack("<2d", values[0], values[-1]) + values.tobytes()

        def head(words: int) -> bytes:
            return struct.pack(">7i", 9994, 0, 0, 0, 0, 0, words) + struct.pack("<ii", 1000, kind) + box + bytes(32)

        record = struct.pack(">ii", 1, len(body) // 2) + body
        path.write_bytes(head(50 + len(record) // 2) + record)
        path.with_suffix(".shx").write_bytes(head(54) + struct.pack(">ii", 50, len(body) // 2))
        path.with_suffix(".prj").write_text(CRS(4258).to_wkt("WKT1_ESRI"))

    return write


def kml(mode: str = "absolute") -> str:
    """A KML map; `mode` says what its altitudes are."""
    points = " ".join(f"{x:.9f},{y:.9f},{z:.3f}" for x, y, z in LINE)
    inner = f"<altitudeMode>{mode}</altitudeMode><coordinates>{points}</coordinates>"
    return (
        '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>main</name>'
        f"<LineString>{inner}</LineString></Placemark></Document></kml>"
    )


def zipped(name: str, content: str) -> bytes:
    """An archive of one file."""
    with zipfile.ZipFile(archive := io.BytesIO(), "w") as file:
        file.writestr(name, content)
    return archive.getvalue()


def zipped_shapefile(path: Path) -> None:
    """An archive of a Shapefile with the files beside it, as portals give it out."""
    measured(13)(path.with_suffix(".shp"))
    with zipfile.ZipFile(path, "w") as archive:
        for part in (path.with_suffix(ending) for ending in (".shp", ".shx", ".prj")):
            archive.write(part, part.name)


def gpx(mark: str = ".") -> str:
    """A GPX track."""
    points = "".join(f'<trkpt lat="{y:.8f}" lon="{x:.8f}"/>' for x, y, _ in LINE).replace(".", mark)
    return (
        '<?xml version="1.0"?><gpx version="1.1" creator="t" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
        f"{points}</trkseg></trk></gpx>"
    )


def osm(railway: str = "rail") -> str:
    """An OpenStreetMap file of one way."""
    nodes = "".join(f'<node id="{k}" version="1" lat="{y:.8f}" lon="{x:.8f}"/>' for k, (x, y, _) in enumerate(LINE, 1))
    way = "".join(f'<nd ref="{k}"/>' for k in range(1, N + 1))
    return (
        f'<?xml version="1.0"?><osm version="0.6">{nodes}<way id="7" version="1">{way}<tag k="railway" v="{railway}"/>'
        "</way></osm>"
    )


def railml(points: Any = LINE, crs: str = "urn:ogc:def:crs:EPSG::4258", *, before: str = "", keys: str = "xyz") -> str:
    """A railML 3 map of one net element; `before` are positioning systems in front of its own."""
    rows = "".join(
        f'<intrinsicCoordinate intrinsicCoord="{k / 40}"><geometricCoordinate positioningSystemRef="g" '
        + " ".join(f'{key}="{value}"' for key, value in zip("xyz", p.tolist(), strict=True) if key in keys)
        + "/></intrinsicCoordinate>"
        for k, p in enumerate(points)
    )
    return (
        '<railML xmlns="https://www.railml.org/schemas/3.2" version="3.2"><common><positioning>'
        f'<geometricPositioningSystems>{before}<geometricPositioningSystem id="g" crsDefinition="{crs}"/>'
        "</geometricPositioningSystems></positioning></common><infrastructure><topology><netElements>"
        f'<netElement id="ne1"><associatedPositioningSystem id="a">{rows}</associatedPositioningSystem></netElement>'
        "</netElements></topology></infrastructure></railML>"
    )


_END: Final = f"{5319500 + 500 * np.cos(0.4):.6f} {650100 + 500 * np.sin(0.4):.6f}"
#: A straight of 100 m and an arc of 200 m, with profile and cant.
LANDXML: Final = f"""<?xml version="1.0"?><LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" version="1.2">
<Units><Metric linearUnit="meter"/></Units><CoordinateSystem epsgCode="25832"/>
<Alignments><Alignment name="T1" length="300" staStart="1000"><CoordGeom>
<Line><Start>5320000 650000</Start><End>5320000 650100</End></Line>
<Curve rot="cw" crvType="arc"><Start>5320000 650100</Start><Center>5319500 650100</Center><End>{_END}</End></Curve>
</CoordGeom><Profile><ProfAlign name="p"><PVI>1000 500</PVI><ParaCurve length="60">1100 501</ParaCurve>
<PVI>1300 500</PVI></ProfAlign></Profile>
<Cant><CantStation station="1000" appliedCant="0"/><CantStation station="1100" appliedCant="0" curvature="cw"/>
<CantStation station="1300" appliedCant="90" curvature="cw"/></Cant></Alignment></Alignments></LandXML>"""


def in_unit(metres: float, unit: str) -> str:
    """The design in another unit of length, cant in millimetres or inches."""
    text = re.sub(
        r">([\d. -]+)<", lambda m: ">" + " ".join(f"{float(v) / metres:.9f}" for v in m[1].split()) + "<", LANDXML
    )
    text = re.sub(r'(staStart|station|length)="([\d.]+)"', lambda m: f'{m[1]}="{float(m[2]) / metres:.9f}"', text)
    if unit.endswith("meter"):
        return text.replace('linearUnit="meter"', f'linearUnit="{unit}"')
    return text.replace('Metric linearUnit="meter"', f'Imperial linearUnit="{unit}"').replace('"90"', f'"{90 / 25.4}"')


def _landxml(old: str, new: str) -> str:
    assert old in LANDXML
    return LANDXML.replace(old, new)


_SOME_HEIGHTS: Final = np.where(np.arange(N)[:, None] < 20, 1.0, [1.0, 1.0, np.nan])
_PARTS: Final = (LINE[:20], LINE[19:])
_LOWER: Final = LINE[19:] - [0.0, 0.0, 47.0]
_FOOT: Final = 0.3048
_NONE: Final[dict[str, str]] = {}

CASES: Final[tuple[Odd, ...]] = (
    # -- CSV
    Odd("clean.csv", csv(), "right"),
    Odd("byte_order_mark.csv", b"\xef\xbb\xbf" + csv().encode(), "right"),
    Odd("carriage_returns.csv", csv().replace("\n", "\r").encode(), "right"),
    Odd("empty.csv", "", "refused", "is empty"),
    Odd("no_point.csv", csv(LINE[:0]), "refused", "a track needs at least two"),
    Odd("one_point.csv", csv(LINE[:1]), "refused", "a track needs at least two"),
    Odd("nan.csv", csv().replace("48.000000000", "nan", 1), "refused", "'nan' is not a finite number"),
    Odd("decimal_commas.csv", csv(pattern='"{1:.9f}","{0:.9f}",1').replace(".", ","), "refused", "is not a number"),
    Odd("degrees_minutes_seconds.csv", csv(pattern="48°00'00\",11°00'00\",480"), "refused", "is not a number"),
    Odd("swapped.csv", csv(LINE[:, _SWAPPED]), "refused", "latitude and longitude are swapped"),
    Odd("swapped_without_frame.csv", csv(LINE[:, _SWAPPED], crs=None), "elsewhere", "swapped"),
    Odd("gon.csv", csv(LINE * [10 / 9, 10 / 9, 1]), "elsewhere"),
    Odd("arc_seconds.csv", csv(LINE * [3600, 3600, 1]), "refused", "give degrees, not minutes"),
    Odd("grid.csv", csv(GRID, crs="EPSG:25832"), "refused", "give degrees, not minutes"),
    Odd("frame_in_grads.csv", csv(crs="EPSG:4807"), "refused", "in grads, but the columns are in degrees"),
    Odd("longitude_of_371.csv", csv(LINE - [-360.0, 0.0, 0.0]), "refused", "longitude_deg 371 is over 360"),
    Odd("four_decimals.csv", csv(pattern="{1:.4f},{0:.4f},{2:.1f}"), "found", "at most five decimals"),
    Odd("heights_missing.csv", csv(LINE * [1, 1, 0] - [0, 0, 9999]), "found", "-9,999 m is impossible"),
    Odd("height_of_zero.csv", csv(np.where(np.arange(N)[:, None] == 9, [1, 1, 0], 1) * LINE), "found", "the height"),
    Odd("heights_in_millimetres.csv", csv(LINE * [1, 1, 1000]), "found", "it is in millimetres"),
    Odd("column_in_feet.csv", csv(LINE / [1, 1, _FOOT]).replace("t_m", "t_ft"), "refused", "is in feet"),
    Odd("two_datums.csv", csv(np.vstack([LINE[:20], LINE[20:] - [0, 0, 47]])), "found", "the height deviates from"),
    Odd("repeated.csv", csv(np.repeat(LINE, 2, axis=0)), "right"),
    Odd("out_of_order.csv", csv(LINE[np.random.default_rng(0).permutation(N)]), "found", "the direction turns by"),
    Odd("back_and_on.csv", csv(np.vstack([LINE[:25], LINE[15:]])), "found", "turns by 179.[0-9] degrees"),
    Odd("piece_missing.csv", csv(np.vstack([LINE[:10], LINE[35:]])), "found", "a curve in between would be missed"),
    Odd("cant_in_metres.csv", _with(np.full(N, 0.1), "cant_mm"), "found", "in metres instead of millimetres"),
    Odd("radius_in_kilometres.csv", _with(np.full(N, 0.5), "radius_m"), "found", r"radius of 0\.5 m"),
    Odd("kilometrage.csv", _with(_KILOMETRAGE, "kilometrage_m"), "right"),
    Odd("kilometrage_in_kilometres.csv", _with(_KILOMETRAGE / 1e3, "kilometrage_m"), "found", "it is in metres"),
    Odd(
        "kilometrage_jumps.csv", _with(_KILOMETRAGE + 500 * (_KILOMETRAGE > 500), "kilometrage_m"), "found",
        "the kilometrage changes by 526",
    ),
    Odd("both_heights.csv", _with(np.full(N, 47.0), "geoid_m"), "noted", "columns not used: geoid_m"),
    # -- GeoJSON
    Odd("clean.geojson", geojson(LINE), "right"),
    Odd("byte_order_mark.geojson", b"\xef\xbb\xbf" + geojson(LINE).encode(), "right"),
    Odd("grid.geojson", geojson(GRID, crs="EPSG:25832"), "right"),
    Odd("reversed_piece.geojson", geojson(LINE[:20], LINE[19:][::-1]), "noted", "against the order of its points"),
    Odd("gap.geojson", geojson(LINE[:20], LINE[20:]), "refused", r"the gap is 26\.12 m"),
    Odd("pieces_out_of_order.geojson", geojson(LINE[:14], LINE[27:], LINE[13:28]), "refused", "the gap is"),
    Odd("the_same_twice.geojson", geojson(LINE, LINE), "found", "turns by 180.0 degrees"),
    Odd("grid_not_named.geojson", geojson(GRID, crs=None), "refused", "or give the CRS of projected"),
    Odd("degrees_in_a_grid.geojson", geojson(LINE, crs="EPSG:25832"), "refused", "whether EPSG:25832 is the right CRS"),
    Odd("northing_first.geojson", geojson(GRID[:, _SWAPPED], crs="EPSG:25832"), "refused", "EPSG:25832 is the right"),
    Odd("next_zone.geojson", geojson(GRID, crs="EPSG:25833"), "elsewhere"),
    Odd("swapped_without_frame.geojson", geojson(LINE[:, _SWAPPED], crs=None), "elsewhere", "swapped"),
    Odd(
        "two_datums_with_geoid.geojson",
        geojson(_PARTS[0], _LOWER, properties=[{}, {"height_datum": "orthometric", "geoid_m": [47.0] * 22}]),
        "refused", "'ellipsoidal' contradicts the file's own 'orthometric'",
    ),
    Odd(
        "two_datums_stated.geojson",
        geojson(
            _PARTS[0], _LOWER,
            properties=[{"height_datum": "ellipsoidal"}, {"height_datum": "orthometric", "geoid_m": [47.0] * 22}],
        ),
        "right", asked=_NONE,
    ),
    Odd("two_datums_untold.geojson", geojson(_PARTS[0], _LOWER), "refused", r"the gap is 47\.00 m"),
    Odd("nan.geojson", geojson(LINE).replace("48.0,", "NaN,", 1), "refused", "that is not finite"),
    Odd("decimal_commas.geojson", geojson(LINE).replace("48.0,", '"48,0",', 1), "refused", "is not a number"),
    Odd("time_as_height.geojson", geojson(LINE - [0, 0, -1.7e9]), "found", "m is impossible"),
    Odd("some_heights.geojson", geojson(LINE).replace(", 480.0]", "]", 1), "refused", "or all .longitude, latitude"),
    Odd("two_documents.geojson", geojson(LINE) + "\n" + geojson(LINE), "refused", "is not JSON"),
    Odd("collection.geojson", '{"type": "GeometryCollection", "geometries": []}', "refused", "LineString or MultiLine"),
    # -- files that GDAL reads
    Odd("clean.gpkg", written("GPKG", LINE), "right"),
    Odd("clean.fgb", written("FlatGeobuf", LINE), "right"),
    Odd("clean.gml", written("GML", LINE), "right"),
    Odd("clean.kml", kml(), "right"),
    Odd("packed.kmz", zipped("doc.kml", kml()), "right"),
    Odd("shapefile.zip", zipped_shapefile, "right"),
    Odd("grid.dxf", written("DXF", GRID), "right", asked={"crs": "EPSG:25832", "height_datum": "ellipsoidal"}),
    Odd("repeated.gpkg", written("GPKG", np.repeat(LINE, 2, axis=0)), "right"),
    Odd("swapped.fgb", written("FlatGeobuf", LINE[:, _SWAPPED]), "refused", "are swapped"),
    Odd("millimetres.gpkg", written("GPKG", GRID * 1000, "EPSG:25832"), "refused", "in the unit of the file"),
    Odd("grid_not_named.dxf", written("DXF", GRID), "refused", "names no CRS, and its coordinates are not in degrees"),
    Odd("some_heights.gpkg", written("GPKG", LINE * _SOME_HEIGHTS), "refused", "21 of 41 points have no height"),
    Odd("flat.gpkg", written("GPKG", LINE[:, :2]), "refused", "the coordinates have no height"),
    Odd("no_database.gpkg", b"hello", "refused", "GDAL cannot read this file"),
    Odd("cut.fgb", _cut("FlatGeobuf", 300), "refused", "GDAL cannot read this file"),
    Odd("heights_and_measures.shp", measured(13), "right"),
    Odd("measures.shp", measured(23), "refused", "the coordinates have no height"),
    Odd("above_ground.kml", kml("relativeToGround"), "refused", "relativeToGround, which gives no track height"),
    Odd("decimal_commas.gpx", gpx(","), "refused", '11,00000000 has a comma in a number'),
    Odd("decimal_commas.osm", osm().replace('lat="48.', 'lat="48,'), "refused", "has a comma in a number"),
    Odd("nodes_not_sorted.osm", osm().replace('id="5"', 'id="555"'), "refused", "have no height; give heights"),
    Odd("platform.osm", osm("platform"), "refused", "1 railway=platform"),
    # -- railML
    Odd("clean.railml", railml(), "right"),
    Odd("grid.railml", railml(GRID, "urn:ogc:def:crs:EPSG::25832"), "right"),
    Odd(
        "second_system.railml",
        railml(before='<geometricPositioningSystem id="h" crsDefinition="EPSG:3857"/>'), "right",
    ),
    Odd("decimal_commas.railml", railml().replace('x="11.0', 'x="11,0'), "refused", "number that railML 3 requires"),
    Odd("nan.railml", railml().replace('y="48.0"', 'y="nan"'), "refused", "number that railML 3 requires"),
    Odd("no_northing.railml", railml(keys="xz"), "refused", "number that railML 3 requires"),
    Odd("no_heights.railml", railml(keys="xy"), "refused", "the coordinates have no height"),
    Odd("one_point.railml", railml(LINE[:1]), "refused", "no netElement"),
    Odd("unknown_system.railml", railml(crs="our grid"), "refused", "the CRS 'our grid' is unknown"),
    # -- LandXML
    Odd("clean.xml", LANDXML, "right"),
    *(
        Odd(f"{unit}.xml", in_unit(metres, unit), "right")
        for unit, metres in {
            "centimeter": 0.01, "kilometer": 1e3, "foot": _FOOT, "USSurveyFoot": 1200 / 3937, "inch": 0.0254,
        }.items()
    ),
    Odd("furlong.xml", in_unit(201.168, "furlong"), "refused", "linearUnit is 'furlong'; one of meter"),
    Odd("nan.xml", _landxml("650100</End>", "nan</End>"), "refused", "number that LandXML 1.2 requires"),
    Odd("decimal_commas.xml", _landxml(">1100 501<", ">1100 501,5<"), "refused", "number that LandXML 1.2 requires"),
    Odd("stations_from_zero.xml", _landxml('"1000"><Co', '"0"><Co'), "refused", "the profile runs from 1000 to 1300 m"),
    Odd("profile_ends.xml", _landxml(">1300 500<", ">1150 500<"), "refused", "the profile runs from 0 to 150 m"),
    Odd("profile_turns.xml", _landxml(">1300 500<", ">1050 500<"), "refused", "stations of a profile do not rise"),
    Odd(
        "station_equation.xml", _landxml("<CoordGeom>", '<StaEquation staAhead="9" staInternal="1"/><CoordGeom>'),
        "refused", "station equations do not rise from the start",
    ),
    Odd("gap.xml", _landxml("650100</End></Line>", "650090</End></Line>"), "refused", "correct the elements"),
    Odd("curve_turned.xml", _landxml('rot="cw"', 'rot="ccw"'), "refused", "curves do not match their attribute rot"),
    Odd("unknown_frame.xml", _landxml('"25832"', '"99999999"'), "refused", "'EPSG:99999999' is unknown"),
    Odd("frame_without_grid.xml", _landxml('"25832"', '"4258"'), "refused", "not a projected CRS"),
    Odd("another_grid.xml", _landxml('"25832"', '"2154"'), "refused", "whether EPSG:2154 is the right CRS"),
)  # fmt: skip
