"""The antenna's path against an independent rigid-body computation, and the vehicle file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_simpson
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError, MismatchError, RailfixError, SettingsError
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.track import Provenance, Track
from railfix.track.map_from_positions import ANTENNA_PATH
from railfix.track.trajectory import Trajectory
from railfix.track.vehicle import (
    PATH_TOLERANCE_M,
    AntennaOffset,
    Vehicle,
    _pose,
    _VehicleLine,
    antenna_trajectory,
    read_vehicle,
)

ORIGIN = (34.7, 135.5, 80.0)
OFFSET = AntennaOffset(along_m=9.1, across_m=0.35, up_m=4.1)


def vehicle(**changes: object) -> Vehicle:
    values: dict[str, object] = {"bogie_distance_m": 13.8, "antennas": {"front": OFFSET}}
    return Vehicle.model_validate(values | changes)


def to_ecef(enu_m: Floats) -> Floats:
    return ecef_from_geodetic(*ORIGIN) + enu_m @ enu_axes(*ORIGIN[:2])


def to_enu(ecef_m: Floats) -> Floats:
    return (ecef_m - ecef_from_geodetic(*ORIGIN)) @ enu_axes(*ORIGIN[:2]).T


@dataclass(frozen=True)
class Line:
    """A line as a formula: straight, clothoid, arc, clothoid, straight, each by its length in plan.

    Curvature to the left and cant are piecewise linear in the length in plan, height a parabola.
    """

    curvature: float
    cant: float
    gradient: float = 0.0
    vertical_radius: float = 4000.0
    breaks: tuple[float, ...] = (0.0, 60.0, 110.0, 170.0, 220.0, 280.0)
    shares: tuple[float, ...] = (0.0, 0.0, 1.0, 1.0, 0.0, 0.0)

    def share(self, s: Floats) -> Floats:
        return np.interp(s, self.breaks, self.shares)

    @cached_property
    def _plan(self) -> tuple[Floats, Floats, Floats]:
        s = np.linspace(0.0, self.breaks[-1], 28_001)
        heading = 0.7 + cumulative_simpson(self.curvature * self.share(s), x=s, initial=0.0)
        return (
            s,
            cumulative_simpson(np.cos(heading), x=s, initial=0.0),
            cumulative_simpson(np.sin(heading), x=s, initial=0.0),
        )

    def sampled(self, s: Floats) -> Floats:
        """Points of the line at lengths in plan, east north up."""
        grid, east, north = self._plan
        up = self.gradient * s + (s - 140.0) ** 2 / (2.0 * self.vertical_radius)
        return np.stack([np.interp(s, grid, east), np.interp(s, grid, north), up], axis=-1)

    def track(self, spacing: float = 2.5) -> Track:
        pieces = [
            np.arange(a, b - 1e-9, 15.0 if i in (0, 4) else spacing)
            for i, (a, b) in enumerate(zip(self.breaks[:-1], self.breaks[1:], strict=True))
        ]
        s = np.append(np.concatenate(pieces), self.breaks[-1])
        curvature = self.curvature * self.share(s)
        with np.errstate(divide="ignore"):
            radius = np.where(curvature == 0.0, np.inf, -1.0 / curvature)  # right is positive
        return Track.from_ecef(to_ecef(self.sampled(s)), cant_m=self.cant * np.abs(self.share(s)), radius_m=radius)


def rigid_body(line: Line, car: Vehicle, offset: AntennaOffset, middle: float) -> Floats:
    """Antenna by root finding on the formula and rotation matrices: x forward, y left, z up."""

    def chord(half: float) -> float:
        ends = line.sampled(np.array([middle - half, middle + half]))
        return float(np.linalg.norm(ends[1] - ends[0])) - car.bogie_distance_m

    half = brentq(chord, 0.4 * car.bogie_distance_m, 0.7 * car.bogie_distance_m, xtol=1e-10)
    places = np.array([middle - half, middle + half])
    rear, front = line.sampled(places)
    step = front - rear
    lean = np.mean(np.arcsin(line.cant * line.share(places) / (car.gauge_m + 0.07)))
    rotation = Rotation.from_euler(
        "ZYX",
        [
            np.arctan2(step[1], step[0]),
            -np.arctan2(step[2], np.hypot(step[0], step[1])),
            -np.sign(line.curvature) * lean,  # to the left in a left curve
        ],
    )
    return np.asarray((rear + front) / 2.0 + rotation.apply([offset.along_m, -offset.across_m, offset.up_m]))


#: A curve of 300 m with ramps of 60 m, and a reverse curve whose ramp goes from one side to the other.
CURVES = {
    "ramps": Line(curvature=1 / 300.0, cant=0.12, breaks=(0.0, 87.0, 147.0, 230.0, 290.0, 400.0)),
    "reverse": Line(
        curvature=-1 / 300.0, cant=0.12, breaks=(0.0, 80.0, 140.0, 210.0, 330.0, 410.0, 470.0, 560.0),
        shares=(0.0, 0.0, 1.0, 1.0, -1.0, -1.0, 0.0, 0.0),
    ),
}  # fmt: skip


@pytest.mark.requirement("A2")
@pytest.mark.parametrize("name", CURVES)
@pytest.mark.parametrize(("spacing_m", "radii"), [(20.0, "of the map"), (10.0, "of the map"), (5.0, "none")])
@pytest.mark.parametrize("start_m", [0.0, 3.0, 7.0])
def test_the_path_follows_the_curve_between_sparse_points(
    name: str, spacing_m: float, radii: str, start_m: float
) -> None:
    """Within 1 cm with points every 20 m where the map has radii and cant, every 5 m where it has no radii."""
    line, car = CURVES[name], vehicle()
    s = np.arange(start_m, line.breaks[-1], spacing_m)
    with np.errstate(divide="ignore"):
        radius = -1.0 / (line.curvature * line.share(s))
    track = Track.from_ecef(
        to_ecef(line.sampled(s)),
        cant_m=line.cant * np.abs(line.share(s)),
        radius_m=radius if radii == "of the map" else np.full(len(s), np.nan),
    )
    path = antenna_trajectory(track, car, reference="centre")
    grid = np.arange(s[0] + 10.0, s[-1] - 10.0, 0.5)
    expected = np.array([rigid_body(line, car, OFFSET, middle) for middle in grid])
    _, _, apart = path._nearest(to_ecef(expected))
    assert apart.max() < 0.01


@pytest.mark.requirement("A2")
@pytest.mark.parametrize("side", [1.0, -1.0], ids=["left", "right"])
@pytest.mark.parametrize("gradient", [0.0, 0.03, -0.03])
@pytest.mark.parametrize("along", [9.1, -9.1, 0.0])
def test_path_is_within_a_centimetre_of_a_rigid_body(side: float, gradient: float, along: float) -> None:
    line = Line(curvature=side / 160.0, cant=0.09, gradient=gradient)
    offset = AntennaOffset(along_m=along, across_m=0.35, up_m=4.1)
    car = vehicle(antennas={"front": offset})
    track = line.track()
    path = antenna_trajectory(track, car, reference="centre")
    # chainage of the polyline to length in plan, through the points that both have
    nodes = to_enu(track.ecef_m)
    plan = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(nodes[:, :2], axis=0).T))])
    truth_plan = np.interp(path.chainage_m, track.chainage_m, _plan_lengths(line, nodes, plan))
    expected = np.array([rigid_body(line, car, offset, s) for s in truth_plan])
    error = np.linalg.norm(to_enu(path.ecef_m) - expected, axis=1)
    assert error.max() < 0.01
    assert len(path) > 60


def _plan_lengths(line: Line, nodes: Floats, guess: Floats) -> Floats:
    """Length in plan of the line's points: chords are shorter than the arc."""
    grid, east, north = line._plan
    index = np.searchsorted(grid, guess)
    window = np.arange(-60, 61)
    candidates = np.clip(index[:, None] + window, 0, len(grid) - 1)
    distance = np.hypot(east[candidates] - nodes[:, :1], north[candidates] - nodes[:, 1:2])
    return grid[candidates[np.arange(len(nodes)), np.argmin(distance, axis=1)]]


@pytest.mark.requirement("A2")
def test_straight_level_line_puts_the_antenna_at_its_offsets() -> None:
    s = np.arange(0.0, 201.0, 20.0)
    track = Track.from_ecef(to_ecef(np.stack([0 * s, s, 0 * s], axis=1)), cant_m=0 * s)
    path = antenna_trajectory(track, vehicle())
    enu = to_enu(path.ecef_m)
    np.testing.assert_allclose(enu[:, 0], 0.35, atol=1e-3)  # right of north is east
    np.testing.assert_allclose(enu[:, 2], 4.1, atol=1e-3)
    np.testing.assert_allclose(enu[:, 1], path.chainage_m, atol=1e-3)  # abeam
    np.testing.assert_allclose(enu[[0, -1], 1], [6.9 + 9.1, 200.0 - 6.9 + 9.1], atol=1e-3)
    assert len(path) == len(track), "a straight line needs no more points than the map has"


@pytest.mark.requirement("A2")
@pytest.mark.parametrize("side", [1.0, -1.0], ids=["right", "left"])
def test_canted_circle_in_closed_form(side: float) -> None:
    radius, cant, car = 200.0, 0.10, vehicle(antennas={"front": AntennaOffset(along_m=0.0, up_m=4.0)})
    angle = np.arange(0.0, 1.0, 1.0 / radius)
    enu = np.stack([side * radius * (1.0 - np.cos(angle)), radius * np.sin(angle), 0 * angle], axis=1)
    path = antenna_trajectory(
        Track.from_ecef(to_ecef(enu), cant_m=0 * angle + cant, radius_m=0 * angle + side * radius), car
    )
    found = to_enu(path.ecef_m)
    roll = np.arcsin(cant / (1.067 + 0.070))
    inward = radius - np.sqrt(radius**2 - 6.9**2) + 4.0 * np.sin(roll)
    np.testing.assert_allclose(np.hypot(found[:, 0] - side * radius, found[:, 1]), radius - inward, atol=2e-3)
    np.testing.assert_allclose(found[:, 2], 4.0 * np.cos(roll), atol=2e-3)
    np.testing.assert_allclose(path.roll_deg, side * np.degrees(roll), atol=1e-9)


@pytest.mark.requirement("A2")
def test_the_roll_of_a_closed_line_goes_on_beyond_its_ends() -> None:
    """A ring of 600 m whose cant rises to its end: beyond an end it is that of the other one."""
    radius, count = 600.0 / (2.0 * np.pi), 240
    angle = 2.0 * np.pi * np.arange(count + 1) / count
    enu = np.stack([radius * (1.0 - np.cos(angle)), radius * np.sin(angle), 0 * angle], axis=1)
    cant = 0.05 + 0.05 * np.sin(0.5 * angle) ** 2 + 0.02 * np.sin(angle)
    line = _VehicleLine(Track.from_ecef(to_ecef(enu), cant_m=cant, radius_m=0 * angle + radius), 1.5)
    length = line.chainage[-1]
    assert line.open_ends == (False, False)
    beyond, within = (
        np.array([-40.0, -5.0, length + 5.0, length + 40.0]),
        np.array([length - 40.0, length - 5.0, 5.0, 40.0]),
    )
    np.testing.assert_allclose(line.roll_at(beyond), line.roll_at(within), atol=1e-9)
    assert np.ptp(line.roll_at(within)) > 0.01


def _reversed(track: Track) -> Track:
    return Track.from_ecef(track.ecef_m[::-1], cant_m=track.cant_m[::-1], radius_m=-track.radius_m[::-1])


@settings(deadline=None, max_examples=15)
@given(
    radius=st.floats(90.0, 800.0),
    side=st.sampled_from([1.0, -1.0]),
    cant=st.floats(0.0, 0.15),
    gradient=st.floats(-0.05, 0.05),
    along=st.floats(-10.0, 10.0),
    across=st.floats(-1.0, 1.0),
)
def test_the_path_does_not_depend_on_the_direction_of_the_map(
    radius: float, side: float, cant: float, gradient: float, along: float, across: float
) -> None:
    track = Line(curvature=side / radius, cant=cant, gradient=gradient).track()
    one = vehicle(antennas={"front": AntennaOffset(along_m=along, across_m=across, up_m=4.0)})
    rising = antenna_trajectory(track, one).ecef_m
    backwards = antenna_trajectory(_reversed(track), one.model_copy(update={"facing": "falling"})).ecef_m[::-1]
    mirrored = vehicle(facing="falling", antennas={"front": AntennaOffset(along_m=-along, across_m=-across, up_m=4.0)})
    np.testing.assert_allclose(antenna_trajectory(track, mirrored).ecef_m, rising, atol=1e-9)
    assert backwards.shape == rising.shape
    np.testing.assert_allclose(backwards, rising, atol=2e-6)


@pytest.mark.parametrize("ramp", [5.0, 20.0])
def test_chords_of_the_path_stay_near_the_antenna(ramp: float) -> None:
    """A map with 15 m spacing on the straight before a curve gets points where the path bends."""
    track = Line(curvature=1 / 160.0, cant=0.09, breaks=(0.0, 60.0, 60.0 + ramp, 170.0, 170.0 + ramp, 280.0)).track()
    path = antenna_trajectory(track, vehicle(), reference="centre")
    _, offset = path.nearest(_dense(track))
    assert offset.max() < 1.5 * PATH_TOLERANCE_M
    straight = (path.chainage_m > 30.0) & (path.chainage_m < 60.0)
    assert np.diff(path.chainage_m[straight])[-1] < 8.0, "the front bogie is in the curve already"


def _dense(track: Track) -> Floats:
    """The antenna every half metre, without the path's points."""
    car, middle = vehicle(), np.arange(10.0, track.chainage_m[-1] - 10.0, 0.5)
    pose = _pose(_VehicleLine(track, car.contact_spacing_m), track, car, middle)
    return pose.origin + OFFSET.along_m * pose.forward + OFFSET.across_m * pose.right + OFFSET.up_m * pose.up


@pytest.mark.parametrize("reference", ["antenna", "centre", "front_bogie", "rear_bogie"])
@pytest.mark.parametrize("facing", ["rising", "falling"])
def test_chainage_is_that_of_the_reference_point(reference: str, facing: str) -> None:
    s = np.arange(0.0, 201.0, 20.0)
    track = Track.from_ecef(to_ecef(np.stack([0 * s, s, 0 * s], axis=1)))
    path = antenna_trajectory(track, vehicle(facing=facing), reference=reference)  # type: ignore[arg-type]
    sign = 1.0 if facing == "rising" else -1.0
    ahead = {"antenna": 9.1, "centre": 0.0, "front_bogie": 6.9, "rear_bogie": -6.9}[reference]
    northing = to_enu(path.ecef_m)[:, 1]
    np.testing.assert_allclose(path.chainage_m, northing - sign * (9.1 - ahead), atol=1e-3)
    assert path.reference == reference


def test_what_is_assumed_is_said() -> None:
    curve = Line(curvature=1 / 300.0, cant=0.05).track()
    without = Track.from_ecef(curve.ecef_m)
    assert any("no cant" in note for note in antenna_trajectory(without, vehicle()).notes)
    bend = Track.from_ecef(curve.ecef_m, cant_m=curve.cant_m)
    by_bend, by_radius = antenna_trajectory(bend, vehicle()), antenna_trajectory(curve, vehicle())
    assert any("the side of the cant is taken from the bend" in note for note in by_bend.notes)
    np.testing.assert_allclose(by_bend.ecef_m, by_radius.ecef_m, atol=0.01)
    assert by_radius.notes == ()
    assert isinstance(by_radius, Trajectory)


def _straight(length: float, **attributes: object) -> Track:
    s = np.linspace(0.0, length, 5)
    return Track.from_ecef(to_ecef(np.stack([0 * s, s, 0 * s], axis=1)), **attributes)  # type: ignore[arg-type]


def test_track_and_vehicle_that_do_not_fit() -> None:
    with pytest.raises(MismatchError, match="too short"):
        antenna_trajectory(_straight(10.0), vehicle())
    with pytest.raises(MismatchError, match="no curve"):
        antenna_trajectory(_straight(100.0, cant_m=np.full(5, 0.05), radius_m=np.full(5, np.inf)), vehicle())
    with pytest.raises(MismatchError, match="in mm"):
        antenna_trajectory(_straight(100.0, cant_m=np.full(5, 50.0), radius_m=np.full(5, 300.0)), vehicle())
    with pytest.raises(SettingsError, match="no antenna 'rear'"):
        antenna_trajectory(_straight(100.0), vehicle(), "rear")
    path = Track.from_ecef(_straight(100.0).ecef_m, provenance=Provenance(notes=(ANTENNA_PATH,)))
    with pytest.raises(MismatchError, match="without a vehicle file"):
        antenna_trajectory(path, vehicle())
    hairpin = to_ecef(np.array([[0.0, 0, 0], [0, 100, 0], [0.5, 100, 0], [0.5, 0, 0]]))
    with pytest.raises(MismatchError, match="turns"):
        antenna_trajectory(Track.from_ecef(hairpin), vehicle())


GOOD = """
name = "test car"
bogie_distance_m = 13.8
gauge_m = 1.067
[antennas.front]
along_m = 9.1
up_m = 4.1
[antennas.rear]
along_m = -9.1
across_m = 0.1
up_m = 4.1
"""


def test_vehicle_file(tmp_path: Path) -> None:
    path = tmp_path / "car.toml"
    path.write_text(GOOD, encoding="utf-8")
    car = read_vehicle(path)
    assert car.antennas["rear"] == AntennaOffset(along_m=-9.1, across_m=0.1, up_m=4.1)
    assert car.contact_spacing_m == pytest.approx(1.137)
    assert car.facing == "rising"


@pytest.mark.parametrize(
    ("old", "new", "error", "said"),
    [
        ("bogie_distance_m", "bogie_distanse_m", SettingsError, "did you mean 'bogie_distance_m'"),
        ("bogie_distance_m = 13.8", "", SettingsError, "bogie_distance_m is missing"),
        ("13.8", "-13.8", SettingsError, "bogie_distance_m"),
        ("13.8", "13800", SettingsError, "bogie_distance_m"),
        ("13.8", "'13.8'", SettingsError, "bogie_distance_m"),
        ("13.8", "nan", SettingsError, "bogie_distance_m"),
        ("1.067", "1067", SettingsError, "gauge_m"),
        ("1.067", "'wide'", SettingsError, "gauge_m"),
        ("along_m = 9.1", "along = 9.1", SettingsError, "did you mean 'along_m'"),
        ("up_m = 4.1", "up_m = 4100", SettingsError, "antennas.front.up_m"),
        ("antennas.rear", "antennas.reer", SettingsError, "'front' or 'rear'"),
        ('name = "test car"', 'facing = "north"', SettingsError, "facing"),
        ("[antennas.front]", "[antennas.front", InputFileError, "not valid TOML"),
    ],
)
def test_broken_vehicle_files(tmp_path: Path, old: str, new: str, error: type[RailfixError], said: str) -> None:
    path = tmp_path / "car.toml"
    path.write_text(GOOD.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(error) as caught:
        read_vehicle(path)
    sentence = str(caught.value)
    assert said in sentence
    assert "car.toml" in sentence
    assert "\n" not in sentence


def test_vehicle_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputFileError, match="No such file"):
        read_vehicle(tmp_path / "none.toml")
    with pytest.raises(InputFileError, match="directory"):
        read_vehicle(tmp_path)


def test_a_vehicle_file_with_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "car.toml"
    path.write_text("\ufeffbogie_distance_m = 13.8\n[antennas.front]\nalong_m = 9.1\nup_m = 4.1\n", encoding="utf-8")
    assert read_vehicle(path).antennas["front"].along_m == 9.1


@pytest.mark.requirement("A2")
@pytest.mark.parametrize("facing", ["rising", "falling"])
def test_the_kilometrage_is_that_of_the_lines_point_abeam_the_antenna(facing: str) -> None:
    """A level straight line marked backwards from 12 km: the antenna is 9.1 m ahead of the body's middle."""
    east = np.arange(0.0, 201.0, 5.0)
    line = Track.from_ecef(
        to_ecef(np.stack([east, 0.0 * east, 0.0 * east], axis=1)), kilometrage_m=12_000.0 - 1.01 * east
    )
    found = antenna_trajectory(line, vehicle(facing=facing), "front")
    ahead = 9.1 if facing == "rising" else -9.1
    np.testing.assert_allclose(found.chainage_m, found.body_chainage_m + ahead, atol=0.01)
    inside = (found.chainage_m > 0.0) & (found.chainage_m < 200.0)
    np.testing.assert_allclose(found.kilometrage_m[inside], 12_000.0 - 1.01 * found.chainage_m[inside], atol=0.01)
