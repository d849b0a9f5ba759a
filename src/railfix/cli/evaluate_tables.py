"""Tables of ``railfix evaluate``: the conventional position beside the one on the map."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import polars as pl
from rich.console import Console
from rich.table import Table

from railfix.cli.console import (
    Column,
    console_of_tables,
    count,
    listed,
    metres,
    percent,
    plain_table,
    show_files,
    show_notes,
    show_verdict,
)
from railfix.cli.evaluate_levels import RUN_OR_CONFIGURATION, show_integrity
from railfix.cli.verdict import verdict_of_evaluation
from railfix.evaluate.figures import WITH_SATELLITES
from railfix.evaluate.output import P1_COMMERCIAL, P1_TABLE_4
from railfix.evaluate.scores import WRONG_PLACE_M

if TYPE_CHECKING:
    from railfix.evaluate import Evaluation

_NAMES: Final = {
    "constrained": "on the map",
    "constrained_ok": "  of status ok",
    "conventional": "conventional",
}
_GROUPINGS: Final = {
    "configuration": "By configuration, its runs together",
    "line": "By line, the runs of a configuration together",
    "environment": "By environment",
    "speed": "By speed",
    "signals": "With and without satellites (tunnels and other outages)",
    "satellites": "By satellites used",
    "status": "By status",
    "section": "By section of the line",
}
#: Rows of sections that are shown; the files have all.
_MOST_SECTIONS: Final = 20


def show_evaluation(evaluation: Evaluation, files: dict[str, Path], *, beside: Literal["nothing", "p1"]) -> None:
    """Figures of each run, then by groups, then where the files are."""
    console = console_of_tables()
    show_verdict(console, verdict_of_evaluation(evaluation))
    for run in evaluation.runs:
        console.print(f"{run.name}: {run.configuration}; line {run.line}", markup=False, soft_wrap=True)
        for antenna, method in run.method.items():
            by = "differences of chainage" if method == "chainage" else "along the trajectory"
            console.print(
                f"  {antenna}: against {run.reference}, {by}; {run.outside[antenna]:,} epochs outside the reference",
                markup=False,
                soft_wrap=True,
            )
        show_notes(console, run.notes)
    console.print("\nErrors along the line in metres, + toward its end")
    several = len(evaluation.runs) > 1
    overall = evaluation.figures.filter(pl.col("grouping") == "all")
    if several and "all" in overall["antenna"]:
        overall = overall.filter(pl.col("antenna") == "all")
    console.print(_overall(overall))
    if overall["mean_low_m"].is_not_null().any():
        options = evaluation.options
        console.print(
            f"Limits of {100 * options.confidence:g} % confidence, from blocks of {options.block_s:g} s drawn "
            f"{options.replicates:,} times"
        )
        console.print(_limits(overall))
    console.print("Metres run and seconds passed between two positions")
    intervals = evaluation.intervals
    console.print(_intervals(intervals.filter(pl.col("run") == "all") if several else intervals))
    if evaluation.levels is not None:
        console.print("Protection levels")
        console.print(_levels(evaluation.levels))
        show_integrity(evaluation, console)
    if evaluation.outages is not None and len(evaluation.outages):
        console.print("Stretches without satellites, as the filter along the track passes them")
        console.print(outages(evaluation.outages))
    if evaluation.branches is not None and len(evaluation.branches):
        console.print(f"Stated probability of the place against the share of places within {WRONG_PLACE_M:g} m")
        console.print(_branches(evaluation.branches))
    for grouping, head in _GROUPINGS.items():
        rows = evaluation.figures.filter(pl.col("grouping") == grouping, pl.col("epochs_of") == "own")
        if several and grouping in ("environment", "speed"):
            rows = rows.filter(pl.col("run") == "all")
        trivial = {"environment": "unknown", "signals": WITH_SATELLITES}.get(grouping)
        if rows.is_empty() or rows["group"].unique().to_list() == [trivial]:
            continue
        console.print(head)
        console.print(_group(rows))
        if grouping == "section" and rows.n_unique(["run", "antenna", "group"]) > _MOST_SECTIONS:
            console.print(f"  the first {_MOST_SECTIONS}; all are in tables.csv (--out)")
    if beside == "p1":
        _show_p1(console)
    show_files(console, files.values())


_WHERE: Final[tuple[Column, ...]] = (("run", "run", str), ("antenna", "antenna", str))
_OF: Final[tuple[Column, ...]] = (("of", "of", str), ("antenna", "antenna", str))
_signed: Final = partial(metres, sign="+")


def _add_names(rows: pl.DataFrame) -> pl.DataFrame:
    """Rows with the words for their kind of position."""
    return rows.with_columns(pl.col("position").replace({name: text.strip() for name, text in _NAMES.items()}))


def _place(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} m"


def _overall(rows: pl.DataFrame) -> Table:
    columns: Sequence[Column] = (
        *_WHERE,
        ("position", "name", str),
        ("epochs", "counted", count),
        ("rate %", "rate", percent),
        ("of run %", "rate_of_run", percent),
        ("mean", "mean_m", _signed),
        *((name, f"{name}_m", metres) for name in ("std", "rms", "p50", "p95", "p99", "max")),
        ("at", "max_at_chainage_m", _place),
        ("wrong", "wrong_places", count),
        ("/sigma", "normalised_rms", metres),
    )
    named = [
        row
        | {"name": _NAMES[row["position"]] + (", epochs of both" if row["epochs_of"] == "common" else "")}
        | {"counted": row["observed" if row["epochs_of"] == "own" else "positions"]}
        for row in _in_order(rows)
    ]
    return listed(named, columns)


def _in_order(rows: pl.DataFrame) -> Iterator[dict[str, Any]]:
    """Rows of each run and antenna, those on common epochs only where they are not every one's own."""
    order = {name: number for number, name in enumerate(_NAMES)}
    for mine in rows.partition_by("run", "antenna", maintain_order=True):
        both = mine.filter(pl.col("position") != "constrained_ok")
        if both["positions"].n_unique() == 1:
            mine = mine.filter(pl.col("epochs_of") == "own")
        ranked = mine.with_columns(_order=pl.col("position").replace_strict(order))
        yield from ranked.sort("epochs_of", "_order", descending=[True, False]).iter_rows(named=True)


def _limits(rows: pl.DataFrame) -> Table:
    table = plain_table("run", "antenna", "position", "blocks", "rate %", "mean", "p95", text=3)
    for row in _in_order(rows.filter(pl.col("mean_low_m").is_not_null())):
        table.add_row(
            row["run"],
            row["antenna"],
            _NAMES[row["position"]],
            count(row["blocks"]),
            f"{percent(row['rate_low'])} to {percent(row['rate_high'])}",
            f"{_signed(row['mean_low_m'])} to {_signed(row['mean_high_m'])}",
            f"{metres(row['p95_low_m'])} to {metres(row['p95_high_m'])}",
        )
    return table


def _group(rows: pl.DataFrame) -> Table:
    """Constrained and conventional of each group in one row."""
    keys = ["run", "configuration", "line", "antenna", "group"]
    left = rows.filter(pl.col("position") == "constrained")
    right = rows.filter(pl.col("position") == "conventional")
    both = left.join(right, on=keys, how="left", suffix="_conventional", maintain_order="left")
    # one antenna beside both together tells nothing new of the groups
    if "all" in both["antenna"]:
        both = both.filter(pl.col("antenna") == "all")
    if rows["grouping"][0] == "section":
        both = both.head(_MOST_SECTIONS)
    # without satellites nothing is observed: every epoch counts
    counted, rate = ("epochs", "rate_of_run") if rows["grouping"][0] == "signals" else ("observed", "rate")
    columns: list[Column] = [_OF[0], ("group", "group", str), _OF[1], ("epochs", counted, count)]
    for conv, suffix in (("", ""), ("conv.\n", "_conventional")):
        columns += [(f"{conv}rate %", f"{rate}{suffix}", percent), (f"{conv}mean", f"mean_m{suffix}", _signed)]
        columns += [(f"{conv}{name}", f"{name}_m{suffix}", metres) for name in ("std", "p50", "p95", "max")]
    return listed(both.with_columns(RUN_OR_CONFIGURATION).iter_rows(named=True), columns)


def _intervals(rows: pl.DataFrame) -> Table:
    columns: Sequence[Column] = (
        *_OF,
        ("position", "position", str),
        ("intervals", "intervals", count),
        ("standing", "standing", count),
        ("p50 m", "interval_p50_m", metres),
        ("p95 m", "interval_p95_m", metres),
        ("largest m", "interval_max_m", metres),
        ("at", "interval_max_chainage_m", _place),
        ("p95 s", "gap_p95_s", metres),
        ("longest s", "gap_max_s", metres),
    )
    return listed(_add_names(rows).with_columns(RUN_OR_CONFIGURATION).iter_rows(named=True), columns)


def _levels(rows: pl.DataFrame) -> Table:
    columns: Sequence[Column] = (
        *_WHERE,
        ("position", "position", str),
        ("level", "level", str),
        ("positions", "positions", count),
        ("finite %", "level_share", percent),
        ("p50 m", "level_p50_m", metres),
        ("p95 m", "level_p95_m", metres),
        ("errors", "errors", count),
        ("over level", "over_level", count),
    )
    return listed(_add_names(rows).iter_rows(named=True), columns)


def outages(rows: pl.DataFrame) -> Table:
    """Table of stretches without satellites."""
    columns: Sequence[Column] = (
        *_WHERE,
        ("begin", "begin_gpst", str),
        ("environment", "environment", str),
        ("carried by", "carried_by", str),
        ("lasting s", "duration_s", "{:.1f}".format),
        ("way m", "travelled_m", lambda value: "-" if value is None else f"{value:.0f}"),
        ("rate %", "rate", percent),
        *((name, f"outage_{name}_m", metres) for name in ("p50", "p95", "max")),
        ("at its end", "end_error_m", _signed),
        ("sigma there", "end_sigma_m", metres),
        ("max /sigma", "largest_normalised", metres),
    )
    shown = rows.with_columns(
        pl.col("begin_gpst").dt.strftime("%H:%M:%S"),
        pl.col("carried_by").fill_null("").replace("", "prediction"),
        rate=pl.col("positions") / pl.col("epochs"),
    )
    return listed(shown.iter_rows(named=True), columns)


def _branches(rows: pl.DataFrame) -> Table:
    columns: Sequence[Column] = (
        *_WHERE,
        ("probability", "probability", str),
        ("positions", "judged", count),
        ("stated %", "probability_mean", percent),
        ("right %", "right_share", percent),
        ("wrong", "wrong_places", count),
        ("blocks", "blocks", count),
        ("with a wrong one", "wrong_blocks", count),
    )
    return listed(rows.iter_rows(named=True), columns)


def _show_p1(console: Console) -> None:
    """The figures of the source paper."""
    rate: Column = ("rate %", "rate", percent)
    console.print("The source paper, test line (table 4)")
    test_line = (("configuration", "configuration", str), rate, ("mean", "mean_m", _signed), ("std", "std_m", metres))
    console.print(listed(P1_TABLE_4, test_line))
    console.print(
        "The source paper, commercial lines with MSAS (5): rate of the section without tunnels (figure 10), "
        "largest error of all (figure 11)"
    )
    console.print(listed(P1_COMMERCIAL, (("position", "position", str), rate, ("max", "max_m", metres))))
