"""Where satellites can serve on a line: satellites, reflections, statuses and levels of runs by chainage."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
import polars as pl

from railfix.core.errors import MismatchError
from railfix.evaluate.run_folder import RunFolder, read_run, tables_of

#: Statuses of the filter with a place that has a level.
_SOUND: Final = ("tracking", "coasting")
_POSITION_COLUMNS: Final = ("n_used", "n_rejected", "conventional_offset_m")
#: Columns of the table by stretch; percentiles are over epochs.
COLUMNS: Final = (
    "from_m", "to_m", "runs", "epochs", "satellites_median", "satellites_p5", "rejected_share", "reflection_p95_m",
    "ok_share", "tracking_share", "level_median_m", "level_p95_m", "within_limit_share",
)  # fmt: skip


def compute_service(folders: Sequence[Path], *, stretch_m: float = 100.0, limit_m: float = 20.0) -> pl.DataFrame:
    """Compute what satellites gave by stretches of the line, over all antennas of several runs on one map.

    Epochs without a position of their own stand where the filter has the train, else where the epochs about them lie.
    Returns `COLUMNS`, in order of the chainage, without stretches that no run has passed. `rejected_share`: of the
    satellites; `reflection_p95_m`: distance of the 3-D position from the line; `ok_share`: single epochs with the
    status ok; `tracking_share` and levels: of the filter, infinite where it has none; null without a filter.
    MismatchError: the runs are on different maps.
    """
    runs = [read_run(folder) for folder in folders]
    first = runs[0].track_facts
    for folder, run in zip(folders, runs, strict=True):
        if (run.line_name, run.track_facts.get("length_m")) != (runs[0].line_name, first.get("length_m")):
            raise MismatchError(
                f"{folder}: is a run on {run.line_name!r} of {run.track_facts.get('length_m')} m, {folders[0]} one on "
                f"{runs[0].line_name!r} of {first.get('length_m')} m; give runs on one map"
            )
    parts = [_epochs(folder, run, number) for number, (folder, run) in enumerate(zip(folders, runs, strict=True))]
    epochs = pl.concat(parts, how="vertical").filter(pl.col("chainage_m").is_not_null())
    if not len(epochs):
        raise MismatchError(f"{folders[0]}: no epoch of the runs has a place on the line")
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
    """Epochs of one run with their chainage, of its single epochs and of the filter where it has one."""
    single = run.positions.select(
        "time_gpst", "antenna", "chainage_m", pl.col("status").cast(pl.String),
        *(pl.col(name).cast(pl.Float64) for name in _POSITION_COLUMNS),
    )  # fmt: skip
    if "train" in tables_of(folder):
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
