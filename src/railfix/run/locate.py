"""Logs of one receiver to conventional 3-D positions, without a track map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers
from railfix.core.errors import NoPositionError
from railfix.core.files import BrokenLines, write_whole
from railfix.core.geodesy import geodetic_from_ecef
from railfix.io.logs import read_navigation
from railfix.pipeline.channels import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.locate import locate
from railfix.pipeline.received import known_from_start
from railfix.run.inputs import InputFiles, input_option
from railfix.run.options import LogReading
from railfix.run.sources import Log


class LocateInputs(InputFiles):
    """Input files of `railfix locate`."""

    log: tuple[Path, ...] = input_option("Observations of one receiver: RINEX, UBX, SBF, RTCM 3.", metavar="OBS")
    nav: tuple[Path, ...] = input_option("Navigation files.", metavar="NAV")


@dataclass(frozen=True, kw_only=True)
class LocateSummary:
    """Counts of a log: epochs, positions, and median standard deviations north, east, up [m]."""

    epochs: int
    positions: int
    sigma_m: tuple[float, float, float]
    notes: tuple[str, ...]


def locate_files(
    inputs: LocateInputs,
    config: Config,
    *,
    out: Path,
    reading: LogReading | None = None,
    broken_lines: BrokenLines = "stop",
    chunk_epochs: int = 3000,
) -> LocateSummary:
    """Compute positions of a log and write them as an RTKLIB solution file with quality 5 (single).

    Raises
    ------
    InputFileError, SettingsError, OutputError, NoPositionError
        No epoch has a position, or a file is not what it should be.
    """
    inputs.check_files()
    date = (reading or LogReading()).instant
    received = known_from_start(config, navigation=read_navigation(inputs.nav, broken_lines=broken_lines, date=date))
    log = Log(paths=inputs.log, chunk_epochs=chunk_epochs, broken_lines=broken_lines, date=date)
    book = ChannelBook(config)
    parts = [locate(part, received, config, book) for part in log.parts()]
    if not any(np.isfinite(part.ecef_m).any() for part in parts):
        raise NoPositionError(
            f"{inputs.log[0]}: no epoch has a position; are the navigation files of the day of the log?"
        )
    time, ecef, sigma, used = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("time", "ecef_m", "sigma_m", "n_used")
    )
    write_whole(out, solution_text(time, ecef, sigma, used))
    known = np.isfinite(ecef[:, 0])
    medians = [float(v) for v in np.median(sigma[known], axis=0)]
    return LocateSummary(
        epochs=len(time),
        positions=int(known.sum()),
        sigma_m=(medians[0], medians[1], medians[2]),
        notes=(*received.notes, *log.problems),
    )


def solution_text(time: Datetimes, ecef_m: Floats, sigma_m: Floats, n_used: Integers) -> str:
    """Positions as RTKLIB's solution format (GPST, latitude, longitude, ellipsoidal height, sigmas)."""
    lines = [
        "% program   : railfix locate",
        "% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)",
        "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  "
        "sdeu(m)  sdun(m) age(s)  ratio",
    ]
    known = np.flatnonzero(np.isfinite(ecef_m[:, 0]))
    latitude, longitude, height = geodetic_from_ecef(ecef_m[known])
    stamps = np.datetime_as_string(time[known], unit="ms")
    rows: Any = zip(stamps, latitude, longitude, height, n_used[known], sigma_m[known], strict=True)
    for stamp, lat, lon, up, count, (north, east, vertical) in rows:
        day, clock = str(stamp).replace("-", "/").split("T")
        lines.append(
            f"{day} {clock} {lat:14.9f} {lon:14.9f} {up:10.4f} {5:3d} {count:3d} {north:8.4f} {east:8.4f} "
            f"{vertical:8.4f} {0.0:8.4f} {0.0:8.4f} {0.0:8.4f} {0.0:6.2f} {0.0:6.1f}"
        )
    return "\n".join(lines) + "\n"
