"""Topology of OpenStreetMap: ways are connected at the nodes that they share, and nowhere else."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from railfix.core.errors import InputFileError
from railfix.track import check_track, read_track
from railfix.track.network import Network
from railfix.track.network_read import read_network
from railfix.track.read import read_segments
from railfix.track.route import NO_HEIGHTS, MapReading

pytestmark = pytest.mark.requirement("A10")

Node = tuple[float, float]


def osm(
    path: Path, nodes: dict[int, Node], ways: dict[int, tuple[list[int], dict[str, str]]], crossing: int = 0
) -> Path:
    """An OSM XML file of nodes (metres east and north) and ways with tags; one node may be a crossing."""
    lines = ["<osm version='0.6'>"]
    for number, (east, north) in nodes.items():
        place = f'lat="{47.0 + north / 111_195.0:.9f}" lon="{8.0 + east / 75_834.0:.9f}"'
        tag = '<tag k="railway" v="railway_crossing"/>' if number == crossing else ""
        lines.append(f'<node id="{number}" {place}>{tag}</node>')
    for number, (refs, tags) in ways.items():
        inside = "".join(f'<nd ref="{ref}"/>' for ref in refs)
        inside += "".join(f'<tag k="{k}" v="{v}"/>' for k, v in {"railway": "rail", **tags}.items())
        lines.append(f'<way id="{number}">{inside}</way>')
    path.write_text("\n".join([*lines, "</osm>"]))
    return path


def passages(network: Network) -> set[frozenset[str]]:
    """Pairs of tracks that a train passes between."""
    return {frozenset((network.names[k.first], network.names[k.second])) for k in network.links if k.navigable}


CROSSED = {1: (0.0, 0.0), 2: (150.0, 0.0), 3: (300.0, 0.0), 4: (0.0, -22.0), 5: (300.0, 22.0)}
X: dict[int, tuple[list[int], dict[str, str]]] = {10: ([1, 2, 3], {}), 11: ([4, 2, 5], {})}


def test_tracks_that_share_an_inner_node_are_connected_there(tmp_path: Path) -> None:
    """A double slip: of both tracks four legs, from each two ways on, without turning back."""
    network = read_network([osm(tmp_path / "slip.osm", CROSSED, X)])
    assert len(network.tracks) == 4
    straight = {frozenset(("way/10/1", "way/10/2")), frozenset(("way/11/1", "way/11/2"))}
    turned = {frozenset(("way/10/1", "way/11/2")), frozenset(("way/11/1", "way/10/2"))}
    assert passages(network) == straight | turned
    crossing = read_network([osm(tmp_path / "crossing.osm", CROSSED, X, crossing=2)])
    assert passages(crossing) == straight


def test_ends_that_meet_in_plan_without_a_shared_node_are_not_connected(tmp_path: Path) -> None:
    nodes = {1: (0.0, 0.0), 2: (300.0, 0.0), 3: (600.0, 0.0), 4: (0.0, -40.0), 5: (300.0, 0.1)}
    ways = {10: ([1, 2, 3], {"bridge": "yes", "layer": "2"}), 11: ([4, 5], {"tunnel": "yes", "layer": "-1"})}
    network = read_network([osm(tmp_path / "layer.osm", nodes, ways)])
    assert len(network.tracks) == 2
    assert not network.links
    assert "nodes that ways share" in network.notes[0]


@pytest.mark.parametrize(("first", "second", "joined"), [("-1", "1", False), ("1", "1", True), ("", "", True)])
def test_files_without_nodes_keep_levels_apart(first: str, second: str, joined: bool, tmp_path: Path) -> None:
    features = []
    for number, layer in ((0, first), (1, second)):
        ends = [[8.0 + 0.002 * number, 47.0], [8.002 + 0.002 * number, 47.0]]
        tags = {"railway": "rail", **({"layer": layer} if layer else {})}
        line = {"type": "LineString", "coordinates": ends}
        features.append({"type": "Feature", "id": f"way/{number}", "properties": tags, "geometry": line})
    path = tmp_path / "net.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    levels_differ = first != second
    network = read_network([path])
    assert bool(passages(network)) == joined == (not levels_differ)


def test_one_degenerate_way_leaves_the_others(tmp_path: Path) -> None:
    ways = {10: ([1, 2, 3], {}), 12: ([2], {}), 13: ([7, 8], {})}
    segments = read_segments(osm(tmp_path / "a.osm", CROSSED, ways), MapReading())
    assert [s.metadata["name"] for s in segments] == ["way/10"]
    assert "way/12 (the file has 1 of its 1 nodes)" in segments[0].notes[0]
    assert "way/13 (the file has 0 of its 2 nodes)" in segments[0].notes[0]
    with pytest.raises(InputFileError, match=r"way/12 \(the file has 1 of its 1 nodes\); also request the nodes"):
        read_segments(osm(tmp_path / "b.osm", CROSSED, {12: ([2], {})}), MapReading())


def test_a_feature_without_geometry_is_left_out_and_heights_of_zero_are_none(tmp_path: Path) -> None:
    line = {"type": "LineString", "coordinates": [[7.0, 46.5, 0.0], [7.01, 46.5, 0.0]]}
    features = [
        {"type": "Feature", "properties": {}, "geometry": None},
        {"type": "Feature", "properties": {}, "geometry": line},
    ]
    path = tmp_path / "a.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    segment = read_segments(path, MapReading(height_datum="ellipsoidal"))[0]
    assert any("1 feature 1 without geometry" in note for note in segment.notes)
    assert segment.height_datum == NO_HEIGHTS
    table = tmp_path / "a.csv"
    table.write_text("latitude_deg,longitude_deg,height_m\n46.5,7.0,0.0\n46.5,7.01,0.0\n")
    assert read_segments(table, MapReading())[0].height_datum == NO_HEIGHTS


@pytest.mark.requirement("A1")
@pytest.mark.parametrize(("cants", "severity"), [((0.1, -0.1), "error"), ((-0.1, -0.1), "error"), ((0.1, 0.1), None)])
def test_cant_signed_by_the_side_of_the_curve_is_found(
    cants: tuple[float, float], severity: str | None, tmp_path: Path
) -> None:
    """A right curve and a left one, with the cant of each."""
    heading = np.concatenate([np.zeros(20), np.linspace(0.0, 0.5, 30), np.full(20, 0.5), np.linspace(0.5, 0.0, 30)])
    east, north = np.cumsum(10.0 * np.cos(heading)), -np.cumsum(10.0 * np.sin(heading))
    curve = np.repeat([0, 1, 0, 2], [20, 30, 20, 30])
    radius, cant = np.array([np.inf, 580.0, -580.0])[curve], 1e3 * np.array([0.0, *cants])[curve]
    rows = [
        f"{47.0 + n / 111_195.0:.9f},{8.0 + e / 75_834.0:.9f},400,{c:g},{0 if np.isinf(r) else r:g}"
        for e, n, c, r in zip(east, north, cant, radius, strict=True)
    ]
    path = tmp_path / "line.csv"
    path.write_text("# crs: EPSG:4258\nlatitude_deg,longitude_deg,height_m,cant_mm,radius_m\n" + "\n".join(rows) + "\n")
    found = {f.severity for f in check_track(read_track(path)).findings if f.kind == "cant side"}
    assert found == ({severity} if severity else set())


def _varint(number: int) -> bytes:
    number &= (1 << 64) - 1
    parts = [number >> shift & 127 for shift in range(0, max(number.bit_length(), 1), 7)]
    return bytes(part | 128 for part in parts[:-1]) + bytes(parts[-1:])


def _field(key: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return _varint(key << 3) + _varint(value)
    return _varint(key << 3 | 2) + _varint(len(value)) + value


def _deltas(values: list[int]) -> bytes:
    steps = [b - a for a, b in zip([0, *values], values, strict=False)]
    return b"".join(_varint(step << 1 ^ step >> 63) for step in steps)


def _packed(path: Path, sign: int) -> Path:
    """Write an .osm.pbf file (https://wiki.openstreetmap.org/wiki/PBF_Format) of one way with ids of a sign."""
    ids = [sign * k for k in (1, 2, 3)]
    table = b"".join(_field(1, text) for text in (b"", b"railway", b"rail", b"name", b"Main"))
    dense = (
        _field(1, _deltas(ids))
        + _field(8, _deltas([480000000, 480010000, 480020000]))
        + _field(9, _deltas([8 * 10**7] * 3))
    )
    way = _field(1, sign * 7) + _field(2, bytes([1, 3])) + _field(3, bytes([2, 4])) + _field(8, _deltas(ids))
    with path.open("wb") as file:
        for kind, data in (
            (b"OSMHeader", _field(4, b"OsmSchema-V0.6") + _field(4, b"DenseNodes")),
            (b"OSMData", _field(1, table) + _field(2, _field(2, dense)) + _field(2, _field(3, way))),
        ):
            blob = _field(2, len(data)) + _field(3, zlib.compress(data))
            head = _field(1, kind) + _field(3, len(blob))
            file.write(struct.pack(">I", len(head)) + head + blob)
    return path


@pytest.mark.parametrize("sign", [1, -1])
def test_a_packed_extract_is_read_whatever_the_sign_of_its_ids(tmp_path: Path, sign: int) -> None:
    """Open Source Railway Designer exports its networks with negative ids."""
    net = read_network([_packed(tmp_path / "osrd.osm.pbf", sign)])
    assert net.names == (f"way/{sign * 7} Main",)
    assert len(net.points_m) == 3
    assert "osmium cat FILE.osm.pbf -o FILE.osm" in net.notes[0]
