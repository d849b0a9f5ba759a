"""Positions in GPX files and in NovAtel ASCII logs (BESTPOS, INSPVA)."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from os import PathLike
from typing import Final

import numpy as np

from railfix.core.errors import InputFileError
from railfix.core.files import read_text
from railfix.core.geodesy import ecef_from_geodetic
from railfix.core.timescale import from_week, utc_to_gpst
from railfix.io.position_log import PositionLog

#: Quality as RTKLIB numbers it, by the position type of NovAtel.
_QUALITY: Final = {"INT": 1, "FLOAT": 2, "WAAS": 3, "SBAS": 3, "PSRDIFF": 4, "PPP": 6, "SINGLE": 5, "PSRSP": 5}


def read_gpx_positions(path: str | PathLike[str]) -> PositionLog:
    """Read the track points of a GPX 1.0 or 1.1 file; times are UTC there.

    Heights are above the geoid by the standard; the point's ``geoidheight`` is added where it has one, else the height
    is kept with a note. InputFileError: this is not GPX, or a point has no latitude.
    """
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
            rows.append(
                (
                    float(node.attrib["lat"]),
                    float(node.attrib["lon"]),
                    float(texts.get("ele") or "nan"),
                    float(texts.get("geoidheight") or "nan"),
                )
            )
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
    known = ~np.isnat(utc)
    time = np.full(len(utc), np.datetime64("NaT", "ns"))
    time[known] = utc_to_gpst(utc[known])
    return PositionLog(
        path=str(path),
        time=time,
        ecef_m=ecef_from_geodetic(values[:, 0], values[:, 1], np.nan_to_num(values[:, 2]) + geoid),
        quality=np.full(len(values), -1),
        sigma_m=np.full((len(values), 3), np.nan),
        line=np.arange(1, len(values) + 1),
        notes=notes,
    )


def read_novatel_positions(path: str | PathLike[str]) -> PositionLog:
    """Read the BESTPOSA, BESTGNSSPOSA and INSPVAA (INSPVASA, INSPVAXA) logs of a NovAtel receiver (SPAN).

    InputFileError: there is no such log in the file, or one is broken.
    """
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
