"""Odd map files of all formats are right, noted, found by the check of maps, or refused; none is wrong silently."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyogrio")
pytest.importorskip("shapely")
from pyproj import Transformer

from helpers import odd_maps as odd
from network_made import log_at
from railfix.core.errors import MismatchError, RailfixError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track import Track, check_track, read_track
from railfix.track.network import Network
from railfix.track.read import read_segments
from railfix.track.route import MapReading
from railfix.track.trajectory import NearestOnPolyline

pytestmark = pytest.mark.requirement("A1")


def _design_m() -> np.ndarray:
    """Points of the LandXML design every metre, by its circle and its parabola; half the cant lifts the middle."""
    way = np.linspace(0.0, 300.0, 301)
    turn = np.maximum(way - 100.0, 0.0) / 500.0
    east = 650000.0 + np.minimum(way, 100.0) + 500.0 * np.sin(turn)
    north = 5319500.0 + 500.0 * np.cos(turn)
    height = np.where(way < 100.0, 500.0 + 0.01 * way, 501.0 - 0.005 * (way - 100.0))
    height -= 0.015 * np.maximum(30.0 - np.abs(way - 100.0), 0.0) ** 2 / (2.0 * 60.0)
    height += 0.045 * np.maximum(way - 100.0, 0.0) / 200.0
    longitude, latitude = Transformer.from_crs("EPSG:25832", "EPSG:4258", always_xy=True).transform(east, north)
    return ecef_from_geodetic(np.array(latitude), np.array(longitude), height)


def _apart_m(track: Track, truth_m: np.ndarray) -> float:
    return max(float(NearestOnPolyline(a)(b)[2].max()) for a, b in ((track.ecef_m, truth_m), (truth_m, track.ecef_m)))


def _path(case: odd.Odd, folder: Path) -> Path:
    path = folder / case.name
    if callable(case.content):
        case.content(path)
    else:
        path.write_bytes(case.content if isinstance(case.content, bytes) else case.content.encode())
    return path


@pytest.mark.parametrize("case", odd.CASES, ids=lambda case: case.name)
def test_an_odd_map_is_right_or_says_what_is_wrong(case: odd.Odd, tmp_path: Path) -> None:
    path = _path(case, tmp_path)
    asked = {key: value for key, value in case.asked.items() if path.suffix != ".csv"}
    if case.outcome == "refused":
        with pytest.raises(RailfixError, match=case.words) as caught:
            read_track(path, **asked)
        assert str(caught.value).startswith(str(path))
        assert "\n" not in str(caught.value)
        return
    track = read_track(path, **asked)
    of_line = ecef_from_geodetic(odd.LINE[:, 1], odd.LINE[:, 0], odd.LINE[:, 2])
    findings = [finding.sentence for finding in check_track(track).findings]
    if case.outcome == "found":
        assert any(re.search(case.words, sentence) for sentence in findings), findings
    elif case.outcome == "elsewhere":
        with pytest.raises(MismatchError, match=case.words or "whether the map is of this line"):
            log_at(odd.LINE[:, 1], odd.LINE[:, 0]).transform_to(
                Network(tracks=tuple(read_segments(path, MapReading(**asked))), links=())
            )
    else:
        assert _apart_m(track, _design_m() if path.suffix == ".xml" else of_line) < 0.05
        assert findings == []
        assert any(re.search(case.words or "^$", note) for note in track.provenance.notes) == (case.outcome == "noted")


def test_a_grid_in_feet_is_read_in_feet(tmp_path: Path) -> None:
    """EPSG:6539 is in US survey feet: a design in metres, or in feet, is put there; so are GDAL's files."""
    foot = 1200.0 / 3937.0
    x, y = 984000.0 * foot, 200000.0 * foot
    text = odd.LANDXML.replace("25832", "6539")
    for number, there in {"5320000": y, "5319500": y - 500.0, "650000": x, "650100": x + 100.0}.items():
        text = text.replace(number, f"{there:.9f}")
    end = f"{y - 500.0 + 500.0 * np.cos(0.4):.9f} {x + 100.0 + 500.0 * np.sin(0.4):.9f}"
    (tmp_path / "metres.xml").write_text(text.replace(odd._END, end))
    metres = read_track(tmp_path / "metres.xml", height_datum="ellipsoidal")
    expected = Transformer.from_crs("EPSG:6539", "EPSG:6318", always_xy=True).transform(984000.0, 200000.0)
    assert (metres.longitude_deg[0], metres.latitude_deg[0]) == pytest.approx(expected, abs=1e-10)
    assert metres.height_m[0] == pytest.approx(500.0)
    compound = "EPSG:6539+6360"  # NAVD88 in US survey feet
    feet = np.array([[984000.0 + 300.0 * k, 200000.0, 100.0 / foot] for k in range(5)])
    path = tmp_path / "feet.geojson"
    path.write_text(odd.geojson(feet, crs=compound, properties=[{"geoid_m": [-32.0] * 5}]))
    track = read_track(path)
    assert track.height_m == pytest.approx(68.0)
    assert (track.longitude_deg[0], track.latitude_deg[0]) == pytest.approx(expected, abs=1e-10)
