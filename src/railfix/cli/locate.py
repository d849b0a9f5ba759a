"""``railfix locate``: conventional 3-D positions from a log, without a track map."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from railfix.cli.console import console_of_tables, show_notes
from railfix.cli.options import OverwriteOption, Without, check_outputs, from_models
from railfix.cli.settings import Choices, settings_of
from railfix.run.locate import LocateInputs, locate_files
from railfix.run.options import LogReading


@from_models
def locate(
    inputs: LocateInputs,
    choices: Annotated[Choices, Without("screens", "without", "filter", "cn0_curve", "error_model", "sbas")],
    reading: LogReading,
    *,
    out: Annotated[Path, typer.Option(metavar="FILE.pos", help="Positions to write, RTKLIB's solution format.")],
    overwrite: OverwriteOption = False,
) -> None:
    """Compute conventional 3-D positions with standard deviations from a log alone, without a track map.

    Ranges that disagree with the others are left out. The file has quality 5 (single); `railfix map match`
    puts it on the tracks of a network. `railfix map survey` makes a map of logs, better than of such positions.

    Example: `railfix locate --log front.obs --nav brdc.nav --out front.pos`

    Exit codes as `railfix --help` says; 7 where no epoch has a position.
    """
    check_outputs((out, "pos"), overwrite=overwrite, inputs=inputs.paths)
    settings, _ = settings_of(choices)
    summary = locate_files(inputs, settings, out=out, reading=reading)
    console = console_of_tables()
    north, east, up = summary.sigma_m
    console.print(
        f"{summary.epochs} epochs, {summary.positions} positions; median sigma {north:.2f} m north, {east:.2f} m east, "
        f"{up:.2f} m up"
    )
    show_notes(console, summary.notes)
    console.print(f"positions: {out}", markup=False, soft_wrap=True)
