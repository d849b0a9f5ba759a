"""An evaluation as files."""

from __future__ import annotations

import platform
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import polars as pl

from railfix import __version__
from railfix.evaluate.epochs import EPOCH_COLUMNS
from railfix.evaluate.evaluation import Evaluation
from railfix.evaluate.figures import FIGURE_COLUMNS
from railfix.evaluate.integrity import BEYOND_COLUMNS, STANFORD_COLUMNS
from railfix.evaluate.intervals import BRANCH_COLUMNS, INTERVAL_COLUMNS, LEVEL_COLUMNS, OUTAGE_COLUMNS
from railfix.run.output import OutputFolder

#: What P1 found (3.3, table 4; 5, figures 10 to 12), for comparison where it is asked for.
P1_TABLE_4: Final = (
    {"configuration": "GPS only", "rate": 0.9909, "mean_m": 2.14, "std_m": 1.98},
    {"configuration": "GPS+QZS", "rate": 0.9915, "mean_m": 1.97, "std_m": 1.99},
    {"configuration": "L1-SAIF corrections", "rate": 0.9641, "mean_m": 0.88, "std_m": 1.83},
)
P1_COMMERCIAL: Final = (
    {"position": "conventional", "rate": 0.867, "max_m": 65.8},
    {"position": "constrained, all screens", "rate": 0.846, "max_m": 10.2},
)
_FILTER_COLUMNS: Final = {"outages": OUTAGE_COLUMNS, "branches": BRANCH_COLUMNS}
#: Epochs beyond their level in ``evaluation.json``, the worst; the CSV file has all.
MOST_BEYOND: Final = 200


def write_evaluation(evaluation: Evaluation, folder: OutputFolder) -> dict[str, Path]:
    """Write an evaluation and commit the folder.

    ==================== ================================================================
    evaluation.json      all figures with their units, options, inputs with their hashes
    errors.parquet       one row an epoch, antenna and run
    tables.csv           figures of every grouping, long form
    intervals.csv        distances and times between positions
    levels.csv           protection levels, where a run has any
    stanford_KIND.csv    levels against errors, counted; KIND is what the levels rest on (sbas, separation)
    beyond_KIND.csv      epochs whose error is over the level
    outages.csv          stretches without satellites, where a table of the filter is evaluated
    branches.csv         stated probabilities of the place against its correctness, the same
    ==================== ================================================================

    Returns
    -------
    dict of str to Path
        Where each file stands.

    Raises
    ------
    OutputError
        A file cannot be written.
    """
    folder.append_parquet("errors.parquet", evaluation.epochs)
    folder.append_csv("tables.csv", evaluation.figures)
    folder.append_csv("intervals.csv", evaluation.intervals)
    if evaluation.levels is not None:
        folder.append_csv("levels.csv", evaluation.levels)
    for name, table in _of_filter(evaluation).items():
        folder.append_csv(f"{name}.csv", table)
    for kind, found in evaluation.integrity.items():
        folder.append_csv(f"stanford_{kind}.csv", found.stanford)
        folder.append_csv(f"beyond_{kind}.csv", found.beyond)
    folder.write_json("evaluation.json", as_record(evaluation))
    return folder.commit({"railfix": __version__, "runs": "; ".join(str(run.path) for run in evaluation.runs)})


def _of_filter(evaluation: Evaluation) -> dict[str, pl.DataFrame]:
    """Tables of the filter along the track by name; empty without one."""
    tables = {"outages": evaluation.outages, "branches": evaluation.branches}
    return {name: table for name, table in tables.items() if table is not None}


def as_record(evaluation: Evaluation) -> dict[str, Any]:
    """Everything that ``evaluation.json`` says, as plain values; NaN as None."""
    tables = {"figures": evaluation.figures, "intervals": evaluation.intervals, **_of_filter(evaluation)}
    columns = {"figures": FIGURE_COLUMNS, "intervals": INTERVAL_COLUMNS, "epochs": EPOCH_COLUMNS}
    columns |= {name: _FILTER_COLUMNS[name] for name in _of_filter(evaluation)}
    if evaluation.levels is not None:
        tables["levels"] = evaluation.levels
        columns["levels"] = LEVEL_COLUMNS
    for kind, found in evaluation.integrity.items():
        tables |= {f"stanford_{kind}": found.stanford, f"beyond_{kind}": found.beyond.head(MOST_BEYOND)}
        columns[f"stanford_{kind}"] = STANFORD_COLUMNS
        columns[f"beyond_{kind}"] = {name.replace("KIND", kind): meaning for name, meaning in BEYOND_COLUMNS.items()}
    return {
        "versions": {"railfix": __version__, "python": platform.python_version(), "polars": pl.__version__},
        "command": list(sys.argv),
        "options": evaluation.options.model_dump(),
        "inputs": list(evaluation.inputs),
        "runs": [
            {**asdict(run), "path": str(run.path), "inputs": [entry["path"] for entry in run.inputs]}
            for run in evaluation.runs
        ],
        "units": "metres, seconds, metres a second as the names end (_m, _s, _mps); shares are parts of 1",
        "columns": columns,
        "beyond_counts": {kind: len(found.beyond) for kind, found in evaluation.integrity.items()},
        **{name: _rows(table) for name, table in tables.items()},
    }


def _rows(table: pl.DataFrame) -> list[dict[str, Any]]:
    """Rows as plain values, times as ISO text to the nanosecond."""
    times = [name for name, kind in table.schema.items() if kind == pl.Datetime("ns")]
    numbers = [name for name, kind in table.schema.items() if kind == pl.Float64]
    plain = table.with_columns(pl.col(times).dt.to_string("%Y-%m-%dT%H:%M:%S%.9f"), pl.col(numbers).fill_nan(None))
    return plain.to_dicts()
