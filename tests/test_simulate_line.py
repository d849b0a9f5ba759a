"""The made line, the train's motion and the rigid body: against geometry worked out in other ways."""

from __future__ import annotations

import numpy as np
import pytest

from railfix.errors import SettingsError
from railfix.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.simulate import (
    LineSettings,
    RunSettings,
    Scenario,
    VehicleSettings,
    antenna_truth,
    made_alignment,
    shuttle,
)
from railfix.simulate.run import vehicle_toml
from railfix.track_map import read_track, write_track_csv
from railfix.vehicle import antenna_trajectory, read_vehicle

pytestmark = pytest.mark.requirement("D4")

LINE = made_alignment(LineSettings())


def local(ecef_m: np.ndarray) -> np.ndarray:
    """East, north, up at the line's first point."""
    s = LINE.settings
    origin = ecef_from_geodetic(s.latitude_deg, s.longitude_deg, s.height_m)
    return (ecef_m - origin) @ enu_axes(s.latitude_deg, s.longitude_deg).T


def radius_through(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    """Radius of the circle through three points in plan, positive when turning to the right."""
    ab, bc, ca = b - a, c - b, a - c
    cross = ab[0] * bc[1] - ab[1] * bc[0]
    return float(-np.linalg.norm(ab) * np.linalg.norm(bc) * np.linalg.norm(ca) / (2.0 * cross))


def test_the_map_is_like_the_test_line_of_the_paper() -> None:
    track = LINE.track()
    spacing = np.diff(track.chainage_m)
    curved = (LINE.curvature_at(LINE.sampled_chainage_m()[:-1] + 0.1)) != 0.0
    assert len(track) == 189
    assert track.chainage_m[-1] == pytest.approx(756.0, abs=0.01)
    assert spacing.max() < 20.01
    assert spacing[curved].min() >= 2.0
    assert spacing[curved].max() <= 3.0
    assert track.kilometrage_m[[0, -1]] == pytest.approx([12_340.0, 13_096.0])
    assert np.abs(track.gradient_permille).max() == pytest.approx(10.0)
    assert np.nanmax(track.cant_m) == pytest.approx(0.090)


@pytest.mark.parametrize(("first_m", "last_m", "radius_m"), [(135.0, 245.0, -160.0), (390.0, 490.0, 300.0)])
def test_curves_have_their_radius(first_m: float, last_m: float, radius_m: float) -> None:
    place = local(LINE.at(np.array([first_m, (first_m + last_m) / 2.0, last_m])))
    assert radius_through(*place[:, :2]) == pytest.approx(radius_m, rel=1e-4)


def test_the_transition_is_a_clothoid() -> None:
    """Offset from the tangent at its foot: x^3 / (6 R L) and Cesaro's next term."""
    foot, length, radius = 90.0, 40.0, -160.0
    points = local(LINE.at(foot + np.linspace(0.0, length, 9)))
    heading = points[1] - points[0]
    tangent = local(LINE.at(np.array([foot - 10.0, foot])))
    along = (tangent[1] - tangent[0])[:2] / np.linalg.norm((tangent[1] - tangent[0])[:2])
    right = np.array([along[1], -along[0]])
    s = np.linspace(0.0, length, 9)
    offset = (points[:, :2] - points[0, :2]) @ right
    a = 1.0 / (2.0 * radius * length)
    assert offset == pytest.approx(a * s**3 / 3.0 - a**3 * s**7 / 42.0, abs=2e-4)
    assert heading[2] < 0.0, "the line falls here"


def test_heights_follow_the_gradient_and_chainage_is_arc_length() -> None:
    s = np.linspace(0.0, 756.0, 756_001)
    place = LINE.at(s)
    _, _, height = geodetic_from_ecef(place[::1000])
    climb = np.cumsum(np.sin(np.arctan(LINE.grade_at(s[:-1] + 5e-4)))) * 1e-3
    assert height[1:] - height[0] == pytest.approx(climb[999::1000], abs=1e-4)
    assert np.linalg.norm(np.diff(place, axis=0), axis=1).sum() == pytest.approx(756.0, abs=1e-5)
    assert np.linalg.norm(LINE.tangent_at(s), axis=1) == pytest.approx(1.0, abs=1e-6)


def test_a_long_line_keeps_its_pattern_height_and_direction() -> None:
    line = made_alignment(LineSettings(length_m=20_000.0))
    track = line.track()
    assert track.chainage_m[-1] == pytest.approx(20_000.0, abs=0.1)
    assert track.height_m.min() > 160.0
    assert track.height_m.max() < 165.0
    radii = np.unique(np.round(track.radius_m[np.isfinite(track.radius_m)], 6))
    assert set(np.abs(radii[np.abs(radii) < 301.0])) >= {160.0, 300.0}
    # Mirrored patterns undo each other's turning: the line goes on, and nowhere meets itself.
    assert np.linalg.norm(track.ecef_m[-1] - track.ecef_m[0]) > 17_000.0
    head = line.tangent_at(np.arange(0.0, 20_000.0, 2 * 756.0))
    assert (head @ head[0] > 0.999).all()


@pytest.mark.requirement("A2")
@pytest.mark.parametrize("antenna", ["front", "rear"])
def test_the_antenna_is_where_the_map_says(tmp_path: object, antenna: str) -> None:
    """The trajectory of the map's polyline, against the rigid body on the continuous curve."""
    from pathlib import Path

    folder = Path(str(tmp_path))
    vehicle = VehicleSettings()
    write_track_csv(LINE.track(), folder / "track.csv")
    (folder / "vehicle.toml").write_text(vehicle_toml(vehicle))
    path = antenna_trajectory(read_track(folder / "track.csv"), read_vehicle(folder / "vehicle.toml"), antenna)  # type: ignore[arg-type]
    offset = getattr(vehicle, antenna)
    # Bodies whose antenna stands abeam the chainages of the path's own points.
    middle = np.linspace(8.0, 748.0, 7401)
    truth = antenna_truth(LINE, vehicle, offset, middle)
    mapped = np.interp(truth.chainage_m, LINE.sampled_chainage_m(), LINE.track().chainage_m)
    place = np.stack([np.interp(path.chainage_m, mapped, truth.ecef_m[:, k]) for k in range(3)], axis=1)
    inside = (path.chainage_m > mapped[0]) & (path.chainage_m < mapped[-1])
    assert inside.sum() > 185
    assert np.linalg.norm(path.ecef_m - place, axis=1)[inside].max() < 0.010
    # Between its points the path is straight within its own tolerance of 2 cm and the map's chords.
    arc, apart = path.nearest(truth.ecef_m[50:-50])
    assert apart.max() < 0.030
    assert np.abs(path.chainage_at(arc) - mapped[50:-50]).max() < 0.010


def test_the_body_is_rigid_and_its_bogies_are_on_the_line() -> None:
    vehicle = VehicleSettings(front=(6.9, 0.0, 0.0), rear=(-6.9, 0.0, 0.0))
    middle = np.linspace(20.0, 736.0, 500)
    places = {n: antenna_truth(LINE, vehicle, getattr(vehicle, n), middle) for n in ("front", "rear")}
    apart = np.linalg.norm(places["front"].ecef_m - places["rear"].ecef_m, axis=1)
    assert apart == pytest.approx(13.8, abs=1e-6)
    for truth in places.values():
        assert np.linalg.norm(LINE.at(truth.chainage_m) - truth.ecef_m, axis=1).max() < 1e-5
    high = VehicleSettings(front=(0.0, 0.0, 4.0))
    lean = local(antenna_truth(LINE, high, high.front, np.array([190.0])).ecef_m - LINE.at(np.array([190.0])))
    assert lean.shape == (1, 3)
    # In the left curve the roof leans to the left by 4 m times 90 mm in 1137 mm, less the chord's sagitta to the left.
    truth = antenna_truth(LINE, high, high.front, np.array([190.0]))
    latitude, longitude, _ = geodetic_from_ecef(truth.ecef_m)
    right = np.cross(truth.forward, enu_axes(latitude, longitude)[:, 2])
    across = float(((truth.ecef_m - LINE.at(np.array([190.0]))) * right).sum() / np.linalg.norm(right))
    assert across == pytest.approx(-4.0 * 90.0 / 1137.0 - 13.8**2 / (8.0 * 160.0), abs=2e-3)


def test_the_train_runs_as_it_was_told() -> None:
    motion = shuttle(20.0, 736.0, 200.0, RunSettings())
    time = np.arange(0.0, 200.0, 0.01)
    chainage, speed = motion.at(time)
    assert chainage.min() == pytest.approx(20.0)
    assert chainage.max() == pytest.approx(736.0)
    assert np.abs(speed).max() == pytest.approx(40.0 / 3.6)
    assert np.diff(chainage) == pytest.approx((speed[1:] + speed[:-1]) / 2.0 * 0.01, abs=1e-4)
    acceleration = np.diff(speed) / 0.01
    assert acceleration.max() == pytest.approx(0.8, abs=1e-9), "braking on the way back"
    assert acceleration.min() == pytest.approx(-0.8, abs=1e-9)
    assert (speed[time < 15.0] == 0.0).all()
    # A leg too short for the cruising speed.
    short, slow = shuttle(0.0, 50.0, 100.0, RunSettings()).at(time)
    assert np.abs(slow).max() < 40.0 / 3.6
    assert short.max() == pytest.approx(50.0, abs=1e-3)


@pytest.mark.parametrize(
    "settings",
    [
        lambda: LineSettings(length_m=50.0),
        lambda: RunSettings(cruise_mps=0.0),
        lambda: Scenario(line=LineSettings(length_m=100.0), run=RunSettings(end_margin_m=60.0)),
        lambda: Scenario(run=RunSettings(end_margin_m=5.0)),
        lambda: Scenario(rate_hz=3.0),
        lambda: Scenario(duration_s=0.0),
        lambda: Scenario(duration_s=float("nan")),
    ],
)
def test_settings_that_make_no_run_are_refused(settings: object) -> None:
    with pytest.raises(SettingsError):
        settings()  # type: ignore[operator]
