"""The report: one page of HTML that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from importlib.resources import files
from itertools import count
from pathlib import Path
from typing import Final

from railfix import __version__
from railfix.core.files import write_whole
from railfix.evaluate import Evaluation
from railfix.report import tables
from railfix.report.encode import chart_values, script_json, sky_values
from railfix.report.figures import NO_OBSERVATIONS, NO_REFERENCE, Group, antenna_groups, run_group
from railfix.report.html import absent, text
from railfix.report.plots.chart import Chart, Points, SkyEpochs
from railfix.report.plots.errors import error_ranges
from railfix.report.plots.signals import SKY_EPOCHS
from railfix.report.protection import protection
from railfix.report.runs import ReportedRun, read_runs

#: Epochs of the sky that every antenna has.
_LEAST_SKY: Final = 200
#: Nothing is fetched: what the page may load, said to the browser.
_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'"


def write_report(runs: Sequence[Path], out: Path, *, references: Sequence[Path] = (), title: str = "") -> Path:
    """Write the report on runs.

    Parameters
    ----------
    runs : sequence of Path
        Folders that `railfix run` wrote.
    out : Path
        The page; it appears whole or not at all, in place of an earlier one.
    references : sequence of Path
        None, one for all runs, or one for each (`railfix.io.reference_log.read_reference`).
    title : str

    Returns
    -------
    Path
        `out`.

    Raises
    ------
    InputFileError, MismatchError, SettingsError
        See `railfix.report.read_runs`.
    OutputError
        The page cannot be written.
    """
    reported, evaluation = read_runs(runs, references)
    return write_page(reported, evaluation, out, title=title)


def write_page(runs: Sequence[ReportedRun], evaluation: Evaluation | None, out: Path, *, title: str = "") -> Path:
    """Write the report on runs that are read already; see `write_report`."""
    write_whole(out, report_page(runs, evaluation, title=title), what="report")
    return out


def report_page(runs: Sequence[ReportedRun], evaluation: Evaluation | None, *, title: str = "") -> str:
    """The page as text.

    Parameters
    ----------
    runs : sequence of ReportedRun
    evaluation : Evaluation or None
    title : str
    """
    numbers = count()
    # together the antennas of many runs weigh no more in this than those of a few
    epochs = max(_LEAST_SKY, min(SKY_EPOCHS, 2 * SKY_EPOCHS // max(sum(len(r.folder.antennas) for r in runs), 1)))
    names = ", ".join(run.name for run in runs)
    heading = title or f"railfix report: {names}"
    when = datetime.now(tz=UTC).strftime("%Y-%m-%d %H:%M UTC")
    parts = [
        f"<h1>{text(heading)}</h1>",
        f'<p class="lead">Positions along the line from satellite ranges and a track map. Made on {when} by railfix '
        f"{text(__version__)}; all that it shows is in this file.</p>",
        _navigation(runs),
        _overview(runs, evaluation, numbers),
        *(_run(run, evaluation, number, numbers, sky=epochs) for number, run in enumerate(runs)),
    ]
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>{text(heading)}</title>",
            f"<style>\n{_resource('page.css')}</style></head><body>",
            '<div id="railfix-errors" hidden></div><div id="railfix-timing" hidden></div>',
            f"<script>\n{_resource('errors.js')}</script>",
            "<noscript>"
            + absent("The pictures of this page are drawn by a script, which this browser does not run.")
            + "</noscript>",
            *parts,
            f"<script>\n{_resource('page.js')}</script>",
            "</body></html>",
            "",
        ]
    )


def _navigation(runs: Sequence[ReportedRun]) -> str:
    links = ['<a href="#summary">Summary</a>']
    for k, run in enumerate(runs):
        links.append(f'<a href="#run{k}">{text(run.name)}</a>')
        links += [f'<a href="#run{k}-{i}">{text(a)} antenna</a>' for i, a in enumerate(run.folder.antennas)]
    return f"<nav>{''.join(links)}</nav>"


def _overview(runs: Sequence[ReportedRun], evaluation: Evaluation | None, numbers: Iterator[int]) -> str:
    parts = ['<h2 id="summary" class="first">Summary</h2>', tables.summary(runs, evaluation)]
    parts.append(
        '<p class="caption screen-only">In the pictures: point for values, drag to enlarge, double-click to see all '
        "again, click on a name below to hide it; a click on a position or an error shows the satellites then. "
        "With the keyboard: + and −, arrows, 0.</p>"
    )
    if evaluation is None:
        parts.append(absent(NO_REFERENCE))
    else:
        series = {}
        for run in runs:
            for antenna in run.folder.antennas:
                errors = run.errors_of(antenna)
                if errors is not None:
                    series[f"{run.name}, {antenna}"] = errors
        chart = error_ranges(series)
        if not chart.empty:
            parts.append(f'<div class="charts">{_figure(chart, next(numbers), "", None)}</div>')
    if any(run.observations is None for run in runs):
        lacking = ", ".join(run.name for run in runs if run.observations is None)
        parts.append(absent(f"{lacking}: {NO_OBSERVATIONS}" if len(runs) > 1 else NO_OBSERVATIONS))
    return "\n".join(parts)


def _run(run: ReportedRun, evaluation: Evaluation | None, k: int, numbers: Iterator[int], *, sky: int) -> str:
    parts = [f'<h2 id="run{k}">Run {text(run.name)}</h2>', tables.what_was_run(run), tables.settings(run)]
    parts += ["<h3>What became of epochs and pseudoranges</h3>", tables.budget(run)]
    if evaluation is not None:
        parts += ["<h3>Figures of merit</h3>", tables.merits(run, evaluation)]
    parts += ["<h3>Protection level</h3>", protection(run, evaluation)]
    parts.append(_group(run_group(run), numbers, ""))
    for i, antenna in enumerate(run.folder.antennas):
        parts.append(f'<h2 id="run{k}-{i}">{text(run.name)}: {text(antenna)} antenna</h2>')
        place = f"sky{k}-{i}" if run.observations is not None else ""
        parts += [_group(group, numbers, place) for group in antenna_groups(run, antenna, sky=sky)]
    return "\n".join(parts)


def _group(group: Group, numbers: Iterator[int], sky: str) -> str:
    figures = []
    for chart in group.charts:
        number = next(numbers)
        if isinstance(chart, SkyEpochs):
            figures.append(_sky(chart, number, sky))
        else:
            figures.append(_figure(chart, number, sky, group))
    body = "".join(absent(sentence) for sentence in group.absent)
    if figures:
        body += f'<div class="charts">{"".join(figures)}</div>'
    return f"<h3>{text(group.title)}</h3>\n{body}"


def _figure(chart: Chart, number: int, sky: str, group: Group | None) -> str:
    clickable = any(isinstance(layer, Points) and layer.epoch_s is not None for layer in chart.layers)
    linked = f' data-sky="{sky}"' if sky and clickable else ""
    values = chart_values(chart, group.start if group is not None and clickable else None)
    return (
        f'<figure class="{chart.width}" data-chart="c{number}" data-name="{text(chart.name)}"{linked}>'
        f"<h4>{text(chart.title)}</h4>"
        f'<div class="plot"><canvas role="img" tabindex="0" aria-label="{text(f"{chart.title}. {chart.caption}")}">'
        '</canvas><div class="tip" hidden></div></div><div class="legend"></div>'
        f'<figcaption class="caption">{text(chart.caption)}</figcaption></figure>'
        f'<script type="application/json" id="c{number}">{script_json(values)}</script>'
    )


def _sky(sky: SkyEpochs, number: int, name: str) -> str:
    heads = "".join(
        f'<th scope="col"{" class=n" if right else ""}>{head}</th>'
        for head, right in (
            ("satellite", 0),
            ("signal", 0),
            ("elevation", 1),
            ("azimuth", 1),
            ("C/N0, dB-Hz", 1),
            ("reason", 0),
        )
    )
    return (
        f'<figure class="wide skyplot" id="{name}" data-chart="c{number}" data-name="sky"><h4>{text(sky.title)}</h4>'
        '<div class="sky"><label class="pick"><span>Epoch</span>'
        f'<input type="range" min="0" max="{len(sky.epoch_s) - 1}" value="0"><output></output></label>'
        f'<div><canvas role="img" aria-label="{text(sky.title)}"></canvas></div>'
        f"<table><thead><tr>{heads}</tr></thead><tbody></tbody></table></div>"
        '<figcaption class="caption">Dots are used, crosses refused; the number is C/N0, the table tells the first '
        f"reason. {text(sky.caption)} The slider or a click on an error chooses one.</figcaption></figure>"
        f'<script type="application/json" id="c{number}">{script_json(sky_values(sky))}</script>'
    )


def _resource(name: str) -> str:
    return files("railfix.report").joinpath(name).read_text(encoding="utf-8")
