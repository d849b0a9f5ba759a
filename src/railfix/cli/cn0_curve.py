"""``railfix cn0-curve``: mean C/N0 over elevation of an antenna and receiver, from a day of open sky."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from railfix.cli.console import console_of_tables, show_files, show_notes
from railfix.cli.options import LenientOption, OverwriteOption, check_outputs
from railfix.core.settings import validated
from railfix.ranges.cn0_curve import KINDS, Cn0Curve, CurveFit, cn0_curve_from_log, write_cn0_curve
from railfix.run.base_station import place_of


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
    table = Table("satellites", "signal", show_edge=False)
    for name in ("samples", "elevation", "15 deg", "45 deg", "75 deg", "spread"):
        table.add_column(name, justify="right")
    for mean in curve.means:
        half = (mean.elevation_deg[1] - mean.elevation_deg[0]) / 2.0
        table.add_row(
            KINDS.get(mean.kind, mean.kind),
            mean.signal,
            f"{int(mean.count.sum()):,}",
            f"{mean.elevation_deg[0] - half:.0f}-{mean.elevation_deg[-1] + half:.0f}",
            *(_number(float(value)) for value in mean.at([15.0, 45.0, 75.0])),
            f"{float(mean.spread_db.mean()):.1f}",
        )
    console.print(table)
    show_notes(console, notes)


def _number(value: float) -> str:
    return "-" if value != value else f"{value:.1f}"
