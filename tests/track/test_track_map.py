"""Track maps from files: columns, heights, routes, marking, and what is refused."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import japan_geoid
import numpy as np
import pytest
from pyproj import Transformer

from railfix.core.errors import InputFileError, OutputError, RailfixError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track import Track, interpolate_kilometrage, read_track, write_track_csv

HEADER = "latitude_deg,longitude_deg,height_m,cant_mm,radius_m,gradient_permille,kilometrage_m"
ROWS = [
    "35.0000,139.0000,50.0,0,,0,1000",
    "35.0001,139.0000,50.1,20,600,9,1011.1",
    "35.0002,139.00001,50.2,40,300,9,1022.2",
]
GOOD = "\n".join([HEADER, *ROWS]) + "\n"


def write(folder: Path, text: str | bytes, name: str = "line.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def refused(path: Path | list[Path], error: type[RailfixError] = InputFileError, **options: str) -> str:
    with pytest.raises(error) as caught:
        read_track(path, **options)  # type: ignore[arg-type]
    sentence = str(caught.value)
    assert "\n" not in sentence
    return sentence


@pytest.mark.requirement("A1")
def test_columns_by_name(tmp_path: Path) -> None:
    track = read_track(write(tmp_path, GOOD))
    np.testing.assert_allclose(track.cant_m, [0.0, 0.02, 0.04])
    np.testing.assert_array_equal(track.radius_m, [np.inf, 600.0, 300.0])  # blank is straight
    np.testing.assert_allclose(track.kilometrage_m, [1000.0, 1011.1, 1022.2])
    np.testing.assert_allclose(
        track.ecef_m, ecef_from_geodetic(track.latitude_deg, track.longitude_deg, track.height_m)
    )
    steps = np.linalg.norm(np.diff(track.ecef_m, axis=0), axis=1)
    np.testing.assert_allclose(np.diff(track.chainage_m), steps)
    assert track.name == "line"
    assert (track.sigma_plan_m, track.sigma_height_m) == (0.30, 0.60)
    assert not track.ecef_m.flags.writeable


@pytest.mark.parametrize(
    "text",
    [
        "\ufeff" + GOOD,
        GOOD.replace("\n", "\r\n"),
        "# surveyed: 2020\n\n" + GOOD.replace(",", " , "),
        GOOD.replace(",", ",", 1) + "\n# the end\n",
        GOOD.replace(",,", ",0,", 1),
        GOOD.replace(",,", ",inf,", 1),
    ],
    ids=["BOM", "CR LF", "comment and spaces", "comment at the end", "radius 0", "radius inf"],
)
def test_the_same_map_in_other_clothes(tmp_path: Path, text: str) -> None:
    expected = read_track(write(tmp_path, GOOD, "good.csv"))
    track = read_track(write(tmp_path, text))
    np.testing.assert_array_equal(track.ecef_m, expected.ecef_m)
    np.testing.assert_array_equal(track.radius_m, expected.radius_m)


def test_attributes_that_the_map_lacks_are_nan_and_extra_columns_named(tmp_path: Path) -> None:
    rows = "latitude_deg,longitude_deg,height_m,surveyor\n35,139,1,x\n35.1,139,2,y\n"
    text = "# name: loop line\n# sigma_plan_m: 0.1\n" + rows
    track = read_track(write(tmp_path, text))
    for values in (track.cant_m, track.radius_m, track.gradient_permille, track.kilometrage_m):
        assert np.isnan(values).all()
    assert track.provenance.notes == (f"{tmp_path / 'line.csv'}: columns not used: surveyor",)
    assert (track.name, track.sigma_plan_m) == ("loop line", 0.1)


# --- heights -----------------------------------------------------------------


@pytest.mark.requirement("A1")
@pytest.mark.parametrize(
    ("geoid", "name", "load"),
    [
        ("japan", "JPGEO2024", japan_geoid.load_embedded_jpgeo2024),
        ("gsigeo2011", "GSIGEO2011", japan_geoid.load_embedded_gsigeo2011),
    ],
)
def test_orthometric_heights_take_the_geoid_and_name_it(tmp_path: Path, geoid: str, name: str, load: object) -> None:
    track = read_track(write(tmp_path, GOOD.replace("height_m", "elevation_m")), geoid=geoid)
    undulation = load().get_height(139.0, 35.0)  # type: ignore[operator]
    assert 35.0 < undulation < 45.0  # around Tokyo
    assert track.height_m[0] == pytest.approx(50.0 + undulation, abs=1e-9)
    assert track.provenance.geoid == name
    assert track.provenance.height_datum_used == "orthometric"


def test_geoid_as_a_column_and_as_metadata(tmp_path: Path) -> None:
    column = "latitude_deg,longitude_deg,elevation_m,geoid_m\n50,4,10,44.5\n50.1,4,11,44.6\n"
    np.testing.assert_allclose(read_track(write(tmp_path, column)).height_m, [54.5, 55.6])
    named = "# geoid: gsigeo2011\n" + GOOD.replace("height_m", "elevation_m")
    assert read_track(write(tmp_path, named)).provenance.geoid == "GSIGEO2011"


def test_geoid_from_a_grid_file_of_pyproj(tmp_path: Path) -> None:
    """A two-by-two grid in NOAA's GTX format, 44 m everywhere but one corner."""
    head = np.array([49.0, 3.0, 2.0, 2.0], dtype=">f8").tobytes() + np.array([2, 2], dtype=">i4").tobytes()
    grid = tmp_path / "small.gtx"
    grid.write_bytes(head + np.array([44.0, 44.0, 44.0, 48.0], dtype=">f4").tobytes())
    text = "latitude_deg,longitude_deg,elevation_m\n50,4,10\n50,3.5,10\n"
    track = read_track(write(tmp_path, text), geoid=str(grid))
    np.testing.assert_allclose(track.height_m, [55.0, 54.5], atol=1e-6)  # bilinear: 44 + 4 x y
    assert track.provenance.geoid == str(grid)


@pytest.mark.parametrize(
    ("text", "options", "error", "said"),
    [
        (GOOD.replace("height_m", "elevation_m"), {}, InputFileError, "require a geoid"),
        (GOOD.replace("height_m", "elevation_m"), {"geoid": "egm9000"}, SettingsError, "'egm9000' is unknown"),
        (
            GOOD.replace("height_m", "elevation_m"),
            {"geoid": "none_such.gtx"},
            SettingsError,
            "the grid is not installed",
        ),
        (GOOD.replace("height_m", "elevation_m"), {"geoid": "EPSG:3855"}, SettingsError, "not installed (projsync"),
        (GOOD.replace("height_m", "elevation_m"), {"geoid": "EPSG:6677"}, SettingsError, "no height datum"),
        (GOOD, {"geoid": "japan"}, SettingsError, "ellipsoidal already"),
        (GOOD, {"height_datum": "orthometric"}, InputFileError, "height_m is ellipsoidal"),
        (GOOD, {"height_datum": "sea level"}, SettingsError, "'sea level' is unknown"),
        (
            "latitude_deg,longitude_deg,elevation_m\n50,4,10\n50.1,4,11\n",
            {"geoid": "japan"},
            InputFileError,
            "outside the geoid JPGEO2024",
        ),
        (
            "latitude_deg,longitude_deg,elevation_m,geoid_m\n50,4,10,44\n50.1,4,11,44\n",
            {"geoid": "japan"},
            SettingsError,
            "use one",
        ),
    ],
)
def test_heights_are_never_guessed(
    tmp_path: Path, text: str, options: dict[str, str], error: type[RailfixError], said: str
) -> None:
    assert said in refused(write(tmp_path, text), error, **options)


# --- broken CSV --------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("\n \n", "is empty"),
        (b"\x1f\x8b\0\0binary", "the packed data are damaged"),
        (bytes(range(256)), "binary"),
        ("緯度,経度\n".encode("shift_jis"), "not UTF-8"),
        ("35.0,139.0,50\n35.1,139,50\n", "line 1: has numbers where a header"),
        (HEADER + "\n", "0 points"),
        (HEADER + "\n" + ROWS[0], "1 point"),
        (GOOD.replace("latitude_deg", "lattitude_deg"), "did you mean 'latitude_deg'"),
        (GOOD.replace("cant_mm", "cant_m"), "did you mean 'cant_mm'"),
        (GOOD.replace("latitude_deg", "y"), "no column 'latitude_deg'"),
        (GOOD.replace("height_m", "z"), "neither 'height_m' nor 'elevation_m'"),
        (GOOD.replace("cant_mm", "elevation_m"), "both 'height_m' and 'elevation_m'"),
        (GOOD.replace("cant_mm", "radius_m"), "occurs twice"),
        (GOOD.replace("35.0001", "abc"), "line 3: column latitude_deg: 'abc' is not a number"),
        (GOOD.replace("35.0001", ""), "line 3: column latitude_deg: the cell is empty"),
        (GOOD.replace("35.0001", "nan"), "line 3: column latitude_deg: 'nan' is not a finite"),
        (GOOD.replace("50.1", "inf"), "line 3: column height_m: 'inf' is not a finite"),
        (GOOD.replace(",20,", ",inf,"), "line 3: column cant_mm"),
        (GOOD.replace("35.0001,", ""), "line 3: 6 cells where the header"),
        (GOOD + "35.0003,139", "line 5: 2 cells"),
        ("latitude_deg,longitude_deg,height_m\n139,35,1\n139.1,35,1\n", "line 2: latitude_deg 139 is over 90"),
        ("latitude_deg,longitude_deg,height_m\n35,13900,1\n35.1,139,1\n", "over 360"),
        ("latitude_deg,longitude_deg,height_m\n0.61,2.43,1\n0.62,2.43,1\n", "radians"),
        ("# height_datum: orthometric\n" + GOOD, "'# height_datum' is 'orthometric'"),
        ("# sigma_plan_m: small\n" + GOOD, "a number in metres"),
        ("# sigma_plan_m: -1\n" + GOOD, "a positive number"),
    ],
)
def test_broken_csv_is_refused_in_one_sentence(tmp_path: Path, text: str | bytes, said: str) -> None:
    sentence = refused(write(tmp_path, text))
    assert said in sentence
    assert "line.csv" in sentence


def test_files_that_are_none(tmp_path: Path) -> None:
    assert "no such file" in refused(tmp_path / "none.csv")
    assert "a track map (a table, GeoJSON" in refused(write(tmp_path, "notes", "line.txt"))
    folder = tmp_path / "folder.csv"
    folder.mkdir()
    assert "a folder" in refused(folder)
    assert "no file was given" in refused([], SettingsError)


@pytest.mark.parametrize(("crs", "said"), [("EPSG:6677", "projected coordinates"), ("EPSG:0", "unknown")])
def test_crs_of_a_csv_is_geographic(tmp_path: Path, crs: str, said: str) -> None:
    assert said in refused(write(tmp_path, GOOD), SettingsError, crs=crs)
    assert read_track(write(tmp_path, GOOD), crs="EPSG:6668").provenance.crs == "EPSG:6668"


# --- GeoJSON -----------------------------------------------------------------

LINE = [[139.0, 35.0, 50.0], [139.0, 35.001, 50.5], [139.0001, 35.002, 51.0]]


def feature(coordinates: object, kind: str = "LineString", **properties: object) -> dict[str, object]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def geojson(folder: Path, document: object, name: str = "line.geojson") -> Path:
    return write(folder, json.dumps(document), name)


@pytest.mark.requirement("A1")
def test_geojson_line_with_attributes(tmp_path: Path) -> None:
    document = feature(
        LINE, height_datum="ellipsoidal", cant_mm=[0, 10, None], radius_m=[None, 400, 400], name="east line"
    )
    track = read_track(geojson(tmp_path, document))
    np.testing.assert_allclose(track.latitude_deg, [35.0, 35.001, 35.002], atol=1e-12)
    np.testing.assert_array_equal(track.cant_m, [0.0, 0.01, np.nan])
    np.testing.assert_array_equal(track.radius_m, [np.inf, 400.0, 400.0])
    assert track.provenance.crs == "OGC:CRS84"
    assert track.name == "east line"


def test_geojson_in_a_projected_system(tmp_path: Path) -> None:
    """Zone IX of Japan's plane rectangular system, easting first as GIS programs write it."""
    forward = Transformer.from_crs("EPSG:4326", "EPSG:6677", always_xy=True)
    plane = [[*forward.transform(lon, lat), height] for lon, lat, height in LINE]
    bare = {"type": "LineString", "coordinates": plane}
    track = read_track(geojson(tmp_path, bare), crs="EPSG:6677", height_datum="ellipsoidal")
    np.testing.assert_allclose(track.latitude_deg, [35.0, 35.001, 35.002], atol=1e-10)
    member = bare | {"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::6677"}}}
    named = read_track(geojson(tmp_path, member), height_datum="ellipsoidal")
    np.testing.assert_allclose(named.ecef_m, track.ecef_m, atol=1e-6)
    assert "contradicts" in refused(
        geojson(tmp_path, member), SettingsError, height_datum="ellipsoidal", crs="EPSG:6678"
    )


def test_geojson_collection_and_multi_line_are_a_route(tmp_path: Path) -> None:
    more = [[139.0001, 35.002, 51.0], [139.0001, 35.003, 51.0]]
    collection = {"type": "FeatureCollection", "features": [feature(LINE), feature(more[::-1])], "name": "route"}
    multi = feature([LINE, more], "MultiLineString", cant_mm=[[1, 2, 3], [4, 5]])
    for document in (collection, multi):
        track = read_track(geojson(tmp_path, document), height_datum="ellipsoidal")
        np.testing.assert_allclose(track.latitude_deg, [35.0, 35.001, 35.002, 35.003], atol=1e-12)
        np.testing.assert_array_equal(track.section, [0, 0, 0, 1])
        assert track.provenance.files == (str(tmp_path / "line.geojson"),)
    np.testing.assert_allclose(track.cant_m, [0.001, 0.002, 0.003, 0.005])


@pytest.mark.parametrize(
    ("document", "said"),
    [
        ([1, 2], "not a GeoJSON object"),
        ({"type": "Point", "coordinates": [1, 2, 3]}, "type 'Point'"),
        ({"type": "FeatureCollection", "features": []}, "no features"),
        ({"type": "Feature", "geometry": None}, "no geometry"),
        (feature([[1, 2], [3, 4]]), "no height"),
        (feature([[1, 50, 2]]), "at least two points"),
        (feature([[1, 50, 2], [1, 51]]), "all points must be"),
        (feature([[1, 50, 2], [1, "x", 3]]), "not a number"),
        (feature([[1, 50, 2], [1, None, 3]]), "not finite"),
        (feature(LINE, height_datum="levelled"), "expected 'ellipsoidal' or 'orthometric'"),
        (feature(LINE, height_datum="orthometric"), "require a geoid"),
        (feature([p[1::-1] + p[2:] for p in LINE], height_datum="ellipsoidal"), "swapped"),
        (feature(LINE, height_datum="ellipsoidal", cant_mm=[1, 2]), "2 for 3 points"),
        (feature(LINE, height_datum="ellipsoidal", cant_mm=5), "a single value for 3 points"),
        (feature(LINE, height_datum="ellipsoidal", cant_mm=[1, 2, "x"]), "not a number"),
        (feature(LINE, height_datum="ellipsoidal", cantt_mm=[1, 2, 3]), "did you mean 'cant_mm'"),
    ],
)
def test_broken_geojson_is_refused_in_one_sentence(tmp_path: Path, document: object, said: str) -> None:
    sentence = refused(geojson(tmp_path, document))
    assert said in sentence
    assert "line.geojson" in sentence


def test_geojson_without_a_height_datum(tmp_path: Path) -> None:
    assert "the height datum is missing" in refused(geojson(tmp_path, feature(LINE)), SettingsError)


def test_geojson_with_an_unknown_crs(tmp_path: Path) -> None:
    member = {"crs": {"type": "name", "properties": {"name": "EPSG:0"}}}
    document = feature(LINE, height_datum="ellipsoidal")
    assert "'EPSG:0' is unknown" in refused(geojson(tmp_path, document | member), SettingsError)
    assert "'EPSG:0' is unknown" in refused(geojson(tmp_path, document | member), SettingsError, crs="EPSG:6677")
    assert "give crs (--crs)" in refused(geojson(tmp_path, document | {"crs": {"type": "name"}}))


def test_geojson_that_is_no_json_names_the_line(tmp_path: Path) -> None:
    assert "line 2: this is not JSON" in refused(write(tmp_path, '{"type":\n oops}', "line.geojson"))


def test_real_network_without_heights_is_refused(recordings: Path) -> None:
    sentence = refused(recordings / "rail" / "infrabel" / "network_airport.geojson", height_datum="ellipsoidal")
    assert "no height" in sentence


# --- routes ------------------------------------------------------------------


def _csv(folder: Path, name: str, latitudes: list[float], kilometrage: list[float], radius: float = 500.0) -> Path:
    rows = [f"{lat},139.0,10,{radius},{km}" for lat, km in zip(latitudes, kilometrage, strict=True)]
    return write(folder, "\n".join(["latitude_deg,longitude_deg,height_m,radius_m,kilometrage_m", *rows]), name)


@pytest.mark.requirement("A1")
def test_segments_make_a_route_and_turn_where_needed(tmp_path: Path) -> None:
    first = _csv(tmp_path, "a.csv", [35.0, 35.001], [0.0, 111.0])
    second = _csv(tmp_path, "b.csv", [35.003, 35.002, 35.001], [5222.0, 5111.0, 5000.0])
    third = _csv(tmp_path, "c.csv", [35.003, 35.004], [900.0, 1011.0])
    track = read_track([first, second, third])
    np.testing.assert_allclose(track.latitude_deg, [35.0, 35.001, 35.002, 35.003, 35.004])
    np.testing.assert_array_equal(track.kilometrage_m, [0.0, 111.0, 5111.0, 5222.0, 1011.0])
    np.testing.assert_array_equal(track.radius_m, [500.0, 500.0, -500.0, -500.0, 500.0])
    np.testing.assert_array_equal(track.section, [0, 0, 1, 1, 2])
    assert track.sections == (str(first), str(second), str(third))
    assert any("against the order" in note for note in track.provenance.notes)
    turned = read_track([_csv(tmp_path, "a.csv", [35.001, 35.0], [111.0, 0.0]), second])
    np.testing.assert_allclose(turned.latitude_deg, [35.0, 35.001, 35.002, 35.003])


def test_gap_between_segments_names_both_files_and_the_gap(tmp_path: Path) -> None:
    first = _csv(tmp_path, "a.csv", [35.0, 35.001], [0.0, 111.0])
    second = _csv(tmp_path, "b.csv", [35.0011, 35.002], [122.0, 222.0])
    sentence = refused([first, second])
    assert str(first) in sentence
    assert str(second) in sentence
    assert "11.0" in sentence  # 0.0001 degrees of latitude are 11.1 m
    assert len(read_track([first, second], max_gap_m=12.0)) == 4


@pytest.mark.requirement("A1")
def test_marking_that_runs_backwards_and_jumps() -> None:
    chainage = np.array([0.0, 100.0, 200.0, 300.0])
    marking = np.array([500.0, 400.0, 2300.0, 2400.0])
    found = interpolate_kilometrage([0.0, 50.0, 100.0, 130.0, 170.0, 250.0, np.nan], chainage, marking)
    np.testing.assert_allclose(found, [500.0, 450.0, 400.0, 370.0, 2270.0, 2350.0, np.nan])
    np.testing.assert_array_equal(interpolate_kilometrage([50.0], chainage, np.full(4, np.nan)), [np.nan])


# --- writing -----------------------------------------------------------------


def test_written_map_reads_back_the_same(tmp_path: Path) -> None:
    track = Track.from_geodetic(
        [35.0, 35.00001234567, 35.1],
        [139.0, 139.0, 139.1],
        [1.0, 2.00004, 3.0],
        name="written",
        radius_m=[np.inf, np.nan, -250.0],
        cant_m=[0.0, np.nan, 0.0885],
        sigma_plan_m=0.05,
    )
    write_track_csv(track, tmp_path / "out.csv")
    again = read_track(tmp_path / "out.csv")
    np.testing.assert_allclose(again.ecef_m, track.ecef_m, atol=1e-4)
    np.testing.assert_array_equal(again.radius_m, track.radius_m)
    np.testing.assert_allclose(again.cant_m, track.cant_m)
    assert (again.name, again.sigma_plan_m) == ("written", 0.05)
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]


def test_map_that_cannot_be_written(tmp_path: Path) -> None:
    track = Track.from_geodetic([35.0, 35.1], [139.0, 139.0], [1.0, 2.0])
    with pytest.raises(OutputError, match="cannot be written"):
        write_track_csv(track, tmp_path / "absent" / "out.csv")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        write_track_csv(track, tmp_path / "folder.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["folder.csv"]


@pytest.mark.parametrize(
    ("latitude", "options", "said"),
    [
        ([35.0], {}, "at least two points"),
        ([35.0, np.nan], {}, "finite"),
        ([35.0, 35.1], {"sigma_plan_m": 0.0}, "positive"),
        ([35.0, 35.1], {"cant_m": [1.0]}, "cant_m has shape"),
    ],
)
def test_arrays_that_are_no_track(latitude: list[float], options: dict[str, object], said: str) -> None:
    other = np.zeros(len(latitude))
    with pytest.raises(ValueError, match=said):
        Track.from_geodetic(latitude, other, other, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("mark", ["", "\ufeff"], ids=["plain", "byte order mark"])
@pytest.mark.parametrize("kind", ["csv", "geojson"])
def test_packed_maps_and_byte_order_marks(tmp_path: Path, kind: str, mark: str) -> None:
    line = [[139.0, 35.0, 10.0], [139.0, 35.001, 11.0]]
    document = {"type": "LineString", "coordinates": line, "height_datum": "ellipsoidal"}
    text = GOOD if kind == "csv" else json.dumps(document)
    plain = read_track(write(tmp_path, text, f"line.{kind}"))
    packed = read_track(write(tmp_path, gzip.compress((mark + text).encode()), f"LINE.{kind.upper()}.GZ"))
    assert np.array_equal(packed.ecef_m, plain.ecef_m)
    assert read_track(write(tmp_path, mark + text, f"line.{kind}")).ecef_m.tolist() == plain.ecef_m.tolist()


def test_arrays_of_a_track_are_read_only_and_the_given_ones_stay_as_they_are(tmp_path: Path) -> None:
    given = np.array([35.0, 35.001])
    track = Track.from_geodetic(given, [139.0, 139.0], [10.0, 11.0])
    with pytest.raises(ValueError, match="read-only"):
        track.latitude_deg[0] = 0.0
    given[0] = 0.0
    assert track.latitude_deg[0] == 35.0
    assert read_track(write(tmp_path, GOOD)).kilometrage_m.flags.writeable is False


@pytest.mark.parametrize("names", ["lat,lon,height", "Latitude,Longitude,Altitude", "LAT;LNG;elevation"])
def test_usual_names_of_columns_need_the_height_datum_alone(tmp_path: Path, names: str) -> None:
    separator = ";" if ";" in names else ","
    rows = [f"35.000{k},139.0,5{k}.5".replace(",", separator) for k in range(3)]
    path = write(tmp_path, "\n".join([names, *rows]))
    assert "--height-datum" in refused(path)
    track = read_track(path, height_datum="ellipsoidal")
    np.testing.assert_allclose(track.height_m, [50.5, 51.5, 52.5])
    path = write(tmp_path, "\n".join([names.replace(names.split(separator)[2], "height_ft"), *rows]))
    assert "is in feet; convert its numbers" in refused(path)
