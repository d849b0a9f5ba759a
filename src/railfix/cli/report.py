"""Commands ``railfix report``, ``explain`` and ``plot-screens`` on finished runs."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer

from railfix.cli.console import TableConsole, show_table
from railfix.cli.options import OverwriteOption, check_outputs, from_models, overwriting
from railfix.core.tables import Column, digits, listing, reading_table
from railfix.evaluate import EvaluationOptions
from railfix.report import write_report
from railfix.report.explain import explain_epoch, time_text, write_explanation
from railfix.report.plots.screens import draw_run_screens
from railfix.run.inputs import ColumnNames
from railfix.run.output import OutputFolder

#: Columns of the table of satellites in the explanation of an epoch.
_SATELLITES: Final[Sequence[Column]] = (
    ("satellite", "satellite", str), ("signal", "signal", str), ("elevation", "elevation_deg", partial(digits, 1)),
    ("C/N0", "cn0_dbhz", partial(digits, 1)), ("sigma m", "sigma_m", partial(digits, 2)),
    ("residual m", "residual_m", partial(digits, 2)), ("without it m", "without_shift_m", partial(digits, 2)),
    ("sigma then m", "without_sigma_m", partial(digits, 2)), ("outcome", "reason_text", str),
)  # fmt: skip
#: Number of ``M_MMAP_THRESHOLD`` in ``malloc.h``, and its value: arrays of more bytes are mapped separately.
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
            help="Reference trajectory: a reference file, a simulator's ground truth, or a log of positions. Give "
            "one for all runs, or repeat the option with one for each run in order.",
        ),
    ] = None,
    conventional: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RUN",
            help="Another run on the same log; its conventional positions are shown. A run with `--screens elevation` "
            "has unscreened positions, as in paper P1. Repeat the option for each run in order.",
        ),
    ] = None,
    background: Annotated[
        Path | None,
        typer.Option(metavar="GEOJSON", help="Background of the plan, such as streets and buildings (WGS 84)."),
    ] = None,
    columns: ColumnNames,
    title: Annotated[str, typer.Option(metavar="TEXT", help="Heading of the page.")] = "",
    overwrite: OverwriteOption = False,
) -> None:
    """Write one HTML page on one or several runs, to open in a browser.

    The page begins with one sentence, five key figures, the plan of the line coloured by error, and the error over
    chainage compared with the error of conventional positions. Folded sections follow, with figures of merit, counts,
    protection levels, settings and inputs; each table can be downloaded as CSV. The charts of each antenna show errors,
    protection levels, intervals and, with `railfix run --observations`, sky, C/N0 and screens. Omitted parts are listed
    with the reasons. Errors are shown only with `--reference`.

    The page needs no other files and no network, and can be sent and printed.

    Example: `railfix report results --reference truth.csv --out report.html`

    Exit codes are listed in `railfix --help`; the code is 4 if the number of references does not match the runs, 5 if a
    reference does not cover the time of its run.
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
    # the observations are read in pieces while the page is written, so that read errors are raised in this block
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
    """Make the GNU C library, where it is used, return the memory of freed arrays to the system at once.

    By default malloc keeps freed arrays of up to 32 MB for reuse, which costs 50 MB of memory in a long run.
    """
    if sys.platform == "linux" and hasattr(library := ctypes.CDLL(None), "mallopt"):
        library.mallopt(*_THRESHOLD)


def explain(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `railfix run --observations` wrote.")],
    *,
    at: Annotated[str, typer.Option(metavar="TIME", help="GPS time: hh:mm:ss, or 'yyyy-mm-dd hh:mm:ss'.")],
    antenna: Annotated[
        str | None, typer.Option(metavar="NAME", help="Antenna, front or rear; by default the run's first antenna.")
    ] = None,
    html: Annotated[Path | None, typer.Option(metavar="HTML", help="Page to write, which also has a sky plot.")] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Explain an epoch: position, use of every satellite, terms of sigma and protection level, reason for the status.

    For each used satellite, the table has the distance by which the single-epoch position would move along the line if
    this satellite were omitted. The epoch nearest to TIME is explained; it may be at most one minute away.

    Example: `railfix explain results --at 06:34:12 --html epoch.html`

    Exit codes are listed in `railfix --help`; the code is 4 if the time or the antenna does not exist, 5 if no
    epoch is near the time.
    """
    inputs = sorted(run.iterdir()) if run.is_dir() else []
    check_outputs((html, "page"), overwrite=overwrite, inputs=[path for path in inputs if path.suffix != ".html"])
    found = explain_epoch(run, at, antenna=antenna)
    console = TableConsole()
    console.print(f"{found.antenna} antenna, {time_text(found.time)} GPS time (requested: {at})")
    for sentence in found.sentences:
        console.print(sentence)
    show_table(console, replace(listing("satellites", found.satellites, _SATELLITES, "Satellites"), boxed=True))
    if html is not None:
        console.print(f"wrote {write_explanation(found, html)}")


def plot_screens(
    run: Annotated[Path, typer.Argument(metavar="DIR", help="Folder that `railfix run --observations` wrote.")],
    *,
    out: Annotated[
        Path, typer.Option("--out", metavar="PICS", help="Folder for the plots; it is created if it does not exist.")
    ],
    overwrite: OverwriteOption = False,
) -> None:
    """Plot each screen's metric against its limit, over time and over chainage.

    One PNG file is written per screen and antenna, such as `front_doppler.png`, `rear_antenna_pair.png` and
    `front_raim.png`. Screens that were off or inactive have no file. Rejected observations have a different colour; the
    title states the fraction of rejected observations.

    Example: `railfix plot-screens results --out results/screens`

    Exit codes are listed in `railfix --help`.
    """
    with OutputFolder(out, overwrite=overwriting(overwrite)) as folder:
        with reading_table(run / "observations.parquet"):
            pictures = draw_run_screens(run, folder.staging)
        for picture in pictures:
            folder.stage(picture.name)
        drawn = folder.commit()
    for path in drawn.values():
        typer.echo(f"wrote {path}")
    if not drawn:
        typer.echo("no screen of this run was active")
