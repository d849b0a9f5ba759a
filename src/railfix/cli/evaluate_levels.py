"""Tables of ``railfix evaluate`` on protection levels: Stanford counts, and epochs with errors above the level."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import polars as pl
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from railfix.pipeline.level_stage import standing

if TYPE_CHECKING:
    from railfix.evaluate import Evaluation, Integrity

#: Epochs beyond that are shown; the files have all.
_MOST_BEYOND: Final = 5
_LEVELS_OF: Final = {"usable": "usable", "all": "levels alone"}
_COUNTS: Final = (
    "epochs", "nominal", "misleading", "hazardously_misleading", "unavailable", "unavailable_misleading", "unjudged",
    "no_position",
)  # fmt: skip
_HEADS: Final = (
    "epochs", "nominal", "misl.", "hazard.\nmisl.", "unavail.", "unavail.\nmisl.", "un-\njudged", "no\npos.",
    "avail. %", "of ob-\nserved %", "blocks\nbeyond", "15 s %", "60 s %",
)  # fmt: skip


def show_integrity(evaluation: Evaluation, console: Console) -> None:
    """Levels of each kind against the errors."""
    several = len(evaluation.runs) > 1
    for text in dict.fromkeys(standing(run.protection) for run in evaluation.runs if run.protection):
        console.print(f"Protection levels: {text}", markup=False, soft_wrap=True)
    for kind, found in evaluation.integrity.items():
        console.print(
            f"Protection levels against errors ({kind}): epochs of each region of the Stanford diagram, availability, "
            "continuity over windows\n  usable: status ok and no alarm, every other position as without a bound; "
            "levels alone: every finite level",
            markup=False,
            soft_wrap=True,
        )
        overall = found.stanford.filter(pl.col("grouping") == "all")
        console.print(_counts(overall.filter(pl.col("run") == "all") if several else overall, first=()))
        _show_environments(found.stanford, console)
        _show_beyond(found, kind, console)


def _show_environments(rows: pl.DataFrame, console: Console) -> None:
    """At the runs' own limit, of all antennas and runs of a configuration together."""
    rows = rows.filter(pl.col("grouping") == "environment", "own_limit", pl.col("levels_of") == "usable")
    for column in ("run", "antenna"):
        if "all" in rows[column]:
            rows = rows.filter(pl.col(column) == "all")
    if rows["group"].n_unique() > 1:
        console.print("The same by environment, usable, at the alarm limit of the run")
        console.print(_counts(rows, first=("group",)))


def _counts(rows: pl.DataFrame, *, first: tuple[str, ...]) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    for head in ("of", "antenna", *first, "levels", "limit m"):
        table.add_column("environment" if head == "group" else head, no_wrap=True)
    for head in _HEADS:
        table.add_column(head, justify="right", no_wrap=True)
    for row in rows.iter_rows(named=True):
        shares = [row["availability"], row["availability_of_observed"]]
        table.add_row(
            str(row["run"] if row["run"] != "all" else row["configuration"]),
            row["antenna"],
            *(row[name] for name in first),
            _LEVELS_OF[row["levels_of"]],
            f"{row['alarm_limit_m']:g}{' (own)' if row['own_limit'] else ''}",
            *(f"{row[name]:,}" for name in _COUNTS),
            *map(_percent, shares),
            f"{row['beyond_blocks']:,}",
            _percent(row["continuity_15_s"]),
            _percent(row["continuity_60_s"]),
        )
    return table


def _show_beyond(found: Integrity, kind: str, console: Console) -> None:
    """Print the number of errors above their level, and the worst of them."""
    beyond, usable = found.beyond, int(found.beyond["usable"].sum())
    console.print(
        f"Errors over their level: {len(beyond):,}, of them {usable:,} usable"
        + (f"; all are in beyond_{kind}.csv (--out)" if len(beyond) else ""),
        markup=False,
        soft_wrap=True,
    )
    for row in beyond.head(_MOST_BEYOND).iter_rows(named=True):
        level = f"{row[f'{kind}_level_m']:.2f} m ({row[f'{kind}_cause'] or 'not recorded'})"
        where = "an unknown place" if row["chainage_m"] is None else f"{row['chainage_m']:.0f} m"
        console.print(
            f"  {row['time_gpst']} {row['run']} {row['antenna']} at {where}, {row['environment']}: "
            f"error {row['error_m']:+.2f} m, level {level}, "
            f"status {row['status']}, verdict {row[f'{kind}_status'] or 'not recorded'}",
            markup=False,
            soft_wrap=True,
        )


def _percent(value: Any) -> str:
    return "-" if value is None else f"{100 * value:.2f}"
