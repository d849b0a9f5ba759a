"""``railfix plot-screens``: the screens of a run as pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from railfix.cli.options import OverwriteOption, overwriting
from railfix.report.plots.run_screens import draw_run_screens
from railfix.run.folder import reading_table
from railfix.run.output import OutputFolder


def plot_screens(
    run: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `railfix run --observations` wrote.")],
    *,
    out: Annotated[Path, typer.Option("--out", metavar="PICS", help="Folder for the pictures; made where absent.")],
    overwrite: OverwriteOption = False,
) -> None:
    """Plot each screen's metric against its limit, over time and over chainage.

    One PNG per screen and antenna: `front_doppler.png`, `rear_antenna_pair.png`, `front_raim.png`, ...;
    none for screens that were off or inactive. Rejected observations have another colour, and their share is
    in the title.

    Example:

        railfix plot-screens results --out results/screens

    Exit codes: 0 done; 2 the command line was misused; 3 DIR is not the folder of a run with observations;
    8 the pictures cannot be written; 1 a defect of railfix.
    """
    with OutputFolder(out, overwrite=overwriting(overwrite)) as folder:
        with reading_table(run / "observations.parquet"):
            pictures = draw_run_screens(run, folder.staging)
        for picture in pictures:
            folder.staged(picture.name)
        drawn = folder.commit()
    for path in drawn.values():
        typer.echo(f"wrote {path}")
    if not drawn:
        typer.echo("no screen of this run was active")
