"""Background of the plan: lines of a GeoJSON file (RFC 7946), longitude and latitude on WGS 84."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import read_json_object

#: Depth of the coordinates above a line of points, by type of geometry.
_DEPTH: Final = {"LineString": 0, "MultiLineString": 1, "Polygon": 1, "MultiPolygon": 2}
_IGNORED: Final = ("Point", "MultiPoint")


def read_background(path: Path) -> tuple[Floats, ...]:
    """Lines and outlines of a GeoJSON file, each of shape (P, 2): longitude and latitude [deg].

    Points are left out.

    Raises
    ------
    InputFileError
        The file cannot be read, is not GeoJSON, or has no lines.
    """
    node = read_json_object(path, what="GeoJSON")
    lines = tuple(_lines(path, node))
    if not lines:
        raise InputFileError(path, "has no lines or polygons; expected GeoJSON with streets, buildings or the like")
    return lines


def _lines(path: Path, node: Any) -> Iterator[Floats]:
    """Every line below a GeoJSON object."""
    kind = node.get("type") if isinstance(node, dict) else None
    if kind == "FeatureCollection":
        for feature in node.get("features") or ():
            yield from _lines(path, feature)
    elif kind == "Feature":
        if node.get("geometry") is not None:
            yield from _lines(path, node["geometry"])
    elif kind == "GeometryCollection":
        for geometry in node.get("geometries") or ():
            yield from _lines(path, geometry)
    elif kind in _DEPTH:
        yield from _coordinates(path, node.get("coordinates"), _DEPTH[kind])
    elif kind not in _IGNORED:
        raise InputFileError(path, f"has an object of type {kind!r}; expected GeoJSON")


def _coordinates(path: Path, value: Any, depth: int) -> Iterator[Floats]:
    if depth and isinstance(value, list):
        for part in value:
            yield from _coordinates(path, part, depth - 1)
        return
    try:
        line = np.array([point[:2] for point in value], dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputFileError(path, f"has coordinates that are not numbers ({error}); expected GeoJSON") from None
    if line.ndim != 2 or line.shape[1] != 2 or not (np.abs(line) <= (180.0, 90.0)).all():
        raise InputFileError(path, "has coordinates that are not longitude and latitude in degrees (WGS 84)")
    yield line
