"""States of satellites by pyrtklib5 (RTKLIB in C), an independent program; development only."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

rtk = pytest.importorskip("pyrtklib5", reason="pyrtklib5 (the oracle) is not installed")
_SYSTEMS = {"G": rtk.SYS_GPS, "J": rtk.SYS_QZS, "E": rtk.SYS_GAL, "C": rtk.SYS_CMP, "R": rtk.SYS_GLO}


def week_and_second(time: np.datetime64) -> tuple[int, float]:
    """Week of GPS time, and seconds of it."""
    week, rest = divmod(int((time - np.datetime64("1980-01-06T00:00:00", "ns")).astype(np.int64)), 604_800_000_000_000)
    return week, rest / 1e9


def instant(time: np.datetime64) -> Any:
    return rtk.gpst2time(*week_and_second(time))


def satellite_number(name: str) -> int:
    return int(rtk.satno(_SYSTEMS[name[0]], int(name[1:]) + (192 if name[0] == "J" else 0)))


def state(ephemeris: Any, time: np.datetime64, code_m: float) -> tuple[list[float], float]:
    """Position [m] and clock [m] at the instant of transmission of a code, as RTKLIB's satposs finds it."""
    is_glonass = isinstance(ephemeris, rtk.geph_t)
    sent = rtk.timeadd(instant(time), -code_m / rtk.CLIGHT)
    clock = rtk.geph2clk(sent, ephemeris) if is_glonass else rtk.eph2clk(sent, ephemeris)
    sent = rtk.timeadd(sent, -clock)
    place, bias, variance = rtk.Arr1Ddouble(3), rtk.Arr1Ddouble(1), rtk.Arr1Ddouble(1)
    (rtk.geph2pos if is_glonass else rtk.eph2pos)(sent, ephemeris, place, bias, variance)
    return [place[i] for i in range(3)], bias[0] * rtk.CLIGHT


def troposphere_m(latitude_deg: float, height_m: float, elevation_deg: float, humidity: float) -> float:
    position, angles = rtk.Arr1Ddouble(3), rtk.Arr1Ddouble(2)
    position[0], position[1], position[2] = np.radians(latitude_deg), 0.0, height_m
    angles[0], angles[1] = 0.0, np.radians(elevation_deg)
    return float(rtk.tropmodel(rtk.gpst2time(2000, 0.0), position, angles, humidity))


def ionosphere_m(time: np.datetime64, place_deg: tuple[float, float], elevation_deg: float, azimuth_deg: float,
                 coefficients: list[float]) -> float:  # fmt: skip
    ion, position, angles = rtk.Arr1Ddouble(8), rtk.Arr1Ddouble(3), rtk.Arr1Ddouble(2)
    for i, value in enumerate(coefficients):
        ion[i] = value
    position[0], position[1], position[2] = np.radians(place_deg[0]), np.radians(place_deg[1]), 50.0
    angles[0], angles[1] = np.radians(azimuth_deg), np.radians(elevation_deg)
    return float(rtk.ionmodel(instant(time), ion, position, angles))
