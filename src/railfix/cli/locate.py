"""Commands on logs without a run: 3-D positions, the track of a train at rest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table

from railfix.cli.console import console_of_tables, show_notes
from railfix.cli.options import OverwriteOption, Without, check_outputs, from_models
from railfix.cli.settings import Choices, settings_of
from railfix.run.locate import LocateInputs, locate_files
from railfix.run.options import LogReading
from railfix.run.which_track import WhichTrackInputs, WhichTrackOptions, which_track_files, write_last_place


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


@from_models
def which_track(
    inputs: WhichTrackInputs,
    options: Annotated[WhichTrackOptions, Without("reference", "height_sigma")],
    choices: Annotated[Choices, Without("screens", "without", "filter", "cn0_curve", "error_model", "sbas")],
    *,
    out: Annotated[
        Path | None, typer.Option(metavar="PICTURE", help="Picture of the probabilities over time (.png or .svg).")
    ] = None,
    save_last: Annotated[
        Path | None,
        typer.Option("--save-last", metavar="FILE.json", help="Probabilities of tracks, for --last at the next start."),
    ] = None,
    overwrite: OverwriteOption = False,
) -> None:
    """Decide on which track a train at rest stands, or report that it is undecided.

    Each track of the map within 60 m is a hypothesis, and so is a track that the map does not have (`none`). The
    codes of each satellite have a constant error at rest, so waiting helps less than independent samples would; with
    a base station carrier phases count, too. The decision is taken when the probability of all other hypotheses
    together is below `--risk`; else all probabilities are printed.

    Example: `railfix which-track --front front.obs --rear rear.obs --spacing 18 --nav brdc.nav --map yard.gpkg`

    Exit codes as `railfix --help` says; 5 where the train moves or no track is near.
    """
    check_outputs((out, "picture"), (save_last, "any"), overwrite=overwrite, inputs=inputs.paths)
    settings, _ = settings_of(choices)
    decision = which_track_files(inputs, options, settings)
    console = console_of_tables()
    last = decision.posteriors[-1]
    decided = "" if np.isnan(decision.decided_s) else f", decided after {decision.decided_s:.0f} s"
    console.print(f"track: {decision.track}{decided} (risk {options.risk:g})", markup=False)
    if not last.fits:
        console.print("the codes do not fit the error model (--code-bias-m, --code-noise-m): no decision is taken")
    table = Table("track", "probability", "facing its direction", show_edge=False)
    facing = np.append(last.with_rising, np.nan)
    for k in np.argsort(-last.probability):
        share = facing[k] / last.probability[k] if last.probability[k] > 0.0 and np.isfinite(facing[k]) else np.nan
        table.add_row(last.names[k], f"{last.probability[k]:.6f}", "" if np.isnan(share) else f"{share:.4f}")
    console.print(table)
    show_notes(console, decision.notes)
    if save_last is not None:
        write_last_place(last, decision.end, save_last)
        console.print(f"last place: {save_last}", markup=False, soft_wrap=True)
    if out is not None:
        from railfix.report.plots.network import plot_track_decision

        plot_track_decision(decision, out, risk=options.risk)
        console.print(f"picture: {out}", markup=False, soft_wrap=True)
