"""The reference trajectories of the real recordings, each as (GPS time, ECEF of the antenna)."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.core.geodesy import ecef_from_geodetic, enu_axes, geodetic_from_ecef
from railfix.core.timescale import from_week, timedelta, utc_to_gpst
from railfix.io.positions import read_positions

Truth = tuple[Datetimes, Floats]

#: Antenna from the reference unit: right, forward, up [m]. extrinsic.yaml gives the antenna from the IMU
#: (0, 0.86, -0.31) and the reference unit from the IMU (0, 0, 0.14).
URBANNAV_LEVER_M: Final = (0.0, 0.86, -0.45)
#: smartLoc tells seconds from an unknown start; this instant plays it.
SMARTLOC_START: Final = np.datetime64("2016-01-03T00:00:00", "ns")


def _folder(recordings: Path, name: str) -> Path:
    """The folder itself, or the one below it whose name begins so."""
    if recordings.name.startswith(name):
        return recordings
    exact = recordings / "kinematic" / name
    return exact if exact.is_dir() else next((recordings / "kinematic").glob(f"{name}*"))


def urbannav_truth(recordings: Path) -> Truth:
    """UrbanNav TST, 1 Hz: inertial reference moved to the GNSS antenna by heading, pitch and roll."""
    path = _folder(recordings, "urbannav_tst") / "UrbanNav_TST_GT_raw.txt"
    rows = np.array([line.split() for line in path.read_text().splitlines()[2:] if line.strip()], dtype=np.float64)
    latitude = rows[:, 3] + rows[:, 4] / 60.0 + rows[:, 5] / 3600.0
    longitude = rows[:, 6] + rows[:, 7] / 60.0 + rows[:, 8] / 3600.0
    roll, pitch, azimuth = np.radians(rows[:, 16]), np.radians(rows[:, 17]), np.radians(rows[:, 18])
    right, forward, up = _body_axes(azimuth, pitch, roll)
    lever = URBANNAV_LEVER_M[0] * right + URBANNAV_LEVER_M[1] * forward + URBANNAV_LEVER_M[2] * up
    origin = ecef_from_geodetic(latitude, longitude, rows[:, 9])
    return from_week(rows[:, 1].astype(int), rows[:, 2]), origin + np.einsum(
        "tji,tj->ti", enu_axes(latitude, longitude), lever
    )


def _body_axes(azimuth: Floats, pitch: Floats, roll: Floats) -> tuple[Floats, Floats, Floats]:
    """Right, forward and up of a body in east-north-up; pitch nose up, roll right side down."""
    level = np.stack([np.cos(azimuth), -np.sin(azimuth), np.zeros_like(azimuth)], axis=-1)
    forward = np.stack([np.sin(azimuth) * np.cos(pitch), np.cos(azimuth) * np.cos(pitch), np.sin(pitch)], axis=-1)
    above = np.cross(level, forward)
    right = np.cos(roll)[:, None] * level - np.sin(roll)[:, None] * above
    return right, forward, np.cross(right, forward)


def gsdc_truth(recordings: Path) -> Truth:
    """GSDC Pixel 5, 10 Hz: SPAN in UTC of 2021-04-28, ddmm.mmmm, west positive, height over the geoid + geoid."""
    path = _folder(recordings, "gsdc_pixel5_a") / "SPAN_a.csv"
    cells = [line.split(",") for line in path.read_text().splitlines() if line.strip()]
    rows = np.array([[float(c[i]) for i in (0, 1, 2, 6, 7)] for c in cells])
    clock, lat, lon = rows[:, 0], rows[:, 1], rows[:, 2]
    of_day = clock // 10000 * 3600 + clock // 100 % 100 * 60 + clock % 100
    utc = np.datetime64("2021-04-28T00:00:00", "ns") + timedelta(np.round(of_day, 3))
    latitude = lat // 100 + lat % 100 / 60.0
    longitude = -(lon // 100 + lon % 100 / 60.0)
    return utc_to_gpst(utc), ecef_from_geodetic(latitude, longitude, rows[:, 3] + rows[:, 4])


def smartloc_truth(recordings: Path) -> Truth:
    """smartLoc Berlin, 5 Hz: ECEF as given; seconds of the file from `SMARTLOC_START`."""
    path = _folder(recordings, "smartloc_berlin") / "Berlin_Potsdamer_Platz_GT.txt"
    rows = np.array([line.split()[1:5] for line in path.read_text().splitlines() if line.strip()], dtype=np.float64)
    return SMARTLOC_START + timedelta(rows[:, 0]), rows[:, 1:]


def smartloc_rinex_truth(folder: Path) -> Truth:
    """smartLoc Berlin as recorded: ECEF, seconds from the log's first epoch."""
    rows = np.loadtxt(folder / "Berlin_Potsdamer_Platz_RTK_GT.txt", usecols=range(1, 5))
    return np.datetime64("2016-06-06T11:10:41.7", "ns") + timedelta(rows[:, 0]), rows[:, 1:]


def japan_truth(recordings: Path) -> Truth:
    """mosaic-X5 in Japan, 1 Hz: RTK positions, fixed ones only."""
    log = read_positions(_folder(recordings, "japan_mosaic") / "rtklib_rtk_ref_l1_GE.pos")
    fixed = log.quality == 1
    return log.time[fixed], log.ecef_m[fixed]


#: Every recording with a reference, by a short name.
TRUTHS: Final = {"urbannav": urbannav_truth, "gsdc": gsdc_truth, "smartloc": smartloc_truth, "japan": japan_truth}


def write_truth_csv(truth: Truth, path: Path) -> Path:
    """The reference as CSV that ``railfix map from-positions`` reads."""
    time, ecef_m = truth
    latitude, longitude, height = geodetic_from_ecef(ecef_m)
    rows = zip(np.datetime_as_string(time, unit="ns"), latitude, longitude, height, strict=True)
    lines = [
        "time_gpst,latitude_deg,longitude_deg,height_m",
        *(f"{t},{a:.10f},{b:.10f},{h:.4f}" for t, a, b, h in rows),
    ]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path
