"""Pages of charts and tables, and the charts of every page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from itertools import count
from typing import TYPE_CHECKING, Any, Final

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from railfix import __version__
from railfix.report.encode import chart_values, script_json, sky_values
from railfix.report.plots.chart import Chart, Points, SkyEpochs
from railfix.report.tables import Block

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
