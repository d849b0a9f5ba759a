"""The conventional position against RTKLIB's single point (`rnx2rtkp`), on real recordings.

RTKLIB differs from railfix in three choices, none of them a model of the ranges:

* weights: it takes elevation, broadcast accuracy and part of each correction, railfix C/N0 and elevation;
* records: it takes the nearest toe (of Galileo the newest toe that has passed), railfix the newest transmitted;
* group delays: it takes those of a satellite's first record in the file (2.4.3), railfix those of the record used.

With the same choices what is left is the models: satellites, atmosphere, Earth rotation, clocks, least squares.
``python -m pytest tests/positioning/test_conventional_rtklib.py -s`` prints the figures.
"""

from __future__ import annotations

import gzip
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import hatanaka
import numpy as np
import pytest

import recordings_truth
from railfix.core.geodesy import geodetic_from_ecef
from railfix.evaluate.public_data import DRIVE, DRIVE_FILES
from railfix.gnss.navigation import Navigation
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.io import read_navigation, read_observations
from railfix.io.positions import read_positions
from railfix.pipeline.config import parse_config
from railfix.pipeline.results import AntennaResult
from railfix.positioning.normal_equations import point_position
from railfix.positioning.range_arrays import Ranges
from railfix.ranges.atmosphere import klobuchar_delay_m
from railfix.ranges.channels import clock_groups
from railfix.run.processor_setup import make_processor
from railfix.track.trajectory import Trajectory
from recordings_score import straight_line, trajectory_of

pytestmark = [
    pytest.mark.requirement("A6"),
    pytest.mark.skipif(shutil.which("rnx2rtkp") is None, reason="rnx2rtkp (Debian package rtklib) is not installed"),
]

MASK_DEG = 15.0
NAVSYS = {"G": 1, "E": 8, "J": 16, "C": 32}
#: RTKLIB's user range accuracies by index [m] (rtkcmn.c: ura_value).
URA_M = np.array([2.4, 3.4, 4.85, 6.85, 9.65, 13.65, 24.0, 48.0, 96.0, 192.0, 384.0, 768.0, 1536.0, 3072.0, 6144.0])


@dataclass(frozen=True)
class Log:
    """Files of a recording, and where its antenna was."""

    observations: Path
    navigation: Path
    systems: str
    interval_s: int
    trajectory: Callable[[Observations], Trajectory]
    static: bool = True


def through_the_header_position(observations: Observations) -> Trajectory:
    return straight_line(observations.header.approximate_ecef_m, 0.0)


@pytest.fixture(scope="module")
def logs(recordings: Path, tmp_path_factory) -> dict[str, Log]:
    geonet = recordings / "static" / "rtklib_geonet2005"
    found = {
        f"geonet {s}": Log(geonet / f"{s}0920.05o", geonet / f"{s}0920.05n", "G", 30, through_the_header_position)
        for s in ("0759", "3040")
    }
    japan = recordings / "kinematic" / "japan_mosaic_2021265_with_GEONET3034"
    for systems in ("G", "E", "GJE"):
        found[f"japan {systems}"] = Log(
            japan / "SEPT265G.21O",
            japan / "SEPT2650.21P",
            systems,
            1,
            lambda _: trajectory_of(*recordings_truth.japan_truth(recordings)),
            static=False,
        )
    unpacked = tmp_path_factory.mktemp("esbc")
    esbc = recordings / "static" / "ESBC_2020177"
    packed = esbc / "ESBC00DNK_R_20201770000_01D_30S_MO.crx.gz"
    (unpacked / "esbc.rnx").write_bytes(hatanaka.decompress(packed.read_bytes()))
    records = (esbc / "ESBC00DNK_R_20201770000_01D_MN.rnx.gz").read_bytes()
    (unpacked / "esbc.nav").write_bytes(gzip.decompress(records))
    for systems in ("G", "E", "C", "GEC"):
        found[f"esbc {systems}"] = Log(
            unpacked / "esbc.rnx", unpacked / "esbc.nav", systems, 600, through_the_header_position
        )
    return found


@pytest.fixture
def log(name: str, request: pytest.FixtureRequest, recorded: Callable[[str], Path]) -> Log:
    if not name.startswith("public"):
        return request.getfixturevalue("logs")[name]
    station, navigation = (recorded(f"public/{DRIVE}/{DRIVE_FILES[file]}") for file in ("base.rnx", "nav.rnx"))
    return Log(station, navigation, name.split()[1], 10, through_the_header_position)


def rtklib(log: Log, folder: Path) -> tuple[np.ndarray, np.ndarray, dict[int, set[str]]]:
    """Time and place of RTKLIB's single points, and the satellites used by second of the GPS time."""
    settings = folder / "single.conf"
    settings.write_text(
        f"pos1-posmode=single\npos1-frequency=l1\npos1-elmask={MASK_DEG}\npos1-ionoopt=brdc\npos1-tropopt=saas\n"
        f"pos1-sateph=brdc\npos1-navsys={sum(NAVSYS[s] for s in log.systems)}\n"
        "out-solformat=xyz\nout-timesys=gpst\nout-timeform=hms\nout-timendec=6\nout-outstat=residual\n"
    )
    out = folder / "single.pos"
    command = ["rnx2rtkp", "-k", settings, "-ti", log.interval_s, "-o", out, log.observations, log.navigation]
    subprocess.run([str(word) for word in command], check=True, capture_output=True)
    satellites: dict[int, set[str]] = {}
    for line in Path(f"{out}.stat").read_text().splitlines():
        cells = line.split(",")
        if cells[0] == "$SAT":
            satellites.setdefault(round(int(cells[1]) * 604_800 + float(cells[2])), set()).add(cells[3])
    found = read_positions(out)
    return found.time, found.ecef_m, satellites


def with_choices_of_rtklib(navigation: Navigation) -> Navigation:
    """Records that lead to RTKLIB's choice of record and group delay.

    Without transmission times a record serves from half-way since the one before: the nearest toe.
    """
    kepler = navigation.kepler
    galileo = kepler.satellite.astype("<U1") == "E"
    first, second = kepler.group_delay_1_s.copy(), np.nan_to_num(kepler.group_delay_2_s)
    order = np.lexsort((kepler.toe, np.where(np.isnat(kepler.transmitted), kepler.toe, kepler.transmitted)))
    for name in np.unique(kepler.satellite):
        rows = order[kepler.satellite[order] == name]
        first[rows], second[rows] = first[rows[0]], second[rows[0]]
    # RTKLIB asks at the instant of transmission, so a toe that is the epoch itself has not passed.
    sent = np.where(galileo, kepler.toe + np.timedelta64(1, "s"), np.datetime64("NaT", "ns"))
    return replace(navigation, kepler=replace(kepler, transmitted=sent, group_delay_1_s=first, group_delay_2_s=second))


def weights_of_rtklib(found: AntennaResult, navigation: Navigation) -> np.ndarray:
    """1 / variance as RTKLIB states it (pntpos.c: varerr, vare, ERR_BRDCI, ERR_SAAS, ERR_CBIAS), shape (T, K)."""
    satellite, signal = found.satellite[found.columns], found.signal[found.columns]
    elevation, azimuth = found.elevation_deg[:, found.columns], found.azimuth_deg[:, found.columns]
    sine = np.sin(np.radians(elevation))
    accuracy = found.corrected.satellites.accuracy_m
    table = URA_M[np.minimum(np.searchsorted(URA_M, np.nan_to_num(accuracy)), len(URA_M) - 1)]
    accuracy = np.where(satellite.astype("<U1") == "E", accuracy, table)
    latitude, longitude, _ = geodetic_from_ecef(found.point.ecef_m)
    ionosphere = klobuchar_delay_m(
        found.time, latitude, longitude, elevation, azimuth, navigation.klobuchar["G"],
        carrier_frequency_hz(satellite, signal, {}),
    )  # fmt: skip
    code, bias, troposphere = 0.3**2 * (1.0 + 1.0 / sine), 0.3**2, (0.3 / (sine + 0.1)) ** 2
    return 1.0 / (code + bias + troposphere + accuracy**2 + (0.5 * ionosphere) ** 2)


def solved_again(found: AntennaResult, weight: np.ndarray) -> np.ndarray:
    """Single points from the ranges of a result with other weights, shape (T, 3)."""
    used = (found.reason[:, found.columns] == 0) & np.isfinite(weight)
    ranges = Ranges(
        sat_ecef_m=np.where(used[..., None], found.corrected.satellites.position_ecef_m, 2.6e7),
        code_m=np.where(used, found.corrected_code_m[:, found.columns], 0.0),
        weight=np.where(used, weight, 0.0),
        groups=clock_groups(found.satellite[found.columns].astype("<U1")),
    )
    start = np.where(np.isfinite(found.point.ecef_m), found.point.ecef_m, 6.4e6)
    return point_position(ranges, start).ecef_m


def positions(log: Log, choose: Callable[[Navigation], Navigation]) -> tuple[AntennaResult, Trajectory, Navigation]:
    whole = read_observations(log.observations)
    of_day = (whole.time - whole.time[0]) / np.timedelta64(1, "s")
    step = round(log.interval_s / float(np.median(np.diff(of_day))))
    observations, trajectory = whole[::step], log.trajectory(whole)
    navigation = choose(read_navigation([log.navigation]))
    settings = {"systems": list(log.systems), "screens": ["elevation"], "elevation": {"mask_deg": MASK_DEG}}
    processor = make_processor(parse_config(settings), navigation, {"front": trajectory})
    result, _ = processor.process({"front": observations})
    return result.antennas["front"], trajectory, navigation


def paired(found: AntennaResult, time: np.ndarray) -> np.ndarray:
    """RTKLIB's row of each epoch, -1 where it has none; its times are the tags less the receiver's clock."""
    after = np.clip(np.searchsorted(time, found.time), 1, len(time) - 1)
    nearest = np.where(np.abs(time[after - 1] - found.time) < np.abs(time[after] - found.time), after - 1, after)
    return np.where(np.abs(time[nearest] - found.time) < np.timedelta64(20, "ms"), nearest, -1)


def percentiles(name: str, what: str, values: np.ndarray) -> tuple[float, float]:
    """Median and 95th percentile, printed."""
    p50, p95 = np.percentile(values, [50, 95])
    print(f"{name:12s} {what:34s} {len(values):4d} epochs  p50 {p50:6.3f}  p95 {p95:6.3f}  max {values.max():6.3f} m")
    return float(p50), float(p95)


@pytest.mark.parametrize(
    ("name", "same_p95_m"),
    [
        ("geonet 0759", 0.01),
        ("geonet 3040", 0.01),
        ("japan G", 0.01),
        ("japan E", 0.05),
        ("japan GJE", 0.10),
        pytest.param("esbc G", 0.01, marks=pytest.mark.slow),
        pytest.param("esbc E", 0.05, marks=pytest.mark.slow),
        ("esbc C", 0.01),
        ("esbc GEC", 0.20),
        ("public G", 0.01),
        ("public E", 0.05),
        ("public GE", 0.20),
    ],
)
@pytest.mark.every(3)
def test_single_point_with_the_same_choices(log: Log, tmp_path: Path, name: str, same_p95_m: float):
    """The requirement asks for 0.5 m; what remains with equal choices is far below."""
    time, place, satellites = rtklib(log, tmp_path)
    found, _, navigation = positions(log, with_choices_of_rtklib)
    own = solved_again(found, 1.0 / found.sigma_m[:, found.columns] ** 2)
    assert own == pytest.approx(found.point.ecef_m, abs=1e-5, nan_ok=True)

    row = paired(found, time)
    again = solved_again(found, weights_of_rtklib(found, navigation))
    both = np.flatnonzero((row >= 0) & np.isfinite(again[:, 0]))
    assert len(both) > 0.95 * len(found)
    stamp = np.round((found.time - np.datetime64("1980-01-06T00:00:00")) / np.timedelta64(1, "s")).astype(int)
    for t in both:
        assert {str(found.satellite[m]) for m in np.flatnonzero(found.reason[t] == 0)} == satellites[int(stamp[t])]
    difference = np.linalg.norm(again[both] - place[row[both]], axis=1)
    _, p95 = percentiles(name, "same weights, records, delays", difference)
    assert p95 < min(same_p95_m, 0.5)
