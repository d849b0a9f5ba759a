"""``railfix error-model``: errors of the pseudoranges along a line, from runs with references."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from railfix.cli.cn0_curve import place_of
from railfix.cli.console import console_of_tables
from railfix.cli.options import OverwriteOption, check_outputs
from railfix.core.errors import SettingsError
from railfix.core.settings import validated
from railfix.evaluate.range_errors import ModelInputs, error_model_from_runs
from railfix.ranges.error_model import (
    ErrorBins,
    ErrorModel,
    ErrorModelFit,
    ErrorSamples,
    FaultRate,
    faulty_stretches,
    summary,
    write_error_model,
)
from railfix.run import read_record


def error_model(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders that `railfix run` wrote.")],
    *,
    reference: Annotated[
        list[Path],
        typer.Option("--reference", metavar="FILE", help="Reference positions, one file for each RUN in order."),
    ],
    out: Annotated[Path, typer.Option("--out", metavar="MODEL.toml", help="Error model to write.")],
    base: Annotated[
        list[Path] | None,
        typer.Option(
            "--base",
            metavar="OBS",
            help="RINEX observations of a nearby reference station during all RUNs; repeat it for several files.",
        ),
    ] = None,
    base_position: Annotated[
        str | None,
        typer.Option(metavar="LAT,LON,HEIGHT", help="Position of the station; from its header without it."),
    ] = None,
    elevations: Annotated[
        str, typer.Option(metavar="DEG,...", help="Edges of the bins of elevation.")
    ] = "0,15,30,45,60,90",
    sectors: Annotated[
        int, typer.Option(metavar="N", help="Sectors of azimuth, the first centred ahead of the car.")
    ] = 4,
    cn0: Annotated[
        str, typer.Option("--cn0", metavar="DBHZ,...", help="Edges of the bins of C/N0; 0,60 puts all into one.")
    ] = "0,30,35,40,45,60",
    least_blocks: Annotated[
        int,
        typer.Option(
            metavar="N", help="Passes of a satellite (30 s blocks) below which a bin takes the values of a wider one."
        ),
    ] = 30,
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
    if len(reference) != len(runs):
        raise SettingsError(f"{len(runs)} runs and {len(reference)} references: give --reference once for each run")
    in_runs = [path for run in runs if run.is_dir() for path in run.iterdir()]
    read = [path for run in runs if (run / "run.json").is_file() for path in read_record(run).inputs.paths]
    check_outputs((out, "any"), overwrite=overwrite, inputs=[*reference, *(base or ()), *in_runs, *read])
    if own := [file for file in base or () if file.resolve() in [path.resolve() for path in read]]:
        raise SettingsError(f"--base {own[0]}: is a log of the run itself; give that of a reference station")
    edges = {"elevation_deg": _edges("--elevations", elevations), "cn0_dbhz": _edges("--cn0", cn0)}
    bins = validated(ErrorBins, {**edges, "sectors": sectors}, source="bins of the model")
    fit = validated(ErrorModelFit, {"bins": bins, "least_blocks": least_blocks}, source="--least-blocks")
    place = None if base_position is None else np.asarray(place_of(base_position, "--base-position"))
    inputs = [
        ModelInputs(run=run, reference=file, base=tuple(base or ()), base_position_ecef_m=place)
        for run, file in zip(runs, reference, strict=True)
    ]
    model, samples = error_model_from_runs(inputs, fit=fit)
    write_error_model(model, out)
    _print_model(model, samples)
    typer.echo(f"wrote {out}")


def _edges(option: str, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise SettingsError(f"{option} {text!r}: expected numbers with commas, for example 10,20,40") from None


def priors_text(rate: FaultRate) -> str:
    """Return how to state the measured priors as settings, which are probabilities below 1."""
    local, side = f"{rate.upper:.2g}", f"{rate.side_upper:.2g}"
    if "1" in (local, side):
        return "Too few blocks to bound both priors: the levels of this line stay indicative"
    return (
        f"For levels of this line: --set risk.local_prior={local} --set risk.side_prior={side} "
        "--set risk.priors=measured"
    )


def _print_model(model: ErrorModel, samples: ErrorSamples) -> None:
    console = console_of_tables()
    base = model.source.base or "none: errors of satellites and atmosphere are in the model"
    console.print(
        f"{len(samples.error_m):,} pseudoranges of {model.source.epochs:,} epochs; reference station: {base}; "
        "in metres",
        markup=False,
    )
    table = Table(show_edge=False, pad_edge=False)
    table.add_column("before and\nafter screens", no_wrap=True)
    for when in ("before", "after"):
        for name in ("count", "bias", "sigma", "bound"):
            table.add_column(f"{when}\n{name}" if name == "count" else f"\n{name}", justify="right", no_wrap=True)
    for row in summary(model):
        table.add_row(row.name, *row.cells)
    console.print(table)
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
        if stretches := ", ".join(f"[{start:g}, {end:g}]" for start, end in faulty_stretches(samples)):
            console.print(
                f"local faults are more frequent than on the line at chainages [m] {stretches}; no level there: "
                f"--set 'no_level_m=[{stretches}]'",
                markup=False,
                soft_wrap=True,
            )
