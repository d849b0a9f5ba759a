"""Frames of maps: against PROJ's own pipelines at named places and epochs, and in a run of a static station."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic
from railfix.track import Track, read_track
from railfix.track.crs import WORKING_FRAME, kind_of_frame
from railfix.track.frames import decimal_year, track_at
from railfix.track.georeference import georeference
from railfix.track.track import Provenance

pytestmark = pytest.mark.requirement("A9")

#: PROJ's steps by hand: geocentric ETRF2014, NAD83(2011), GDA2020 to ITRF2014 and to ITRF2020. The 14 parameters are
#: those of the EPSG entries named; signs as PROJ's position-vector convention has them.
PLACES = {
    "EPSG:9069": [(35.0 + 1.7 * k, -9.0 + 1.9 * k, 50.0 * k) for k in range(20)],  # ETRF2014
    "EPSG:7931": [(35.0 + 1.7 * k, -9.0 + 1.9 * k, 50.0 * k) for k in range(20)],  # ETRF2000
    "EPSG:6319": [(26.0 + 1.1 * k, -123.0 + 2.7 * k, 40.0 * k) for k in range(20)],  # NAD83(2011)
    "EPSG:7843": [(-43.0 + 1.6 * k, 115.0 + 1.9 * k, 20.0 * k) for k in range(20)],  # GDA2020
}
GEOCENTRIC = {"EPSG:9069": "EPSG:8401", "EPSG:7931": "EPSG:7930", "EPSG:6319": "EPSG:6317", "EPSG:7843": "EPSG:7842"}


def line_at(places: list[tuple[float, float, float]], frame: str) -> Track:
    latitude, longitude, height = np.array(places).T
    return Track.from_geodetic(latitude, longitude, height, provenance=Provenance(crs=frame, frame=frame))


@pytest.mark.parametrize("frame", PLACES)
@pytest.mark.parametrize("year", [2010, 2021, 2026])
def test_shifts_are_those_of_proj(frame: str, year: int) -> None:
    """20 places of each frame at three epochs, within 2 cm of PROJ's steps over ITRF2014."""
    time = np.datetime64(f"{year}-07-02T12:00:00")
    track = line_at(PLACES[frame], frame)
    moved, shift = track_at(track, time)
    at = np.full(len(track), decimal_year(time))
    source = Transformer.from_crs(frame, GEOCENTRIC[frame], always_xy=False)
    x, y, z = source.transform(track.latitude_deg, track.longitude_deg, track.height_m)
    to_2014 = Transformer.from_crs(GEOCENTRIC[frame], "EPSG:7789", allow_ballpark=False)
    to_2020 = Transformer.from_crs("EPSG:7789", "EPSG:9988", allow_ballpark=False)
    x, y, z, _ = to_2014.transform(x, y, z, at)
    x, y, z, _ = to_2020.transform(x, y, z, at)
    assert np.linalg.norm(moved.ecef_m - np.stack([x, y, z], axis=-1), axis=1).max() < 0.02
    size = np.linalg.norm(moved.ecef_m - track.ecef_m, axis=1)
    assert size.min() > 0.05
    assert size.max() < 2.0
    assert np.hypot(np.hypot(shift.east_m, shift.north_m), shift.up_m) == pytest.approx(size[len(track) // 2], abs=1e-6)


@pytest.mark.parametrize(
    ("frame", "place", "size"),
    [
        ("EPSG:4258", (50.85, 4.35, 100.0), (0.85, 0.97)),  # Brussels
        ("EPSG:6319", (39.74, -104.99, 1600.0), (1.2, 1.75)),  # Denver, height included
        ("EPSG:7843", (-33.87, 151.21, 50.0), (0.33, 0.45)),  # Sydney
    ],
)
def test_known_sizes_in_2026(frame: str, place: tuple[float, float, float], size: tuple[float, float]) -> None:
    latitude, longitude, height = place
    track = line_at([place, (latitude + 0.01, longitude, height)], frame)
    _, shift = track_at(track, np.datetime64("2026-07-01"))
    assert size[0] < float(np.linalg.norm([shift.east_m, shift.north_m, shift.up_m])) < size[1]


def test_plate_motion_by_hand() -> None:
    """ITRF2020 rotation of the Eurasian plate (Altamimi et al. 2023, table 2): -0.085, -0.519, 0.753 mas a year."""
    track = line_at([(50.85, 4.35, 0.0), (50.86, 4.35, 0.0)], WORKING_FRAME)
    moved, shift = track_at(track, np.datetime64("2030-01-01"), epoch=2020.0, plate="EURA")
    rate = np.radians(np.array([-0.085, -0.519, 0.753]) / 3.6e6)
    expected = np.cross(rate, track.ecef_m) * 10.0
    assert np.abs(moved.ecef_m - track.ecef_m - expected).max() < 0.002
    assert "EURA" in shift.method
    same, shift = track_at(track, np.datetime64("2030-01-01"), epoch=2020.0)
    assert np.abs(same.ecef_m - track.ecef_m).max() < 1e-6
    assert "not moved" in shift.notes[0]


def test_japan_moves_with_its_plate_and_says_so() -> None:
    track = line_at([(35.68, 139.76, 60.0), (35.69, 139.76, 60.0)], "EPSG:6667")
    _, shift = track_at(track, np.datetime64("2026-07-01"))
    assert 0.2 < np.hypot(shift.east_m, shift.north_m) < 0.6
    assert "left out" in shift.notes[0]


def _semidynamic(path: Path, *, slope: float = 0.0) -> Path:
    """A parameter file about Tokyo: 0.01 and 0.02 seconds of arc, 0.1 m; the first grows by `slope` each 5 km north."""
    mesh = pytest.importorskip("jgdtrans").mesh
    lines = ["made by a test"] * 15 + ["MeshCode dB(sec)  dL(sec) dH(m)"]
    for row in range(4):
        for column in range(4):
            cell = mesh.MeshCell.from_pos(35.63 + row / 24.0, 139.71 + column / 16.0, mesh_unit=5)
            code = cell.south_west.to_meshcode()
            lines.append(f"{code:08d} {0.01 + slope * row:9.5f} {0.02:9.5f} {0.1:9.5f}")
    path.write_text("\n".join(lines) + "\n")
    return path


def test_japan_moves_by_a_semidynamic_correction_where_its_file_is_given(tmp_path: Path) -> None:
    track = line_at([(35.68, 139.76, 60.0), (35.69, 139.77, 60.0)], "EPSG:6667")
    time = np.datetime64("2026-07-01")
    moved, shift = track_at(track, time, parameters=_semidynamic(tmp_path / "s.par"))
    assert moved.latitude_deg - track.latitude_deg == pytest.approx(0.01 / 3600.0, abs=1e-9)
    assert moved.longitude_deg - track.longitude_deg == pytest.approx(0.02 / 3600.0, abs=1e-9)
    assert (shift.east_m, shift.north_m, shift.up_m) == pytest.approx((0.503, 0.308, 0.1), abs=2e-3)
    assert "its epoch is not given" in shift.notes[0]
    later, named = track_at(track, time, parameters=tmp_path / "s.par", epoch=2024.5)
    step = np.linalg.norm(later.ecef_m - moved.ecef_m, axis=1)
    assert 0.03 < step[0] < 0.07  # two years of the Eurasian plate in the ITRF
    assert "since the map epoch 2024.5" in named.method
    # taken by cells of 0.001 degrees: within millimetres of each point's own
    sloped, _ = track_at(track, time, parameters=_semidynamic(tmp_path / "slope.par", slope=0.001))
    correction = pytest.importorskip("jgdtrans").loads((tmp_path / "slope.par").read_text(), format="SemiDynaEXE")
    own = [correction.forward_corr(*p).latitude for p in zip(track.latitude_deg, track.longitude_deg, strict=True)]
    assert (sloped.latitude_deg - track.latitude_deg - own) * 111e3 == pytest.approx(0.0, abs=2e-3)


def test_semidynamic_files_that_cannot_be_used_are_one_sentence(tmp_path: Path) -> None:
    tokyo = line_at([(35.68, 139.76, 60.0), (35.69, 139.76, 60.0)], "EPSG:6667")
    osaka = line_at([(34.68, 135.76, 60.0), (34.69, 135.76, 60.0)], "EPSG:6667")
    europe = line_at([(50.85, 4.35, 100.0), (50.86, 4.35, 100.0)], "EPSG:4937")
    time, path = np.datetime64("2026-07-01"), _semidynamic(tmp_path / "s.par")
    with pytest.raises(InputFileError, match="no parameters for a part of the map"):
        track_at(osaka, time, parameters=path)
    with pytest.raises(SettingsError, match="apply only to JGD2011"):
        track_at(europe, time, parameters=path)
    (tmp_path / "text.par").write_text("no parameters\n" * 20)
    with pytest.raises(InputFileError, match="not a parameter file of semi-dynamic correction"):
        track_at(tokyo, time, parameters=tmp_path / "text.par")


def test_a_map_without_a_frame_names_its_doubt(tmp_path: Path) -> None:
    path = tmp_path / "line.csv"
    path.write_text("latitude_deg,longitude_deg,height_m\n50.85,4.35,100\n50.86,4.35,100\n")
    track = read_track([path])
    same, shift = track_at(track, np.datetime64("2026-07-01"))
    assert same is track
    assert "displaced by 0.89 m" in shift.notes[0]
    assert "ETRS89" in shift.notes[0]
    path.write_text("# crs: EPSG:4979\nlatitude_deg,longitude_deg,height_m\n50.85,4.35,100\n50.86,4.35,100\n")
    assert track_at(read_track([path]), np.datetime64("2026-07-01"))[1].notes == ()


def test_kinds_and_older_datums() -> None:
    kinds = {crs: kind_of_frame(crs) for crs in ("EPSG:4326", "EPSG:25831", "EPSG:9989", "EPSG:31370", "EPSG:6677")}
    assert list(kinds.values()) == ["wgs84", "moves with its plate", "dynamic", "older datum", "moves with its plate"]
    # Belgian Lambert 72 goes to ETRS89, so that the rest of the way to the ITRF follows.
    place = georeference("EPSG:31370", np.array([150_000.0]), np.array([170_000.0]), path="map")
    assert (place.frame, place.accuracy_m) == ("EPSG:4937", 0.2)
    assert (place.latitude_deg[0], place.longitude_deg[0]) == (
        pytest.approx(50.84, abs=0.02),
        pytest.approx(4.37, abs=0.02),
    )


def test_what_is_refused(tmp_path: Path) -> None:
    track = line_at([(50.85, 4.35, 100.0), (50.86, 4.35, 100.0)], "EPSG:4258")
    with pytest.raises(SettingsError, match="no epoch and no plate apply"):
        track_at(track, np.datetime64("2026-07-01"), epoch=2020.0)
    with pytest.raises(SettingsError, match="plate 'ATLANTIS'"):
        track_at(
            line_at([(1.0, 1.0, 0.0), (1.1, 1.0, 0.0)], WORKING_FRAME), np.datetime64("2026-07-01"), plate="ATLANTIS"
        )
    for name, crs, first in (("a", "EPSG:4258", 50.85), ("b", "EPSG:4326", 50.86)):
        rows = f"{first},4.35,100\n{first + 0.01},4.35,100\n"
        (tmp_path / f"{name}.csv").write_text(f"# crs: {crs}\nlatitude_deg,longitude_deg,height_m\n{rows}")
    with pytest.raises(MismatchError, match="different reference frames"):
        read_track([tmp_path / "a.csv", tmp_path / "b.csv"])


def test_epochs_as_years() -> None:
    assert decimal_year(np.datetime64("2024-07-02T00:00")) == pytest.approx(2024.5, abs=0.001)
    assert ecef_from_geodetic(0.0, 0.0, 0.0)[0] == pytest.approx(6_378_137.0)
