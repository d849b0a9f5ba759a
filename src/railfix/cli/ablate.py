"""``railfix ablate``: what each screen buys and costs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from railfix.cli.options import (
    INPUTS,
    CrsOption,
    DatumOption,
    EndOption,
    FrontOption,
    GeoidOption,
    LenientOption,
    NavOption,
    OutOption,
    OverwriteOption,
    RearOption,
    Sp3Option,
    StartOption,
    TrackOption,
    VehicleOption,
)
from railfix.cli.settings import (
    Choices,
    ConfigOption,
    CurveOption,
    PresetOption,
    ScreensOption,
    SettingOption,
    WithoutOption,
    settings_of,
)

if TYPE_CHECKING:
    from rich.console import Console

    from railfix.evaluate import Score
    from railfix.evaluate.ablation import Ablation, Effect

#: Columns of text that the table needs.
_WIDTH = 110


def ablate(
    *,
    front: FrontOption,
    nav: NavOption,
    track: TrackOption,
    out: OutOption,
    rear: RearOption = None,
    sp3: Sp3Option = None,
    vehicle: VehicleOption = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            "--truth",
            metavar="POSITIONS",
            rich_help_panel=INPUTS,
            help="Where the antenna really was: CSV with named columns (antenna says whose, where there are two) or "
            "RTKLIB .pos; of quality 1 where it tells one.",
        ),
    ] = None,
    config: ConfigOption = None,
    preset: PresetOption = None,
    setting: SettingOption = None,
    screens: ScreensOption = None,
    without: WithoutOption = None,
    cn0_curve: CurveOption = None,
    crs: CrsOption = None,
    height_datum: DatumOption = None,
    geoid: GeoidOption = None,
    start: StartOption = None,
    end: EndOption = None,
    lenient: LenientOption = False,
    overwrite: OverwriteOption = False,
) -> None:
    r"""What each screen buys and costs on a log: all screens, none, each alone, all but each.

    The logs are read once. Screens that are off in the settings stay off, and those that cannot judge
    (no second antenna, no C/N0 curve) are left out and named. Validity and health of the satellites are
    asked in every case; `none` is these alone, without an elevation mask.

    For each choice: the rate of epochs with coordinates and of status ok, satellites used, the median
    standard deviation along the line; with `--truth` the errors along the line too (over 50 m counts as
    a wrong place), of all epochs with coordinates and of those that are ok. Into DIR come
    `ablation.csv` with all figures, those of the conventional position included, and `ablation.json`.

    Example:

        railfix ablate --front front.obs --nav brdc.nav --track line.csv --truth rtk.pos --out screens

    Exit codes: 0 done; 2 the command line was misused; 3 an input file is not what it should be;
    4 a setting is wrong; 5 the inputs do not belong together; 7 not one position; 8 DIR cannot be
    written; 1 a defect of railfix.
    """
    from railfix.cli.console import progress_bar
    from railfix.evaluate.ablation import ablate_files
    from railfix.run import RunInputs, RunOptions, TrackReading

    chosen = Choices(
        config=config,
        preset=preset,
        setting=tuple(setting or ()),
        screens=screens,
        without=tuple(without or ()),
        cn0_curve=cn0_curve,
    )
    settings, asked = settings_of(chosen)
    inputs = RunInputs(
        front=tuple(front),
        rear=tuple(rear or ()),
        nav=tuple(nav),
        sp3=tuple(sp3 or ()),
        track=tuple(track),
        vehicle=vehicle,
        config=config,
        truth=truth,
    )
    options = RunOptions(
        broken_lines="count" if lenient else "stop",
        overwrite="replace" if overwrite else "refuse",
        start=start,
        end=end,
        track=TrackReading(crs=crs, height_datum=height_datum, geoid=geoid),
    )
    with progress_bar() as progress:
        ablation = ablate_files(inputs, settings, out=out, options=options, asked=asked, progress=progress)
    show_ablation(ablation)


def show_ablation(ablation: Ablation) -> None:
    """One table an antenna, the notes, and where the results are."""
    from rich.console import Console

    console = Console(highlight=False)
    console.width = max(console.width, _WIDTH)
    for antenna in dict.fromkeys(effect.antenna for effect in ablation.effects):
        effects = [effect for effect in ablation.effects if effect.antenna == antenna]
        console.print(f"{antenna}: {effects[0].epochs:,} epochs", markup=False)
        _show(console, effects)
    for note in ablation.notes:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    for path in ablation.files.values():
        console.print(f"wrote {path}", markup=False, soft_wrap=True)


def _show(console: Console, effects: list[Effect]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    scored = effects[0].coordinates is not None
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    table.add_column("screens", no_wrap=True)
    heads = ["rate\n%", "ok\n%", "sats\nused", "sigma\np50 m"]
    if scored:
        heads += [f"{head}\n{of}" for of in ("all", "ok") for head in ("p50", "p95", "max", "wrong")]
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    for effect in effects:
        cells = [f"{100 * effect.rate:.2f}", f"{100 * effect.ok_rate:.2f}", f"{effect.n_used:.2f}"]
        cells.append(f"{effect.sigma_p50_m:.2f}")
        for figures in (effect.coordinates, effect.ok):
            cells += _errors(figures) if figures is not None else []
        table.add_row(effect.choice, *cells)
    if scored:
        console.print("errors along the line in metres, wrong places in per cent; all: every epoch with coordinates")
    console.print(table)


def _errors(figures: Score) -> list[str]:
    if not figures.positions:
        return ["-"] * 4
    lengths = [f"{value:.2f}" for value in (figures.p50_m, figures.p95_m)]
    return [*lengths, f"{figures.max_m:.1f}", f"{100 * figures.wrong_place:.2f}"]
