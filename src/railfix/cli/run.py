"""``railfix run``: logs, navigation and a track map in, a folder of positions out."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

from railfix.cli.options import (
    CHOICES,
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
    ErrorModelOption,
    PresetOption,
    SbasOption,
    ScreensOption,
    SettingOption,
    WithoutOption,
    settings_of,
)


def run(
    *,
    front: FrontOption,
    nav: NavOption,
    track: TrackOption,
    out: OutOption,
    rear: RearOption = None,
    sp3: Sp3Option = None,
    sbas: SbasOption = None,
    vehicle: VehicleOption = None,
    config: ConfigOption = None,
    preset: PresetOption = None,
    setting: SettingOption = None,
    screens: ScreensOption = None,
    without: WithoutOption = None,
    cn0_curve: CurveOption = None,
    error_model: ErrorModelOption = None,
    crs: CrsOption = None,
    height_datum: DatumOption = None,
    geoid: GeoidOption = None,
    reference: Annotated[
        Literal["antenna", "centre", "front_bogie", "rear_bogie"],
        typer.Option(
            rich_help_panel=CHOICES,
            help="The point of the vehicle whose chainage is given; for each antenna its own place by default.",
        ),
    ] = "antenna",
    start: StartOption = None,
    end: EndOption = None,
    observations: Annotated[
        bool,
        typer.Option(
            "--observations",
            rich_help_panel=CHOICES,
            help="Also write observations.parquet: one row an epoch, satellite and signal, with its reason.",
        ),
    ] = False,
    lenient: LenientOption = False,
    overwrite: OverwriteOption = False,
    chunk: Annotated[
        int,
        typer.Option(
            metavar="EPOCHS",
            min=1,
            rich_help_panel=CHOICES,
            help="Epochs in memory at a time; the results do not depend on it.",
        ),
    ] = 3000,
) -> None:
    r"""Positions along the line from receiver logs, navigation files and a track map.

    Reads RINEX 2, 3 and 4 (plain, .gz, .Z, Hatanaka), reads the log in pieces, and writes into DIR:

    - `positions.csv` and `positions.parquet`: one row an epoch and antenna, also where there is no
      position; place along the line, its standard deviation, coordinates, the conventional
      position for comparison
    - `observations.parquet` (with `--observations`): one row an epoch, satellite and signal
    - `run.json`: versions, hashes of the inputs, settings asked for and used, counts by status and
      reason, positioning rate

    Times are GPS time, as the receiver tagged them. The results appear in DIR when all is done; an
    error leaves nothing there.

    Example:

        railfix run --front front.obs --rear rear.obs --nav brdc.nav \
            --track line.csv --vehicle car.toml --out results

    Exit codes: 0 done; 2 the command line was misused; 3 an input file is not what it should be;
    4 a setting is wrong; 5 the inputs do not belong together; 7 not one position; 8 DIR cannot be
    written; 1 a defect of railfix.
    """
    from railfix.cli.console import progress_bar, show_summary
    from railfix.run import RunInputs, RunOptions, TrackReading, run_files

    settings, asked = settings_of(
        Choices(
            config=config,
            preset=preset,
            setting=tuple(setting or ()),
            screens=screens,
            without=tuple(without or ()),
            cn0_curve=cn0_curve,
            error_model=error_model,
            sbas=tuple(sbas or ()),
        )
    )
    inputs = RunInputs(
        front=tuple(front),
        rear=tuple(rear or ()),
        nav=tuple(nav),
        sp3=tuple(sp3 or ()),
        track=tuple(track),
        vehicle=vehicle,
        config=config,
    )
    options = RunOptions(
        observations="write" if observations else "skip",
        broken_lines="count" if lenient else "stop",
        overwrite="replace" if overwrite else "refuse",
        chunk_epochs=chunk,
        start=start,
        end=end,
        track=TrackReading(crs=crs, height_datum=height_datum, geoid=geoid, reference=reference),
    )
    with progress_bar() as progress:
        summary = run_files(inputs, settings, out=out, options=options, asked=asked, progress=progress)
    show_summary(summary)
