"""The made line, the train's motion and the rigid body: against geometry worked out in other ways."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from railfix.core.errors import InputFileError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.core.settings_files import write_toml
from railfix.simulate import (
    Element,
    GeneratedLine,
    Gradient,
    LineFile,
    LineSettings,
    MapError,
    RunSettings,
    Scenario,
    SpeedLimit,
    Station,
    Terrain,
    VehicleSettings,
    antenna_truth,
    build_alignment,
    build_motion,
    run_curve,
    shuttle,
)
from railfix.simulate.motion import BodyMotion, limit_jerk
from railfix.simulate.run import vehicle_table
from railfix.track import read_track, write_track_csv
from railfix.track.vehicle import antenna_trajectory, read_vehicle

pytestmark = pytest.mark.requirement("D4")

LINE = build_alignment(LineSettings())


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
    curved = (LINE.curvature_at(LINE.point_chainage_m()[:-1] + 0.1)) != 0.0
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


@pytest.mark.slow
def test_heights_follow_the_gradient_and_chainage_is_arc_length() -> None:
    s = np.linspace(0.0, 756.0, 756_001)
    place = LINE.at(s)
    _, _, height = geodetic_from_ecef(place[::1000])
    climb = np.cumsum(np.sin(np.arctan(LINE.grade_at(s[:-1] + 5e-4)))) * 1e-3
    assert height[1:] - height[0] == pytest.approx(climb[999::1000], abs=1e-4)
    assert np.linalg.norm(np.diff(place, axis=0), axis=1).sum() == pytest.approx(756.0, abs=1e-5)
    assert np.linalg.norm(LINE.tangent_at(s), axis=1) == pytest.approx(1.0, abs=1e-6)


def test_a_long_line_keeps_its_pattern_height_and_direction() -> None:
    line = build_alignment(LineSettings(length_m=20_000.0))
    track = line.track()
    assert track.chainage_m[-1] == pytest.approx(20_000.0, abs=0.1)
    assert track.height_m.min() > 160.0
    assert track.height_m.max() < 165.0
    radii = np.unique(np.round(track.radius_m[np.isfinite(track.radius_m)], 6))
    assert set(np.abs(radii[np.abs(radii) < 301.0])) >= {160.0, 300.0}
    # Reflections patterns undo each other's turning: the line goes on, and nowhere meets itself.
    assert np.linalg.norm(track.ecef_m[-1] - track.ecef_m[0]) > 17_000.0
    head = line.tangent_at(np.arange(0.0, 20_000.0, 2 * 756.0))
    assert (head @ head[0] > 0.999).all()


@pytest.mark.requirement("A2")
@pytest.mark.parametrize("antenna", ["front", "rear"])
def test_the_antenna_is_where_the_map_says(tmp_path: Path, antenna: str) -> None:
    """The trajectory of the map's polyline, against the rigid body on the continuous curve."""
    folder = tmp_path
    vehicle = VehicleSettings()
    write_track_csv(LINE.track(), folder / "track.csv")
    write_toml(folder / "vehicle.toml", vehicle_table(vehicle))
    path = antenna_trajectory(read_track(folder / "track.csv"), read_vehicle(folder / "vehicle.toml"), antenna)  # type: ignore[arg-type]
    offset = getattr(vehicle, antenna)
    # Bodies whose antenna stands abeam the chainages of the path's own points.
    middle = np.linspace(8.0, 748.0, 7401)
    truth = antenna_truth(LINE, vehicle, offset, middle)
    mapped = np.interp(truth.chainage_m, LINE.point_chainage_m(), LINE.track().chainage_m)
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


# ---------------------------------------------------------------- lines of elements, of a seed, of a file


def elements_line(**more: object) -> LineSettings:
    """Straight, clothoid, circle of 300 m to the right with 80 mm, clothoid, straight; falling, then rising."""
    return LineSettings(
        kind="elements",
        elements=(
            Element(kind="straight", length_m=200.0),
            Element(kind="transition", length_m=60.0),
            Element(kind="curve", length_m=150.0, radius_m=300.0, cant_m=0.080),
            Element(kind="transition", length_m=60.0),
            Element(kind="straight", length_m=230.0),
        ),
        gradients=(
            Gradient(from_m=0.0, permille=-5.0),
            Gradient(from_m=350.0, permille=12.0, vertical_radius_m=3000.0),
        ),
        **more,  # type: ignore[arg-type]
    )


def test_a_line_of_elements_is_what_they_say() -> None:
    line = build_alignment(elements_line())
    assert line.length_m == pytest.approx(700.0)
    assert line.curvature_at([100.0, 230.0, 300.0, 440.0]) == pytest.approx(np.array([0.0, 0.5, 1.0, 0.5]) / 300.0)
    assert line.lean_at([100.0, 230.0, 300.0]) == pytest.approx([0.0, 0.040, 0.080])
    # Turned by the circle and half of each clothoid: (150 + 60) / 300 rad, the meridians' convergence apart.
    start, end = (line.tangent_at(np.array([m]))[0] for m in (0.0, 700.0))
    assert np.degrees(np.arccos(start @ end)) == pytest.approx(np.degrees(210.0 / 300.0), abs=0.05)
    # The vertical curve of 3000 m takes 51 m, its middle at the change.
    assert line.grade_at([0.0, 324.0, 350.0, 376.0]) == pytest.approx([-0.005, -0.005, 0.0035, 0.012], abs=1e-9)
    track = line.track()
    middle = track.height_m[0] - 0.005 * 324.5
    assert np.interp(324.5, track.chainage_m, track.height_m) == pytest.approx(middle, abs=0.02)
    assert np.nanmax(track.cant_m) == pytest.approx(0.080)
    assert set(np.round(track.radius_m[np.isfinite(track.radius_m) & (track.radius_m < 301.0)], 3)) == {300.0}


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (lambda: LineSettings(kind="elements"), "elements"),
        (lambda: Element(kind="curve", length_m=10.0), "radius_m"),
        (lambda: Element(kind="straight", length_m=10.0, cant_m=0.1), "cant_m"),
        (lambda: LineSettings(kind="generated", file=LineFile(path="x.csv")), "file"),
        (lambda: LineSettings(generated=GeneratedLine(seed=2)), "generated"),
        (lambda: LineSettings(kind="file", file=LineFile(path="x.csv"), length_m=5.0), "follows from the file"),
        (lambda: GeneratedLine(terrain=(Terrain(from_m=5.0),)), "begin at 0"),
        (lambda: build_alignment(LineSettings(kind="elements", elements=(
            Element(kind="straight", length_m=100.0), Element(kind="curve", length_m=90.0, radius_m=400.0)))),
         "need a transition"),
        (lambda: build_alignment(LineSettings(kind="elements", elements=(Element(kind="straight", length_m=700.0),),
            gradients=(Gradient(from_m=300.0, permille=9.0), Gradient(from_m=310.0, permille=0.0)))), "overlaps"),
    ],
)  # fmt: skip
def test_lines_that_cannot_be_are_refused(settings: object, told: str) -> None:
    with pytest.raises(SettingsError, match=told):
        settings()  # type: ignore[operator]


MOUNTAIN = Terrain(from_m=12_000.0, radius_m=(300.0, 800.0), straight_m=(60.0, 400.0), permille=25.0)


def test_a_generated_line_keeps_its_ranges() -> None:
    settings = LineSettings(
        kind="generated", length_m=20_000.0, generated=GeneratedLine(seed=5, terrain=(Terrain(), MOUNTAIN))
    )
    line = build_alignment(settings)
    again = build_alignment(settings)
    np.testing.assert_array_equal(line.at([0.0, 9999.0, 20_000.0]), again.at([0.0, 9999.0, 20_000.0]))
    s = np.arange(0.0, 20_000.0, 1.0)
    bend = np.abs(line.curvature_at(s))
    assert bend[s < 11_000.0].max() <= 1.0 / 400.0 + 1e-9
    assert 1.0 / 800.0 < bend[s > 13_000.0].max() <= 1.0 / 300.0 + 1e-9
    grade = np.abs(line.grade_at(s))
    assert grade[s < 11_000.0].max() <= 0.0100001
    assert 0.011 < grade.max() <= 0.0250001
    # Cant on circles is the equilibrium cant of 110 km/h, in steps of 5 mm, and 105 mm at most.
    circle = (bend > 0.0) & (np.abs(np.gradient(bend)) < 1e-12)
    ideal = np.minimum((110.0 / 3.6) ** 2 * bend[circle] / 9.80665 * 1.137, 0.105)
    assert np.abs(np.abs(line.lean_at(s))[circle] - ideal).max() < 0.0026
    # Transitions are long enough: the cant rises by no more than 1 in 400.
    assert np.abs(np.diff(line.lean_at(s))).max() < 1.0 / 400.0 + 1e-9
    # It goes somewhere: no loop.
    assert np.linalg.norm(line.at(20_000.0) - line.at(0.0)) > 10_000.0
    other = build_alignment(LineSettings(kind="generated", length_m=20_000.0, generated=GeneratedLine(seed=6)))
    assert np.linalg.norm(other.at(20_000.0) - line.at(20_000.0)) > 100.0


def test_a_track_file_becomes_the_line_it_was_sampled_from(tmp_path: Path) -> None:
    """The spline through a map's points against the clothoids that the map was sampled from."""
    write_track_csv(LINE.track(), tmp_path / "track.csv")
    line = build_alignment(LineSettings(kind="file", file=LineFile(path=str(tmp_path / "track.csv"))))
    assert line.length_m == pytest.approx(756.0, abs=1e-3)
    s = np.linspace(0.0, line.length_m, 5001)
    assert np.linalg.norm(line.at(s) - LINE.at(s), axis=1).max() < 0.005
    assert np.linalg.norm(line.tangent_at(s), axis=1) == pytest.approx(1.0, abs=1e-6)
    assert np.abs(line.lean_at(s) - LINE.lean_at(s)).max() < 1e-4
    assert np.abs(line.kilometrage_at(s) - LINE.kilometrage_at(s)).max() < 1e-3
    np.testing.assert_array_equal(line.track().latitude_deg, read_track(tmp_path / "track.csv").latitude_deg)
    part = build_alignment(
        LineSettings(kind="file", file=LineFile(path=str(tmp_path / "track.csv"), from_m=100.0, to_m=400.0))
    )
    assert 270.0 < part.length_m < 300.0


def test_a_track_file_that_jitters_or_lacks_points_is_refused(tmp_path: Path) -> None:
    track = LINE.track()
    rough = read_track_with_jitter(tmp_path, track.latitude_deg, track.longitude_deg, track.height_m)
    with pytest.raises(InputFileError, match="radius of"):
        build_alignment(LineSettings(kind="file", file=LineFile(path=str(rough))))
    with pytest.raises(InputFileError, match="at least 4"):
        build_alignment(LineSettings(kind="file", file=LineFile(path=str(rough), from_m=5e5)))


def read_track_with_jitter(folder: Path, lat: np.ndarray, lon: np.ndarray, height: np.ndarray) -> Path:
    """The map with every second point 0.5 m to the north."""
    from railfix.track import Track

    moved = lat + np.where(np.arange(len(lat)) % 2 == 0, 0.5 / 111_000.0, 0.0)
    write_track_csv(Track.from_geodetic(moved, lon, height), folder / "rough.csv")
    return folder / "rough.csv"


@pytest.mark.slow
def test_the_map_is_off_by_the_error_that_was_asked_for() -> None:
    error = MapError(plan_sigma_m=0.3, height_sigma_m=0.6, correlation_m=200.0, seed=3)
    line = build_alignment(LineSettings(length_m=60_000.0, map_error=error))
    clean = build_alignment(LineSettings(length_m=60_000.0))
    s = line.point_chainage_m()
    np.testing.assert_array_equal(line.at(s[:50]), clean.at(s[:50]), "the truth is the same")
    latitude, longitude, _ = geodetic_from_ecef(clean.at(s))
    off = np.einsum("nij,nj->ni", enu_axes(latitude, longitude), line.track().ecef_m - clean.at(s))
    assert off == pytest.approx(line.map_error_m(s), abs=1e-6)
    # 300 correlation lengths: the sigma is known to some 5 percent.
    assert off.std(axis=0) == pytest.approx([0.3, 0.3, 0.6], rel=0.2)
    even = line.map_error_m(np.arange(0.0, 60_000.0, 10.0))[:, 2]
    assert np.corrcoef(even[20:], even[:-20])[0, 1] == pytest.approx(np.exp(-0.5), abs=0.12)
    assert np.abs(np.diff(even)).max() < 0.15, "smooth"


# ---------------------------------------------------------------- run curves, swaying


def test_a_run_curve_keeps_all_limits_and_stops() -> None:
    line = build_alignment(LineSettings(length_m=6_000.0))
    run = RunSettings(
        cruise_mps=25.0,
        stations=(Station(at_m=50.0), Station(at_m=2_500.0, dwell_s=40.0), Station(at_m=5_900.0, dwell_s=20.0)),
        limits=(SpeedLimit(from_m=1_000.0, to_m=1_200.0, limit_mps=9.0),),
        cant_deficiency_m=0.05,
    )
    scenario = Scenario(duration_s=1500.0, line=LineSettings(length_m=6_000.0), run=run)
    motion = build_motion(line, scenario)
    time = np.arange(0.0, 1500.0, 0.05)
    chainage, speed = motion.at(time)
    assert chainage.min() == pytest.approx(50.0)
    assert chainage.max() == pytest.approx(5_900.0)
    assert np.diff(chainage) == pytest.approx((speed[1:] + speed[:-1]) / 2.0 * 0.05, abs=3e-3)
    assert np.abs(np.diff(speed)).max() <= 0.8 * 0.05 + 1e-9
    assert np.abs(speed[(chainage > 1_000.0) & (chainage < 1_200.0)]).max() <= 9.0 + 1e-9
    # In every curve: the equilibrium cant of the speed is within the deficiency over the cant there is.
    needed = speed**2 * np.abs(line.curvature_at(chainage)) / 9.80665 * (1.067 + 0.070)
    assert (needed - np.abs(line.lean_at(chainage))).max() <= 0.05 + 1e-6
    # Curves of 160 m with 90 mm: v^2 = g R 0.14 / 1.137; it is reached.
    slow = np.sqrt(9.80665 * 160.0 * 0.14 / 1.137)
    inside = np.abs(line.curvature_at(chainage)) > 1.0 / 160.1
    assert np.abs(speed[inside & (speed != 0.0)]).max() == pytest.approx(slow, rel=1e-6)
    standing = (speed == 0.0) & (np.abs(chainage - 2_500.0) < 1e-6)
    first_way = time < time[np.argmax(chainage > 5_899.9)]
    assert (standing & first_way).sum() * 0.05 == pytest.approx(40.0, abs=0.11)
    acceleration = motion.acceleration_at(time)
    assert np.median(np.abs(np.diff(speed) / 0.05 - acceleration[:-1])) < 1e-9


def test_a_run_the_other_way_is_its_mirror_and_ends_standing() -> None:
    line = build_alignment(LineSettings())
    up, down = (
        build_motion(line, Scenario(run=RunSettings(direction=way, at_end="stand", acceleration_mps2=0.8)))  # type: ignore[arg-type]
        for way in ("rising", "falling")
    )
    time = np.arange(0.0, 300.0, 0.1)
    (there, fast), (back, slow) = up.at(time), down.at(time)
    assert there + back == pytest.approx(756.0, abs=1e-6)
    assert fast == pytest.approx(-slow, abs=1e-9)
    assert there[-1] == pytest.approx(736.0)
    assert (fast[time > 100.0] == 0.0).all()
    # The same as the shuttle, which knows no limits but its own, but for the 2 m in which the top speed is reached.
    plain = shuttle(20.0, 736.0, 80.0, RunSettings(acceleration_mps2=0.8)).at(time[:700])[0]
    assert plain == pytest.approx(there[:700], abs=0.01)


def test_the_body_sways_with_its_sigma_and_not_at_rest() -> None:
    scenario = Scenario(vehicle=VehicleSettings(sway_sigma_deg=0.5, sway_period_s=1.5))
    sway = BodyMotion(scenario, build_motion(LINE, scenario))
    time = np.arange(0.0, 600.0, 0.1)
    roll = sway.roll_rad(time, np.full(time.shape, 30.0))
    assert np.degrees(roll.std()) == pytest.approx(0.5, rel=0.15)
    crossings = (np.diff(np.sign(roll)) != 0).sum()
    assert 2.0 * 600.0 / crossings == pytest.approx(1.5, rel=0.1)
    assert (sway.roll_rad(time, np.zeros(time.shape)) == 0.0).all()
    middle = np.full(len(time), 45.0)
    still, swaying = (antenna_truth(LINE, scenario.vehicle, scenario.vehicle.front, middle, r) for r in (0.0, roll))
    # 3.95 m over the rails turn by the roll; the way the antennas are apart stays.
    assert np.linalg.norm(swaying.ecef_m - still.ecef_m, axis=1) == pytest.approx(
        np.abs(roll) * np.hypot(3.95, 0.25), rel=1e-3, abs=1e-5
    )
    rear = antenna_truth(LINE, scenario.vehicle, scenario.vehicle.rear, middle, roll)
    assert np.linalg.norm(swaying.ecef_m - rear.ecef_m, axis=1) == pytest.approx(18.2, abs=1e-6)


def test_pitch_follows_the_acceleration_and_moves_the_antennas() -> None:
    """Once the oscillation has decayed, the pitch under a constant acceleration is the gain times it."""
    vehicle = VehicleSettings(pitch_deg_per_mps2=0.6, pitch_period_s=0.8)
    scenario = Scenario(
        vehicle=vehicle, run=RunSettings(first_stand_s=5.0, acceleration_mps2=0.5, deceleration_mps2=1.0)
    )
    body = BodyMotion(scenario, motion := build_motion(LINE, scenario))
    time = np.arange(0.0, 120.0, 0.02)
    chainage, speed = motion.at(time)
    pitch = body.pitch_rad(time, speed)
    assert pitch is not None
    acceleration = motion.acceleration_at(time)
    settled = np.array([np.ptp(acceleration[max(k - 200, 0) : k + 1]) == 0.0 for k in range(len(time))])
    assert len(set(acceleration[settled])) >= 3
    assert np.degrees(pitch[settled]) == pytest.approx(0.6 * acceleration[settled], abs=0.6 * 2e-3)
    assert np.degrees(pitch).max() > 0.6 * 0.5 * 1.2, "it overshoots"
    level, pitched = (antenna_truth(LINE, vehicle, vehicle.front, chainage, 0.0, p) for p in (None, pitch))
    moved = np.linalg.norm(pitched.ecef_m - level.ecef_m, axis=1)
    assert moved == pytest.approx(2.0 * np.abs(np.sin(pitch / 2.0)) * np.hypot(9.1, 3.95), abs=1e-4)
    # The front rises by the lever arm, the antenna moves back by its height.
    up = geodetic_from_ecef(pitched.ecef_m)[2] - geodetic_from_ecef(level.ecef_m)[2]
    assert up == pytest.approx(9.1 * np.sin(pitch), abs=2e-3)
    assert pitched.chainage_m - level.chainage_m == pytest.approx(-3.95 * np.sin(pitch), abs=2e-3)


def test_random_pitch_has_its_sigma_and_none_at_rest() -> None:
    scenario = Scenario(vehicle=VehicleSettings(pitch_sigma_deg=0.2, pitch_period_s=0.9))
    body = BodyMotion(scenario, build_motion(LINE, scenario))
    time = np.arange(0.0, 900.0, 0.1)
    pitch = body.pitch_rad(time, np.full(time.shape, 25.0))
    assert pitch is not None
    assert np.degrees(pitch.std()) == pytest.approx(0.2, rel=0.15)
    standing = body.pitch_rad(time, np.zeros(time.shape))
    assert standing is not None
    assert (standing == 0.0).all()
    assert BodyMotion(Scenario(), build_motion(LINE, Scenario())).pitch_rad(time, time) is None


@pytest.mark.parametrize("jerk", [0.1, 0.4, 2.0])
@pytest.mark.every(5)
def test_the_jerk_stays_within_its_limit_and_the_stops_where_they_are(jerk: float) -> None:
    settings = RunSettings(stations=(Station(at_m=30.0), Station(at_m=400.0), Station(at_m=720.0)), stand_s=25.0)
    plain = run_curve(LINE, settings, 100.0, contact_m=1.137)
    smooth = limit_jerk(plain, jerk)
    assert np.abs(smooth.jerk_mps3).max() == pytest.approx(jerk, rel=1e-6), "as fast as the limit allows"
    time = np.arange(0.0, 400.0, 0.01)
    chainage, speed = smooth.at(time)
    # Independent: third differences of the chainage; it and its derivatives are continuous.
    third = np.diff(chainage[::10], 3) / 0.1**3
    assert np.abs(third).max() < jerk * 1.01 + 1e-3
    assert np.abs(np.diff(speed)).max() < 0.8 * 0.01 * 1.001, "never faster than the plain motion's acceleration"
    assert np.diff(chainage) == pytest.approx((speed[1:] + speed[:-1]) / 2.0 * 0.01, abs=1e-6)
    assert np.diff(speed) == pytest.approx(
        (smooth.acceleration_at(time)[1:] + smooth.acceleration_at(time)[:-1]) / 2.0 * 0.01, abs=jerk * 1e-4
    )
    assert np.abs(speed).max() <= np.abs(plain.at(time)[1]).max() + 1e-9
    standing = chainage[speed == 0.0]
    assert set(np.round(standing, 6)) == {30.0, 400.0, 720.0}
