"""``railfix report``: runs as one page for the browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from railfix.cli.options import OverwriteOption
from railfix.report import write_report
from railfix.run.output import check_output_file


def report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders that `railfix run` wrote.")],
    *,
    out: Annotated[Path, typer.Option("--out", metavar="HTML", help="HTML file to write.")],
    reference: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="REF",
            help="Reference positions: of railfix reference, ground truth of a simulation, a log of good positions. "
            "One for all runs, or repeated, one for each run in order.",
        ),
    ] = None,
    title: Annotated[str, typer.Option(metavar="TEXT", help="Heading of the page.")] = "",
    overwrite: OverwriteOption = False,
) -> None:
    """Make one page of one or several runs, to open in a browser.

    The page shows what was run and with which settings, what became of every epoch and pseudorange,
    the line in plan, the positioning interval, the processing time; with `--reference` the errors
    along the line on the map and conventional, figures of merit and Stanford diagrams; with
    observations (`railfix run --observations`) the sky at an epoch that is clicked on, C/N0 over
    elevation, and each screen's metric against its limit. It says what it leaves out, and why.

    The page holds all that it shows: it opens without a network and can be sent and printed.

    Example:

        railfix report results --reference truth.csv --out report.html

    Exit codes: 0 done; 2 the command line was misused; 3 a RUN or REF is not what it should be;
    4 the number of references fits neither one nor each run; 5 a reference is of another time;
    8 the page cannot be written; 1 a defect of railfix.
    """
    in_runs = [path for run in runs if run.is_dir() for path in run.iterdir() if path.suffix != ".html"]
    check_output_file(out, overwrite="replace" if overwrite else "refuse", inputs=[*(reference or ()), *in_runs])
    page = write_report(runs, out, references=tuple(reference or ()), title=title)
    typer.echo(f"wrote {page} ({page.stat().st_size / 1e6:.1f} MB)")
