"""Group delays of the newer messages: against cases worked by hand from the interface documents, and each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orbit_cases import TOE, kepler, navigation
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.gnss.navigation import Navigation
from railfix.gnss.orbits import satellite_states
from railfix.gnss.orbits.ephemerides import Orbits, kepler_state
from railfix.gnss.orbits.prepared_records import group_delay_s, unhealthy
from railfix.io.rinex import read_navigation
from railfix.ranges.second_codes import group_delay_sigma_m

pytestmark = pytest.mark.requirement("A11")

#: TGD 8.0 ns; ISC of L1 C/A, L2C, L5I5, L5Q5, L1C_D, L1C_P in ns.
CNAV = {"message": "CNAV", "group_delay_1_s": 8e-9, "inter_signal_s": (-1e-9, 6e-9, 2e-9, 4e-9, np.nan, np.nan)}
CNV2 = {**CNAV, "message": "CNV2", "inter_signal_s": (-1e-9, 6e-9, 2e-9, 4e-9, -2e-9, -3e-9)}
#: TGD_B1Cp -2 ns, TGD_B2ap 5 ns; ISC_B1Cd 1 ns, ISC_B2ad -3 ns.
BEIDOU = {
    "group_delay_1_s": -2e-9, "group_delay_2_s": 5e-9, "sqrt_a": 5282.6,
    "inter_signal_s": (1e-9, -3e-9, *(np.nan,) * 4),
}  # fmt: skip


@pytest.mark.parametrize(
    ("satellite", "record", "signal", "nanoseconds"),
    [
        ("G05", CNAV, "1C", 8.0 + 1.0),  # t_L1CA = t - TGD + ISC_L1CA: the delay is TGD - ISC
        ("G05", CNAV, "1W", 8.0),
        ("G05", CNAV, "2W", 8.0 * (77 / 60) ** 2),
        ("G05", CNAV, "2L", 8.0 - 6.0),
        ("G05", CNAV, "5I", 8.0 - 2.0),
        ("J02", CNAV, "5Q", 8.0 - 4.0),
        ("G05", CNAV, "5X", 8.0 - 3.0),
        ("G05", CNV2, "1S", 8.0 + 2.0),
        ("G05", CNV2, "1L", 8.0 + 3.0),
        ("G05", {"group_delay_1_s": 8e-9}, "5Q", 8.0),
        ("G05", {"group_delay_1_s": 8e-9}, "2L", 8.0 * (77 / 60) ** 2),
        ("C20", {**BEIDOU, "message": "CNV1"}, "1P", -2.0),
        ("C20", {**BEIDOU, "message": "CNV1"}, "1D", -2.0 + 1.0),
        ("C20", {**BEIDOU, "message": "CNV1"}, "5X", 5.0),
        ("C20", {**BEIDOU, "message": "CNV2"}, "5D", 5.0 - 3.0),
        ("C20", {**BEIDOU, "message": "CNV3"}, "7D", -2.0),
        ("C20", {**BEIDOU, "message": "CNV1"}, "6I", 0.0),
        ("C20", {**BEIDOU, "message": "CNV1"}, "2I", np.nan),
        ("C20", {**BEIDOU, "message": "CNV3"}, "5P", np.nan),
        ("C20", BEIDOU, "5P", np.nan),
    ],
)
def test_group_delays_by_hand(satellite: str, record: dict[str, Any], signal: str, nanoseconds: float) -> None:
    """To 1 cm; IS-GPS-200 30.3.3.3.1.1, IS-GPS-705 20.3.3.3.1.2, IS-GPS-800 3.5.3.9, BDS B1C and B2a ICD 7.6."""
    got = group_delay_s(kepler({"satellite": satellite, **record}), signal)[0] * SPEED_OF_LIGHT
    assert got == pytest.approx(nanoseconds * 1e-9 * SPEED_OF_LIGHT, abs=0.01, nan_ok=True)


def test_sigma_of_delays_without_their_corrections() -> None:
    legacy, modern = kepler({"satellite": "G05"}), kepler({"satellite": "G05", **CNAV})
    assert [float(group_delay_sigma_m(legacy, s)[0]) for s in ("1C", "2W", "2L", "5Q")] == [0.0, 0.0, 0.3, 0.6]
    assert not any(group_delay_sigma_m(modern, s).any() for s in ("1C", "2L", "5Q"))


def test_health_by_band_in_cnav() -> None:
    assert [bool(unhealthy(kepler({"satellite": "G05", **CNAV, "health": 1}), s)[0]) for s in ("1C", "2L", "5Q")] == [
        False, False, True,
    ]  # fmt: skip


def test_each_signal_uses_the_message_with_its_delay() -> None:
    def delay_m(records: Navigation, signal: str) -> float:
        code = np.full((1, 1), 2.2e7)
        states = satellite_states(np.array([TOE]), np.array(["G05"]), np.array([signal]), code, records)
        return float(states.group_delay_m[0, 0])

    both = navigation({"satellite": "G05", "group_delay_1_s": 7e-9}, {"satellite": "G05", **CNAV})
    light = 1e-9 * SPEED_OF_LIGHT
    assert delay_m(both, "1C") == pytest.approx(7 * light)
    assert delay_m(both, "5Q") == pytest.approx(4 * light)
    alone = navigation({"satellite": "G05", **CNAV})
    assert delay_m(alone, "1C") == pytest.approx(9 * light)


def test_rates_of_axis_and_motion_are_in_position_and_velocity() -> None:
    """The velocity is the derivative of the position, and an hour of both rates moves the satellite by so much."""
    records = kepler({"satellite": "G05", "a_dot": 1e-2, "delta_n_dot": 5e-14}, {"satellite": "G05"})
    orbits = Orbits.from_records(records)
    moving, still = (orbits.take(np.array([i])) for i in range(2))
    at = np.array([3600.0])
    (before, _, _), (_, velocity, _), (after, _, _) = (kepler_state(moving, at + d) for d in (-0.5, 0.0, 0.5))
    assert np.ravel(after) - np.ravel(before) == pytest.approx(np.ravel(velocity), abs=1e-4)
    difference = np.ravel(kepler_state(moving, at)[0]) - np.ravel(kepler_state(still, at)[0])
    # Outward by A_dot t, forward by A delta_n_dot t^2 / 2: 36 m and 26.56e6 * 0.5 * 5e-14 * 3600^2 = 8.6 m.
    assert np.linalg.norm(difference) == pytest.approx(np.hypot(36.0, 8.6), rel=0.02)


@pytest.fixture(scope="module")
def version_4(recordings: Path) -> Navigation:
    return read_navigation(recordings / "sbas" / "msas_20250215" / "046r_rnx.nav")


@pytest.mark.parametrize(
    ("message", "other", "position_m", "clock_m"),
    [("CNAV", "LNAV", 1.0, 1.5), ("FNAV", "INAV", 0.01, 0.5), ("CNV3", "CNV1", 0.1, 1.0), ("CNV2", "CNV1", 0.01, 0.01)],
)
def test_messages_of_one_satellite_agree(
    version_4: Navigation, message: str, other: str, position_m: float, clock_m: float
) -> None:
    """Orbit and clock of a message against those of another one, a quarter of an hour after the middle of their toe."""
    records = version_4.kepler
    orbits = Orbits.from_records(records)
    compared = 0
    for i in np.flatnonzero(records.message == message):
        same = np.flatnonzero((records.satellite == records.satellite[i]) & (records.message == other))
        if not len(same):
            continue
        j = same[np.argmin(np.abs(records.toe[same] - records.toe[i]))]
        time = records.toe[i] + (records.toe[j] - records.toe[i]) // 2 + np.timedelta64(900, "s")
        age, since_toc = (((time - t[[i, j]]) / np.timedelta64(1, "s")) for t in (records.toe, records.toc))
        position, _, _ = kepler_state(orbits.take(np.array([i, j])), age)
        assert np.linalg.norm(np.diff(position, axis=1)) < position_m
        assert abs(np.diff(records.af0_s[[i, j]] + records.af1[[i, j]] * since_toc)[0]) * SPEED_OF_LIGHT < clock_m
        compared += 1
    assert compared >= 18


def test_sigmas_without_corrections_are_what_satellites_show(version_4: Navigation) -> None:
    """TGD - ISC of CNAV, less what `group_delay_s` has without them, over the satellites that send it."""
    records = version_4.kepler
    kept = (records.message == "CNAV") & (records.satellite.astype("<U1") == "G")
    tgd, isc = records.group_delay_1_s, records.inter_signal_s
    for column, legacy, signal in ((1, tgd * (77 / 60) ** 2, "2L"), (3, tgd, "5Q")):
        difference = np.unique((tgd - isc[:, column] - legacy)[kept & (isc[:, column] != 0.0)]) * SPEED_OF_LIGHT
        sigma = float(group_delay_sigma_m(kepler({"satellite": "G05"}), signal)[0])
        assert 0.6 * sigma < np.sqrt(np.mean(difference**2)) < 1.1 * sigma
