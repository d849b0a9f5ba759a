"""Sensor samples as measurements at the epochs of an antenna, however they are cut."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.timescale import timedelta
from railfix.motion.features import LineSeries, map_features
from railfix.motion.samples import InertialSamples, RadarSpeeds, SensorSamples, TachometerPulses
from railfix.pipeline.along_track import _find_fix, _gated_ranges, _restart_state
from railfix.pipeline.config import parse_config
from railfix.pipeline.feature_fixes import LineFeatures, feature_fixes
from railfix.pipeline.filter_result import FilterFix, FilterState
from railfix.pipeline.outage_gate import ReturnState
from railfix.pipeline.passed_features import FeatureState, RateSeries
from railfix.pipeline.sensor_epochs import SensorLimits, SensorState, ranging_lever_m, sensor_epochs
from railfix.run.sensors import read_sensors, read_units, units_of_ranges
from railfix.tracking import Line, RangeEpochs, Tracked, TrackStatus
from tracking_cases import START, bent_line

LIMITS = SensorLimits()
SECONDS = 20


def _samples(speed: float = 10.0, direction: int = 1) -> SensorSamples:
    pulse = LIMITS.tachometer.pulse_m / speed
    instants = np.arange(0.0, SECONDS, pulse)
    fine = np.arange(0.0, SECONDS, 0.01)
    return SensorSamples(
        tachometer=TachometerPulses(
            time=START + timedelta(instants),
            pulse=np.arange(1, len(instants) + 1),
            direction=np.full(len(instants), direction),
        ),
        inertial=InertialSamples(
            time=START + timedelta(fine),
            force_mps2=np.column_stack([0.05 * np.sin(fine), 0 * fine, 0 * fine - 9.8]),
            rate_radps=np.zeros((len(fine), 3)),
        ),
        radar=RadarSpeeds(time=START + timedelta(fine[::10]), speed_mps=np.full(len(fine[::10]), speed)),
    )


EPOCHS = START + timedelta(np.arange(1.0, SECONDS))


@pytest.mark.requirement("E5")
def test_ways_and_forces_of_each_second() -> None:
    found, _, _ = sensor_epochs(_samples(), EPOCHS, bent_line(), SensorState.empty(), limits=LIMITS)
    np.testing.assert_allclose(found.wheel_m[1:], 10.0, atol=1e-3)
    np.testing.assert_allclose(found.radar_m[1:], 10.0, atol=1e-9)
    limits = LIMITS.replaced(radar_sigma_mps=0.3)
    rougher, _, _ = sensor_epochs(_samples(), EPOCHS, bent_line(), SensorState.empty(), limits=limits)
    for each, sigma_mps in ((found, 0.1), (rougher, 0.3)):  # ten independent speeds in a second
        np.testing.assert_allclose(each.radar_sigma_m[1:], sigma_mps / np.sqrt(10.0))
    t = np.arange(1.0, SECONDS)
    np.testing.assert_allclose(found.force_mps2[1:], 0.05 * (np.cos(t[:-1]) - np.cos(t[1:])), atol=5e-4)
    assert found.wheel_sign == "measured"


@pytest.mark.requirement("E5")
def test_the_front_toward_falling_chainage_turns_the_signs() -> None:
    falling = replace(bent_line(), facing="falling")
    found, _, _ = sensor_epochs(_samples(), EPOCHS, falling, SensorState.empty(), limits=LIMITS)
    assert (found.wheel_m[1:] < 0).all()
    assert (found.radar_m[1:] < 0).all()


@pytest.mark.requirement("E5")
def test_the_force_and_the_place_of_the_ranging_unit_turn_with_the_front() -> None:
    falling = replace(bent_line(), facing="falling")
    both = [
        sensor_epochs(_samples(), EPOCHS, line, SensorState.empty(), limits=LIMITS, sources=("force",))[0].force_mps2
        for line in (bent_line(), falling)
    ]
    assert both[1] is not None
    assert np.abs(both[0][1:]).max() > 0.02
    np.testing.assert_array_equal(both[1], -both[0])
    limits = SensorLimits(range_ahead_m=9.0, range_right_m=1.2, range_above_m=-1.0)
    np.testing.assert_allclose(ranging_lever_m(bent_line(), limits), [9.0, 1.2, -1.0])
    np.testing.assert_allclose(ranging_lever_m(falling, limits), [-9.0, -1.2, -1.0])
    behind = replace(falling, body_chainage_m=falling.chainage_m + 7.0)
    np.testing.assert_allclose(ranging_lever_m(behind, limits), [-2.0, -1.2, -1.0])


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("pitch_rad", [0.01, -0.01])
def test_a_pitch_of_the_body_is_no_acceleration(pitch_rad: float) -> None:
    """On a level line the body pitches within half a second, as on its springs; the gyro shows it."""
    given = _samples()
    t = (given.inertial.time - START) / np.timedelta64(1, "s")
    pitch = pitch_rad * np.clip((t - 12.0) / 0.5, 0.0, 1.0)
    force, rate = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    force[:, 0], force[:, 2], rate[:, 1] = 9.80665 * pitch, -9.80665, np.gradient(pitch, t)
    samples = replace(given, inertial=InertialSamples(time=given.inertial.time, force_mps2=force, rate_radps=rate))
    found, _, _ = sensor_epochs(
        samples, EPOCHS, bent_line(), SensorState.empty(), limits=LIMITS, sine_at=lambda arc_m: np.zeros(arc_m.shape)
    )
    np.testing.assert_allclose(found.force_mps2[13:17], 0.0, atol=0.03)


@pytest.mark.requirement("E2")
def test_a_wheel_without_direction_is_so_called_and_a_slow_one_says_nothing() -> None:
    found, _, _ = sensor_epochs(_samples(direction=0), EPOCHS, bent_line(), SensorState.empty(), limits=LIMITS)
    assert found.wheel_sign == "unknown"
    slow, _, _ = sensor_epochs(_samples(0.2), EPOCHS, bent_line(), SensorState.empty(), limits=LIMITS)
    assert slow.wheel_m is not None
    assert np.isnan(slow.wheel_m).all()


@pytest.mark.requirement("E5")
def test_no_way_before_the_first_pulse_nor_over_a_gap() -> None:
    samples = _samples()
    pulses = samples.tachometer
    late = pulses.time > START + timedelta(np.array(5.5))
    started = TachometerPulses(time=pulses.time[late], pulse=pulses.pulse[late], direction=pulses.direction[late])
    found, _, _ = sensor_epochs(
        replace(samples, tachometer=started), EPOCHS, bent_line(), SensorState.empty(), limits=LIMITS
    )
    assert found.wheel_m is not None
    assert np.isfinite(found.wheel_m).tolist() == [False] * 6 + [True] * 13
    far = EPOCHS[[0, 1, 18]]
    gap, _, _ = sensor_epochs(samples, far, bent_line(), SensorState.empty(), limits=LIMITS)
    for way in (gap.wheel_m, gap.radar_m, gap.force_mps2):
        assert way is not None
        assert np.isfinite(way).tolist() == [False, True, False]


@pytest.mark.requirement("E2")
def test_no_way_over_a_lost_or_a_doubled_pulse() -> None:
    samples = _samples()
    time = samples.tachometer.time
    lost = int(np.searchsorted(time, START + timedelta(np.array(14.5))))
    doubled = int(np.searchsorted(time, START + timedelta(np.array(9.5))))
    halfway = time[doubled] + (time[doubled + 1] - time[doubled]) // 2
    time = np.sort(np.append(np.delete(time, lost), halfway))
    pulses = TachometerPulses(time=time, pulse=np.arange(1, len(time) + 1), direction=np.ones(len(time), dtype=int))
    found, _, _ = sensor_epochs(
        replace(samples, tachometer=pulses), EPOCHS, bent_line(), SensorState.empty(), limits=LIMITS
    )
    assert found.wheel_m is not None
    # Epoch k is at k + 1 seconds; the first epoch has no way.
    assert np.flatnonzero(np.isnan(found.wheel_m)).tolist() == [0, 9, 14]


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("cuts", [[1], [3, 4, 11], list(range(1, 19))])
def test_any_cutting_gives_the_same(cuts: list[int]) -> None:
    samples, line = _samples(), bent_line()
    speed = 10.0 + np.sin(np.arange(len(samples.radar.time)))
    samples = replace(samples, radar=RadarSpeeds(time=samples.radar.time, speed_mps=speed))
    whole, _, _ = sensor_epochs(samples, EPOCHS, line, SensorState.empty(), limits=LIMITS)
    state, received, parts = SensorState.empty(), np.datetime64("NaT", "ns"), []
    for begin, end in zip([0, *cuts], [*cuts, len(EPOCHS)], strict=True):
        now = EPOCHS[end - 1]
        part, _, state = sensor_epochs(samples.between(received, now), EPOCHS[begin:end], line, state, limits=LIMITS)
        received = now
        parts.append(part)
        # Of a long log only the samples that the next epoch needs are kept.
        assert len(state.samples.radar) <= 2
        assert len(state.samples.inertial) <= 42
    for name in ("wheel_m", "radar_m", "force_mps2"):
        np.testing.assert_allclose(np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name), atol=1e-9)


@pytest.mark.requirement("E2")
def test_tables_are_read_and_bad_ones_named(tmp_path: Path) -> None:
    good = tmp_path / "pulses.csv"
    good.write_text("time_gpst,pulse\n2024-03-05T03:10:00.1,1\n2024-03-05T03:10:00.2,2\n")
    assert len(read_sensors(tachometer=good).tachometer) == 2
    beating = tmp_path / "beating.csv"
    beating.write_text(
        "time_gpst,pulse,direction\n2024-03-05T03:10:00.1,1,1\n2024-03-05T03:10:00.2,,\n2024-03-05T03:10:00.3,2,\n"
    )
    found = read_sensors(tachometer=beating).tachometer
    assert found.pulse.tolist() == [1, 2]
    assert found.direction.tolist() == [1, 0]
    beating.write_text("time_gpst,pulse,direction\n2024-03-05T03:10:00.1,1,1\n2024-03-05T03:10:00.2,,1\n")
    with pytest.raises(InputFileError, match="row 3: pulse is None, a number was expected"):
        read_sensors(tachometer=beating)
    beating.write_text("time_gpst,pulse\n2024-03-05T03:10:00.1,\n")
    with pytest.raises(InputFileError, match="has times but no values of the tachometer"):
        read_sensors(tachometer=beating)
    bad = tmp_path / "bad.csv"
    bad.write_text("time_gpst,count\n2024-03-05T03:10:00.1,1\n")
    with pytest.raises(InputFileError, match="has no column pulse"):
        read_sensors(tachometer=bad)
    back = tmp_path / "back.csv"
    back.write_text("time_gpst,pulse\n2024-03-05T03:10:00.2,1\n2024-03-05T03:10:00.1,2\n")
    with pytest.raises(InputFileError, match="falls"):
        read_sensors(tachometer=back)


@pytest.mark.requirement("E4")
def test_ranges_and_ground_units_are_read_and_held_against_each_other(tmp_path: Path) -> None:
    ranges, units = tmp_path / "ranges.csv", tmp_path / "units.csv"
    ranges.write_text("time_gpst,unit,range_m\n2024-03-05T03:10:00.1,A,55.1\n2024-03-05T03:10:00.3,B,40.2\n")
    units.write_text("unit,x_m,y_m,z_m\nA,1.0,2.0,3.0\nB,4.0,5.0,6.0\n")
    samples, surveyed = read_sensors(ranging=ranges), read_units(units)
    assert samples.ranging.station.tolist() == ["A", "B"]
    assert np.isnan(samples.ranging.sigma_m).all()
    np.testing.assert_array_equal(surveyed.ecef_m[1], [4.0, 5.0, 6.0])
    assert units_of_ranges(samples, None, ranging=None) is None
    found = units_of_ranges(samples, units, ranging=ranges)
    np.testing.assert_array_equal(found.ecef_m, surveyed.ecef_m)
    with pytest.raises(SettingsError, match="--ranging needs --ranging-units"):
        units_of_ranges(samples, None, ranging=ranges)
    with pytest.raises(SettingsError, match="--ranging-units is given without --ranging"):
        units_of_ranges(samples, units, ranging=None)
    units.write_text("unit,x_m,y_m,z_m\nA,1.0,2.0,3.0\n")
    with pytest.raises(MismatchError, match=r"the ground unit B, and .*units.csv has no such unit"):
        units_of_ranges(samples, units, ranging=ranges)
    units.write_text("unit,x_m,y_m,z_m\nA,1.0,2.0,3.0\nA,4.0,5.0,6.0\n")
    with pytest.raises(InputFileError, match="names unit A twice"):
        read_units(units)
    units.write_text("unit,x_m,y_m\nA,1.0,2.0\n")
    with pytest.raises(InputFileError, match="has no column z_m"):
        read_units(units)


def _ridden(
    line: LineFeatures, arc_m: np.ndarray, facing: float, cuts: list[int], slid_m: float = 0.0
) -> list[tuple[int, str, float]]:
    """Verdicts on features along places of a body, 0.1 s apart, in chunks that end at ticks; a slide is at 1000 m."""
    series = line.series
    curvature = np.interp(arc_m, series.arc_m, series.curvature_1pm)
    pitch = facing * np.arctan(np.interp(arc_m, series.arc_m, series.gradient))
    steps = np.diff(arc_m)
    slides = slid_m * np.diff(np.sign(arc_m - 1000.0)) / 2.0
    when = START + timedelta(0.1 * np.arange(len(steps)))
    rates = RateSeries(
        time=when, known=when, distance_m=np.cumsum(steps + slides), arc_m=arc_m[1:] + 2.0,
        turned_rad=0.5 * (curvature[1:] + curvature[:-1]) * steps, climbed_rad=np.diff(pitch), speed_mps=10.0 * steps,
        rolls=np.ones(len(steps), dtype=bool),
    )  # fmt: skip
    state, found = FeatureState(), []
    for first, last in pairwise([0, *cuts, len(steps)]):
        part = replace(rates, **{f.name: getattr(rates, f.name)[first:last] for f in fields(RateSeries)})
        part = replace(part, distance_m=part.distance_m - (rates.distance_m[first - 1] if first else 0.0))
        fixes, state = feature_fixes(part, line, facing, 6.0, state, noise=(1e-3, 1e-4))
        found += [(fix.tick + first, fix.located.verdict, fix.correction_m) for fix in fixes]
    return found


@pytest.mark.requirement("E3")
@pytest.mark.parametrize("facing", [1.0, -1.0])
@pytest.mark.parametrize("falling", [False, True])
def test_features_are_placed_alike_however_the_ride_is_cut_and_the_vehicle_faces(facing: float, falling: bool) -> None:
    """The wheel has the body 2 m too far; two ends of a curve, a top and a dip are on the way."""
    arc = np.arange(0.0, 2000.0)
    slope = 0.02 / (1.0 + np.exp(-(arc - 800.0) / 4.0)) - 0.015 / (1.0 + np.exp(-(arc - 1200.0) / 4.0))
    series = LineSeries(arc_m=arc, gradient=slope, curvature_1pm=np.where((arc > 500.0) & (arc < 1500.0), 2e-3, 0.0))
    features = tuple(map_features(series))
    line = LineFeatures(series=series, features=features, antenna_m=arc, body_m=arc, line=Line(bent_line()))
    way = np.arange(300.0, 1750.0, 1.3)
    way = way[::-1] if falling else way
    whole = _ridden(line, way, facing, [])
    assert [verdict for _, verdict, _ in whole] == ["accepted"] * 4
    np.testing.assert_allclose([correction for *_, correction in whole], -2.0, atol=0.5)
    for cuts in ([300], [130, 131, 500, 800], list(range(40, 1100, 40))):
        cut = _ridden(line, way, facing, cuts)
        assert [found[:2] for found in cut] == [found[:2] for found in whole]
        np.testing.assert_allclose([found[2] for found in cut], [found[2] for found in whole], atol=1e-6)
        slid = _ridden(line, way, facing, cuts, 15.0)
        assert [verdict for _, verdict, _ in slid] == ["accepted", "accepted", "none", "none"]


@pytest.mark.requirement("E4", "E5")
def test_ranges_are_held_against_the_place_of_the_unit_on_the_vehicle() -> None:
    """Its unit is 3 m ahead, 4 m to the right and 6 m below the antenna; echoes come late, and nothing comes early."""
    line, lever = Line(bent_line()), np.array([3.0, 4.0, -6.0])
    time = START + timedelta(np.array([1.0, 2.0]))
    fixed = FilterFix(time=START, arc_m=500.0, sigma_m=0.05, speed_mps=10.0)
    age = np.array([[0.25, 0.0], [0.0, 0.5]])
    at = fixed.arc_m + 10.0 * (np.array([[1.0], [2.0]]) - age)
    point, axes = line.at((at + lever[0]).ravel())
    own = point + lever[1] * axes[:, 1] + lever[2] * axes[:, 2]
    unit = own + 25.0 * axes[:, 1] + 5.0 * axes[:, 2] + 8.0 * axes[:, 0]
    distance = np.linalg.norm(unit - own, axis=1).reshape(2, 2)
    config = parse_config({"tracking": {"acceleration_mps2": 0.01}})
    state = replace(FilterState(), anchor=fixed)
    for error, kept in ((0.0, True), (0.5, True), (1.0, False), (-1.0, False)):
        ranges = RangeEpochs(
            range_m=distance + error, sigma_m=np.full((2, 2), 0.1), age_s=age, unit_ecef_m=unit.reshape(2, 2, 3),
            lever_m=lever,
        )  # fmt: skip
        gated = _gated_ranges(ranges, time, line, state, config)
        assert (np.isfinite(gated.range_m) == kept).all(), error
        assert np.isnan(_gated_ranges(ranges, time, line, FilterState(), config).range_m).all()


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("status", list(TrackStatus))
def test_what_sensors_carry_begins_from_a_place_that_the_filter_has_decided_on(status: TrackStatus) -> None:
    empty = Tracked.empty(EPOCHS[:2], 0)
    values = {name: np.full(2, value) for name, value in (("arc_m", 7.0), ("sigma_m", 2.0), ("speed_mps", 3.0))}
    fixed = _find_fix(replace(empty, status=np.full(2, status, dtype=np.int8), **values))
    decided = status in (TrackStatus.TRACKING, TrackStatus.COASTING)
    assert fixed.arc_at(EPOCHS[2]) == pytest.approx(10.0 if decided else np.nan, nan_ok=True)
    assert (fixed.time, fixed.sigma_m) == (EPOCHS[1], 2.0)
    again = _restart_state(replace(FilterState(), gate=ReturnState(place_m=1.0, sigma_m=9.0, distance_m=5.0)), fixed)
    assert (again.anchor, again.gate.sigma_m, again.gate.distance_m) == (fixed, 2.0, 0.0)
    assert again.gate.place_m == pytest.approx(fixed.arc_m, nan_ok=True)
