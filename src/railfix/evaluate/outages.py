"""Stretches of a run without satellites, as the filter along the track passes them: tunnels, stations."""

from __future__ import annotations

from typing import Final

import polars as pl

from railfix.evaluate.epochs import OF_FILTER
from railfix.evaluate.figures import AIDED, KEYS

#: Shorter losses of all satellites are no stretch [s].
LEAST_S: Final = 2.0

#: Columns of the table of stretches without satellites beside its keys, with their unit and meaning.
OUTAGE_COLUMNS: Final[dict[str, str]] = {
    "begin_gpst": "first epoch at which the single-epoch solution used no satellite, GPS time",
    "duration_s": "from the last epoch with a satellite to the last without",
    "travelled_m": "distance travelled meanwhile, by the reference",
    "environment": "of the reference or of the sections, at its middle",
    "carried_by": "measurements that the filter used within it",
    "epochs": "epochs without satellites, those missing in the log included",
    "positions": "those with a position",
    "outage_p50_m": "size of error",
    "outage_p95_m": "size of error",
    "outage_max_m": "size of error",
    "end_error_m": "error at the last position, + toward the end of the line",
    "end_sigma_m": "stated standard deviation there",
    "largest_normalised": "largest size of error / along_sigma_m",
}
_USED: Final = (
    "time_gpst", "observed", "n_used", "in_reference", "reference_good", "positioned", "moved_m", "environment",
    "sources", "error_m", "along_sigma_m", "branch_probability",
)  # fmt: skip


def outage_table(epochs: pl.DataFrame) -> pl.DataFrame | None:
    """Stretches without satellites with the filter's errors, in order of time; None without a table of the filter.

    Single epochs have no position in these stretches and are left out.
    """
    filtered = epochs.select(*KEYS, *_USED).filter(OF_FILTER)
    if not len(filtered):
        return None
    keys = list(KEYS)
    before = pl.col("time_gpst").shift().over(keys)
    marked = (
        filtered.filter("in_reference")
        .with_columns(without=~AIDED, before=before, moved_before=pl.col("moved_m").shift().over(keys))
        .with_columns(stretch=pl.col("without").rle_id().over(keys))
        .filter("without")
    )
    size = pl.col("error_m").abs()
    judged = pl.col("positioned") & pl.col("reference_good")
    first = pl.coalesce(pl.col("before").first(), pl.col("time_gpst").first())
    start = pl.coalesce(pl.col("moved_before").first(), pl.col("moved_m").first())
    words = pl.col("sources").str.split("+").list.explode(keep_nulls=False, empty_as_null=False)
    table = marked.group_by([*keys, "stretch"], maintain_order=True).agg(
        begin_gpst=pl.col("time_gpst").first(),
        duration_s=(pl.col("time_gpst").last() - first).dt.total_nanoseconds() / 1e9,
        travelled_m=pl.col("moved_m").last() - start,
        environment=pl.col("environment").get(pl.len() // 2),
        carried_by=words.filter(words != "").unique(maintain_order=True).str.join("+"),
        epochs=pl.len().cast(pl.Int64),
        positions=pl.col("positioned").sum().cast(pl.Int64),
        outage_p50_m=size.filter(judged).quantile(0.5, "linear"),
        outage_p95_m=size.filter(judged).quantile(0.95, "linear"),
        outage_max_m=size.filter(judged).max(),
        end_error_m=pl.col("error_m").filter(judged).last(),
        end_sigma_m=pl.col("along_sigma_m").filter(judged).last(),
        largest_normalised=(size / pl.col("along_sigma_m")).filter(judged).max(),
    )
    return table.filter(pl.col("duration_s") >= LEAST_S).select(*keys, *OUTAGE_COLUMNS)
