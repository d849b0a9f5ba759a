"""Commands ``railfix evaluate``, ``reference``, ``error-model`` and ``cn0-curve``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from railfix.cli.console import (
    TableConsole,
    list_antenna_errors,
    print_json,
    show_files,
    show_notes,
    show_table,
    show_verdict,
    verdict_of_evaluation,
)
from railfix.cli.options import (
    JsonOption,
    OutOption,
    OverwriteOption,
    VerboseOption,
    Without,
    check_outputs,
    from_models,
    overwriting,
)
from railfix.core.errors import SettingsError
from railfix.core.notebook import plural
from railfix.core.settings import validate
from railfix.core.tables import plain_table
from railfix.evaluate import EvaluationOptions, RunAndReference, TrackFiles, evaluate_runs, write_evaluation
from railfix.evaluate.evaluation_inputs import POSITIONS_TABLE, TABLES, EvaluationInputs, list_position_tables
from railfix.evaluate.range_errors import ModelInputs, StationBeside, error_model_from_runs
from railfix.evaluate.tables import error_tables, group_tables, level_tables
from railfix.pipeline.level_stage import prior_basis_text
from railfix.ranges.cn0_curve import KINDS, Cn0Curve
from railfix.ranges.cn0_curve_file import write_cn0_curve
from railfix.ranges.cn0_curve_fit import CurveFit
from railfix.ranges.cn0_curve_log import cn0_curve_from_log
from railfix.ranges.error_model import LARGEST_PRIOR, ErrorModel, FaultRate, write_error_model
from railfix.ranges.error_model_fit import ErrorModelFit, ErrorSamples, summary
from railfix.reference import ReferenceInputs, ReferenceOptions, ReferenceSettings, ReferenceSummary, reference_files
from railfix.run import read_record
from railfix.run.inputs import LogReading
from railfix.run.output import OutputFolder
from railfix.run.processor_setup import parse_position

if TYPE_CHECKING:
    from railfix.evaluate import Evaluation


#: Maximum number of rows that are printed of each table of groups, such as the table by section.
_MOST_SECTIONS: Final = 20
#: Beginnings of the names of the tables that are printed without ``--verbose``.
_MAIN_TABLES: Final = ("figures-of-merit", "figures-by-configuration", "levels", "above-level")
_MOST_BEYOND: Final = 5  #: Maximum number of printed epochs with an error above the protection level.


def show_evaluation(evaluation: Evaluation, files: dict[str, Path], *, verbose: bool) -> None:
    """Print the verdict, the references of each run, the tables, and the paths of the written files.

    Without `verbose`, only `_MAIN_TABLES` and, for alarm limits that were given, the Stanford counts are printed.
    """
    console = TableConsole()
    show_verdict(console, verdict_of_evaluation(evaluation))
    for run in evaluation.runs:
        console.print(f"{run.name}: {run.configuration}; line {run.line}")
        for antenna, method in run.method.items():
            by = "differences of chainage" if method == "chainage" else "along the trajectory"
            outside = plural(run.outside[antenna], "epoch")
            console.print(f"  {antenna}: compared with {run.reference}, {by}; {outside} not covered by the reference")
        show_notes(console, run.notes)
    levels, groups = level_tables(evaluation, worst=_MOST_BEYOND), group_tables(evaluation)
    tables = [*error_tables(evaluation), *levels, *groups]
    own_limits = evaluation.options.alarm_limits_m != EvaluationOptions().alarm_limits_m
    main = (*_MAIN_TABLES, "stanford") if own_limits else _MAIN_TABLES
    shown = [table for table in tables if verbose or table.name.startswith(main)]
    for table in shown:
        if table in levels[:1]:
            for text in dict.fromkeys(prior_basis_text(run.protection) for run in evaluation.runs if run.protection):
                console.print(f"Protection levels: {text}")
        show_table(console, table, most=_MOST_SECTIONS if table in groups else None)
    if len(shown) < len(tables):
        console.print(f"{plural(len(tables) - len(shown), 'more table')}: --verbose prints all tables")
    show_files(console, files.values())


@from_models
def evaluate(
    *,
    runs: Annotated[list[Path], typer.Argument(metavar="RUN", help="Folder that `railfix run` wrote.")],
    inputs: EvaluationInputs,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="DIR", help="Folder for the output files; without this option, tables are only printed."
        ),
    ] = None,
    files: Annotated[TrackFiles, Without("reference", "map_epoch", "plate", "jgd_parameters", "height_sigma")],
    options: EvaluationOptions,
    overwrite: OverwriteOption = False,
    verbose: VerboseOption = False,
    as_json: JsonOption = False,
) -> None:
    r"""Compute the along-track errors of runs against references, and statistics of these errors.

    The error is the distance along the line from the reference to the position, positive toward the end of the line in
    either direction of travel. The tables have three kinds of positions: those computed with the map, those with status
    ok, and conventional positions (3-D single point, moved to the nearest point of the line). The statistics are
    computed over all positions of each kind, and over the epochs that have a position of each of the three kinds.
    Errors are grouped by antenna, section, environment, speed, number of satellites used, whether satellites were used,
    and status. With several runs, they are also grouped by configuration and line.

    `evaluation.json` in DIR has all statistics, the options and the hashes of the inputs; `errors.parquet` has one row
    per epoch and antenna. Further files are `tables.csv` and `intervals.csv`. For a run with protection levels,
    `levels.csv`, `stanford_KIND.csv` (number of epochs in each region of the Stanford diagram, for each alarm limit)
    and `beyond_KIND.csv` (every epoch with an error above the protection level) are also written; KIND is `sbas`,
    `separation` or `train`. For the filter along the track, `outages.csv` has the stretches without satellites, and
    `branches.csv` compares the stated probability of a branch with the frequency at which the branch was correct.

    Example:

        railfix evaluate results --reference truth.csv --out evaluation

        railfix evaluate gps gps-qzs --reference auto --label GPS --label GPS+QZS

    Exit codes are listed in `railfix --help`.
    """
    if unknown := [name for name in inputs.table if name not in TABLES]:
        raise SettingsError(f"--table {unknown[0]}: no such table; the tables are {', '.join(TABLES)}")
    pairs = [
        replace(pair, table=name, conventional=inputs.conventional)
        for pair in _pair(runs, inputs.reference, inputs.label)
        for name in inputs.table or list_position_tables(pair.run) or [POSITIONS_TABLE]
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
    if as_json:
        notes = [note for run in evaluation.runs for note in run.notes]
        print_json({"antennas": list_antenna_errors(evaluation), "notes": notes, "files": list(written.values())})
    else:
        show_evaluation(evaluation, written, verbose=verbose)


def _pair(runs: list[Path], reference: tuple[str, ...], label: tuple[str, ...]) -> list[RunAndReference]:
    """Return the reference and the label of each run; the reference is None for `auto`.

    Raise SettingsError if the number of references or labels does not match the number of runs.
    """
    references = reference * len(runs) if len(reference) == 1 else reference
    if len(references) != len(runs):
        raise SettingsError(
            f"{len(references)} references for {len(runs)} runs; give one for all runs, or one for each run in order"
        )
    if label and len(label) != len(runs):
        raise SettingsError(f"{len(label)} labels for {len(runs)} runs; give one for each run in order")
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
    r"""Build the reference trajectory of each antenna from RTK fixed positions on the track, and bridge its gaps.

    A position is rejected if it is not an RTK fix, has a low ambiguity ratio, is too far from the antenna's trajectory,
    disagrees with the distance travelled, or disagrees with the distance between the two antennas. The remaining
    positions are matched to the trajectory. The gaps between these positions are bridged with the available Doppler
    speeds, tachometer pulses and accelerations, weighted by their inverse variances. The closing error of a gap is
    distributed over the gap. The following files are written into DIR:

    - `reference.csv`: one row per instant and antenna; position, speed, standard deviation, source `rtk` or `bridged`
    - `fixes.csv`: every position with its test result and measurements
    - `reference.json`: versions, hashes of the inputs, settings given and used, counts by reason, gaps

    Gaps that are too long, and instants with too large a standard deviation, are omitted, counted and reported. All
    times are GPS time.

    Example:

        railfix reference --rtk rtk.pos --track line.csv --vehicle car.toml \
            --front front.obs --nav brdc.nav --pulses tacho.csv --out reference

    Exit codes are listed in `railfix --help`; the code is 7 if there are fewer than two good fixes.
    """
    asked = settings.model_dump(mode="json", exclude_unset=True)
    show_reference(reference_files(inputs, settings, out=out, options=options, asked=asked))


def show_reference(summary: ReferenceSummary) -> None:
    """Print the numbers of fixes, instants and rejections of each antenna, the notes, and the paths of the written
    files.
    """
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
    console = TableConsole()
    show_notes(console, summary.notes)
    show_files(console, summary.files.values())


@from_models
def error_model(
    *,
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders that `railfix run` wrote.")],
    beside: StationBeside,
    out: Annotated[Path, typer.Option("--out", metavar="MODEL.toml", help="File for the error model.")],
    fit: ErrorModelFit,
    overwrite: OverwriteOption = False,
) -> None:
    """Model the errors that corrected pseudoranges have on a line because of multipath and receiver noise.

    The positions of each RUN are computed again with its settings. The error of a pseudorange is the pseudorange minus
    the sum of the receiver clock bias and the distance between satellite and reference position. With `--base`, the
    error of the same satellite at a nearby reference station is also subtracted. Without `--base`, the model includes
    the orbit, clock and atmospheric errors of the recorded days; its standard deviations are then larger, and it is
    valid only for days with similar errors.

    The file has the bias, the standard deviation and a Gaussian overbound for every bin of elevation, C/N0, and azimuth
    relative to the front of the car. Bias, standard deviation and overbound are stated before and after the screens.
    `railfix run --error-model MODEL.toml` derives the protection level from the model.

    Example: `railfix error-model results --reference reference.csv --base 0759.obs --out line.toml`

    Exit codes are listed in `railfix --help`; the code is 5 if run, reference and station do not match.
    """
    reference = beside.reference
    if len(reference) != len(runs):
        raise SettingsError(f"{len(runs)} runs and {len(reference)} references: give --reference once for each run")
    in_runs = [path for run in runs if run.is_dir() for path in run.iterdir()]
    read = [path for run in runs if (run / "run.json").is_file() for path in read_record(run).inputs.paths]
    check_outputs((out, "any"), overwrite=overwrite, inputs=[*reference, *beside.base, *in_runs, *read])
    if own := [file for file in beside.base if file.resolve() in [path.resolve() for path in read]]:
        raise SettingsError(f"--base {own[0]}: this is a log of the run itself; give the log of a reference station")
    position = beside.base_position
    place = None if position is None else parse_position(position, "--base-position")
    inputs = [
        ModelInputs(run=run, reference=file, base=beside.base, base_position_ecef_m=place, columns=beside.columns)
        for run, file in zip(runs, reference, strict=True)
    ]
    model, samples = error_model_from_runs(inputs, fit=fit)
    write_error_model(model, out)
    _print_model(model, samples)
    typer.echo(f"wrote {out}")


def priors_text(rate: FaultRate) -> str:
    """Return a sentence on the fault priors that a run with this model assumes."""
    if not rate.bounds_priors:
        return (
            f"Too few blocks to show that both priors are below {LARGEST_PRIOR:g}: protection levels of runs with "
            "this model are only indicative, unless settings state risk.local_prior and risk.side_prior"
        )
    return (
        f"Runs with this model (--error-model) use the measured values risk.local_prior = {rate.upper:.2g} and "
        f"risk.side_prior = {rate.side_upper:.2g}, unless settings state these priors"
    )


def _print_model(model: ErrorModel, samples: ErrorSamples) -> None:
    console = TableConsole()
    base = model.source.base or "none, so that satellite and atmospheric errors are part of the model"
    console.print(
        f"{len(samples.error_m):,} pseudoranges of {model.source.epochs:,} epochs; in metres; reference station: {base}"
    )
    figures = [[f"{when}\ncount", "\nbias", "\nsigma", "\nbound"] for when in ("before", "after")]
    head = ["before and\nafter screens", *figures[0], *figures[1]]
    show_table(console, plain_table(head, [list(row) for row in summary(model)]))
    if (rate := model.faults) is not None:
        console.print(
            f"local faults: errors of {rate.faulty} of {rate.ranges:,} used ranges exceed {rate.beyond_sigma:g} times "
            f"the sigma of the protection level (fraction {rate.prior:.2g}, at most {rate.upper:.2g} with 95 % "
            f"confidence; {rate.faulty_blocks} of {rate.blocks:,} blocks have such errors). Two satellites are faulty "
            f"together {rate.together:.1f} times as often as independent satellites would be. Low satellites on one "
            f"side of the track are faulty together in {rate.side_faulty_blocks} of {rate.side_blocks:,} blocks "
            f"(side_prior at most {rate.side_upper:.2g}). {priors_text(rate)}"
        )
        if stretches := ", ".join(f"[{start:g}, {end:g}]" for start, end in rate.no_level_m):
            console.print(
                f"at chainages [m] {stretches}, local faults are more frequent than on the whole line: runs that use "
                "the priors of this model have no protection level there"
            )


@from_models
def cn0_curve(
    observations: Annotated[
        list[Path],
        typer.Argument(metavar="OBS...", help="RINEX observation files of one receiver over about a day."),
    ],
    *,
    nav: Annotated[
        list[Path],
        typer.Option("--nav", metavar="FILE", help="RINEX navigation file of that day; may be repeated."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="CURVE.toml", help="File for the curve.")],
    plot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Plot of the samples, the mean C/N0 and the threshold.")
    ] = None,
    position: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON,HEIGHT",
            help="Antenna position to within a few kilometres, in degrees and metres; by default from the file header.",
        ),
    ] = None,
    bin_deg: Annotated[float, typer.Option("--bin", metavar="DEG", help="Width of the elevation bins.")] = 5.0,
    reading: LogReading,
    overwrite: OverwriteOption = False,
) -> None:
    """Fit the mean C/N0 of one antenna and receiver as a function of satellite elevation.

    Record about a day under open sky with the antenna and the receiver of the train, because the curve is valid only
    for this antenna and receiver. One curve is fitted per constellation and signal. The file also names the inputs.
    With the curve, positioning rejects signals more than 10 dB below the mean at their elevation; without a curve, only
    a fixed minimum of the C/N0 can be applied.

    Example: `railfix cn0-curve roof.crx.gz --nav roof.rnx.gz --out roof.toml --plot roof.png`

    Exit codes are listed in `railfix --help`; the code is 5 if the position or the navigation files do not match the
    log.
    """
    fit = validate(CurveFit, {"bin_deg": bin_deg}, source="--bin")
    place = None if position is None else parse_position(position, "--position")
    outputs = check_outputs((out, "any"), (plot, "png"), overwrite=overwrite, inputs=[*observations, *nav])
    fitted = cn0_curve_from_log(observations, nav, position_ecef_m=place, fit=fit, **reading.of_observations)
    if plot is not None:
        from railfix.report.plots.screens import draw_cn0_curve

        draw_cn0_curve(plot, fitted.curve, fitted.samples)
    write_cn0_curve(fitted.curve, out)
    _print_curve(fitted.curve, fitted.notes)
    show_files(TableConsole(), outputs)


def _print_curve(curve: Cn0Curve, notes: tuple[str, ...]) -> None:
    console, source = TableConsole(), curve.source
    console.print(
        f"antenna {source.antenna or 'not named'}, receiver {source.receiver or 'not named'}; {source.epochs:,} "
        f"epochs from {source.start[:19]} to {source.end[:19]}; mean C/N0 in dB-Hz by elevation"
    )
    rows = []
    for mean in curve.means:
        half = (mean.elevation_deg[1] - mean.elevation_deg[0]) / 2.0
        values = ["-" if value != value else f"{value:.1f}" for value in mean.at([15.0, 45.0, 75.0]).tolist()]
        span = f"{mean.elevation_deg[0] - half:.0f}-{mean.elevation_deg[-1] + half:.0f}"
        spread = f"{float(mean.spread_db.mean()):.1f}"
        rows.append([KINDS.get(mean.kind, mean.kind), mean.signal, f"{int(mean.count.sum()):,}", span, *values, spread])
    head = ["satellites", "signal", "samples", "elevation", "15 deg", "45 deg", "75 deg", "spread"]
    show_table(console, plain_table(head, rows, texts=2))
    show_notes(console, notes)
