"""``railfix evaluate``: runs against their references."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from railfix.cli.evaluate_tables import show_evaluation
from railfix.cli.options import OverwriteOption, Without, from_models, overwriting
from railfix.core.errors import SettingsError
from railfix.evaluate import EvaluationOptions, RunAndReference, TrackFiles, evaluate_runs, write_evaluation
from railfix.evaluate.options import EvaluationInputs
from railfix.evaluate.run_folder import POSITIONS_TABLE, TABLES, tables_of
from railfix.run.output import OutputFolder


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
