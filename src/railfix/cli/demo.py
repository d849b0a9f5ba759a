"""``railfix demo``: compute the positions of the demonstration run and compare them with the ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from railfix.cli.console import (
    TableConsole,
    describe_errors,
    prepare_kernels,
    progress_bar,
    show_budget,
    show_notes,
    show_table,
)
from railfix.cli.options import OverwriteOption, VerboseOption, overwriting
from railfix.core.notebook import plural
from railfix.evaluate.tables import error_tables, level_tables
from railfix.pipeline.config import Config
from railfix.report import read_runs, write_page
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_inputs, demo_truth


def demo(
    *,
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the results; it is created if it does not exist.")
    ] = Path("railfix-demo"),
    real: Annotated[
        bool,
        typer.Option(
            "--real", help="Use a recorded drive instead of the simulated run; it is downloaded once (53 MB)."
        ),
    ] = False,
    overwrite: OverwriteOption = False,
    verbose: VerboseOption = False,
) -> None:
    """Compute positions from the log that comes with railfix, and compare them with the ground truth.

    The log is a simulated run of a train with two antennas on a line with curves and cant; the README in the folder of
    the log describes the run. The log is processed as `railfix run` does. A page, as `railfix report` writes, compares
    the positions computed with the map, and the conventional positions (3-D single points from unscreened ranges, moved
    to the nearest point of the line), with the ground truth.

    The run's `positions.csv`, `positions.parquet`, `train.csv`, `train.parquet`, `observations.parquet` and `run.json`
    are written into DIR. Further outputs are the folder `unscreened`, which has the conventional positions, and the
    page `report.html`, to open in a browser.

    With `--real`, the log is a 20-minute drive of a car through a town, from the Python package `gnss-benchmark` (MIT
    licence), which pip downloads and the user's cache keeps. The map is made from the ground truth: a trajectory
    computed with RTKLIB if it is installed, otherwise the publisher's trajectory. As with `railfix benchmark`, the
    positions of railfix and RTKLIB are evaluated; the case is written into `DIR/drive`, and the results into
    `DIR/benchmark`.

    Example: `railfix demo --out first-look`

    Exit codes are listed in `railfix --help`; with `--real` the code is also 3 if the recording cannot be downloaded.
    """
    if real:
        from railfix.cli.campaign import show_benchmark
        from railfix.evaluate.public_data import fetch_public_data, write_drive

        quality = write_drive(fetch_public_data(), out / "drive")
        show_benchmark(out / "drive", Config(), out=out / "benchmark", workers=1)
        typer.echo(f"ground truth: {quality}")
        return
    inputs = demo_inputs()
    prepare_kernels()
    with progress_bar() as progress:
        options = RunOptions(observations="write", overwrite=overwriting(overwrite), chunk_epochs=200)
        summary = run_files(inputs, Config(), out=out, options=options, progress=progress)
    # as in paper P1, conventional positions are computed from ranges that are not screened
    unscreened = Config(filter="off", screens=("elevation",), protection="off")
    run_files(inputs, unscreened, out=out / "unscreened", options=options.replaced(observations="skip"))
    runs, evaluation = read_runs([out], [demo_truth()], conventional=[out / "unscreened"])
    page = write_page(runs, evaluation, out / "report.html", title="railfix demonstration: a simulated run")
    console = TableConsole()
    for line in summary.verdict.lines():
        console.print(line)
    if evaluation is not None:
        console.print(describe_errors(evaluation))
    console.print(
        f"{plural(summary.notes, 'note')} on the limitations of this run: {out / 'run.json'}; --verbose shows all"
    )
    console.print(f"the log, its track map, vehicle and ground truth: {inputs.front[0].parent}")
    console.print(f"the report, to open in a browser: {page}")
    if verbose:
        console.print()
        show_notes(console, summary.notes)
        show_budget(console, summary)
        if evaluation is not None:
            for table in (*error_tables(evaluation), *level_tables(evaluation, worst=5)):
                show_table(console, table)
