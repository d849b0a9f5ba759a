"""Tables of ``railfix evaluate``: the conventional position beside the one on the map."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

import polars as pl
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from railfix.cli.console import console_of_tables, show_files, show_notes
from railfix.cli.evaluate_levels import show_integrity
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
        console.print(_grouped(rows))
        if grouping == "section" and rows.n_unique(["run", "antenna", "group"]) > _MOST_SECTIONS:
            console.print(f"  the first {_MOST_SECTIONS}; all are in tables.csv (--out)")
    if beside == "p1":
        _show_p1(console)
    show_files(console, files.values())


def _table(*heads: str, text: int) -> Table:
    """A table whose first columns are text and the others numbers."""
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for number, head in enumerate(heads):
        table.add_column(head, justify="left" if number < text else "right", no_wrap=True, overflow="fold")
    return table


def _overall(rows: pl.DataFrame) -> Table:
    heads = ("epochs", "rate %", "of run %", "mean", "std", "rms", "p50", "p95", "p99", "max", "at", "wrong", "/sigma")
    table = _table("run", "antenna", "position", *heads, text=3)
    for row in _in_order(rows):
        table.add_row(
            row["run"],
            row["antenna"],
            _NAMES[row["position"]] + (", epochs of both" if row["epochs_of"] == "common" else ""),
            f"{row['observed'] if row['epochs_of'] == 'own' else row['positions']:,}",
            _percent(row["rate"]),
            _percent(row["rate_of_run"]),
            _metres(row["mean_m"], sign="+"),
            *(_metres(row[name]) for name in ("std_m", "rms_m", "p50_m", "p95_m", "p99_m", "max_m")),
            _place(row["max_at_chainage_m"]),
            f"{row['wrong_places']:,}",
            _metres(row["normalised_rms"]),
        )
    return table


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
    table = _table("run", "antenna", "position", "blocks", "rate %", "mean", "p95", text=3)
    for row in _in_order(rows.filter(pl.col("mean_low_m").is_not_null())):
        table.add_row(
            row["run"],
            row["antenna"],
            _NAMES[row["position"]],
            f"{row['blocks']:,}",
            f"{_percent(row['rate_low'])} to {_percent(row['rate_high'])}",
            f"{_metres(row['mean_low_m'], sign='+')} to {_metres(row['mean_high_m'], sign='+')}",
            f"{_metres(row['p95_low_m'])} to {_metres(row['p95_high_m'])}",
        )
    return table


def _grouped(rows: pl.DataFrame) -> Table:
    """Constrained and conventional of each group in one row."""
    heads = ("epochs", "rate %", "mean", "std", "p50", "p95", "max")
    table = _table("of", "group", "antenna", *heads, *(f"conv.\n{head}" for head in heads[1:]), text=3)
    keys = ["run", "configuration", "line", "antenna", "group"]
    left = rows.filter(pl.col("position") == "constrained")
    right = rows.filter(pl.col("position") == "conventional")
    both = left.join(right, on=keys, how="left", suffix="_conventional", maintain_order="left")
    # one antenna beside both together tells nothing new of the groups
    if "all" in both["antenna"]:
        both = both.filter(pl.col("antenna") == "all")
    if rows["grouping"][0] == "section":
        both = both.head(_MOST_SECTIONS)
    for row in both.iter_rows(named=True):
        # without satellites nothing is observed: every epoch counts
        counted, rate = ("epochs", "rate_of_run") if row["grouping"] == "signals" else ("observed", "rate")
        cells = [f"{row[counted]:,}"]
        for suffix in ("", "_conventional"):
            cells.append(_percent(row[f"{rate}{suffix}"]))
            cells.append(_metres(row[f"mean_m{suffix}"], sign="+"))
            cells += [_metres(row[f"{name}{suffix}"]) for name in ("std_m", "p50_m", "p95_m", "max_m")]
        table.add_row(_of(row), row["group"], row["antenna"], *cells)
    return table


def _intervals(rows: pl.DataFrame) -> Table:
    heads = ("intervals", "standing", "p50 m", "p95 m", "largest m", "at", "p95 s", "longest s")
    table = _table("of", "antenna", "position", *heads, text=3)
    for row in rows.iter_rows(named=True):
        table.add_row(
            _of(row),
            row["antenna"],
            _NAMES[row["position"]].strip(),
            f"{row['intervals']:,}",
            f"{row['standing']:,}",
            *(_metres(row[name]) for name in ("interval_p50_m", "interval_p95_m", "interval_max_m")),
            _place(row["interval_max_chainage_m"]),
            *(_metres(row[name]) for name in ("gap_p95_s", "gap_max_s")),
        )
    return table


def _levels(rows: pl.DataFrame) -> Table:
    heads = ("positions", "finite %", "p50 m", "p95 m", "errors", "over level")
    table = _table("run", "antenna", "position", "level", *heads, text=4)
    for row in rows.iter_rows(named=True):
        table.add_row(
            row["run"],
            row["antenna"],
            _NAMES[row["position"]].strip(),
            row["level"],
            f"{row['positions']:,}",
            _percent(row["level_share"]),
            _metres(row["level_p50_m"]),
            _metres(row["level_p95_m"]),
            f"{row['errors']:,}",
            f"{row['over_level']:,}",
        )
    return table


def outages(rows: pl.DataFrame) -> Table:
    """Table of stretches without satellites."""
    heads = ("lasting s", "way m", "rate %", "p50", "p95", "max", "at its end", "sigma there", "max /sigma")
    table = _table("run", "antenna", "begin", "environment", "carried by", *heads, text=5)
    for row in rows.iter_rows(named=True):
        table.add_row(
            row["run"],
            row["antenna"],
            f"{row['begin_gpst']:%H:%M:%S}",
            row["environment"],
            row["carried_by"] or "prediction",
            f"{row['duration_s']:.1f}",
            "-" if row["travelled_m"] is None else f"{row['travelled_m']:.0f}",
            _percent(row["positions"] / row["epochs"]),
            *(_metres(row[f"outage_{name}_m"]) for name in ("p50", "p95", "max")),
            _metres(row["end_error_m"], sign="+"),
            _metres(row["end_sigma_m"]),
            _metres(row["largest_normalised"]),
        )
    return table


def _branches(rows: pl.DataFrame) -> Table:
    heads = ("positions", "stated %", "right %", "wrong", "blocks", "with a wrong one")
    table = _table("run", "antenna", "probability", *heads, text=3)
    for row in rows.iter_rows(named=True):
        shares = (_percent(row[name]) for name in ("probability_mean", "right_share"))
        counts = (f"{row[name]:,}" for name in ("wrong_places", "blocks", "wrong_blocks"))
        table.add_row(row["run"], row["antenna"], row["probability"], f"{row['judged']:,}", *shares, *counts)
    return table


def _show_p1(console: Console) -> None:
    """The figures of the source paper."""
    console.print("The source paper, test line (table 4)")
    table = _table("configuration", "rate %", "mean", "std", text=1)
    for row in P1_TABLE_4:
        table.add_row(
            str(row["configuration"]), _percent(row["rate"]), _metres(row["mean_m"], sign="+"), _metres(row["std_m"])
        )
    console.print(table)
    console.print(
        "The source paper, commercial lines with MSAS (5): rate of the section without tunnels (figure 10), "
        "largest error of all (figure 11)"
    )
    table = _table("position", "rate %", "max", text=1)
    for row in P1_COMMERCIAL:
        table.add_row(str(row["position"]), _percent(row["rate"]), _metres(row["max_m"]))
    console.print(table)


def _of(row: dict[str, Any]) -> str:
    """The run, or the configuration whose runs are together."""
    return str(row["run"] if row["run"] != "all" else row["configuration"])


def _percent(value: Any) -> str:
    return "-" if value is None else f"{100 * value:.2f}"


def _metres(value: Any, *, sign: str = "") -> str:
    return "-" if value is None else f"{value:{sign}.2f}"


def _place(value: Any) -> str:
    return "-" if value is None else f"{value:.0f} m"
