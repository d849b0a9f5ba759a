"""A long run for reports: the demonstration, its tables laid end to end."""

from __future__ import annotations

import json
from pathlib import Path

import polars as pl

from railfix.pipeline.config import Config
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_inputs, demo_truth


def laid_end_to_end(table: pl.DataFrame, times: int, span: pl.Expr) -> pl.DataFrame:
    """A table so many times over, each later than the one before by a span."""
    return pl.concat([table.with_columns(pl.col("time_gpst") + k * span) for k in range(times)])


def long_run(folder: Path, epochs: int) -> tuple[Path, Path]:
    """A run of so many epochs an antenna, and its reference."""
    short = folder / "short"
    options = RunOptions(observations="write", chunk_epochs=500)
    run_files(demo_inputs(), Config(filter="track"), out=short, options=options)
    whole = folder / "long"
    whole.mkdir()
    positions = pl.read_parquet(short / "positions.parquet")
    each = positions["time_gpst"].n_unique()
    times = -(-epochs // each)
    step = positions["time_gpst"].unique().sort().diff().median()
    span = pl.lit(positions["time_gpst"].max() - positions["time_gpst"].min() + step)  # type: ignore[operator]
    for name in ("positions.parquet", "train.parquet", "observations.parquet"):
        laid_end_to_end(pl.read_parquet(short / name), times, span).write_parquet(whole / name)
    truth = pl.read_csv(demo_truth(), schema_overrides={"time_gpst": pl.Datetime("ns")})
    laid_end_to_end(truth, times, span).write_csv(folder / "truth.csv", datetime_format="%Y-%m-%dT%H:%M:%S%.9f")
    record = json.loads((short / "run.json").read_text(encoding="utf-8"))
    (whole / "run.json").write_text(json.dumps(record), encoding="utf-8")
    return whole, folder / "truth.csv"
