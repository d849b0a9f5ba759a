"""Tables of an evaluation for the output of ``railfix evaluate``, for the report, and as files."""

from __future__ import annotations

import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import polars as pl

from railfix import __version__
from railfix.core.tables import Column, Table, count, listing, number, percent, signed
from railfix.evaluate.accuracy import FIGURE_COLUMNS, WITH_SATELLITES, WRONG_PLACE_M
from railfix.evaluate.epoch_table import EPOCH_COLUMNS
from railfix.evaluate.evaluation import Evaluation
from railfix.evaluate.integrity import BEYOND_COLUMNS, STANFORD_COLUMNS, Integrity
from railfix.evaluate.intervals import BRANCH_COLUMNS, INTERVAL_COLUMNS, LEVEL_COLUMNS, OUTAGE_COLUMNS
from railfix.run.output import OutputFolder

_NAMES: Final = {"constrained": "on the map", "constrained_ok": "on the map, ok", "conventional": "conventional"}
_POSITION: Final = pl.col("position").replace(_NAMES)
#: Name of the run; in rows that combine several runs, name of the configuration.
_OF: Final = pl.when(pl.col("run") != "all").then("run").otherwise("configuration").alias("of")
#: Groupings in the order of their tables, with captions.
_GROUPINGS: Final = {
    "configuration": "By configuration, runs combined",
    "line": "By line, runs of a configuration combined",
    "environment": "By environment",
    "speed": "By speed",
    "signals": "With and without satellites (tunnels and other outages)",
    "satellites": "By number of satellites used",
    "status": "By status",
    "section": "By section of the line",
}
_LEVELS_OF: Final = (
    "usable: levels without an alarm, of positions with status ok (filter: tracking or coasting), other levels count "
    "as infinite; all: every level"
)
_AVAILABLE: Final = (
    "available: fraction of all epochs, tunnels included; 15 s, 60 s: of the windows that begin at an available "
    "epoch, the fraction that stays available"
)


#: Names of the protection levels in tables, by column.
_LEVEL: Final = pl.col("level").replace(
    {
        "train_protection_level_m": "filter, along the line",
        "train_protection_level_ground_m": "filter, on the ground",
        "separation_protection_level_m": "single epochs, separation",
        "sbas_protection_level_m": "single epochs, sbas",
        "raim_level_m": "single epochs, raim",
    }
)


def _name_kind(kind: str) -> str:
    """Return the name that captions use for a kind of protection level."""
    return "filter along the track" if kind == "train" else f"single epochs, {kind}"


def _text(value: str) -> str:
    """Return a text unchanged; a column with this format is right-aligned, like a column of numbers."""
    return value


_POSITIONS: Final[Column] = ("position", "position", str)
_PLACE: Final = partial(number, digits=0, unit=" m")
_ERRORS: Final[Sequence[Column]] = (
    _POSITIONS,
    ("epochs", "counted", count),
    ("rate %", "rate", percent),
    ("of run %", "rate_of_run", percent),
    ("mean", "mean_m", signed),
    *((name, f"{name}_m", number) for name in ("std", "rms", "p50", "p95", "p99", "max")),
    ("at", "max_at_chainage_m", _PLACE),
    (f"over {WRONG_PLACE_M:g} m", "wrong_places", count),
    ("rms /sigma", "normalised_rms", number),
    ("p95 /sigma", "normalised_p95", number),
)
_LIMITS: Final[Sequence[Column]] = (
    _POSITIONS,
    ("blocks", "blocks", count),
    ("rate %", "rate_limits", _text),
    ("mean m", "mean_limits", _text),
    ("p95 m", "p95_limits", _text),
)
_INTERVALS: Final[Sequence[Column]] = (
    _POSITIONS,
    ("intervals", "intervals", count),
    ("standing", "standing", count),
    *((f"{name} m", f"interval_{name}_m", number) for name in ("p50", "p95", "max")),
    ("at", "interval_max_chainage_m", _PLACE),
    ("p95 s", "gap_p95_s", number),
    ("longest s", "gap_max_s", number),
)
_LEVELS: Final[Sequence[Column]] = (
    ("level", "level", str),
    _POSITIONS,
    ("positions", "positions", count),
    ("finite %", "level_share", percent),
    ("p50", "level_p50_m", number),
    ("p95", "level_p95_m", number),
    ("errors", "errors", count),
    ("over the level", "over_level", count),
)
_OUTAGES: Final[Sequence[Column]] = (
    ("begin", "begin_gpst", str),
    ("environment", "environment", str),
    ("positions by", "carried_by", str),
    ("duration s", "duration_s", partial(number, digits=1)),
    ("distance m", "travelled_m", count),
    ("rate %", "rate", percent),
    *((name, f"outage_{name}_m", number) for name in ("p50", "p95", "max")),
    ("error at end", "end_error_m", signed),
    ("sigma at end", "end_sigma_m", number),
    ("max /sigma", "largest_normalised", number),
)
_BRANCHES: Final[Sequence[Column]] = (
    ("probability", "probability", str),
    ("positions", "judged", count),
    ("stated %", "probability_mean", percent),
    ("right %", "right_share", percent),
    ("wrong", "wrong_places", count),
    ("blocks", "blocks", count),
    ("blocks with a wrong one", "wrong_blocks", count),
)
_STANFORD: Final[Sequence[Column]] = (
    ("levels", "levels_of", str),
    ("limit m", "limit", _text),
    ("epochs", "epochs", count),
    ("nominal", "nominal", count),
    ("misl.", "misleading", count),
    ("hazard.\nmisl.", "hazardously_misleading", count),
    ("unavail.", "unavailable", count),
    ("unavail.\nmisl.", "unavailable_misleading", count),
    ("not\njudged", "unjudged", count),
    ("no\nposition", "no_position", count),
    ("avail.\n%", "availability", percent),
    ("of\nobs. %", "availability_of_observed", percent),
    ("blocks\nbeyond", "beyond_blocks", count),
    ("15 s %", "continuity_15_s", percent),
    ("60 s %", "continuity_60_s", percent),
)


def select_evaluation(evaluation: Evaluation, name: str) -> Evaluation:
    """Return the part of an evaluation that concerns the run with the given name."""

    def own(rows: Any) -> Any:
        return rows if rows is None or "run" not in rows.columns else rows.filter(run=name)

    tables = ("figures", "intervals", "levels", "outages", "branches")
    return replace(
        evaluation,
        **{table: own(getattr(evaluation, table)) for table in tables},
        integrity={
            kind: replace(found, stanford=stanford, beyond=own(found.beyond))
            for kind, found in evaluation.integrity.items()
            if len(stanford := own(found.stanford))
        },
    )


def error_tables(evaluation: Evaluation) -> list[Table]:
    """Return the tables of error statistics, confidence limits, intervals, outages and branch probabilities."""
    overall, options = _together(evaluation.figures.filter(grouping="all")), evaluation.options
    paths = [run.path for run in evaluation.runs]
    again = [run.name for k, run in enumerate(evaluation.runs) if run.path in paths[:k]]
    # list conventional positions once, because they are the same in every table of a run
    new = (pl.col("position") != "conventional") | ~pl.col("run").is_in(again)
    overall = overall.filter(new | (pl.col("epochs_of") == "common"))
    caption = (
        "Errors along the line in metres, + toward its end; sigma: the stated standard deviation; epochs of both: "
        "epochs with a position on the map and a conventional position"
    )
    tables = [listing("figures-of-merit", _in_order(overall), [*_where(overall), *_ERRORS], caption)]
    if len(limited := overall.filter(pl.col("mean_low_m").is_not_null())):
        caption = (
            f"Confidence limits of {100 * options.confidence:g} %, from blocks of {options.block_s:g} s in "
            f"{options.replicates:,} bootstrap samples"
        )
        tables.append(listing("limits", _in_order(limited), [*_where(limited), *_LIMITS], caption))
    if len(intervals := evaluation.intervals):
        caption = "Distance travelled [m] and time [s] between consecutive positions"
        intervals = _pool_runs(intervals).filter(new)
        columns = [*_where(intervals), *_INTERVALS]
        tables.append(listing("intervals", intervals.with_columns(_POSITION, _OF), columns, caption))
    if evaluation.outages is not None and len(evaluation.outages):
        tables.append(outages(evaluation.outages))
    if (rows := evaluation.branches) is not None and len(rows):
        caption = f"Stated branch probability, and fraction of positions within {WRONG_PLACE_M:g} m of the reference"
        tables.append(listing("branches", rows.with_columns(_OF), [*_where(rows), *_BRANCHES], caption))
    return tables


def group_tables(evaluation: Evaluation) -> list[Table]:
    """Return one table of error statistics per grouping, for positions on the map and conventional positions.

    Groupings in which all epochs are in one trivial group are omitted.
    """
    tables, runs = [], evaluation.runs
    apart = len({run.configuration for run in runs}) == len(runs)
    for grouping, caption in _GROUPINGS.items():
        if apart and grouping in ("configuration", "line"):
            continue
        rows = evaluation.figures.filter(grouping=grouping, epochs_of="own")
        if grouping in ("environment", "speed"):
            rows = _pool_runs(rows)
        trivial = {"environment": "unknown", "signals": WITH_SATELLITES}.get(grouping)
        if len(rows) and rows["group"].unique().to_list() != [trivial]:
            tables.append(_group(grouping, rows, caption))
    return tables


def level_tables(evaluation: Evaluation, *, worst: int) -> list[Table]:
    """Return the tables of protection levels, their Stanford counts, and epochs whose error exceeds the level.

    For each kind of level, only the `worst` epochs with the largest excess are listed.
    """
    tables = []
    if (rows := evaluation.levels) is not None and len(rows):
        columns = [*_where(rows), *_LEVELS]
        caption = "Protection levels in metres, and errors above them"
        tables.append(listing("levels", rows.with_columns(_POSITION, _OF, _LEVEL), columns, caption))
    for kind, found in evaluation.integrity.items():
        overall = _pool_runs(found.stanford.filter(grouping="all"))
        caption = (
            f"Protection levels ({_name_kind(kind)}) against errors: epochs in each region of the Stanford diagram. "
        )
        tables.append(_stanford(f"stanford-{kind}", overall, f"{caption}{_LEVELS_OF}; {_AVAILABLE}"))
        by = _pool_runs(found.stanford.filter(pl.col("own_limit"), grouping="environment", levels_of="usable"))
        by = by.filter(antenna="all") if "all" in by["antenna"] else by
        if by["group"].n_unique() > 1:
            caption = "Usable protection levels against errors by environment, at the alarm limit of the run"
            tables.append(_stanford(f"stanford-{kind}-by-environment", by, caption, ("environment", "group", str)))
        tables.append(_beyond(found, kind, worst))
    return tables


def outages(rows: pl.DataFrame) -> Table:
    """Return the table of stretches without satellites (`OUTAGE_COLUMNS`) for output."""
    shown = rows.with_columns(
        _OF,
        pl.col("begin_gpst").dt.strftime("%H:%M:%S"),
        pl.col("carried_by").fill_null("").replace("", "dead reckoning"),
        rate=pl.col("positions") / pl.col("epochs"),
    )
    caption = "Stretches without satellites, with the errors of the filter along the track in metres"
    return listing("outages", shown, [*_where(rows), *_OUTAGES], caption)


def _where(rows: pl.DataFrame) -> list[Column]:
    """Return the columns of run and antenna for a table; the run is omitted if all rows are of a single run."""
    antenna: Column = ("antenna", "antenna", str)
    return [antenna] if rows["run"].n_unique() == 1 and "all" not in rows["run"] else [("run", "of", str), antenna]


def _pool_runs(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows that combine the runs of a configuration, or the rows by run if no configuration has several
    runs.
    """
    runs = rows.filter(pl.col("run") != "all")
    several = "all" in rows["run"] and runs["run"].n_unique() > runs["configuration"].n_unique()
    return rows.filter(run="all") if several else runs


def _together(rows: pl.DataFrame) -> pl.DataFrame:
    """If there are several runs, return only the rows that combine both antennas; otherwise return all rows."""
    several = rows["run"].n_unique() > 1 and "all" in rows["antenna"]
    return rows.filter(antenna="all") if several else rows


def _in_order(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the rows of each run and antenna in display order, with formatted confidence limits.

    Rows for common epochs are omitted where all kinds of position have the same number of positions.
    """
    order = {name: number for number, name in enumerate(_NAMES)}
    parts: Iterator[pl.DataFrame] = (
        mine.filter(epochs_of="own")
        if mine.filter(pl.col("position") != "constrained_ok")["positions"].n_unique() == 1
        else mine.with_columns(_order=pl.col("position").replace_strict(order))
        .sort("epochs_of", "_order", descending=[True, False])
        .drop("_order")
        for mine in rows.partition_by("run", "antenna", maintain_order=True)
    )
    common = pl.when(pl.col("epochs_of") == "common").then(pl.lit(", epochs of both")).otherwise(pl.lit(""))
    return pl.concat(parts).with_columns(
        _OF,
        _POSITION + common,
        counted=pl.when(pl.col("epochs_of") == "own").then("observed").otherwise("positions"),
        rate_limits=_range("rate_low", "rate_high", 100.0),
        mean_limits=_range("mean_low_m", "mean_high_m"),
        p95_limits=_range("p95_low_m", "p95_high_m"),
    )


def _range(low: str, high: str, scale: float = 1.0) -> pl.Expr:
    """Return the expression for an interval as text, "LOW to HIGH", multiplied by `scale`."""
    ends = (pl.col(name).mul(scale).map_elements(number, return_dtype=pl.String) for name in (low, high))
    return pl.concat_str(*ends, separator=" to ")


def _group(grouping: str, rows: pl.DataFrame, caption: str) -> Table:
    """Return the table of a grouping, with constrained and conventional positions of each group in one row."""
    keys = ["run", "configuration", "line", "antenna", "group"]
    left, right = (rows.filter(position=position) for position in ("constrained", "conventional"))
    both = left.join(right, on=keys, how="left", suffix="_conventional", maintain_order="left")
    both = both.filter(antenna="all") if "all" in both["antenna"] else both
    # epochs without satellites have no observations, so rates are fractions of all epochs
    counted, rate = ("epochs", "rate_of_run") if grouping == "signals" else ("observed", "rate")
    of = "epochs and rate: all epochs" if grouping == "signals" else "epochs and rate: only epochs with observations"
    columns: list[Column] = [*_where(both), ("group", "group", str), ("epochs", counted, count)]
    for conv, suffix in (("", ""), ("conv.\n", "_conventional")):
        columns += [(f"{conv}rate %", f"{rate}{suffix}", percent), (f"{conv}mean", f"mean_m{suffix}", signed)]
        columns += [(f"{conv}{name}", f"{name}_m{suffix}", number) for name in ("std", "p50", "p95", "max")]
    return listing(f"figures-by-{grouping}", both.with_columns(_OF), columns, f"{caption}; errors in metres; {of}")


def _stanford(name: str, rows: pl.DataFrame, caption: str, *first: Column) -> Table:
    """Return the table with the numbers of epochs in each region of the Stanford diagram.

    Rows at the alarm limit of the run are marked.
    """
    own = rows["own_limit"].to_list()
    limits = [f"{limit:g}{' (own)' if its else ''}" for limit, its in zip(rows["alarm_limit_m"], own, strict=True)]
    shown = rows.with_columns(_OF, pl.Series("limit", limits, dtype=pl.String))
    marked = [] if first else [k for k, its in enumerate(own) if its]
    # a table by environment counts only usable levels at the run's alarm limit
    columns = _STANFORD[2:] if first else _STANFORD
    return listing(name, shown, [*_where(rows), *first, *columns], caption, marked=marked)


def _beyond(found: Integrity, kind: str, worst: int) -> Table:
    """Return the table of the `worst` epochs with the largest excess of the error over the protection level."""
    beyond, usable = found.beyond, int(found.beyond["usable"].sum())
    parts = [pl.col(f"{kind}_{part}").map_elements(partial(number, digits=1), return_dtype=pl.String, skip_nulls=False)
             for part in ("fault_free_m", "one_fault_m", "two_faults_m")]  # fmt: skip
    shown = beyond.head(worst).with_columns(
        pl.col("time_gpst").dt.strftime("%Y-%m-%d %H:%M:%S%.3f"),
        pl.col(f"{kind}_cause", f"{kind}_status", "status").cast(pl.String).fill_null("not recorded"),
        usable=pl.when("usable").then(pl.lit("yes")).otherwise(pl.lit("no")),
        of="run",
        parts=pl.concat_str(*parts, separator=" / "),
    )
    columns: list[Column] = [
        ("GPS time", "time_gpst", str), *_where(beyond), ("environment", "environment", str),
        ("set by", f"{kind}_cause", str), ("verdict", f"{kind}_status", str), ("status", "status", str),
        ("usable", "usable", str), ("chainage m", "chainage_m", count), ("error m", "error_m", signed),
        ("level m", f"{kind}_level_m", number), ("no fault / one / two m", "parts", _text),
        ("satellites", "n_used", count),
    ]  # fmt: skip
    caption = f"Errors above the level ({_name_kind(kind)}): {len(beyond):,}, of which {usable:,} at a usable level"
    caption += f"; the {worst} largest excesses" if len(beyond) > worst else ""
    return listing(f"above-level-{kind}", shown, columns, caption)


#: Maximum number of epochs with an error above the protection level in ``evaluation.json``, where they are in
#: descending order of the excess. The CSV file has all these epochs.
MOST_BEYOND: Final = 200


def write_evaluation(evaluation: Evaluation, folder: OutputFolder) -> dict[str, Path]:
    """Write an evaluation and complete its output folder; return the path of each file.

    Raise OutputError if a file cannot be written. The files are:

    ==================== ============================================================================================
    evaluation.json      all statistics with their units, options, and inputs with their hashes
    errors.parquet       one row per epoch, antenna and run
    tables.csv           error statistics of every grouping, one row per group
    intervals.csv        distances and times between positions
    levels.csv           protection levels, if a run has any
    stanford_KIND.csv    epochs per region of the Stanford diagram; KIND: kind of level (sbas, separation, train)
    beyond_KIND.csv      epochs whose error exceeds the level
    outages.csv          stretches without satellites, if a table of the filter is evaluated
    branches.csv         stated branch probabilities and correctness of positions, if a filter table is evaluated
    ==================== ============================================================================================
    """
    folder.append_parquet("errors.parquet", evaluation.epochs)
    for name, (table, _) in _tables(evaluation).items():
        folder.append_csv("tables.csv" if name == "figures" else f"{name}.csv", table)
    folder.write_json("evaluation.json", as_record(evaluation))
    return folder.commit({"railfix": __version__, "runs": "; ".join(str(run.path) for run in evaluation.runs)})


def _tables(evaluation: Evaluation) -> dict[str, tuple[pl.DataFrame, Mapping[str, str]]]:
    """Return, by name, all tables except the table of epochs, each with the meaning of its columns."""
    tables: dict[str, tuple[pl.DataFrame | None, Mapping[str, str]]] = {
        "figures": (evaluation.figures, FIGURE_COLUMNS),
        "intervals": (evaluation.intervals, INTERVAL_COLUMNS),
        "outages": (evaluation.outages, OUTAGE_COLUMNS),
        "branches": (evaluation.branches, BRANCH_COLUMNS),
        "levels": (evaluation.levels, LEVEL_COLUMNS),
    }
    for kind, found in evaluation.integrity.items():
        beyond = {name.replace("KIND", kind): meaning for name, meaning in BEYOND_COLUMNS.items()}
        tables |= {f"stanford_{kind}": (found.stanford, STANFORD_COLUMNS), f"beyond_{kind}": (found.beyond, beyond)}
    return {name: (table, columns) for name, (table, columns) in tables.items() if table is not None}


def as_record(evaluation: Evaluation) -> dict[str, Any]:
    """Return the content of ``evaluation.json`` as values that JSON can represent, with None in place of NaN."""
    tables = _tables(evaluation)
    return {
        "versions": {"railfix": __version__, "python": platform.python_version(), "polars": pl.__version__},
        "command": list(sys.argv),
        "options": evaluation.options.model_dump(),
        "inputs": list(evaluation.inputs),
        "runs": [
            {**asdict(run), "path": str(run.path), "inputs": [entry["path"] for entry in run.inputs]}
            for run in evaluation.runs
        ],
        "units": "by the ending of the names: metres (_m), seconds (_s), metres per second (_mps); fractions are "
        "from 0 to 1",
        "columns": {name: tables[name][1] for name in ("figures", "intervals")}
        | {"epochs": EPOCH_COLUMNS}
        | {name: columns for name, (_, columns) in tables.items()},
        "beyond_counts": {kind: len(found.beyond) for kind, found in evaluation.integrity.items()},
        **{
            name: _rows(table.head(MOST_BEYOND) if name.startswith("beyond_") else table)
            for name, (table, _) in tables.items()
        },
    }


def _rows(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Return rows as dictionaries; times are ISO 8601 text to the nanosecond, and NaN is None."""
    times = [name for name, kind in table.schema.items() if kind == pl.Datetime("ns")]
    numbers = [name for name, kind in table.schema.items() if kind == pl.Float64]
    plain = table.with_columns(pl.col(times).dt.to_string("%Y-%m-%dT%H:%M:%S%.9f"), pl.col(numbers).fill_nan(None))
    return plain.to_dicts()
