"""Satellite positions, velocities and clocks against second formulas; NaN, chunks and masks."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import orbit_cases
from orbit_cases import HOUR, KINDS, TOE, glonass, kepler, navigation
from railfix.core.arrays import read_only
from railfix.core.constants import (
    EARTH_ROTATION_RATE,
    EARTH_ROTATION_RATE_BEIDOU,
    EARTH_ROTATION_RATE_GLONASS,
    GM_GALILEO,
    GM_GLONASS,
    GM_GPS,
    PZ90_J2,
    PZ90_SEMI_MAJOR_AXIS,
    SPEED_OF_LIGHT,
)
from railfix.gnss.navigation import KeplerRecords, Navigation
from railfix.gnss.orbits import SatelliteStates, satellite_states
from railfix.gnss.orbits.ephemerides import Orbits, eccentric_anomaly, kepler_state

CODE = 23_456_789.012
ALL = (*KINDS, "R07")


def at(after_toe_s: Any) -> np.ndarray:
    return TOE + np.rint(np.atleast_1d(after_toe_s) * 1e9).astype("timedelta64[ns]")


def states(
    nav: Navigation, after_toe_s: Any, satellite: str = "G05", signal: str = "1C", code_m: float = CODE, **more: Any
) -> SatelliteStates:
    time = at(after_toe_s)
    code = read_only(np.full((len(time), 1), code_m))
    return satellite_states(read_only(time), read_only(np.array([satellite])), np.array([signal]), code, nav, **more)


def textbook(record: KeplerRecords, t: float) -> tuple[np.ndarray, float]:
    """IS-GPS-200 table 20-IV and BDS-SIS-ICD 5.2.4.12, one line a step with the math library: position, sin E."""
    r = {item.name: getattr(record, item.name)[0] for item in fields(record)}
    beidou, gps = r["satellite"][0] == "C", r["satellite"][0] in "GJ"
    gm, turn = (GM_GPS if gps else GM_GALILEO), (EARTH_ROTATION_RATE_BEIDOU if beidou else EARTH_ROTATION_RATE)
    a, e = r["sqrt_a"] ** 2, r["eccentricity"]
    mean = r["m0"] + (math.sqrt(gm / a**3) + r["delta_n"]) * t
    big_e = mean
    for _ in range(200):
        big_e = mean + e * math.sin(big_e)
    true = 2.0 * math.atan2(math.sqrt(1 + e) * math.sin(big_e / 2), math.sqrt(1 - e) * math.cos(big_e / 2))
    phi = true + r["omega"]
    u = phi + r["cus"] * math.sin(2 * phi) + r["cuc"] * math.cos(2 * phi)
    radius = a * (1 - e * math.cos(big_e)) + r["crs"] * math.sin(2 * phi) + r["crc"] * math.cos(2 * phi)
    i = r["i0"] + r["i_dot"] * t + r["cis"] * math.sin(2 * phi) + r["cic"] * math.cos(2 * phi)
    geo = r["satellite"] in ("C03",)
    node = r["omega0"] + (r["omega_dot"] - (0.0 if geo else turn)) * t - turn * r["toe_sow_s"]
    in_plane = radius * np.array([math.cos(u), math.sin(u), 0.0])
    place = about_z(-node) @ about_x(-i) @ in_plane
    if geo:
        place = about_z(turn * t) @ about_x(math.radians(-5.0)) @ place
    return place, math.sin(big_e)


def about_x(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1, 0, 0], [0, c, s], [0, -s, c]])


def about_z(angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])


@pytest.mark.requirement("A7")
@pytest.mark.parametrize("satellite", list(KINDS))
def test_position_is_that_of_the_interface_document(satellite: str) -> None:
    records = kepler({"satellite": satellite})
    for t in (-7200.0, -1.5, 0.0, 3333.25, 7200.0):
        position, _, relativity = kepler_state(Orbits.from_records(records), np.array([t]))
        expected, sin_e = textbook(records, t)
        assert np.linalg.norm(np.array(position)[:, 0] - expected) < 1e-5
        gm = GM_GPS if satellite[0] in "GJ" else GM_GALILEO
        f = -2.0 * math.sqrt(gm) / SPEED_OF_LIGHT**2
        expected_s = f * records.eccentricity[0] * records.sqrt_a[0] * sin_e
        assert relativity[0] == pytest.approx(expected_s, abs=1e-18)


@pytest.mark.requirement("A7")
@pytest.mark.parametrize("satellite", ALL)
def test_velocity_is_the_derivative_of_position(satellite: str) -> None:
    nav = navigation({"satellite": satellite, "af1": 0.0} if satellite != "R07" else {"satellite": satellite})
    step = 0.5
    t = np.array([-1500.0, -30.0, 0.25, 700.0, 1500.0])
    found, before, after = (states(nav, t + d, satellite) for d in (0.0, -step, step))
    numeric = (after.position_ecef_m - before.position_ecef_m) / (2 * step)
    assert np.abs(numeric - found.velocity_ecef_mps).max() < 1e-5


def test_kepler_equation_holds_to_the_last_digit() -> None:
    mean, e = np.meshgrid(np.linspace(-7.0, 7.0, 1001), [0.0, 0.002, 0.02, 0.075, 0.17])
    anomaly, sine, cosine = eccentric_anomaly(mean, e)
    assert np.abs(anomaly - e * np.sin(anomaly) - mean).max() < 2e-13
    assert np.abs(sine - np.sin(anomaly)).max() < 1e-15
    assert np.abs(cosine - np.cos(anomaly)).max() < 1e-15


def test_glonass_is_the_solution_of_the_equations_of_motion() -> None:
    """Against an adaptive integrator of order 8 in another form: the potential's gradient, inertial frame of toe."""
    records = glonass({"satellite": "R07"})
    omega = np.array([0.0, 0.0, EARTH_ROTATION_RATE_GLONASS])
    fixed = records.acceleration_ecef_mps2[0]

    def rate(t: float, y: np.ndarray) -> np.ndarray:
        x, v = y[:3], y[3:]
        r = np.linalg.norm(x)
        down = np.array([0.0, 0.0, 1.0])
        oblate = 1.5 * PZ90_J2 * GM_GLONASS * PZ90_SEMI_MAJOR_AXIS**2 / r**4
        unit = x / r
        sine = unit @ down
        gravity = -GM_GLONASS / r**2 * unit + oblate * ((5 * sine**2 - 1) * unit - 2 * sine * down)
        turn = about_z(EARTH_ROTATION_RATE_GLONASS * t)
        return np.concatenate([v, gravity + turn.T @ fixed])

    start = np.concatenate(
        [records.position_ecef_m[0], records.velocity_ecef_mps[0] + np.cross(omega, records.position_ecef_m[0])]
    )
    nav = navigation({"satellite": "R07", "clock_bias_s": 0.0, "relative_frequency": 0.0})
    for t in (-1750.0, -30.0, 61.0, 900.0, 1750.0):
        solution = solve_ivp(rate, (0.0, t), start, method="DOP853", rtol=1e-13, atol=1e-6).y[:, -1]
        turn = about_z(EARTH_ROTATION_RATE_GLONASS * t)
        place = turn @ solution[:3]
        speed = turn @ solution[3:] - np.cross(omega, place)
        found = states(nav, t, "R07", code_m=0.0)
        # 1.3 mm after half an hour: the fourth order with steps of 60 s, as the ICD has it.
        assert np.linalg.norm(found.position_ecef_m[0, 0] - place) < 2e-3
        assert np.linalg.norm(found.velocity_ecef_mps[0, 0] - speed) < 2e-6


def test_instant_of_transmission_needs_the_satellite_clock_and_not_the_receivers() -> None:
    """The same signal tagged by a receiver 1 ms fast: tag and code move together, the satellite does not."""
    nav = navigation({"satellite": "E11"})
    exact = states(nav, 1000.0, "E11", code_m=2.4e7)
    fast = states(nav, 1000.0 + 1e-3, "E11", code_m=2.4e7 + 1e-3 * SPEED_OF_LIGHT)
    assert np.abs(fast.position_ecef_m - exact.position_ecef_m).max() < 1e-5
    slow_clock = states(navigation({"satellite": "E11", "af0_s": 0.0, "af1": 0.0}), 1000.0, "E11", code_m=2.4e7)
    moved = np.linalg.norm(slow_clock.position_ecef_m - exact.position_ecef_m)
    assert moved == pytest.approx(2.5e-4 * np.linalg.norm(exact.velocity_ecef_mps), rel=1e-3)


def test_clock_is_polynomial_plus_relativity() -> None:
    nav = navigation({"satellite": "G05", "af2": 1e-17, "toc": TOE - HOUR})
    found = states(nav, 600.0, code_m=0.0)
    t = 4200.0 - (-2.5e-4)
    t = 4200.0 - (-2.5e-4 + 3.1e-12 * t + 1e-17 * t * t)
    _, sin_e = textbook(nav.kepler, t - 3600.0)
    relativity = -4.442807633e-10 * 0.0059 * 5153.65 * sin_e
    expected = SPEED_OF_LIGHT * (-2.5e-4 + 3.1e-12 * t + 1e-17 * t * t + relativity)
    assert found.clock_m[0, 0] == pytest.approx(expected, abs=1e-5)


def mixed() -> tuple[Navigation, np.ndarray, np.ndarray]:
    rows: list[dict[str, Any]] = []
    for name in ALL:
        for hour in range(-2, 3):
            toe = TOE + hour * (HOUR if name != "R07" else HOUR // 2)
            rows.append({"satellite": name, "toe": toe, "transmitted": toe - HOUR // 3})
    channels = [(name, "2I" if name[0] == "C" else "1C") for name in ALL] + [
        ("G05", "2W"),
        ("E11", "5Q"),
        ("G31", "1C"),
    ]
    return navigation(*rows), np.array([c[0] for c in channels]), np.array([c[1] for c in channels])


def test_absent_codes_give_nan_and_no_mask() -> None:
    nav, satellite, signal = mixed()
    code = np.full((120, len(satellite)), np.nan)
    found = satellite_states(at(np.arange(120.0)), satellite, signal, code, nav)
    for name in ("position_ecef_m", "velocity_ecef_mps", "clock_m", "age_s", "accuracy_m"):
        assert np.isnan(getattr(found, name)).all(), name
    assert not found.too_old.any()
    assert not found.unhealthy.any()
    assert found.no_record.all(axis=0).tolist() == [s == "G31" for s in satellite]


def test_results_are_read_only_and_shapes_are_checked() -> None:
    nav = navigation({"satellite": "G05"})
    assert not states(nav, 0.0).clock_m.flags.writeable
    with pytest.raises(ValueError, match="code_m"):
        satellite_states(at([0.0, 1.0]), np.array(["G05"]), np.array(["1C"]), np.zeros((1, 1)), nav)
    with pytest.raises(ValueError, match="signal"):
        satellite_states(at([0.0]), np.array(["G05"]), np.array(["1C", "2W"]), np.zeros((1, 1)), nav)


def test_no_epochs_and_no_records_are_allowed() -> None:
    nav = navigation({"satellite": "G05"})
    none = satellite_states(at([0.0])[:0], np.array(["G05"]), np.array(["1C"]), np.empty((0, 1)), nav)
    assert none.position_ecef_m.shape == (0, 1, 3)
    empty = replace(nav, kepler=orbit_cases.kepler())
    found = states(empty, 0.0)
    assert found.no_record.all()
    assert np.isnan(found.position_ecef_m).all()
