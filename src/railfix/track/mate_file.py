"""Reader of the track tables of EGNSS MATE: edges of lines, circles and clothoids, with gradients and cant.

The tables are described at https://github.com/EGNSS-MATE/egnss-mate-schematics. A circle is given by its centre and the
arc length from its northernmost point. A clothoid is given by its point of zero curvature, the azimuth at this point
and the arc length from this point. The tables define neither the sign of curves nor the constant of a clothoid.
Therefore, the reader interprets both such that successive segments of an edge meet.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from railfix.core.array_functions import cheapest_path
from railfix.core.errors import InputFileError
from railfix.core.files import FilePath
from railfix.io.mate import mate_table, read_mate
from railfix.track.crs import choose_crs
from railfix.track.elements import CantElement, Design, PlanElement, ProfileElement, plan_starts, segment_of_design
from railfix.track.georeference import EllipsoidalHeights, georeference
from railfix.track.route import MapReading, Segment, make_segment

#: CRS of the points: latitude, longitude and ellipsoidal height in ETRS89.
_ETRS89: Final = "EPSG:4937"
_NUMBERS: Final = ("LATITUDE_ETRS89", "LONGITUDE_ETRS89", "ALTITUDE_ETRS89", "RADIUS", "CANT", "GRADIENT")
_POINT: Final = ("TRACK_EDGE_ID", "POSITION", *_NUMBERS[:3])


def read_edges(path: Path, reading: MapReading) -> list[Segment]:
    """Read the track edges of a table S_DM_TRACKPOINT or S_DM_TRACK_SEGMENT_POSITION as segments.

    Points of S_DM_TRACKPOINT are in ETRS89 unless `reading` gives a CRS. Raise InputFileError for an invalid table.
    """
    if mate_table(path) != "S_DM_TRACKPOINT":
        return _read_segments(path, reading)
    table = read_mate(path, _POINT).sort("TRACK_EDGE_ID", "POSITION", maintain_order=True)
    edges = table.group_by("TRACK_EDGE_ID", maintain_order=True)
    return [_segment_of_points(path, str(key[0]), rows, reading) for key, rows in edges]


def _segment_of_points(path: Path, edge: str, rows: pl.DataFrame, reading: MapReading) -> Segment:
    """Create a segment from the points of one track edge.

    The cant in the table is in millimetres. A missing or zero radius is straight track.
    """
    values = {name: rows[name].cast(pl.Float64).fill_null(np.nan).to_numpy() for name in _NUMBERS}
    for name in _NUMBERS[:3]:
        if not np.isfinite(values[name]).all():
            raise InputFileError(path, f"track edge {edge}: a point has no {name}; complete it")
    crs = reading.crs or _ETRS89
    source, radius = f"{path} ({edge})", values["RADIUS"]
    return make_segment(
        georeference(crs, values["LONGITUDE_ETRS89"], values["LATITUDE_ETRS89"], path=source),
        EllipsoidalHeights(height_m=values["ALTITUDE_ETRS89"], datum="ellipsoidal"),
        source=source,
        file=str(path),
        crs=crs,
        metadata={"name": edge},
        attributes={
            "cant_m": values["CANT"] * 1e-3,
            "radius_m": np.where(np.nan_to_num(radius) == 0.0, np.inf, radius),
            "gradient_permille": values["GRADIENT"],
        },
    )


_POSITION: Final = "S_DM_TRACK_SEGMENT_POSITION"
_GRADIENT: Final = "S_DM_TRACK_SEGMENT_GRADIENT"
_CANT: Final = "S_DM_TRACK_SEGMENT_CANT"
_SPAN: Final = ("TRACK_SEGMENT_REFERENCE_POSITION", "TRACK_SEGMENT_LENGTH")
#: A file is rejected if a gap between successive segments of an edge, computed by `_gap`, exceeds this [m].
_MEETS_M: Final = 0.5
Row = dict[str, str]


def _read_segments(path: FilePath, reading: MapReading) -> list[Segment]:
    """Read edges from S_DM_TRACK_SEGMENT_POSITION, and from the gradient and cant tables in the same folder.

    Raise InputFileError if the segments of an edge do not meet.
    """
    gradients, cants = (_rows(path, name) for name in (_GRADIENT, _CANT))
    found = []
    for edge, rows in _rows(path, None).items():
        cell = rows[0].get("UTM_CELL", "")
        of_edge = replace(reading, crs=choose_crs(path, reading.crs, _find_crs(cell)), height_datum="ellipsoidal")
        plan = _plan(str(path), edge, rows)
        profile = [_profile(str(path), row) for row in gradients.get(edge, [])]
        cant = [_cant(str(path), row, plan) for row in cants.get(edge, [])]
        design = Design(plan=plan, profile=profile, cant=cant)
        found.append(segment_of_design(path=str(path), name=edge, design=design, reading=of_edge))
    return found


def _rows(path: FilePath, table: str | None) -> dict[str, list[Row]]:
    """Return the rows of each edge, sorted by distance from the start of the edge.

    If `table` is None, the rows are from the file `path`, otherwise from the file of this table in the same folder. The
    result is empty if the file of `table` is missing.
    """
    file = Path(path)
    if table is not None:
        names = {entry.name.upper(): entry for entry in file.parent.iterdir()}
        wanted = file.name.upper().replace(_POSITION, table)
        if _POSITION not in file.name.upper() or wanted not in names:
            return {}
        file = names[wanted]
    edges: dict[str, list[Row]] = {}
    for row in read_mate(file, ("TRACK_EDGE_ID",), table or _POSITION).cast(pl.String).iter_rows(named=True):
        cells = {name: value.strip() for name, value in row.items() if value is not None}
        edges.setdefault(cells.get("TRACK_EDGE_ID", ""), []).append(cells)
    return {edge: sorted(rows, key=lambda row: _number(str(file), row, _SPAN[0])) for edge, rows in edges.items()}


def _number(path: str, row: Row, name: str) -> float:
    try:
        return float(row.get(name, ""))
    except ValueError:
        edge, kind = row.get("TRACK_EDGE_ID", ""), row.get("TRACK_SEGMENT_TYPE", "")
        raise InputFileError(
            path, f"edge {edge!r}: a {kind} has {name} {row.get(name, '')!r}; a number was expected"
        ) from None


def _find_crs(cell: str) -> str | None:
    """Return the CRS of a UTM cell ("32T"), or of the Swiss grid ("LV95"); None for any other text."""
    if cell.strip().upper() == "LV95":
        return "EPSG:2056"
    zone = re.fullmatch(r"\s*(\d{1,2})\s*([C-X])?\s*", cell.upper())
    if zone is None:
        return None
    return f"EPSG:{(327 if (zone[2] or 'N') < 'N' else 326)}{int(zone[1]):02d}"


def _plan(path: str, edge: str, rows: Sequence[Row]) -> list[PlanElement]:
    """Return the elements of an edge, interpreted such that they meet best; raise InputFileError if a gap remains."""
    forms = [_forms(path, row) for row in rows]
    gaps = (np.array([[_gap(a, b) for a in before] for b in after]) for before, after in pairwise(forms))
    chosen = cheapest_path([np.zeros(len(options)) for options in forms], gaps)
    plan = [options[k] for options, k in zip(forms, chosen, strict=True)]
    for number, (first, second) in enumerate(pairwise(plan), start=2):
        if (gap := _gap(first, second)) > _MEETS_M:
            raise InputFileError(
                path, f"edge {edge!r}: segment {number} starts {gap:.2f} m from the end of the previous one"
            )
    return plan


def _end(element: PlanElement) -> tuple[np.ndarray, float]:
    way = np.array([element.length_m])
    return element.place_at(way)[0], float(element.direction_at(way)[0])


def _gap(before: PlanElement, after: PlanElement) -> float:
    """Return the distance from an element's end to the next element's start, plus 10 m per rad of turn [m]."""
    place, direction = _end(before)
    turn = np.angle(np.exp(1j * (direction - after.direction_rad)))
    return float(np.hypot(*(place - (after.x_m, after.y_m))) + 10.0 * abs(turn))


def _forms(path: str, row: Row) -> list[PlanElement]:
    """Return the possible interpretations of a row as elements, the most likely first."""
    kind = row.get("TRACK_SEGMENT_TYPE", "").lower()
    east, north, length = (_number(path, row, name) for name in ("EAST", "NORTH", "TRACK_SEGMENT_LENGTH"))
    if kind == "line":
        azimuth = _number(path, row, "AZIMUTH")
        forms = [_element(east, north, azimuth, 0.0, 0.0, length)]
    elif kind == "circle":
        radius, arc = _number(path, row, "RADIUS"), _number(path, row, "INITIAL_ARC_LENGTH")
        forms = []
        for side, turned in product((np.sign(radius), -np.sign(radius)), (0.0, np.pi)):
            angle = side * arc / abs(radius) + turned
            x, y = east + abs(radius) * np.sin(angle), north + abs(radius) * np.cos(angle)
            bend = side / abs(radius)
            forms.append(_element(x, y, angle + side * np.pi / 2.0, bend, bend, length))
    elif kind == "clothoid":
        azimuth, arc, constant = (
            _number(path, row, name) for name in ("AZIMUTH", "INITIAL_ARC_LENGTH", "CLOTHOID_CONSTANT")
        )
        size, side = abs(constant), np.sign(constant)
        sizes = (size**-2, 1.0 / size, size) if size >= 1.0 else (size, size**-2, 1.0 / size)
        rates = [s * rate for rate, s in product(sizes, (side, -side)) if rate * (abs(arc) + length) < 0.1]
        forms = [_clothoid(east, north, azimuth, rate, arc, length) for rate in rates]
    else:
        raise InputFileError(path, f"a segment has the type {kind!r}; line, circle or clothoid was expected")
    if not forms:
        raise InputFileError(path, f"edge {row.get('TRACK_EDGE_ID')!r}: a clothoid has a radius below 10 m")
    return [_turn(form) for form in forms] if _number(path, row, "TRACK_SEGMENT_DIRECTION") < 0.0 else forms


def _element(x: float, y: float, azimuth: float, first: float, last: float, length: float) -> PlanElement:
    """Convert clockwise azimuth and curvatures to an element, whose angles are counter-clockwise from east."""
    direction = np.pi / 2.0 - azimuth
    return PlanElement(x_m=x, y_m=y, direction_rad=direction, first=-first, last=-last, length_m=length)


def _clothoid(east: float, north: float, azimuth: float, rate: float, arc: float, length: float) -> PlanElement:
    """Create the part of a clothoid that begins at the arc length `arc` from its point of zero curvature."""
    if arc == 0.0:
        return _element(east, north, azimuth, 0.0, rate * length, length)
    # before its origin, a clothoid is the curve after the origin, rotated by 180 degrees
    way = _element(east, north, azimuth if arc > 0.0 else azimuth + np.pi, 0.0, rate * abs(arc), abs(arc))
    (x, y), _ = _end(way)
    return _element(x, y, azimuth + rate * arc**2 / 2.0, rate * arc, rate * (arc + length), length)


def _turn(element: PlanElement) -> PlanElement:
    """Return an element in the opposite direction."""
    (x, y), direction = _end(element)
    return replace(
        element, x_m=float(x), y_m=float(y), direction_rad=direction + np.pi, first=-element.last, last=-element.first
    )


def _profile(path: str, row: Row) -> ProfileElement:
    start, length, height, gradient = (_number(path, row, name) for name in (*_SPAN, "INITIAL_HEIGHT", "GRADIENT"))
    first = last = gradient * 1e-3
    if row.get("TRACK_SEGMENT_TYPE", "").lower() == "circle":
        sine = np.sin(np.arctan(first)) + length / _number(path, row, "RADIUS")
        last = float(np.tan(np.arcsin(sine)))
    element = ProfileElement(start_m=start, length_m=length, height_m=height, first=first, last=last, arc="circle")
    if _number(path, row, "TRACK_SEGMENT_DIRECTION") < 0.0:
        end = float(element.height_at(np.array([start + length]))[0])
        element = replace(element, height_m=end, first=-last, last=-first)
    return element


def _cant(path: str, row: Row, plan: Sequence[PlanElement]) -> CantElement:
    """Create a cant element; the outer rail is raised and the inner rail is lowered by half of the cant.

    The sharpest curve within the element determines which rail is the outer rail.
    """
    start, length, first, last = (_number(path, row, name) for name in (*_SPAN, "INITIAL_CANT", "END_CANT"))
    if _number(path, row, "TRACK_SEGMENT_DIRECTION") < 0.0:
        first, last = last, first
    bends = [
        bend
        for element, low in zip(plan, plan_starts(plan), strict=True)
        if low < start + length and low + element.length_m > start
        for bend in (element.first, element.last)
    ]
    side = 0.5 * float(np.sign(max(bends, key=abs, default=0.0)))
    ends = (abs(first) * side, abs(last) * side)
    return CantElement(start_m=start, length_m=length, left_m=(-ends[0], -ends[1]), right_m=ends)
