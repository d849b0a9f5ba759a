"""Comparison of protection levels with errors: Stanford counts, availability, continuity, errors above the level.

Epochs are counted with two choices of protection levels. `usable`: a level is used if the status of the position is ok
(filter: tracking or coasting) and the level raises no alarm; any other position has an infinite level. `all`: every
level is used, whatever its status.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import polars as pl

from railfix.core.arrays import Floats, Masks, Strings
from railfix.evaluate.accuracy import ALL, KEYS, PASSED
from railfix.evaluate.evaluation_inputs import WINDOWS_S, EvaluationOptions, floats, words
from railfix.integrity.stanford import Region, Stanford, stanford

LevelsOf = Literal["usable", "all"]

#: Choices of the protection levels that are compared with errors, as defined in the docstring of this module.
LEVELS_OF: Final[tuple[LevelsOf, ...]] = ("usable", "all")
#: Names, without the prefix "protection_", of the columns with the parts of a protection level.
PARTS: Final[tuple[str, ...]] = ("fault_free_m", "one_fault_m", "two_faults_m")
#: Names, without the prefix "protection_", of the columns with the cause and the status of a protection level.
STATED: Final[tuple[str, ...]] = ("cause", "status")
_ALARM: Final = "alarm"
#: Columns of the table of epochs that a Stanford diagram requires, in addition to the protection level and its status.
_JUDGED: Final = ("time_gpst", "status", "in_reference", "reference_good", "positioned", "error_m")
#: Statuses of positions whose protection level bounds the error, including positions of a coasting filter.
_BOUNDED: Final = (*PASSED, "coasting")
_REGIONS: Final = {
    Region.NOMINAL: "nominal",
    Region.MISLEADING: "misleading",
    Region.HAZARDOUS: "hazardously_misleading",
    Region.UNAVAILABLE: "unavailable",
    Region.UNAVAILABLE_MISLEADING: "unavailable_misleading",
    Region.UNJUDGED: "unjudged",
    Region.NO_POSITION: "no_position",
}

#: Columns of the table of Stanford counts in addition to `KEYS`, with their meaning.
STANFORD_COLUMNS: Final[dict[str, str]] = {
    "grouping": "`all` or `environment`",
    "group": "name of the group",
    "levels_of": "`usable`: levels without an alarm, of positions with status ok (filter: tracking, coasting); all "
    "other levels count as infinite; `all`: every level",
    "alarm_limit_m": "alarm limit AL",
    "own_limit": "whether this is the alarm limit of the run",
    "epochs": "number of epochs with a reference, including epochs missing in the log",
    "observed": "number of these epochs with observations",
    "judged": "number of these epochs at which the error is known",
    "nominal": "epochs with error <= level <= AL",
    "misleading": "epochs with level < error <= AL",
    "hazardously_misleading": "epochs with level <= AL < error",
    "unavailable": "epochs with AL < level and error <= level",
    "unavailable_misleading": "epochs with AL < level < error",
    "unjudged": "epochs with a protection level, but without a sufficiently accurate reference",
    "no_position": "epochs with neither a protection level nor a known error",
    "available": "epochs with a level within AL, whether or not the error is known",
    "availability": "available / epochs",
    "availability_of_observed": "fraction of the `observed` epochs that have a level within AL",
    "beyond": "errors above a finite protection level; the number is the same at every AL",
    "beyond_share": "beyond / judged",
    "beyond_blocks": "time blocks (60 s) with an error above a finite protection level",
    "windows_15_s": "windows of 15 s that begin at an available epoch",
    "kept_15_s": "windows of 15 s in which every epoch is available",
    "continuity_15_s": "kept_15_s / windows_15_s; not computed by environment",
    **dict.fromkeys(("windows_60_s", "kept_60_s", "continuity_60_s"), "as for 15 s, but with windows of 60 s"),
}

#: Columns of the list of epochs whose error exceeds the level, with unit and meaning; KIND is the kind of level.
BEYOND_COLUMNS: Final[dict[str, str]] = {
    "run": "name of the run",
    "time_gpst": "time tag of the receiver, GPS time",
    "antenna": "`front` or `rear`",
    "chainage_m": "chainage of the reference",
    "environment": "environment stated by the reference, else by the sections, else `unknown`",
    "error_m": "error of the position computed with the map, + toward the end of the line",
    "KIND_level_m": "protection level",
    **dict.fromkeys(("KIND_fault_free_m", "KIND_one_fault_m", "KIND_two_faults_m"), "part of the level"),
    "KIND_cause": "cause of the level",
    "KIND_status": "status of the level",
    "status": "status of the epoch",
    "n_used": "number of satellites used",
    "usable": "whether the level was usable, so that the position is misleading information",
}


#: Kind of a run's protection levels (the prefix of their columns), and the run's alarm limit [m]; None without a limit.
Level = tuple[str, float | None]


@dataclass(frozen=True, kw_only=True)
class Integrity:
    """Comparison of the protection levels of one kind with the errors."""

    stanford: pl.DataFrame  #: Counts of epochs: `railfix.evaluate.accuracy.KEYS`, then `STANFORD_COLUMNS`.
    beyond: pl.DataFrame  #: Epochs whose error exceeds the level: `BEYOND_COLUMNS`, the largest excess first.


def level_name(kind: str) -> str:
    """Return the name of the column of the epoch table with the protection levels of the given kind."""
    return f"{kind}_protection_level_m"


def effective_levels(level_m: Floats, has: Masks, status: Strings, verdict: Strings, *, levels_of: LevelsOf) -> Floats:
    """Return the protection levels that are compared with errors, shape (T,) [m].

    A level is infinite if it is missing, or if it is not usable and `levels_of` is "usable". It is NaN at epochs
    without a position, where the mask `has` is false. `status` is the status of the position, and `verdict` is the
    status of the protection level.
    """
    bound = np.where(np.isnan(level_m), np.inf, level_m)
    if levels_of == "usable":
        bound = np.where(_usable(status, verdict), bound, np.inf)
    return np.where(has, bound, np.nan)


def _usable(status: Strings, verdict: Strings) -> Masks:
    return np.asarray(np.isin(status, _BOUNDED) & (verdict != _ALARM))


def epochs_diagram(
    epochs: pl.DataFrame, kind: str, *, alarm_limit_m: float, levels_of: LevelsOf, options: EvaluationOptions
) -> Stanford:
    """Return the Stanford diagram of the epochs of one antenna (`EPOCH_COLUMNS`) that the reference covers."""
    columns = (level_name(kind), f"{kind}_protection_status")
    spanned = epochs.select(*_JUDGED, *(name for name in columns if name in epochs.columns)).filter("in_reference")
    return _sort(spanned, *_judge(spanned, kind, levels_of), alarm_limit_m, options)


def _judge(spanned: pl.DataFrame, kind: str, levels_of: LevelsOf) -> tuple[Floats, Floats]:
    """Return the errors and `effective_levels` of epochs within the reference, shape (T,) each [m].

    The error is NaN if there is no position, or no sufficiently accurate reference.
    """
    has = spanned["positioned"].to_numpy()
    error = np.where(has & spanned["reference_good"].to_numpy(), floats(spanned, "error_m"), np.nan)
    level = effective_levels(
        floats(spanned, level_name(kind)),
        has,
        words(spanned, "status"),
        words(spanned, f"{kind}_protection_status"),
        levels_of=levels_of,
    )
    return error, level


def positions_diagram(
    positions: pl.DataFrame, *, alarm_limit_m: float, levels_of: LevelsOf, options: EvaluationOptions
) -> Stanford:
    """Return the Stanford diagram of one antenna's epochs (`POSITION_COLUMNS`) without a reference.

    Since the errors are unknown, the diagram has only availability and continuity.
    """
    level = effective_levels(
        floats(positions, "protection_level_m"),
        np.isfinite(floats(positions, "chainage_m")),
        words(positions, "status"),
        words(positions, "protection_status"),
        levels_of=levels_of,
    )
    return _sort(positions, np.full(len(positions), np.nan), level, alarm_limit_m, options)


def _sort(
    table: pl.DataFrame, error_m: Floats, level_m: Floats, alarm_limit_m: float, options: EvaluationOptions
) -> Stanford:
    return stanford(
        table["time_gpst"].to_numpy().astype("datetime64[ns]"),
        error_m,
        level_m,
        alarm_limit_m=alarm_limit_m,
        windows_s=WINDOWS_S,
        block_s=options.block_s,
    )


def judge_levels(epochs: pl.DataFrame, runs: Mapping[str, Level], options: EvaluationOptions) -> dict[str, Integrity]:
    """Compare the protection levels of all runs with the errors at all alarm limits.

    Return the comparison by kind of protection level; empty if no run has protection levels.
    """
    own = {limit for _, limit in runs.values() if limit is not None}
    limits = sorted({*options.alarm_limits_m, *own})
    by_kind = {}
    for kind in dict.fromkeys(kind for kind, _ in runs.values()):
        mine = [name for name, (of_run, _) in runs.items() if of_run == kind]
        rows: list[dict[str, Any]] = []
        needed = (*_JUDGED, level_name(kind), f"{kind}_protection_status")
        slim = epochs.select(*KEYS, "environment", "observed", *(name for name in needed if name in epochs.columns))
        for name in mine:
            for part in slim.filter(pl.col("run") == name).partition_by("antenna", maintain_order=True):
                rows += _count(part, runs[name], limits, options)
        by_kind[kind] = Integrity(stanford=_pool(rows), beyond=_beyond(epochs, mine, kind))
    return by_kind


def _count(
    part: pl.DataFrame, of_run: Level, limits: Sequence[float], options: EvaluationOptions
) -> Iterator[dict[str, Any]]:
    """Yield the counts of one antenna of a run at each alarm limit: all epochs first, then each environment."""
    kind, own_limit = of_run
    keys = dict(zip(KEYS, part.select(KEYS).row(0), strict=True))
    part = part.filter("in_reference")
    groups = [(ALL, ALL, part)]
    environments = part.partition_by("environment", maintain_order=True)
    groups += [("environment", str(mine["environment"][0]), mine) for mine in environments]
    for grouping, group, spanned in groups:
        observed = spanned["observed"].to_numpy()
        for levels_of in LEVELS_OF:
            error, level = _judge(spanned, kind, levels_of)
            for limit in limits:
                diagram = _sort(spanned, error, level, limit, options)
                regions = {name: diagram.counts[region] for region, name in _REGIONS.items()}
                row = {
                    **keys,
                    "grouping": grouping,
                    "group": group,
                    "levels_of": levels_of,
                    "alarm_limit_m": limit,
                    "own_limit": limit == own_limit,
                    "epochs": len(spanned),
                    "observed": int(observed.sum()),
                    "judged": int(diagram.histogram.sum()),
                    **regions,
                    "available": round(diagram.available_rate * len(spanned)),
                    "available_observed": int(np.count_nonzero(observed & (level <= limit))),
                    "beyond": len(diagram.beyond),
                    "beyond_blocks": diagram.misleading_blocks,
                }
                for window in diagram.continuity:
                    row |= {
                        f"windows_{window.window_s:g}_s": window.windows,
                        f"kept_{window.window_s:g}_s": window.kept,
                    }
                yield row


def _pool(rows: list[dict[str, Any]]) -> pl.DataFrame:
    """Return the counts and fractions as a table, with sums over both antennas and over a configuration's runs."""
    parts = [pl.DataFrame(rows, schema_overrides={"alarm_limit_m": pl.Float64})]
    if parts[0]["antenna"].n_unique() > 1:
        parts.append(parts[0].with_columns(antenna=pl.lit(ALL)))
    if parts[0]["run"].n_unique() > 1:
        parts += [part.with_columns(run=pl.lit(ALL), line=pl.lit(ALL)) for part in parts]
    named = [*KEYS, "grouping", "group", "levels_of", "alarm_limit_m"]
    counts = [name for name in parts[0].columns if name not in named and name != "own_limit"]
    sums = pl.concat(parts).group_by(named, maintain_order=True).agg(pl.col("own_limit").all(), pl.col(counts).sum())
    windows = [f"{name}_{window:g}_s" for window in WINDOWS_S for name in ("windows", "kept")]
    sums = sums.with_columns(pl.when(pl.col("grouping") == ALL).then(pl.col(name)).alias(name) for name in windows)
    shares = {
        "availability": ("available", "epochs"),
        "availability_of_observed": ("available_observed", "observed"),
        "beyond_share": ("beyond", "judged"),
        **{f"continuity_{window:g}_s": (f"kept_{window:g}_s", f"windows_{window:g}_s") for window in WINDOWS_S},
    }
    sums = sums.with_columns(
        pl.when(pl.col(below) > 0).then(pl.col(above) / pl.col(below)).alias(name)
        for name, (above, below) in shares.items()
    )
    return sums.select(*KEYS, *STANFORD_COLUMNS)


def _beyond(epochs: pl.DataFrame, runs: Sequence[str], kind: str) -> pl.DataFrame:
    """Return the epochs of the given runs whose error exceeds a finite level, the largest excess first."""
    level = pl.col(level_name(kind))
    columns = {name: f"{kind}_protection_{name}" for name in (*PARTS, *STATED)}
    absent = [name for name in columns.values() if name not in epochs.columns]
    blank = [pl.lit(None, pl.Float64 if name.endswith("_m") else pl.String).alias(name) for name in absent]
    over = epochs.with_columns(blank).filter(
        "in_reference",
        "reference_good",
        "positioned",
        pl.col("run").is_in(runs) & level.is_finite() & (pl.col("error_m").abs() > level),
    )
    excess = pl.col("error_m").abs() - level
    verdict = pl.Series("usable", _usable(words(over, "status"), words(over, columns["status"])))
    named = {f"{kind}_{name}": pl.col(column) for name, column in columns.items()}
    listed = over.with_columns(verdict, level.alias(f"{kind}_level_m"), **named)
    return listed.sort(excess, descending=True, maintain_order=True).select(
        name.replace("KIND", kind) for name in BEYOND_COLUMNS
    )
