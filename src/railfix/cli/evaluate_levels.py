"""Tables of ``railfix evaluate`` on protection levels: Stanford counts, and epochs with errors above the level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import polars as pl
from rich.console import Console
from rich.table import Table

from railfix.cli.console import Column, count, listed, percent
from railfix.pipeline.level_stage import prior_basis_text

if TYPE_CHECKING:
    from railfix.evaluate import Evaluation, Integrity

#: Epochs beyond that are shown; the files have all.
_MOST_BEYOND: Final = 5
#: The run, or the configuration whose runs are together.
RUN_OR_CONFIGURATION: Final = pl.when(pl.col("run") != "all").then("run").otherwise("configuration").alias("of")
_LEVELS_OF: Final = {"usable": "usable", "all": "levels alone"}
_COUNTS: Final = {
    "epochs": "epochs",
    "nominal": "nominal",
    "misl.": "misleading",
    "hazard.\nmisl.": "hazardously_misleading",
    "unavail.": "unavailable",
    "unavail.\nmisl.": "unavailable_misleading",
    "un-\njudged": "unjudged",
    "no\npos.": "no_position",
}


def show_integrity(evaluation: Evaluation, console: Console) -> None:
    """Levels of each kind against the errors."""
    for text in dict.fromkeys(prior_basis_text(run.protection) for run in evaluation.runs if run.protection):
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
        several = "all" in overall["run"]
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
        console.print(_counts(rows, first=(("environment", "group", str),)))


def _counts(rows: pl.DataFrame, *, first: tuple[Column, ...]) -> Table:
    columns: Sequence[Column] = (
        ("of", "of", str),
        ("antenna", "antenna", str),
        *first,
        ("levels", "levels_of", str),
        ("limit m", "limit", str),
        *((head, column, count) for head, column in _COUNTS.items()),
        ("avail. %", "availability", percent),
        ("of ob-\nserved %", "availability_of_observed", percent),
        ("blocks\nbeyond", "beyond_blocks", count),
        ("15 s %", "continuity_15_s", percent),
        ("60 s %", "continuity_60_s", percent),
    )
    own = zip(rows["alarm_limit_m"], rows["own_limit"], strict=True)
    limits = [f"{limit:g}{' (own)' if its else ''}" for limit, its in own]
    shown = rows.with_columns(
        RUN_OR_CONFIGURATION, pl.col("levels_of").replace(_LEVELS_OF), pl.Series("limit", limits, dtype=pl.String)
    )
    return listed(shown.iter_rows(named=True), columns)


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
