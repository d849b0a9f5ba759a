"""Tables of a run: positioning intervals, outages, branch probabilities, protection levels, service by chainage."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from railfix.core.errors import MismatchError
from railfix.evaluate.accuracy import (
    AIDED,
    ALL,
    KEYS,
    POSITIONS,
    WRONG_PLACE_M,
    at_largest,
    edges_reached,
    has_position,
)
from railfix.evaluate.epoch_table import OF_FILTER, level_columns
from railfix.evaluate.evaluation_inputs import RunFolder, list_position_tables, read_run

#: Columns of the table of intervals in addition to its keys, with their unit and meaning.
INTERVAL_COLUMNS: Final[dict[str, str]] = {
    "position": "`constrained`, `constrained_ok` or `conventional`",
    "intervals": "number of pairs of consecutive positions between which the train moved",
    "standing": "number of pairs of consecutive positions between which the train did not move",
    **dict.fromkeys(
        (f"interval_{figure}_m" for figure in ("mean", "p50", "p95", "p99", "max")),
        "mean, percentile or maximum of the distance travelled between consecutive positions",
    ),
    "interval_max_from": "time of the position before the largest interval, GPS time",
    "interval_max_chainage_m": "chainage of the reference before the largest interval; empty in a gap of the reference",
    **dict.fromkeys(
        ("gap_p50_s", "gap_p95_s", "gap_max_s"), "percentile or maximum of the time between consecutive positions"
    ),
    "gap_max_from": "time of the position before the longest gap, GPS time",
    "before_first_s": "time from the first epoch with a reference to the first position",
    "after_last_s": "time from the last position to the last epoch with a reference",
}
_OF: Final = ("run", "antenna")


def interval_table(epochs: pl.DataFrame, by: list[str]) -> pl.DataFrame:
    """Return the distribution of the intervals between positions of each kind (`INTERVAL_COLUMNS`), grouped by `by`.

    Intervals are between positions of the same run and antenna.
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
        .select(*keys, "time_gpst", "chainage_m", "moved_m", has=has_position(position))
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


#: Stretches without satellites are listed in the table if they last at least this time [s].
LEAST_S: Final = 2.0

#: Columns of the table of stretches without satellites in addition to its keys, with their unit and meaning.
OUTAGE_COLUMNS: Final[dict[str, str]] = {
    "begin_gpst": "first epoch without a used satellite, GPS time",
    "duration_s": "time from the last epoch with a used satellite to the last epoch without a used satellite",
    "travelled_m": "distance travelled in the stretch, computed from the reference",
    "environment": "environment in the middle of the stretch, from the reference or from the sections",
    "carried_by": "measurements that the filter used within the stretch",
    "epochs": "number of epochs of the stretch",
    "positions": "number of epochs of the stretch with a position",
    **dict.fromkeys(("outage_p50_m", "outage_p95_m", "outage_max_m"), "percentile or maximum of the error magnitude"),
    "end_error_m": "error of the last position with an accurate reference",
    "end_sigma_m": "stated standard deviation of the last position with an accurate reference",
    "largest_normalised": "largest magnitude of error / along_sigma_m",
}
_OUTAGE_COLUMNS: Final = (
    "time_gpst", "observed", "n_used", "in_reference", "reference_good", "positioned", "moved_m", "environment",
    "sources", "error_m", "along_sigma_m", "branch_probability",
)  # fmt: skip


def outage_table(epochs: pl.DataFrame) -> pl.DataFrame | None:
    """Return the stretches without satellites (`OUTAGE_COLUMNS`), with the errors of the filter, in order of time.

    Stretches shorter than `LEAST_S` are omitted. Return None if there is no table of the filter.
    """
    filtered = epochs.select(*KEYS, *_OUTAGE_COLUMNS).filter(OF_FILTER)
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
        duration_s=_seconds(pl.col("time_gpst").last() - first),
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


#: Limits of the classes of the branch probability.
_EDGES: Final = (0.0, 0.5, 0.9, 0.99, 0.999, 1.0)

_BRANCH_COLUMNS: Final = ("in_reference", "reference_good", "positioned", "branch_probability", "distance_m", "block")

#: Columns of the table of branch probabilities, with unit and meaning; the columns of antenna and class are not
#: included.
BRANCH_COLUMNS: Final[dict[str, str]] = {
    "probability": "class of the stated probability of the branch; `all` for every epoch",
    "judged": "number of positions of the class whose error is known",
    "probability_mean": "mean of the stated probabilities",
    "right_share": "fraction of the positions within 50 m of the reference",
    "wrong_places": "number of positions farther than 50 m from the reference",
    "blocks": "number of time blocks with an epoch of the class",
    "wrong_blocks": "number of time blocks with a position of the class farther than 50 m from the reference",
}


def branch_table(epochs: pl.DataFrame) -> pl.DataFrame | None:
    """Return the stated probability of the branch and the fraction of correct positions, by class of probability.

    The table has `BRANCH_COLUMNS`. Return None if there is no table of the filter.
    """
    filtered = epochs.select(*KEYS, *_BRANCH_COLUMNS).filter(OF_FILTER)
    if not len(filtered):
        return None
    judged = filtered.filter("in_reference", "reference_good", "positioned")
    names = [f"{low:g} to {high:g}" for low, high in pairwise(_EDGES)]
    rank = edges_reached(pl.col("branch_probability"), _EDGES[1:-1])
    wrong = pl.col("distance_m") > WRONG_PLACE_M
    figures = [
        pl.len().cast(pl.Int64).alias("judged"),
        pl.col("branch_probability").mean().alias("probability_mean"),
        (1.0 - wrong.mean()).alias("right_share"),
        wrong.sum().cast(pl.Int64).alias("wrong_places"),
        pl.col("block").n_unique().cast(pl.Int64).alias("blocks"),
        pl.col("block").filter(wrong).n_unique().cast(pl.Int64).alias("wrong_blocks"),
    ]
    ranked = pl.concat([judged.with_columns(rank=rank), judged.with_columns(rank=pl.lit(len(names), pl.Int64))])
    table = ranked.group_by([*KEYS, "rank"], maintain_order=True).agg(figures)
    table = table.with_columns(probability=pl.col("rank").replace_strict(dict(enumerate([*names, ALL]))))
    return table.sort(*KEYS, "rank", maintain_order=True).select(*KEYS, *BRANCH_COLUMNS)


#: Columns of the table of protection levels in addition to its keys, with their unit and meaning.
LEVEL_COLUMNS: Final[dict[str, str]] = {
    "level": "column of the level",
    "position": "`constrained` or `constrained_ok`",
    "observed": "number of epochs with observations and reference",
    "positions": "number of epochs with a position",
    "infinite": "number of positions with an infinite protection level",
    "with_level": "number of positions with a finite protection level",
    "level_share": "fraction of the `observed` epochs that have a finite protection level",
    "level_p50_m": "median of the finite protection levels",
    "level_p95_m": "95th percentile of the finite protection levels",
    "errors": "number of positions with a finite protection level and a known error",
    "over_level": "number of errors above a finite protection level",
    "over_level_share": "over_level / errors",
}


def level_table(epochs: pl.DataFrame, by: list[str]) -> pl.DataFrame | None:
    """Return counts and percentiles of the protection levels of each kind (`LEVEL_COLUMNS`), grouped by columns `by`.

    Return None if no run has a protection level.
    """
    tables = []
    for level in level_columns(epochs):
        if epochs[level].null_count() == len(epochs):
            continue
        # runs without this kind of level have no row; the filter's table, for example, has no single-epoch level
        columns = ("run", *by, "status", "observed", "in_reference", "reference_good", "positioned", "error_m", level)
        spanned = epochs.select(*dict.fromkeys(columns)).filter(
            "in_reference", pl.col(level).is_not_null().any().over("run")
        )
        for position in ("constrained", "constrained_ok"):
            has = has_position(position)
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


#: Statuses of the filter with which its protection level is used; with other statuses, the level counts as infinite.
_SOUND: Final = ("tracking", "coasting")
_POSITION_COLUMNS: Final = ("n_used", "n_rejected", "conventional_offset_m")
#: Columns of the table of positioning quality by stretch of line; percentiles are over the epochs of the stretch.
COLUMNS: Final = (
    "from_m", "to_m", "runs", "epochs", "satellites_median", "satellites_p5", "rejected_share", "reflection_p95_m",
    "ok_share", "tracking_share", "level_median_m", "level_p95_m", "within_limit_share",
)  # fmt: skip


def compute_service(folders: Sequence[Path], *, stretch_m: float = 100.0, limit_m: float = 20.0) -> pl.DataFrame:
    """Compute the quality of positioning (`COLUMNS`) by stretches of the line, over all antennas and runs.

    `stretch_m` is the length of a stretch, and `limit_m` is the alarm limit [m]. The chainage of an epoch is taken from
    the filter, else from the single-epoch position, else interpolated between the neighbouring epochs with a position.
    The protection level is infinite if the filter is neither tracking nor coasting, and null for runs without the
    filter. Raise MismatchError if the runs are on different maps, or no epoch has a position.
    """
    runs = [read_run(folder) for folder in folders]
    first = runs[0].track_facts
    for folder, run in zip(folders, runs, strict=True):
        if (run.line_name, run.track_facts.get("length_m")) != (runs[0].line_name, first.get("length_m")):
            raise MismatchError(
                f"{folder}: the line is {run.line_name!r} ({run.track_facts.get('length_m')} m), but the line of "
                f"{folders[0]} is {runs[0].line_name!r} ({first.get('length_m')} m); give runs on one map"
            )
    parts = [_epochs(folder, run, number) for number, (folder, run) in enumerate(zip(folders, runs, strict=True))]
    epochs = pl.concat(parts, how="vertical").filter(pl.col("chainage_m").is_not_null())
    if not len(epochs):
        raise MismatchError(f"{folders[0]}: no epoch of the runs has a position on the line")
    sound = pl.col("filter_status").is_in(_SOUND)
    stretch = (pl.col("chainage_m") / stretch_m).floor()
    return (
        epochs.with_columns(
            level=pl.when(sound).then(pl.col("level_m")).when(pl.col("filter_status").is_not_null()).then(np.inf)
        )
        .group_by((stretch * stretch_m).alias("from_m"))
        .agg(
            (stretch.first() * stretch_m + stretch_m).alias("to_m"),
            pl.col("run").n_unique().alias("runs"),
            pl.len().alias("epochs"),
            pl.col("n_used").median().alias("satellites_median"),
            pl.col("n_used").quantile(0.05).alias("satellites_p5"),
            (pl.col("n_rejected").sum() / (pl.col("n_rejected") + pl.col("n_used")).sum()).alias("rejected_share"),
            pl.col("conventional_offset_m").quantile(0.95).alias("reflection_p95_m"),
            (pl.col("status") == "ok").mean().alias("ok_share"),
            sound.mean().alias("tracking_share"),
            pl.col("level").quantile(0.5, "higher").alias("level_median_m"),
            pl.col("level").quantile(0.95, "higher").alias("level_p95_m"),
            (pl.col("level") <= limit_m).mean().alias("within_limit_share"),
        )
        .select(COLUMNS)
        .sort("from_m")
    )


def _epochs(folder: Path, run: RunFolder, number: int) -> pl.DataFrame:
    """Return the epochs of one run with chainage and with the filter's status and level, which are null without a
    filter.
    """
    single = run.positions.select(
        "time_gpst", "antenna", "chainage_m", pl.col("status").cast(pl.String),
        *(pl.col(name).cast(pl.Float64) for name in _POSITION_COLUMNS),
    )  # fmt: skip
    if "train" in list_position_tables(folder):
        train = read_run(folder, table="train").positions
        tracked = train.select(
            "time_gpst", "antenna", pl.col("chainage_m").alias("filter_m"),
            pl.col("status").cast(pl.String).alias("filter_status"),
            pl.col("protection_level_m").cast(pl.Float64).alias("level_m"),
        )  # fmt: skip
        single = single.join(tracked, on=["time_gpst", "antenna"], how="left")
    else:
        empty = {"filter_m": pl.Float64, "filter_status": pl.String, "level_m": pl.Float64}
        single = single.with_columns(pl.lit(None, dtype=kind).alias(name) for name, kind in empty.items())
    place = pl.coalesce(pl.col("filter_m").fill_nan(None), pl.col("chainage_m").fill_nan(None))
    return (
        single.sort("antenna", "time_gpst")
        .with_columns(place.interpolate().forward_fill().backward_fill().over("antenna").alias("chainage_m"))
        .with_columns(pl.lit(number).alias("run"))
        .drop("filter_m")
    )
