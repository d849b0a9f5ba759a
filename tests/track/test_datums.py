"""Older datums: the right operation for the place with its accuracy, or a refusal; never a null step.

The right coordinates are those of a translation of the country, as the EPSG dataset has it, that is written out here
and applied without PROJ's operations; and those that PROJ itself chooses at the place. A null step would be 50 to 700 m
off.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS, Proj, Transformer
from pyproj.aoi import AreaOfInterest

from railfix.core.arrays import Floats
from railfix.core.errors import SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track import read_track
from railfix.track.georeference import georeference
from railfix.track.heights import egm96_heights

pytestmark = pytest.mark.requirement("A9")

#: CRS, place (latitude, longitude), and translation to WGS 84 [m] of the country; None where it takes a rotation, too.
PLACES: dict[str, tuple[str, tuple[float, float], tuple[float, float, float] | None]] = {
    "ED50 Rome": ("EPSG:23033", (41.9, 12.5), (-87.0, -98.0, -121.0)),
    "ED50 Bergen": ("EPSG:23032", (60.4, 5.3), (-83.11, -97.38, -117.22)),
    "ED50 Athens": ("EPSG:23034", (38.0, 23.7), (-84.0, -95.0, -130.0)),
    "ED50 Berlin": ("EPSG:23033", (52.5, 13.4), (-87.0, -98.0, -121.0)),
    "ED50 Madrid": ("EPSG:23030", (40.4, -3.7), (-84.0, -107.0, -120.0)),
    "ED50 Lisbon": ("EPSG:23029", (38.7, -9.1), (-86.0, -98.0, -119.0)),
    "ED50 Paris": ("EPSG:23031", (48.9, 2.35), (-84.0, -97.0, -117.0)),
    "ED50 Milan": ("EPSG:23032", (45.4, 9.2), (-87.0, -98.0, -121.0)),
    "ED50 Munich": ("EPSG:23032", (48.1, 11.6), (-87.0, -98.0, -121.0)),
    "ED50 Vienna": ("EPSG:23033", (48.2, 16.4), (-87.0, -98.0, -121.0)),
    "ED50 Palermo": ("EPSG:23033", (38.1, 13.4), (-97.0, -88.0, -135.0)),
    "ED50 Helsinki": ("EPSG:23035", (60.2, 25.0), (-83.11, -97.38, -117.22)),
    "ED50 Copenhagen": ("EPSG:23032", (55.7, 12.5), (-81.1, -89.4, -115.8)),
    "ED50 Istanbul": ("EPSG:23035", (41.0, 29.0), None),
    "S-42/83 Prague": ("EPSG:3835", (50.1, 14.4), (26.0, -121.0, -78.0)),
    "S-42/83 Budapest": ("EPSG:4178", (47.5, 19.0), (28.0, -121.0, -77.0)),
    "S-42/58 Warsaw": ("EPSG:4179", (52.2, 21.0), (23.0, -124.0, -82.0)),
    "S-42/58 Prague": ("EPSG:4179", (50.1, 14.4), (26.0, -121.0, -78.0)),
    "S-42 Moscow": ("EPSG:4284", (55.7, 37.6), (28.0, -130.0, -95.0)),
    "OSGB36 London": ("EPSG:27700", (51.5, -0.1), (375.0, -111.0, 431.0)),
    "OSGB36 Glasgow": ("EPSG:27700", (55.9, -4.3), (384.0, -111.0, 425.0)),
    "TM65 Dublin": ("EPSG:29902", (53.3, -6.3), None),
    "DHDN Frankfurt": ("EPSG:31467", (50.1, 8.7), None),
    "MGI Vienna": ("EPSG:31256", (48.2, 16.4), None),
    "Monte Mario Rome": ("EPSG:3004", (41.9, 12.5), (-225.0, -65.0, 9.0)),
    "NTF Paris": ("EPSG:27572", (48.9, 2.35), (-168.0, -60.0, 320.0)),
    "BD72 Brussels": ("EPSG:31370", (50.8, 4.4), (-125.8, 79.9, -100.5)),
    "Amersfoort Utrecht": ("EPSG:28992", (52.1, 5.1), (593.16, 26.15, 478.54)),
    "RT90 Stockholm": ("EPSG:3021", (59.3, 18.1), None),
    "CH1903 Bern": ("EPSG:21781", (46.95, 7.45), (674.4, 15.1, 405.3)),
    "Lisbon 1890": ("EPSG:20791", (38.7, -9.1), (-304.0, -60.7, 103.6)),
    "HD72 Budapest": ("EPSG:23700", (47.5, 19.0), (52.2, -71.8, -10.9)),
    "S-JTSK Prague": ("EPSG:5513", (50.1, 14.4), None),
    "NAD83 New York": ("EPSG:26918", (40.7, -74.0), (0.0, 0.0, 0.0)),
    "NAD83 Denver": ("EPSG:26913", (39.7, -105.0), (0.0, 0.0, 0.0)),
    "NAD27 Denver": ("EPSG:26713", (39.7, -105.0), (-8.0, 159.0, 175.0)),
    "NAD27 Toronto": ("EPSG:26717", (43.7, -79.4), (-10.0, 158.0, 187.0)),
    "NAD27 Havana": ("EPSG:3795", (23.1, -82.4), (-9.0, 152.0, 178.0)),
    "PSAD56 Lima": ("EPSG:24878", (-12.1, -77.0), (-279.0, 175.0, -379.0)),
    "PSAD56 Caracas": ("EPSG:24819", (10.5, -66.9), (-295.0, 173.0, -371.0)),
    "Aratu Salvador": ("EPSG:4208", (-12.9, -38.5), (-151.99, 287.04, -147.45)),
    "Chua Brasilia": ("EPSG:4224", (-15.8, -47.9), (-143.87, 243.37, -33.52)),
    "SAD69 Sao Paulo": ("EPSG:4618", (-23.5, -46.6), (-66.87, 4.37, -38.52)),
    "Campo Inchauspe": ("EPSG:22195", (-34.6, -58.4), (-148.0, 136.0, 90.0)),
    "Bogota 1975": ("EPSG:21897", (4.6, -74.1), (307.0, 304.0, -318.0)),
    "AGD66 Sydney": ("EPSG:20256", (-33.9, 151.2), (-127.8, -52.3, 152.9)),
    "AGD66 Alice Springs": ("EPSG:20253", (-23.7, 133.9), (-127.8, -52.3, 152.9)),
    "AGD84 Perth": ("EPSG:20350", (-31.9, 115.9), (-128.5, -53.0, 153.4)),
    "NZGD49 Wellington": ("EPSG:27200", (-41.3, 174.8), (54.4, -20.1, 183.1)),
    "Tokyo": ("EPSG:30169", (35.7, 139.7), (-146.4, 507.3, 680.5)),
    "Korean 1985 Seoul": ("EPSG:4162", (37.5, 127.0), (-147.0, 506.0, 687.0)),
    "Beijing 1954": ("EPSG:21420", (39.9, 116.4), (12.6, -155.1, -69.1)),
    "Xian 1980": ("EPSG:4610", (39.9, 116.4), None),
    "Kalianpur Delhi": ("EPSG:24378", (28.6, 77.2), (295.0, 736.0, 257.0)),
    "Luzon Manila": ("EPSG:25393", (14.6, 121.0), (-127.62, -67.24, -47.04)),
    "Indian 1975 Bangkok": ("EPSG:24047", (13.8, 100.5), None),
    "Palestine 1923": ("EPSG:28191", (31.8, 35.2), None),
    "Nahrwan Dubai": ("EPSG:4270", (25.2, 55.3), (-245.0, -153.9, 382.8)),
    "Ain el Abd Riyadh": ("EPSG:20438", (24.7, 46.7), (-143.0, -236.0, 7.0)),
    "Cape Johannesburg": ("EPSG:22289", (-26.2, 28.0), (-136.0, -108.0, -292.0)),
    "Arc 1960 Nairobi": ("EPSG:21037", (-1.3, 36.8), (-157.0, -2.0, -299.0)),
    "Minna Lagos": ("EPSG:26331", (6.5, 3.4), (-92.0, -93.0, 122.0)),
    "Merchich Casablanca": ("EPSG:26191", (33.6, -7.6), (31.0, 146.0, 47.0)),
    "Egypt 1907 Cairo": ("EPSG:22992", (30.0, 31.2), (-130.0, 110.0, -13.0)),
    "WGS 84 (Transit)": ("EPSG:8888", (50.0, 5.0), (0.06, -0.517, -0.223)),
}  # fmt: skip
#: No operation of PROJ is installed there, or those that are contradict each other by more than 100 m.
REFUSED = {"Beijing 1954", "Xian 1980", "Indian 1975 Bangkok"}
_COUNTRY_M = 14.0  #: The translations hold for whole countries, with 1 to 10 m of error along each axis.


def on_old_datum(crs: str, place: tuple[float, float], shift_m: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Coordinates in a CRS of a place of WGS 84, by translation and the ellipsoid and projection alone."""
    system = CRS(crs)
    geodetic = system.geodetic_crs
    a, f = geodetic.ellipsoid.semi_major_metre, 1.0 / geodetic.ellipsoid.inverse_flattening
    point = ecef_from_geodetic(np.array([place[0]]), np.array([place[1]]), np.array([0.0])) - np.array(shift_m)
    back = Transformer.from_pipeline(f"+proj=pipeline +step +inv +proj=cart +a={a} +f={f} +step +proj=unitconvert "
                                     "+xy_in=rad +xy_out=deg")  # fmt: skip
    longitude, latitude, _ = back.transform(*point.T)
    if not system.is_projected:
        return longitude, latitude
    x, y = Proj(system)(longitude, latitude)
    return np.asarray(x), np.asarray(y)


@pytest.mark.parametrize("name", PLACES)
def test_a_place_on_an_older_datum_is_right_within_the_stated_accuracy_or_refused(name: str) -> None:
    crs, place, shift_m = PLACES[name]
    x, y = on_old_datum(crs, place, shift_m or (0.0, 0.0, 0.0))
    if name in REFUSED:
        with pytest.raises(SettingsError, match="PROJ has no installed operation"):
            georeference(crs, x, y, path="map")
        return
    found = georeference(crs, x, y, path="map")
    assert "Ballpark" not in found.operation
    assert found.accuracy_m > 0.0
    assert f"'{found.operation}' (accuracy {found.accuracy_m:g} m" in found.notes[0]
    at = ecef_from_geodetic(found.latitude_deg, found.longitude_deg, np.array([0.0]))
    if shift_m is not None:
        there = ecef_from_geodetic(np.array([place[0]]), np.array([place[1]]), np.array([0.0]))
        assert np.linalg.norm(at - there) < max(3.0 * found.accuracy_m, _COUNTRY_M)
    around = AreaOfInterest(place[1] - 0.1, place[0] - 0.1, place[1] + 0.1, place[0] + 0.1)
    frame = CRS(found.frame).to_2d()
    of_proj = Transformer.from_crs(
        CRS(crs).to_2d(), frame, always_xy=True, allow_ballpark=False, area_of_interest=around
    )
    longitude, latitude = of_proj.transform(x, y)
    assert np.linalg.norm(ecef_from_geodetic(latitude, longitude, np.array([0.0])) - at) < found.accuracy_m + 2.0


def write_line(path: Path, crs: str, points: Floats, **members: object) -> Path:
    """A GeoJSON line in a CRS."""
    line = {"type": "LineString", "coordinates": points.tolist()}
    member = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps({"type": "Feature", "crs": member, "properties": {}, "geometry": line, **members}))
    return path


def test_the_accuracy_of_the_operation_is_in_the_sigma_of_the_map_and_stated(tmp_path: Path) -> None:
    points = np.array([[530_000.0, 180_000.0, 20.0], [530_100.0, 180_000.0, 20.0]])
    path = write_line(tmp_path / "map.geojson", "EPSG:27700", points, height_datum="ellipsoidal")
    track = read_track(path)
    assert track.sigma_plan_m == pytest.approx(np.hypot(0.3, 2.0))
    notes = " ".join(track.provenance.notes)
    assert "'OSGB36 to WGS 84 (6)' (accuracy 2 m" in notes
    assert "projsync --file uk_os_OSTN15_NTv2_OSGBtoETRS.tif" in notes
    given = read_track(path, sigma_plan_m=0.5)
    assert given.sigma_plan_m == 0.5
    assert "better than the accuracy of the map's transformation" in " ".join(given.provenance.notes)


def test_the_accuracy_of_the_geoid_is_in_the_sigma_of_the_heights(tmp_path: Path) -> None:
    points = np.array([[6.5, 45.9, 1000.0], [6.6, 45.9, 1000.0]])
    path = write_line(tmp_path / "map.geojson", "EPSG:4258", points, height_datum="orthometric")
    track = read_track(path, geoid="egm96")
    assert track.sigma_height_m == pytest.approx(np.hypot(0.6, 1.0))
    assert "heights by EGM96" in " ".join(track.provenance.notes)
    assert read_track(path, geoid="egm96", sigma_height_m=0.7).sigma_height_m == 0.7


@pytest.mark.parametrize(
    ("crs", "grid", "points"),
    [
        ("EPSG:7415", "nl_nsgi_nlgeo2018.tif", [[121_700.0, 487_000.0, 1.0], [121_800.0, 487_000.0, 1.0]]),
        ("EPSG:5698", "fr_ign_RAF", [[652_000.0, 6_862_000.0, 30.0], [652_100.0, 6_862_000.0, 30.0]]),
        ("EPSG:31370+5710", "be_ign_hBG18.tif", [[149_000.0, 170_000.0, 20.0], [149_100.0, 170_000.0, 20.0]]),
        ("EPSG:7405", "uk_os_OSGM15_GB.tif", [[530_000.0, 180_000.0, 20.0], [530_100.0, 180_000.0, 20.0]]),
    ],
)
def test_a_height_grid_that_is_not_installed_is_named(crs: str, grid: str, points: object, tmp_path: Path) -> None:
    path = write_line(tmp_path / "map.geojson", crs, np.array(points))
    with pytest.raises(SettingsError, match=rf"{grid}.*not installed.*projsync --file"):
        read_track(path)
    with pytest.raises(SettingsError, match="geoid 'egm96' contradicts the file's own CRS"):
        read_track(path, geoid="egm96")


def test_heights_of_a_compound_crs_given_as_text_are_those_of_its_height_datum(tmp_path: Path) -> None:
    points = np.array([[5.0, 50.0, 100.0], [5.001, 50.0, 100.0]])
    for crs in ("EPSG:4326+5773", CRS("EPSG:4326+5773").to_wkt()):
        track = read_track(write_line(tmp_path / "map.geojson", crs, points))
        np.testing.assert_allclose(track.height_m, 100.0 + egm96_heights(*points.T[1::-1]), atol=1e-6)


def test_a_crs_without_a_datum_is_refused_and_one_of_unknown_accuracy_needs_it(tmp_path: Path) -> None:
    points = np.array([[500_000.0, 5_000_000.0, 1.0], [500_100.0, 5_000_000.0, 1.0]])
    path = write_line(tmp_path / "a.geojson", "+proj=utm +zone=32 +ellps=GRS80", points, height_datum="ellipsoidal")
    with pytest.raises(SettingsError, match="a CRS without a datum"):
        read_track(path)
    shifted = "+proj=utm +zone=32 +ellps=GRS80 +towgs84=0,0,0,0,0,0,0"
    path = write_line(tmp_path / "b.geojson", shifted, points, height_datum="ellipsoidal")
    with pytest.raises(SettingsError, match="--plan-sigma"):
        read_track(path)
    assert read_track(path, sigma_plan_m=1.0).sigma_plan_m == 1.0
