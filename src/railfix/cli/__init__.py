"""Command-line program ``railfix`` and its commands.

The module of a command is imported only when the command is called, so that ``railfix --help`` appears quickly.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Annotated, ClassVar

import typer

from railfix import __version__
from railfix.cli.command import LazyCommands, command_group
from railfix.core.files import source_commit

# OpenBLAS is limited to one thread, because its threads occupy processor cores even while they wait for work. The
# variable must be set before numpy is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


class _Program(LazyCommands):
    """Top-level group of commands, with a one-line summary and the module of each command."""

    summaries: ClassVar[Mapping[str, str]] = {
        "run": "Compute positions along the line from receiver logs.",
        "doctor": "Identify files, check that they fit together, and print the command to run.",
        "explain": "Explain one epoch of a run: its satellites, sigma, protection level and status.",
        "export": "Write the positions of a run as KML, GPX, GeoJSON, GeoPackage, GeoParquet or MCAP.",
        "campaign": "Compute positions from many logs in parallel; continue an interrupted campaign.",
        "benchmark": "Run a folder of cases, and evaluate railfix and other programs in the same way.",
        "demo": "Compute positions from the demonstration log, and compare them with the ground truth.",
        "ablate": "Compare the screens on a log: all together, none, each screen alone, and all but one.",
        "evaluate": "Compute errors of runs against references.",
        "reference": "Build a reference trajectory from RTK fixed positions, and bridge its gaps.",
        "live": "Compute the positions of a train from its receivers' streams as they arrive.",
        "locate": "Compute 3-D positions from a log, without a track map.",
        "which-track": "Determine the track on which a train stands.",
        "convert": "Write receiver logs as RINEX files.",
        "cn0-curve": "Fit the mean C/N0 of an antenna and receiver as a function of satellite elevation.",
        "error-model": "Model the pseudorange errors along a line from runs with references.",
        "plot-screens": "Plot each screen's metric against its limit.",
        "simulate": "Simulate runs with ground truth.",
        "report": "Write an HTML report on runs.",
        "ground": "Monitor satellites with three reference receivers; supervise trains from the ground.",
        "map": "Check or make a track map, or match positions to a network of tracks.",
    }
    modules: ClassVar[Mapping[str, str]] = {
        "convert": "logs",
        "doctor": "logs",
        "export": "logs",
        "locate": "logs",
        "which-track": "logs",
        "explain": "report",
        "plot-screens": "report",
        "benchmark": "campaign",
        "ablate": "campaign",
        "reference": "evaluate",
        "error-model": "evaluate",
        "live": "run",
        "cn0-curve": "evaluate",
    }


app = command_group("railfix", cls=_Program, context_settings={"help_option_names": ["-h", "--help"]})


def version_text() -> str:
    """Return the version of railfix and the source commit in one line."""
    return f"railfix {__version__} (commit {source_commit()})"


def _print_version(*, asked: bool) -> None:
    if asked:
        typer.echo(version_text())
        raise typer.Exit


@app.callback()
def railfix(
    *,
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=lambda asked: _print_version(asked=asked),
            is_eager=True,
            help="Print the version with its commit and exit.",
        ),
    ] = False,
) -> None:
    """Compute the positions of a train along its line from GNSS receiver logs and a 3-D track map.

    A train runs on a known line, so its antenna lies on a known curve and its position is one number, the chainage.
    railfix reads receiver logs, navigation files and a track map, and writes the chainage of every epoch, its
    standard deviation and the reason for every rejected observation.

    Begin with `railfix demo`, then read `railfix run --help`.

    Exit codes:

    - 0: done
    - 1: an internal error of railfix (a traceback is shown)
    - 2: the command line is wrong (unknown option, missing argument)
    - 3: an input file is missing, unreadable, or malformed
    - 4: a setting is misspelt, out of range, or contradicts another setting
    - 5: the inputs are readable but do not match each other, for example because they are from different days or places
    - 6: the track map was checked and has errors
    - 7: the results contain no position, or the inputs contain no usable position
    - 8: the output cannot be written
    - 9: the two processing channels of a live session computed different outputs from the same input

    After a signal, the exit code is 128 plus the number of the signal: 143 for SIGTERM, or 141 for SIGPIPE if the
    program that reads the output ends first.

    An error is reported in one sentence on standard error, and no results are written. Existing files are replaced only
    with `--overwrite`; an input is never replaced.
    """
