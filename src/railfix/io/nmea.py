"""Reader of NMEA 0183 logs: positions from GGA, dates from RMC or ZDA."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.core.errors import InputFileError
from railfix.core.files import LENIENT, BrokenLines, FilePath, read_text_lines
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.timescale import SECONDS_PER_DAY, timedelta, utc_to_gpst
from railfix.gnss.joined_observations import first_problems
from railfix.io.position_log import PositionLog

#: Names of the counts of lines that are unusual but no errors.
_OTHER_LINES, _UNCHECKED = (
    "skipped lines that are not NMEA 0183 sentences",
    "sentences without checksum",
)
#: A geoid separation of 0 is reported as doubtful if the geoid is at least this far from the ellipsoid [m].
_GEOID_M: Final = 2.0
#: RTKLIB quality (`PositionLog.quality`) for each GGA quality indicator (NMEA 0183 4.10, field 6); others mean 0.
QUALITY: Final = {1: 5, 2: 4, 3: 5, 4: 1, 5: 2, 9: 3}


@dataclass(frozen=True)
class _Gga:
    """GGA sentence."""

    line: int
    of_day_s: float  #: UTC time of day, NaN if blank.
    quality: int  #: RTKLIB quality (`QUALITY`).
    geodetic: tuple[float, float, float]  #: Latitude, longitude [deg] and ellipsoidal height [m]; NaN if unknown.
    separation_m: float  #: Height of the geoid above the ellipsoid, NaN if blank.


@dataclass(frozen=True)
class _Date:
    """Date and time of an RMC or ZDA sentence."""

    line: int
    of_day_s: float  #: UTC time of day.
    day: np.datetime64  #: UTC date.


def read_nmea(path: FilePath, *, broken_lines: BrokenLines = "stop", date: np.datetime64 | None = None) -> PositionLog:
    """Read the GGA sentences of an NMEA log.

    Parameters
    ----------
    path : path
        Text file, plain or compressed. Only GGA, RMC and ZDA sentences are used; text before the ``$`` of a sentence is
        ignored. A sentence may lack its checksum.
    broken_lines : {"stop", "count"}
        With "stop", a sentence with a wrong checksum or invalid fields raises InputFileError. With "count", the
        sentence is skipped and noted. A malformed last line is always skipped and noted.
    date : datetime64, optional
        UTC date of the first GGA sentence, for logs without RMC and ZDA. If the log has dates, `date` overrides them.

    Returns
    -------
    PositionLog
        Times are in GPS time. Qualities are RTKLIB numbers (`QUALITY`). A position whose height or geoid separation is
        missing is NaN in `ecef_m`; its latitude and longitude are in `plan_deg`.

    Raises
    ------
    InputFileError
        The file has no GGA sentence or no date, or a sentence is malformed and `broken_lines` is "stop".
    """
    problems: list[InputFileError] = []
    fixes: list[_Gga] = []
    dates: list[_Date] = []
    counts: Counter[str] = Counter()
    lines = read_text_lines(path)
    for number, fields in _sentences(path, lines, problems, counts):
        kind = fields[0][2:]
        try:
            if kind == "GGA":
                fixes.append(_gga(number, fields))
            elif kind in _DATED and fields[1] and (dated := _DATED[kind](number, fields)):
                dates.append(dated)
        except (ValueError, IndexError):
            problems.append(InputFileError(path, f"a field of {kind} is invalid", line=number))
    serious = [problem for problem in problems if problem.line != len(lines)]
    if serious and broken_lines == "stop":
        raise InputFileError(path, f"{serious[0].message}; {LENIENT}", line=serious[0].line)
    if not fixes:
        raise InputFileError(path, "there is no GGA sentence; an NMEA log with GGA was expected")
    if date is not None:
        dates = [_Date(fixes[0].line, fixes[0].of_day_s, date.astype("datetime64[D]"))]
    if not dates:
        raise InputFileError(
            path, "there is no RMC or ZDA sentence, so the date is unknown; log RMC or ZDA, or give the date (--date)"
        )
    geodetic = np.array([fix.geodetic for fix in fixes])
    flat = np.isfinite(geodetic[:, 0]) & np.isnan(geodetic[:, 2])
    notes = [f"{path}: times converted from UTC to GPS time"]
    notes += [f"{path}: {count:,} {what}" for what, count in counts.items()]
    if flat.any():
        notes.append(f"{path}: {int(flat.sum()):,} of {len(fixes):,} fixes have no height or no geoid separation")
    notes += _doubt_separation(path, fixes, geodetic)
    return PositionLog(
        path=str(path),
        time=_times(fixes, dates, chained=date is not None),
        ecef_m=ecef_from_geodetic(*geodetic.T),
        quality=np.array([fix.quality for fix in fixes], dtype=np.int64),
        sigma_m=np.full((len(fixes), 3), np.nan),
        line=np.array([fix.line for fix in fixes], dtype=np.int64),
        notes=(*notes, *first_problems((f"{problem}; skipped" for problem in problems), count=len(problems))),
        plan_deg=geodetic[:, :2] if flat.any() else None,
    )


def _doubt_separation(path: FilePath, fixes: list[_Gga], geodetic: Floats) -> list[str]:
    """Return a note if the geoid separation is 0 in every fix although the geoid is far from the ellipsoid."""
    placed = np.isfinite(geodetic[:, 0])
    if not placed.any() or any(fix.separation_m != 0.0 for fix in fixes if np.isfinite(fix.separation_m)):
        return []
    if not any(fix.separation_m == 0.0 for fix in fixes):
        return []
    there = "up to 100 m"
    with suppress(ImportError):
        import sidereon

        height = float(sidereon.egm96_undulations_deg(np.median(geodetic[placed][:, :2], axis=0)[None])[0])
        if abs(height) < _GEOID_M:
            return []
        there = f"{height:.0f} m (EGM96)"
    return [
        f"{path}: the geoid separation is 0 in every fix, but the geoid is {there} from the ellipsoid; the heights are "
        "used as ellipsoidal heights, and are wrong by this distance if the receiver wrote heights above sea level"
    ]


def _sentences(
    path: FilePath, lines: list[str], problems: list[InputFileError], counts: Counter[str]
) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and fields of every sentence that has no checksum or a correct one; append errors to
    `problems`.
    """
    for number, line in enumerate(lines, start=1):
        _, dollar, text = line.partition("$")
        if not dollar:
            counts[_OTHER_LINES] += bool(line.strip())
            continue
        body, star, checksum = text.strip().partition("*")
        total = reduce(xor, body.encode("latin-1"), 0)
        if not star:
            if number == len(lines):
                problems.append(InputFileError(path, "the last sentence is cut short", line=number))
                continue
            counts[_UNCHECKED] += 1
        elif checksum[:2].upper() != f"{total:02X}":
            problems.append(
                InputFileError(path, f"the checksum is {checksum[:2]}, {total:02X} was expected", line=number)
            )
            continue
        yield number, body.split(",")


def _of_day(text: str) -> float:
    return int(text[:2]) * 3600.0 + int(text[2:4]) * 60.0 + float(text[4:])


def _angle(text: str, side: str, negative: str, degrees: int) -> float:
    if side not in ("N", "S", "E", "W"):
        raise ValueError("side")
    value = int(text[:degrees]) + float(text[degrees:]) / 60.0
    return -value if side == negative else value


def _gga(line: int, fields: list[str]) -> _Gga:
    quality = QUALITY.get(int(fields[6] or 0), 0)
    position, separation = (np.nan, np.nan, np.nan), np.nan
    if fields[2] and fields[4]:
        latitude, longitude = _angle(fields[2], fields[3], "S", 2), _angle(fields[4], fields[5], "W", 3)
        if abs(latitude) > 90.0 or abs(longitude) > 180.0:
            raise ValueError("range")
        level, separation = (float(fields[k]) if fields[k] else np.nan for k in (9, 11))
        position = (latitude, longitude, level + separation)
    return _Gga(line, _of_day(fields[1]) if fields[1] else np.nan, quality, position, separation)


def _rmc(line: int, fields: list[str]) -> _Date | None:
    text = fields[9]
    if not text:
        return None
    year = int(text[4:6])
    return _Date(line, _of_day(fields[1]), _day(year + (1900 if year >= 80 else 2000), text[2:4], text[:2]))


def _zda(line: int, fields: list[str]) -> _Date | None:
    return _Date(line, _of_day(fields[1]), _day(int(fields[4]), fields[3], fields[2])) if fields[4] else None


def _day(year: int, month: str, day: str) -> np.datetime64:
    return np.datetime64(f"{year:04d}-{int(month):02d}-{int(day):02d}", "D")


_DATED: Final[dict[str, Callable[[int, list[str]], _Date | None]]] = {"RMC": _rmc, "ZDA": _zda}


def _times(fixes: list[_Gga], dates: list[_Date], *, chained: bool) -> Datetimes:
    """Compute the GPS time of each fix. The date is taken from the preceding RMC or ZDA sentence, corrected at
    midnight. If `chained` is True, the date is instead the first date plus one day for each midnight since.
    """
    of_day = np.array([fix.of_day_s for fix in fixes])
    line = np.array([fix.line for fix in fixes])
    if chained:
        step = np.diff(of_day, prepend=of_day[:1])
        days = np.cumsum(np.nan_to_num(step) < -SECONDS_PER_DAY / 2)
        base = np.full(len(fixes), dates[0].day, dtype="datetime64[D]")
    else:
        row = np.maximum(np.searchsorted([date.line for date in dates], line, side="right") - 1, 0)
        base = np.array([date.day for date in dates], dtype="datetime64[D]")[row]
        days = -np.rint((of_day - np.array([date.of_day_s for date in dates])[row]) / SECONDS_PER_DAY)
        days = np.nan_to_num(days).astype(np.int64)
    return utc_to_gpst(base.astype("datetime64[ns]") + days.astype("timedelta64[D]") + timedelta(of_day))
