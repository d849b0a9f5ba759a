"""How wide the protection levels of a run are, and how many errors exceed them, whatever the verdict on them."""

from __future__ import annotations

from typing import Final

import polars as pl

from railfix.evaluate.epochs import level_columns
from railfix.evaluate.figures import positioned

#: Columns of the table of levels beside its keys, with their unit and meaning.
LEVEL_COLUMNS: Final[dict[str, str]] = {
    "level": "column of the level",
    "position": "`constrained` or `constrained_ok`",
    "observed": "epochs with observations and reference",
    "positions": "epochs with a position",
    "infinite": "positions with an infinite level",
    "with_level": "positions with a finite level",
    "level_share": "share of `observed` with a finite level",
    "level_p50_m": "finite levels",
    "level_p95_m": "finite levels",
    "errors": "finite levels with an error",
    "over_level": "errors above their level",
    "over_level_share": "over_level / errors",
}


def level_table(epochs: pl.DataFrame, by: list[str]) -> pl.DataFrame | None:
    """Counts of every protection level of the epochs, by the values of some columns; None where a run has none."""
    tables = []
    for level in level_columns(epochs):
        if epochs[level].null_count() == len(epochs):
            continue
        # runs without this level, such as the filter along the track, have no row
        columns = ("run", *by, "status", "observed", "in_reference", "reference_good", "positioned", "error_m", level)
        spanned = epochs.select(*dict.fromkeys(columns)).filter(
            "in_reference", pl.col(level).is_not_null().any().over("run")
        )
        for position in ("constrained", "constrained_ok"):
            has = positioned(position)
            tables.append(
                spanned.with_columns(has=has, finite=has & pl.col(level).is_finite().fill_null(value=False))
                .group_by(by, maintain_order=True)
                .agg(_counts(level))
                .with_columns(
                    level=pl.lit(level),
                    position=pl.lit(position),
                    level_share=pl.when(pl.col("observed") > 0).then(pl.col("observed_level") / pl.col("observed")),
                    over_level_share=pl.when(pl.col("errors") > 0).then(pl.col("over_level") / pl.col("errors")),
                )
                .select(*by, *LEVEL_COLUMNS)
            )
    return pl.concat(tables) if tables else None


def _counts(level: str) -> list[pl.Expr]:
    value, has, finite = pl.col(level), pl.col("has"), pl.col("finite")
    judged = finite & pl.col("reference_good")
    counts = {
        "observed": pl.col("observed"),
        "positions": has,
        "infinite": has & value.is_infinite(),
        "with_level": finite,
        "observed_level": finite & pl.col("observed"),
        "errors": judged,
        "over_level": judged & (pl.col("error_m").abs() > value),
    }
    return [
        *(expression.sum().cast(pl.Int64).alias(name) for name, expression in counts.items()),
        value.filter(finite).median().alias("level_p50_m"),
        value.filter(finite).quantile(0.95, "linear").alias("level_p95_m"),
    ]
