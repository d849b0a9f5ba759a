"""Sensors inside the filter along the track, on a simulated ride through a tunnel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from railfix.motion.features import line_series
from railfix.motion.samples import GroundUnits, RadarSpeeds
from railfix.motion.slip import MotionState
from railfix.motion.tachometer import TachometerLimits
from railfix.pipeline.result_tables import antenna_train
from railfix.run.sensor_checks import doppler_speeds, sensor_notes
from railfix.track.trajectory import Trajectory
from railfix.tracking import Kind
from sensed_ride import Ride, ride

#: A tunnel between 61 and 68 s; the wheel slips in it.
RIDE = """{
    "duration_s": 84.0, "rate_hz": 2.0,
    "sensors": {
        "tachometer": {"jitter_s": 2e-6, "lowest_mps": 0.3, "slips": [{"start_s": 62.5, "end_s": 65.0, "ratio": 0.25}]},
        "inertial": UNIT,
        "ranging": {
            "noise_sigma_m": 0.19, "multipath_sigma_m": 0.1, "echo_chance": 0.05,
            "units": [{"name": "A", "chainage_m": 480.0}, {"name": "B", "chainage_m": 500.0, "lateral_m": -3.0}],
        },
    },
}"""
PLACE = {"range_ahead_m": 9.0, "range_above_m": -1.0}
GNSS = ("code", "phase", "doppler")


@pytest.fixture(scope="module")
def case() -> Ride:
    return ride(RIDE)


def tunnel(case: Ride) -> np.ndarray:
    return ~np.isfinite(case.observations.code_m).any(axis=1) & (case.time_s > 50.0)


@pytest.mark.requirement("E5")
def test_any_cutting_of_the_log_gives_the_same(case: Ride) -> None:
    whole = case.run(sensors=PLACE)
    # epoch by epoch in the tunnel, in odd pieces elsewhere
    cuts = [1, 2, 37, 38, 95, *range(118, 142), 150]
    cut = case.run(sensors=PLACE, cuts=cuts)
    np.testing.assert_allclose(cut.chainage_m, whole.chainage_m, atol=1e-6)
    np.testing.assert_array_equal(cut.sensed.state, whole.sensed.state)
    np.testing.assert_array_equal(cut.tracked.used, whole.tracked.used)


@pytest.mark.requirement("E1")
def test_a_slip_in_a_tunnel_is_carried_by_inertia(case: Ride) -> None:
    wheel_alone = case.run(filter_sources=(*GNSS, "wheel"))
    both = case.run(filter_sources=(*GNSS, "wheel", "force"))
    inside = tunnel(case)
    slipping = (case.time_s > 63.0) & (case.time_s < 65.0)
    assert (both.sensed.state[slipping] == MotionState.INERTIAL_SPIN).all()
    assert np.abs(case.error_m(wheel_alone)[inside]).max() > 2.5
    assert np.abs(case.error_m(both)[inside]).max() < 1.0
    table = antenna_train("front", both)
    assert set(table["sources"].to_numpy()[slipping]) == {"force+carry"}
    assert set(table["motion"].cast(str).to_numpy()[slipping]) == {"inertial_spin"}


@pytest.mark.requirement("E4")
def test_ranges_to_ground_units_place_the_train_in_the_tunnel(case: Ride) -> None:
    found = case.run(filter_sources=(*GNSS, "range"), sensors=PLACE)
    inside = tunnel(case)
    ranged = inside & (found.tracked.used[:, Kind.RANGE] > 0)
    assert ranged.sum() >= 0.8 * inside.sum()
    error = case.error_m(found)[ranged]
    assert np.abs(error).max() < 0.6
    assert np.sqrt(np.mean((error / found.tracked.sigma_m[ranged]) ** 2)) < 2.0


@pytest.mark.requirement("E4")
def test_a_unit_surveyed_wrongly_does_not_move_the_train_while_there_are_satellites(case: Ride) -> None:
    far = case.units.ecef_m + 40.0
    moved = Ride(**{**vars(case), "units": GroundUnits(name=case.units.name, ecef_m=far)})
    found = moved.run(filter_sources=(*GNSS, "range"), sensors=PLACE)
    outside = ~tunnel(case) & (case.time_s > 30.0) & (case.time_s < 61.0)
    assert np.abs(case.error_m(found)[outside]).max() < 3.0


@pytest.mark.requirement("E3")
def test_a_curve_of_a_good_map_sharpens_the_place(case: Ride) -> None:
    surveyed = {"map_plan_sigma_m": 0.03, "map_height_sigma_m": 0.03}
    without = case.run(filter_sources=(*GNSS, "wheel", "force"), **surveyed)
    found = case.run(filter_sources=(*GNSS, "wheel", "force", "feature"), **surveyed)
    placed = np.flatnonzero(found.tracked.used[:, Kind.PLACE])
    assert len(placed)
    assert found.tracked.sigma_m[placed[-1]] < without.tracked.sigma_m[placed[-1]]
    np.testing.assert_array_less(np.abs(case.error_m(found)[placed]), 3.0 * found.tracked.sigma_m[placed])
    # a map that is right to 0.3 m and 0.6 m has no feature as sharp as the place by satellites
    assert not case.run(filter_sources=(*GNSS, "wheel", "force", "feature")).tracked.used[:, Kind.PLACE].any()


@pytest.mark.requirement("E5")
@pytest.mark.parametrize("metres", [50.0, -50.0, 20.0])
@pytest.mark.every(3)
def test_a_jump_of_the_satellites_at_the_portal_is_refused(case: Ride, metres: float) -> None:
    jumped = case.jumped(68.0, 78.0, metres)
    after = case.time_s > 61.0
    kept = case.run(observations=jumped, filter_sources=(*GNSS, "wheel", "force"))
    assert np.abs(case.error_m(kept)[after]).max() < 1.0
    # the gate is what refuses it
    open_gate = {"return_sigmas": 1e9}
    moved = case.run(observations=jumped, filter_sources=(*GNSS, "wheel", "force"), sensors=open_gate)
    assert np.abs(case.error_m(moved)[after]).max() > 1.5


@pytest.mark.requirement("E2")
def test_wrong_units_tags_and_diameters_are_told(case: Ride) -> None:
    found = case.run(filter_sources=GNSS)
    speeds = doppler_speeds(antenna_train("front", found))
    limits = TachometerLimits()
    speed, time = np.abs(case.speed_mps), case.observations.time
    right = replace(case.samples, radar=RadarSpeeds(time=time, speed_mps=speed))
    assert sensor_notes(right, speeds, limits) == ()
    kmh = replace(case.samples, radar=RadarSpeeds(time=time, speed_mps=3.6 * speed))
    assert [note for note in sensor_notes(kmh, speeds, limits) if "in km/h" in note and note.startswith("radar")]
    late = replace(case.samples, radar=RadarSpeeds(time=time + np.timedelta64(1, "s"), speed_mps=speed))
    assert "1.0 s late" in " ".join(sensor_notes(late, speeds, limits))
    (note,) = sensor_notes(case.samples, speeds, TachometerLimits(wheel_diameter_m=0.86 * 1.02))
    assert "+2.0 %" in note or "+1.9 %" in note or "+2.1 %" in note
    assert "0.86" in note
    pulses = case.samples.tachometer
    shifted = replace(pulses, time=pulses.time - np.timedelta64(1, "s"))
    assert "1.0 s early" in " ".join(sensor_notes(replace(case.samples, tachometer=shifted), speeds, limits))


@pytest.mark.requirement("E5")
def test_the_innovation_of_each_sensor_stands_in_the_table(case: Ride) -> None:
    found = case.run(sensors=PLACE)
    table = antenna_train("front", found)
    for kind, column in ((Kind.WHEEL, "innovation_wheel_m"), (Kind.FORCE, "innovation_force_mps2")):
        known = np.isfinite(table[column].fill_null(float("nan")).to_numpy())
        assert known[found.tracked.used[:, kind] > 0].all()
        assert known.sum() > 100
    ranged = table["innovation_range_m"].fill_null(float("nan")).to_numpy()[tunnel(case)]
    assert np.nanmedian(np.abs(ranged)) < 1.0


@pytest.mark.requirement("E3")
def test_gradient_curvature_and_cant_are_those_of_the_map(case: Ride) -> None:
    """Under the body's middle, where the map's curvature is even over 30 m (the bodies' bogies are 14 m apart)."""
    found, line = case.run(), case.simulation.line
    track = line.track()
    series = line_series(Trajectory.from_antenna_path(track))
    body = found.chainage_m - case.simulation.scenario.vehicle.front[0]
    curvature, gradient = (np.interp(body, series.arc_m, v) for v in (series.curvature_1pm, series.gradient))
    near = [np.interp(body + d, series.arc_m, series.curvature_1pm) for d in (-15.0, 15.0)]
    sensed = found.sensed
    even = np.isfinite(sensed.curvature_1pm) & (np.abs(np.subtract(*near)) < 2e-4)
    curves = even & (np.abs(curvature) > 1e-3)
    assert even.sum() > 60
    assert curves.sum() > 20
    np.testing.assert_allclose(sensed.curvature_1pm[even], curvature[even], atol=6e-4)  # the map has points
    cant = np.sign(curvature) * np.interp(body, track.chainage_m, np.nan_to_num(track.cant_m))
    np.testing.assert_allclose(sensed.cant_m[even], np.where(curves, cant, 0.0)[even], atol=5e-3)
    off = (sensed.gradient - gradient)[even]  # the accelerometer's offset of 0.02 m/s2 is 2 permille
    assert np.median(off) == pytest.approx(2e-3, abs=5e-4)
    assert np.percentile(np.abs(off - np.median(off)), 90.0) < 3e-3  # not the fifth of a second before a slip is found
    table = antenna_train("front", found)
    np.testing.assert_allclose(table["measured_cant_mm"].to_numpy()[curves], 1e3 * cant[curves], atol=5.0)
    assert np.isnan(sensed.curvature_1pm[~(np.abs(case.speed_mps) > 0.9)]).all()
