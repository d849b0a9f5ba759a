"""SBAS corrections against RTKLIB: its functions epoch by epoch, and its whole single-point run."""

from __future__ import annotations

import shutil
import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.geodesy import elevation_azimuth, geodetic_from_ecef, range_with_rotation
from railfix.core.timescale import from_week
from railfix.gnss.orbits.states import satellite_states
from railfix.io import read_observations
from railfix.io.rinex.navigation import read_navigation
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


_SETTINGS = """pos1-posmode=single
pos1-frequency=l1
pos1-elmask=5
pos1-ionoopt=sbas
pos1-tropopt=sbas
pos1-sateph=brdc+sbas
pos1-navsys=1
out-solformat=xyz
out-timesys=gpst
out-timeform=tow
out-outstat=residual
misc-sbasatsel=137
"""


@pytest.mark.requirement("C1")
def test_whole_runs_agree(recordings: Path, tmp_path: Path) -> None:
    """Ranges corrected here, at the positions of `rnx2rtkp`, leave the residuals that it says.

    RTKLIB uses a message from one second after its tag on (postpos.c compares with the epoch less
    1 s), so the log is shifted by that.
    """
    program = shutil.which("rnx2rtkp")
    if program is None:
        pytest.skip("rnx2rtkp (the oracle) is not installed")
    stem = str(recordings / "sbas" / "msas_20080526_crescent" / "cres_20080526.bin")
    (tmp_path / "run.conf").write_text(_SETTINGS)
    out = tmp_path / "out.pos"
    command = [program, "-k", str(tmp_path / "run.conf"), "-o", str(out), *(stem + e for e in (".obs", ".nav", ".sbs"))]
    subprocess.run(command, check=True, capture_output=True)
    rows = [line.split(",") for line in Path(f"{out}.stat").read_text().splitlines()]
    place = {row[2]: [float(v) for v in row[4:7]] for row in rows if row[0] == "$POS"}
    clock_m = {row[2]: float(row[5]) * 1e-9 * SPEED_OF_LIGHT for row in rows if row[0] == "$CLK"}
    theirs = {(row[2], row[3]): float(row[7]) for row in rows if row[0] == "$SAT" and row[9] == "0" and row[7]}
    tags = list(place)

    navigation = read_navigation(stem + ".nav")
    observations = read_observations(stem + ".obs")
    time = from_week(np.full(len(tags), 1481), [float(tag) for tag in tags])
    at = np.searchsorted(observations.time, time)
    assert (observations.time[at] == time).all()
    column = np.flatnonzero((np.char.startswith(observations.satellite, "G")) & (observations.signal == "1C"))
    satellite, code = observations.satellite[column], observations.code_m[np.ix_(at, column)]
    log = read_sbas(stem + ".sbs")
    engine = SbasCorrections.from_log(replace(log, time=log.time + np.timedelta64(1, "s")), prn=137, limits=AS_RTKLIB)
    sbas = engine.satellites(time, satellite, navigation)
    states = satellite_states(time, satellite, observations.signal[column], code, navigation, record=sbas.record)
    receiver = np.array([place[tag] for tag in tags])
    position = states.position_ecef_m + sbas.position_m
    elevation, azimuth = elevation_azimuth(position, receiver)
    latitude, longitude, height = geodetic_from_ecef(receiver)
    delay = engine.ionosphere(time, latitude, longitude, elevation, azimuth).delay_m
    delay = delay + rtca_troposphere_m(time, latitude, height, elevation)
    clock = states.clock_m - states.group_delay_m + SPEED_OF_LIGHT * sbas.clock_s
    corrected = code + clock + sbas.fast_m - delay
    distance, _ = range_with_rotation(position, receiver[:, None, :])
    residual = corrected - distance - np.array([clock_m[tag] for tag in tags])[:, None]
    compared = 0
    for (tag, name), expected in theirs.items():
        k = np.flatnonzero(satellite == name)
        value = residual[tags.index(tag), k[0]]
        if np.isnan(value):
            continue
        assert abs(value - expected) < 1e-3, (tag, name, value, expected)
        compared += 1
    assert len(tags) == 136
    assert compared == len(theirs) == 832
