"""Sensors on board against the satellites and the line, by rides written as formulas."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Literal

import numpy as np
import polars as pl
import pytest

from railfix.core.errors import MismatchError
from railfix.core.geodesy import ecef_from_geodetic, enu_axes
from railfix.motion.radar_watch import RadarWatch
from railfix.motion.samples import (
    GroundUnits,
    InertialSamples,
    RadarSpeeds,
    SensorSamples,
    StationRanges,
    TachometerPulses,
)
from railfix.motion.tachometer import TachometerLimits
from railfix.pipeline.sensor_epochs import SensorLimits, SensorState, sensor_epochs
from railfix.run.checks import check_sensor_time
from railfix.run.sensor_checks import SensorChecks, compute_motion, range_notes, sign_notes
from railfix.run.tally import AntennaTally, Tally
from railfix.track import Track
from railfix.track.trajectory import Trajectory

pytestmark = pytest.mark.requirement("E5")
START = np.datetime64("2024-03-05T03:10:00", "ns")
ORIGIN = ecef_from_geodetic(35.0, 139.0, 60.0)
EAST, _, UP = enu_axes(35.0, 139.0)
SOUTH = np.cross(EAST, UP)
AT = np.arange(0.0, 900.0, 10.0)
LINE = Trajectory.from_antenna_path(Track.from_ecef(ORIGIN + AT[:, None] * EAST, name="east"))
#: Units 3 m to the right of the line, 1 m above the antenna.
UNITS = GroundUnits(
    name=np.array(["A", "B"]), ecef_m=np.stack([ORIGIN + x * EAST + 3.0 * SOUTH + UP for x in (300.0, 600.0)])
)


def places(speed_mps: float) -> pl.DataFrame:
    """The antenna once a second; the line runs east, the train at this speed."""
    time = START + (np.arange(len(AT)) * 1e9).astype("timedelta64[ns]")
    return pl.DataFrame({"time_gpst": time, "chainage_m": AT[:: 1 if speed_mps > 0 else -1]})


def ranges(table: pl.DataFrame, ahead_m: float, excess_m: float, *, right_m: float = 0.0) -> StationRanges:
    """Half a second after each place, within 150 m, by a device so far from the antenna and 1 m above it."""
    at = table["chainage_m"].to_numpy()
    device = ORIGIN + (0.5 * (at[1:] + at[:-1]) + ahead_m)[:, None] * EAST + right_m * SOUTH + UP
    time = table["time_gpst"].to_numpy().astype("datetime64[ns]")[:-1] + np.timedelta64(500, "ms")
    distance = np.linalg.norm(device[:, None] - UNITS.ecef_m, axis=2)
    row, unit = np.nonzero(distance < 150.0)
    values = distance[row, unit] + excess_m
    return StationRanges(time=time[row], station=UNITS.name[unit], range_m=values, sigma_m=np.full(len(values), np.nan))


@pytest.mark.requirement("E4")
@pytest.mark.parametrize("facing", ["rising", "falling"])
@pytest.mark.parametrize("speed", [10.0, -10.0])
def test_the_place_of_the_device_is_found_whichever_way_the_train_runs_and_faces(
    facing: Literal["rising", "falling"], speed: float
) -> None:
    trajectory, sign = replace(LINE, facing=facing), 1.0 if facing == "rising" else -1.0
    table = places(speed)
    made = ranges(table, 8.0 * sign, 0.0)
    assert list(range_notes(made, UNITS, table, trajectory, SensorLimits(range_ahead_m=8.0, range_above_m=1.0))) == []
    (note,) = range_notes(made, UNITS, table, trajectory, SensorLimits(range_above_m=1.0))
    assert f"8.0 m {'ahead of' if sign > 0 else 'behind'} satellite positions" in note
    assert "sensors.range_ahead_m = 8.0 would fit" in note


@pytest.mark.requirement("E4")
def test_ranges_that_are_too_long_are_told_apart_from_a_displaced_device() -> None:
    table, limits = places(10.0), SensorLimits(range_above_m=1.0)
    (note,) = range_notes(ranges(table, 0.0, 5.0), UNITS, table, LINE, limits)
    assert "the ranges are 5.0 m too long compared with satellite positions" in note
    both = list(range_notes(ranges(table, -6.0, -4.0), UNITS, table, LINE, limits))
    assert "6.0 m behind" in both[0]
    assert "4.0 m too short" in both[1]
    beside = ranges(table, 0.0, 0.0, right_m=-65.0)
    away = SensorLimits(range_above_m=1.0, range_right_m=-65.0)
    assert list(range_notes(beside, UNITS, table, LINE, away)) == []
    assert "too long" in "".join(range_notes(beside, UNITS, table, LINE, limits))
    (note,) = range_notes(ranges(table, 0.0, 0.0), UNITS, table[:3], LINE, limits)
    assert "too few ranges" in note
    later = table.with_columns(pl.col("time_gpst").dt.offset_by("100ms"), pl.col("chainage_m") + 9.0)
    ten_hertz = pl.concat([table, later]).sort("time_gpst")
    rows = ten_hertz.with_columns(status=pl.lit("ok"), sources=pl.lit("doppler"), speed_mps=pl.lit(10.0))
    for size in (1, 50, 1000):  # two positions a second, whatever the length of the chunks
        checks = SensorChecks()
        for part in rows.iter_slices(size):
            checks.take(part, part)
        assert checks.notes(SensorSamples(ranging=ranges(table, -6.0, -4.0)), UNITS, LINE, limits) == tuple(both)


#: A ride on a circle to the right that climbs: speed 12 + 6 sin(2 pi t / 80), so 80 s of braking and accelerating.
RADIUS_M, CLIMB, SECONDS = 1500.0, 0.01, 320.0


def distance_m(t: np.ndarray) -> np.ndarray:
    return 12.0 * t + 6.0 * 80.0 / (2.0 * np.pi) * (1.0 - np.cos(2.0 * np.pi * t / 80.0))


def circle(t: np.ndarray, noise_m: float = 0.0) -> pl.DataFrame:
    """Places at these seconds, with a white error along the line."""
    distance = distance_m(t) + noise_m * np.random.default_rng(1).standard_normal(len(t))
    return pl.DataFrame({"time_gpst": START + (t * 1e9).astype("timedelta64[ns]"), "chainage_m": distance})


def round_line() -> Trajectory:
    """The circle, its points 5 m apart."""
    distance = np.arange(-50.0, distance_m(np.array([SECONDS]))[0] + 50.0, 5.0)
    angle = distance / RADIUS_M  # heading, from east to the south
    flat = np.cos(angle)[:, None] * -SOUTH + np.sin(angle)[:, None] * EAST
    ecef = ORIGIN + RADIUS_M * (flat + SOUTH) + CLIMB * distance[:, None] * UP
    line = Trajectory.from_antenna_path(Track.from_ecef(ecef, name="circle"))
    return replace(line, chainage_m=distance)


def on_the_circle(facing: float) -> SensorSamples:
    """What a vehicle measures there, its front toward rising chainage or the other way."""
    t = np.arange(0.0, SECONDS, 0.02)
    time = START + (t * 1e9).astype("timedelta64[ns]")
    speed = 12.0 + 6.0 * np.sin(2.0 * np.pi * t / 80.0)
    gained = 6.0 * 2.0 * np.pi / 80.0 * np.cos(2.0 * np.pi * t / 80.0)
    nothing = np.zeros_like(t)
    force = np.column_stack([facing * (gained + 9.80665 * CLIMB), facing * speed**2 / RADIUS_M, nothing - 9.80665])
    pulse = np.arange(0.0, distance_m(t[-1:])[0], TachometerLimits().pulse_m)
    at = np.interp(pulse, distance_m(t), t)
    return SensorSamples(
        inertial=InertialSamples(
            time=time, force_mps2=force, rate_radps=np.column_stack([nothing, nothing, speed / RADIUS_M])
        ),
        radar=RadarSpeeds(time=time[::5], speed_mps=facing * speed[::5]),
        tachometer=TachometerPulses(
            time=START + (at * 1e9).astype("timedelta64[ns]"),
            pulse=np.arange(len(pulse)),
            direction=np.full(len(pulse), int(facing)),
        ),
    )


def test_motion_by_places_is_that_of_the_ride() -> None:
    t = np.arange(0.0, SECONDS, 1.0)
    motion = compute_motion(circle(t).filter(pl.Series((t < 100.0) | (t > 130.0))), round_line())
    at = (motion.time - START) / np.timedelta64(1, "s")
    wave = 2.0 * np.pi * at / 80.0
    known = np.isfinite(motion.acceleration_mps2)
    assert known.sum() > 60
    np.testing.assert_allclose(motion.speed_mps[known], (12.0 + 6.0 * np.sin(wave))[known], atol=0.3)
    np.testing.assert_allclose(motion.acceleration_mps2[known], (0.4712 * np.cos(wave))[known], atol=0.06)
    np.testing.assert_allclose(motion.gradient[known], CLIMB, atol=4e-4)  # the earth is round
    turned = np.isfinite(motion.heading_rate_radps)
    np.testing.assert_allclose(motion.heading_rate_radps[turned], motion.speed_mps[turned] / RADIUS_M, atol=4e-4)


def _turned(samples: SensorSamples, sensor: str, column: str, factor: object) -> SensorSamples:
    table = getattr(samples, sensor)
    return replace(samples, **{sensor: replace(table, **{column: getattr(table, column) * factor})})


@pytest.mark.parametrize("facing", [1.0, -1.0])
@pytest.mark.parametrize(
    ("sensor", "column", "factor", "said"),
    [
        ("tachometer", "direction", -1, "tachometer: the direction of its pulses is opposite"),
        ("radar", "speed_mps", -1.0, "radar: the sign of its speeds is opposite"),
        ("inertial", "force_mps2", [-1.0, -1.0, 1.0], "inertial: the forward force is opposite"),
        ("inertial", "force_mps2", 1.0 / 9.80665, "inertial: its forces are in g"),
        ("inertial", "force_mps2", [1.0, 1.0, -1.0], r"force_down_mps2 is \+9.8 on average"),
        ("inertial", "force_mps2", [1.0, 1.0, 0.5], "inertial: its median force is 4.9"),
        ("inertial", "rate_radps", -1.0, "inertial: its yaw rate is opposite"),
        ("inertial", "rate_radps", 57.29578, "inertial: its rates are in degrees"),
    ],
)  # fmt: skip
@pytest.mark.every(2)
def test_a_sensor_that_is_turned_or_in_another_unit_is_told(
    sensor: str, column: str, factor: object, said: str, facing: float
) -> None:
    places, samples = circle(np.arange(0.0, SECONDS, 1.0), noise_m=0.7), on_the_circle(facing)
    line = replace(round_line(), facing="rising" if facing > 0 else "falling")
    assert list(sign_notes(samples, places, line, TachometerLimits())) == []
    factor = np.array(factor) if isinstance(factor, list) else factor
    (note,) = sign_notes(_turned(samples, sensor, column, factor), places, line, TachometerLimits())
    assert re.search(said, note), note


@pytest.mark.parametrize(("lag_s", "said"), [(-18.0, "1[789] s early .* UTC"), (6.0, "6 s late .* correct them")])
@pytest.mark.parametrize("sensor", ["tachometer", "radar", "inertial"])
def test_time_tags_that_are_seconds_off_are_told(sensor: str, lag_s: float, said: str) -> None:
    places, samples = circle(np.arange(0.0, SECONDS, 1.0), noise_m=0.7), on_the_circle(1.0)
    table = getattr(samples, sensor)
    late = replace(table, time=table.time + np.timedelta64(round(lag_s * 1e9), "ns"))
    (note,) = sign_notes(replace(samples, **{sensor: late}), places, round_line(), TachometerLimits())
    assert re.search(f"{sensor}: its time tags are {said}", note), note


def test_exchanged_axes_are_told_and_nothing_else_rests_on_them() -> None:
    """The speeds of the filter are wrong with such a unit: what they say of the other sensors is not told."""
    places, samples = circle(np.arange(0.0, SECONDS, 1.0)), on_the_circle(1.0)
    unit = samples.inertial
    samples = replace(samples, inertial=replace(unit, force_mps2=unit.force_mps2[:, ::-1]))
    checks = SensorChecks(places=[places], speeds=[pl.DataFrame({"time_gpst": places["time_gpst"], "speed_mps": 30.0})])
    notes = checks.notes(samples, None, round_line(), SensorLimits())
    assert "inertial: gravity is in force_forward_mps2, not in force_down_mps2; swap the columns" in notes[0]
    assert not any("tachometer" in note for note in notes)
    right = checks.notes(on_the_circle(1.0), None, round_line(), SensorLimits())
    assert any("tachometer: its distance differs by" in note for note in right)


@pytest.mark.requirement("E4")
@pytest.mark.parametrize("degrees", [0.0, 0.3, 1.0, -2.0])
def test_a_mounting_that_moves_by_a_degree_is_found_and_one_that_does_not_is_left_alone(degrees: float) -> None:
    """At 45 degrees a degree is 1.7 % (P2 3.1); 0.3 degrees are within the scale that the filter learns."""
    random = np.random.default_rng(7)
    t = np.arange(0.0, 3600.0, 0.5)
    time, speed = START + (t * 1e9).astype("timedelta64[ns]"), 15.0 + 8.0 * np.sin(t / 90.0)
    angle = np.radians(45.0 + np.where(t > 1300.0, degrees, 0.0))
    radar = speed * np.cos(angle) / np.cos(np.radians(45.0)) + 0.1 * random.standard_normal(len(t))
    right = speed + 0.05 * random.standard_normal(len(t))
    whole, piecewise = RadarWatch(), RadarWatch()
    steps = whole.take(time, radar, right)
    cuts = np.sort(random.integers(0, len(t), 50))
    pieces = np.split(np.arange(len(t)), cuts)
    found = [step for k in pieces for step in piecewise.take(time[k], radar[k], right[k])]
    assert [step.time for step in found] == [step.time for step in steps]
    assert [step.after for step in found] == pytest.approx([step.after for step in steps], abs=1e-9)
    if abs(degrees) < 0.5:
        assert steps == []
        return
    (step,) = steps
    assert abs(step.time - (START + np.timedelta64(1300, "s"))) <= np.timedelta64(30, "s")
    assert step.after == pytest.approx(-np.radians(degrees), abs=0.003)
    assert step.before == pytest.approx(0.0, abs=0.002)
    samples = SensorSamples(radar=RadarSpeeds(time=time[::2], speed_mps=radar[::2]))
    (again,) = RadarWatch().take_samples(samples.radar, time, right)
    assert again.time == step.time


def test_a_train_at_rest_has_no_pulses() -> None:
    """A table that begins after a short log is reported; one of another day is an error."""
    tally = Tally(antennas={"front": AntennaTally(first=START, last=START + np.timedelta64(9, "s"))})
    later = START + np.arange(1, 3) * np.timedelta64(1, "h")
    pulses = TachometerPulses(time=later, pulse=np.arange(2), direction=np.ones(2, dtype=np.int64))
    (note,) = check_sensor_time(SensorSamples(tachometer=pulses), tally)
    assert "the samples of --tachometer" in note
    another_day = replace(pulses, time=later + np.timedelta64(24, "h"))
    with pytest.raises(MismatchError, match="have no time in common; give the samples of the day of the logs"):
        check_sensor_time(SensorSamples(tachometer=another_day), tally)


@pytest.mark.requirement("E4")
def test_a_radar_that_swings_has_not_moved() -> None:
    """Half a minute too much, half a minute too little: a step stays on one side."""
    t = np.arange(0.0, 900.0, 0.5)
    time = np.datetime64("2024-03-05T03:10:00", "ns") + (t * 1e9).astype("timedelta64[ns]")
    swing = np.where(t > 600.0, np.where(t % 60.0 < 30.0, 1.03, 0.97), 1.0)
    assert RadarWatch().take(time, 15.0 * swing, np.full(len(t), 15.0)) == []
    assert len(RadarWatch().take(time, np.where(t > 600.0, 15.45, 15.0), np.full(len(t), 15.0))) == 1


@pytest.mark.requirement("E4")
def test_a_radar_that_falls_silent_is_told_once_and_again_after_it_was_heard() -> None:
    """Standing is no silence, and neither are single speeds that are missing."""
    t = np.arange(0.0, 1200.0, 0.5)
    time = START + (t * 1e9).astype("timedelta64[ns]")
    speed = np.where((t > 600.0) & (t < 800.0), 0.0, 15.0)
    radar = np.where(np.arange(len(t)) % 3 == 0, np.nan, speed)
    radar[(t > 600.0) & (t < 800.0)] = np.nan
    assert RadarWatch().take(time, radar, speed) == []
    silent = ((t > 200.0) & (t < 420.0)) | (t > 1000.0)
    alarms = RadarWatch().take(time, np.where(silent, np.nan, radar), speed)
    assert [alarm.kind for alarm in alarms] == ["silent", "silent"]
    for alarm, since in zip(alarms, (200.0, 1000.0), strict=True):
        assert 0.0 <= (alarm.time - START) / np.timedelta64(1, "s") - since <= 60.0
    assert "while the train moves; check whether snow" in alarms[0].sentence
    nothing = RadarSpeeds(time=time[:0], speed_mps=radar[:0])
    assert [alarm.kind for alarm in RadarWatch().take_samples(nothing, time, speed)] == ["silent"]


def test_a_run_names_a_mounting_that_moves() -> None:
    places, samples = circle(np.arange(0.0, SECONDS, 1.0)), on_the_circle(1.0)
    t = np.arange(0.0, SECONDS, 0.5)
    time, right = START + (t * 1e9).astype("timedelta64[ns]"), 12.0 + 6.0 * np.sin(2.0 * np.pi * t / 80.0)
    checks = SensorChecks(places=[places], speeds=[pl.DataFrame({"time_gpst": time, "speed_mps": right})])
    scale = np.where(samples.radar.time > START + np.timedelta64(200, "s"), 0.97, 1.0)
    moved = replace(samples.radar, speed_mps=scale * samples.radar.speed_mps)
    assert checks.notes(samples, None, round_line(), SensorLimits()) == ()
    assert checks.radar_alarms(samples.radar) == ()
    notes = checks.radar_alarms(moved)
    assert any("differ from satellite-derived speeds by -3.0 % (+0.0 % before); check" in note for note in notes), notes


@pytest.mark.requirement("E3")
@pytest.mark.parametrize("facing", [1.0, -1.0])
def test_the_line_under_the_body_whichever_way_the_vehicle_faces(facing: float) -> None:
    """A circle to the right that climbs, the body leaning by 60 mm over 1.5 m, seen by a vehicle that runs or backs."""
    samples, lean = on_the_circle(facing), 0.06 / 1.5
    unit = samples.inertial
    force = unit.force_mps2 - np.array([0.0, facing * 9.80665 * lean, 0.0])
    samples = replace(samples, inertial=replace(unit, force_mps2=force))
    trajectory = replace(LINE, facing="rising" if facing > 0 else "falling", contact_m=1.5)
    time = START + (np.arange(20.0, SECONDS - 20.0) * 1e9).astype("timedelta64[ns]")
    state, limits = SensorState.empty(), SensorLimits()
    climb = CLIMB / np.sqrt(1.0 + CLIMB**2)
    _, sensed, _ = sensor_epochs(
        samples, time, trajectory, state, limits=limits, sine_at=lambda arc_m: np.full(arc_m.shape, climb)
    )
    late = slice(30, None)  # once the wheel is known to roll
    np.testing.assert_allclose(sensed.curvature_1pm[late], 1.0 / RADIUS_M, rtol=0.02)
    np.testing.assert_allclose(sensed.cant_m[late], 0.06, atol=1e-3)
    np.testing.assert_allclose(sensed.gradient[late], CLIMB, atol=5e-4)
    _, without, _ = sensor_epochs(samples, time, replace(trajectory, contact_m=None), state, limits=limits)
    assert np.isnan(without.cant_m).all()
    assert np.isfinite(without.curvature_1pm[late]).all()
