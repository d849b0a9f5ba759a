"""``railfix evaluate``: runs against their references."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from railfix.cli.options import CHOICES, INPUTS, CrsOption, DatumOption, GeoidOption, OverwriteOption

if TYPE_CHECKING:
    from railfix.evaluate import RunAndReference


def evaluate(
    *,
    runs: Annotated[list[Path], typer.Argument(metavar="RUN", help="Folder that `railfix run` wrote.")],
    reference: Annotated[
        list[str],
        typer.Option(
            "--reference",
            metavar="FILE",
            rich_help_panel=INPUTS,
            help="Reference trajectory (reference.csv, truth.csv, .gz, RTKLIB), once for each run in order; "
            "`auto`: truth.csv or reference.csv beside the log of each run.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Folder for the files; without it the tables alone.")
    ] = None,
    table: Annotated[
        list[str] | None,
        typer.Option(
            "--table",
            metavar="NAME",
            rich_help_panel=INPUTS,
            help="Table of positions: `positions` (single epochs) or `train` (filter along the track); may be "
            "repeated. By default every table of the run.",
        ),
    ] = None,
    conventional: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            rich_help_panel=INPUTS,
            help="Another run on the same log, whose conventional positions are compared with: one with "
            "`--screens elevation` gives unscreened ones, as in P1.",
        ),
    ] = None,
    sections: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            rich_help_panel=INPUTS,
            help="Environment by chainage (from_m,to_m,environment), where the reference does not tell it.",
        ),
    ] = None,
    track: Annotated[
        list[Path] | None,
        typer.Option(metavar="TRACK", rich_help_panel=INPUTS, help="Track in place of the one that run.json names."),
    ] = None,
    vehicle: Annotated[
        Path | None,
        typer.Option(metavar="TOML", rich_help_panel=INPUTS, help="Vehicle in place of the one that run.json names."),
    ] = None,
    crs: CrsOption = None,
    height_datum: DatumOption = None,
    geoid: GeoidOption = None,
    label: Annotated[
        list[str] | None,
        typer.Option(
            metavar="TEXT",
            rich_help_panel=CHOICES,
            help="Name of the configuration of each run, once for each in order; made from the settings by default.",
        ),
    ] = None,
    method: Annotated[
        Literal["auto", "chainage", "trajectory"],
        typer.Option(
            rich_help_panel=CHOICES,
            help="Errors as differences of chainage, or along the trajectory from the reference's place.",
        ),
    ] = "auto",
    reference_sigma: Annotated[
        float,
        typer.Option(
            metavar="M", rich_help_panel=CHOICES, help="Epochs whose reference is worse are left out of the errors."
        ),
    ] = 0.5,
    reference_gap: Annotated[
        float, typer.Option(metavar="S", rich_help_panel=CHOICES, help="Longest step of the reference that is bridged.")
    ] = 2.5,
    section_length: Annotated[
        float, typer.Option(metavar="M", rich_help_panel=CHOICES, help="Length of the sections of the line.")
    ] = 1000.0,
    speed_classes: Annotated[
        str, typer.Option(metavar="KMH,...", rich_help_panel=CHOICES, help="Where one class of speed ends.")
    ] = "20,60,100",
    standing: Annotated[
        float, typer.Option(metavar="M/S", rich_help_panel=CHOICES, help="Below this speed the train stands.")
    ] = 0.3,
    alarm_limit: Annotated[
        list[float] | None,
        typer.Option(
            metavar="M",
            rich_help_panel=CHOICES,
            help="What a protection level must stay within to be available, beside each run's own limit; may be "
            "repeated. 10, 20 and 40 by default.",
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(metavar="N", rich_help_panel=CHOICES, help="Start of the random numbers of the confidence.")
    ] = 0,
    beside_p1: Annotated[
        bool, typer.Option("--beside-p1", rich_help_panel=CHOICES, help="Also show what the source paper found.")
    ] = False,
    overwrite: OverwriteOption = False,
) -> None:
    r"""Errors along the line of runs against references, and the figures made of them.

    The error is the distance along the line between the answer and the reference, + toward the end of
    the line whichever way the train runs. Shown for the positions on the map, those of status ok, and
    the conventional ones (3-D single point, moved to the nearest point of the line), over each one's own
    epochs and over those that both have; by antenna, section, environment, speed, satellites used
    and status; of several runs also by configuration and line.

    Into DIR come `evaluation.json` (all figures, options, hashes of the inputs), `errors.parquet` (one
    row an epoch and antenna), `tables.csv`, `intervals.csv` and, where a run has protection levels,
    `levels.csv`, `stanford_KIND.csv` (levels against errors, counted at each alarm limit) and
    `beyond_KIND.csv` (every epoch whose error is over its level), with KIND `sbas` or `separation`.

    Example:

        railfix evaluate results --reference truth.csv --out evaluation

        railfix evaluate gps gps-qzs --reference auto --label GPS --label GPS+QZS

    Exit codes: 0 done; 2 the command line was misused; 3 an input file is not what it should be;
    4 a setting is wrong; 5 run, reference and line do not belong together; 8 DIR cannot be written;
    1 a defect of railfix.
    """
    from railfix.cli.evaluate_tables import show_evaluation
    from railfix.core.settings import validated
    from railfix.evaluate import EvaluationOptions, TrackFiles, evaluate_runs, write_evaluation
    from railfix.run.output import OutputFolder

    values = {
        "method": method,
        "reference_sigma_m": reference_sigma,
        "reference_gap_s": reference_gap,
        "standing_mps": standing,
        "section_m": section_length,
        "speed_edges_kmh": _numbers("--speed-classes", speed_classes),
        "seed": seed,
    }
    if alarm_limit:
        values["alarm_limits_m"] = tuple(alarm_limit)
    options = validated(EvaluationOptions, values, source="railfix evaluate")
    files = TrackFiles(track=tuple(track or ()), vehicle=vehicle, crs=crs, height_datum=height_datum, geoid=geoid)
    chosen = _with_tables(_paired(runs, reference, label), table, conventional)

    if out is None:
        evaluation = evaluate_runs(chosen, sections=sections, files=files, options=options)
        written: dict[str, Path] = {}
    else:
        with OutputFolder(out, overwrite="replace" if overwrite else "refuse") as folder:
            evaluation = evaluate_runs(chosen, sections=sections, files=files, options=options)
            written = write_evaluation(evaluation, folder)
    show_evaluation(evaluation, written, beside="p1" if beside_p1 else "nothing")


def _paired(runs: list[Path], reference: list[str], label: list[str] | None) -> list[RunAndReference]:
    """Each run with its reference and label."""
    from railfix.core.errors import SettingsError
    from railfix.evaluate import RunAndReference

    references: list[str] = reference * len(runs) if reference == ["auto"] else reference
    for name, given in (("--reference", references), ("--label", label)):
        if given is not None and len(given) != len(runs):
            raise SettingsError(f"{name} is given {len(given)} times for {len(runs)} runs; give it once for each run")
    labels: list[str | None] = [*label] if label is not None else [None] * len(runs)
    return [
        RunAndReference(run=run, reference=None if file == "auto" else Path(file), configuration=name)
        for run, file, name in zip(runs, references, labels, strict=True)
    ]


def _with_tables(
    runs: list[RunAndReference], tables: list[str] | None, conventional: Path | None
) -> list[RunAndReference]:
    """Each run once per table of positions."""
    from dataclasses import replace

    from railfix.evaluate.run_folder import POSITIONS_TABLE, tables_of

    return [
        replace(item, table=name, conventional=conventional)
        for item in runs
        for name in tables or tables_of(item.run) or [POSITIONS_TABLE]
    ]


def _numbers(option: str, text: str) -> tuple[float, ...]:
    """Numbers between commas."""
    from railfix.core.errors import SettingsError

    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise SettingsError(f"{option} is {text!r}; numbers between commas were expected, such as 20,60,100") from None
