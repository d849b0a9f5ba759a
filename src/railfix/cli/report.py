"""``railfix report``: runs as one page for the browser."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path
from typing import Annotated, Final

import typer

from railfix.cli.options import OverwriteOption, check_outputs, from_models
from railfix.evaluate import EvaluationOptions
from railfix.report import write_report
from railfix.run.folder import reading_table
from railfix.run.options import ColumnNames

#: ``M_MMAP_THRESHOLD`` of ``malloc.h``, and the size from which on an array has pages of its own [bytes].
_THRESHOLD: Final = (-3, 1 << 17)


@from_models
def report(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders that `railfix run` wrote.")],
    *,
    out: Annotated[Path, typer.Option("--out", metavar="HTML", help="HTML file to write.")],
    reference: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="REF",
            help="Reference trajectory: a reference file, a simulator's ground truth, or a log of positions. One for "
            "all runs, or repeated, one for each run in order.",
        ),
    ] = None,
    conventional: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RUN",
            help="Another run on the same log, whose conventional positions are shown: one with `--screens elevation` "
            "gives unscreened ones, as in P1. Repeated, one for each run in order.",
        ),
    ] = None,
    background: Annotated[
        Path | None,
        typer.Option(metavar="GEOJSON", help="Streets, buildings or the like to draw below the plan (WGS 84)."),
    ] = None,
    columns: ColumnNames,
    title: Annotated[str, typer.Option(metavar="TEXT", help="Heading of the page.")] = "",
    overwrite: OverwriteOption = False,
) -> None:
    """Write one HTML page on one or several runs, to open in a browser.

    At the top: one sentence, five key figures, the line in plan coloured by error, and the error over
    chainage beside the conventional one. Below, folded: figures of merit, counts, protection levels,
    settings and inputs, each table with a CSV download. Then the charts of each antenna: errors,
    protection levels, intervals and, with `railfix run --observations`, sky, C/N0 and screens. The page
    names what it leaves out, with the reason. Errors need `--reference`.

    The page contains everything it shows: it opens without a network and can be sent and printed.

    Example:

        railfix report results --reference truth.csv --out report.html

    Exit codes: 0 done; 2 the command line was misused; 3 a RUN or REF is not what it should be;
    4 the number of references fits neither one nor each run; 5 a reference is of another time;
    8 the page cannot be written; 1 a defect of railfix.
    """
    in_runs = [
        path
        for run in [*runs, *(conventional or ())]
        if run.is_dir()
        for path in run.iterdir()
        if path.suffix != ".html"
    ]
    _free_arrays_at_once()
    check_outputs((out, "page"), overwrite=overwrite, inputs=[*(reference or ()), *in_runs, background])
    # the observations are read piece by piece while the page is drawn
    with reading_table(runs[0] / "observations.parquet" if len(runs) == 1 else Path("observations.parquet of a RUN")):
        page = write_report(
            runs,
            out,
            references=tuple(reference or ()),
            conventional=tuple(conventional or ()),
            background=background,
            title=title,
            options=EvaluationOptions(columns=columns),
        )
    typer.echo(f"wrote {page} ({page.stat().st_size / 1e6:.1f} MB)")


def _free_arrays_at_once() -> None:
    """Have the GNU C library return an array's memory as soon as it is freed; other libraries are left as they are.

    By itself it keeps freed arrays of up to 32 MB for later ones, between those in use: of a long run 50 MB.
    """
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "mallopt"):
        library.mallopt(*_THRESHOLD)
