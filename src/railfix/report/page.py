"""Report on runs as one HTML page with tables and charts."""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import count as counter
from pathlib import Path
from typing import Any, Final

from railfix.core.arrays import Floats
from railfix.core.files import path_names
from railfix.core.staged_files import write_whole
from railfix.core.tables import Table, count, number, share
from railfix.evaluate import Evaluation, EvaluationOptions
from railfix.evaluate.evaluation_inputs import POSITIONS_TABLE, flat_settings
from railfix.evaluate.tables import error_tables, group_tables, select_evaluation
from railfix.report.charts_page import (
    Absent,
    Block,
    Folded,
    Group,
    Notes,
    PagePart,
    ReportedCommand,
    Sentence,
    figure,
    read_background,
    render,
)
from railfix.report.figures import NO_OBSERVATIONS, NO_REFERENCE, antenna_groups, overview, protection, run_group
from railfix.report.headline import headline
from railfix.report.plots.errors import error_ranges, errors_of_runs
from railfix.report.plots.signals import SKY_EPOCHS
from railfix.report.runs import ReportedRun, get_figures, read_runs
from railfix.run.record import budget_tables, level_basis

#: Errors in the table of all runs: for each name in the header, kind of position and table of positions.
_JUDGED: Final = {
    "filter": ("constrained", "train"),
    "single epochs": ("constrained_ok", POSITIONS_TABLE),
    "conventional": ("conventional", POSITIONS_TABLE),
}


def summary(runs: Sequence[ReportedRun], evaluation: Evaluation | None) -> Table:
    """Return a table with one row per run and antenna: settings, rates, sigma and, with a reference, errors."""
    head = ["run", "antenna", "settings", "epochs", "rate", "ok", "sigma p95"]
    judged = [name for kind in _JUDGED for name in (f"{kind} p95", "largest")] if evaluation else []
    rows = []
    for run in runs:
        asked = flat_settings(run.record.get("settings_asked") or {})
        chosen = [run.config.preset, *(f"{name} {_word(value)}" for name, value in asked.items() if name != "preset")]
        for antenna, facts in _antennas(run).items():
            sigma = facts.get("along_sigma_m") or {}
            row = [
                run.name,
                antenna,
                "; ".join(chosen),
                count(facts.get("epochs")),
                share(facts.get("positioning_rate")),
                share(facts.get("ok_rate")),
                number(_plain(sigma.get("p95_m"))),
            ]
            if evaluation:
                for position, table in _JUDGED.values():
                    figures = get_figures(evaluation, run, antenna, position, table=table)
                    row += [number(figures.get(k)) for k in ("p95_m", "max_m")]
            rows.append(row)
    caption = (
        "The column of settings has the preset, and settings whose values differ from it. The rate is the number of "
        "positions divided by the number of epochs with observations. Sigma p95 is the 95th percentile of the stated "
        "standard deviation along the line, in metres"
    )
    if evaluation:
        caption += (
            ". The last columns are the 95th percentile and the maximum of the error along the line, in metres: for "
            "the filter at all epochs, for single epochs that passed every check, and for conventional positions"
        )
    columns = range(3, len(head) + len(judged))
    return Table(name="summary", head=[*head, *judged], rows=rows, caption=caption, numeric=columns)


def _antennas(run: ReportedRun) -> Mapping[str, Mapping[str, Any]]:
    known: Mapping[str, Mapping[str, Any]] = run.record.get("antennas") or {}
    return {name: known.get(name) or {} for name in run.folder.antennas}


def provenance(run: ReportedRun) -> list[Block]:
    """Return tables and texts on the origin of a run: command, versions, line, hashes of the inputs, and notes."""
    record = run.record
    written = datetime.fromtimestamp((run.folder.path / "run.json").stat().st_mtime, tz=UTC)
    versions: Mapping[str, Any] = record.get("versions") or {}
    spans = [
        f"{name}: {facts.get('first_epoch_gpst')} to {facts.get('last_epoch_gpst')} GPS time"
        for name, facts in _antennas(run).items()
    ]
    track = run.folder.track_facts
    vehicle = (record.get("line") or {}).get("vehicle") or {}
    rows = [
        ("folder", str(run.folder.path)),
        ("written", written.strftime("%Y-%m-%d %H:%M:%S UTC")),
        ("epochs", "; ".join(spans)),
        ("reference", run.reference or "none given"),
        ("line", f"{run.folder.line_name}, {track.get('length_m', '?')} m, {track.get('points', '?')} points"),
        ("vehicle", str(vehicle.get("name") or "none: the track is taken as the trajectory of the antenna")),
        ("versions", ", ".join(f"{name} {value}" for name, value in versions.items())),
        ("platform", str(record.get("platform", "not recorded"))),
        ("wall time", f"{record.get('wall_s', '?')} s"),
    ]
    inputs = [
        [str(f["input"]), str(f["path"]), count(f.get("bytes")), str(f.get("sha256", ""))]
        for f in record.get("inputs") or []
    ]
    notes = [*(str(note) for note in record.get("notes") or []), *run.notes]
    return [
        Table(name="run", head=["", "run"], rows=rows),
        ReportedCommand(shlex.join(str(word) for word in record.get("command") or [])),
        Table(name="inputs", head=["input", "file", "bytes", "SHA-256"], rows=inputs, numeric=[2], code=[1, 3]),
        Notes("Notes", notes) if notes else Sentence("The run has no notes."),
    ]


def settings(run: ReportedRun) -> list[Block]:
    """Return a table of the settings that were used; settings that the user gave come first and are highlighted."""
    asked = flat_settings(run.record.get("settings_asked") or {})
    used = flat_settings(run.record.get("settings_used") or {})
    names = [*(name for name in used if name in asked), *(name for name in asked if name not in used)]
    names += [name for name in used if name not in asked]
    rows = [[name, _word(asked.get(name, "")), _word(used.get(name, ""))] for name in names]
    return [
        Sentence(f"{len(asked)} of {len(used)} settings were given; the others have their default values."),
        Table(name="settings", head=["setting", "asked", "used"], rows=rows, marked=range(len(asked))),
    ]


def budget(run: ReportedRun) -> list[Block]:
    """Return three tables: signs of interference, epochs by status, and pseudoranges by first reason of rejection."""
    antennas = _antennas(run)
    signs = [
        [name, sign, count(seen["epochs"]), str(seen["first"])]
        for name, facts in antennas.items()
        for sign, seen in (facts.get("interference") or {}).items()
    ]
    suspected = [
        Table(
            name="interference", head=["antenna", "sign", "epochs", "first, GPS time"], rows=signs, numeric=[2],
            caption="Signs of jamming and spoofing",
        )
    ] if signs else [Sentence("No sign of jamming or spoofing.")]  # fmt: skip
    return [
        *suspected,
        *budget_tables(antennas, level_basis(run.record)),
    ]


def merits(run: ReportedRun, evaluation: Evaluation) -> list[Block]:
    """Return the tables of figures of merit of one run, for positions on the map and conventional positions."""
    return _with_groups(select_evaluation(evaluation, run.name_in(evaluation)))


def filter_tables(run: ReportedRun, evaluation: Evaluation) -> list[Block]:
    """Return the tables of figures of merit of the filter along the track, or a sentence if the run has no filter."""
    name = run.name_in(evaluation, "train")
    if not name:
        return [Absent("The run has no filter along the track (railfix run --filter off).")]
    return _with_groups(select_evaluation(evaluation, name), of="filter-")


def _with_groups(evaluation: Evaluation, *, of: str = "") -> list[Block]:
    tables, groups = (
        [replace(table, name=f"{of}{table.name}") for table in found]
        for found in (error_tables(evaluation), group_tables(evaluation))
    )
    return [*tables, *(Folded(table.caption.split(";")[0], [table]) for table in groups)]


def _plain(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _word(value: Any) -> str:
    if isinstance(value, Iterable) and not isinstance(value, str):
        return " ".join(str(v) for v in value)
    return "none" if value is None else str(value)


#: The sky plot of an antenna has at least this number of epochs, however many antennas the page has.
_LEAST_SKY: Final = 200


def write_report(
    runs: Sequence[Path | str],
    out: Path | str,
    *,
    references: Sequence[Path | str] = (),
    conventional: Sequence[Path | str] = (),
    background: Path | str | None = None,
    title: str = "",
    options: EvaluationOptions | None = None,
) -> Path:
    """Write the report on runs as an HTML page and return its path; a failed write leaves an existing file unchanged.

    For `references`, `conventional` and the errors that are raised, see `railfix.report.read_runs`. `background` is a
    GeoJSON file with lines that are drawn below the plan. Raise OutputError if the page cannot be written.
    """
    folders, others, unscreened = (
        [Path(name) for name in path_names(names)] if names else [] for names in (runs, references, conventional)
    )
    reported, evaluation = read_runs(folders, others, conventional=unscreened, options=options)
    lines = () if background is None else read_background(Path(background))
    return write_page(reported, evaluation, Path(out), background=lines, title=title)


def write_page(
    runs: Sequence[ReportedRun],
    evaluation: Evaluation | None,
    out: Path,
    *,
    background: Sequence[Floats] = (),
    title: str = "",
) -> Path:
    """Write an HTML page with the report on runs that `read_runs` has read, and return the path of the page.

    For `background` see `report_page`. Raise OutputError if the page cannot be written.
    """
    write_whole(out, report_page(runs, evaluation, background=background, title=title), what="report")
    return out


def report_page(
    runs: Sequence[ReportedRun], evaluation: Evaluation | None, *, background: Sequence[Floats] = (), title: str = ""
) -> str:
    """Return the HTML of the report.

    `background` has lines that are drawn below the plan, each as longitude and latitude of shape (P, 2) [deg].
    """
    numbers = counter()
    antennas = max(sum(len(run.folder.antennas) for run in runs), 1)
    # with many antennas, the sky plot of each antenna has fewer epochs, which limits the size of the page
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
    """Return the table of all runs, and sentences on missing parts of the page."""
    blocks: list[Block] = [summary(runs, evaluation)]
    if evaluation is None:
        blocks.append(Absent(NO_REFERENCE))
    without = [run.name for run in runs if run.observations is None]
    if without:
        blocks.append(Absent(NO_OBSERVATIONS if len(runs) == 1 else f"{', '.join(without)}: {NO_OBSERVATIONS}"))
    return blocks


def _ranges(runs: Sequence[ReportedRun], evaluation: Evaluation | None, numbers: Iterator[int]) -> PagePart:
    if evaluation is None:
        return PagePart(title="", figures=())
    series = {
        f"{run.name}, {antenna}": errors
        for run in runs
        for antenna in run.folder.antennas
        if (errors := run.get_errors(antenna)) is not None
    }
    # for a single run, the run's own chart over chainage already shows the errors
    charts = [error_ranges(series), *([errors_of_runs(series)] if len(runs) > 1 else [])]
    return PagePart(title="", figures=[figure(chart, numbers) for chart in charts if not chart.empty])


def _run(
    run: ReportedRun,
    evaluation: Evaluation | None,
    number: int,
    numbers: Iterator[int],
    *,
    sky: int,
    background: Sequence[Floats],
) -> dict[str, Any]:
    """Return the values of one run for the template; `sky` is the maximum number of epochs of a sky plot."""
    anchor, first = f"run{number}", run.folder.antennas[0]
    errors: list[Folded] = []
    if evaluation is not None:
        errors.append(Folded("Figures of merit", merits(run, evaluation)))
        errors.append(Folded("Filter along the track", filter_tables(run, evaluation)))

    def place(i: int) -> str:
        return f"sky{number}-{i}" if run.observations is not None else ""

    return {
        "name": run.name,
        "anchor": anchor,
        "antenna": first,
        "headline": headline(run, first, evaluation),
        "overview": _part(
            overview(run, first, background), numbers, place(0), anchor, linked=f"{anchor}-0", width="half"
        ),
        "tables": (
            *errors,
            Folded("Epochs and pseudoranges", budget(run)),
            Folded("Protection level", protection(run, evaluation)),
            Folded("Run, inputs and notes", provenance(run)),
            Folded("Settings given and used", settings(run)),
        ),
        "timing": _part(run_group(run), numbers, "", anchor),
        "antennas": [
            {
                "name": antenna,
                "anchor": f"{anchor}-{i}",
                "parts": [
                    _part(group, numbers, place(i), anchor, linked=f"{anchor}-{i}")
                    for group in antenna_groups(run, antenna, sky=sky, background=background)
                ],
            }
            for i, antenna in enumerate(run.folder.antennas)
        ],
    }


def _part(
    group: Group, numbers: Iterator[int], sky: str, anchor: str, *, linked: str = "", width: str = ""
) -> PagePart:
    figures = [
        figure(chart, numbers, group=group, sky=sky, anchor=anchor, linked=linked, width=width)
        for chart in group.charts
    ]
    return PagePart(title=group.title, figures=figures, absent=group.absent)
