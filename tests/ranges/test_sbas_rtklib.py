"""SBAS corrections against RTKLIB: its functions epoch by epoch."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from railfix.core.constants import SPEED_OF_LIGHT
from railfix.ranges.sbas import IonosphereState, SatelliteState, SbasCorrections, SbasLimits, SbasMessages, read_sbas
from railfix.ranges.sbas.troposphere import rtca_troposphere_m

GPS = np.array([f"G{i:02d}" for i in range(1, 33)])
#: What RTKLIB does: corrections as sent, at the second of their tag, whatever their degradation data and UDREI.
AS_RTKLIB = SbasLimits(range_rate="off", incomplete="inflate", message_s=0.0, max_udrei=13, type0="as_type2")


def seconds_of(log: SbasMessages, step: int) -> np.ndarray:
    first, last = log.time[[0, -1]].astype("datetime64[s]")
    return np.arange(first, last + 1, step).astype("datetime64[ns]")


@pytest.mark.requirement("C1")
@pytest.mark.parametrize(
    ("name", "prn", "step", "fewest"),
    [
        ("msas_20080526_crescent/cres_20080526.bin.sbs", 129, 1, 1900),
        ("msas_20080526_crescent/cres_20080526.bin.sbs", 137, 1, 1900),
        ("msas_20250215/046r_sbas_prn137.txt", 137, 60, 400),
    ],
)
def test_corrections_are_those_of_rtklib(recordings: Path, name: str, prn: int, step: int, fewest: int) -> None:
    """Every satellite and every `step` seconds, within 1 mm, and corrected by both or by neither."""
    from sbas_rtklib import replay

    log = read_sbas(recordings / "sbas" / name).of(prn)
    engine = SbasCorrections.from_log(log, prn=prn, limits=AS_RTKLIB)
    time = seconds_of(log, step)
    ours = engine.satellites(time, GPS)
    compared = 0
    for t, program in replay(log, time):
        for k, satellite in enumerate(GPS):
            theirs = program.satellite(time[t], satellite)
            assert (theirs is None) == (ours.state[t, k] != SatelliteState.OK), (time[t], satellite)
            if theirs is None:
                continue
            compared += 1
            assert program.issue(satellite) == ours.iode[t, k]
            clock_m = SPEED_OF_LIGHT * ours.clock_s[t, k] + ours.fast_m[t, k]
            assert np.abs(theirs[0] - ours.position_m[t, k]).max() < 1e-3
            assert abs(SPEED_OF_LIGHT * theirs[1] - clock_m) < 1e-3
    assert compared > fewest


@pytest.mark.requirement("C1")
@pytest.mark.parametrize(
    ("name", "prn", "fewest"),
    [
        ("msas_20080526_crescent/cres_20080526.bin.sbs", 129, 400),
        ("msas_20080526_crescent/cres_20080526.bin.sbs", 137, 1400),
        ("msas_20250215/046r_sbas_prn137.txt", 137, 2000),
    ],
)
def test_delays_are_those_of_rtklib(recordings: Path, name: str, prn: int, fewest: int) -> None:
    """Places all over Japan and south of it, within 0.1 mm; RTKLIB takes a delay that says do not use for zero."""
    from sbas_rtklib import replay

    log = read_sbas(recordings / "sbas" / name).of(prn)
    engine = SbasCorrections.from_log(log, prn=prn, limits=AS_RTKLIB)
    time = seconds_of(log, 10 if len(log) > 1000 else 1)
    random = np.random.default_rng(2008)
    latitude, longitude = random.uniform(20.0, 46.0, len(time)), random.uniform(123.0, 146.0, len(time))
    elevation, azimuth = random.uniform(5.0, 90.0, (len(time), 8)), random.uniform(0.0, 360.0, (len(time), 8))
    ours = engine.ionosphere(time, latitude, longitude, elevation, azimuth)
    compared, only_theirs = 0, Counter[int]()
    for t, program in replay(log, time):
        for k in range(elevation.shape[1]):
            theirs = program.ionosphere(time[t], latitude[t], longitude[t], elevation[t, k], azimuth[t, k])
            if theirs is None:
                assert np.isnan(ours.delay_m[t, k])
            elif np.isnan(ours.delay_m[t, k]):
                only_theirs[int(ours.state[t, k])] += 1
            else:
                compared += 1
                assert abs(theirs - ours.delay_m[t, k]) < 1e-4
    assert compared > fewest
    assert set(only_theirs) <= {IonosphereState.DO_NOT_USE}


@pytest.mark.requirement("C1")
def test_the_troposphere_is_that_of_rtklib() -> None:
    from sbas_rtklib import troposphere

    random = np.random.default_rng(1)
    count = 200
    time = np.datetime64("2008-05-26", "ns") + random.integers(0, 400 * 86_400, count) * np.timedelta64(1, "s")
    latitude, height = random.uniform(-80.0, 80.0, count), random.uniform(-50.0, 3000.0, count)
    elevation = random.uniform(4.5, 90.0, count)
    ours = rtca_troposphere_m(time, latitude, height, elevation[:, None])[:, 0]
    for i in range(count):
        assert abs(troposphere(time[i], latitude[i], 0.0, height[i], elevation[i]) - ours[i]) < 1e-4
