"""Sensor samples as measurements at the epochs of an antenna, however they are cut."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from railfix.core.errors import InputFileError, MismatchError, SettingsError
from railfix.core.timescale import timedelta
from railfix.motion.samples import InertialSamples, RadarSpeeds, SensorSamples, TachometerPulses
from railfix.pipeline.sensor_epochs import SensorLimits, SensorState, ranging_lever_m, sensor_epochs
from railfix.run.sensors import read_sensors, read_units, units_of_ranges
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
    assert found.wheel_m is not None
    assert found.radar_m is not None
    assert found.force_mps2 is not None
    np.testing.assert_allclose(found.wheel_m[1:], 10.0, atol=1e-3)
    np.testing.assert_allclose(found.radar_m[1:], 10.0, atol=1e-9)
    t = np.arange(1.0, SECONDS)
    np.testing.assert_allclose(found.force_mps2[1:], 0.05 * (np.cos(t[:-1]) - np.cos(t[1:])), atol=5e-4)
    assert found.wheel_sign == "measured"


@pytest.mark.requirement("E5")
def test_the_front_toward_falling_chainage_turns_the_signs() -> None:
    falling = replace(bent_line(), facing="falling")
    found, _, _ = sensor_epochs(_samples(), EPOCHS, falling, SensorState.empty(), limits=LIMITS)
    assert found.wheel_m is not None
    assert found.radar_m is not None
    assert (found.wheel_m[1:] < 0).all()
    assert (found.radar_m[1:] < 0).all()


@pytest.mark.requirement("E5")
def test_the_force_and_the_place_of_the_ranging_unit_turn_with_the_front() -> None:
    falling = replace(bent_line(), facing="falling")
    both = [
        sensor_epochs(_samples(), EPOCHS, line, SensorState.empty(), limits=LIMITS, sources=("force",))[0].force_mps2
        for line in (bent_line(), falling)
    ]
    assert both[0] is not None
    assert both[1] is not None
    assert np.abs(both[0][1:]).max() > 0.02
    np.testing.assert_array_equal(both[1], -both[0])
    limits = SensorLimits(range_ahead_m=9.0, range_right_m=1.2, range_above_m=-1.0)
    np.testing.assert_allclose(ranging_lever_m(bent_line(), limits), [9.0, 1.2, -1.0])
    np.testing.assert_allclose(ranging_lever_m(falling, limits), [-9.0, -1.2, -1.0])
    behind = replace(falling, body_chainage_m=falling.chainage_m + 7.0)
    np.testing.assert_allclose(ranging_lever_m(behind, limits), [-2.0, -1.2, -1.0])


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
    with pytest.raises(InputFileError, match="has no row of the tachometer but its time"):
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
    assert found is not None
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
