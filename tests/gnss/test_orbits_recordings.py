"""Every record of the real navigation files against two independent programs, which read the files themselves."""

from __future__ import annotations

import gzip
from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orbit_cases import one_record
from railfix.evaluate.public_data import DRIVE, DRIVE_FILES
from railfix.gnss.navigation import KeplerRecords, Navigation
from railfix.gnss.orbits import satellite_states
from railfix.gnss.orbits.prepared_records import validity_s
from railfix.io.rinex import read_navigation

PUBLIC_NAVIGATION = f"public/{DRIVE}/{DRIVE_FILES['nav.rnx']}"
FILES = (
    "dual/mosaic_x2_99cm/base.nav",
    "kinematic/gsdc_pixel5_a/hour1180.21n",
    "kinematic/japan_mosaic_2021265_with_GEONET3034/SEPT2650.21P",
    "kinematic/urbannav_tst/hksc137c.nav",
    "sbas/msas_20080526_crescent/cres_20080526.bin.nav",
    "sbas/msas_20250215/046r_rnx.nav",
    "static/ESBC_2020177/ESBC00DNK_R_20201770000_01D_MN.rnx.gz",
    "static/rtklib_geonet2005/07590920.05n",
    "static/rtklib_geonet2005/30400920.05n",
    PUBLIC_NAVIGATION,
)
CODE = 22_345_678.9
#: Every so many records of a file with more than this [pieces].
MOST = 100


@cache
def ours(path: Path) -> Navigation:
    """Records of the messages that the other programs read, too: not those of CNAV."""
    navigation = read_navigation(path)
    kepler = navigation.kepler
    classic = np.isin(kepler.message, ("LNAV", "INAV", "FNAV", "D1", "D2"))
    table = {item.name: getattr(kepler, item.name)[classic] for item in fields(KeplerRecords)}
    return replace(navigation, kepler=KeplerRecords(**table))


def some(count: int) -> range:
    return range(0, count, max(1, count // MOST))


def plain(path: Path, folder: Path) -> Path:
    """The file as text, with a name that RTKLIB takes for a navigation file."""
    target = folder / "unpacked.nav"
    target.write_bytes(gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes())
    return target


def compare(nav: Navigation, row: int, ephemeris: Any, *, of_glonass: bool) -> tuple[float, float]:
    """Largest differences of position and clock [m] over the validity of one record."""
    from pyrtklib_orbits import state

    table = nav.glonass if of_glonass else nav.kepler
    limit = 1799.0 if of_glonass else float(validity_s(nav.kepler)[row]) - 1.0
    offset = np.array([-1.0, -0.31, 0.0, 0.004, 0.5, 1.0]) * limit
    time = table.toe[row] + np.rint(offset * 1e9).astype("timedelta64[ns]")
    satellite = table.satellite[row : row + 1]
    signal = np.array(["2I" if satellite[0][0] == "C" else "1C"])
    found = satellite_states(
        time, satellite, signal, np.full((len(time), 1), CODE), one_record(nav, row, of_glonass=of_glonass)
    )
    theirs = [state(ephemeris, t, CODE) for t in time]
    distance = np.linalg.norm(found.position_ecef_m[:, 0] - [p for p, _ in theirs], axis=-1)
    return float(distance.max()), float(np.abs(found.clock_m[:, 0] - [c for _, c in theirs]).max())


@pytest.mark.requirement("A7")
@pytest.mark.parametrize("name", FILES)
@pytest.mark.every(3)
def test_positions_and_clocks_of_rtklib(name: str, recorded: Callable[[str], Path], tmp_path: Path) -> None:
    """RTKLIB reads the file and computes the states. Required: 1 mm and 1 mm; found: a micrometre."""
    rtk = pytest.importorskip("pyrtklib5")
    from pyrtklib_orbits import satellite_number

    nav = ours(recorded(name))
    theirs, observations, station = rtk.nav_t(), rtk.obs_t(), rtk.sta_t()
    assert rtk.readrnx(str(plain(recorded(name), tmp_path)), 1, "", observations, theirs, station) == 1
    by_content: dict[tuple[float, ...], Any] = {}
    for i in range(theirs.n):
        eph = theirs.eph[i]
        by_content[eph.sat, eph.f0, eph.f1, eph.M0] = eph
    for i in range(theirs.ng):
        geph = theirs.geph[i]
        by_content[geph.sat, geph.gamn, round(geph.pos[0], 2)] = geph
    numbers = {s: satellite_number(s) for s in {*nav.kepler.satellite.tolist(), *nav.glonass.satellite.tolist()}}
    worst, missing = np.zeros(2), 0
    for of_glonass, table in ((False, nav.kepler), (True, nav.glonass)):
        for row in some(len(table)):
            name_of = numbers[str(table.satellite[row])]
            if of_glonass:
                x = round(float(nav.glonass.position_ecef_m[row, 0]), 2)
                eph = by_content.get((name_of, float(nav.glonass.relative_frequency[row]), x))
            else:
                numbers_of = (float(x[row]) for x in (nav.kepler.af0_s, nav.kepler.af1, nav.kepler.m0))
                eph = by_content.get((name_of, *numbers_of))
            if eph is None:
                # This build of RTKLIB ends at C46.
                missing += name_of != 0
                continue
            worst = np.maximum(worst, compare(nav, row, eph, of_glonass=of_glonass))
    assert missing == 0
    assert worst[0] < 1e-5, "position [m]"
    assert worst[1] < 1e-6, "clock [m]"


@pytest.mark.requirement("B0")
def test_every_satellite_of_a_day_has_a_record_most_of_the_time(recordings: Path) -> None:
    """ESBC, 24 h: what the station received serves; what is right after the fact alone is flagged."""
    nav = ours(recordings / FILES[6])
    names = np.array(sorted(set(nav.kepler.satellite.tolist()) | set(nav.glonass.satellite.tolist())))
    time = np.datetime64("2020-06-25T00:00", "ns") + np.arange(0, 86_400, 300) * np.timedelta64(1, "s")
    signal = np.array(["2I" if s[0] == "C" else "1C" for s in names])
    found = satellite_states(time, names, signal, np.full((len(time), len(names)), CODE), nav)
    radius = np.linalg.norm(found.position_ecef_m, axis=-1)
    assert np.nanmin(radius) > 2.33e7, "perigee of the two Galileo satellites in elliptic orbits"
    assert np.nanmax(radius) < 4.7e7
    used = np.isfinite(radius)
    # Orbits of neighbouring records join: no step of a satellite's position beyond its travel.
    step = np.linalg.norm(np.diff(found.position_ecef_m, axis=0), axis=-1)
    assert np.nanmax(step) < 300.0 * 4000.0
    assert found.future_record[used].mean() < 0.2, "of all satellites, seen or not"
    assert not found.no_record.any()


@pytest.mark.requirement("B0")
def test_qzss_satellites_of_the_recordings_stay_usable(recordings: Path) -> None:
    """Since 2022 their word is 1 (no L1C/B) though nothing is wrong; J01 was switched off in September 2021."""
    for name in (FILES[0], FILES[2], FILES[5], FILES[6]):
        nav = ours(recordings / name)
        rows = np.flatnonzero(np.char.startswith(nav.kepler.satellite, "J"))
        time = nav.kepler.toe[rows[:1]]
        satellites = np.unique(nav.kepler.satellite[rows])
        code = np.full((1, len(satellites)), 3.8e7)
        found = satellite_states(time, satellites, np.full(len(satellites), "1C"), code, nav)
        sick = satellites[found.unhealthy[0]].tolist()
        assert sick == (["J01"] if name == FILES[2] else [])
