"""Frames of five continents: moved to the ITRF within 5 cm of PROJ's steps, or of their published definitions."""

from __future__ import annotations

import numpy as np
import pytest
from pyproj import Transformer

from frame_cases import FRAMES, ITRF, MOTION, TIME, YEAR, moved
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track.crs import HELD, REALISATIONS, SAME, kind_of_frame
from railfix.track.frames import points_at

pytestmark = pytest.mark.requirement("A9")


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.every(2)
def test_a_frame_is_moved_as_proj_or_its_definition_has_it(name: str) -> None:
    case = moved(name)
    assert case.off_m < 0.05
    definition = FRAMES[name][2]
    if isinstance(definition, tuple) and definition[2] and name not in MOTION:
        assert "is left out" in case.shift.notes[0]
        assert np.linalg.norm(case.moved - case.place) > 0.1


#: To a frame from its ITRF: epoch of the parameters, translations [m] and rotations [mas] there, their rates a year,
#: scale [1e-9] and its rate: EUREF (Technical Note 1), ICSM (GDA2020 Technical Manual), NGS (Pearson & Snay 2013).
PUBLISHED = {
    "EPSG:10571": ("2020", 1989.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 3 * (0.0,), (0.086, 0.519, -0.753), 0.0, 0.0),
    "EPSG:7843": ("2014", 2020.0, 3 * (0.0,), 3 * (0.0,), 3 * (0.0,), (-1.50379, -1.18346, -1.20716), 0.0, 0.0),
    "EPSG:6319": (
        "2008", 1997.0, (0.99343, -1.90331, -0.52655), (-25.91467, -9.42645, -11.59935), (0.00079, -0.00060, -0.00134),
        (-0.06667, 0.75744, 0.05133), 1.71504, -0.10201,
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("crs", "place"), [("EPSG:10571", (50.8, 4.4)), ("EPSG:7843", (-33.9, 151.2)), ("EPSG:6319", (39.7, -105.0))]
)
def test_published_parameters_lead_to_the_same_place(crs: str, place: tuple[float, float]) -> None:
    """By the seven parameters and their rates, written out here without PROJ but for the few mm between ITRFs."""
    itrf, since, shift, turn, drift, turning, size, growing = PUBLISHED[crs]
    there = ecef_from_geodetic(*(np.array([v]) for v in (*place, 100.0)))
    found, _ = points_at(there, crs, TIME)
    back = Transformer.from_crs(9988, ITRF[itrf])
    old = np.stack(back.transform(*found.T, np.array([YEAR]))[:3], axis=-1)
    years = YEAR - since
    turned = np.radians((np.array(turn) + np.array(turning) * years) / 3.6e6)
    scale = 1e-9 * (size + growing * years)
    again = old + np.array(shift) + np.array(drift) * years + np.cross(turned, old) + scale * old
    assert np.linalg.norm(again - there) < 0.01


def test_an_ensemble_and_a_frame_of_another_name_say_what_they_are_taken_for() -> None:
    place = ecef_from_geodetic(np.array([50.8]), np.array([4.4]), np.array([0.0]))
    assert "taken as ETRF2020" in points_at(place, "EPSG:4258", TIME)[1].notes[0]
    assert points_at(place, "EPSG:9069", TIME)[1].notes == ()
    there = ecef_from_geodetic(np.array([40.0]), np.array([-105.0]), np.array([0.0]))
    assert "taken as NAD83(2011); the frames differ by up to 0.1 m" in points_at(there, "EPSG:4957", TIME)[1].notes[0]
    assert "latest realisation, which is ITRF2020" in points_at(place, "EPSG:4326", TIME)[1].method


@pytest.mark.slow
def test_no_frame_of_the_table_stops_with_an_error() -> None:
    """Each name is one that PROJ knows, at its own area of use."""
    import pyproj

    known = {info.name: info for info in pyproj.database.query_crs_info("EPSG", pyproj.enums.PJType.GEOGRAPHIC_2D_CRS)}
    known |= {i.name: i for i in pyproj.database.query_crs_info("EPSG", pyproj.enums.PJType.GEOGRAPHIC_3D_CRS)}
    for name in {*HELD, *REALISATIONS, *SAME}:
        info = known[name]
        latitude = (info.area_of_use.south + info.area_of_use.north) / 2.0
        place = ecef_from_geodetic(np.array([latitude]), np.array([info.area_of_use.west + 0.5]), np.array([0.0]))
        there, shift = points_at(place, f"EPSG:{info.code}", TIME)
        assert np.linalg.norm(there - place) < 6.0
        assert kind_of_frame(f"EPSG:{info.code}") in ("dynamic", "moves with its plate")
        assert "nan" not in str(shift.facts)
