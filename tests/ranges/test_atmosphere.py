"""Ionosphere and troposphere against an independent program, second formulas and physical limits."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from orbit_cases import TOE
from railfix.core.arrays import read_only
from railfix.core.constants import CARRIER_FREQUENCY, FREQUENCY_L1, SPEED_OF_LIGHT
from railfix.ranges.atmosphere import TYPICAL_KLOBUCHAR, klobuchar_delay_m, saastamoinen_delay_m

REFERENCES = json.loads((Path(__file__).parents[1] / "references" / "delays.json").read_text())
COEFFICIENTS = np.array(REFERENCES["klobuchar"])
L1 = np.array([FREQUENCY_L1])


def ionosphere(after_toe_s: float, latitude: float, longitude: float, elevation: float, azimuth: float) -> float:
    time = np.array([TOE + np.timedelta64(round(after_toe_s * 1e9), "ns")])
    place = (np.array([latitude]), np.array([longitude]))
    angles = (np.array([[elevation]]), np.array([[azimuth]]))
    return float(klobuchar_delay_m(time, *place, *angles, COEFFICIENTS, L1)[0, 0])


def troposphere(latitude: float, height: float, elevation: float, humidity: float = 0.7) -> float:
    values = (np.array([latitude]), np.array([height]), np.array([[elevation]]))
    return float(saastamoinen_delay_m(*values, relative_humidity=humidity)[0, 0])


@pytest.mark.requirement("A7")
def test_ionosphere_is_that_of_an_independent_program() -> None:
    rows = REFERENCES["ionosphere"]
    assert len(rows) == 108
    names = ("after_toe_s", "latitude_deg", "longitude_deg", "elevation_deg", "azimuth_deg")
    for row in rows:
        assert ionosphere(*(row[n] for n in names)) == pytest.approx(row["delay_m"], abs=1e-6), row


@pytest.mark.requirement("A7")
def test_troposphere_is_that_of_an_independent_program() -> None:
    rows = REFERENCES["troposphere"]
    assert len(rows) == 96
    for row in rows:
        found = troposphere(row["latitude_deg"], row["height_m"], row["elevation_deg"], row["relative_humidity"])
        assert found == pytest.approx(row["delay_m"], abs=1e-6), row


@pytest.mark.parametrize("hour", [2, 9, 14, 19])
def test_typical_coefficients_are_those_of_another_program(hour: int) -> None:
    """RTKLIB's, where its coefficients are all zero."""
    from pyrtklib_orbits import ionosphere_m

    time = np.array([np.datetime64("2021-05-17", "ns") + np.timedelta64(hour, "h")])
    place, angles = (np.array([22.3]), np.array([114.2])), (np.array([[40.0]]), np.array([[130.0]]))
    found = klobuchar_delay_m(time, *place, *angles, TYPICAL_KLOBUCHAR, L1)[0, 0]
    assert found == pytest.approx(ionosphere_m(time[0], (22.3, 114.2), 40.0, 130.0, [0.0] * 8), abs=1e-3)


def by_hand(seconds_of_day: float, latitude: float, longitude: float, elevation: float, azimuth: float) -> float:
    """Figure 20-4 of IS-GPS-200 step by step, in semicircles, for one ray."""
    e, phi_u, lambda_u, a = elevation / 180, latitude / 180, longitude / 180, math.radians(azimuth)
    psi = 0.0137 / (e + 0.11) - 0.022
    phi_i = min(max(phi_u + psi * math.cos(a), -0.416), 0.416)
    lambda_i = lambda_u + psi * math.sin(a) / math.cos(phi_i * math.pi)
    phi_m = phi_i + 0.064 * math.cos((lambda_i - 1.617) * math.pi)
    t = 4.32e4 * lambda_i + seconds_of_day
    while t >= 86400:
        t -= 86400
    while t < 0:
        t += 86400
    per = max(sum(b * phi_m**n for n, b in enumerate(COEFFICIENTS[4:])), 72000)
    amp = max(sum(c * phi_m**n for n, c in enumerate(COEFFICIENTS[:4])), 0)
    x = 2 * math.pi * (t - 50400) / per
    f = 1 + 16 * (0.53 - e) ** 3
    delay = f * (5e-9 + amp * (1 - x**2 / 2 + x**4 / 24)) if abs(x) < 1.57 else f * 5e-9
    return delay * SPEED_OF_LIGHT


@settings(max_examples=60)
@given(
    st.floats(0, 86_399), st.floats(-85, 85), st.floats(-180, 180), st.floats(1, 90), st.floats(0, 360)
)  # fmt: skip
def test_ionosphere_is_the_figure_of_the_interface_document(
    t: float, lat: float, lon: float, el: float, az: float
) -> None:
    of_day = (t + 8 * 3600) % 86_400
    assert ionosphere(t, lat, lon, el, az) == pytest.approx(by_hand(of_day, lat, lon, el, az), abs=1e-5)


def test_other_carriers_scale_by_the_square_of_the_frequency() -> None:
    carriers = np.array([FREQUENCY_L1, CARRIER_FREQUENCY["C"]["2"], CARRIER_FREQUENCY["G"]["5"]])
    angles = (np.full((1, 3), 40.0), np.full((1, 3), 120.0))
    found = klobuchar_delay_m(np.array([TOE]), np.array([35.0]), np.array([139.0]), *angles, COEFFICIENTS, carriers)
    ratio = (found / found[:, :1])[0]
    np.testing.assert_allclose(ratio, [1.0, (1575.42 / 1561.098) ** 2, (154 / 115) ** 2], rtol=1e-12)


def test_absent_inputs_and_the_horizon_give_nan_and_nothing_else_changes() -> None:
    elevation = read_only(np.array([[40.0, np.nan, 0.0, -5.0, 30.0], [40.0, 41.0, 42.0, 43.0, 44.0]]))
    azimuth = read_only(np.array([[10.0, 10.0, 10.0, 10.0, np.nan], [10.0] * 5]))
    time = read_only(np.array([TOE, TOE]))
    latitude, longitude = read_only(np.array([35.0, np.nan])), read_only(np.array([139.0, 139.0]))
    frequency = read_only(np.full(5, FREQUENCY_L1))
    ion = klobuchar_delay_m(time, latitude, longitude, elevation, azimuth, read_only(COEFFICIENTS), frequency)
    assert np.isnan(ion).tolist() == [[False, True, True, True, True], [True] * 5]
    trop = saastamoinen_delay_m(latitude, read_only(np.array([50.0, 50.0])), elevation)
    assert np.isnan(trop).tolist() == [[False, True, True, True, False], [True] * 5]
    assert np.isnan(saastamoinen_delay_m(np.array([35.0]), np.array([np.nan]), np.array([[40.0]]))).all()
    no_frequency = np.array([np.nan] * 5)
    assert np.isnan(klobuchar_delay_m(time, latitude, longitude, elevation, azimuth, COEFFICIENTS, no_frequency)).all()


def test_troposphere_at_sea_level_is_two_and_a_half_metres_and_thins_upward() -> None:
    assert troposphere(45.0, 0.0, 90.0) == pytest.approx(2.3 + 0.13, abs=0.1)
    dry = [troposphere(45.0, h, 90.0, 0.0) for h in (0.0, 1000.0, 3000.0, 8000.0)]
    # The dry part is the pressure: 2.2768 mm a hectopascal; 1013, 899, 701 and 357 hPa in the standard atmosphere.
    np.testing.assert_allclose(dry, np.array([1013.25, 898.76, 701.2, 356.5]) * 2.2768e-3, rtol=4e-3)
    assert troposphere(45.0, 0.0, 30.0) == pytest.approx(2.0 * troposphere(45.0, 0.0, 90.0))


def test_heights_below_the_sea_count_as_sea_level_and_absurd_ones_are_refused() -> None:
    assert troposphere(35.0, -60.0, 50.0) == troposphere(35.0, 0.0, 50.0)
    assert math.isnan(troposphere(35.0, -101.0, 50.0))
    assert math.isnan(troposphere(35.0, 10_001.0, 50.0))


@pytest.mark.requirement("A7")
def test_the_period_of_the_ionosphere_is_20_hours_and_its_amplitude_0_at_least() -> None:
    """At the equator, straight up at 16:00 local: phase 2 pi 7200/72000, cosine 0.8091; 3.0 m of amplitude."""
    time = np.array(["2024-03-03T16:00:00"], dtype="datetime64[ns]")  # a Sunday: 57 600 s of week
    zero, overhead = np.zeros(1), np.full((1, 1), 90.0)

    def delay(alpha: float, beta: float) -> float:
        coefficients = np.array([alpha, 0.0, 0.0, 0.0, beta, 0.0, 0.0, 0.0])
        return float(klobuchar_delay_m(time, zero, zero, overhead, np.zeros((1, 1)), coefficients, L1)[0, 0])

    phase = 2.0 * np.pi * 7200.0 / 72_000.0
    cosine = 1.0 - phase**2 / 2.0 + phase**4 / 24.0
    slant = 1.0 + 16.0 * 0.03**3
    assert delay(1e-8, 0.0) == pytest.approx(SPEED_OF_LIGHT * slant * (5e-9 + 1e-8 * cosine))
    assert delay(1e-8, 5e4) == delay(1e-8, 0.0)
    assert delay(1e-8, 1.5e5) > delay(1e-8, 0.0) > delay(-1e-8, 0.0)
    assert delay(-1e-8, 0.0) == pytest.approx(SPEED_OF_LIGHT * slant * 5e-9)
