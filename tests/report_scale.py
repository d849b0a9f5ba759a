"""Size and opening time of a report on a long run: the demonstration, its tables laid end to end.

    python tests/report_scale.py [--epochs 100000] [--keep FOLDER]

Prints epochs, rows, size of the page, time to write it, and what the browser says of opening it: from
the request to the end of loading, and to the first pictures drawn.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import polars as pl

from railfix.report import write_report
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_inputs, demo_truth
from report_page import browser, opened, timing_ms


def laid_end_to_end(table: pl.DataFrame, times: int, span: pl.Expr) -> pl.DataFrame:
    """A table so many times over, each later than the one before by a span."""
    return pl.concat([table.with_columns(pl.col("time_gpst") + k * span) for k in range(times)])


def long_run(folder: Path, epochs: int) -> tuple[Path, Path]:
    """A run of so many epochs an antenna, and its reference."""
    short = folder / "short"
    run_files(demo_inputs(), out=short, options=RunOptions(observations="write", chunk_epochs=500))
    whole = folder / "long"
    whole.mkdir()
    positions = pl.read_parquet(short / "positions.parquet")
    each = positions["time_gpst"].n_unique()
    times = -(-epochs // each)
    step = positions["time_gpst"].unique().sort().diff().median()
    span = pl.lit(positions["time_gpst"].max() - positions["time_gpst"].min() + step)  # type: ignore[operator]
    for name in ("positions.parquet", "observations.parquet"):
        laid_end_to_end(pl.read_parquet(short / name), times, span).write_parquet(whole / name)
    truth = pl.read_csv(demo_truth(), schema_overrides={"time_gpst": pl.Datetime("ns")})
    laid_end_to_end(truth, times, span).write_csv(folder / "truth.csv", datetime_format="%Y-%m-%dT%H:%M:%S%.9f")
    record = json.loads((short / "run.json").read_text(encoding="utf-8"))
    (whole / "run.json").write_text(json.dumps(record), encoding="utf-8")
    return whole, folder / "truth.csv"


def main() -> None:
    """Make the run, write the report, open it five times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=100_000, help="epochs of each antenna")
    parser.add_argument("--keep", type=Path, help="folder to leave the page in")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        run, truth = long_run(Path(place), arguments.epochs)
        began = time.perf_counter()
        page = write_report([run], (arguments.keep or Path(place)) / "report.html", references=[truth])
        took = time.perf_counter() - began
        rows = {name: pl.scan_parquet(run / f"{name}.parquet").select(pl.len()).collect().item() for name in
                ("positions", "observations")}  # fmt: skip
        print(f"{rows['positions']:,} rows of positions, {rows['observations']:,} of observations")
        print(f"written in {took:.1f} s, {page.stat().st_size / 1e6:.2f} MB")
        if browser() is None:
            sys.exit("no chromium here: the opening time is not measured")
        tries = [timing_ms(opened(page)) for _ in range(5)]
        for name, what in (("load", "loaded"), ("drawn", "first pictures drawn")):
            values = [found[name] for found in tries]
            print(f"{what} after {median(values):.0f} ms (median of 5; {min(values):.0f} to {max(values):.0f})")


if __name__ == "__main__":
    main()
