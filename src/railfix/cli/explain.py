"""``railfix explain``: one epoch of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from railfix.cli.console import console_of_tables
from railfix.cli.options import OverwriteOption, check_outputs
from railfix.report.explain import explain_epoch, time_text, write_explanation


def explain(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder that `railfix run --observations` wrote.")],
    *,
    at: Annotated[str, typer.Option(metavar="TIME", help="GPS time: hh:mm:ss, or 'yyyy-mm-dd hh:mm:ss'.")],
    antenna: Annotated[str | None, typer.Option(metavar="NAME", help="The run's first antenna unless given.")] = None,
    html: Annotated[Path | None, typer.Option(metavar="HTML", help="Write a page with the sky as well.")] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Explain one epoch: its place, every satellite and its fate, what set sigma, level and status.

    Of each satellite that was used it says how far the position of the single epoch would move along the line without
    it. The epoch nearest to the time is taken, a minute away at most.

    Example: `railfix explain results --at 06:34:12 --html epoch.html`

    Exit codes: 0 done; 3 RUN is not what it should be; 4 no such time or antenna; 5 no epoch near the time; 8 the page
    cannot be written.
    """
    inputs = sorted(run.iterdir()) if run.is_dir() else []
    check_outputs((html, "page"), overwrite=overwrite, inputs=[path for path in inputs if path.suffix != ".html"])
    found = explain_epoch(run, at, antenna=antenna)
    console = console_of_tables()
    console.print(f"{found.antenna} antenna, {time_text(found.time)} GPS time (asked: {at})", markup=False)
    for sentence in found.sentences:
        console.print(sentence, markup=False, soft_wrap=True)
    table = Table(title="Satellites")
    columns = {
        "satellite": ("satellite", None), "signal": ("signal", None), "elevation_deg": ("elevation", 1),
        "cn0_dbhz": ("C/N0", 1), "sigma_m": ("sigma m", 2), "residual_m": ("residual m", 2),
        "without_shift_m": ("without it m", 2), "without_sigma_m": ("sigma then m", 2), "reason_text": ("fate", None),
    }  # fmt: skip
    for heading, digits in columns.values():
        table.add_column(heading, justify="left" if digits is None else "right")
    for row in found.satellites.iter_rows(named=True):
        values = ((row[name], digits) for name, (_, digits) in columns.items())
        table.add_row(*("" if v is None else str(v) if digits is None else f"{v:.{digits}f}" for v, digits in values))
    console.print(table)
    if html is not None:
        console.print(f"wrote {write_explanation(found, html)}", markup=False, soft_wrap=True)
