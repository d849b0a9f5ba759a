"""``railfix doctor``: what files are, whether they fit together, and the command to run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from railfix.cli.console import console_of_tables
from railfix.run.doctor import examine_files


def doctor(
    files: Annotated[
        list[Path], typer.Argument(metavar="FILE...", help="Logs, navigation, track, vehicle, references.")
    ],
) -> None:
    """Examine files before a run: what each is, whether they fit together, and the command to run.

    The kind of a file is found by its content: a log of observations, navigation, a track map, positions, a vehicle or
    settings. First comes what does not fit together or is missing, then the command, ready to copy, then the facts of
    each file (span in GPS time, rate, gaps, satellites, signals, place, frame, heights). Nothing is written.

    Example: `railfix doctor front.obs brdc.nav line.csv car.toml`

    Exit codes: 0 everything fits; 3 a file is missing; 5 something does not fit, is missing or of no known kind.
    """
    diagnosis = examine_files(files)
    console = console_of_tables()
    problems = diagnosis.problems
    verdict = f"{len(problems)} thing(s) to mend" if problems else "the files fit together"
    console.print(f"{len(diagnosis.findings)} files: {verdict}", markup=False)
    for problem in problems:
        console.print(f"- {problem}", markup=False, soft_wrap=True)
    if diagnosis.command:
        console.print(f"run: {diagnosis.command}", markup=False, soft_wrap=True)
    for finding in diagnosis.findings:
        console.print(f"\n{finding.path}: {finding.kind}", markup=False, soft_wrap=True)
        if finding.span is not None:
            first, last = (str(time)[:19].replace("T", " ") for time in finding.span)
            console.print(f"  {first} to {last} GPS time", markup=False)
        for fact in finding.facts:
            console.print(f"  {fact}", markup=False, soft_wrap=True)
    if problems:
        raise typer.Exit(5)
