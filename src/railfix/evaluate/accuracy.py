"""Error statistics of constrained and conventional positions by group of epochs, with confidence limits.

The position errors of a train are correlated over tens of seconds, so that epochs are not independent samples.
Confidence limits are therefore computed by resampling blocks of one minute, which are nearly independent.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import nan
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Integers, Masks
from railfix.core.reasons import Status
from railfix.evaluate.evaluation_inputs import EvaluationOptions, floats

#: A position counts as wrong if its error, or its distance from the reference, exceeds this value [m].
WRONG_PLACE_M = 50.0
#: The fraction of errors whose magnitude exceeds each of these values is reported [m].
OVER_M: Final = (5, 10, 20, 50)


@dataclass(frozen=True, kw_only=True)
class Score:
    """Availability and error statistics of a run; statistics in metres are NaN if there is no position."""

    epochs: int  #: Number of epochs with observations within the time span of the reference.
    positions: int  #: Number of these epochs at which the position, and therefore the error, is known.
    rate: float  #: positions / epochs.
    mean_m: float  #: Mean of the signed error.
    std_m: float  #: Population standard deviation of the signed error.
    p50_m: float  #: Median of the error magnitude.
    p95_m: float  #: 95th percentile of the error magnitude.
    max_m: float  #: Largest error magnitude.
    wrong_place: float  #: Fraction of the positions with an error above `WRONG_PLACE_M`.


def score(error_m: Floats, observed: Masks) -> Score:
    """Compute the statistics of signed errors at the `observed` epochs.

    `error_m` has shape (T,) and is NaN at epochs without a position. Raise ValueError if no epoch is observed.
    """
    if not observed.any():
        raise ValueError("no epoch with observations lies within the time span of the reference")
    values = error_m[observed & np.isfinite(error_m)]
    size = np.abs(values) if len(values) else np.array([np.nan])
    return Score(
        epochs=int(observed.sum()),
        positions=len(values),
        rate=len(values) / int(observed.sum()),
        mean_m=float(values.mean()) if len(values) else float("nan"),
        std_m=float(values.std()) if len(values) else float("nan"),
        p50_m=float(np.median(size)),
        p95_m=float(np.percentile(size, 95)),
        max_m=float(size.max()),
        wrong_place=float(np.mean(size > WRONG_PLACE_M)),
    )


#: Lower edges of the classes of epochs by number of used satellites.
_SATELLITE_EDGES: Final = (4, 5, 6, 7, 8, 10, 12, 15, 20)
#: Confidence limits are computed only from at least this number of time blocks.
FEWEST_BLOCKS: Final = 5
#: Number of nodes in one step of the search for a percentile. The errors up to each node are counted.
_NODES: Final = 400


#: Column names of the statistics that have confidence limits; {} is replaced by "_low", "_high" or "". The last two
#: statistics are percentiles of |error| / sigma.
LIMITS: Final = ("mean{}_m", "rate{}", "p95{}_m", "normalised_p68{}", "normalised_p95{}")
LIMIT_COLUMNS: Final = tuple(name.format(end) for name in LIMITS for end in ("_low", "_high"))


def block_limits(
    error_m: Floats,
    sigma_m: Floats,
    observed: Masks,
    positioned: Masks,
    block: Integers,
    *,
    replicates: int,
    seed: int,
    confidence: float,
) -> dict[str, float]:
    """Compute the confidence limits (`LIMIT_COLUMNS`) by a block bootstrap; return them with the number of blocks.

    Errors, sigmas, the masks and the block numbers have shape (T,). Blocks are drawn with replacement for each of
    `replicates` resamples. The limits are NaN with fewer than `FEWEST_BLOCKS` blocks.
    """
    names, member = np.unique(block, return_inverse=True)
    blocks = len(names)
    if blocks < FEWEST_BLOCKS:
        return {"blocks": blocks, **dict.fromkeys(LIMIT_COLUMNS, nan)}
    drawn = np.random.default_rng(seed).integers(0, blocks, (replicates, blocks))
    times = np.zeros((replicates, blocks))
    np.add.at(times, (np.arange(replicates)[:, None], drawn), 1.0)
    has = np.isfinite(error_m)

    def sums(values: Floats) -> Floats:
        return times @ np.bincount(member, weights=values, minlength=blocks)

    errors = sums(has.astype(np.float64))
    tail = 50.0 * (1.0 - confidence)

    def limits(values: Floats) -> tuple[float, float]:
        values = values[np.isfinite(values)]
        if not len(values):
            return nan, nan
        low, high = np.percentile(values, [tail, 100.0 - tail])
        return float(low), float(high)

    def of_percentile(values: Floats, share: float) -> tuple[float, float]:
        known = np.isfinite(values)
        counts = sums(known.astype(np.float64))
        return limits(_percentiles(values[known], member[known], times, counts, share=share))

    with np.errstate(invalid="ignore", divide="ignore"):
        mean = sums(np.where(has, error_m, 0.0)) / errors
        rate = sums((positioned & observed).astype(np.float64)) / sums(observed.astype(np.float64))
    size = np.abs(error_m)
    ends = (
        *limits(mean),
        *limits(rate),
        *of_percentile(size, 0.95),
        *of_percentile(size / sigma_m, 0.68),
        *of_percentile(size / sigma_m, 0.95),
    )
    return {"blocks": blocks, **dict(zip(LIMIT_COLUMNS, ends, strict=True))}


def _percentiles(size: Floats, member: Integers, times: Floats, errors: Floats, *, share: float) -> Floats:
    """Compute the percentile of each resample, shape (replicates,), by counting values up to nodes of ever finer grids.

    `size` and the block numbers `member` have shape (T,). `times`, shape (replicates, blocks), states how often each
    block is in a resample. `errors` is the number of values of each resample; the result is NaN for a resample without
    values.
    """
    found = np.full(len(times), np.nan)
    drawn = errors > 0
    if not drawn.any():
        return found
    values, rank = np.unique(size, return_inverse=True)
    # without the tolerance, rounding could make the 20th of 20 errors the 95th percentile, instead of the 19th
    wanted = (share * errors[drawn] - 1e-9)[:, None]
    low, high, most = 0, len(values) - 1, _NODES
    while True:
        nodes = np.unique(np.linspace(low, high, min(high - low + 1, most)).round().astype(np.int64))
        here = rank <= high
        cell = member[here] * len(nodes) + np.searchsorted(nodes, rank[here])
        counts = np.bincount(cell, minlength=times.shape[1] * len(nodes)).reshape(-1, len(nodes))
        at = np.argmax(times[drawn] @ np.cumsum(counts, axis=1).astype(np.float64) >= wanted, axis=1)
        if len(nodes) == high - low + 1:
            found[drawn] = values[nodes[at]]
            return found
        before = high - low
        low, high = int(nodes[at.min() - 1]) + 1 if at.min() > 0 else low, int(nodes[at.max()])
        if high - low > before // 2:
            most = high - low + 1


#: Kinds of position: computed with the map; computed with the map, with every check passed; 3-D single point moved to
#: the nearest point of the line.
POSITIONS: Final = ("constrained", "constrained_ok", "conventional")
#: First columns of every table, which identify the run and antenna of a row.
KEYS: Final = ("run", "configuration", "line", "antenna")
#: Groupings for which confidence limits are computed.
WITH_LIMITS: Final = ("all", "section", "environment", "speed", "configuration", "line")
#: Data type of the columns of names during grouping, because these columns have many rows and few distinct names.
WORDS: Final = pl.Categorical()
#: Name of the group of all epochs; also the entry in ``antenna``, ``run`` or ``line`` of rows that combine several
#: antennas, runs or lines.
ALL: Final = "all"
#: The groups of the grouping ``signals``: epochs at which the single-epoch solution used at least one satellite, and
#: all other epochs.
WITH_SATELLITES: Final = "with satellites"
WITHOUT_SATELLITES: Final = "without satellites"
AIDED: Final = pl.col("observed") & (pl.col("n_used").fill_null(0) > 0)

#: Columns of the table of error statistics, with the meaning of each.
FIGURE_COLUMNS: Final[dict[str, str]] = {
    "grouping": "grouping of the epochs: `all`, `section`, `environment`, `speed`, `satellites`, `signals` (with or "
    "without a satellite used), `status`; with several runs also `configuration` and `line`",
    "group": "name of the group",
    "run": "name of the run; `all` where several runs are combined",
    "configuration": "settings of the run",
    "line": "name of the track",
    "antenna": "`front` or `rear`; `all` where both are combined",
    "position": "`constrained`: positions computed with the map; `constrained_ok`: those that passed every check; "
    "`conventional`: 3-D single points at the nearest point of the line",
    "epochs_of": "`own`: all positions of this kind; `common`: only positions at epochs with both a constrained and a "
    "conventional position",
    "epochs": "number of epochs with a reference, including epochs missing in the log",
    "observed": "number of epochs with a reference and observations",
    "positions": "number of epochs with a reference and a position",
    "left_out": "number of positions whose error is unknown because the reference is not accurate enough",
    "errors": "number of positions whose error is known",
    "rate": "fraction of the `observed` epochs that have a position",
    "rate_of_run": "fraction of the `epochs` that have a position",
    "mean_m": "mean error, + toward the end of the line",
    "std_m": "population standard deviation of the error",
    "rms_m": "root mean square error",
    **dict.fromkeys(("p50_m", "p95_m", "p99_m", "max_m"), "percentile or maximum of the error magnitude"),
    "lowest_m": "most negative error (toward the start of the line)",
    "highest_m": "most positive error (toward the end of the line)",
    "max_at_time": "GPS time of the largest error magnitude",
    "max_at_chainage_m": "chainage of the reference at the time of the largest error magnitude",
    **dict.fromkeys((f"over_{limit}_m" for limit in OVER_M), "fraction of errors above this magnitude"),
    "wrong_places": "number of errors above 50 m",
    "reference_sigma_p50_m": "median standard deviation of the reference",
    "along_sigma_p50_m": "median of the standard deviation along the line, as stated by the run",
    **dict.fromkeys(
        ("distance_p50_m", "distance_p95_m", "distance_max_m"),
        "percentile or maximum of the straight distance (3-D) from the position computed with the map to the reference",
    ),
    **dict.fromkeys(("normalised_mean", "normalised_rms"), "mean or root mean square of error / along_sigma"),
    **dict.fromkeys(("normalised_p68", "normalised_p95"), "percentile of the magnitude of error / along_sigma"),
    **dict.fromkeys((f"over_{n}_sigma" for n in (1, 2, 3)), "fraction of errors above this multiple of along_sigma"),
    "blocks": "number of time blocks from which the confidence limits are computed",
    **dict.fromkeys(LIMIT_COLUMNS, "lower (`_low`) or upper (`_high`) confidence limit"),
}
#: Statuses of positions that passed every check: `ok` for single epochs, `tracking` for the filter along the track.
PASSED: Final[tuple[str, ...]] = (Status.OK.text, "tracking")
#: Columns of the epoch table that are required to compute error statistics, in addition to `KEYS`.
USED: Final = (
    "time_gpst", "status", "observed", "in_reference", "reference_good", "chainage_m", "speed_mps", "environment",
    "reference_sigma_m", "n_used", "positioned", "conventional_positioned",
    "error_m", "conventional_error_m", "distance_m", "along_sigma_m", "block",
)  # fmt: skip


def classify_epochs(epochs: pl.DataFrame, options: EvaluationOptions) -> pl.DataFrame:
    """Return the epochs that the reference covers, with the name and the rank of their group in every grouping.

    For the grouping ``section``, for example, these are the columns ``section_group`` and ``section_rank``. Tables are
    sorted by rank.
    """
    section = (pl.col("chainage_m") / options.section_m).floor().cast(pl.Int64)
    speed, used = pl.col("speed_mps") * 3.6, pl.col("n_used")
    edges = options.speed_edges_kmh
    speed_rank = pl.when(pl.col("speed_mps") < options.standing_mps).then(0).otherwise(edges_reached(speed, edges) + 1)
    ranks = dict.fromkeys(("all", "environment", "configuration", "line"), pl.lit(0)) | {
        "section": section,
        "speed": pl.when(pl.col("speed_mps").is_null()).then(len(edges) + 2).otherwise(speed_rank),
        "satellites": pl.when(used.is_null()).then(-1).otherwise(edges_reached(used, _SATELLITE_EDGES)),
        "signals": pl.when(AIDED).then(0).otherwise(1),
        "status": pl.col("status").replace_strict({s.text: int(s) for s in Status}, default=len(Status)),
    }
    begins = section * options.section_m
    names = {name: pl.col(name) for name in ("environment", "status", "configuration", "line")} | {
        "all": pl.lit(ALL),
        "section": pl.format("{} to {} m", *(_plain(x) for x in (begins, begins + options.section_m))),
        "speed": pl.col("speed_rank").replace_strict(dict(enumerate(_speed_names(options)))),
        "satellites": pl.col("satellites_rank").replace_strict(dict(enumerate(_satellite_names(), start=-1))),
        "signals": pl.when(AIDED).then(pl.lit(WITH_SATELLITES)).otherwise(pl.lit(WITHOUT_SATELLITES)),
    }
    inside = epochs.filter("in_reference")
    ranked = inside.with_columns(rank.cast(pl.Int32).alias(f"{name}_rank") for name, rank in ranks.items())
    return ranked.with_columns(
        pl.col(KEYS).cast(WORDS),
        *(expression.cast(pl.String).cast(WORDS).alias(f"{name}_group") for name, expression in names.items()),
    )


def edges_reached(value: pl.Expr, edges: Sequence[float]) -> pl.Expr:
    """Return the expression for the number of edges that a value reaches or exceeds."""
    return pl.sum_horizontal((value >= float(edge)).cast(pl.Int64) for edge in edges)


def _plain(value: pl.Expr) -> pl.Expr:
    """Return the expression for numbers as text; whole numbers are written without decimals."""
    return pl.when(value == value.round()).then(value.cast(pl.Int64).cast(pl.String)).otherwise(value.cast(pl.String))


def _speed_names(options: EvaluationOptions) -> list[str]:
    edges = options.speed_edges_kmh
    between = [f"{low:g} to {high:g} km/h" for low, high in pairwise(edges)]
    return ["standing", f"under {edges[0]:g} km/h", *between, f"over {edges[-1]:g} km/h", "unknown"]


def _satellite_names() -> list[str]:
    edges = _SATELLITE_EDGES
    between = [f"{low}" if high == low + 1 else f"{low} to {high - 1}" for low, high in pairwise(edges)]
    return ["unknown", f"under {edges[0]}", *between, f"{edges[-1]} and more"]


def has_position(position: str) -> pl.Expr:
    """Return the expression for epochs with a position of the given kind, one of `POSITIONS`."""
    if position == "conventional":
        return pl.col("conventional_positioned")
    if position == "constrained_ok":
        return pl.col("positioned") & pl.col("status").is_in(PASSED)
    return pl.col("positioned")


def series(epochs: pl.DataFrame, position: str, epochs_of: str) -> pl.DataFrame:
    """Return the epochs with the columns from which the statistics of one kind of position are computed.

    ``has`` is true for epochs with a position. ``error``, ``size`` (error magnitude) and ``normalised`` (error / sigma)
    are null without a position, or if the reference is not accurate enough. ``sigma`` and ``distance`` are null for
    conventional positions.
    """
    conventional = position == "conventional"
    column = "conventional_error_m" if conventional else "error_m"
    has = has_position(position)
    if epochs_of == "common":
        has &= pl.col("positioned") & pl.col("conventional_positioned")
    unknown = pl.lit(None, pl.Float64)
    good = has & pl.col("reference_good")
    return (
        epochs.with_columns(
            has=has,
            error=pl.when(good).then(pl.col(column)),
            distance=unknown if conventional else pl.when(good).then(pl.col("distance_m")),
            sigma=unknown if conventional else pl.col("along_sigma_m"),
        )
        .with_columns(size=pl.col("error").abs(), normalised=pl.col("error") / pl.col("sigma"))
        .with_columns(position=pl.lit(position), epochs_of=pl.lit(epochs_of))
    )


def figures_by(parts: Iterable[pl.DataFrame], groupings: Sequence[str], options: EvaluationOptions) -> pl.DataFrame:
    """Return error statistics (`FIGURE_COLUMNS`), one row per group, antenna, kind of position and choice of epochs."""
    kinds = [(position, "own") for position in POSITIONS] + [("constrained", "common"), ("conventional", "common")]
    tables: dict[str, list[list[pl.DataFrame]]] = {grouping: [[] for _ in kinds] for grouping in groupings}
    for epochs in parts:
        ranked = classify_epochs(epochs, options)
        for kind, (position, epochs_of) in enumerate(kinds):
            part = series(ranked, position, epochs_of)
            for grouping in groupings:
                by = [*KEYS, f"{grouping}_rank", f"{grouping}_group"]
                table = part.group_by(by, maintain_order=True).agg(_figures())
                limited = epochs_of == "own" and grouping in WITH_LIMITS
                tables[grouping][kind].append(_with_limits(table, part if limited else None, by, options))
    whole = {grouping: pl.concat([table for kind in found for table in kind]) for grouping, found in tables.items()}
    return pl.concat([_order(table, grouping) for grouping, table in whole.items()], how="vertical")


def _order(table: pl.DataFrame, grouping: str) -> pl.DataFrame:
    """Return the table of one grouping sorted by its groups, with the columns `FIGURE_COLUMNS`."""
    rank, group = f"{grouping}_rank", f"{grouping}_group"
    words = [pl.col(name).cast(pl.String) for name in KEYS]
    named = table.with_columns(*words, grouping=pl.lit(grouping), group=pl.col(group).cast(pl.String))
    return named.sort(rank, "group", maintain_order=True).select(*FIGURE_COLUMNS)


def at_largest(column: str, by: str) -> pl.Expr:
    """Return the value of `column` in the first row where `by` is largest; null if all values of `by` are null."""
    return pl.col(column).get(pl.col(by).arg_max())


def _figures() -> list[pl.Expr]:
    """Return the expressions of all statistics of a group of rows of `series`."""
    error, size, has = pl.col("error"), pl.col("size"), pl.col("has")
    good = error.is_not_null()
    observed, positions = pl.col("observed").sum(), has.sum()
    sigmas = pl.col("normalised").abs()
    return [
        pl.col("position").first(),
        pl.col("epochs_of").first(),
        pl.len().cast(pl.Int64).alias("epochs"),
        observed.cast(pl.Int64).alias("observed"),
        positions.cast(pl.Int64).alias("positions"),
        (has & ~pl.col("reference_good")).sum().cast(pl.Int64).alias("left_out"),
        error.count().cast(pl.Int64).alias("errors"),
        pl.when(observed > 0).then((has & pl.col("observed")).sum() / observed).alias("rate"),
        (positions / pl.len()).alias("rate_of_run"),
        error.mean().alias("mean_m"),
        error.std(ddof=0).alias("std_m"),
        (error**2).mean().sqrt().alias("rms_m"),
        *(size.quantile(q / 100, "linear").alias(f"p{q}_m") for q in (50, 95, 99)),
        size.max().alias("max_m"),
        error.min().alias("lowest_m"),
        error.max().alias("highest_m"),
        at_largest("time_gpst", "size").alias("max_at_time"),
        at_largest("chainage_m", "size").alias("max_at_chainage_m"),
        *((size > limit).mean().alias(f"over_{limit}_m") for limit in OVER_M),
        (size > WRONG_PLACE_M).sum().cast(pl.Int64).alias("wrong_places"),
        pl.col("reference_sigma_m").filter(good).median().alias("reference_sigma_p50_m"),
        pl.col("sigma").filter(good).median().alias("along_sigma_p50_m"),
        *(pl.col("distance").quantile(q / 100, "linear").alias(f"distance_p{q}_m") for q in (50, 95)),
        pl.col("distance").max().alias("distance_max_m"),
        pl.col("normalised").mean().alias("normalised_mean"),
        (pl.col("normalised") ** 2).mean().sqrt().alias("normalised_rms"),
        *(sigmas.quantile(q / 100, "linear").alias(f"normalised_p{q}") for q in (68, 95)),
        *((sigmas > n).mean().alias(f"over_{n}_sigma") for n in (1, 2, 3)),
    ]


def _with_limits(
    table: pl.DataFrame, part: pl.DataFrame | None, by: Sequence[str], options: EvaluationOptions
) -> pl.DataFrame:
    """Return the table with additional columns of confidence limits, computed from the epochs `part`.

    The limits are null if there is no `part`, or if they are undefined.
    """
    schema = {"blocks": pl.Int64} | dict.fromkeys(LIMIT_COLUMNS, pl.Float64)
    if part is None:
        return table.with_columns(pl.lit(None, kind).alias(name) for name, kind in schema.items())
    kept = part.select(*by, "error", "sigma", "observed", "has", "block")
    groups = kept.partition_by(by, as_dict=True, maintain_order=True, include_key=False)
    rows = [
        block_limits(
            floats(groups[key], "error"),
            floats(groups[key], "sigma"),
            *(groups[key][name].to_numpy() for name in ("observed", "has", "block")),
            replicates=options.replicates,
            seed=options.seed,
            confidence=options.confidence,
        )
        for key in table.select(by).iter_rows()
    ]
    return table.hstack(pl.DataFrame(rows, schema=schema).with_columns(pl.col(LIMIT_COLUMNS).fill_nan(None)))
