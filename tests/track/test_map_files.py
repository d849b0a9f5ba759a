"""Map files that were read wrong without a word: right now, or refused with one sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Transformer

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track import read_track
from railfix.track.ifc_file import read_ifc_segments
from railfix.track.network_read import read_network
from railfix.track.read import read_segments
from railfix.track.route import MapReading

pyogrio = pytest.importorskip("pyogrio")
shapely = pytest.importorskip("shapely")

pytestmark = pytest.mark.requirement("A1")

LINE = [[11.0 + 0.0005 * k, 48.0 + 0.0001 * k, 480.0] for k in range(20)]
FLAT = [point[:2] for point in LINE]


def geojson(path: Path, lines: dict[str, dict[str, Any]], coordinates: list[Any] = FLAT, **members: Any) -> Path:
    """A file with a line of each name, and its properties; `members` are those of the collection."""
    features = [
        {"type": "Feature", "properties": {"id": name} | own, "geometry": {"type": "LineString", "coordinates": [
            [p[0], p[1] + 0.001 * k, *p[2:]] for p in coordinates]}}
        for k, (name, own) in enumerate(lines.items())
    ]  # fmt: skip
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features} | members))
    return path


def named(crs: str) -> dict[str, Any]:
    return {"crs": {"type": "name", "properties": {"name": crs}}}


# --- OpenStreetMap -----------------------------------------------------------

TAGS = {"1": "rail", "2": "platform", "3": "abandoned", "4": "construction", "5": "light_rail", "6": None}


@pytest.mark.parametrize("style", ["@id", "id", "tags", "only railway", "osm_id"])
@pytest.mark.parametrize("height", [[], [480.0]])
def test_platforms_and_lifted_tracks_of_openstreetmap_are_no_tracks(
    tmp_path: Path, style: str, height: list[float]
) -> None:
    """As osmtogeojson, Overpass and GDAL write it, with and without heights."""
    lines: dict[str, dict[str, Any]] = {}
    for number, railway in TAGS.items():
        tags = {} if railway is None else {"railway": railway}
        row = {"tags": {"tags": tags}, "osm_id": {"osm_id": number} | tags}.get(style, tags)
        row |= {"@id": f"way/{number}"} if style in ("@id", "tags") else {}
        lines[f"way/{number}" if style == "id" else number] = row
    path = geojson(tmp_path / "area.geojson", lines, [[*p, *height] for p in FLAT])
    segments = read_segments(path, MapReading(height_datum="ellipsoidal"))
    kept = ["1", "5"] if style == "only railway" else ["way/1", "way/5"]
    kept += ["6"] if style == "only railway" else []  # nothing says that the file is of OpenStreetMap
    assert [s.metadata["name"] for s in segments] == kept
    assert "1 railway=platform, 1 railway=abandoned, 1 railway=construction" in " ".join(segments[0].notes)


@pytest.mark.parametrize("key", ["osm_id", "track_id", "@id"])
def test_a_flat_geojson_names_its_lines_as_other_vector_files_do(tmp_path: Path, key: str) -> None:
    path = tmp_path / "a.geojson"
    rows = [{"name": None, key: f"way/{k}", "railway": "rail"} for k in (5, 6)]
    lines = [{"type": "LineString", "coordinates": [[11.0, 48.0 + k], [11.1, 48.0 + k]]} for k in (0, 1)]
    features = [{"type": "Feature", "properties": r, "geometry": g} for r, g in zip(rows, lines, strict=True)]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    assert [s.metadata["name"] for s in read_segments(path, MapReading())] == ["way/5", "way/6"]


def test_a_column_railway_of_another_meaning_leaves_nothing_out(tmp_path: Path) -> None:
    path = geojson(tmp_path / "a.geojson", {"1": {"railway": "Northern"}, "2": {"railway": "Southern"}})
    assert len(read_segments(path, MapReading())) == 2
    only = geojson(tmp_path / "b.geojson", {"1": {"railway": "platform"}})
    with pytest.raises(InputFileError, match=r"no track in this file;.*1 railway=platform"):
        read_segments(only, MapReading())


# --- frames and grids --------------------------------------------------------


def test_swapped_axes_are_named_where_the_frame_has_an_area(tmp_path: Path) -> None:
    swapped = [[y, x, z] for x, y, z in LINE]
    path = geojson(tmp_path / "a.geojson", {"1": {}}, swapped, **named("EPSG:4258"))
    with pytest.raises(InputFileError, match=r"outside the area of use of ETRS89 .* are swapped"):
        read_track(path, height_datum="ellipsoidal")
    rows = "".join(f"{x},{y},{z}\n" for x, y, z in LINE)
    (tmp_path / "a.csv").write_text("# crs: EPSG:4258\nlatitude_deg,longitude_deg,height_m\n" + rows)
    with pytest.raises(InputFileError, match=r"are swapped"):
        read_track(tmp_path / "a.csv")


@pytest.mark.parametrize("wrong", ["EPSG:28992", "EPSG:3857", "EPSG:2154"])
def test_a_wrong_grid_is_refused(tmp_path: Path, wrong: str) -> None:
    """Coordinates of UTM 32 read in the Dutch grid, Web Mercator and Lambert 93 are elsewhere, or of another size."""
    east, north = Transformer.from_crs("EPSG:4258", "EPSG:25832", always_xy=True).transform(*np.array(LINE).T[:2])
    points = [[x, y, 480.0] for x, y in zip(east, north, strict=True)]
    right = geojson(tmp_path / "a.geojson", {"1": {}}, points, **named("EPSG:25832"))
    assert len(read_track(right, height_datum="ellipsoidal")) == 20
    path = geojson(tmp_path / "b.geojson", {"1": {}}, points, **named(wrong))
    if wrong == "EPSG:3857":
        with pytest.raises(InputFileError, match=r"design is 200 m long, but 1[0-9][0-9] m on the map"):
            read_ifc_segments(ifc(tmp_path / "a.ifc"), MapReading(crs=wrong, height_datum="ellipsoidal"))
        return
    with pytest.raises(InputFileError, match=r"outside the area of use|another grid"):
        read_track(path, height_datum="ellipsoidal")


def test_a_crs_against_the_files_own_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = "".join(f"{y},{x},{z}\n" for x, y, z in LINE)
    path.write_text("# crs: EPSG:4258\nlatitude_deg,longitude_deg,height_m\n" + rows)
    with pytest.raises(SettingsError, match=r"crs EPSG:4326 \(--crs\) contradicts the file's own CRS EPSG:4258"):
        read_track(path, crs="EPSG:4326")
    assert read_track(path, crs="EPSG:4258").provenance.frame == "EPSG:4258"
    with pytest.raises(SettingsError, match="contradicts"):
        read_ifc_segments(ifc(tmp_path / "a.ifc", grid=True), MapReading(crs="EPSG:25833", height_datum="ellipsoidal"))
    own = geojson(tmp_path / "a.geojson", {"1": {}}, LINE, **named("urn:ogc:def:crs:OGC:1.3:CRS84"))
    assert read_track(own, crs="EPSG:4326", height_datum="ellipsoidal").provenance.frame == "OGC:CRS84"


def test_the_height_datum_of_a_compound_crs_is_the_maps(tmp_path: Path) -> None:
    path = geojson(tmp_path / "a.geojson", {"1": {}}, [[5.2, 52.1 + 0.001 * k, 3.0] for k in range(5)])
    document = json.loads(path.read_text()) | named("EPSG:9286")  # ETRS89 and heights above NAP
    path.write_text(json.dumps(document))
    with pytest.raises(SettingsError, match="'ellipsoidal' contradicts the file's own CRS, whose heights are NAP"):
        read_track(path, height_datum="ellipsoidal")
    with pytest.raises(SettingsError, match=r"nl_nsgi_nlgeo2018.tif, not installed"):
        read_track(path)  # which needs the geoid of the CRS, not a silent 43 m
    document["features"][0]["properties"]["geoid_m"] = [43.0] * 5
    path.write_text(json.dumps(document))
    assert read_track(path).height_m == pytest.approx(46.0)
    shape = np.array([shapely.to_wkb(shapely.LineString([[5.2, 52.1, 3.0], [5.2, 52.2, 3.0]]))])
    packed = tmp_path / "a.gpkg"
    pyogrio.raw.write(packed, shape, [], [], driver="GPKG", geometry_type="LineString Z", crs="EPSG:9286")
    with pytest.raises(SettingsError, match="whose heights are NAP"):
        read_track(packed, height_datum="ellipsoidal")


# --- what a file states ------------------------------------------------------


def test_the_accuracy_of_a_flat_geojson_is_used(tmp_path: Path) -> None:
    profile = tmp_path / "profile.csv"
    profile.write_text("# sigma_m: 0.2\nchainage_m,height_m\n0,480\n5000,480\n")
    path = geojson(tmp_path / "a.geojson", {"1": {}}, sigma_plan_m=1.5)
    assert read_track(path, heights=profile).sigma_plan_m == 1.5
    path = geojson(tmp_path / "b.geojson", {"1": {"sigma_plan_m": 2.5}})
    stated = read_track(path, heights=profile)
    assert stated.sigma_plan_m == 2.5
    assert not any("states no accuracy" in note for note in stated.provenance.notes)


@pytest.mark.requirement("A1")
def test_a_file_without_an_accuracy_is_taken_as_a_survey_with_a_note(tmp_path: Path) -> None:
    """The bound of the filter rests on it: a line drawn by hand is not known to 0.3 m."""
    profile = tmp_path / "profile.csv"
    profile.write_text("# sigma_m: 0.2\nchainage_m,height_m\n0,480\n5000,480\n")
    path = geojson(tmp_path / "c.geojson", {"1": {}})
    track = read_track(path, heights=profile)
    assert track.sigma_plan_m == 0.3
    note = "map: c.geojson states no accuracy, 0.3 m in plan is assumed, as for an aerial survey (--plan-sigma)"
    assert track.provenance.notes.count(note) == 1
    given = read_track(path, heights=profile, sigma_plan_m=3.0)
    assert given.sigma_plan_m == 3.0
    assert note not in given.provenance.notes


def test_net_relations_without_a_geometry_are_connections(tmp_path: Path) -> None:
    path = geojson(tmp_path / "a.geojson", {"a": {}, "b": {}})
    document = json.loads(path.read_text())
    relation = {"id": "r", "netelementA": "a", "netelementB": "b", "positionOnA": 1, "positionOnB": 0}
    document["features"].append({"type": "Feature", "properties": relation, "geometry": None})
    path.write_text(json.dumps(document))
    network = read_network([path])
    assert [(link.first, link.first_end, link.second, link.second_end) for link in network.links] == [(0, 1, 1, 0)]
    del relation["positionOnB"]
    path.write_text(json.dumps(document))
    with pytest.raises(InputFileError, match="net relation 'r' has no positionOnB"):
        read_network([path])


# --- IFC ---------------------------------------------------------------------

IFC = """ISO-10303-21;
HEADER;
ENDSEC;
DATA;
#1= IFCALIGNMENT('a',$,'line',$,$,#60,$,$);
#2= IFCALIGNMENTHORIZONTAL('b',$,$,$,$,#70,$,$);
#3= IFCALIGNMENTVERTICAL('c',$,$,$,$,$,$);
#5= IFCCARTESIANPOINT((10.,20.));
#11= IFCALIGNMENTHORIZONTALSEGMENT($,$,#5,0.,0.,0.,200.,$,.LINE.);
#12= IFCALIGNMENTVERTICALSEGMENT($,$,0.,200.,10.,0.,0.,$,.CONSTANTGRADIENT.);
#21= IFCALIGNMENTSEGMENT('e',$,$,$,$,$,$,#11);
#22= IFCALIGNMENTSEGMENT('f',$,$,$,$,$,$,#12);
#31= IFCRELNESTS('h',$,$,$,#1,(#2,#3));
#32= IFCRELNESTS('i',$,$,$,#2,(#21));
#33= IFCRELNESTS('j',$,$,$,#3,(#22));
#50= IFCCARTESIANPOINT((650000.,5320000.,400.));
#51= IFCDIRECTION((0.,0.,1.));
#52= IFCDIRECTION((1.,0.,0.));
#53= IFCAXIS2PLACEMENT3D(#50,#51,#52);
#54= IFCLOCALPLACEMENT($,#53);
#55= IFCCARTESIANPOINT((1000.,500.,5.));
#56= IFCDIRECTION((0.,1.,0.));
#57= IFCAXIS2PLACEMENT3D(#55,$,#56);
#60= IFCLOCALPLACEMENT(#54,#57);
{more}ENDSEC;
"""


def ifc(path: Path, *, grid: bool = False, more: str = "#70= IFCLOCALPLACEMENT(#60,#71);\n") -> Path:
    """An alignment placed on axes turned by 90 degrees, 1.1 km from those of its site."""
    more += "#71= IFCAXIS2PLACEMENT3D(#72,$,$);\n#72= IFCCARTESIANPOINT((0.,0.,0.));\n"
    if grid:
        more += "#80= IFCPROJECTEDCRS('EPSG:25832',$,$,$,$,$,$);\n"
        more += "#81= IFCMAPCONVERSION(#80,#80,0.,0.,0.,$,$,$);\n"
    path.write_text(IFC.format(more=more))
    return path


def test_the_placement_of_an_alignment_is_used(tmp_path: Path) -> None:
    """East of the line is 650,000 + 1000 - 20, north 5,320,000 + 500 + 10 and on, height 400 + 5 + 10."""
    (segment,) = read_ifc_segments(ifc(tmp_path / "a.ifc"), MapReading(crs="EPSG:25832", height_datum="ellipsoidal"))
    longitude, latitude = Transformer.from_crs("EPSG:25832", "EPSG:4258", always_xy=True).transform(
        [650980.0, 650980.0], [5320510.0, 5320710.0]
    )
    expected = ecef_from_geodetic(np.array(latitude), np.array(longitude), np.array([415.0, 415.0]))
    found = ecef_from_geodetic(segment.latitude_deg, segment.longitude_deg, segment.height_m)[[0, -1]]
    assert np.linalg.norm(found - expected, axis=1).max() < 1e-3


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("#70= IFCLINEARPLACEMENT(#60,#71,$);\n", "IFCLINEARPLACEMENT"),
        (
            "#70= IFCLOCALPLACEMENT(#60,#73);\n#73= IFCAXIS2PLACEMENT3D(#72,#74,$);\n#74= IFCDIRECTION((0.,1.,0.));\n",
            "not vertical",
        ),
    ],
)
def test_placements_that_are_not_read_are_refused(tmp_path: Path, more: str, message: str) -> None:
    with pytest.raises(InputFileError, match=message):
        read_ifc_segments(ifc(tmp_path / "a.ifc", more=more), MapReading(crs="EPSG:25832", height_datum="ellipsoidal"))


@pytest.mark.parametrize("scale", ["$", "1.", "0.001"])
def test_a_map_conversion_of_a_file_in_millimetres(tmp_path: Path, scale: str) -> None:
    """Its scale is that of the file's units, or left out; any other is refused."""
    path = ifc(tmp_path / "a.ifc", grid=True)
    text = path.read_text().replace("0.,0.,0.,$,$,$);\nENDSEC", f"0.,0.,0.,$,$,{scale});\nENDSEC")
    text = text.replace("ENDSEC;\n", "", 1).replace("DATA;", "ENDSEC;\nDATA;\n#90= IFCUNITASSIGNMENT((#91));", 1)
    text = text.replace("#91));", "#91));\n#91= IFCSIUNIT(*,.LENGTHUNIT.,.MILLI.,.METRE.);", 1)
    for metres in ("200.", "10.,0.,0.,$", "1000.,500.,5.", "650000.,5320000.,400.", "10.,20."):
        mm = ",".join(f"{float(v) * 1000}" if v not in ("0.", "$") else v for v in metres.split(","))
        text = text.replace(metres, mm)
    path.write_text(text)
    (segment,) = read_ifc_segments(path, MapReading(height_datum="ellipsoidal"))
    assert segment.height_m[0] == pytest.approx(415.0)
    assert segment.latitude_deg[0] == pytest.approx(48.0199, abs=0.01)
    path.write_text(text.replace(f"$,$,{scale});", "$,$,0.3048);"))
    with pytest.raises(InputFileError, match=r"scale 0\.3048 of IfcMapConversion"):
        read_ifc_segments(path, MapReading(height_datum="ellipsoidal"))


def test_a_frame_is_looked_up_once_for_all_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """PROJ takes milliseconds for a frame: once a line, that was three quarters of the time of opening a network."""
    from railfix.track import crs

    path = geojson(tmp_path / "a.geojson", {str(k): {} for k in range(50)}, **named("EPSG:25833"))
    document = json.loads(path.read_text())
    for k, feature in enumerate(document["features"]):
        feature["geometry"]["coordinates"] = [[400000.0 + 25.0 * n, 5700000.0 + 100.0 * k] for n in range(5)]
    path.write_text(json.dumps(document))
    found = []
    system = crs.CRS.from_user_input
    monkeypatch.setattr(crs.CRS, "from_user_input", lambda name: (found.append(name), system(name))[1])
    assert len(read_segments(path, MapReading())) == 50
    assert found.count("EPSG:25833") < 10
