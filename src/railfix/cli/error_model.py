"""Commands that fit models: errors of pseudoranges, C/N0 over elevation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from railfix.cli.console import console_of_tables, show_files, show_notes, show_table
from railfix.cli.options import LenientOption, OverwriteOption, check_outputs, from_models
from railfix.core.errors import SettingsError
from railfix.core.settings import validated
from railfix.core.tables import listed
from railfix.evaluate.range_errors import ModelInputs, StationBeside, error_model_from_runs
from railfix.ranges.cn0_curve import KINDS, Cn0Curve, CurveFit, cn0_curve_from_log, write_cn0_curve
from railfix.ranges.error_model import (
    LARGEST_PRIOR,
    ErrorModel,
    ErrorModelFit,
    ErrorSamples,
    FaultRate,
    summary,
    write_error_model,
)
from railfix.run import read_record
from railfix.run.processor import place_of


@from_models
def error_model(
    *,
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders that `railfix run` wrote.")],
    beside: StationBeside,
    out: Annotated[Path, typer.Option("--out", metavar="MODEL.toml", help="Error model to write.")],
    fit: ErrorModelFit,
    overwrite: OverwriteOption = False,
) -> None:
    """Model the errors of corrected pseudoranges: multipath of the line and receiver noise.

    Each RUN is positioned once more with its own settings. The error of a pseudorange is its residual after the
    distance from the reference and the receiver clock are subtracted, and with `--base` also the residual of a
    nearby reference station to the same satellite. Without `--base` the model includes the orbit, clock and
    atmospheric errors of those days: it is wider, and valid for such days.

    The file has bias, standard deviation and a Gaussian overbound for every bin of elevation, azimuth from the
    car's front and C/N0, before the screens and after. `railfix run --error-model MODEL.toml` derives
    the protection level from it.

    Example: `railfix error-model results --reference reference.csv --base 0759.obs --out line.toml`

    Exit codes as `railfix --help` says; 5 where run, reference and station do not match each other.
    """
    reference = beside.reference
    if len(reference) != len(runs):
        raise SettingsError(f"{len(runs)} runs and {len(reference)} references: give --reference once for each run")
    in_runs = [path for run in runs if run.is_dir() for path in run.iterdir()]
    read = [path for run in runs if (run / "run.json").is_file() for path in read_record(run).inputs.paths]
    check_outputs((out, "any"), overwrite=overwrite, inputs=[*reference, *beside.base, *in_runs, *read])
    if own := [file for file in beside.base if file.resolve() in [path.resolve() for path in read]]:
        raise SettingsError(f"--base {own[0]}: is a log of the run itself; give that of a reference station")
    position = beside.base_position
    place = None if position is None else place_of(position, "--base-position")
    inputs = [
        ModelInputs(run=run, reference=file, base=beside.base, base_position_ecef_m=place, columns=beside.columns.names)
        for run, file in zip(runs, reference, strict=True)
    ]
    model, samples = error_model_from_runs(inputs, fit=fit)
    write_error_model(model, out)
    _print_model(model, samples)
    typer.echo(f"wrote {out}")


def priors_text(rate: FaultRate) -> str:
    """Say what a run with this model takes for its priors."""
    if not rate.bounds_priors:
        return (
            f"Too few blocks to bound both priors by {LARGEST_PRIOR:g}: the levels of runs with this model stay "
            "indicative, unless risk.local_prior and risk.side_prior are given"
        )
    return (
        f"Runs with this model (--error-model) take risk.local_prior = {rate.upper:.2g} and risk.side_prior = "
        f"{rate.side_upper:.2g} as measured, unless they are given"
    )


def _print_model(model: ErrorModel, samples: ErrorSamples) -> None:
    console = console_of_tables()
    base = model.source.base or "none: errors of satellites and atmosphere are in the model"
    console.print(
        f"{len(samples.error_m):,} pseudoranges of {model.source.epochs:,} epochs; reference station: {base}; "
        "in metres",
        markup=False,
    )
    figures = [[f"{when}\ncount", "\nbias", "\nsigma", "\nbound"] for when in ("before", "after")]
    head = ["before and\nafter screens", *figures[0], *figures[1]]
    show_table(console, listed(head, [[row.name, *row.cells] for row in summary(model)]))
    if (rate := model.faults) is not None:
        console.print(
            f"local faults: {rate.faulty} of {rate.ranges:,} used ranges beyond {rate.beyond_sigma:g} sigma of the "
            f"level ({rate.prior:.2g}; {rate.faulty_blocks} of {rate.blocks:,} blocks; at most {rate.upper:.2g} with "
            f"95 % confidence); two satellites at a time {rate.together:.1f} times as often as independent ones, low "
            f"ones of one side of the track in {rate.side_faulty_blocks} of {rate.side_blocks:,} blocks (side_prior at "
            f"most {rate.side_upper:.2g}). {priors_text(rate)}",
            markup=False,
            soft_wrap=True,
        )
        if stretches := ", ".join(f"[{start:g}, {end:g}]" for start, end in rate.no_level_m):
            console.print(
                f"local faults are more frequent than on the line at chainages [m] {stretches}: runs that take the "
                "priors of this model have no level there",
                markup=False,
                soft_wrap=True,
            )


def cn0_curve(
    observations: Annotated[
        list[Path],
        typer.Argument(metavar="OBS...", help="RINEX observation file or files of one receiver, about a day."),
    ],
    *,
    nav: Annotated[
        list[Path],
        typer.Option("--nav", metavar="FILE", help="RINEX navigation file of that day; repeat it for several."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="CURVE.toml", help="Curve to write.")],
    plot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Picture of the samples, the mean and the threshold.")
    ] = None,
    position: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON,HEIGHT",
            help="Position of the antenna, in degrees and metres, within some kilometres; from the header without it.",
        ),
    ] = None,
    bin_deg: Annotated[float, typer.Option("--bin", metavar="DEG", help="Width of the bins of elevation.")] = 5.0,
    lenient: LenientOption = False,
    overwrite: OverwriteOption = False,
) -> None:
    """Fit the mean C/N0 over elevation of one antenna and receiver.

    Record about a day under open sky with the antenna and the receiver of the train: the curve belongs to the
    two together. It is fitted for each constellation and signal, and the file names its inputs. Positioning then
    rejects signals that are 10 dB-Hz below the mean at their elevation; without a curve only a fixed floor applies.

    Example: `railfix cn0-curve roof.crx.gz --nav roof.rnx.gz --out roof.toml --plot roof.png`

    Exit codes as `railfix --help` says; 5 where the position or the navigation files do not fit the log.
    """
    fit = validated(CurveFit, {"bin_deg": bin_deg}, source="--bin")
    place = None if position is None else place_of(position, "--position")
    outputs = check_outputs((out, "any"), (plot, "png"), overwrite=overwrite, inputs=[*observations, *nav])
    fitted = cn0_curve_from_log(
        observations, nav, position_ecef_m=place, fit=fit, broken_lines="count" if lenient else "stop"
    )
    if plot is not None:
        from railfix.report.plots.screens import draw_cn0_curve

        draw_cn0_curve(plot, fitted.curve, fitted.samples)
    write_cn0_curve(fitted.curve, out)
    _print_curve(fitted.curve, fitted.notes)
    show_files(console_of_tables(), outputs)


def _print_curve(curve: Cn0Curve, notes: tuple[str, ...]) -> None:
    console, source = console_of_tables(), curve.source
    console.print(
        f"antenna {source.antenna or 'not named'}, receiver {source.receiver or 'not named'}; "
        f"{source.epochs:,} epochs from {source.start[:19]} to {source.end[:19]}; mean C/N0 in dB-Hz over elevation",
        markup=False,
    )
    rows = []
    for mean in curve.means:
        half = (mean.elevation_deg[1] - mean.elevation_deg[0]) / 2.0
        values = ["-" if value != value else f"{value:.1f}" for value in mean.at([15.0, 45.0, 75.0]).tolist()]
        span = f"{mean.elevation_deg[0] - half:.0f}-{mean.elevation_deg[-1] + half:.0f}"
        spread = f"{float(mean.spread_db.mean()):.1f}"
        rows.append([KINDS.get(mean.kind, mean.kind), mean.signal, f"{int(mean.count.sum()):,}", span, *values, spread])
    head = ["satellites", "signal", "samples", "elevation", "15 deg", "45 deg", "75 deg", "spread"]
    show_table(console, listed(head, rows, texts=2))
    show_notes(console, notes)
