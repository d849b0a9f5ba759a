"""Multipath features of cities, each alone against a closed form or an explicit path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railfix.core.arrays import Floats
from railfix.gnss import concatenate
from railfix.simulate import ReceiverSettings, Scenario, Simulation, SkySettings
from railfix.simulate.environment import Environment, EnvironmentSettings
from railfix.simulate.environment.correlator import circular_reflection, reflection_amplitude
from railfix.simulate.environment.settings import (
    AntennaSettings,
    NeighbourSettings,
    RoofEquipment,
    SideStreetSettings,
    TreeSettings,
)
from railfix.simulate.environment.structures import build_structures, tree_rows
from railfix.simulate.environment.walls import (
    Rays,
    SideStreets,
    equipment_amplitude,
    foliage,
    neighbour_clearance,
    neighbour_reflection,
    second_reflection,
    street_reflections,
)
from railfix.simulate.receiver import CodeSmoothing, TrackingNoise
from railfix.simulate.scenario_file import load_scenario
from railfix.simulate.settings import TrackingSettings
from test_simulate_environment import LINE_M, WAVE, rays, section, seen, wall
from test_simulate_signals import whole

pytestmark = pytest.mark.requirement("D4")


def direction(ray: Rays) -> Floats:
    return np.array([ray.x[0], ray.y[0], ray.z[0]])


# Polarisation -----------------------------------------------------------------------------------------------------


def test_a_wall_turns_the_polarisation_at_normal_incidence_and_keeps_it_at_grazing() -> None:
    """sqrt(e) = 3: reflection (3 - 1) / (3 + 1) = 0.5, all left-handed; at grazing 1, all right-handed."""
    right, left = circular_reflection(np.array([1.0, 1e-9]), 9.0)
    assert right == pytest.approx([0.0, 1.0], abs=1e-6)
    assert left == pytest.approx([0.5, 0.0], abs=1e-6)
    # At Brewster's angle, tan = 3, the parallel part vanishes: both polarisations are alike, half of G_perp = 0.8.
    right, left = circular_reflection(np.array([1.0 / np.sqrt(10.0)]), 9.0)
    assert right == pytest.approx([0.4])
    assert left == pytest.approx([0.4])


def test_the_antenna_weakens_the_left_handed_part_more_the_higher_it_is() -> None:
    antenna = AntennaSettings(cross_polar_zenith_db=20.0, cross_polar_horizon_db=6.0, wall_permittivity=9.0)
    at = reflection_amplitude(np.array([1.0, 1.0, 1.0]), np.array([0.0, 0.5, 1.0]), antenna)
    assert 20.0 * np.log10(at / 0.5) == pytest.approx([-6.0, -13.0, -20.0])


def test_the_gain_ripple_is_in_cn0_alone_and_differs_between_the_antennas() -> None:
    # An environment with nothing in it but a section of open country.
    open_country = section().model_copy(update={"kind": "open"})
    settings = EnvironmentSettings(
        sections=(open_country,), ground_reflection=0.0, antenna=AntennaSettings(ripple_sigma_db=2.0)
    )
    place = Environment(settings, line_length_m=LINE_M, seed=3)
    azimuth = np.arange(0.0, 360.0, 2.0)
    geometry = seen(500.0, [20.0] * len(azimuth), azimuth.tolist())
    got = place(geometry)
    assert np.abs(got.code_m).max() < 1e-3
    assert got.cn0_db.std() == pytest.approx(2.0 * np.cos(np.radians(20.0)), rel=0.1)
    high = place(seen(500.0, [80.0] * len(azimuth), azimuth.tolist()))
    assert high.cn0_db.std() == pytest.approx(2.0 * np.cos(np.radians(80.0)), rel=0.1)


# Paths ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("relative_deg", "ahead"), [(150.0, 1.0), (30.0, -1.0)])
def test_a_side_street_reflects_along_the_line(relative_deg: float, ahead: float) -> None:
    """Against the satellite mirrored in the wall's plane, at 20 000 km."""
    ray = rays(500.0, 20.0, relative_deg)
    distance = 60.0
    # The ray meets the wall so far to the side: the street's mouth is 5 m nearer than that.
    aside = distance * abs(ray.y[0] / ray.x[0])
    edge = 500.0 + ahead * distance
    edges = (edge - 20.0, edge) if ahead > 0.0 else (edge, edge + 20.0)
    one = {"front_m": aside - 5.0, "depth_m": 40.0, "height_m": 80.0, "opposite_m": 20.0, "reflection": 0.7}
    columns = {name: np.array([value]) for name, value in one.items()}
    street = SideStreets(start_m=np.array([edges[0]]), end_m=np.array([edges[1]]), **columns)
    none = SideStreets(**{name: np.empty(0) for name in SideStreets.__dataclass_fields__})
    ((amplitude, extra, growth, cosine),) = street_reflections((none, street), ray, candidates=1, roughness_m=0.0)
    u = direction(ray)
    mirrored = 2e7 * u * [-1.0, 1.0, 1.0] + [2.0 * ahead * distance, 0.0, 0.0]
    assert extra[0] == pytest.approx(np.linalg.norm(mirrored) - 2e7, abs=2e-3)
    one_metre_on = np.linalg.norm(mirrored - [1.0, 0.0, 0.0]) - np.linalg.norm(2e7 * u - [1.0, 0.0, 0.0])
    assert growth[0] == pytest.approx(one_metre_on - extra[0], abs=1e-3)
    assert cosine[0] == pytest.approx(abs(u[0]))
    assert amplitude[0] == pytest.approx(0.7, rel=0.1)
    beyond, hidden = replace(street, front_m=columns["front_m"] + 30.0), replace(street, opposite_m=np.array([80.0]))
    for other in (beyond, hidden):
        assert street_reflections((none, other), ray, candidates=1, roughness_m=0.0)[0][0][0] < 0.05
    assert street_reflections((street, none), ray, candidates=1, roughness_m=0.0)[0][0][0] == 0.0, "the other side"


def test_a_second_reflection_has_the_length_of_its_broken_line() -> None:
    """Satellite on the left at 20 deg between walls 9 m off on both sides, 14 m high: explicit points."""
    both = build_structures((section(wall("both", 9.0, 14.0)),), LINE_M, 1)
    ray = rays(500.0, 20.0, -70.0)
    amplitude, extra, growth = second_reflection(both.walls, ray, None)
    u = direction(ray)
    # Back along the ray: antenna, left wall at y = -9, right wall at y = +9, and out.
    t = 9.0 / abs(u[1])
    first = np.array([u[0] * t, -9.0, u[2] * t])
    second = first + 2.0 * t * np.array([u[0], abs(u[1]), u[2]])
    way = np.linalg.norm(first) + np.linalg.norm(second - first)
    # A plane wave reaches `second` later than the antenna by its part along the direction to the satellite.
    assert extra[0] == pytest.approx(way - second @ u, abs=1e-9)
    assert growth[0] == pytest.approx(0.0)
    # Antenna 4 m high: both walls are met 7.5 and 14.5 m up, so half of the amplitude is left at the second one's top.
    assert 0.2 * 0.8**2 < amplitude[0] < 0.8**2


def test_walls_too_low_or_a_satellite_too_high_give_no_second_reflection() -> None:
    both = build_structures((section(wall("both", 9.0, 14.0)),), LINE_M, 1)
    assert second_reflection(both.walls, rays(500.0, 70.0, -80.0), None)[0][0] < 0.02
    low = build_structures((section(wall("both", 9.0, 5.0)),), LINE_M, 1)
    assert second_reflection(low.walls, rays(500.0, 30.0, -80.0), None)[0][0] < 0.1


# Trees ------------------------------------------------------------------------------------------------------------


def test_a_crown_takes_its_attenuation_times_its_width() -> None:
    tree = TreeSettings(
        sides="right", distance_m=(8.0, 8.0), height_m=(14.0, 14.0), crown_m=(3.0, 3.0), length_m=(6.0, 6.0),
        gap_m=(0.0, 0.0), attenuation_db_per_m=1.2, most_db=30.0, scatter=0.5,
    )  # fmt: skip
    (row,) = tree_rows((tree,), LINE_M, 1)
    # Square to the line at 20 deg: the crown is met 2.9 m over the antenna, in the middle; 6 m / cos 20 of it.
    middle = 0.5 * (row.start_m[-2] + row.end_m[-2])
    left, scatter, extra = foliage(row, rays(middle, 20.0, 90.0))
    assert 20.0 * np.log10(left[0]) == pytest.approx(-1.2 * 6.0 / np.cos(np.radians(20.0)))
    assert scatter[0] == pytest.approx(0.5 * (1.0 - left[0]))
    assert 2.0 < extra[0] < 7.0
    assert foliage(row, rays(middle, 60.0, 90.0))[0][0] == 1.0, "over the crown"
    assert foliage(row, rays(middle, 20.0, -90.0))[0][0] == 1.0, "on the other side"
    (thick,) = tree_rows((tree.replaced(most_db=5.0),), LINE_M, 1)
    assert 20.0 * np.log10(foliage(thick, rays(middle, 20.0, 90.0))[0][0]) == pytest.approx(-5.0)
    (none,) = tree_rows((tree.replaced(share=0.0),), LINE_M, 1)
    assert foliage(none, rays(middle, 20.0, 90.0))[0][0] == 1.0


# Vehicles ---------------------------------------------------------------------------------------------------------


def test_neighbours_pass_with_their_speed_and_headway() -> None:
    """Trains of 100 m every 1000 m at 20 m/s: in the way a tenth of the time, again after 50 s."""
    train = NeighbourSettings(lateral_m=2.5, height_m=6.0, length_m=100.0, spacing_m=1000.0, speed_mps=20.0)
    time = np.arange(0.0, 500.0, 0.1)
    n = len(time)
    ray = rays(300.0, 10.0, 90.0)
    many = Rays(
        chainage_m=np.full(n, 300.0), height_m=4.0, x=np.full(n, ray.x[0]), y=np.full(n, ray.y[0]),
        z=np.full(n, ray.z[0]), wavelength_m=np.full(n, WAVE),
    )  # fmt: skip
    v = neighbour_clearance(train, many, time)
    assert (v > 0.0).mean() == pytest.approx(0.1, abs=0.003)
    np.testing.assert_allclose(v[:-500], v[500:], atol=1e-6)
    # At 20 m/s toward rising chainage: a second later it is the same 20 m further on.
    further = neighbour_clearance(train, replace(many, chainage_m=np.full(n, 320.0)), time + 1.0)
    np.testing.assert_allclose(further, v, atol=1e-6)
    # 2.5 m off, 2 m over the antenna: hides up to atan(2 / 2.5) = 38.7 deg; left of the train nothing.
    inside = float(time[np.argmax(v)])
    for elevation, hidden in ((37.0, True), (41.0, False)):
        there = neighbour_clearance(train, rays(300.0, elevation, 90.0), np.array([inside]))[0]
        assert (there > 0.0) == hidden
    assert neighbour_clearance(train, rays(300.0, 10.0, -90.0), np.array([inside]))[0] == -99.0
    # A satellite on the left is mirrored in its side: 2 * 2.5 m * cos(10 deg) further, when a train is there.
    amplitude, extra, _ = neighbour_reflection(train, rays(300.0, 10.0, -90.0), np.array([inside]))
    assert amplitude[0] == pytest.approx(train.reflection, rel=1e-6)
    assert extra[0] == pytest.approx(5.0 * np.cos(np.radians(10.0)))
    away = neighbour_reflection(train, rays(300.0, 10.0, -90.0), np.array([inside + 25.0]))
    assert away[0][0] < 0.01


def test_equipment_on_the_roof_hides_low_satellites_ahead() -> None:
    box = (RoofEquipment(ahead_m=1.5, above_antenna_m=0.6, half_width_m=0.8),)
    # Its edge stands at atan(0.6 / 1.5) = 21.8 deg, there half of the amplitude is left (6 dB).
    assert equipment_amplitude(box, rays(0.0, 21.8, 0.0))[0] == pytest.approx(0.5, abs=0.02)
    assert equipment_amplitude(box, rays(0.0, 5.0, 0.0))[0] < 0.35
    assert equipment_amplitude(box, rays(0.0, 60.0, 0.0))[0] == 1.0
    assert equipment_amplitude(box, rays(0.0, 5.0, 180.0))[0] == 1.0, "behind"
    assert equipment_amplitude(box, rays(0.0, 5.0, 60.0))[0] == 1.0, "beside"


# Receiver ---------------------------------------------------------------------------------------------------------


def test_code_smoothing_is_its_recursion_by_any_cutting() -> None:
    rng = np.random.default_rng(5)
    error, lost = rng.normal(size=(300, 4)), rng.uniform(size=(300, 4)) < 0.05
    lost[100:140, 2] = True
    expected = error.copy()
    keep = np.exp(-0.5 / 4.0)
    for channel in range(4):
        for k in range(1, 300):
            if not lost[k, channel] and not lost[k - 1, channel]:
                expected[k, channel] = keep * expected[k - 1, channel] + (1.0 - keep) * error[k, channel]
    for size in (300, 1, 7, 64):
        smoothing = CodeSmoothing(4.0, channels=4, interval_s=0.5)
        parts = [smoothing.next(error[k : k + size], lost[k : k + size]) for k in range(0, 300, size)]
        np.testing.assert_allclose(np.concatenate(parts)[~lost], expected[~lost], atol=1e-12)


def test_a_weak_signal_is_tracked_again_only_from_the_higher_threshold() -> None:
    cn0 = np.array([[20.0], [11.0], [9.0], [12.0], [14.9], [15.0], [11.0], [10.0], [9.9], [30.0], [9.0]])
    expected = [False, False, True, True, True, False, False, False, True, False, True]
    settings = TrackingSettings(threshold_dbhz=10.0, reacquisition_dbhz=15.0)
    for size in (11, 1, 3):
        tracking = TrackingNoise(settings, key=(1,), channels=1, interval_s=1.0)
        weak = np.concatenate([tracking.too_weak(cn0[k : k + size]) for k in range(0, 11, size)])
        assert weak[:, 0].tolist() == expected


def test_clear_cn0_is_that_of_the_settings_and_satellites_differ_by_their_sigma() -> None:
    receiver = ReceiverSettings(cn0_horizon_dbhz=30.0, cn0_rise_db=10.0, cn0_sigma_dbhz=0.0)
    sky = SkySettings(systems="GJEC")
    piece = whole(Scenario(duration_s=5.0, rate_hz=1.0, receiver=receiver, sky=sky))
    there = np.isfinite(piece.observations.cn0_dbhz)
    clear = 30.0 + 10.0 * np.sin(np.radians(piece.geometry.elevation_deg))
    assert np.abs(piece.observations.cn0_dbhz - clear)[there].max() <= 0.125
    spread = whole(
        Scenario(duration_s=5.0, rate_hz=1.0, receiver=receiver.replaced(cn0_satellite_sigma_db=2.0), sky=sky)
    )
    offset = (spread.observations.cn0_dbhz - clear)[2]
    assert np.nanstd(offset) == pytest.approx(2.0, rel=0.3)


# The shipped scenario ---------------------------------------------------------------------------------------------


def test_the_city_is_cut_anyhow() -> None:
    scenario = load_scenario("city").replaced(duration_s=90.0)
    simulation = Simulation(scenario)
    expected = whole(scenario).observations
    joined = concatenate([p.observations for p in simulation.pieces("front", chunk_epochs=13)])
    for name in ("code_m", "phase_cycles", "doppler_hz", "cn0_dbhz", "loss_of_lock"):
        np.testing.assert_array_equal(getattr(joined, name), getattr(expected, name))


@pytest.mark.parametrize(
    "part",
    [
        {"side_streets": SideStreetSettings()},
        {"trees": (TreeSettings(),)},
        {"neighbours": (NeighbourSettings(spacing_m=150.0, height_m=5.0),)},
        {"equipment": (RoofEquipment(ahead_m=1.0, above_antenna_m=0.5),)},
    ],
    ids=lambda part: next(iter(part)),
)
def test_each_part_alone_disturbs_signals(part: dict[str, object]) -> None:
    settings = EnvironmentSettings(ground_reflection=0.0, **part)  # type: ignore[arg-type]
    assert not settings.empty
    azimuth = np.arange(0.0, 360.0, 5.0)
    got = Environment(settings, line_length_m=LINE_M, seed=2)(
        seen(np.arange(300.0, 400.0, 5.0), [12.0] * len(azimuth), azimuth.tolist())
    )
    assert got.cn0_db.min() < -2.0
    assert EnvironmentSettings().empty
