"""Commands about references: errors against them, and how they are built."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import polars as pl
import typer
from rich.console import Console

from railfix.cli.console import (
    console_of_tables,
    show_files,
    show_notes,
    show_table,
    show_verdict,
    verdict_of_evaluation,
)
from railfix.cli.options import OutOption, OverwriteOption, Without, from_models, overwriting
from railfix.core.errors import SettingsError
from railfix.core.tables import Column, listing, number, percent, signed
from railfix.evaluate import EvaluationOptions, RunAndReference, TrackFiles, evaluate_runs, write_evaluation
from railfix.evaluate.options import EvaluationInputs
from railfix.evaluate.run_folder import POSITIONS_TABLE, TABLES, tables_of
from railfix.evaluate.tables import P1_COMMERCIAL, P1_TABLE_4, error_tables, group_tables, level_tables
from railfix.pipeline.level_stage import prior_basis_text
from railfix.reference import ReferenceInputs, ReferenceOptions, ReferenceSettings, ReferenceSummary, reference_files
from railfix.run.output import OutputFolder

if TYPE_CHECKING:
    from railfix.evaluate import Evaluation

#: Rows of sections, and epochs with an error beyond the level, that are shown; the files have all.
_MOST_SECTIONS: Final = 20
_MOST_BEYOND: Final = 5


def show_evaluation(evaluation: Evaluation, files: dict[str, Path], *, beside: Literal["nothing", "p1"]) -> None:
    """Figures of each run, then by groups, then where the files are."""
    console = console_of_tables()
    show_verdict(console, verdict_of_evaluation(evaluation))
    write = partial(console.print, markup=False, soft_wrap=True)
    for run in evaluation.runs:
        write(f"{run.name}: {run.configuration}; line {run.line}")
        for antenna, method in run.method.items():
            by = "differences of chainage" if method == "chainage" else "along the trajectory"
            write(f"  {antenna}: against {run.reference}, {by}; {run.outside[antenna]:,} epochs outside the reference")
        show_notes(console, run.notes)
    for table in error_tables(evaluation):
        show_table(console, table)
    for text in dict.fromkeys(prior_basis_text(run.protection) for run in evaluation.runs if run.protection):
        write(f"Protection levels: {text}")
    for table in level_tables(evaluation, worst=_MOST_BEYOND):
        show_table(console, table)
    for table in group_tables(evaluation):
        show_table(console, table, most=_MOST_SECTIONS)
    if beside == "p1":
        _show_p1(console)
    show_files(console, files.values())


def _show_p1(console: Console) -> None:
    """The figures of the source paper."""
    rate: Column = ("rate %", "rate", percent)
    test_line = (("configuration", "configuration", str), rate, ("mean", "mean_m", signed), ("std", "std_m", number))
    caption = "The source paper, test line (table 4)"
    show_table(console, listing("p1", pl.DataFrame(P1_TABLE_4), test_line, caption))
    caption = (
        "The source paper, commercial lines with MSAS (5): rate of the section without tunnels (figure 10), "
        "largest error of all (figure 11)"
    )
    commercial = (("position", "position", str), rate, ("max", "max_m", number))
    show_table(console, listing("p1", pl.DataFrame(P1_COMMERCIAL), commercial, caption))


@from_models
def evaluate(
    *,
    runs: Annotated[list[Path], typer.Argument(metavar="RUN", help="Folder that `railfix run` wrote.")],
    inputs: EvaluationInputs,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for the files; without it the tables alone.")
    ] = None,
    files: Annotated[TrackFiles, Without("reference", "map_epoch", "plate", "jgd_parameters", "height_sigma")],
    options: EvaluationOptions,
    beside_p1: Annotated[
        bool, typer.Option("--beside-p1", rich_help_panel="Choices", help="Also show the results of the source paper.")
    ] = False,
    overwrite: OverwriteOption = False,
) -> None:
    r"""Compute errors of runs along the line against references, and statistics of them.

    The error is the distance along the line from the reference to the position, + toward the end of
    the line whichever way the train runs. Shown for the positions on the map, those of status ok, and
    the conventional ones (3-D single point, moved to the nearest point of the line), over each one's own
    epochs and over those that both have; by antenna, section, environment, speed, satellites used,
    with and without satellites, and status; of several runs also by configuration and line.

    Into DIR come `evaluation.json` (all figures, options, hashes of the inputs), `errors.parquet` (one
    row an epoch and antenna), `tables.csv`, `intervals.csv` and, where a run has protection levels,
    `levels.csv`, `stanford_KIND.csv` (levels against errors, counted at each alarm limit) and
    `beyond_KIND.csv` (every epoch whose error is over its level), with KIND `sbas`, `separation` or `train`;
    for the filter along the track `outages.csv` (stretches without satellites) and `branches.csv` (stated
    probability of the place against its correctness).

    Example:

        railfix evaluate results --reference truth.csv --out evaluation

        railfix evaluate gps gps-qzs --reference auto --label GPS --label GPS+QZS

    Exit codes: 0 done; 2 the command line was misused; 3 an input file is not what it should be;
    4 a setting is wrong; 5 run, reference and line do not match each other; 8 DIR cannot be written;
    1 a defect of railfix.
    """
    if unknown := [name for name in inputs.table if name not in TABLES]:
        raise SettingsError(f"--table {unknown[0]}: no such table; known are {', '.join(TABLES)}")
    pairs = [
        replace(pair, table=name, conventional=inputs.conventional)
        for pair in _pair(runs, inputs.reference, inputs.label)
        for name in inputs.table or tables_of(pair.run) or [POSITIONS_TABLE]
    ]
    written: dict[str, Path] = {}
    if out is None:
        evaluation = evaluate_runs(pairs, sections=inputs.sections, files=files, options=options)
    else:
        given = [pair.reference for pair in pairs if isinstance(pair.reference, Path)]
        read = [*given, *files.track, *(path for path in (inputs.sections, files.vehicle) if path is not None)]
        with OutputFolder(out, overwrite=overwriting(overwrite), inputs=read) as folder:
            evaluation = evaluate_runs(pairs, sections=inputs.sections, files=files, options=options)
            written = write_evaluation(evaluation, folder)
    show_evaluation(evaluation, written, beside="p1" if beside_p1 else "nothing")


def _pair(runs: list[Path], reference: tuple[str, ...], label: tuple[str, ...]) -> list[RunAndReference]:
    """Each run with its reference and label."""
    references = reference * len(runs) if len(reference) == 1 else reference
    if len(references) != len(runs):
        raise SettingsError(
            f"{len(references)} references for {len(runs)} runs; give one for all runs, or one for each in order"
        )
    if label and len(label) != len(runs):
        raise SettingsError(f"{len(label)} labels for {len(runs)} runs; give one for each in order")
    return [
        RunAndReference(run=run, reference=None if file == "auto" else Path(file), configuration=name)
        for run, file, name in zip(runs, references, label or [None] * len(runs), strict=True)
    ]


@from_models
def reference(
    inputs: ReferenceInputs,
    settings: ReferenceSettings,
    options: Annotated[ReferenceOptions, Without("reference")],
    *,
    out: OutOption,
) -> None:
    r"""Build the reference trajectory of the antennas: fixed positions on the track, gaps between them bridged.

    Positions are rejected that are not fixed, have a low ratio, whose two antennas are not as far apart as on the
    vehicle, that lie off the antenna's trajectory, or that disagree with the distance travelled. The others are
    matched to the trajectory. Between them Doppler speeds, pulses and acceleration, whichever are given, are
    weighted by their variances, and the closing error of each gap is distributed over it. Written into DIR:

    - `reference.csv`: one row per instant and antenna; position, speed, standard deviation, source `rtk` or `bridged`
    - `fixes.csv`: every position with its verdict and measurements
    - `reference.json`: versions, hashes of the inputs, settings given and used, counts by reason, gaps

    Gaps that are too long and instants of too large a standard deviation are left out, counted and named. All times are
    GPS time.

    Example:

        railfix reference --rtk rtk.pos --track line.csv --vehicle car.toml \
            --front front.obs --nav brdc.nav --pulses tacho.csv --out reference

    Exit codes: 0 done; 2 the command line was misused; 3 an input file is not what it should be;
    4 a setting is wrong; 5 the inputs do not match each other; 7 fewer than two good fixes; 8 DIR cannot be
    written; 1 a defect of railfix.
    """
    asked = settings.model_dump(mode="json", exclude_unset=True)
    show_reference(reference_files(inputs, settings, out=out, options=options, asked=asked))


def show_reference(summary: ReferenceSummary) -> None:
    """Counts by antenna, the notes, and where the results are."""
    for name, part in summary.built.items():
        source = part.reference.source
        counts = part.fixes.counts()
        good = counts.pop("good")
        rejected = ", ".join(f"{count:,} {what}" for what, count in counts.items() if count) or "none"
        typer.echo(f"{name}: {len(part.fixes):,} positions, {good:,} good fixes; rejected: {rejected}")
        by = ", ".join(f"{count:,} by {what}" for what, count in part.bridged_by.items()) or "none"
        bridged = source == "bridged"
        typer.echo(
            f"{name}: {int((source == 'rtk').sum()):,} instants from fixes, {int(bridged.sum()):,} bridged ({by})"
        )
        left = ", ".join(f"{count:,} {what.replace('_', ' ')}" for what, count in part.left_out.items() if count)
        typer.echo(f"{name}: left out: {left or 'none'}")
    for note in summary.notes:
        typer.echo(f"note: {note}")
    for path in summary.files.values():
        typer.echo(f"wrote {path}")
