"""Pictures of the README, from the demonstration: ``python tests/studies/pictures.py`` writes them to docs/pictures."""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Final

import polars as pl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import paths
from railfix import Config, read_track, run_files
from railfix.evaluate import RunAndReference, evaluate_runs
from railfix.report.plots import draw_chart, plan
from railfix.run import RunOptions
from railfix.simulate.demonstration import demo_inputs, demo_truth

FOLDER: Final = paths.ROOT / "docs" / "pictures"
_SERIES: Final = (
    ("conventional_error_m", "conventional, unscreened", "#b0b0b0", 2.0),
    ("error_m", "filter along the track", "#0072b2", 1.2),
)


def demonstration(folder: Path) -> tuple[pl.DataFrame, dict[str, pl.DataFrame]]:
    """Positions of the front antenna by the filter; their errors, and those of unscreened conventional positions."""
    inputs = demo_inputs()
    run_files(inputs, Config(), out=folder / "run")
    unscreened = Config(filter="off", screens=("elevation",), protection="off")
    run_files(inputs, unscreened, out=folder / "unscreened", options=RunOptions())
    single = RunAndReference(run=folder / "run", reference=demo_truth(), conventional=folder / "unscreened")
    errors = {
        column: evaluate_runs([compared]).epochs.filter(pl.col("antenna") == "front")
        for column, compared in (("conventional_error_m", single), ("error_m", replace(single, table="train")))
    }
    return pl.read_parquet(folder / "run" / "train.parquet").filter(pl.col("antenna") == "front"), errors


def draw_plan(positions: pl.DataFrame) -> Figure:
    """Plan of the line, its positions coloured by the protection level."""
    figure = Figure(figsize=(8.0, 4.4), layout="constrained")
    track = read_track(demo_inputs().track[0])
    chart = plan(positions, level_m=positions["protection_level_m"].to_numpy(), track=track, title="")
    draw_chart(chart, figure.subplots())
    return figure


def draw_errors(errors: dict[str, pl.DataFrame]) -> Figure:
    """Errors along the line over chainage, beside those of the conventional positions."""
    figure = Figure(figsize=(8.0, 3.4), layout="constrained")
    axes: Axes = figure.subplots()
    for column, label, colour, size in _SERIES:
        axes.plot(errors[column]["chainage_m"], errors[column][column], ".", ms=size, color=colour, label=label)
    axes.set(xlabel="chainage [m]", ylabel="error along the line [m]")
    axes.set_yscale("symlog", linthresh=5.0)
    axes.set_yticks([-20, -10, -5, 0, 5, 10, 20, 40], ["-20", "-10", "-5", "0", "5", "10", "20", "40"])
    axes.grid(alpha=0.3)
    axes.legend(markerscale=5.0, loc="upper left")
    return figure


def main() -> int:
    """Write the pictures."""
    FOLDER.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        positions, errors = demonstration(Path(folder))
    for name, figure in (("plan", draw_plan(positions)), ("errors", draw_errors(errors))):
        figure.savefig(FOLDER / f"{name}.png", dpi=100, metadata={"Software": None})
    return 0


if __name__ == "__main__":
    sys.exit(main())
