"""Sensors on board: what they measure integrates to the motion, and each of their errors comes back alone."""

from __future__ import annotations

import tomllib
from typing import Any

import numpy as np
import polars as pl
import pytest
from pydantic import TypeAdapter
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from railfix.core.errors import SettingsError
from railfix.core.geodesy import enu_axes, geodetic_from_ecef
from railfix.simulate import RunSettings, Scenario, Simulation
from railfix.simulate.body_sensors import gravity_mps2, wheel_slips
from railfix.simulate.sensor_columns import COLUMNS, dropouts, sensor_tables
from railfix.simulate.settings import (
    BaliseSettings,
    DrawnSlips,
    Dropout,
    GroundUnit,
    InertialSettings,
    RadarSettings,
    RangingSettings,
    SensorSettings,
    SlipInterval,
    TachometerSettings,
)

pytestmark = pytest.mark.requirement("D4")

EARTH = np.array([0.0, 0.0, 7.292115e-5])
FORCES = ["force_forward_mps2", "force_right_mps2", "force_down_mps2"]
RATES = ["roll_rate_radps", "pitch_rate_radps", "yaw_rate_radps"]
STANDING = RunSettings(first_stand_s=1e6)


def only(duration_s: float = 100.0, *, run: RunSettings | None = None, **sensors: Any) -> Simulation:
    """A run that carries only the sensors named."""
    settings = SensorSettings(**(dict.fromkeys(("tachometer", "inertial", "radar")) | sensors))
    return Simulation(Scenario(duration_s=duration_s, sensors=settings, run=run or RunSettings()))


def table(simulation: Simulation, name: str) -> pl.DataFrame:
    return sensor_tables(simulation)[name]


def since_start(simulation: Simulation, times: pl.Series) -> np.ndarray:
    return (times.to_numpy() - simulation.scenario.start) / np.timedelta64(1, "ns") * 1e-9


def pulses(settings: TachometerSettings, duration_s: float = 100.0) -> tuple[Simulation, np.ndarray]:
    simulation = only(duration_s, tachometer=settings)
    return simulation, since_start(simulation, table(simulation, "tachometer")["time_gpst"])


def inertial(settings: InertialSettings, duration_s: float = 100.0, run: RunSettings | None = None) -> np.ndarray:
    """The six columns, shape (n, 6)."""
    return table(only(duration_s, inertial=settings, run=run), "inertial").select(FORCES + RATES).to_numpy()


def test_the_tables_have_the_columns_that_are_described() -> None:
    assert sensor_tables(Simulation(Scenario(duration_s=1.0))) == {}
    units = RangingSettings(units=(GroundUnit(name="A", chainage_m=60.0),))
    sensors = SensorSettings(ranging=units, balises=BaliseSettings(spacing_m=50.0))
    made = sensor_tables(Simulation(Scenario(duration_s=30.0, sensors=sensors)))
    assert {name: list(frame.columns) for name, frame in made.items()} == {n: list(c) for n, c in COLUMNS.items()}
    for name in made.keys() - {"ranging_units", "balise_list"}:
        assert made[name]["time_gpst"].dtype == pl.Datetime("ns")
        assert made[name]["time_gpst"].is_sorted()
    again = sensor_tables(Simulation(Scenario(duration_s=30.0, sensors=sensors)))
    assert all(made[name].equals(again[name]) for name in made)


def test_pulses_times_circumference_are_the_distance() -> None:
    """Both ways of a shuttle, a nanosecond exact; 60 pulses a turn of 0.86 m."""
    simulation, time = pulses(TachometerSettings(), 200.0)
    apart = np.pi * 0.86 / 60.0
    fine = np.arange(0.0, 200.0005, 0.001)
    way = np.abs(np.diff(simulation.motion.at(fine)[0])).sum()
    assert way > 1000.0
    assert len(time) == pytest.approx(way / apart, abs=1.0)
    chainage, speed = simulation.motion.at(time)
    same_way = np.sign(speed[1:]) == np.sign(speed[:-1])
    assert np.abs(np.diff(chainage))[same_way] == pytest.approx(apart, abs=1e-6)
    # The speed from the interval of pulses (P2, 2.2) is the mean speed between them; the corners of the motion aside.
    running = np.abs(speed[1:]) > 1.0
    measured = apart / np.diff(time)
    assert measured[running & same_way] == pytest.approx(
        np.abs(speed[1:] + speed[:-1])[running & same_way] / 2.0, abs=5e-4
    )
    direction = table(simulation, "tachometer")["direction"].to_numpy()
    assert set(direction) == {-1, 1}
    assert (direction == np.sign(speed)).all()


def test_a_larger_wheel_makes_fewer_pulses() -> None:
    counts = [len(pulses(TachometerSettings(diameter_error_m=e), 200.0)[1]) for e in (0.0, 0.043)]
    assert counts[1] == pytest.approx(counts[0] / 1.05, abs=1.0)


@pytest.mark.parametrize("ratio", [-1.0, -0.4, 0.5])
def test_slips_and_slides_take_the_pulses_that_they_say(ratio: float) -> None:
    slip = SlipInterval(start_s=20.0, end_s=24.0, ratio=ratio)
    simulation, time = pulses(TachometerSettings(slips=(slip,)))
    _, rolled = pulses(TachometerSettings())
    surplus, _ = quad(lambda t: simulation.motion.at(t)[1] * ratio * np.sin(np.pi * (t - 20.0) / 4.0), 20.0, 24.0)
    assert abs(surplus) > 3.0
    assert (len(time) - len(rolled)) * np.pi * 0.86 / 60.0 == pytest.approx(surplus, abs=0.09)
    np.testing.assert_array_equal(time[time < 20.0], rolled[rolled < 20.0])
    # In the middle the wheel turns at (1 + ratio) times the train's speed.
    middle = np.searchsorted(time, 22.0)
    wheel = np.pi * 0.86 / 60.0 / (time[middle] - time[middle - 1])
    assert wheel == pytest.approx((1.0 + ratio) * simulation.motion.at(22.0)[1], abs=0.1)
    truth = table(simulation, "wheel_slips")
    assert since_start(simulation, truth["end_gpst"]) == pytest.approx([24.0])
    assert truth["ratio"].to_list() == [ratio]


@pytest.mark.slow
def test_drawn_slips_come_as_often_as_they_should() -> None:
    """Over 100 hours of a shuttle; slips while it accelerates, slides while it brakes."""
    drawn = DrawnSlips(slip_chance=0.2, slide_chance=0.6, ratio=0.3, duration_s=3.0)
    simulation = only(360_000.0, tachometer=TachometerSettings(drawn_slips=drawn))
    assert simulation.scenario.sensors is not None
    assert simulation.scenario.sensors.tachometer is not None
    slips = wheel_slips(simulation, simulation.scenario.sensors.tachometer)
    ratio = np.array([s.ratio for s in slips])
    lasting = np.array([s.end_s - s.start_s for s in slips])
    stops = int(np.sum((simulation.motion.speed_mps[1:] == 0.0) & (simulation.motion.speed_mps[:-1] != 0.0)))
    assert stops > 4000
    assert (ratio > 0.0).sum() == pytest.approx(0.2 * stops, rel=0.05)
    assert (ratio < 0.0).sum() == pytest.approx(0.6 * stops, rel=0.05)
    # Even between a fifth and all.
    assert np.abs(ratio).mean() == pytest.approx(0.6 * 0.3, rel=0.05)
    assert lasting.mean() == pytest.approx(0.6 * 3.0, rel=0.05)
    at = np.array([s.start_s for s in slips]) + 0.2 * lasting
    gain = np.abs(simulation.motion.at(at + 0.01)[1]) - np.abs(simulation.motion.at(at)[1])
    assert (np.sign(gain) == np.sign(ratio)).mean() > 0.999


def test_pulse_times_have_jitter_and_resolution_and_stop_at_low_speed() -> None:
    _, exact = pulses(TachometerSettings(), 200.0)
    # Less than a tenth of the shortest interval, so that no two change places.
    _, noisy = pulses(TachometerSettings(jitter_s=1e-4), 200.0)
    assert len(exact) > 20_000
    assert (noisy - exact).std() == pytest.approx(1e-4, rel=0.05)
    _, counted = pulses(TachometerSettings(resolution_s=1e-3), 200.0)
    assert counted * 1e3 == pytest.approx(np.rint(counted * 1e3), abs=1e-5)
    assert (counted - exact).std() == pytest.approx(1e-3 / np.sqrt(12.0), rel=0.05)
    simulation, fast = pulses(TachometerSettings(lowest_mps=1.0), 200.0)
    assert np.abs(simulation.motion.at(fast)[1]).min() >= 0.999
    slow = np.abs(simulation.motion.at(exact)[1]) < 1.0
    assert len(exact) - len(fast) == pytest.approx(slow.sum(), abs=2)


@pytest.mark.parametrize(
    ("latitude", "height", "gravity"),
    # NIMA TR8350.2, table 3.4 (equator, poles); at 45 degrees and at 1000 m by its equations 4-1 and 4-3.
    [(0.0, 0.0, 9.7803253359), (90.0, 0.0, 9.8321849378), (45.0, 0.0, 9.806199), (45.0, 1000.0, 9.803114)],
)
def test_gravity(latitude: float, height: float, gravity: float) -> None:
    assert gravity_mps2(np.array(latitude), np.array(height)) == pytest.approx(gravity, abs=2e-6)


def test_a_standing_sensor_feels_gravity_and_the_earths_rotation() -> None:
    six = inertial(InertialSettings(), 20.0, STANDING)
    gravity = float(gravity_mps2(np.array(35.05), np.array(162.0)))
    assert np.linalg.norm(six[:, :3], axis=1) == pytest.approx(gravity, abs=1e-4)
    assert np.linalg.norm(six[:, 3:], axis=1) == pytest.approx(7.292115e-5, abs=1e-7)
    # Level and facing azimuth 63: the axis of the Earth is to the north, and up by the latitude.
    north = 7.292115e-5 * np.cos(np.radians(35.05))
    expected = [north * np.cos(np.radians(63.0)), -north * np.sin(np.radians(63.0)),
                -7.292115e-5 * np.sin(np.radians(35.05))]  # fmt: skip
    assert six[:, 3:].mean(axis=0) == pytest.approx(expected, abs=5e-7)


def test_curve_cant_and_gradient_are_felt() -> None:
    """At even speed in the first curve (160 m to the left, 90 mm of cant) and on the climb of 10 permille."""
    simulation = only(60.0, inertial=InertialSettings(up_m=0.0))
    six = table(simulation, "inertial").select(FORCES + RATES).to_numpy()
    chainage, speed = simulation.motion.at(np.arange(len(six)) / 100.0)
    gravity = float(gravity_mps2(np.array(35.05), np.array(162.0)))
    curve = (chainage > 145.0) & (chainage < 235.0) & (speed == speed.max())
    assert curve.sum() > 500
    lean = np.arcsin(0.090 / 1.137)
    across = -(speed.max() ** 2) / 160.0 * np.cos(lean) + gravity * np.sin(lean)
    assert six[curve, 1].mean() == pytest.approx(across, abs=0.01)
    assert six[curve, 5].mean() == pytest.approx(-speed.max() / 160.0 * np.cos(lean), rel=0.01)
    climb = (chainage > 300.0) & (chainage < 340.0) & (speed == speed.max())
    assert six[climb, 0].mean() == pytest.approx(gravity * np.sin(np.arctan(0.010)), abs=2e-3)
    # Accelerating on the level: the acceleration itself (P2, figure 1).
    up = (speed > 0.1) & (speed < 4.0) & (chainage < 40.0)
    assert six[up, 0].mean() == pytest.approx(0.7, abs=0.005)


def test_the_integral_of_a_noiseless_sensor_is_the_motion() -> None:
    """Strapdown navigation from the true start, 100 s of curves, cant and gradients without any aid."""
    offset = (3.0, 0.4, 1.2)
    simulation = only(100.0, inertial=InertialSettings(along_m=3.0, across_m=0.4, up_m=1.2))
    six = table(simulation, "inertial").select(FORCES + RATES).to_numpy()
    dt, count = 0.01, len(six)
    time = np.arange(count) * dt
    place = simulation.body_truth(offset, time)[0]
    right = simulation.body_truth((3.0, 1.4, 1.2), np.zeros(1))[0].ecef_m[0] - place.ecef_m[0]
    right /= np.linalg.norm(right)
    axes = np.stack([place.forward[0], right, np.cross(place.forward[0], right)], axis=1)
    at, velocity = place.ecef_m[0].copy(), np.zeros(3)
    turns = Rotation.from_rotvec((six[1:, 3:] + six[:-1, 3:]) / 2.0 * dt).as_matrix()
    back = Rotation.from_rotvec(-EARTH * dt).as_matrix()
    found = [at.copy()]
    for k in range(count - 1):
        after = back @ axes @ turns[k]
        force = (axes @ six[k, :3] + after @ six[k + 1, :3]) / 2.0
        latitude, longitude, height = geodetic_from_ecef(at)
        down = -enu_axes(latitude, longitude)[2] * gravity_mps2(latitude, height)
        change = (force + down - 2.0 * np.cross(EARTH, velocity)) * dt
        at = at + (velocity + change / 2.0) * dt
        velocity = velocity + change
        axes = after
        found.append(at)
    off = np.linalg.norm(np.array(found) - place.ecef_m, axis=1)
    assert simulation.motion.at(100.0)[0] > 600.0
    assert off.max() < 0.05


def difference(settings: dict[str, Any], duration_s: float = 100.0) -> np.ndarray:
    """What errors add to the six columns of a standing sensor, shape (n, 6)."""
    return inertial(InertialSettings(**settings), duration_s, STANDING) - inertial(
        InertialSettings(rate_hz=settings.get("rate_hz", 100.0)), duration_s, STANDING
    )


def test_inertial_biases_scales_and_turns() -> None:
    assert difference({"accel_bias_mps2": (0.1, -0.2, 0.3), "gyro_bias_radps": (1e-3, 2e-3, -3e-3)}, 2.0) == (
        pytest.approx(np.tile([0.1, -0.2, 0.3, 1e-3, 2e-3, -3e-3], (201, 1)), abs=1e-12)
    )
    true = inertial(InertialSettings(), 2.0)
    scaled = inertial(InertialSettings(accel_scale=(0.01, 0.0, -0.02), gyro_scale=(0.0, 0.05, 0.0)), 2.0)
    np.testing.assert_allclose(scaled, true * [1.01, 1.0, 0.98, 1.0, 1.05, 1.0], rtol=1e-12)
    # A box that is nose-up by 10 mrad on a level vehicle feels g sin(0.01) forward.
    turned = inertial(InertialSettings(misalignment_rad=(0.0, 0.01, 0.0)), 2.0, STANDING)
    assert (turned - inertial(InertialSettings(), 2.0, STANDING))[:, 0] == pytest.approx(9.797 * 0.01, abs=2e-4)
    stepped = inertial(InertialSettings(accel_resolution_mps2=2e-3), 2.0)[:, :3]
    assert stepped / 2e-3 == pytest.approx(np.rint(stepped / 2e-3), abs=1e-6)
    assert np.abs(stepped - true[:, :3]).max() <= 1.0001e-3


def test_inertial_noise_is_the_walk_that_it_makes() -> None:
    added = difference({"velocity_walk_mps_per_sqrt_s": 0.002, "angle_walk_rad_per_sqrt_s": 5e-5})
    assert added[:, :3].std() == pytest.approx(0.002 * np.sqrt(100.0), rel=0.05)
    # Velocity after a second: sqrt(1 s) times the walk.
    second = added[:10_000].reshape(100, 100, 6).sum(axis=1) * 0.01
    assert second[:, :3].std() == pytest.approx(0.002, rel=0.12)
    assert second[:, 3:].std() == pytest.approx(5e-5, rel=0.12)
    assert added[:, 3:].std() == pytest.approx(5e-5 * np.sqrt(100.0), rel=0.05)
    # White, and each axis its own.
    assert np.abs(np.corrcoef(added.T) - np.eye(6)).max() < 4.0 / np.sqrt(len(added))
    assert abs(np.mean(added[1:] * added[:-1] / added.std(axis=0) ** 2)) < 4.0 / np.sqrt(added.size)


def test_inertial_biases_drift() -> None:
    settings = {"rate_hz": 2.0, "accel_drift_sigma_mps2": 0.01, "accel_drift_time_s": 4.0,
                "gyro_drift_sigma_radps": 1e-4, "gyro_drift_time_s": 8.0}  # fmt: skip
    added = difference(settings, 7200.0)
    for series, sigma, time_s in ((added[:, :3], 0.01, 4.0), (added[:, 3:], 1e-4, 8.0)):
        assert series.std() == pytest.approx(sigma, rel=0.05)
        lag = round(time_s / 2.0 / 0.5)
        rho = float((series[lag:] * series[:-lag]).mean() / (series**2).mean())
        assert -lag * 0.5 / np.log(rho) == pytest.approx(time_s, rel=0.05)
    walk = difference({"rate_hz": 2.0, "gyro_drift_walk_radps_per_sqrt_s": 1e-5}, 3600.0)
    assert np.abs(walk[:, :3]).max() == 0.0
    assert np.abs(walk[0]).max() == 0.0
    assert np.diff(walk[::2, 3:], axis=0).std() == pytest.approx(1e-5, rel=0.05)


def radar(settings: RadarSettings, duration_s: float = 2000.0) -> tuple[np.ndarray, np.ndarray]:
    """Measured and true speed."""
    simulation = only(duration_s, radar=settings)
    frame = table(simulation, "radar")
    return frame["speed_mps"].to_numpy(), simulation.motion.at(since_start(simulation, frame["time_gpst"]))[1]


def test_radar_measures_the_speed() -> None:
    measured, true = radar(RadarSettings(), 200.0)
    np.testing.assert_allclose(measured, true, atol=1e-9)
    assert true.min() < -10.0
    assert true.max() > 10.0
    measured, true = radar(RadarSettings(bias_mps=0.2, scale=-0.01), 200.0)
    np.testing.assert_allclose(measured, 0.99 * true + 0.2, atol=1e-9)
    measured, true = radar(RadarSettings(noise_sigma_mps=0.05))
    assert (measured - true).std() == pytest.approx(0.05, rel=0.05)
    measured, true = radar(RadarSettings(lowest_mps=1 / 3.6, highest_mps=8.0), 200.0)
    np.testing.assert_array_equal(np.isnan(measured), (np.abs(true) < 1 / 3.6) | (np.abs(true) > 8.0))


def test_radar_sways_in_proportion_to_the_speed() -> None:
    measured, true = radar(RadarSettings(sway_ratio_sigma=0.02, sway_time_s=0.5), 7200.0)
    moving = np.abs(true) > 1.0
    ratio = np.where(moving, measured / np.where(moving, true, 1.0) - 1.0, np.nan)
    assert np.nanstd(ratio) == pytest.approx(0.02, rel=0.05)
    rho = np.nanmean(ratio[3:] * ratio[:-3]) / np.nanmean(ratio**2)
    assert -0.3 / np.log(rho) == pytest.approx(0.5, rel=0.05)


def test_radar_drops_out() -> None:
    measured, _ = radar(
        RadarSettings(dropouts=(Dropout(start_s=10.0, end_s=12.0), Dropout(start_s=50.0, end_s=50.5))), 60.0
    )
    gone = np.isnan(measured)
    assert gone.sum() == 25
    assert gone[100:120].all()
    assert gone[500:505].all()
    found = np.array(dropouts(RadarSettings(dropouts_per_hour=40.0, dropout_duration_s=5.0), 3, 3600.0 * 100.0))
    assert len(found) == pytest.approx(4000, rel=0.05)
    assert np.diff(found, axis=1).mean() == pytest.approx(5.0, rel=0.05)


def test_settings_are_read_from_plain_tables() -> None:
    text = """
    [tachometer]
    pulses_per_turn = 90
    slips = [{start_s = 1, end_s = 4, ratio = -0.5}]
    [inertial]
    accel_bias_mps2 = [0.1, 0, 0]
    """
    read = TypeAdapter(SensorSettings).validate_python(tomllib.loads(text))
    assert read.tachometer == TachometerSettings(
        pulses_per_turn=90, slips=(SlipInterval(start_s=1.0, end_s=4.0, ratio=-0.5),)
    )
    assert read.inertial == InertialSettings(accel_bias_mps2=(0.1, 0.0, 0.0))
    assert read.radar == RadarSettings()


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        (lambda: SlipInterval(start_s=1.0, end_s=1.0, ratio=0.1), "end_s"),
        (lambda: SlipInterval(start_s=1.0, end_s=2.0, ratio=-1.1), "ratio"),
        (lambda: DrawnSlips(slip_chance=2.0), "slip_chance"),
        (lambda: TachometerSettings(pulses_per_turn=0), "pulses_per_turn"),
        (lambda: TachometerSettings(diameter_error_m=0.9), "diameter_error_m"),
        (
            lambda: TachometerSettings(
                slips=(SlipInterval(start_s=1.0, end_s=4.0, ratio=0.1), SlipInterval(start_s=3.0, end_s=5.0, ratio=0.1))
            ),
            "slips",
        ),
        (lambda: InertialSettings(rate_hz=0.0), "rate_hz"),
        (lambda: InertialSettings(gyro_scale=(0.0, float("nan"), 0.0)), "gyro_scale"),
        (lambda: RadarSettings(noise_sigma_mps=-1.0), "noise_sigma_mps"),
    ],
)
def test_settings_out_of_range_are_refused(settings: Any, names: str) -> None:
    with pytest.raises(SettingsError, match=names):
        settings()


# ---------------------------------------------------------------- teeth


def test_uneven_teeth_come_back_every_turn_and_a_whole_turn_cancels_them() -> None:
    """Cruising at constant speed the interval of 60 pulses is even, that of one pulse is not."""
    plain = pulses(TachometerSettings())[1]
    _, uneven = pulses(TachometerSettings(tooth_sigma=0.05))
    assert len(uneven) == pytest.approx(len(plain), abs=1)
    simulation = only(100.0, tachometer=TachometerSettings())
    cruising = uneven[np.abs(simulation.motion.acceleration_at(uneven)) == 0.0]
    cruising = cruising[(cruising > 35.0) & (cruising < 70.0)]
    spacing = np.diff(cruising) / np.diff(plain[(plain > 36.0) & (plain < 60.0)]).mean()
    # Difference of two independent teeth: sqrt(2) times their sigma.
    assert spacing.std() == pytest.approx(0.05 * np.sqrt(2.0), rel=0.25)
    assert spacing[60:] == pytest.approx(spacing[:-60], abs=1e-6), "the same teeth every turn"
    turn = cruising[60:] - cruising[:-60]
    assert np.ptp(turn) / turn.mean() < 1e-8


def test_lost_and_doubled_pulses_are_as_many_as_their_chances_say() -> None:
    _, plain = pulses(TachometerSettings(), 200.0)
    _, lost = pulses(TachometerSettings(lost_chance=0.02), 200.0)
    _, doubled = pulses(TachometerSettings(doubled_chance=0.03), 200.0)
    n = len(plain)
    assert n - len(lost) == pytest.approx(0.02 * n, abs=4.0 * np.sqrt(0.02 * n))
    assert np.isin(lost, plain).all()
    assert len(doubled) - n == pytest.approx(0.03 * n, abs=4.0 * np.sqrt(0.03 * n))
    assert np.isin(plain, doubled).all()
    extra = doubled[~np.isin(doubled, plain)]
    after = np.searchsorted(plain, extra)
    inside = after < n
    part = (extra - plain[after - 1])[inside] / (plain[np.minimum(after, n - 1)] - plain[after - 1])[inside]
    assert part.min() > 0.09
    assert part.max() < 0.61


# ---------------------------------------------------------------- vibration


def test_vibration_has_its_sigma_and_frequency_and_none_at_rest() -> None:
    run = RunSettings(cruise_mps=10.0)
    settings = InertialSettings(vibration_sigma_mps2=0.4, vibration_sigma_radps=0.02, vibration_hz=12.0)
    plain, shaken = inertial(InertialSettings(), run=run), inertial(settings, run=run)
    more = shaken - plain
    simulation = only(100.0, inertial=settings, run=run)
    speed = simulation.motion.at(np.arange(len(more)) / 100.0)[1]
    assert (more[speed == 0.0] == 0.0).all()
    cruising = more[speed == 10.0]
    assert len(cruising) > 3000
    # Half of the size at half of 20 m/s.
    assert cruising[:, :3].std(axis=0) == pytest.approx(0.2, rel=0.1)
    assert cruising[:, 3:].std(axis=0) == pytest.approx(0.01, rel=0.1)
    crossings = (np.diff(np.sign(cruising[:, 0])) != 0).sum()
    assert crossings / 2.0 / (len(cruising) / 100.0) == pytest.approx(12.0, rel=0.08)
    assert np.abs(np.corrcoef(cruising.T)[np.triu_indices(6, 1)]).max() < 0.2


# ---------------------------------------------------------------- ranging


def ranging(
    duration_s: float = 100.0, *, run: RunSettings | None = None, **settings: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Measured less true ranges [m] of one unit at chainage 250 m, and the chainage of the vehicle's middle."""
    unit = settings.pop("unit", GroundUnit(name="A", chainage_m=250.0, lateral_m=4.0, height_m=2.0))
    simulation = only(duration_s, run=run, ranging=RangingSettings(units=(unit,), **settings))
    frame = table(simulation, "ranging")
    time = since_start(simulation, frame["time_gpst"])
    place = table(simulation, "ranging_units").select("x_m", "y_m", "z_m").to_numpy()[0]
    vehicle, _ = simulation.body_truth((9.0, 0.0, 3.0), time)
    true = np.linalg.norm(vehicle.ecef_m - place, axis=1)
    return frame["range_m"].to_numpy() - true, simulation.motion.at(time)[0]


def test_a_range_without_errors_is_the_distance_and_ends_at_its_reach() -> None:
    error, chainage = ranging()
    assert len(error) > 50
    assert np.abs(error).max() < 1e-6
    assert np.abs(chainage + 9.0 - 250.0).max() == pytest.approx(100.0, abs=2.5)
    # On a straight by Pythagoras: 4 m to the side, 1 m lower, so many metres ahead.
    unit = GroundUnit(name="B", chainage_m=60.0, lateral_m=4.0, height_m=2.0)
    simulation = only(1.0, ranging=RangingSettings(units=(unit,)))
    first = table(simulation, "ranging")["range_m"][0]
    assert first == pytest.approx(np.sqrt((60.0 - 29.0) ** 2 + 4.0**2 + 1.0**2), abs=0.02)


def test_each_error_of_a_range_comes_back_alone() -> None:
    # The sigma of P2 3.3 on the straight.
    noise, _ = ranging(400.0, noise_sigma_m=0.19)
    assert noise.std() == pytest.approx(0.19, rel=0.15)
    assert ranging(unit=GroundUnit(name="A", chainage_m=250.0, delay_bias_m=0.15))[0] == pytest.approx(0.15, abs=1e-6)
    full, kept = ranging(400.0)[0], ranging(400.0, lost_chance=0.3)[0]
    assert len(kept) / len(full) == pytest.approx(0.7, abs=0.1)
    echoes, _ = ranging(400.0, echo_chance=0.2, echo_delay_m=0.8)
    late = echoes > 1e-6
    assert late.mean() == pytest.approx(0.2, abs=0.08)
    assert echoes.min() > -1e-6, "an echo is never early"
    assert echoes[late].mean() == pytest.approx(0.8, rel=0.35)


def test_ranging_errors_stay_while_the_train_stands() -> None:
    run = RunSettings(first_stand_s=1e6)
    unit = GroundUnit(name="A", chainage_m=60.0)
    still, _ = ranging(20.0, run=run, unit=unit, multipath_sigma_m=0.3, echo_chance=0.5)
    assert len(still) == 101
    assert np.ptp(still) < 1e-9
    moving, _ = ranging(60.0, multipath_sigma_m=0.3)
    assert moving.std() == pytest.approx(0.3, rel=0.25)
    assert abs(np.corrcoef(moving[1:], moving[:-1])[0, 1]) < 0.3
