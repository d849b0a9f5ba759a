"""Logs of positions of any kind: one reader, which finds the kind by the content."""

from __future__ import annotations

import codecs
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, Literal

import numpy as np

from railfix.core.arrays import take_rows
from railfix.core.errors import InputFileError, SettingsError
from railfix.core.files import BrokenLines, FilePath, ending, read_text
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.tables import plural
from railfix.core.timescale import from_week, utc_to_gpst
from railfix.gnss.observations import first_problems
from railfix.io.nmea import read_nmea
from railfix.io.position_log import PositionLog, parse_csv_positions, parse_rtklib_positions, skip_broken
from railfix.io.receiver.framing import is_receiver_log, read_head
from railfix.io.receiver.log import read_receiver_positions

#: Quality as RTKLIB numbers it, by the position type of NovAtel.
_QUALITY: Final = {"INT": 1, "FLOAT": 2, "WAAS": 3, "SBAS": 3, "PSRDIFF": 4, "PPP": 6, "SINGLE": 5, "PSRSP": 5}


def _read_gpx(path: FilePath) -> PositionLog:
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


def _parse_novatel(text: list[str], path: FilePath) -> PositionLog:
    """Parse the BESTPOSA, BESTGNSSPOSA and INSPVAA (INSPVASA, INSPVAXA) logs of a NovAtel receiver (SPAN)."""
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


#: Rows that are this much out of order are sorted; those further back are left where they are [s].
_SORTED_S: Final = 60.0
_NMEA: Final = re.compile(rb"\$(?:[A-Z]{2}(?:GGA|RMC|ZDA|GSA|GSV|GLL|VTG|GNS|GST|TXT)|P[A-Z]{3})")
_NOVATEL: Final = re.compile(rb"^[#%](?:BEST(?:GNSS)?POSA|INSPVA[SX]?A|[A-Z0-9]+A),", re.MULTILINE)
_GPX: Final = re.compile(rb"<(?:\w+:)?gpx[\s>]")
_RTKLIB: Final = re.compile(rb"^%.*(?:latitude|ecef|baseline|program|GPST|UTC|JST)", re.MULTILINE)


def header_line(head: bytes) -> str:
    """Return the first line of the beginning of a text that is neither blank nor a comment; "" without any."""
    coding = "utf-16" if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    lines = head.decode(coding, "replace").splitlines()
    return next((line for line in lines if line.strip() and not line.startswith("#")), "")


def position_kind(path: FilePath) -> str:
    """Return the kind of a log of positions by its content: csv, rtklib, nmea, gpx, novatel, receiver; "" of none."""
    head = read_head(path)
    if is_receiver_log(head):
        return "receiver"
    for kind, pattern in (("gpx", _GPX), ("nmea", _NMEA), ("novatel", _NOVATEL), ("rtklib", _RTKLIB)):
        if pattern.search(head):
            return kind
    first = header_line(head)
    is_table = any(mark in first for mark in ",;\t|") and any(letter.isalpha() for letter in first)
    if ending(path) == ".csv" or (is_table and not first.lstrip().startswith(("{", "<", "["))):
        return "csv"
    return "rtklib" if ending(path) == ".pos" else ""


def read_positions(
    path: FilePath,
    *,
    broken_lines: BrokenLines = "stop",
    date: np.datetime64 | None = None,
    columns: Mapping[str, str] | None = None,
    heights: Literal["needed", "optional"] = "needed",
    antennas: Literal["one", "several"] = "one",
) -> PositionLog:
    """Read a log of positions of any kind; its content decides which.

    RTKLIB's solutions, tables with named columns (CSV), NMEA, GPX, NovAtel ASCII, and receiver logs with positions
    (UBX, SBF); plain or packed.

    Parameters
    ----------
    path : path
    broken_lines : {"stop", "count"}
        A broken line is an error, or is skipped and noted; a last line that is cut is always skipped.
    date : datetime64, optional
        For NMEA (see `railfix.io.nmea.read_nmea`), and UBX logs whose positions have no date.
    columns : mapping of str, optional
        For tables with other column names: name in railfix to name in the file, such as ``{"latitude_deg": "Lat"}``.
    heights : {"needed", "optional"}
        Whether a file without any height is an error.
    antennas : {"one", "several"}
        Whether a table with rows of several antennas is an error.

    Returns
    -------
    PositionLog
        All rows and columns of the file. Rows whose time is up to a minute too late in the file are sorted, with a
        note; larger steps back are noted.

    Raises
    ------
    InputFileError
        The file is not a log of positions, or a line of it is broken.
    SettingsError
        `columns` names a column that railfix does not know, or the file is no table.
    """
    kind = position_kind(path)
    if columns and kind != "csv":
        raise SettingsError(f"{path}: columns can be renamed in a table with named columns only")
    parsers: dict[str, Callable[[list[str]], PositionLog]] = {
        "csv": lambda lines: parse_csv_positions(lines, path, columns or {}),
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
        raise InputFileError(
            path,
            "is no log of positions: RTKLIB's solution (.pos), NMEA, GPX, NovAtel ASCII, UBX, SBF, or a table (CSV) "
            "whose first line names its columns was expected",
        )
    if antennas == "one" and len(log.antennas) > 1:
        raise InputFileError(path, f"has positions of {' and '.join(log.antennas)}; give those of one antenna")
    if heights == "needed" and log.plan_deg is not None and np.isnan(log.ecef_m).all():
        raise InputFileError(path, "its positions have no height; expected heights above the ellipsoid (height_m)")
    return _in_order(log)


read_any_positions = read_positions  #: Its former name.


def _in_order(log: PositionLog) -> PositionLog:
    """Return the log with rows that are a little late put in order, and a note on times that go back."""
    known = np.flatnonzero(~np.isnat(log.time))
    time = log.time[known]
    back = np.flatnonzero(np.diff(time) < np.timedelta64(0, "ns")) + 1
    if not len(back):
        return log
    longest = float(np.max(np.maximum.accumulate(time) - time) / np.timedelta64(1, "s"))
    where = f"{log.path}, line {log.line[known[back[0]]]}: the time goes back"
    times = "" if len(back) == 1 else f", and {plural(len(back) - 1, 'more time')} in the file"
    if longest > _SORTED_S or len(known) < len(log):
        note = f"{where} by {longest:,.1f} s{times}; the rows stay in the order of the file"
        return replace(log, notes=(*log.notes, note))
    ordered = take_rows(log, np.argsort(log.time, kind="stable"))
    return replace(ordered, notes=(*log.notes, f"{where}{times}; the rows were sorted by time"))
