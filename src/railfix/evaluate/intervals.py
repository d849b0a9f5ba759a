"""How far the train runs, and how long it takes, from one position to the next (P1 5, figure 12)."""

from __future__ import annotations

from typing import Final

import polars as pl

from railfix.evaluate.figures import POSITIONS, at_largest, positioned

#: Columns of the table of intervals beside its keys, with their unit and meaning.
INTERVAL_COLUMNS: Final[dict[str, str]] = {
    "position": "`constrained`, `constrained_ok` or `conventional`",
    "intervals": "pairs of consecutive positions between which the train moved",
    "standing": "pairs between which it did not move; they count for the time gaps only",
    "interval_mean_m": "distance travelled between consecutive positions",
    "interval_p50_m": "distance travelled between consecutive positions",
    "interval_p95_m": "distance travelled between consecutive positions",
    "interval_p99_m": "distance travelled between consecutive positions",
    "interval_max_m": "distance travelled between consecutive positions",
    "interval_max_from": "time of the position before the largest interval, GPS time",
    "interval_max_chainage_m": "chainage there; empty in a gap of the reference",
    "gap_p50_s": "time between consecutive positions",
    "gap_p95_s": "time between consecutive positions",
    "gap_max_s": "time between consecutive positions",
    "gap_max_from": "time of the position before the longest gap, GPS time",
    "before_first_s": "from the first epoch with a reference to the first position",
    "after_last_s": "from the last position to the last epoch with a reference",
}
_OF: Final = ("run", "antenna")


def interval_table(epochs: pl.DataFrame, by: list[str]) -> pl.DataFrame:
    """Distribution of the intervals of each kind of position: columns `by` and `INTERVAL_COLUMNS`.

    An interval lies within one run and antenna. The values of the columns `by`, ``configuration`` among them, are kept
    apart; before_first_s and after_last_s are the largest of the runs.
    """
    return pl.concat(
        _of_position(epochs.lazy().filter(configuration=name), position, by)
        for position in POSITIONS
        for name in epochs["configuration"].unique(maintain_order=True)
    )


def _of_position(epochs: pl.LazyFrame, position: str, by: list[str]) -> pl.DataFrame:
    keys = list(dict.fromkeys([*by, *_OF]))
    spanned = (
        epochs.filter(pl.col("moved_m").is_not_null())
        .select(*keys, "time_gpst", "chainage_m", "moved_m", has=positioned(position))
        .collect()
    )
    edges = (
        spanned.group_by(keys, maintain_order=True)
        .agg(
            before=_seconds(pl.col("time_gpst").filter("has").first() - pl.col("time_gpst").first()),
            after=_seconds(pl.col("time_gpst").last() - pl.col("time_gpst").filter("has").last()),
        )
        .group_by(by, maintain_order=True)
        .agg(before_first_s=pl.col("before").max(), after_last_s=pl.col("after").max())
    )
    apart = spanned.filter("has").with_columns(
        interval=pl.col("moved_m").diff().over(_OF),
        gap=_seconds(pl.col("time_gpst").diff().over(_OF)),
        start=pl.col("time_gpst").shift().over(_OF),
        place=pl.col("chainage_m").shift().over(_OF),
    )
    ran = pl.col("interval").filter(pl.col("interval") > 0)
    found = apart.group_by(by, maintain_order=True).agg(
        intervals=ran.count().cast(pl.Int64),
        standing=(pl.col("interval") == 0).sum().cast(pl.Int64),
        interval_mean_m=ran.mean(),
        interval_p50_m=ran.quantile(0.5, "linear"),
        interval_p95_m=ran.quantile(0.95, "linear"),
        interval_p99_m=ran.quantile(0.99, "linear"),
        interval_max_m=ran.max(),
        interval_max_from=pl.when(ran.count() > 0).then(at_largest("start", "interval")),
        interval_max_chainage_m=pl.when(ran.count() > 0).then(at_largest("place", "interval")),
        gap_p50_s=pl.col("gap").quantile(0.5, "linear"),
        gap_p95_s=pl.col("gap").quantile(0.95, "linear"),
        gap_max_s=pl.col("gap").max(),
        gap_max_from=at_largest("start", "gap"),
    )
    whole = edges.join(found, on=by, how="left", maintain_order="left")
    counts = pl.col("intervals", "standing").fill_null(0)
    return whole.with_columns(counts, position=pl.lit(position)).select(*by, *INTERVAL_COLUMNS)


def _seconds(duration: pl.Expr) -> pl.Expr:
    return duration.dt.total_nanoseconds() / 1e9
