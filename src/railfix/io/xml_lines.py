"""Readers of tracks, routes and lines in GPX (1.0, 1.1) and KML (2.2, with Google's gx:Track)."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import FilePath, read_bytes

Element = ElementTree.Element


@dataclass(frozen=True, kw_only=True)
class XmlLine:
    """Line of a GPX or KML file, n points."""

    fields: dict[str, str]  #: ``name`` of the line, blank if absent, and the ``ExtendedData`` of a KML line.
    points: Floats  #: Longitude, latitude [deg] and height [m] as written; NaN where missing, shape (n, 3).
    geoid_m: Floats  #: Geoid height of each point (GPX ``geoidheight``) [m]; NaN where missing, shape (n,).
    time: tuple[str, ...]  #: UTC time of each point as written, n strings; blank where missing.


def read_root(path: FilePath) -> Element:
    """Return the root element of an XML file; raise InputFileError if the file is not XML."""
    content = read_bytes(path).rstrip(b"\0")  # a power cut may leave zero bytes at the end
    try:
        text: str | bytes = content.decode("utf-8")
    except UnicodeDecodeError:  # the parser uses the encoding that the file declares
        text = content
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputFileError(path, f"this is not XML ({error})", line=error.position[0]) from None


def tag(element: Element) -> str:
    """Return the name of an element without its namespace."""
    return element.tag.rsplit("}", 1)[-1]


def _texts(element: Element) -> dict[str, str]:
    """Return the text of each child element by the element's name."""
    return {tag(child): (child.text or "").strip() for child in element}


def read_gpx_lines(path: FilePath) -> list[XmlLine]:
    """Return the track segments and routes of a GPX file; raise InputFileError if a point has no valid position."""
    lines = []
    for owner in read_root(path):
        if tag(owner) not in ("trk", "rte"):
            continue
        for part in [child for child in owner if tag(child) == "trkseg"] if tag(owner) == "trk" else [owner]:
            points = [child for child in part if tag(child) in ("trkpt", "rtept")]
            texts = [_texts(point) for point in points]
            places = []
            for number, (point, own) in enumerate(zip(points, texts, strict=True), start=1):
                cells = [point.get("lon"), point.get("lat"), own.get("ele") or "nan", own.get("geoidheight") or "nan"]
                places.append(_numbers(path, f"point {number} of a {tag(owner)}", cells))
            if points:
                values = np.array(places)
                time = tuple(own.get("time", "") for own in texts)
                fields = {"name": _texts(owner).get("name", "")}
                lines.append(XmlLine(fields=fields, points=values[:, :3], geoid_m=values[:, 3], time=time))
    return lines


def read_kml_lines(path: FilePath) -> list[XmlLine]:
    """Return the lines and tracks of a KML file. Heights of lines that are clamped to the ground are ignored.

    Raise InputFileError if a coordinate is not a number, or if heights are relative to the ground or sea floor.
    """
    lines = []
    for mark in (element for element in read_root(path).iter() if tag(element) == "Placemark"):
        name = _texts(mark).get("name", "")
        given = [child for child in mark.iter() if tag(child) in ("SimpleData", "Data")]
        fields = {"name": name} | {child.get("name", ""): "".join(child.itertext()).strip() for child in given}
        for part in (element for element in mark.iter() if tag(element) in ("LineString", "Track")):
            mode = _texts(part).get("altitudeMode", "")
            if mode.startswith("relativeTo"):
                raise InputFileError(
                    path, f"its altitudeMode is {mode}, which gives no track height; write absolute or no heights"
                )
            rows = [_numbers(path, f"a coordinate of {name!r}", cells) for cells in _kml_cells(part)]
            if not rows:
                continue
            values = np.array([(*row, np.nan)[:3] for row in rows])
            if mode.startswith("clampTo"):
                values[:, 2] = np.nan
            time = tuple((child.text or "").strip() for child in part if tag(child) == "when") or ("",) * len(rows)
            lines.append(XmlLine(fields=fields, points=values, geoid_m=np.full(len(rows), np.nan), time=time))
    return lines


def _kml_cells(part: Element) -> Iterator[Sequence[str | None]]:
    """Yield longitude, latitude and height (if written) of each point in a LineString or gx:Track."""
    for child in part:
        if tag(child) == "coordinates":
            yield from ([*text.split(",")] for text in (child.text or "").replace(", ", ",").split())
        elif tag(child) == "coord":
            yield [*(child.text or "").split()]


def _numbers(path: FilePath, where: str, cells: Sequence[str | None]) -> list[float]:
    """Return a point's coordinates as numbers. Raise InputFileError if they are invalid."""
    if comma := next((cell for cell in cells if "," in str(cell)), None):
        raise InputFileError(path, f"{where}: {comma} has a comma in a number; a decimal point was expected")
    try:
        values = [float(str(cell)) for cell in cells]
    except ValueError:
        values = []
    if not 2 <= len(values) <= 4 or not (abs(values[0]) <= 360.0 and abs(values[1]) <= 90.0):
        raise InputFileError(path, f"{where}: {', '.join(map(str, cells))} are not longitude, latitude and height")
    return values
