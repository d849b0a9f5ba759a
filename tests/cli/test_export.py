"""``railfix export``: every format read back without the program that wrote it, styles, and what goes wrong."""

from __future__ import annotations

import json
import math
import shutil
import sqlite3
import struct
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
import pandas
import polars as pl
import pyarrow.parquet
import pyogrio
import pytest
import shapely
from fastkml.validator import validate as validate_kml
from lxml import etree
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from pyproj import CRS, Transformer
from typer.testing import CliRunner

from railfix.cli import app
from railfix.core.reasons import POSITIONED
from railfix.io.positions_export import STATUS_COLOURS
from railfix.pipeline.config import parse_config
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_inputs, demo_truth
from railfix.tracking import TrackStatus

RUNNER = CliRunner(env={"COLUMNS": "200", "TERM": "dumb", "NO_COLOR": "1"})
pytestmark = pytest.mark.requirement("G4")

#: GPS time less UTC at the time of the demonstration.
LEAP: Final = timedelta(seconds=18)
#: Rows of the filter that get no position, and the row whose level becomes infinite.
WITHOUT: Final = (5, 6, 150)
UNBOUNDED: Final = 200


@dataclass(frozen=True, kw_only=True)
class Point:
    """One position as a file has it."""

    place: tuple[float, float, float]
    utc: datetime
    antenna: str
    status: str
    chainage_m: float
    level_m: float | None
    gpst: str


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of the demonstration; some positions of the filter are taken away."""
    out = tmp_path_factory.mktemp("exported") / "results"
    first = pl.read_csv(demo_truth(), try_parse_dates=True)["time_gpst"][0]
    options = RunOptions(end=first + timedelta(seconds=20))
    run_files(demo_inputs(), parse_config({"filter": "track"}), out=out, options=options)
    row = pl.int_range(pl.len())
    place = ("longitude_deg", "latitude_deg", "height_m", "x_m", "y_m", "z_m")
    pl.read_parquet(out / "train.parquet").with_columns(
        pl.when(~row.is_in(WITHOUT)).then(pl.col(place)),
        protection_level_m=pl.when(row == UNBOUNDED).then(math.inf).otherwise("protection_level_m"),
    ).write_parquet(out / "train.parquet")
    return out


def export(run: Path, out: Path, *more: str) -> str:
    result = RUNNER.invoke(app, ["export", str(run), "--out", str(out), *more])
    assert result.exit_code == 0, result.output
    return " ".join(result.output.split())


def refused(run: Path, out: Path, *more: str) -> tuple[int, str]:
    result = RUNNER.invoke(app, ["export", str(run), "--out", str(out), *more])
    assert isinstance(result.exception, SystemExit), repr(result.exception)
    return result.exit_code, " ".join(result.output.split())


# -- readers that share nothing with the writers --------------------------------------------------------------


def number(text: object) -> float | None:
    return None if text is None else float(str(text))


def point(values: dict[str, object], place: tuple[float, ...], utc: object) -> Point:
    at = utc if isinstance(utc, datetime) else datetime.fromisoformat(str(utc))
    assert at.utcoffset() == timedelta(0)
    return Point(
        place=(place[0], place[1], place[2]),
        utc=at.replace(tzinfo=None),
        antenna=str(values["antenna"]),
        status=str(values["status"]),
        chainage_m=float(str(values["chainage_m"])),
        level_m=number(values.get("protection_level_m")),
        gpst=str(values["time_gpst"]),
    )


def place_of(wkb: bytes) -> tuple[float, ...]:
    order, kind, *place = struct.unpack("<BI3d", wkb)
    assert (order, kind) == (1, 1001)
    return tuple(place)


def read_kml(path: Path) -> list[Point]:
    name = {"k": "http://www.opengis.net/kml/2.2"}
    points = []
    for mark in ElementTree.parse(path).iterfind(".//k:Placemark", name):
        values = {
            str(data.get("name")): data.findtext("k:value", None, name) for data in mark.iterfind(".//k:Data", name)
        }
        assert mark.findtext("k:styleUrl", None, name) == f"#{values['status']}"
        place = [float(v) for v in mark.findtext("k:Point/k:coordinates", "", name).split(",")]
        points.append(point(dict(values), tuple(place), mark.findtext("k:TimeStamp/k:when", None, name)))
    return points


def read_gpx(path: Path) -> list[Point]:
    name = {"g": "http://www.topografix.com/GPX/1/1"}
    points = []
    for track in ElementTree.parse(path).iterfind("g:trk", name):
        for node in track.iterfind(".//g:trkpt", name):
            values = {child.tag.partition("}")[2]: child.text for child in node.find("g:extensions", name) or ()}
            assert values["antenna"] == track.findtext("g:name", None, name)
            place = float(node.attrib["lon"]), float(node.attrib["lat"]), float(node.findtext("g:ele", "", name))
            points.append(point(dict(values), place, node.findtext("g:time", None, name)))
    return points


def read_geojson(path: Path) -> list[Point]:
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    return [point(f["properties"], f["geometry"]["coordinates"], f["properties"]["time_utc"]) for f in features]


def read_geopackage(path: Path) -> list[Point]:
    with sqlite3.connect(path) as base:
        base.row_factory = sqlite3.Row
        ((table, srs),) = base.execute("select table_name, srs_id from gpkg_geometry_columns").fetchall()
        codes = base.execute("select organization_coordsys_id from gpkg_spatial_ref_sys where srs_id=?", [srs])
        assert codes.fetchone()[0] == 4979
        rows = base.execute(f'select * from "{table}"').fetchall()
    base.close()
    points = []
    for row in rows:
        assert row["geom"][:2] == b"GP"
        place = place_of(row["geom"][-29:])  # behind a header with an envelope or without
        points.append(point(dict(row), place, row["time_utc"]))
    return points


def read_geoparquet(path: Path) -> list[Point]:
    file = pyarrow.parquet.ParquetFile(path)
    geo = json.loads(file.metadata.metadata[b"geo"])
    column = geo["columns"][geo["primary_column"]]
    assert (column["encoding"], column["geometry_types"]) == ("WKB", ["Point Z"])
    assert column["crs"]["id"] == {"authority": "EPSG", "code": 4979}
    rows = file.read().to_pandas()
    points = [
        point(row, place_of(row[geo["primary_column"]]), row["time_utc"].to_pydatetime(warn=False))
        for row in rows.replace({np.nan: None}).to_dict("records")
    ]
    box = np.array([p.place for p in points])
    np.testing.assert_array_equal(column["bbox"], [*box.min(axis=0), *box.max(axis=0)])
    return points


def messages(path: Path) -> Iterator[tuple[str, int, Any]]:
    """Topic, time [ns] and content of each message."""
    with path.open("rb") as file:
        for _, channel, message, content in make_reader(
            file, decoder_factories=[DecoderFactory()]
        ).iter_decoded_messages():
            yield channel.topic, message.log_time, content


def read_mcap(path: Path) -> list[Point]:
    """Rows of the filter or of single epochs, at the place and time of the fix beside each."""
    fixes = {}
    points = []
    for topic, time, message in messages(path):
        stamp = 10**9 * message.header.stamp.sec + message.header.stamp.nanosec
        assert topic.startswith(f"/{message.header.frame_id}/")
        assert time == stamp
        if topic.endswith("/fix"):
            fixes[topic.split("/")[1], stamp] = (message.longitude, message.latitude, message.altitude)
        elif topic.endswith("/row"):
            values = {name: getattr(message, name) for name in message.__slots__}
            values["protection_level_m"] = level if math.isfinite(level := message.protection_level_m) else None
            utc = datetime.fromtimestamp(stamp / 1e9, UTC)
            points.append(point(values, fixes[message.antenna, stamp], utc))
    return points


READERS: Final[dict[str, Callable[[Path], list[Point]]]] = {
    ".kml": read_kml, ".gpx": read_gpx, ".geojson": read_geojson, ".gpkg": read_geopackage, ".parquet": read_geoparquet,
    ".mcap": read_mcap,
}  # fmt: skip


# -- contents -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", ["train", "positions"])
@pytest.mark.parametrize("ending", READERS)
def test_positions_read_back_to_a_millimetre(results: Path, tmp_path: Path, ending: str, table: str) -> None:
    out = tmp_path / f"run{ending}"
    said = export(results, out, *(["--single"] if table == "positions" else []))
    rows = pl.read_parquet(results / f"{table}.parquet").drop_nulls("x_m").sort("antenna", "time_gpst")
    assert len(rows) == (400 - len(WITHOUT) if table == "train" else 400)
    assert f"{len(rows)} of 400 possible positions" in said
    assert "WGS 84 (ITRF2020 at 2024.18), heights above the ellipsoid" in said
    points = sorted(READERS[ending](out), key=lambda p: (p.antenna, p.utc))
    assert [p.antenna for p in points] == rows["antenna"].to_list()
    assert [p.status for p in points] == rows["status"].cast(pl.String).to_list()
    assert [p.utc for p in points] == [time - LEAP for time in rows["time_gpst"].dt.cast_time_unit("us")]
    gpst = rows["time_gpst"].dt.strftime("%F %H:%M:%S%.3f").to_list()
    assert [f"{p.gpst}.000".replace("T", " ")[:23] for p in points] == gpst
    to_ecef = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    ecef = to_ecef.transform(*np.array([p.place for p in points]).T)
    np.testing.assert_allclose(np.array(ecef).T, rows.select("x_m", "y_m", "z_m").to_numpy(), rtol=0.0, atol=1e-3)
    np.testing.assert_allclose([p.chainage_m for p in points], rows["chainage_m"].to_numpy(), rtol=0.0, atol=1e-3)
    level = rows["protection_level_m"]
    assert level.is_infinite().any() == (table == "train")
    expected = [None if v is None or math.isinf(v) else pytest.approx(v, abs=1e-3) for v in level]
    assert [p.level_m for p in points] == expected


@pytest.mark.parametrize("ending", [".kml", ".gpx", ".geojson", ".gpkg"])
def test_gdal_shows_the_positions_as_a_gis_does(results: Path, tmp_path: Path, ending: str) -> None:
    """GDAL opens each file by its content: points with heights, in WGS 84, at the places and times of the run."""
    out = tmp_path / f"run{ending}"
    export(results, out)
    rows = pl.read_parquet(results / "train.parquet").drop_nulls("x_m").sort("antenna", "time_gpst")
    names = ["track_points"] if ending == ".gpx" else [str(name) for name, _ in pyogrio.list_layers(out)]
    parts = [pyogrio.raw.read(out, layer=name) for name in names]
    points = [shapely.from_wkb(geometry) for _, _, geometry, _ in parts]
    place = shapely.get_coordinates(np.concatenate(points), include_z=True)
    for meta, *_ in parts:
        assert CRS(meta["crs"]).to_epsg() in (4326, 4979)
    field = {".gpx": "time", ".kml": "timestamp"}.get(ending, "time_utc")
    times = np.concatenate([values[list(meta["fields"]).index(field)] for meta, _, _, values in parts])
    times = times.astype("datetime64[ms]")
    utc = rows["time_gpst"].dt.cast_time_unit("ms").to_numpy() - np.timedelta64(LEAP)
    expected = rows.select("longitude_deg", "latitude_deg", "height_m").to_numpy()
    seen, true = np.lexsort((place[:, 0], times)), np.lexsort((expected[:, 0], utc))
    np.testing.assert_array_equal(times[seen], utc[true].astype("datetime64[ms]"))
    np.testing.assert_allclose(place[seen, :2], expected[true, :2], rtol=0.0, atol=1e-8)
    if ending == ".gpx":  # GDAL has heights of GPX as a field
        place[:, 2] = np.concatenate([values[list(meta["fields"]).index("ele")] for meta, _, _, values in parts])
    np.testing.assert_allclose(place[seen, 2], expected[true, 2], rtol=0.0, atol=1e-3)


def test_kml_is_valid_by_its_schema(results: Path, tmp_path: Path) -> None:
    for table in ("--filter", "--single"):
        export(results, tmp_path / "run.kml", table, "--overwrite")
        assert validate_kml(file_to_validate=tmp_path / "run.kml")
    text = (tmp_path / "run.kml").read_text().replace("<TimeStamp>", "<Time>").replace("</TimeStamp>", "</Time>")
    (tmp_path / "run.kml").write_text(text)
    with pytest.raises(AssertionError):
        validate_kml(file_to_validate=tmp_path / "run.kml")


#: Children of each element of GPX 1.1 that is written, in the order of its schema, and its required attributes.
GPX_ORDER: Final = {
    "gpx": ("metadata wpt rte trk extensions", "version creator"),
    "metadata": ("name desc author copyright link time keywords bounds extensions", ""),
    "trk": ("name cmt desc src link number type extensions trkseg", ""),
    "trkseg": ("trkpt extensions", ""),
    "trkpt": ("ele time magvar geoidheight name cmt desc src link sym type fix sat hdop vdop pdop ageofdgpsdata dgpsid "
              "extensions", "lat lon"),
}  # fmt: skip


def test_gpx_has_the_elements_of_its_schema_in_their_order(results: Path, tmp_path: Path) -> None:
    export(results, tmp_path / "run.gpx")
    root = etree.parse(tmp_path / "run.gpx").getroot()
    assert (root.tag, root.get("version")) == ("{http://www.topografix.com/GPX/1/1}gpx", "1.1")
    seen = set()
    for element in root.iter("{http://www.topografix.com/GPX/1/1}*"):
        name, names = etree.QName(element).localname, [etree.QName(child).localname for child in element]
        if name not in GPX_ORDER:
            foreign = {etree.QName(child).namespace for child in element}
            assert not names or (name == "extensions" and foreign == {"urn:railfix:positions"})
            continue
        order, attributes = (text.split() for text in GPX_ORDER[name])
        places = [order.index(child) for child in names]
        assert places == sorted(places)
        assert set(element.attrib) == set(attributes)
        assert all(names.count(child) < 2 for child in names if child not in ("trk", "trkseg", "trkpt"))
        seen.add(name)
    assert seen == set(GPX_ORDER)


def test_geopackage_has_the_tables_of_its_standard(results: Path, tmp_path: Path) -> None:
    """OGC 12-128r18, 1.1: identification, spatial references, contents, geometry columns, and their consistency."""
    export(results, tmp_path / "run.gpkg")
    rows = pl.read_parquet(results / "train.parquet").drop_nulls("x_m")
    with sqlite3.connect(tmp_path / "run.gpkg") as base:
        assert base.execute("pragma application_id").fetchone() == (int.from_bytes(b"GPKG"),)
        assert base.execute("pragma user_version").fetchone()[0] >= 10_200
        assert base.execute("pragma integrity_check").fetchall() == [("ok",)]
        assert base.execute("pragma foreign_key_check").fetchall() == []
        systems = {row[0] for row in base.execute("select srs_id from gpkg_spatial_ref_sys")}
        (contents,) = base.execute(
            "select table_name, data_type, srs_id, min_x, min_y, max_x, max_y, last_change from gpkg_contents"
        )
        columns = base.execute(
            "select table_name, column_name, geometry_type_name, srs_id, z, m from gpkg_geometry_columns"
        ).fetchall()
        key = [row[1] for row in base.execute("pragma table_info(run)") if row[5]]
    base.close()
    assert {-1, 0, 4326} < systems
    assert contents[:2] == ("run", "features")
    assert contents[2] in systems
    assert columns == [("run", "geom", "POINT", contents[2], 1, 0)]
    assert len(key) == 1
    longitude, latitude = rows["longitude_deg"], rows["latitude_deg"]
    expected = [longitude.min(), latitude.min(), longitude.max(), latitude.max()]
    np.testing.assert_allclose(contents[3:7], expected, rtol=0.0, atol=1e-8)
    assert datetime.fromisoformat(contents[7]).utcoffset() == timedelta(0)


@pytest.mark.requirement("G2")
def test_geoparquet_and_the_tables_of_a_run_in_pandas_and_xarray(results: Path, tmp_path: Path) -> None:
    """The tables that other tools read: pandas by way of pyarrow, shapely for the geometry, xarray from pandas."""
    export(results, tmp_path / "run.parquet")
    frame = pandas.read_parquet(tmp_path / "run.parquet")
    rows = pl.read_parquet(results / "train.parquet").drop_nulls("x_m")
    column = next(name for name in frame.columns if frame[name].map(type).eq(bytes).all())
    place = shapely.get_coordinates(shapely.from_wkb(frame[column]), include_z=True)
    np.testing.assert_allclose(np.sort(place[:, 0]), np.sort(rows["longitude_deg"].to_numpy()), rtol=0.0, atol=1e-8)
    table = pandas.read_parquet(results / "train.parquet")
    text = pandas.read_csv(results / "train.csv", parse_dates=["time_gpst"])
    assert len(table) == len(text) == 400
    assert (text["time_gpst"] == table["time_gpst"]).all()
    cube = table.set_index(["antenna", "time_gpst"]).to_xarray()
    assert dict(cube.sizes) == {"antenna": 2, "time_gpst": 200}
    front = rows.filter(antenna="front")["chainage_m"].to_numpy()
    seen = cube["chainage_m"].sel(antenna="front").dropna("time_gpst").to_numpy()
    assert set(front) <= set(seen)


def test_the_frame_is_stated_in_every_file(results: Path, tmp_path: Path) -> None:
    for ending in READERS:
        export(results, tmp_path / f"run{ending}", "--overwrite")
        assert b"WGS 84 (ITRF2020 at 2024.18), heights above the ellipsoid" in (tmp_path / f"run{ending}").read_bytes()


def test_a_run_without_parquet_files_is_exported_from_its_tables(results: Path, tmp_path: Path) -> None:
    run = shutil.copytree(results, tmp_path / "results", ignore=shutil.ignore_patterns("*.parquet"))
    for ending in READERS:
        export(run, tmp_path / f"run{ending}", "--overwrite")
        assert len(READERS[ending](tmp_path / f"run{ending}")) == 400


def test_tracks_of_a_network_are_attributes(results: Path, tmp_path: Path) -> None:
    run = shutil.copytree(results, tmp_path / "results")
    rows = pl.read_parquet(run / "train.parquet")
    name = pl.when(pl.int_range(pl.len()) > 100).then(pl.lit("L36 <B> & 'C'"))
    rows.with_columns(track=name, track_chainage_m=pl.lit(12.5)).write_parquet(run / "train.parquet")
    for ending in (".geojson", ".kml"):
        export(run, tmp_path / f"run{ending}")
    features = json.loads((tmp_path / "run.geojson").read_text(encoding="utf-8"))["features"]
    assert {f["properties"]["track"] for f in features} == {None, "L36 <B> & 'C'"}
    assert features[0]["properties"]["track_chainage_m"] == 12.5
    texts = [node.text for node in ElementTree.parse(tmp_path / "run.kml").iter() if node.tag.endswith("}value")]
    assert texts.count("L36 <B> & 'C'") == sum(f["properties"]["track"] is not None for f in features)


def test_messages_of_the_filter_for_ros(results: Path, tmp_path: Path) -> None:
    """Layout of emate_msgs/FusionResultTrack, every column of a row, and the variance of the place."""
    run = shutil.copytree(results, tmp_path / "results")
    rows = pl.read_parquet(run / "train.parquet")
    on_track = pl.int_range(pl.len()) > 100
    rows = rows.with_columns(
        track=pl.when(on_track).then(pl.lit("L36")),
        track_chainage_m=pl.when(on_track).then(pl.col("chainage_m") - 7.0),
        under_reading_m=pl.col("protection_level_m"),
    )
    rows.write_parquet(run / "train.parquet")
    export(run, tmp_path / "run.mcap")
    found: dict[str, list[Any]] = {}
    for topic, _, message in messages(tmp_path / "run.mcap"):
        found.setdefault(topic, []).append(message)
    assert set(found) == {f"/{name}/{topic}" for name in ("front", "rear") for topic in ("fix", "row", "track")}
    rows = rows.drop_nulls("x_m").filter(antenna="front")
    tracks, fixes, every = (found[f"/front/{topic}"] for topic in ("track", "fix", "row"))
    assert [len(tracks), len(fixes), len(every)] == [len(rows)] * 3
    statuses = {status.text: int(status) for status in TrackStatus}
    for row, track, fix, copy in zip(rows.iter_rows(named=True), tracks, fixes, every, strict=True):
        assert track.status == statuses[row["status"]]
        assert list(track.track_id) == ([row["track"]] if row["track"] else [])
        place = row["track_chainage_m"] if row["track"] else row["chainage_m"]
        assert track.relative_dist == pytest.approx(place, abs=1e-4)
        assert track.movement_direction == (row["direction"] != "falling")
        assert track.speed == pytest.approx(abs(row["speed_mps"]), abs=1e-4)
        assert track.dist_ci.overestimation == pytest.approx(row["over_reading_m"], abs=1e-4)
        assert track.dist_ci.underestimation == pytest.approx(row["under_reading_m"], abs=1e-4)
        assert fix.position_covariance[0] == pytest.approx(row["along_sigma_m"] ** 2, rel=1e-2, abs=1e-4)
        assert copy.protection_level_m == pytest.approx(row["protection_level_m"], abs=1e-4)
        assert set(copy.__slots__) >= set(row)
    assert math.isinf(max(copy.protection_level_m for copy in every + found["/rear/row"]))
    assert tracks[-1].travelled_dist == pytest.approx(rows["chainage_m"].diff().abs().sum(), abs=0.01)
    export(run, tmp_path / "single.mcap", "--single")
    topics = {topic for topic, _, _ in messages(tmp_path / "single.mcap")}
    assert topics == {f"/{name}/{topic}" for name in ("front", "rear") for topic in ("fix", "row")}


# -- styles ---------------------------------------------------------------------------------------------------


def test_every_status_with_a_position_has_its_colour_in_the_style(results: Path, tmp_path: Path) -> None:
    export(results, tmp_path / "run.gpkg")
    renderer = ElementTree.parse(tmp_path / "run.qml").find("renderer-v2")
    assert renderer is not None
    assert (renderer.get("type"), renderer.get("attr")) == ("categorizedSymbol", "status")
    symbol = {c.get("value"): c.get("symbol") for c in renderer.iterfind("categories/category")}
    colour = {
        s.get("name"): next(o.get("value") for o in s.iter("Option") if o.get("name") == "color")
        for s in renderer.iterfind("symbols/symbol")
    }
    drawn = {status: colour[name] for status, name in symbol.items()}
    assert {status or "other": shown for status, shown in drawn.items()} == STATUS_COLOURS
    no_place = {"expired", "not_started"}
    assert {s.text for s in POSITIONED} | {s.text for s in TrackStatus} - no_place == set(STATUS_COLOURS) - {"other"}


def test_formats_share_a_style_and_a_style_of_the_user_is_kept(results: Path, tmp_path: Path) -> None:
    for ending in READERS:
        export(results, tmp_path / f"run{ending}")
    assert len(list(tmp_path.iterdir())) == len(READERS) + 1
    style = tmp_path / "run.qml"
    style.write_text("mine")
    (tmp_path / "run.gpkg").unlink()
    code, said = refused(results, tmp_path / "run.gpkg")
    assert (code, style.read_text()) == (8, "mine")
    assert "run.qml: the file exists already" in said
    assert not (tmp_path / "run.gpkg").exists()
    export(results, tmp_path / "run.gpkg", "--overwrite")
    assert style.read_text() != "mine"


# -- what goes wrong ------------------------------------------------------------------------------------------


def test_another_ending_is_refused_with_those_there_are(results: Path, tmp_path: Path) -> None:
    code, said = refused(results, tmp_path / "run.shp")
    assert code == 8
    assert "give a file name that ends in .kml or .gpx or .geojson or .gpkg or .parquet or .mcap" in said


@pytest.mark.parametrize(
    ("package", "ending", "extra"),
    [("pyogrio", "gpkg", "maps"), ("shapely", "gpkg", "maps"), ("mcap_ros2.writer", "mcap", "mcap")],
)
def test_a_missing_extra_is_one_sentence(
    results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, ending: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    code, said = refused(results, tmp_path / f"run.{ending}")
    assert (code, list(tmp_path.iterdir())) == (4, [])
    assert f"this needs {package}, which is not installed; pip install 'railfix[{extra}]'" in said
    export(results, tmp_path / "run.kml")


def test_a_full_disk_leaves_nothing(results: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Path.write_bytes

    def full(path: Path, content: bytes) -> int:
        if ".qml" in path.name:
            write(path, content[:10])
            raise OSError(28, "No space left on device")
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    code, said = refused(results, tmp_path / "run.gpkg")
    assert (code, list(tmp_path.iterdir())) == (8, [])
    assert "No space left on device" in said


def test_a_run_without_the_filter_or_without_a_position(results: Path, tmp_path: Path) -> None:
    run = shutil.copytree(results, tmp_path / "results", ignore=shutil.ignore_patterns("train.*"))
    code, said = refused(run, tmp_path / "run.kml", "--filter")
    assert code == 3
    assert "has no positions of the filter" in said
    assert "single epochs" in export(run, tmp_path / "run.kml")
    nothing = pl.read_parquet(run / "positions.parquet").with_columns(pl.lit(None, pl.Float64).alias("height_m"))
    nothing.write_parquet(run / "positions.parquet")
    code, said = refused(run, tmp_path / "other.gpkg")
    assert code == 7
    assert "no epoch has a position" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["results", "run.kml"]
