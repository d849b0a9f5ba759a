"""Tables of ``railfix evaluate``: the conventional position beside the one on the map."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import polars as pl
from rich.console import Console

from railfix.cli.console import console_of_tables, show_files, show_notes, show_table, show_verdict
from railfix.cli.verdict import verdict_of_evaluation
from railfix.core.tables import Column, listing, number, percent, signed
from railfix.evaluate.output import P1_COMMERCIAL, P1_TABLE_4
from railfix.evaluate.tables import error_tables, group_tables, level_tables
from railfix.pipeline.level_stage import prior_basis_text

if TYPE_CHECKING:
    from railfix.evaluate import Evaluation

#: Rows of sections, and epochs with an error beyond the level, that are shown; the files have all.
_MOST_SECTIONS: Final = 20
_MOST_BEYOND: Final = 5


def show_evaluation(evaluation: Evaluation, files: dict[str, Path], *, beside: Literal["nothing", "p1"]) -> None:
    """Figures of each run, then by groups, then where the files are."""
    console = console_of_tables()
    show_verdict(console, verdict_of_evaluation(evaluation))
    write = partial(console.print, markup=False, soft_wrap=True)
    for run in evaluation.runs:
        write(f"{run.name}: {run.configuration}; line {run.line}")
        for antenna, method in run.method.items():
            by = "differences of chainage" if method == "chainage" else "along the trajectory"
            write(f"  {antenna}: against {run.reference}, {by}; {run.outside[antenna]:,} epochs outside the reference")
        show_notes(console, run.notes)
    for table in error_tables(evaluation):
        show_table(console, table)
    for text in dict.fromkeys(prior_basis_text(run.protection) for run in evaluation.runs if run.protection):
        write(f"Protection levels: {text}")
    for table in level_tables(evaluation, worst=_MOST_BEYOND):
        show_table(console, table)
    for table in group_tables(evaluation):
        show_table(console, table, most=_MOST_SECTIONS)
    if beside == "p1":
        _show_p1(console)
    show_files(console, files.values())


def _show_p1(console: Console) -> None:
    """The figures of the source paper."""
    rate: Column = ("rate %", "rate", percent)
    test_line = (("configuration", "configuration", str), rate, ("mean", "mean_m", signed), ("std", "std_m", number))
    caption = "The source paper, test line (table 4)"
    show_table(console, listing("p1", pl.DataFrame(P1_TABLE_4), test_line, caption))
    caption = (
        "The source paper, commercial lines with MSAS (5): rate of the section without tunnels (figure 10), "
        "largest error of all (figure 11)"
    )
    commercial = (("position", "position", str), rate, ("max", "max_m", number))
    show_table(console, listing("p1", pl.DataFrame(P1_COMMERCIAL), commercial, caption))
