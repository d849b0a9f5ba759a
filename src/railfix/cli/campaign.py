"""``railfix campaign``: position many logs side by side."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated

import typer

from railfix.cli.console import console_of_tables, prepare_kernels, show_files, show_notes, show_table, show_verdict
from railfix.cli.options import OutOption
from railfix.core.errors import MismatchError, NoPositionError, SettingsError
from railfix.report.campaign import report_campaign, write_campaign_page
from railfix.run.campaign import run_campaign


def campaign(
    path: Annotated[Path, typer.Argument(metavar="CAMPAIGN.toml", help="Patterns of logs and navigation, track.")],
    *,
    out: OutOption,
    workers: Annotated[int, typer.Option("--workers", metavar="N", min=1, help="Processes side by side.")] = 2,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Use the workers of a Dask scheduler, tcp://HOST:PORT, that see the same files (extra `cluster`).",
        ),
    ] = None,
) -> None:
    r"""Position all logs of a campaign, each into its own folder; a killed campaign is continued.

    CAMPAIGN.toml has patterns with fields in braces, relative to the file. Logs with the same fields are one run;
    navigation files are matched by the fields that they share with the logs:

        front = "logs/{train}/{day}/front.obs*"
        rear = "logs/{train}/{day}/rear.obs*"
        nav = "nav/{day}.nav*"
        track = ["line.csv"]
        vehicle = "car.toml"
        config = "settings.toml"
        reference = "logs/{train}/{day}/truth.csv"

    `track`, `vehicle` and the sensors' tables (`tachometer`, `inertial`, `radar`) may have fields too.

    Into DIR come `runs/train=A/day=2024-03-05/` with the files of `railfix run` for each run (together one
    hive-partitioned data set), `campaign.csv` with one row per run, and `campaign.html`, a page on all of them: lines,
    errors (with `reference`) and levels by run, and the worst ten epochs with their explanations. A run that fails is
    a row with its error.
    Runs whose results are there, of the same inputs and settings, are not repeated.

    Example:

        railfix campaign line.toml --out results --workers 8

    Exit codes as `railfix --help` says; 5 where some runs have failed, 7 where every one has.
    """
    with executor_of(workers, scheduler) as (executor, lost):
        prepare_kernels()
        table = run_campaign(path, out=out, executor=executor, progress=show_progress, lost=lost)
    failed = table.filter(status="failed")
    report = report_campaign(table, out)
    page = write_campaign_page(report, out / "campaign.html", title=f"railfix campaign: {path.stem}")
    console = console_of_tables()
    show_verdict(console, [*report.sentences, f"next: open {page}"])
    for found in report.tables:
        show_table(console, found)
    show_notes(console, report.notes)
    show_files(console, [out / "campaign.csv", page])
    if len(failed) == len(table):
        raise NoPositionError(f"every run has failed; the first: {failed['error'][0]}")
    if len(failed):
        raise MismatchError(f"{len(failed)} of {len(table)} runs failed; the first: {failed['error'][0]}")


def show_progress(*, done: int, failed: int, total: int, left_s: float) -> None:
    """Print how many runs are done, and the time left."""
    minutes, seconds = divmod(round(left_s), 60)
    typer.echo(f"{done} of {total} runs, {failed} failed, {minutes} min {seconds:02d} s left", err=True)
    sys.stderr.flush()


@contextmanager
def executor_of(workers: int, scheduler: str | None) -> Iterator[tuple[Executor, tuple[type[Exception], ...]]]:
    """Give the executor, and the errors by which it reports that a worker process is gone.

    SettingsError: there is no such scheduler, or `distributed` is not installed.
    """
    if scheduler is None:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            yield pool, (BrokenExecutor,)
        return
    try:
        from distributed import Client, KilledWorker
    except ModuleNotFoundError:
        raise SettingsError("--scheduler needs distributed; install railfix[cluster]") from None
    try:
        client = Client(scheduler, timeout="10s")  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise SettingsError(f"--scheduler {scheduler}: no scheduler answers there ({error})") from None
    with client:
        executor: Executor = client.get_executor(pure=False)  # type: ignore[no-untyped-call]
        yield executor, (BrokenExecutor, KilledWorker)
