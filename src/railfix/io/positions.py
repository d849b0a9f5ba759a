"""Reader of position logs; the kind of a log is detected from its content."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import take_rows
from railfix.core.errors import InputFileError, NoPositionError, SettingsError
from railfix.core.files import BrokenLines, FilePath
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.notebook import plural
from railfix.core.staged_files import check_path
from railfix.core.timescale import from_week, utc_to_gpst
from railfix.gnss.joined_observations import first_problems
from railfix.io.file_kind import FileKind, find_kind, wrong_kind
from railfix.io.nmea import read_nmea
from railfix.io.position_log import PositionLog, parse_csv_positions, parse_rtklib_positions, skip_broken
from railfix.io.receiver.log import read_receiver_positions
from railfix.io.xml_lines import read_gpx_lines

#: RTKLIB quality for each word that a NovAtel position type may contain.
_QUALITY: Final = {"INT": 1, "FLOAT": 2, "WAAS": 3, "SBAS": 3, "PSRDIFF": 4, "PPP": 6, "SINGLE": 5, "PSRSP": 5}


def _read_gpx(path: FilePath) -> PositionLog:
    """Read the points of tracks and routes in GPX 1.0 or 1.1; GPX times are in UTC.

    Heights without ``geoidheight`` are used as ellipsoidal heights, with a note.
    """
    lines = read_gpx_lines(path)
    if not lines:
        raise InputFileError(path, "has no point of a track or route (trkpt, rtept)")
    points = np.concatenate([line.points for line in lines])
    geoid = np.concatenate([line.geoid_m for line in lines])
    try:
        stamps = [stamp.removesuffix("Z") or "NaT" for line in lines for stamp in line.time]
        utc = np.array(stamps, dtype="datetime64[ns]")
    except ValueError:
        raise InputFileError(path, "a time is not in the form 2024-01-01T10:00:00Z (UTC)") from None
    known = np.isfinite(points[:, 2])
    notes = [f"{path}: GPX heights above the geoid are taken as ellipsoidal"] if (known & np.isnan(geoid)).any() else []
    if not known.all():
        notes.append(f"{path}: {int((~known).sum()):,} of {len(points):,} points have no height (ele)")
    return PositionLog(
        path=str(path),
        time=utc_to_gpst(utc),
        ecef_m=ecef_from_geodetic(points[:, 1], points[:, 0], points[:, 2] + np.nan_to_num(geoid)),
        quality=np.full(len(points), -1),
        sigma_m=np.full((len(points), 3), np.nan),
        line=np.arange(1, len(points) + 1),
        notes=tuple(notes),
        plan_deg=None if known.all() else points[:, 1::-1],
    )


def _parse_novatel(text: list[str], path: FilePath) -> PositionLog:
    """Parse the BESTPOSA, BESTGNSSPOSA, INSPVAA, INSPVASA and INSPVAXA logs of a NovAtel receiver (SPAN).

    BESTPOSA and BESTGNSSPOSA logs whose status is not SOL_COMPUTED are left out.
    """
    rows: list[tuple[float, ...]] = []
    lines: list[int] = []
    for number, line in enumerate(text, start=1):
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
            raise InputFileError(path, f"the {name} log cannot be read", line=number) from None
        lines.append(number)
    if not rows:
        raise InputFileError(path, "there is no BESTPOSA, BESTGNSSPOSA, INSPVAA, INSPVASA or INSPVAXA with a position")
    values = np.array(rows, dtype=np.float64)
    return PositionLog(
        path=str(path),
        time=from_week(values[:, 0].astype(np.int64), values[:, 1]),
        ecef_m=ecef_from_geodetic(values[:, 2], values[:, 3], values[:, 4]),
        quality=values[:, 5].astype(np.int64),
        sigma_m=values[:, 6:9],
        line=np.array(lines),
    )


#: Rows are sorted by time if all rows have times and no time goes back by more than this [s]. Otherwise the rows stay
#: in the order of the file.
_SORTED_S: Final = 60.0


def read_positions(
    path: FilePath,
    *,
    broken_lines: BrokenLines = "stop",
    date: np.datetime64 | None = None,
    columns: Mapping[str, str] | None = None,
    heights: Literal["needed", "optional"] = "needed",
    antennas: Literal["one", "several"] = "one",
) -> PositionLog:
    """Read a position log of any kind, detected from its content.

    Parameters
    ----------
    path : path
        An RTKLIB solution, a table with named columns (CSV), NMEA, GPX, NovAtel ASCII, or a receiver log with positions
        (UBX, SBF); plain or compressed.
    broken_lines : {"stop", "count"}
        With "stop", a malformed line raises InputFileError; with "count", it is skipped and noted. An incomplete last
        line is always skipped.
    date : datetime64, optional
        For an NMEA log without dates, the UTC date of the first position (see `railfix.io.nmea.read_nmea`). For a UBX
        log whose positions have no date, any time within half a week of the log.
    columns : mapping of str, optional
        For each of railfix's column names, the column name in the file, such as ``{"latitude_deg": "Lat"}``.
    heights : {"needed", "optional"}
        With "needed", a file without any height raises InputFileError.
    antennas : {"one", "several"}
        With "one", a table with positions of several antennas raises InputFileError.

    Returns
    -------
    PositionLog
        All rows and columns of the file. If times go back, a note states this. In this case, the rows are sorted by
        time, provided that every row has a time and no time goes back by more than one minute.

    Raises
    ------
    InputFileError
        The file is not a position log, a line is malformed, heights are missing, or there are several antennas.
    NoPositionError
        No row has a position.
    SettingsError
        `columns` names a column unknown to railfix, or is given for a file that is not a table.
    """
    check_path(path)
    kind = find_kind(path)
    if columns and kind != "table":
        raise SettingsError(f"{path}: only the columns of a table with names can be renamed; leave out --column")
    parsers: dict[FileKind, Callable[[list[str]], PositionLog]] = {
        "table": lambda lines: parse_csv_positions(lines, path, columns or {}),
        "novatel": lambda lines: _parse_novatel(lines, path),
        "rtklib": lambda lines: parse_rtklib_positions(lines, path),
    }
    if kind in parsers:
        log, skipped = skip_broken(path, parsers[kind], broken_lines=broken_lines)
        log = replace(log, notes=(*log.notes, *first_problems(skipped, count=len(skipped))))
    elif kind == "nmea":
        log = read_nmea(path, broken_lines=broken_lines, date=date)
    elif kind == "receiver":
        log = read_receiver_positions(path, date=date)
    elif kind == "gpx":
        log = _read_gpx(path)
    else:
        raise wrong_kind(
            path, "a position log: an RTKLIB solution (.pos), NMEA, GPX, NovAtel ASCII, UBX, SBF, or a table (CSV)"
        )
    if antennas == "one" and len(log.antennas) > 1:
        raise InputFileError(path, f"has positions of {' and '.join(log.antennas)}; give the positions of one antenna")
    if np.isnan(log.geodetic[0]).all():
        raise NoPositionError(f"{path}: has {plural(len(log), 'row')}, but none with a position")
    if heights == "needed" and log.plan_deg is not None and np.isnan(log.ecef_m).all():
        raise InputFileError(path, "the positions have no height; expected heights above the ellipsoid (height_m)")
    return _in_order(log)


def _in_order(log: PositionLog) -> PositionLog:
    """Sort the log by time if no time goes back by more than `_SORTED_S`; add a note if any time goes back."""
    known = np.flatnonzero(~np.isnat(log.time))
    time = log.time[known]
    back = np.flatnonzero(np.diff(time) < np.timedelta64(0, "ns")) + 1
    if not len(back):
        return log
    longest = float(np.max(np.maximum.accumulate(time) - time) / np.timedelta64(1, "s"))
    where = f"{log.path}, line {log.line[known[back[0]]]}: the time goes back"
    times = "" if len(back) == 1 else f", and again at {plural(len(back) - 1, 'later row')}"
    if longest > _SORTED_S or len(known) < len(log):
        note = f"{where} by {longest:,.1f} s{times}; the rows stay in the order of the file"
        return replace(log, notes=(*log.notes, note))
    rows = np.argsort(log.time, kind="stable")
    table = None if log.table is None else log.table.take(rows)
    notes = (*log.notes, f"{where}{times}; the rows were sorted by time")
    return replace(take_rows(log, rows), table=table, notes=notes)
