"""``railfix ablate``: compare choices of screens, and of the filter's sources, on one log."""

from __future__ import annotations

from typing import Annotated

from rich.console import Console

from railfix.cli.console import console_of_tables, progress_bar, show_files, show_notes, show_table
from railfix.cli.options import OutOption, Without, from_models
from railfix.cli.settings import Choices, settings_of
from railfix.core.tables import Table, number, percent
from railfix.evaluate import Score
from railfix.evaluate.ablation import Ablation, Effect, ablate_files
from railfix.run import RunInputs, RunOptions
from railfix.run.options import ColumnNames


@from_models
def ablate(
    inputs: RunInputs,
    choices: Choices,
    options: Annotated[RunOptions, Without("observations", "chunk_epochs", "reference")],
    columns: ColumnNames,
    *,
    out: OutOption,
) -> None:
    r"""Compare choices of screens on a log: all screens, none, each alone, all but each.

    The logs are read once. Screens that are off in the settings stay off, and inactive ones
    (no second antenna, no C/N0 curve) are left out and named. Validity and health of the satellites are
    checked in every case; `none` is these checks alone, without an elevation mask.

    With `--filter track` the filter along the track has rows too: with every source that is there
    (codes, phases, Dopplers, and the sensors given) and without each but codes, all screens on.

    For each choice: the rate of epochs with coordinates and of status ok, satellites used, the median
    standard deviation along the line; with `--truth` also the errors along the line (over 50 m counts as
    a wrong position), of all epochs with coordinates and of those that are ok, of epochs without satellites, and the
    95th percentile of the error over its stated sigma. Into DIR come
    `ablation.csv` with all figures, those of the conventional position included, and `ablation.json`.

    Example:

        railfix ablate --front front.obs --nav brdc.nav --track line.csv --truth rtk.pos --out screens

        railfix ablate ... --tachometer pulses.csv --inertial imu.csv --filter track --out sources

    Exit codes: 0 done; 2 the command line was misused; 3 an input file is not what it should be;
    4 a setting is wrong; 5 the inputs do not match each other; 7 not one position; 8 DIR cannot be
    written; 1 a defect of railfix.
    """
    settings, asked = settings_of(choices)
    inputs = inputs.replaced(config=choices.config)
    with progress_bar() as progress:
        ablation = ablate_files(
            inputs, settings, out=out, options=options, asked=asked, names=columns.names, progress=progress
        )
    show_ablation(ablation)


def show_ablation(ablation: Ablation) -> None:
    """One table an antenna, the notes, and where the results are."""
    console = console_of_tables()
    for antenna in dict.fromkeys(effect.antenna for effect in ablation.effects):
        _show(console, [effect for effect in ablation.effects if effect.antenna == antenna])
    show_notes(console, ablation.notes)
    show_files(console, ablation.files.values())


def _show(console: Console, effects: list[Effect]) -> None:
    head, scored = ["screens", "rate\n%", "ok\n%", "sats\nused", "sigma\np50 m"], effects[0].coordinates is not None
    if scored:
        head += [f"{name}\n{of}" for of in ("all", "ok") for name in ("p50", "p95", "max", "wrong")]
    filtered = scored and any(effect.sources for effect in effects)
    if filtered:
        head += [f"{name}\nno sats" for name in ("p50", "p95", "max")] + ["p95\n/sigma"]
    rows = []
    for effect in effects:
        cells = [percent(effect.rate), percent(effect.ok_rate), number(effect.n_used), number(effect.sigma_p50_m)]
        for figures in (effect.coordinates, effect.ok):
            cells += _errors(figures) if figures is not None else []
        if filtered:
            cells += (_errors(effect.outage) if effect.outage is not None else ["-"] * 4)[:3]
            cells.append(number(effect.normalised_p95))
        rows.append([effect.choice, *cells])
    caption = f"{effects[0].antenna}: {effects[0].epochs:,} epochs"
    if scored:
        caption += "; errors along the line in metres, wrong positions in per cent; all: every epoch with coordinates"
    show_table(console, Table(name="ablation", head=head, rows=rows, caption=caption, numeric=range(1, len(head))))


def _errors(figures: Score) -> list[str]:
    if not figures.positions:
        return ["-"] * 4
    return [number(figures.p50_m), number(figures.p95_m), number(figures.max_m, 1), percent(figures.wrong_place)]
