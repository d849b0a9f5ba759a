"""``railfix benchmark``: all cases of a folder with one configuration, and other programs beside."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from railfix.cli.campaign import executor_of, show_progress
from railfix.cli.console import console_of_tables, prepare_kernels, show_files, show_notes, show_table
from railfix.cli.options import OutOption, from_models
from railfix.cli.settings import Choices, settings_of
from railfix.core.errors import MismatchError, NoPositionError
from railfix.core.tables import Table
from railfix.evaluate.benchmark.table import heads, run_benchmark, shown_rows


@from_models
def benchmark(
    *,
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of cases, each a folder with `case.toml`.")],
    choices: Choices,
    out: OutOption,
    workers: Annotated[int, typer.Option("--workers", metavar="N", min=1, help="Processes side by side.")] = 2,
) -> None:
    r"""Run the cases of a folder with one configuration, and judge them beside other programs.

    `case.toml` of a case names its files, relative to its folder, each with its SHA-256; a file with another one is
    refused. `files` has the names of the options of `railfix run`, and the ground truth:

        licence = "CC BY 4.0"
        fetch = "https://example.org/town.zip"
        held_out = true

        [files]
        front = ["rover.rnx"]
        nav = ["nav.rnx"]
        track = ["track.csv"]
        truth = "truth.csv"

        [positions."RTKLIB RTK"]
        file = "rtk.pos"

        [sha256]
        "rover.rnx" = "2c26b46b..."

    `positions` are those of other programs (RTKLIB, NMEA, CSV), moved to the nearest point of the line and judged by
    the same code, as RTKLIB's single point is where `rnx2rtkp` is installed. `scenario` describes the recording as
    EN 16803-2 asks of record and replay; `options` and `evaluation` are of `railfix run` and `railfix evaluate`.
    A case with `held_out` is for the benchmark alone: settings made from its files are refused.

    Into DIR come `benchmark.csv`, `benchmark.json` and `benchmark.md`, and the folders of the runs; a run that is
    there, of the same inputs and settings, is not repeated.

    Example:

        railfix benchmark cases --out benchmark

    Exit codes as `railfix --help` says; 5 where some cases have failed, 7 where every one has.
    """
    config, _ = settings_of(choices)
    with executor_of(workers, None) as (executor, lost):
        prepare_kernels()
        table, notes = run_benchmark(folder, config, out=out, executor=executor, progress=show_progress, lost=lost)
    console = console_of_tables()
    head = ["\n".join(pair) for pair in zip(*heads(), strict=True)]
    shown = Table(
        name="benchmark",
        head=head,
        rows=shown_rows(table),
        caption="Errors in metres along the line and straight; second line: performance feature of EN 16803-1",
        numeric=range(2, len(head)),
    )
    show_table(console, shown)
    show_notes(console, notes)
    show_files(console, [out / f"benchmark.{kind}" for kind in ("csv", "json", "md")])
    failed = table["error"].drop_nulls()
    if len(failed) == len(table):
        raise NoPositionError(f"every case has failed; the first: {failed[0]}")
    if len(failed):
        raise MismatchError(f"{len(failed)} cases failed; the first: {failed[0]}")
