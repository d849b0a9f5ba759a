"""HTML pages with charts and tables: templates, conversion of charts to JSON, and the page on a network of tracks."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from functools import partial
from importlib.resources import files
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup
from numpy.typing import NDArray
from plotly.offline import get_plotlyjs

from railfix import __version__
from railfix.core.arrays import Floats
from railfix.core.errors import InputFileError
from railfix.core.files import read_json_object
from railfix.core.notebook import plural
from railfix.core.staged_files import write_whole
from railfix.core.tables import Table, number, share
from railfix.core.timescale import seconds
from railfix.report.plots.chart import Cells, Chart, Layer, Points, SkyEpochs
from railfix.report.plots.network import network_frame, network_plan

if TYPE_CHECKING:
    from railfix.track.network import Network
    from railfix.track.network_match import Matched, PlanLog
    from railfix.track.network_read import NetworkQuality

_EPOCH_ZERO: Final = np.datetime64("1970-01-01T00:00:00", "ns")
#: 16-bit number that stands for an unknown C/N0.
_UNKNOWN: Final = 65535
_OF_CHART: Final = (
    "title", "x_label", "y_label", "x_scale", "y_scale", "y_linear", "x_range", "y_range", "equal",
)  # fmt: skip


def script_json(value: Any) -> str:
    """Return plain values as JSON text that is safe in an HTML script element.

    Raise ValueError if the values contain NaN or infinity.
    """
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for mark, code in (("<", "\\u003c"), (">", "\\u003e"), ("\u2028", "\\u2028"), ("\u2029", "\\u2029")):
        text = text.replace(mark, code)
    return text


def pack_array(values: NDArray[Any], kind: str = "f") -> str:
    """Return an array as text: the letter of its type, followed by the values in base 64, little endian.

    The types are 32-bit float (f) and unsigned integers of 16 (h) and 32 (i) bits.
    """
    dtype = {"f": "<f4", "h": "<u2", "i": "<u4"}[kind]
    return kind + base64.b64encode(np.ascontiguousarray(values, dtype=dtype).tobytes()).decode("ascii")


def chart_values(chart: Chart, epochs_from: np.datetime64 | None = None) -> dict[str, Any]:
    """Return a chart as plain values for JSON; the times `Points.epoch_s` are counted from `epochs_from`."""
    values: dict[str, Any] = {name: getattr(chart, name) for name in _OF_CHART}
    values |= {"axis": chart.common_axis, "layers": [_layer(layer) for layer in chart.layers]}
    if chart.start is not None:
        values["start"] = since_1970(chart.start)
    if epochs_from is not None:
        values["epoch0"] = since_1970(epochs_from)
    return values


def since_1970(time: np.datetime64) -> float:
    """Return a time in seconds since 1970-01-01, rounded to microseconds."""
    return round(float(seconds(time - _EPOCH_ZERO)), 6)


def _layer(layer: Layer) -> dict[str, Any]:
    """Return a layer as plain values by field name; fields that are None are omitted."""
    values: dict[str, Any] = {"label": layer.label, "colour": layer.colour, "kind": layer.kind}
    if isinstance(layer, Cells):
        return values | _cells(layer)
    for name in (item.name for item in fields(layer) if item.name not in values):
        if (value := getattr(layer, name)) is not None:
            packed = pack_array(value) if isinstance(value, np.ndarray) else value
            values["epoch" if name == "epoch_s" else name] = packed
    return values


def _cells(layer: Cells) -> dict[str, Any]:
    """Return the limits of the grid, and the index and count of each occupied cell; the cells must have equal sizes."""
    column, row = np.nonzero(layer.counts)
    return {
        "x0": float(layer.x_edges[0]),
        "x1": float(layer.x_edges[-1]),
        "y0": float(layer.y_edges[0]),
        "y1": float(layer.y_edges[-1]),
        "nx": layer.counts.shape[0],
        "ny": layer.counts.shape[1],
        "most": int(layer.counts.max(initial=1)),
        "a": pack_array(column, "h"),
        "b": pack_array(row, "h"),
        "n": pack_array(layer.counts[column, row], "i"),
    }


def sky_values(sky: SkyEpochs) -> dict[str, Any]:
    """Return the satellites in view as plain values; the unit of angles is 0.01 deg, the unit of C/N0 is 0.01 dB-Hz."""
    values: dict[str, Any] = {
        "start": since_1970(sky.start),
        "epoch": pack_array(sky.epoch_s),
        "first": pack_array(sky.first, "i"),
        "azimuth": pack_array(np.round(100.0 * (sky.azimuth_deg % 360.0)), "h"),
        "elevation": pack_array(np.round(100.0 * np.clip(sky.elevation_deg, 0.0, 90.0)), "h"),
        "cn0": pack_array(np.where(np.isfinite(sky.cn0_dbhz), np.round(100.0 * sky.cn0_dbhz), _UNKNOWN), "h"),
    }
    for name, words, first in (
        ("satellite", sky.satellite, ()),
        ("signal", sky.signal, ()),
        ("reason", sky.reason, ("used",)),
    ):
        known = [*first, *(str(word) for word in np.unique(words) if word not in first)]
        code = {word: number for number, word in enumerate(known)}
        values[name] = pack_array(np.array([code[str(word)] for word in words], dtype=np.int64), "h")
        values[{"satellite": "names", "signal": "signals", "reason": "reasons"}[name]] = known
    return values


#: Depth at which the lists of points are nested, by type of geometry (RFC 7946).
_DEPTH: Final = {"LineString": 0, "MultiLineString": 1, "Polygon": 1, "MultiPolygon": 2}
_IGNORED: Final = ("Point", "MultiPoint")


def read_background(path: Path) -> tuple[Floats, ...]:
    """Read the lines and outlines of a GeoJSON file, each as longitudes and latitudes, shape (P, 2) [deg].

    Raise InputFileError if the file is not GeoJSON, or has neither lines nor polygons.
    """
    node = read_json_object(path, what="GeoJSON")
    lines = tuple(_lines(path, node))
    if not lines:
        raise InputFileError(path, "has no lines or polygons; expected GeoJSON with streets, buildings or similar")
    return lines


def _lines(path: Path, node: Any) -> Iterator[Floats]:
    """Yield the coordinates of every line in a GeoJSON object and in the objects that it contains."""
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


#: Content security policy of the pages, which load no other files.
_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


@dataclass(frozen=True)
class Text:
    """Paragraph of a page; `kind` is "sentence", "absent" (reason why a part is missing) or "command"."""

    kind: str
    text: str


Sentence: Final = partial(Text, "sentence")
Absent: Final = partial(Text, "absent")
ReportedCommand: Final = partial(Text, "command")


@dataclass(frozen=True)
class Notes:
    """List of sentences under a heading."""

    kind: ClassVar[str] = "notes"
    title: str
    lines: Sequence[str]


@dataclass(frozen=True)
class Folded:
    """Part of a page that is hidden until the reader clicks on the title of the part."""

    kind: ClassVar[str] = "folded"
    title: str
    blocks: Sequence[Block]


Block = Table | Text | Notes | Folded


@dataclass(frozen=True, kw_only=True)
class Figure:
    """Chart or sky plot in a page."""

    number: int  #: Number of the figure in the page, beginning with 0.
    chart: Chart | SkyEpochs
    json: Markup  #: Values of the chart for the script of the page.
    width: str  #: Name of the style class for the width: "wide" or "half".
    sky: str  #: Element id of the sky plot that shows the epoch of a clicked point; "" without a sky plot.
    zoomed_with: str  #: Figures with the same value share the range of the x axis; "" if the range is not shared.
    linked: str  #: After a zoom in one figure, figures with the same value show its epochs; "" if no figure is linked.

    @property
    def is_sky(self) -> bool:
        """Whether the figure is a sky plot."""
        return isinstance(self.chart, SkyEpochs)


@dataclass(frozen=True, kw_only=True)
class PagePart:
    """Figures under a heading; `absent` has one sentence for each missing figure, with the reason."""

    title: str
    figures: Sequence[Figure]
    absent: Sequence[str] = ()


def charts_page(title: str, charts: Sequence[Chart], tables: Sequence[Block], *, lead: Sequence[Block] = ()) -> str:
    """Return the HTML of a page with the blocks `lead`, followed by the charts and the tables."""
    numbers = count()
    figures = PagePart(title="", figures=[figure(chart, numbers) for chart in charts])
    return render("charts.html.j2", title, charts=figures, tables=tables, lead=lead)


def read_template(name: str) -> Template:
    """Return a template of this package."""
    loader = PackageLoader("railfix.report")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.get_template(name)


def render(template: str, title: str, **content: Any) -> str:
    """Return the HTML of a page from a template of this package, with style sheet and scripts."""
    return read_template(template).render(
        title=title,
        created=datetime.now(tz=UTC).strftime("%Y-%m-%d %H:%M UTC"),
        version=__version__,
        policy=_POLICY,
        style=page_style(),
        scripts=(_resource("errors.js"), chart_library(), _resource("page.js")),
        **content,
    )


def chart_library() -> Markup:
    """Return the script of plotly.js, which draws the charts."""
    return Markup(get_plotlyjs())


def page_style() -> Markup:
    """Return the style sheet of all pages."""
    return _resource("page.css")


def _resource(name: str) -> Markup:
    return Markup(files("railfix.report").joinpath("templates", name).read_text(encoding="utf-8"))


@dataclass(frozen=True, kw_only=True)
class Group:
    """Charts under a heading. `absent` has the reasons for missing charts. The times `Points.epoch_s` are counted from
    `start`.
    """

    title: str
    charts: tuple[Chart | SkyEpochs, ...]
    start: np.datetime64
    absent: tuple[str, ...] = ()


def figure(
    chart: Chart | SkyEpochs,
    numbers: Iterator[int],
    *,
    group: Group | None = None,
    sky: str = "",
    anchor: str = "",
    linked: str = "",
    width: str = "",
) -> Figure:
    """Return the figure of a chart, with the values of the chart for the script of the page.

    `numbers` yields the numbers of figures. The times of the points are counted from the start of `group`; a click on a
    point with a time shows the satellites in the sky plot `sky`. `anchor` is a prefix of the name of the x axis that
    figures share. `linked` is `Figure.linked`.
    """
    values: dict[str, Any]
    if isinstance(chart, SkyEpochs):
        values, chosen_in, axis, width = sky_values(chart), sky, "", "wide"
    else:
        clickable = any(isinstance(layer, Points) and layer.epoch_s is not None for layer in chart.layers)
        values = chart_values(chart, group.start if group is not None and clickable else None)
        chosen_in = sky if clickable else ""
        linked = linked if clickable else ""
        axis = f"{anchor}-{chart.common_axis}" if chart.common_axis else ""
        width = width or chart.width
    return Figure(
        number=next(numbers), chart=chart, json=Markup(script_json(values)), width=width, sky=chosen_in,
        zoomed_with=axis, linked=linked,
    )  # fmt: skip


#: Maximum number of listed tracks and findings.
_LISTED: Final = 5_000


def write_network_page(
    network: Network, quality: NetworkQuality, out: Path, *, run: tuple[PlanLog, Matched] | None = None
) -> None:
    """Write the HTML page of a network: findings of the map check and, if a run is given, its matched positions.

    The positions must be in the reference frame of the network. Raise OutputError if the file cannot be written.
    """
    title = f"Network: {quality.tracks:,} tracks, {quality.length_m / 1e3:,.1f} km, {quality.switches:,} switches"
    write_whole(
        out, charts_page(title, [network_plan(network, quality, run)], _tables(network, quality, run)), what="page"
    )


def _tables(network: Network, quality: NetworkQuality, run: tuple[PlanLog, Matched] | None) -> Sequence[Block]:
    beside = {end: ", ".join(network.names[t] for t, _ in others) for end, others in network.passages.items()}
    seen = np.zeros(len(network.tracks), dtype=np.int64)
    dead_ends = sum(f.kind == "dead end" for f in quality.findings)
    parts = "is connected" if quality.parts == 1 else f"consists of {quality.parts:,} separate parts"
    blocks: list[Block] = [
        Sentence(
            f"{quality.ends:,} ends have no connection; the network {parts} and has "
            f"{plural(quality.findings, 'finding')}, including {plural(dead_ends, 'dead end')}."
        )
    ]
    if run is not None:
        matched = run[1]
        on = matched.track >= 0
        np.add.at(seen, matched.track[on], 1)
        blocks.append(
            Sentence(
                f"{len(on):,} positions were matched: {share(float(on.mean()), 1)} are on a track, "
                f"{share(float((np.abs(matched.offset_m) <= 5.0).mean()), 1)} are within 5 m of their track, and "
                f"{share(float((matched.probability < 0.9).mean()), 1)} have a track probability below 0.9."
            )
        )
    if network.notes:
        blocks.append(Notes("Notes", network.notes))
    if quality.findings:
        listed = quality.findings[:_LISTED]
        plane = network_frame(network).to_plane(*np.array([(f.latitude_deg, f.longitude_deg) for f in listed]).T)
        blocks.append(
            Table(
                name="findings",
                # a click on the link centres the plan on the finding
                links=[f"#plan:{east:.1f},{north:.1f}" for east, north in plane],
                head=("kind", "latitude deg", "longitude deg", "finding"),
                rows=[(f.kind, f"{f.latitude_deg:.6f}", f"{f.longitude_deg:.6f}", f.sentence) for f in listed],
                caption=f"Findings: {len(quality.findings):,}, including {dead_ends:,} dead ends",
                numeric=(1, 2),
            )
        )
    blocks.append(
        Table(
            name="tracks",
            head=("track", "length m", "before its first point", "after its last point", "positions"),
            rows=[
                (
                    name,
                    number(float(network.length_m[k]), 1),
                    beside.get((k, 0), ""),
                    beside.get((k, 1), ""),
                    f"{seen[k]:,}" if run is not None else "–",
                )
                for k, name in enumerate(network.names[:_LISTED])
            ],
            caption=f"Tracks: {len(network.tracks):,}"
            + (f"; the first {_LISTED:,} are listed" if len(network.tracks) > _LISTED else ""),
            numeric=(1, 4),
        )
    )
    return blocks
