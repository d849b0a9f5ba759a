"""``railfix demo``: the main job on the log that comes with railfix, against its truth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from railfix.demonstration import Comparison


def demo(
    *,
    out: Annotated[
        Path,
        typer.Option("--out", metavar="DIR", help="Folder for the results; those of an earlier demo are replaced."),
    ] = Path("railfix-demo"),
) -> None:
    """Run the main job on the log that comes with railfix, and compare it with the truth.

    The log is made up: a train with two antennas, 18.2 m apart, shuttles on a test line of 756 m with
    curves and cant, seen by two receivers at 10 Hz, with noise and without multipath. railfix
    positions it as `railfix run` does, works out the error along the line of each position and of
    the conventional one (3-D single point, moved to the nearest point), and draws a picture.

    Into DIR come `positions.csv`, `positions.parquet`, `observations.parquet`, `run.json` and
    `picture.png`.

    Example:

        railfix demo --out first-look

    Exit codes: 0 done; 8 DIR cannot be written; 1 a defect of railfix.
    """
    from railfix.cli.console import progress_bar, show_summary
    from railfix.demonstration import compare, demo_inputs, draw
    from railfix.run import RunOptions, run_files

    inputs = demo_inputs()
    with progress_bar() as progress:
        options = RunOptions(observations="write", overwrite="replace")
        summary = run_files(inputs, out=out, options=options, progress=progress)
    show_summary(summary)
    comparison = compare(inputs, summary.files["positions.parquet"])
    show_comparison(comparison)
    picture = draw(comparison, out / "picture.png")
    typer.echo(f"wrote {picture}")
    typer.echo(f"the log, its track map, vehicle and truth: {inputs.front[0].parent}")


def show_comparison(comparison: Comparison) -> None:
    """Errors along the line on the map, and of the conventional position."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    console.print("Error along the line against the truth in metres, + toward its end")
    table = Table()
    for head in ("antenna", "position", "rate", "mean", "std", "p50", "p95", "largest"):
        table.add_column(head, justify="left" if head in ("antenna", "position") else "right")
    for name, antenna in comparison.antennas.items():
        for label, figures in (("on the map", antenna.on_map), ("conventional", antenna.conventional)):
            lengths = (figures.mean_m, figures.std_m, figures.p50_m, figures.p95_m, figures.max_m)
            table.add_row(name, label, f"{100 * figures.rate:.2f} %", *(f"{value:.2f}" for value in lengths))
    console.print(table)
