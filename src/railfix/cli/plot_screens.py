"""``railfix plot-screens``: the screens of a run as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def plot_screens(
    run: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `railfix run --observations` wrote.")],
    *,
    out: Annotated[Path, typer.Option("--out", metavar="PICS", help="Folder for the pictures; it is made.")],
) -> None:
    """Draw each screen's metric against its limit, over time and over chainage.

    One PNG a screen and antenna: `front_doppler.png`, `rear_antenna_pair.png`, `front_raim.png`, ...;
    screens that were off or had nothing to judge get none. What was refused is drawn in another
    colour, and its share stands in the title. Pictures of the same names are replaced.

    Example:

        railfix plot-screens results --out results/screens

    Exit codes: 0 done; 2 the command line was misused; 3 DIR is not that of a run with observations;
    8 the pictures cannot be written; 1 a defect of railfix.
    """
    from railfix.report.plots.run_screens import draw_run_screens

    drawn = draw_run_screens(run, out)
    for path in drawn:
        typer.echo(f"wrote {path}")
    if not drawn:
        typer.echo("no screen was on that had anything to judge")
