"""Pages of charts and tables: of a run, and of a network of tracks with switches, faults and positions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from railfix import __version__
from railfix.core.files import write_whole
from railfix.core.tables import Table, number, share
from railfix.report.encode import chart_values, script_json, sky_values
from railfix.report.plots.chart import Chart, Points, SkyEpochs
from railfix.report.plots.network import network_plan
from railfix.report.tables import Block, Notes, Sentence
from railfix.track.network import Network
from railfix.track.network_check import NetworkQuality
from railfix.track.network_match import Matched, PlanLog

if TYPE_CHECKING:
    from railfix.report.figures import Group


#: Content security policy of the page: it loads nothing.
_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


@dataclass(frozen=True, kw_only=True)
class Figure:
    """A chart or sky plot in the page."""

    number: int
    chart: Chart | SkyEpochs
    json: Markup
    width: str
    sky: str
    zoomed_with: str

    @property
    def is_sky(self) -> bool:
        """Whether it is a sky plot."""
        return isinstance(self.chart, SkyEpochs)


@dataclass(frozen=True, kw_only=True)
class PagePart:
    """Figures under a heading."""

    title: str
    figures: Sequence[Figure]
    absent: Sequence[str] = ()


def charts_page(title: str, charts: Sequence[Chart], tables: Sequence[Block], *, lead: Sequence[Block] = ()) -> str:
    """HTML of a page of sentences, charts, and tables under them."""
    numbers = count()
    figures = PagePart(title="", figures=[figure(chart, numbers) for chart in charts])
    return render("charts.html.j2", title, charts=figures, tables=tables, lead=lead)


def render(template: str, title: str, **content: Any) -> str:
    """HTML of a template of this package."""
    environment = Environment(
        loader=PackageLoader("railfix.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(
        title=title,
        created=datetime.now(tz=UTC).strftime("%Y-%m-%d %H:%M UTC"),
        version=__version__,
        policy=_POLICY,
        style=_resource("page.css"),
        scripts=(_resource("errors.js"), _resource("page.js")),
        **content,
    )


def _resource(name: str) -> Markup:
    return Markup(files("railfix.report").joinpath("templates", name).read_text(encoding="utf-8"))


def figure(
    chart: Chart | SkyEpochs,
    numbers: Iterator[int],
    *,
    group: Group | None = None,
    sky: str = "",
    anchor: str = "",
    width: str = "",
) -> Figure:
    """A chart with its values, linked with the sky plot and the charts of an axis that belong to it."""
    values: dict[str, Any]
    if isinstance(chart, SkyEpochs):
        values, linked, axis, width = sky_values(chart), sky, "", "wide"
    else:
        clickable = any(isinstance(layer, Points) and layer.epoch_s is not None for layer in chart.layers)
        values = chart_values(chart, group.start if group is not None and clickable else None)
        linked = sky if clickable else ""
        axis = f"{anchor}-{chart.shared_axis}" if chart.shared_axis else ""
        width = width or chart.width
    return Figure(
        number=next(numbers),
        chart=chart,
        json=Markup(script_json(values)),
        width=width,
        sky=linked,
        zoomed_with=axis,
    )


#: Tracks that are listed at most.
_LISTED: Final = 5_000


def write_network_page(
    network: Network, quality: NetworkQuality, out: Path, *, run: tuple[PlanLog, Matched] | None = None
) -> None:
    """Write a page on a network, with the positions of a run in its frame; it opens without an internet connection.

    Raises
    ------
    OutputError
        The page cannot be written.
    """
    title = f"{quality.tracks:,} tracks, {quality.length_m / 1e3:,.1f} km, {quality.switches:,} switches"
    write_whole(
        out, charts_page(title, [network_plan(network, quality, run)], _tables(network, quality, run)), what="page"
    )


def _tables(network: Network, quality: NetworkQuality, run: tuple[PlanLog, Matched] | None) -> Sequence[Block]:
    beside: dict[tuple[int, int], list[str]] = {}
    for link in network.links:
        if link.navigable:
            beside.setdefault((link.first, link.first_end), []).append(network.names[link.second])
            beside.setdefault((link.second, link.second_end), []).append(network.names[link.first])
    seen = np.zeros(len(network.tracks), dtype=np.int64)
    blocks: list[Block] = [
        Sentence(
            f"{quality.ends:,} ends without a connection, {quality.parts:,} separate part(s), "
            f"{sum(f.kind != 'dead end' for f in quality.findings):,} findings."
        )
    ]
    if run is not None:
        matched = run[1]
        on = matched.track >= 0
        np.add.at(seen, matched.track[on], 1)
        blocks.append(
            Sentence(
                f"{len(on):,} positions, {share(float(on.mean()), 1)} on a track, "
                f"{share(float((np.abs(matched.offset_m) <= 5.0).mean()), 1)} within 5 m of it, "
                f"{share(float((matched.probability < 0.9).mean()), 1)} with a probability below 0.9."
            )
        )
    if network.notes:
        blocks.append(Notes("Notes", network.notes))
    if quality.findings:
        blocks.append(
            Table(
                name="findings",
                head=("kind", "latitude", "longitude", "finding"),
                rows=[
                    (f.kind, f"{f.latitude_deg:.6f}", f"{f.longitude_deg:.6f}", f.sentence)
                    for f in quality.findings[:_LISTED]
                ],
                caption=f"Findings: {len(quality.findings):,}",
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
                    ", ".join(beside.get((k, 0), [])),
                    ", ".join(beside.get((k, 1), [])),
                    f"{seen[k]:,}" if run is not None else "–",
                )
                for k, name in enumerate(network.names[:_LISTED])
            ],
            caption=f"Tracks: {len(network.tracks):,}"
            + (f", the first {_LISTED:,} of them" if len(network.tracks) > _LISTED else ""),
            numeric=(1, 4),
        )
    )
    return blocks
