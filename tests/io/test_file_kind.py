"""The kind of a file is found by its content, whatever its name is."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest

from railfix.core.errors import InputFileError
from railfix.core.geodesy import geodetic_from_ecef
from railfix.io.file_kind import KIND_WORDS, find_kind
from railfix.io.positions import read_positions
from railfix.track import read_track

pytestmark = pytest.mark.requirement("G5")

LABEL = "RINEX VERSION / TYPE"
HEADS = {
    "observations": f"{'     3.04           OBSERVATION DATA    M':60}{LABEL}\n",
    "navigation": f"{'     2.11           N: GPS NAV DATA':60}{LABEL}\n",
    "rinex": f"{'     2.11           METEOROLOGICAL DATA':60}{LABEL}\n",
    "sbas": "1481 108093 129 26 : 5369C4" + "0" * 58 + "\n",
    "sp3": "#dP2024  3  5  0  0  0.00000000      96 ORBIT IGS20 FIT  IGS\n",
    "nmea": "boot 3.1\n$GPGGA,031000.00,,,,,0,,,M,,M,,*66\n",
    "novatel": "#BESTPOSA,COM1,0,83.5,FINESTEERING,1419,336148.000,0,0,0;SOL_COMPUTED,SINGLE\n",
    "rtklib": "%  GPST   latitude(deg) longitude(deg)  height(m)   Q  ns\n",
    "gpx": '<?xml version="1.0"?>\n<!-- a remark -->\n<g:gpx xmlns:g="http://www.topografix.com/GPX/1/1"></g:gpx>',
    "kml": '<?xml version="1.0"?><kml xmlns="http://www.opengis.net/kml/2.2"></kml>',
    "osm": '<?xml version="1.0"?><osm version="0.6"></osm>',
    "xml": '<?xml version="1.0"?><LandXML version="1.2"></LandXML>',
    "gml": '<ogr:FeatureCollection xmlns:ogr="http://ogr.maptools.org/"></ogr:FeatureCollection>',
    "rdf": "@prefix era: <http://data.europa.eu/949/> .\n",
    "geojson": '{"type": "FeatureCollection", "features": []}',
    "ifc": "ISO-10303-21;\nHEADER;\n",
    "dxf": "  0\nSECTION\n  2\nHEADER\n",
    "gpkg": "SQLite format 3\0",
    "shp": "\0\0\x27\n" + "\0" * 20,
    "fgb": "fgb\x03fgb\x00",
    "table": "# name: a\nlatitude_deg;longitude_deg\n47;8\n",
    "mate": "TRACK_EDGE_ID,TRACK_SEGMENT_TYPE\n1,STRAIGHT\n",
    "unknown": "notes\n",
}
OTHER_RDF = (
    '<?xml version="1.0"?><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"></rdf:RDF>',
    "<http://a/1> <http://a/2> <http://a/3> .\n", '[{"@id": "http://a/1"}]', '{"@context": {}}',
)  # fmt: skip


@pytest.mark.parametrize("kind", HEADS)
def test_the_content_decides_the_kind(tmp_path: Path, kind: str) -> None:
    assert kind in KIND_WORDS
    path = tmp_path / "upload"
    path.write_bytes(HEADS[kind].encode("latin-1"))
    assert find_kind(path) == kind
    path.write_bytes(gzip.compress(HEADS[kind].encode("latin-1")))
    assert find_kind(path) == kind


@pytest.mark.parametrize("text", OTHER_RDF)
def test_every_form_of_rdf_is_known(tmp_path: Path, text: str) -> None:
    (tmp_path / "net").write_text(text)
    assert find_kind(tmp_path / "net") == "rdf"


def test_a_map_is_the_same_as_table_and_kml_of_any_name(tmp_path: Path) -> None:
    rows = [(8.0 + k * 1e-4, 47.0 + k * 1e-5, 400.0 + k) for k in range(20)]
    table = "lat,lon,height\n" + "".join(f"{y},{x},{z}\n" for x, y, z in rows)
    points = " ".join(f"{x},{y},{z}" for x, y, z in rows)
    kml = (
        '<kml xmlns="http://www.opengis.net/kml/2.2" xmlns:gx="http://www.google.com/kml/ext/2.2"><Document>'
        "<Placemark><name>stop</name><Point><coordinates>8,47,0</coordinates></Point></Placemark>"
        "<Placemark><name>main</name>%s</Placemark></Document></kml>"
    )
    track = "<gx:Track>" + "".join(f"<gx:coord>{x} {y} {z}</gx:coord>" for x, y, z in rows) + "</gx:Track>"
    texts = [table, kml % f"<LineString><coordinates>{points}</coordinates></LineString>", kml % track]
    maps = []
    for number, text in enumerate(texts):
        (tmp_path / f"map{number}").write_text(text)
        maps.append(read_track(tmp_path / f"map{number}", height_datum="ellipsoidal"))
    np.testing.assert_allclose(maps[1].ecef_m, maps[0].ecef_m, atol=1e-6)
    np.testing.assert_array_equal(maps[2].ecef_m, maps[1].ecef_m)
    assert maps[1].name == "main"
    (tmp_path / "clamped").write_text(
        texts[1].replace("<coordinates>8.0,", "<altitudeMode>clampToGround</altitudeMode><coordinates>8.0,")
    )
    with pytest.raises(InputFileError, match="the coordinates have no height"):
        read_track(tmp_path / "clamped")


def test_a_gpx_point_without_height_stays_in_plan(tmp_path: Path) -> None:
    path = tmp_path / "run"
    path.write_text(
        '<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
        '<trkpt lat="47" lon="8"><ele>400</ele>'
        '</trkpt><trkpt lat="47.1" lon="8.1"/></trkseg></trk></gpx>'
    )
    log = read_positions(path)
    np.testing.assert_allclose(geodetic_from_ecef(log.ecef_m[0]), (47.0, 8.0, 400.0))
    assert np.isnan(log.ecef_m[1]).all()
    np.testing.assert_array_equal(log.geodetic[0], [47.0, 47.1])
    assert any("1 of 2 points have no height" in note for note in log.notes)
