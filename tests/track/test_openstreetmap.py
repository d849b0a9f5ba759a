"""OpenStreetMap as each exporter writes it: the same two tracks with their ids and names, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.io.position_log import PositionLog
from railfix.track import Track
from railfix.track.georeference import Georeference
from railfix.track.height_source import with_heights
from railfix.track.heights import egm96_heights, geoid_heights
from railfix.track.network import Network
from railfix.track.network_read import read_network
from railfix.track.read import read_segments, track_of_segments
from railfix.track.route import MapReading

pytestmark = pytest.mark.requirement("A1")
#: Longitude and latitude of the points of each way; the siding leaves the line at its second point.
WAYS: Final[dict[int, list[list[float]]]] = {
    11: [[5.0, 50.0], [5.002, 50.0], [5.004, 50.0], [5.008, 50.0]],
    12: [[5.002, 50.0], [5.003, 50.00004], [5.006, 50.00004]],
    13: [[5.002, 50.0001], [5.003, 50.0001]],
    14: [[5.0, 50.001], [5.008, 50.001]],
}
TAGS: Final[dict[int, dict[str, str]]] = {
    11: {"railway": "rail", "name": 'Ligne "36"', "usage": "main"},
    12: {"railway": "rail", "service": "siding"},
    13: {"railway": "platform"},
    14: {"highway": "path"},
}
NAMES: Final = ['way/11 Ligne "36"', "way/12"]


def _geojson(row: Callable[[int], dict[str, Any]], identity: str = "") -> str:
    features = [
        {"type": "Feature", **({"id": identity.format(k)} if identity else {}), "properties": row(k),
         "geometry": {"type": "LineString", "coordinates": points}}
        for k, points in WAYS.items()
    ]  # fmt: skip
    return json.dumps({"type": "FeatureCollection", "features": features})


def _hstore(k: int) -> dict[str, Any]:
    escaped = {key: value.replace('"', '\\"') for key, value in TAGS[k].items() if key != "name"}
    named = {"name": TAGS[k]["name"]} if "name" in TAGS[k] else {"name": None}
    return {"osm_id": str(k), **named, "other_tags": ",".join(f'"{key}"=>"{v}"' for key, v in escaped.items())}


def _nodes() -> dict[tuple[float, float], int]:
    return {(x, y): k for k, (x, y) in enumerate(dict.fromkeys((x, y) for w in WAYS.values() for x, y in w), 101)}


def _xml() -> str:
    """As Overpass prints ways before their nodes, which lie in any order."""
    nodes = _nodes()
    quoted = {k: {key: v.replace('"', "&quot;") for key, v in tags.items()} for k, tags in TAGS.items()}
    ways = "".join(
        f'<way id="{k}">'
        + "".join(f'<nd ref="{nodes[x, y]}"/>' for x, y in points)
        + "".join(f'<tag k="{key}" v="{value}"/>' for key, value in quoted[k].items())
        + "</way>"
        for k, points in WAYS.items()
    )
    after = "".join(f'<node id="{k}" lat="{y}" lon="{x}"/>' for (x, y), k in reversed(nodes.items()))
    return f'<?xml version="1.0"?><osm version="0.6">{ways}{after}</osm>'


def _overpass(*, geometry: bool) -> str:
    nodes = _nodes()
    ways: list[dict[str, Any]] = [
        {"type": "way", "id": k, "tags": TAGS[k], "nodes": [nodes[x, y] for x, y in points]}
        | ({"geometry": [{"lat": y, "lon": x} for x, y in points]} if geometry else {})
        for k, points in WAYS.items()
    ]
    after = [{"type": "node", "id": k, "lat": y, "lon": x} for (x, y), k in nodes.items()]
    return json.dumps({"version": 0.6, "generator": "Overpass API", "elements": ways + ([] if geometry else after)})


FLAVOURS: Final[dict[str, tuple[str, str]]] = {
    "OSM XML": ("area.osm", _xml()),
    "Overpass JSON, out geom": ("area.json", _overpass(geometry=True)),
    "Overpass JSON, out body": ("area.json", _overpass(geometry=False)),
    "osmtogeojson": ("area.geojson", _geojson(lambda k: {"@id": f"way/{k}"} | TAGS[k], "way/{}")),
    "osmtogeojson, verbose": ("area.geojson", _geojson(lambda k: {"type": "way", "id": k, "tags": TAGS[k]}, "way/{}")),
    "ogr2ogr": ("area.geojson", _geojson(_hstore)),
    "ogr2ogr, tags as JSON": (
        "area.geojson",
        _geojson(lambda k: {"osm_id": str(k), "other_tags": json.dumps(TAGS[k])}),
    ),
    "QuickOSM": ("area.geojson", _geojson(lambda k: {"full_id": f"w{k}", "osm_type": "way"} | TAGS[k])),
    "osmium export": ("area.geojson", _geojson(lambda k: TAGS[k], "w{}")),
    "osmium export, attributes": ("area.geojson", _geojson(lambda k: {"@type": "way", "@id": k} | TAGS[k])),
    "osmnx": ("area.geojson", _geojson(lambda k: {"element": "way", "id": k} | TAGS[k], "('way', {})")),
    "pyrosm": ("area.geojson", _geojson(lambda k: {"id": k, "osm_type": "way", "tags": json.dumps(TAGS[k])})),
    "Geofabrik": (
        "area.geojson",
        _geojson(lambda k: {"osm_id": str(k), "fclass": TAGS[k].get("railway"), "name": TAGS[k].get("name", "")}),
    ),
}  # fmt: skip


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_every_exporter_gives_the_same_tracks_with_id_name_and_accuracy(tmp_path: Path, flavour: str) -> None:
    name, text = FLAVOURS[flavour]
    path = tmp_path / name
    path.write_text(text)
    segments = read_segments(path, MapReading())
    assert [s.metadata["name"] for s in segments] == NAMES
    np.testing.assert_allclose(segments[1].longitude_deg, [x for x, _ in WAYS[12]], atol=1e-12)
    assert {s.metadata["sigma_plan_m"] for s in segments} == {"2"}
    notes = " ".join(segments[0].notes)
    assert "2 m in plan is assumed (--plan-sigma)" in notes
    assert "1 railway=platform" in notes
    network = read_network([path], MapReading(sigma_plan_m=0.5))
    assert network.sigma_plan_m == 0.5
    # the siding divides the line where it leaves it
    assert set(network.names) == {'way/11 Ligne "36"/1', 'way/11 Ligne "36"/2', "way/12"}


def test_a_way_is_known_by_its_id_alone(tmp_path: Path) -> None:
    path = tmp_path / "area.osm"
    path.write_text(_xml())
    network = Network(tracks=tuple(read_segments(path, MapReading())), links=())
    assert (network.find_index("way/11"), network.find_index("way/12")) == (0, 1)
    with pytest.raises(SettingsError, match=r"no track 'way/1'"):
        network.find_index("way/1")


def test_a_shapefile_of_classes_is_read_as_its_geojson(tmp_path: Path) -> None:
    pyogrio, shapely = pytest.importorskip("pyogrio"), pytest.importorskip("shapely")
    path = tmp_path / "gis_osm_railways_free_1.shp"
    shapes = np.array([shapely.to_wkb(shapely.LineString(points)) for points in WAYS.values()])
    rows = [(str(k), TAGS[k].get("railway", "path"), TAGS[k].get("name")) for k in WAYS]
    columns = [np.array(column, dtype=object) for column in zip(*rows, strict=True)]
    fields = ["osm_id", "fclass", "name"]
    pyogrio.raw.write(path, shapes, columns, fields, geometry_type="LineString", crs="EPSG:4326")
    assert [s.metadata["name"] for s in read_segments(path, MapReading())] == NAMES


def test_an_accuracy_of_the_file_counts(tmp_path: Path) -> None:
    path = tmp_path / "area.geojson"
    path.write_text(_geojson(lambda k: {"@id": f"way/{k}", "sigma_plan_m": 0.8} | TAGS[k]))
    assert read_network([path]).sigma_plan_m == 0.8


def test_a_clipped_way_is_two_and_one_without_nodes_a_sentence(tmp_path: Path) -> None:
    document = json.loads(_overpass(geometry=True))
    document["elements"][0]["geometry"] = [{"lat": 50.0, "lon": 5.0 + 0.001 * k} for k in range(6)]
    document["elements"][0]["geometry"][3] = None
    path = tmp_path / "area.json"
    path.write_text(json.dumps(document))
    assert [len(s.latitude_deg) for s in read_segments(path, MapReading())] == [3, 2, 3]
    bare = [{"type": "way", "id": 11, "tags": TAGS[11], "nodes": [101, 102]}]
    path.write_text(json.dumps({"elements": bare}))
    with pytest.raises(InputFileError, match=r"way/11 \(the file has 0 of its 2 nodes\); also request the nodes"):
        read_segments(path, MapReading())


def _log(error_m: np.ndarray) -> tuple[PositionLog, np.ndarray]:
    """Single positions each 10 m along a line that falls and rises by 20 permille, and the heights there."""
    longitude = np.linspace(5.0, 5.06, len(error_m))
    way = np.linspace(0.0, 1.0, len(error_m))
    height = 150.0 + 40.0 * np.abs(way - 0.5)
    ecef = ecef_from_geodetic(np.full(len(way), 50.0), longitude, height + error_m)
    log = PositionLog(
        path="log",
        time=np.datetime64("2024-01-01", "ns") + np.arange(len(way)) * np.timedelta64(1, "s"),
        ecef_m=ecef,
        quality=np.full(len(way), 5),
        sigma_m=np.full((len(way), 3), 3.0),
        line=np.arange(len(way)),
    )
    return log, height


def test_heights_of_the_log_itself_are_smooth_and_pass_over_reflections_and_tunnels() -> None:
    """A way with points 1 km apart; of the positions one of ten is 60 m too high, and 400 m of them are missing."""
    rng = np.random.default_rng(1)
    error = rng.normal(0.0, 2.0, 430) + np.where(rng.random(430) < 0.1, 60.0, 0.0)
    log, height = _log(error)
    longitude = np.linspace(4.99, 5.06, 6)
    track = Track.from_geodetic(np.full(6, 50.0), longitude, np.zeros(6))
    kept = np.flatnonzero((np.arange(430) < 300) | (np.arange(430) > 340))
    columns = {name: getattr(log, name)[kept] for name in ("time", "ecef_m", "quality", "sigma_m", "line")}
    raised = with_heights(track, replace(log, **columns))
    assert np.diff(raised.chainage_m).max() < 51.0
    inside = raised.longitude_deg > 5.001
    expected = np.interp(raised.longitude_deg, np.linspace(5.0, 5.06, 430), height)
    assert np.abs(raised.height_m - expected)[inside].max() < 3.0
    assert np.abs(np.diff(raised.height_m) / np.diff(raised.chainage_m)).max() < 0.04
    assert raised.sigma_height_m == 6.0
    assert np.isfinite(raised.height_m).all()  # also where the way goes on beyond the log


def test_all_that_a_map_without_heights_needs_is_asked_for_at_once(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "area.osm"
    path.write_text(_xml())
    with pytest.raises(InputFileError, match=r"--heights.* log.*file.*--height-datum.*--height-sigma.*--geoid"):
        track_of_segments(read_segments(path, MapReading())[:1])
    raster = tmp_path / "ground.tif"
    with rasterio.open(
        raster, "w", driver="GTiff", width=40, height=40, count=1, dtype="float32", crs="EPSG:4326",
        transform=rasterio.transform.from_bounds(4.99, 49.99, 5.02, 50.02, 40, 40),
    ) as file:  # fmt: skip
        file.write(np.full((1, 40, 40), 100.0, dtype=np.float32))
    with pytest.raises(SettingsError, match=r"--height-datum.*--geoid.*egm96 of the world.*--height-sigma"):
        track_of_segments(read_segments(path, MapReading())[:1], heights=raster)
    track = track_of_segments(
        read_segments(path, MapReading())[:1],
        heights=raster, height_datum="orthometric", geoid="egm96", sigma_height_m=3.0,
    )  # fmt: skip
    geoid = egm96_heights(track.latitude_deg, track.longitude_deg)
    np.testing.assert_allclose(track.height_m, 100.0 + geoid, atol=1e-3)
    assert track.sigma_height_m == 3.0


#: Test values of the program of the model (NGA, F477): latitude, longitude, height of the geoid [m].
EGM96: Final = (
    (38.6281550, 269.7791550, -31.628),
    (-14.6212170, 305.0211140, -2.969),
    (46.8743190, 102.4487290, -43.575),
    (-23.6174460, 133.8747120, 15.871),
    (38.6254730, 359.9995000, 50.066),
    (-0.4667440, 0.0023000, 17.329),
)


def test_geoid_of_the_world_is_the_published_one() -> None:
    latitude, longitude, published = np.array(EGM96).T
    model = geoid_heights("egm96", Georeference(latitude_deg=latitude, longitude_deg=longitude), path="map")
    assert np.abs(model.height_m - published).max() < 0.005
    assert "EGM96" in model.name
    assert model.accuracy_m == 1.0


def test_geoid_of_the_world_is_that_of_another_package_at_whole_degrees() -> None:
    sidereon = pytest.importorskip("sidereon")
    latitude, longitude = (v.ravel() for v in np.meshgrid(np.arange(-89.0, 90.0, 7.0), np.arange(-179.0, 181.0, 9.0)))
    expected = sidereon.egm96_undulations_deg(np.ascontiguousarray(np.stack([latitude, longitude], axis=-1)))
    assert np.abs(egm96_heights(latitude, longitude) - expected).max() < 1e-6


def test_a_geoid_that_is_not_installed_names_its_grid_and_the_command() -> None:
    place = Georeference(latitude_deg=np.array([50.0]), longitude_deg=np.array([5.0]))
    with pytest.raises(SettingsError, match=r"projsync --file .*us_nga_egm08_25.tif"):
        geoid_heights("EPSG:3855", place, path="map")
