"""The report: one HTML page with all it shows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Final

from railfix.core.arrays import Floats
from railfix.core.files import write_whole
from railfix.evaluate import Evaluation, EvaluationOptions
from railfix.report import tables
from railfix.report.charts_page import PagePart, figure, render
from railfix.report.encode import read_background
from railfix.report.figures import NO_OBSERVATIONS, NO_REFERENCE, Group, antenna_groups, overview, protection, run_group
from railfix.report.headline import Headline, headline
from railfix.report.plots.errors import error_ranges
from railfix.report.plots.signals import SKY_EPOCHS
from railfix.report.runs import ReportedRun, read_runs
from railfix.report.tables import Absent, Block, Folded

#: Fewest epochs of the sky plot of an antenna.
_LEAST_SKY: Final = 200


@dataclass(frozen=True, kw_only=True)
class _AntennaPart:
    """Charts of one antenna."""

    name: str
    anchor: str
    parts: Sequence[PagePart]


@dataclass(frozen=True, kw_only=True)
class _RunPart:
    """Everything on one run."""

    name: str
    anchor: str
    antenna: str
    headline: Headline
    overview: PagePart
    tables: Sequence[Folded]
    timing: PagePart
    antennas: Sequence[_AntennaPart]


def write_report(
    runs: Sequence[Path],
    out: Path,
    *,
    references: Sequence[Path] = (),
    conventional: Sequence[Path] = (),
    background: Path | None = None,
    title: str = "",
    options: EvaluationOptions | None = None,
) -> Path:
    """Write the report on runs.

    Parameters
    ----------
    runs : sequence of Path
        Folders that `railfix run` wrote.
    out : Path
        The page; an existing file is replaced, by the complete page or not at all.
    references, conventional : sequence of Path
        See `railfix.report.read_runs`.
    background : Path, optional
        GeoJSON file with lines to draw below the plan (`railfix.report.encode`).
    title : str
    options : EvaluationOptions, optional

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
    reported, evaluation = read_runs(runs, references, conventional=conventional, options=options)
    lines = () if background is None else read_background(background)
    return write_page(reported, evaluation, out, background=lines, title=title)


def write_page(
    runs: Sequence[ReportedRun],
    evaluation: Evaluation | None,
    out: Path,
    *,
    background: Sequence[Floats] = (),
    title: str = "",
) -> Path:
    """Write the report on runs that have been read; see `write_report`."""
    write_whole(out, report_page(runs, evaluation, background=background, title=title), what="report")
    return out


def report_page(
    runs: Sequence[ReportedRun],
    evaluation: Evaluation | None,
    *,
    background: Sequence[Floats] = (),
    title: str = "",
) -> str:
    """HTML of the report; `background`: longitude and latitude of lines below the plan, each of shape (P, 2) [deg]."""
    numbers = count()
    antennas = max(sum(len(run.folder.antennas) for run in runs), 1)
    # many antennas share the size that two have
    epochs = max(_LEAST_SKY, min(SKY_EPOCHS, 2 * SKY_EPOCHS // antennas))
    return render(
        "page.html.j2",
        title or f"railfix report: {', '.join(run.name for run in runs)}",
        runs=[
            _run(run, evaluation, number, numbers, sky=epochs, background=background) for number, run in enumerate(runs)
        ],
        summary=_summary(runs, evaluation),
        ranges=_ranges(runs, evaluation, numbers),
    )


def _summary(runs: Sequence[ReportedRun], evaluation: Evaluation | None) -> list[Block]:
    """Table of all runs, and what the page lacks."""
    blocks: list[Block] = [tables.summary(runs, evaluation)]
    if evaluation is None:
        blocks.append(Absent(NO_REFERENCE))
    without = [run.name for run in runs if run.observations is None]
    if without:
        blocks.append(Absent(NO_OBSERVATIONS if len(runs) == 1 else f"{', '.join(without)}: {NO_OBSERVATIONS}"))
    return blocks


def _ranges(runs: Sequence[ReportedRun], evaluation: Evaluation | None, numbers: Iterator[int]) -> PagePart:
    """Range of the errors of all runs."""
    if evaluation is None:
        return PagePart(title="", figures=())
    series = {
        f"{run.name}, {antenna}": errors
        for run in runs
        for antenna in run.folder.antennas
        if (errors := run.errors_of(antenna)) is not None
    }
    chart = error_ranges(series)
    return PagePart(title="", figures=() if chart.empty else (figure(chart, numbers),))


def _run(
    run: ReportedRun,
    evaluation: Evaluation | None,
    number: int,
    numbers: Iterator[int],
    *,
    sky: int,
    background: Sequence[Floats],
) -> _RunPart:
    anchor, first = f"run{number}", run.folder.antennas[0]
    merits = []
    if evaluation is not None:
        merits.append(Folded("Figures of merit", tables.merits(run, evaluation)))
        merits.append(Folded("Filter along the track", tables.filter_tables(run, evaluation)))

    def place(i: int) -> str:
        return f"sky{number}-{i}" if run.observations is not None else ""

    return _RunPart(
        name=run.name,
        anchor=anchor,
        antenna=first,
        headline=headline(run, first, evaluation),
        overview=_part(overview(run, first, background), numbers, place(0), anchor, width="half"),
        tables=(
            *merits,
            Folded("Epochs and pseudoranges", tables.budget(run)),
            Folded("Protection level", protection(run, evaluation)),
            Folded("Run, inputs and notes", tables.provenance(run)),
            Folded("Settings asked for and used", tables.settings(run)),
        ),
        timing=_part(run_group(run), numbers, "", anchor),
        antennas=[
            _AntennaPart(
                name=antenna,
                anchor=f"{anchor}-{i}",
                parts=[
                    _part(group, numbers, place(i), anchor)
                    for group in antenna_groups(run, antenna, sky=sky, background=background)
                ],
            )
            for i, antenna in enumerate(run.folder.antennas)
        ],
    )


def _part(group: Group, numbers: Iterator[int], sky: str, anchor: str, *, width: str = "") -> PagePart:
    figures = [figure(chart, numbers, group=group, sky=sky, anchor=anchor, width=width) for chart in group.charts]
    return PagePart(title=group.title, figures=figures, absent=group.absent)
