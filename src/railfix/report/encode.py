"""Charts and the background of the plan as text for the page: plain values, arrays as base 64, lines of GeoJSON."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import read_json_object
from railfix.core.timescale import seconds
from railfix.report.plots.chart import Band, Bars, Cells, Chart, Curve, Layer, Marks, Points, RangeBars, SkyEpochs

_EPOCH_ZERO: Final = np.datetime64("1970-01-01T00:00:00", "ns")
#: Unknown value of an unsigned 16-bit number.
_UNKNOWN: Final = 65535
_OF_CHART: Final = (
    "title", "x_label", "y_label", "x_scale", "y_scale", "y_linear", "x_range", "y_range", "equal",
)  # fmt: skip


def script_json(value: Any) -> str:
    """JSON text of plain values that is safe inside a script element; ValueError for NaN outside an array."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for mark, code in (("<", "\\u003c"), (">", "\\u003e"), ("\u2028", "\\u2028"), ("\u2029", "\\u2029")):
        text = text.replace(mark, code)
    return text


def packed(values: NDArray[Any], kind: str = "f") -> str:
    """An array as base 64, little endian, after the letter of its kind: 32-bit float, unsigned 16-bit, unsigned
    32-bit.
    """
    dtype = {"f": "<f4", "h": "<u2", "i": "<u4"}[kind]
    return kind + base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")


def chart_values(chart: Chart, epochs_from: np.datetime64 | None = None) -> dict[str, Any]:
    """A chart as plain values; `epochs_from`: origin of ``epoch_s`` of its points, if not `Chart.start`."""
    values: dict[str, Any] = {name: getattr(chart, name) for name in _OF_CHART}
    values |= {"axis": chart.shared_axis, "layers": [_layer(layer) for layer in chart.layers]}
    if chart.start is not None:
        values["start"] = since_1970(chart.start)
    if epochs_from is not None:
        values["epoch0"] = since_1970(epochs_from)
    return values


def since_1970(time: np.datetime64) -> float:
    """A time as seconds, to the microsecond."""
    return round(float(seconds(time - _EPOCH_ZERO)), 6)


def _layer(layer: Layer) -> dict[str, Any]:
    values: dict[str, Any] = {"label": layer.label, "colour": layer.colour}
    match layer:
        case Points():
            values |= {"kind": "points", "shape": layer.shape, "size": layer.size}
            values |= {"x": packed(layer.x), "y": packed(layer.y)}
            if layer.epoch_s is not None:
                values["epoch"] = packed(layer.epoch_s)
        case Curve():
            values |= {"kind": "line", "width": layer.width, "dash": layer.dash}
            values |= {"x": packed(layer.x), "y": packed(layer.y)}
        case Band():
            values |= {"kind": "band", "x": packed(layer.x), "low": packed(layer.low), "high": packed(layer.high)}
        case Bars():
            values |= {"kind": "bars", "left": packed(layer.left), "right": packed(layer.right)}
            values["height"] = packed(layer.height)
        case Cells():
            values |= _cells(layer)
        case RangeBars():
            values |= {"kind": "ranges", "names": list(layer.names)}
            values |= {name: packed(getattr(layer, name)) for name in ("low", "mid", "high")}
        case Marks():
            values |= {"kind": "marks", "x": packed(layer.x), "y": packed(layer.y), "words": list(layer.words)}
            values["place"] = layer.place
    return values


def _cells(layer: Cells) -> dict[str, Any]:
    """Cells that are not empty; all have equal widths."""
    column, row = np.nonzero(layer.counts)
    return {
        "kind": "cells",
        "x0": float(layer.x_edges[0]),
        "x1": float(layer.x_edges[-1]),
        "y0": float(layer.y_edges[0]),
        "y1": float(layer.y_edges[-1]),
        "nx": layer.counts.shape[0],
        "ny": layer.counts.shape[1],
        "most": int(layer.counts.max(initial=1)),
        "a": packed(column, "h"),
        "b": packed(row, "h"),
        "n": packed(layer.counts[column, row], "i"),
    }


def sky_values(sky: SkyEpochs) -> dict[str, Any]:
    """Satellites in view as plain values; angles and C/N0 in hundredths."""
    values: dict[str, Any] = {
        "start": since_1970(sky.start),
        "epoch": packed(sky.epoch_s),
        "first": packed(sky.first, "i"),
        "azimuth": packed(np.round(100.0 * (sky.azimuth_deg % 360.0)), "h"),
        "elevation": packed(np.round(100.0 * np.clip(sky.elevation_deg, 0.0, 90.0)), "h"),
        "cn0": packed(np.where(np.isfinite(sky.cn0_dbhz), np.round(100.0 * sky.cn0_dbhz), _UNKNOWN), "h"),
    }
    for name, words, first in (
        ("satellite", sky.satellite, ()),
        ("signal", sky.signal, ()),
        ("reason", sky.reason, ("used",)),
    ):
        known = [*first, *(str(word) for word in np.unique(words) if word not in first)]
        code = {word: number for number, word in enumerate(known)}
        values[name] = packed(np.array([code[str(word)] for word in words], dtype=np.int64), "h")
        values[{"satellite": "names", "signal": "signals", "reason": "reasons"}[name]] = known
    return values


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
