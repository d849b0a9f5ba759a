"""Positions from NMEA 0183 (GGA with RMC or ZDA), GPX and NovAtel logs."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from operator import xor
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes
from railfix.core.errors import InputFileError
from railfix.core.files import BrokenLines, FilePath, ending, read_text, read_text_lines
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.timescale import SECONDS_PER_DAY, from_week, timedelta, utc_to_gpst
from railfix.gnss.observations import first_problems
from railfix.io.position_log import PositionLog, read_positions
from railfix.io.receiver.framing import is_receiver_log, read_head
from railfix.io.receiver.log import read_receiver_positions

#: Quality as RTKLIB numbers it, by the position type of NovAtel.
_QUALITY: Final = {"INT": 1, "FLOAT": 2, "WAAS": 3, "SBAS": 3, "PSRDIFF": 4, "PPP": 6, "SINGLE": 5, "PSRSP": 5}


def read_gpx_positions(path: FilePath) -> PositionLog:
    """Read the track points of GPX 1.0 or 1.1 (UTC); heights without ``geoidheight`` are kept, with a note."""
    try:
        root = ElementTree.fromstring(read_text(path))
    except ElementTree.ParseError as error:
        raise InputFileError(path, f"this is not XML ({error.msg})", line=error.position[0]) from None
    points = [node for node in root.iter() if node.tag.rsplit("}", 1)[-1] == "trkpt"]
    if not points:
        raise InputFileError(path, "there is no track point (trkpt) in this GPX file")
    rows = []
    for node in points:
        texts = {child.tag.rsplit("}", 1)[-1]: (child.text or "").strip() for child in node}
        try:
            heights = [texts.get(name) or "nan" for name in ("ele", "geoidheight")]
            rows.append([float(text) for text in (node.attrib["lat"], node.attrib["lon"], *heights)])
        except (KeyError, ValueError):
            raise InputFileError(path, f"track point {len(rows) + 1} has no latitude and longitude") from None
    stamps = [next((c.text or "" for c in n if c.tag.rsplit("}", 1)[-1] == "time"), "").strip() for n in points]
    try:
        utc = np.array([s.removesuffix("Z") or "NaT" for s in stamps], dtype="datetime64[ns]")
    except ValueError:
        raise InputFileError(path, "a time is not UTC such as 2024-01-01T10:00:00Z") from None
    values = np.array(rows, dtype=np.float64)
    geoid = np.nan_to_num(values[:, 3])
    notes = (
        () if np.isfinite(values[:, 3]).all() else (f"{path}: heights of GPX are above the geoid; kept as they are",)
    )
    return PositionLog(
        path=str(path),
        time=utc_to_gpst(utc),
        ecef_m=ecef_from_geodetic(values[:, 0], values[:, 1], np.nan_to_num(values[:, 2]) + geoid),
        quality=np.full(len(values), -1),
        sigma_m=np.full((len(values), 3), np.nan),
        line=np.arange(1, len(values) + 1),
        notes=notes,
    )


def read_novatel_positions(path: FilePath) -> PositionLog:
    """Read the BESTPOSA, BESTGNSSPOSA and INSPVAA (INSPVASA, INSPVAXA) logs of a NovAtel receiver (SPAN)."""
    rows: list[tuple[float, ...]] = []
    lines: list[int] = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        name = line.lstrip("#%").split(",", 1)[0]
        if name not in ("BESTPOSA", "BESTGNSSPOSA", "INSPVAA", "INSPVASA", "INSPVAXA") or ";" not in line:
            continue
        header, body = (part.split(",") for part in line.split("*")[0].split(";", 1))
        try:
            week, seconds = header[1:3] if name == "INSPVASA" else header[5:7]
            if name.endswith("POSA") and body[0] != "SOL_COMPUTED":
                continue
            if name not in ("INSPVAA", "INSPVASA"):
                kind = next((q for word, q in _QUALITY.items() if word in body[1]), 5)
                latitude, longitude, level, undulation = (float(v) for v in body[2:6])
                first = 7 if name.endswith("POSA") else 12
                sigmas = tuple(float(v) for v in body[first : first + 3])
                rows.append((float(week), float(seconds), latitude, longitude, level + undulation, kind, *sigmas))
            else:
                latitude, longitude, height = (float(v) for v in body[2:5])
                rows.append((float(week), float(seconds), latitude, longitude, height, -1, *[np.nan] * 3))
        except (ValueError, IndexError):
            raise InputFileError(path, f"the {name} log is broken", line=number) from None
        lines.append(number)
    if not rows:
        raise InputFileError(path, "there is no BESTPOSA, INSPVAA, INSPVASA or INSPVAXA log with a position")
    values = np.array(rows, dtype=np.float64)
    return PositionLog(
        path=str(path),
        time=from_week(values[:, 0].astype(np.int64), values[:, 1]),
        ecef_m=ecef_from_geodetic(values[:, 2], values[:, 3], values[:, 4]),
        quality=values[:, 5].astype(np.int64),
        sigma_m=values[:, 6:9],
        line=np.array(lines),
    )


#: GGA's quality (NMEA 0183 4.10, field 6) as RTKLIB's (`position_log.PositionLog`); others are 0, no position.
QUALITY: Final = {1: 5, 2: 4, 3: 5, 4: 1, 5: 2, 9: 3}


@dataclass(frozen=True)
class _Gga:
    """One GGA sentence: line, seconds of the day, quality, latitude, longitude, ellipsoidal height."""

    line: int
    of_day_s: float
    quality: int
    geodetic: tuple[float, float, float]


@dataclass(frozen=True)
class _Date:
    """One RMC or ZDA sentence: line, seconds of the day, day."""

    line: int
    of_day_s: float
    day: np.datetime64


def read_nmea(path: FilePath, *, broken_lines: BrokenLines = "stop", date: np.datetime64 | None = None) -> PositionLog:
    """Read the GGA sentences of an NMEA log.

    Parameters
    ----------
    path : path
        Text, .gz too; sentences of other kinds are skipped.
    broken_lines : {"stop", "count"}
        A sentence with a wrong checksum or invalid fields is an error, or is skipped and noted.
    date : datetime64, optional
        UTC date of the first GGA, for logs without RMC and ZDA.

    Returns
    -------
    PositionLog
        Times in GPS time; qualities as RTKLIB numbers them (`QUALITY`), 1 a fix.

    Raises
    ------
    InputFileError
        No GGA, a broken sentence, no date, or heights without the geoid's separation.
    """
    problems: list[InputFileError] = []
    fixes: list[_Gga] = []
    dates: list[_Date] = []
    for number, fields in _sentences(path, problems):
        kind = fields[0][2:]
        try:
            if kind == "GGA":
                fixes.append(_gga(number, fields))
            elif kind in _DATED and fields[1] and (dated := _DATED[kind](number, fields)):
                dates.append(dated)
        except (ValueError, IndexError) as error:
            reason = str(error) if str(error).startswith("height") else f"a field of {kind} is invalid"
            problems.append(InputFileError(path, reason, line=number))
    if problems and broken_lines == "stop":
        raise problems[0]
    if not fixes:
        raise InputFileError(path, "there is no GGA sentence; an NMEA log with GGA was expected")
    if date is not None:
        dates = [_Date(fixes[0].line, fixes[0].of_day_s, date.astype("datetime64[D]"))]
    if not dates:
        raise InputFileError(
            path, "there is no RMC or ZDA sentence, the date is unknown; log one of them, or give the date"
        )
    notes = first_problems((str(problem) for problem in problems), count=len(problems))
    return PositionLog(
        path=str(path),
        time=_times(fixes, dates, chained=date is not None),
        ecef_m=ecef_from_geodetic(*np.array([fix.geodetic for fix in fixes]).T),
        quality=np.array([fix.quality for fix in fixes], dtype=np.int64),
        sigma_m=np.full((len(fixes), 3), np.nan),
        line=np.array([fix.line for fix in fixes], dtype=np.int64),
        notes=(f"{path}: times converted from UTC to GPS time", *notes),
    )


def _sentences(path: FilePath, problems: list[InputFileError]) -> Iterator[tuple[int, list[str]]]:
    """Yield line number and fields of every sentence with a correct checksum."""
    for number, line in enumerate(read_text_lines(path), start=1):
        text = line.strip()
        if not text:
            continue
        body, star, checksum = text[1:].partition("*")
        if text[0] != "$" or not star:
            what = "has no checksum" if text[0] == "$" else "does not begin with $"
            problems.append(InputFileError(path, f"this sentence {what}; NMEA 0183 was expected", line=number))
            continue
        total = reduce(xor, body.encode("latin-1"), 0)
        if checksum[:2].upper() != f"{total:02X}":
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
    position = (np.nan, np.nan, np.nan)
    if fields[2] and fields[4]:
        if not fields[9] or not fields[11]:
            raise ValueError("height or geoid separation is missing in GGA; let the receiver write both")
        latitude, longitude = _angle(fields[2], fields[3], "S", 2), _angle(fields[4], fields[5], "W", 3)
        if abs(latitude) > 90.0 or abs(longitude) > 180.0:
            raise ValueError("range")
        position = (latitude, longitude, float(fields[9]) + float(fields[11]))
    return _Gga(line, _of_day(fields[1]) if fields[1] else np.nan, quality, position)


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
    """Compute the GPS time of each fix by the nearest date sentence; with one date (`chained`) count midnights."""
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


def read_any_positions(
    path: FilePath,
    *,
    broken_lines: BrokenLines = "stop",
    date: np.datetime64 | None = None,
    columns: Mapping[str, str] | None = None,
) -> PositionLog:
    """Read a log of positions of any kind, by its ending.

    NMEA (``.nmea``, ``.nma``, ``.gga``), GPX (``.gpx``), NovAtel ASCII (``.asc``, ``.ascii``, ``.gps``), receiver logs
    by their content (`railfix.io.receiver.log`), else `read_positions`.

    Parameters
    ----------
    path : path
    broken_lines : {"stop", "count"}
    date : datetime64, optional
        For NMEA (see `read_nmea`), and UBX logs whose positions have no date.
    columns : mapping of str, optional
        See `read_positions`.
    """
    if columns:
        return read_positions(path, columns=columns)
    if ending(path) in (".nmea", ".nma", ".gga"):
        return read_nmea(path, broken_lines=broken_lines, date=date)
    if ending(path) == ".gpx":
        return read_gpx_positions(path)
    if ending(path) in (".asc", ".ascii", ".gps"):
        return read_novatel_positions(path)
    if ending(path) != ".csv" and is_receiver_log(read_head(path)):
        return read_receiver_positions(path, date=date)
    return read_positions(path)
