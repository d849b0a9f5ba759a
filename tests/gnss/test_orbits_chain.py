"""The whole chain on real logs: from navigation file to states at the instants of transmission, as RTKLIB has them."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from railfix.gnss.navigation import GlonassRecords, KeplerRecords, Navigation
from railfix.gnss.orbits import satellite_states
from railfix.io import read_navigation, read_observations
from railfix.io.rinex.navigation_writer import write_navigation

#: Log, navigation file, signals of one channel a satellite.
LOGS = {
    "urban": ("kinematic/urbannav_tst/20210517.light-urban.tste.ublox.f9p.obs", "kinematic/urbannav_tst/hksc137c.nav"),
    "japan": (
        "kinematic/japan_mosaic_2021265_with_GEONET3034/SEPT265G.21O",
        "kinematic/japan_mosaic_2021265_with_GEONET3034/SEPT2650.21P",
    ),
    "roof": ("dual/mosaic_x2_99cm/rover.obs", "dual/mosaic_x2_99cm/base.nav"),
}
SIGNAL = {"G": "1C", "J": "1C", "E": "1C", "C": "2I", "R": "1C"}
EPOCHS = 30


def _rows(table: Any, rows: np.ndarray) -> Any:
    return type(table)(**{item.name: getattr(table, item.name)[rows] for item in fields(table)})


def _used_once(navigation: Navigation, states: Any, satellite: np.ndarray) -> Navigation:
    """Of each satellite the one record that serves most epochs: which one to take is another question."""
    tables: dict[str, Any] = {}
    for name, letters in (("kepler", "GJEC"), ("glonass", "R")):
        table: KeplerRecords | GlonassRecords = getattr(navigation, name)
        rows = []
        for m in np.flatnonzero(np.isin(satellite.astype("<U1"), list(letters))):
            used = states.record[np.isfinite(states.clock_m[:, m]), m]
            if len(used):
                rows.append(np.bincount(used).argmax())
        tables[name] = _rows(table, np.array(rows, dtype=np.int64))
    return Navigation(**tables)


def _rtklib(rtk: Any, nav: Any, time: np.datetime64, satellite: list[str], code_m: np.ndarray) -> tuple[Any, Any]:
    from pyrtklib_orbits import instant, satellite_number

    n = len(satellite)
    observed = rtk.Arr1Dobsd_t(n)
    for i, name in enumerate(satellite):
        one = observed[i]
        one.sat, one.time = satellite_number(name), instant(time)
        one.P[0] = float(code_m[i])
    states, clocks, variances, health = (
        rtk.Arr1Ddouble(6 * n), rtk.Arr1Ddouble(2 * n), rtk.Arr1Ddouble(n), rtk.Arr1Dint(n),
    )  # fmt: skip
    rtk.satposs(instant(time), observed[0], n, nav, rtk.EPHOPT_BRDC, states, clocks, variances, health)
    return np.array([states[i] for i in range(6 * n)]).reshape(n, 6), np.array([clocks[2 * i] for i in range(n)])


@pytest.mark.requirement("A7")
@pytest.mark.parametrize("name", LOGS)
def test_states_at_transmission_are_those_of_rtklib(name: str, recordings: Path, tmp_path: Path) -> None:
    """Required: 1 mm and 1 mm; found: a micrometre. RTKLIB's velocity is a difference quotient."""
    rtk = pytest.importorskip("pyrtklib5")
    log, file = (recordings / part for part in LOGS[name])
    observations = read_observations(log)
    wanted = [SIGNAL.get(s[0]) == g for s, g in zip(observations.satellite.tolist(), observations.signal, strict=True)]
    channels = np.flatnonzero(wanted)
    epochs = np.linspace(0, len(observations) - 1, EPOCHS).astype(int)
    time, code = observations.time[epochs], observations.code_m[np.ix_(epochs, channels)]
    satellite, signal = observations.satellite[channels], observations.signal[channels]
    whole = read_navigation(file)
    write_navigation(
        _used_once(whole, satellite_states(time, satellite, signal, code, whole), satellite), tmp_path / "n"
    )
    (tmp_path / "n").rename(tmp_path / "made.nav")
    navigation = read_navigation(tmp_path / "made.nav")
    states = satellite_states(time, satellite, signal, code, navigation)
    nav = rtk.nav_t()
    assert rtk.readrnx(str(tmp_path / "made.nav"), 1, "", rtk.obs_t(), nav, rtk.sta_t()) == 1

    worst: dict[str, np.ndarray] = {}
    for k, at in enumerate(time):
        # This build of RTKLIB ends at C46.
        here = np.flatnonzero(np.isfinite(states.clock_m[k]) & ~((satellite > "C46") & (satellite < "D")))
        theirs, clock = _rtklib(rtk, nav, at, satellite[here].tolist(), code[k, here])
        for i, m in enumerate(here):
            assert theirs[i].any(), f"{satellite[m]} has no state there"
            found = np.array(
                [
                    np.linalg.norm(states.position_ecef_m[k, m] - theirs[i, :3]),
                    abs(states.clock_m[k, m] - 299_792_458.0 * clock[i]),
                    np.linalg.norm(states.velocity_ecef_mps[k, m] - theirs[i, 3:]),
                ]
            )
            letter = str(satellite[m])[0]
            worst[letter] = np.maximum(worst.get(letter, 0.0), found)
    assert set(worst) >= {"G", "E"}
    largest = np.max(list(worst.values()), axis=0)
    assert largest[0] < 1e-5, worst
    assert largest[1] < 1e-6, worst
    assert largest[2] < 1e-3, worst
