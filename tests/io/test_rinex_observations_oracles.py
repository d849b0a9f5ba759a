"""Real recordings against other programs' readers: georinex (all values), RTKLIB (what it keeps)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from railfix.core.files import read_bytes
from railfix.evaluate.public_data import DRIVE, DRIVE_FILES
from railfix.gnss.observations import Observations
from railfix.io import read_observations
from railfix.io.rinex.observations_lines import KINDS, find_signal

pytestmark = [pytest.mark.requirement("A7"), pytest.mark.filterwarnings("ignore")]

RECORDINGS = {
    "geonet 0759": ("static/rtklib_geonet2005/07590920.05o", (120, 22)),
    "geonet 3040": ("static/rtklib_geonet2005/30400920.05o", (120, 24)),
    "crescent": ("sbas/msas_20080526_crescent/cres_20080526.bin.obs", (312, 11)),
    "M8T": ("kinematic/urbannav_tst/20210517.light-urban.tste.ublox.m8t.GC.obs", (782, 27)),
    "F9P": ("kinematic/urbannav_tst/20210517.light-urban.tste.ublox.f9p.obs", (657, 78)),
    "phone": ("kinematic/gsdc_pixel5_a/Pixel5_a.21o", (998, 31)),
    "mosaic": ("kinematic/japan_mosaic_2021265_with_GEONET3034/SEPT265G.21O", (360, 78)),
    "geonet 3034": ("kinematic/japan_mosaic_2021265_with_GEONET3034/3034265G.21O", (360, 64)),
    "dual base": ("dual/mosaic_x2_99cm/base.obs", (301, 149)),
    "dual rover": ("dual/mosaic_x2_99cm/rover.obs", (301, 154)),
    "public station": (f"public/{DRIVE}/{DRIVE_FILES['base.rnx']}", (1200, 96)),
    "public 10 Hz": ("public/argonaut_single_static_3m_10Hz/argonaut_2.rnx", (1788, 25)),
    "ESBC": ("static/ESBC_2020177/ESBC00DNK_R_20201770000_01D_30S_MO.crx.gz", (2880, 404)),
}


def first_epochs(source: Path, target: Path, epochs: int) -> Path:
    """A copy with the first epochs only (RINEX 3; RINEX 2 files are small enough)."""
    text = read_bytes(source)
    at = text.index(b"END OF HEADER")
    for _ in range(epochs + 1):
        at = text.find(b"\n>", at + 1)
        if at < 0:
            at = len(text) - 1
            break
    target.write_bytes(text[: at + 1])
    return target


def arrays_of(observations: Observations) -> list[np.ndarray]:
    return [observations.code_m, observations.phase_cycles, observations.doppler_hz, observations.cn0_dbhz]


@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings_are_read_without_a_fault(recorded: Callable[[str], Path], name: str) -> None:
    path, shape = RECORDINGS[name]
    observations = read_observations(recorded(path))
    assert observations.code_m.shape == shape
    assert (np.diff(observations.time) > np.timedelta64(0, "ns")).all()
    assert not observations.problems
    assert not observations.skipped
    code = observations.code_m[np.isfinite(observations.code_m)]
    assert code.size
    assert code.min() > 1.6e7  # a receiver clock of 10 ms
    assert code.max() < 4.5e7  # geostationary, with a clock error


def compare_with_georinex(path: Path) -> int:
    """Values compared; each is equal, and none is missing on either side."""
    georinex = pytest.importorskip("georinex")
    ours = read_observations(path)
    theirs = georinex.load(path, useindicators=True)
    version = ours.header.version
    # georinex cuts its times to 1 ms (RINEX 2) or 1 us, through a float
    tolerance = np.timedelta64(1000 if version < 3.0 else 1, "us")
    assert len(theirs.time) == len(ours)
    assert (np.abs(theirs.time.values.astype("M8[us]") - ours.time.astype("M8[us]")) <= tolerance).all()
    names = [str(n) for n in theirs.data_vars if not str(n).endswith(("lli", "ssi")) and str(n)[0] in "CLDSP"]
    column = {key: i for i, key in enumerate(zip(ours.satellite.tolist(), ours.signal.tolist(), strict=True))}
    arrays = arrays_of(ours)
    left = [np.isfinite(a) for a in arrays]
    for name in names:
        for j, satellite in enumerate(theirs.sv.values.tolist()):
            system = satellite[0]
            values = theirs[name].values[:, j]
            signal = find_signal(name, system=system, version=version, declared=names)
            at = column.get((f"{system}{int(satellite[1:]):02d}", str(signal)))
            kind = list(KINDS).index("C" if name[0] == "P" else name[0])
            if at is None:
                assert not np.nan_to_num(values).any()
                continue
            np.testing.assert_array_equal(arrays[kind][:, at], np.where(values == 0.0, np.nan, values))
            left[kind][:, at] = False
            if name + "lli" in theirs:
                np.testing.assert_array_equal(
                    ours.loss_of_lock[:, at], np.nan_to_num(theirs[name + "lli"].values[:, j])
                )
    assert not any(a.any() for a in left)
    return sum(int(np.isfinite(a).sum()) for a in arrays)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in ("ESBC", "dual base") else n for n in RECORDINGS]
)
@pytest.mark.every(3)
def test_first_epochs_equal_georinex(recorded: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    source = recorded(RECORDINGS[name][0])
    path = source if name in ("geonet 0759", "geonet 3040") else first_epochs(source, tmp_path / "log.rnx", 8)
    assert compare_with_georinex(path) > 100


@pytest.mark.parametrize(
    "name", ["geonet 0759", "crescent", "M8T", "F9P", "mosaic", "dual base", "ESBC", "public 10 Hz", "public station"]
)
@pytest.mark.every(3)
def test_first_epochs_equal_rtklib(recorded: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    """Every value RTKLIB keeps (it has three bands) stands at the same place here."""
    rtk = pytest.importorskip("pyrtklib5")
    source = recorded(RECORDINGS[name][0])
    path = source if name == "geonet 0759" else first_epochs(source, tmp_path / "log.obs", 30)
    ours = read_observations(path)
    table, navigation, station = rtk.obs_t(), rtk.nav_t(), rtk.sta_t()
    rtk.readrnx(str(path), 1, "", table, navigation, station)
    column = {key: i for i, key in enumerate(zip(ours.satellite.tolist(), ours.signal.tolist(), strict=True))}
    row = {int(t): k for k, t in enumerate((ours.time.astype(np.int64) + 50_000) // 100_000)}
    arrays = arrays_of(ours)
    compared = 0
    for i in range(table.n):
        record = table.data[i]
        satellite = rtk.Arr1Dchar(8)
        rtk.satno2id(record.sat, satellite)
        tag = record.time.time * 10_000 + round(record.time.sec * 10_000)
        number = satellite.ptr if not satellite.ptr.isdigit() else f"S{int(satellite.ptr) - 100:02d}"
        for f in range(3):
            if not record.code[f]:
                continue
            at = column.get((number, rtk.code2obs(record.code[f])))
            theirs = (record.P[f], record.L[f], record.D[f], record.SNR[f])
            if at is None:
                assert not any(theirs[:3]), (number, rtk.code2obs(record.code[f]))
                continue
            for kind, (value, tolerance) in enumerate(zip(theirs, (1e-6, 1e-6, 1e-3, 0.26), strict=True)):
                mine = np.nan_to_num(arrays[kind][row[tag], at])
                assert abs(mine - value) <= tolerance, (number, KINDS[kind], tag)
                compared += mine != 0.0
    assert compared > 1000
