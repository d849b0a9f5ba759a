"""Commands that process many runs: ``railfix campaign``, ``benchmark`` and ``ablate``."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

from railfix.cli.command import SIGNALLED
from railfix.cli.console import (
    TableConsole,
    prepare_kernels,
    print_json,
    progress_bar,
    show_files,
    show_notes,
    show_table,
    show_verdict,
)
from railfix.cli.options import Choices, JsonOption, OutOption, Without, from_models, resolve_settings
from railfix.core.errors import MismatchError, NoPositionError, SettingsError
from railfix.core.extras import needs_extra
from railfix.core.tables import number, percent, plain_table
from railfix.evaluate import Score
from railfix.evaluate.ablation import Ablation, Effect, ablate_files
from railfix.evaluate.benchmark import heads, run_benchmark, shown_rows
from railfix.pipeline.config import Config
from railfix.report.campaign import report_campaign, write_campaign_page
from railfix.run import RunInputs, RunOptions
from railfix.run.campaign import run_campaign
from railfix.run.inputs import ColumnNames, LogReading


@from_models
def campaign(
    path: Annotated[
        Path, typer.Argument(metavar="CAMPAIGN.toml", help="File with the patterns of the input files (see above).")
    ],
    reading: LogReading,
    *,
    out: OutOption,
    workers: Annotated[int, typer.Option("--workers", metavar="N", min=1, help="Number of parallel processes.")] = 2,
    scheduler: Annotated[
        str | None,
        typer.Option(
            "--scheduler",
            metavar="ADDRESS",
            help="Dask scheduler, tcp://HOST:PORT (extra `cluster`); its workers need access to the same files.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    r"""Compute positions from all logs of a campaign, with one folder per run; an interrupted campaign is continued.

    CAMPAIGN.toml has patterns of paths with fields in braces; paths are relative to the folder of this file. Logs with
    the same values of all fields form one run. A navigation file is used for all runs whose fields have the values in
    its path:

        front = "logs/{train}/{day}/front.obs*"
        rear = "logs/{train}/{day}/rear.obs*"
        nav = "nav/{day}.nav*"
        track = ["line.csv"]
        vehicle = "car.toml"
        config = "settings.toml"
        reference = "logs/{train}/{day}/truth.csv"

    `track`, `vehicle` and the sensors' tables (`tachometer`, `inertial`, `radar`) may have fields too. Options of
    `railfix run` are written in TOML tables. An example for a KML map and logs with damaged text lines:

        [options.track]
        height_datum = "orthometric"
        geoid = "egm96"
        [options.logs]
        broken_lines = "count"

    Each run has a folder with the files that `railfix run` writes, such as `DIR/runs/train=A/day=2024-03-05/`;
    together, these folders are one hive-partitioned data set. `campaign.csv` has one row per run, with the error
    message of a run that fails. The page `campaign.html` shows the lines, the protection levels and (with `reference`)
    the errors of each run, and explains the ten worst epochs. A run is not repeated if results for the same inputs,
    settings and options exist.

    Example: `railfix campaign line.toml --out results --workers 8`

    Exit codes are listed in `railfix --help`; the code is 5 if some runs have failed, 7 if all have failed.
    """
    with open_executor(workers, scheduler) as (executor, lost):
        prepare_kernels()
        table = run_campaign(path, out=out, executor=executor, reading=reading, progress=show_progress, lost=lost)
    failed = table.filter(status="failed")
    report = report_campaign(table, out)
    page = write_campaign_page(report, out / "campaign.html", title=f"railfix campaign: {path.stem}")
    files = [out / "campaign.csv", page]
    if as_json:
        print_json({"runs": table.to_dicts(), "sentences": report.sentences, "notes": report.notes, "files": files})
    else:
        console = TableConsole()
        show_verdict(console, [*report.sentences, f"next: open {page}"])
        for found in report.tables:
            show_table(console, found)
        show_notes(console, report.notes)
        show_files(console, files)
    if len(failed) == len(table):
        raise NoPositionError(f"every run has failed; the first error: {failed['error'][0]}")
    if len(failed):
        raise MismatchError(f"{len(failed)} of {len(table)} runs failed; the first error: {failed['error'][0]}")


def show_progress(*, done: int, kept: int, failed: int, total: int, left_s: float) -> None:
    """Print the number of finished runs and the remaining time on standard error; `kept` is the number of runs that an
    earlier command finished.
    """
    minutes, seconds = divmod(round(left_s), 60)
    before = f" ({kept} of earlier calls)" if kept else ""
    typer.echo(f"{done} of {total} runs{before}, {failed} failed, {minutes} min {seconds:02d} s left", err=True)
    sys.stderr.flush()


#: Signals that end a worker process: SIGINT (Ctrl-C), and SIGTERM, which the pool sends if another worker ends
#: unexpectedly.
_ENDING: Final = (signal.SIGINT, signal.SIGTERM)


def _prepare_worker() -> None:
    """Install the signal handlers of a worker process, then unblock its signals.

    A signal that is already pending ends the process at once. The handlers are required because polars, when it is
    imported, replaces the default handlers, so that Ctrl-C would be ignored.
    """
    for each in _ENDING:
        signal.signal(each, _end)
    if signal.sigpending() & {*_ENDING}:
        signal.raise_signal(signal.SIGKILL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)


def _end(number_of_signal: int, _frame: object) -> None:
    """Ignore further signals, which would interrupt the clean-up of the process, and raise SystemExit."""
    for each in _ENDING:
        signal.signal(each, signal.SIG_IGN)
    raise SystemExit(SIGNALLED + number_of_signal)


@contextmanager
def open_executor(workers: int, scheduler: str | None) -> Iterator[tuple[Executor, tuple[type[Exception], ...]]]:
    """Yield an executor, and the types of the exceptions that the executor raises when it has lost a worker process.

    Raise SettingsError if no scheduler answers at the given address, or if `distributed` is not installed.
    """
    if scheduler is None:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_prepare_worker) as pool:
            try:
                signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)  # workers then start with these signals blocked
                for _ in range(workers):
                    pool.submit(int)
                signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)
                yield pool, (BrokenExecutor,)
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return
    with needs_extra("--scheduler"):
        from distributed import Client, KilledWorker
    try:
        client = Client(scheduler, timeout="10s")  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise SettingsError(f"--scheduler {scheduler}: no scheduler answers at this address ({error})") from None
    with client:
        executor: Executor = client.get_executor(pure=False)  # type: ignore[no-untyped-call]
        yield executor, (BrokenExecutor, KilledWorker)


@from_models
def benchmark(
    *,
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder with one subfolder per case, each with a `case.toml`.")
    ],
    choices: Choices,
    out: OutOption,
    workers: Annotated[int, typer.Option("--workers", metavar="N", min=1, help="Number of parallel processes.")] = 2,
) -> None:
    r"""Run the cases of a folder with one configuration, and compare them with other programs.

    `case.toml` lists the files of a case and their SHA-256; paths are relative to the folder of the case. A file with a
    different SHA-256 is rejected. The keys of `files` are names of options of `railfix run`, or `truth` for the ground
    truth:

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

    `positions` lists files with positions computed by other programs (RTKLIB, NMEA, CSV). These positions are moved to
    the nearest point of the line and evaluated in the same way as the positions of railfix. If `rnx2rtkp` is installed,
    single-point positions are also computed with RTKLIB and evaluated. `scenario` describes the recording as EN 16803-2
    requires for record and replay. `options` sets options of `railfix run`, and `evaluation` sets options of `railfix
    evaluate`. A case with `held_out` is reserved for the benchmark: settings derived from its files are rejected.

    `benchmark.csv`, `benchmark.json`, `benchmark.md` and the folders of the runs are written into DIR. A run is not
    repeated if results for the same inputs, settings and options exist.

    Example: `railfix benchmark cases --out benchmark`

    Exit codes are listed in `railfix --help`; the code is 5 if some cases have failed, 7 if all have failed.
    """
    config, _ = resolve_settings(choices)
    show_benchmark(folder, config, out=out, workers=workers)


def show_benchmark(folder: Path, config: Config, *, out: Path, workers: int) -> None:
    """Run the cases of a folder, and print the table, the notes and the names of the written files.

    Raise NoPositionError if every case has failed, and MismatchError if some cases have failed.
    """
    with open_executor(workers, None) as (executor, lost):
        prepare_kernels()
        table, notes = run_benchmark(folder, config, out=out, executor=executor, progress=show_progress, lost=lost)
    console = TableConsole()
    head = ["\n".join(pair) for pair in zip(*heads(), strict=True)]
    caption = "Errors in metres, along the line and in 3-D; below each heading, the performance feature of EN 16803-1"
    show_table(console, plain_table(head, shown_rows(table), caption, texts=2))
    show_notes(console, notes)
    show_files(console, [out / f"benchmark.{kind}" for kind in ("csv", "json", "md")])
    failed = table["error"].drop_nulls()
    if len(failed) == len(table):
        raise NoPositionError(f"every case has failed; the first error: {failed[0]}")
    if len(failed):
        raise MismatchError(f"{len(failed)} cases failed; the first error: {failed[0]}")


@from_models
def ablate(
    inputs: RunInputs,
    choices: Choices,
    options: Annotated[RunOptions, Without("observations", "chunk_epochs", "reference")],
    columns: ColumnNames,
    *,
    out: OutOption,
) -> None:
    r"""Compare the screens on a log: all screens, none, each screen alone, and all but one.

    The logs are read once. Screens that are off in the settings stay off. Screens that cannot be run (no second
    antenna, no C/N0 curve) are left out and reported. The validity and health of satellites are checked in every case;
    with `none`, no other check is made, and there is no elevation mask.

    With `--filter track`, the table also has rows for the filter along the track, with all screens on: one row with all
    available sources (codes, phases, Dopplers, and the given sensors), and, for each source except codes, one row
    without this source.

    For each selection of screens, the table shows the fractions of epochs with coordinates and of epochs with status
    ok, the number of satellites used, and the median standard deviation along the line. With `--truth`, the table also
    shows errors along the line for three groups: all epochs with coordinates, epochs with status ok, and epochs without
    satellites. A position with an error over 50 m counts as wrong. A further column is the 95th percentile of the ratio
    of error to stated sigma. `ablation.csv` in DIR has all statistics, also of the conventional positions (3-D single
    point); `ablation.json` has the versions, inputs and settings.

    Example:

        railfix ablate --front front.obs --nav brdc.nav --track line.csv --truth rtk.pos --out screens

        railfix ablate ... --tachometer pulses.csv --inertial imu.csv --filter track --out sources

    Exit codes are listed in `railfix --help`.
    """
    settings, asked = resolve_settings(choices)
    inputs = inputs.replaced(config=choices.config)
    with progress_bar() as progress:
        ablation = ablate_files(
            inputs, settings, out=out, options=options, asked=asked, reading=columns, progress=progress
        )
    show_ablation(ablation)


def show_ablation(ablation: Ablation) -> None:
    """Print one table per antenna, the notes, and the path of the results."""
    console = TableConsole()
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
    show_table(console, plain_table(head, rows, caption))


def _errors(figures: Score) -> list[str]:
    if not figures.positions:
        return ["-"] * 4
    return [number(figures.p50_m), number(figures.p95_m), number(figures.max_m, 1), percent(figures.wrong_place)]
