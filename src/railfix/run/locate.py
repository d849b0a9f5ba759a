"""Logs of one receiver to conventional 3-D positions, without a track map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers
from railfix.core.errors import NoPositionError
from railfix.core.files import write_whole
from railfix.core.geodesy import geodetic_from_ecef
from railfix.gnss.observations import Observations
from railfix.io.logs import read_navigation
from railfix.pipeline.channels import ChannelBook
from railfix.pipeline.config import Config
from railfix.pipeline.locate import locate
from railfix.pipeline.received import Received, known_from_start
from railfix.run.inputs import InputFiles, LogReading, input_option
from railfix.run.sources import Log
from railfix.track.trajectory import Trajectory


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
    inputs: LocateInputs, config: Config, *, out: Path, reading: LogReading | None = None
) -> LocateSummary:
    """Compute positions of a log and write them as an RTKLIB solution file with quality 5 (single)."""
    inputs.check_files()
    date = (reading or LogReading()).instant
    received = known_from_start(config, navigation=read_navigation(inputs.nav, date=date))
    log = Log(paths=inputs.log, chunk_epochs=_CHUNK_EPOCHS, date=date)
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


#: Epochs that are tried, and how near the line a position is on it, in plan [m].
_EPOCHS: Final = 5
#: Epochs of a log that are positioned together.
_CHUNK_EPOCHS: Final = 3000
_ON_LINE_M: Final = 150.0
#: Positions so far above or below the line have another cause than errors of ranges [m].
_HEIGHT_M: Final = 30.0
#: Seconds between GPS time and UTC since 2017; BeiDou time is 14 s behind GPS time.
_LEAP_S: Final = 18
_BEIDOU_S: Final = 14
#: Hours between time zones that are tried.
_HOURS: Final = 14
_FEET: Final = 0.3048


def likely_cause(observations: Observations, received: Received, config: Config, line: Trajectory) -> str:
    """Return why the positions of a log may lie off the line, in a clause; "" where nothing was found.

    Conventional positions of some epochs are compared with the line: in height, and with the time tags shifted by leap
    seconds and by whole hours.
    """
    step = max(len(observations) // _EPOCHS, 1)
    few = observations[: step * _EPOCHS : step]
    as_tagged = _offset_m(few, received, config, line)
    if as_tagged is not None and as_tagged[0] < _ON_LINE_M:
        return _cause_in_height(*as_tagged[1:]) if abs(as_tagged[1]) > _HEIGHT_M else ""
    for shift_s in _shifts_s():
        shifted = replace(few, time=few.time + np.timedelta64(shift_s, "s"))
        offset = _offset_m(shifted, received, config, line)
        if offset is not None and offset[0] < _ON_LINE_M:
            return (
                f"with time tags {_duration(abs(shift_s))} {'later' if shift_s > 0 else 'earlier'} its positions lie "
                "on the line: are the tags UTC or local time, or is the time system in its header wrong?"
            )
    if as_tagged is None:
        return ""
    return f"its positions lie {as_tagged[0]:,.0f} m beside the line: is this the right track?"


def _shifts_s() -> Iterator[int]:
    """Give shifts of time tags that mistakes make, the smallest first [s]."""
    for seconds in (_LEAP_S, _BEIDOU_S):
        yield from (seconds, -seconds)
    for hours in range(1, _HOURS + 1):
        for sign in (-1, 1):
            yield from (sign * hours * 3600, sign * hours * 3600 + _LEAP_S, sign * hours * 3600 - _LEAP_S)


def _offset_m(
    observations: Observations, received: Received, config: Config, line: Trajectory
) -> tuple[float, float, float] | None:
    """Return the offset of the positions from the line in plan and height, and the line's height [m]."""
    ecef: Floats = locate(observations, received, config, ChannelBook(config)).ecef_m
    if not np.isfinite(ecef[:, 0]).any():
        return None
    place = np.nanmedian(ecef, axis=0)
    arc, _ = line.nearest(place[None])
    height = float(geodetic_from_ecef(place)[2])
    of_line = float(geodetic_from_ecef(line.at_arc(arc)[0])[2])
    # moved to the height of the line, where it may be of any height
    level = place * (1.0 + (of_line - height) / float(np.linalg.norm(place)))
    return float(line.nearest(level[None])[1][0]), height - of_line, of_line


def _cause_in_height(above_m: float, of_line_m: float) -> str:
    """Say that the line is too high or too low, and which unit explains it."""
    height = of_line_m + above_m
    feet = abs(of_line_m * _FEET - height) < abs(above_m) / 4.0
    hint = "are the heights of the map in feet?" if feet else "is the height datum of the map the right one?"
    return f"its positions lie {abs(above_m):.0f} m {'above' if above_m > 0.0 else 'below'} the line: {hint}"


def _duration(seconds: int) -> str:
    hours, rest = divmod(seconds + _LEAP_S, 3600)
    rest -= _LEAP_S
    return " ".join([*([f"{hours} h"] if hours else []), *([f"{rest:+d} s" if hours else f"{rest} s"] if rest else [])])
