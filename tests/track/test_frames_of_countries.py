"""Frames of five continents: moved to the ITRF within 5 cm of PROJ's steps, or of their published definitions."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS, Transformer

from railfix.core.geodesy import ecef_from_geodetic
from railfix.track.crs import frame_degrees, kind_of_frame, older_datum_note
from railfix.track.frame_table import HELD, REALISATIONS, SAME
from railfix.track.frames import points_at

pytestmark = pytest.mark.requirement("A9")
TIME, YEAR = np.datetime64("2026-07-02T12:00:00"), 2026.5
#: Geocentric codes of the realisations of the ITRF, for a way that is not the code's own.
ITRF = {"91": 4913, "93": 4915, "94": 4916, "96": 4917, "97": 4918, "2000": 4919, "2005": 4896, "2008": 5332}
ITRF |= {"2014": 7789, "2020": 9988}
#: Rotation of plates [mas a year]: Altamimi et al. 2023, table 2.
ROTATION = {
    "EURA": (-0.085, -0.519, 0.753),
    "AMUR": (-0.131, -0.551, 0.837),
    "AUST": (1.487, 1.175, 1.223),
    "PCFC": (-0.404, 1.021, -2.154),
    "SOAM": (-0.261, -0.282, -0.157),
    "NUBI": (0.090, -0.585, 0.717),
    "NOAM": (0.045, -0.666, -0.098),
}
#: Code, place, and definition: the ITRF at an epoch on a plate, or the geocentric code of a frame that PROJ moves.
FRAMES = {
    "CGCS2000": ("EPSG:4490", (31.2, 121.5), ("97", 2000.0, "EURA")),
    "CGCS2000, a grid": ("EPSG:4549", (31.2, 120.5), ("97", 2000.0, "EURA")),
    "KGD2002": ("EPSG:4737", (37.5, 127.0), ("2000", 2002.0, "AMUR")),
    "TWD97": ("EPSG:3826", (25.0, 121.5), ("94", 1997.0, "EURA")),
    "JGD2011": ("EPSG:6677", (35.7, 139.8), ("2008", 2011.4, "EURA")),
    "JGD2000": ("EPSG:4612", (35.7, 139.8), ("94", 1997.0, "EURA")),
    "GSK-2011": ("EPSG:7683", (55.7, 37.6), ("2008", 2011.0, "EURA")),
    "KSA-GRF17": ("EPSG:9333", (24.7, 46.7), 9331),
    "NZGD2000 of Auckland": ("EPSG:2193", (-36.9, 174.8), ("96", 2000.0, "AUST")),
    "NZGD2000 of Christchurch": ("EPSG:2193", (-43.5, 172.6), ("96", 2000.0, "PCFC")),
    "GDA94": ("EPSG:4283", (-33.9, 151.2), 4938),
    "GDA2020": ("EPSG:7844", (-33.9, 151.2), 7842),
    "SIRGAS 2000": ("EPSG:4674", (-15.8, -47.9), ("2000", 2000.4, "SOAM")),
    "SIRGAS 2000, a grid": ("EPSG:31983", (-23.5, -46.6), ("2000", 2000.4, "SOAM")),
    "POSGAR 2007": ("EPSG:5340", (-34.6, -58.4), ("2005", 2006.632, "SOAM")),
    "MAGNA-SIRGAS": ("EPSG:4686", (4.6, -74.1), ("94", 1995.4, "SOAM")),
    "SIRGAS-Chile 2016": ("EPSG:9153", (-33.4, -70.7), ("2008", 2016.0, "SOAM")),
    "Hartebeesthoek94": ("EPSG:4148", (-26.2, 28.0), ("91", 1994.0, "NUBI")),
    "Mexico ITRF2008": ("EPSG:6365", (19.4, -99.1), ("2008", 2010.0, "NOAM")),
    "NAD83(CSRS)": ("EPSG:4617", (51.0, -114.1), 8253),
    "NAD83(CSRS), a grid": ("EPSG:2955", (51.0, -114.1), 8253),
    "NAD83(CSRS)v6": ("EPSG:8252", (45.4, -75.7), 8250),
    "NAD83(HARN)": ("EPSG:4152", (39.7, -105.0), 6317),
    "NAD83(NSRS2007)": ("EPSG:4759", (39.7, -105.0), 6317),
    "NAD83(2011)": ("EPSG:6318", (39.7, -105.0), 6317),
    "NAD83(PA11)": ("EPSG:6322", (21.3, -157.9), 6320),
    "ETRS89": ("EPSG:4258", (50.8, 4.4), 10569),
    "ETRF2000": ("EPSG:9067", (50.8, 4.4), 7930),
    "RGF93 v2b": ("EPSG:9782", (48.9, 2.4), 7930),
    "EST97": ("EPSG:3301", (59.4, 24.7), 10569),
    "IGb08": ("EPSG:9017", (50.8, 4.4), ("2008", YEAR, None)),
    "IGb14": ("EPSG:9380", (50.8, 4.4), ("2014", YEAR, None)),
    "IGS20": ("EPSG:10178", (50.8, 4.4), ("2020", YEAR, None)),
    "WGS 84 (G1150)": ("EPSG:9055", (50.8, 4.4), ("2000", YEAR, None)),
}


@pytest.mark.parametrize("name", FRAMES)
def test_a_frame_is_moved_as_proj_or_its_definition_has_it(name: str) -> None:
    code, (latitude, longitude), definition = FRAMES[name]
    grid = CRS(code)
    x, y = (np.array([v]) for v in (longitude, latitude))
    if grid.is_projected:
        x, y = Transformer.from_crs(grid.geodetic_crs, grid, always_xy=True).transform(x, y)
    lat, lon, frame = frame_degrees(code, x, y, path="map")
    place = ecef_from_geodetic(lat, lon, np.array([100.0]))
    moved, shift = points_at(place, frame, TIME)
    if isinstance(definition, int):
        steps = Transformer.from_crs(definition, 9988, allow_ballpark=False)
        expected = np.stack(steps.transform(*place.T, np.array([YEAR]))[:3], axis=-1)
    else:
        itrf, epoch, plate = definition
        steps = Transformer.from_crs(ITRF[itrf], 9988)
        at = np.stack(steps.transform(*place.T, np.array([epoch]))[:3], axis=-1)
        rate = np.radians(np.array(ROTATION[plate] if plate else (0.0, 0.0, 0.0)) / 3.6e6)
        expected = at + np.cross(rate, at) * (YEAR - epoch)
    assert np.linalg.norm(moved - expected) < 0.05
    if isinstance(definition, tuple) and definition[2]:
        assert "is left out" in shift.notes[0]
        assert np.linalg.norm(moved - place) > 0.1


def test_an_ensemble_and_a_frame_of_another_name_say_what_they_are_taken_for() -> None:
    place = ecef_from_geodetic(np.array([50.8]), np.array([4.4]), np.array([0.0]))
    assert "taken as ETRF2020" in points_at(place, "EPSG:4258", TIME)[1].notes[0]
    assert points_at(place, "EPSG:9069", TIME)[1].notes == ()
    there = ecef_from_geodetic(np.array([40.0]), np.array([-105.0]), np.array([0.0]))
    assert "taken as NAD83(2011); it differs by up to 0.1 m" in points_at(there, "EPSG:4957", TIME)[1].notes[0]
    assert "latest realisation, which is ITRF2020" in points_at(place, "EPSG:4326", TIME)[1].method


@pytest.mark.parametrize(
    ("crs", "frame"),
    [
        ("EPSG:4618", "EPSG:4989"),  # SAD69: South America
        ("EPSG:4272", "EPSG:4959"),  # NZGD49
        ("EPSG:4162", "EPSG:4927"),  # Korean 1985, not Japan
        ("EPSG:4269", "EPSG:6319"),  # NAD83 as of 1986
        ("EPSG:31370", "EPSG:4937"),  # Belgian Lambert 72
        ("EPSG:30169", "EPSG:4326"),  # Tokyo: PROJ has none to JGD2011 without its grid, and Korea's is not meant
    ],
)
def test_an_older_datum_goes_to_the_modern_frame_of_its_region(crs: str, frame: str) -> None:
    area = CRS(crs).area_of_use
    assert area is not None
    x = np.array([(area.west + (area.east - area.west) % 360.0 / 2.0 + 180.0) % 360.0 - 180.0])
    y = np.array([(area.south + area.north) / 2.0])
    if CRS(crs).is_projected:
        x, y = Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(x, y)
    assert frame_degrees(crs, x, y, path="map")[2] == frame
    assert "transformed to" in older_datum_note(crs)[0]


@pytest.mark.slow
def test_no_frame_of_the_table_stops_with_an_error() -> None:
    """Each name is one that PROJ knows, at its own area of use."""
    import pyproj

    known = {info.name: info for info in pyproj.database.query_crs_info("EPSG", pyproj.enums.PJType.GEOGRAPHIC_2D_CRS)}
    known |= {i.name: i for i in pyproj.database.query_crs_info("EPSG", pyproj.enums.PJType.GEOGRAPHIC_3D_CRS)}
    for name in {*HELD, *REALISATIONS, *SAME}:
        info = known[name]
        assert info.area_of_use is not None
        latitude = (info.area_of_use.south + info.area_of_use.north) / 2.0
        place = ecef_from_geodetic(np.array([latitude]), np.array([info.area_of_use.west + 0.5]), np.array([0.0]))
        moved, shift = points_at(place, f"EPSG:{info.code}", TIME)
        assert np.linalg.norm(moved - place) < 6.0
        assert kind_of_frame(f"EPSG:{info.code}") in ("dynamic", "moves with its plate")
        assert "nan" not in str(shift.facts)
