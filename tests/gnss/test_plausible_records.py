"""Navigation records that describe no orbit of their constellation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.pipeline_cases import clean_navigation
from railfix.core.errors import InputFileError
from railfix.gnss.navigation import Navigation
from railfix.gnss.plausible_records import plausible_navigation, plausible_radius
from railfix.io.logs import read_navigation
from railfix.pipeline.config import Config
from railfix.pipeline.received import known_from_start, receive

pytestmark = pytest.mark.requirement("A6")


def changed(navigation: Navigation, satellite: str, **values: object) -> Navigation:
    """Navigation data with fields of one satellite's records replaced."""
    own = navigation.kepler.satellite == satellite
    assert own.any()
    fields = {name: np.where(own, value, getattr(navigation.kepler, name)) for name, value in values.items()}
    return replace(navigation, kepler=replace(navigation.kepler, **fields))


def test_sound_records_stay() -> None:
    navigation = clean_navigation()
    assert plausible_navigation(navigation) is navigation


def test_reference_times_that_do_not_belong_together_are_rejected() -> None:
    navigation = clean_navigation()
    early = changed(navigation, "E05", toe=navigation.kepler.toe - np.timedelta64(600, "s"))
    found = plausible_navigation(early)
    assert "E05" not in found.kepler.satellite
    assert len(found.kepler) == len(navigation.kepler) - (navigation.kepler.satellite == "E05").sum()
    (note,) = found.notes
    assert "of Galileo rejected (E05): toe and toc differ by more than 5 min" in note
    assert found.skipped["implausible"] == (navigation.kepler.satellite == "E05").sum()


@pytest.mark.parametrize(
    ("satellite", "axis_m"), [("G10", 42_159_348.0), ("E05", 26_560_000.0), ("J02", 27_906_000.0), ("G10", 0.0)]
)
def test_orbits_of_other_constellations_are_rejected(satellite: str, axis_m: float) -> None:
    """42,159 km is the orbit of a QZSS satellite that a file of 2016 has under a number of GPS."""
    found = plausible_navigation(changed(clean_navigation(), satellite, sqrt_a=np.sqrt(axis_m)))
    assert satellite not in found.kepler.satellite
    assert len(np.unique(found.kepler.satellite)) == len(np.unique(clean_navigation().kepler.satellite)) - 1


def test_records_received_on_the_way_are_checked_as_those_of_files() -> None:
    config = Config()
    wrong = changed(clean_navigation(), "G10", eccentricity=0.3)
    after = receive(known_from_start(config), config, np.datetime64("NaT", "ns"), navigation=wrong)
    assert "G10" not in after.navigation.kepler.satellite
    assert "G15" in after.navigation.kepler.satellite


def glonass_text(x: float, y: float, z: float, vx: float, vy: float, vz: float) -> str:
    """A RINEX 3 file with one record of GLONASS, kilometres."""
    head = f"{'     3.04           N: GNSS NAV DATA    R':60}RINEX VERSION / TYPE\n{'':60}END OF HEADER\n"
    rows = [(x, vx, 0.0, 0.0), (y, vy, 0.0, 1.0), (z, vz, 0.0, 0.0)]
    first = "R03 2022 06 08 09 45 00" + "".join(f"{value:19.12E}" for value in (1e-5, 0.0, 3e5))
    return head + first + "\n" + "".join("    " + "".join(f"{v:19.12E}" for v in row) + "\n" for row in rows)


def test_glonass_states_off_their_orbit_are_rejected(tmp_path: Path) -> None:
    """A circular orbit of 25,508 km: 3.953 km/s in an inertial frame, less the Earth's rotation."""
    path = tmp_path / "r.nav"
    radius, speed = 25_508.0, np.sqrt(398_600.4418 / 25_508.0)
    turning = 7.2921151467e-5 * radius
    path.write_text(glonass_text(radius, 0.0, 0.0, 0.0, speed * np.cos(1.13) - turning, speed * np.sin(1.13)))
    assert len(read_navigation(path).glonass) == 1
    for position, velocity in (
        ((14_000.0,) * 3, (0.5, 1.0, -1.5)),  # the same number three times
        ((radius, 0.0, 0.0), (0.0, 0.0, 0.0)),  # without velocity
        ((0.0, 0.0, 11_400.0), (0.0, speed, 0.0)),
    ):
        path.write_text(glonass_text(*position, *velocity))
        with pytest.raises(InputFileError, match=r"1 record of GLONASS rejected \(R03\): radius or velocity"):
            read_navigation(path)


def test_records_of_recordings_are_all_but_known_ones(recordings: Path) -> None:
    """Three files have records in error: QZSS under a number of GPS, and GLONASS states off their orbit."""
    rejected = {}
    for path in sorted(recordings.rglob("*")):
        if "cases" in path.parts or path.suffix not in (".nav", ".gz", ".21n", ".21P", ".05n"):
            continue
        if path.suffix == ".gz" and not path.name.startswith("brdc"):
            continue
        found = read_navigation(path)
        if "implausible" in found.skipped:
            rejected[path.name] = found.skipped["implausible"]
    assert rejected == {"brdc1580.16n.gz": 1, "046r_rnx.nav": 14}


def test_radii_of_precise_orbits() -> None:
    names = np.array(["G01", "R01", "E14", "C01", "C20", "J02"])
    radius = np.array([26.6e6, 25.5e6, 23.5e6, 42.2e6, 27.9e6, 39.0e6])
    assert plausible_radius(names, radius[:, None] * np.array([0.6, 0.0, 0.8])).all()
    assert not plausible_radius(names, np.zeros((6, 3))).any()
    assert not plausible_radius(names, radius[::-1, None] * np.array([0.6, 0.0, 0.8]))[[0, 1]].any()
