"""Size and opening time of a report on a long run: the demonstration, its tables laid end to end.

    python tests/studies/report_scale.py [--epochs 100000] [--keep FOLDER] [--run RUN REFERENCE]

Prints rows, size of the page and of its print, time and memory to write it, and the time to open it in a browser: from
the request to the end of loading, and to the first charts drawn.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median

import polars as pl

import paths  # noqa: F401
from railfix.pipeline.config import Config
from railfix.run import RunOptions, run_files
from railfix.simulate.demonstration import demo_inputs, demo_truth
from report_page import browser, opened, run_browser, timing_ms


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


def written(run: Path, truth: Path, page: Path) -> tuple[float, float, float]:
    """Time of `railfix report` [s], its largest resident memory, and that without pages of files [MB]."""
    words = ["report", str(run), "--reference", str(truth), "--out", str(page), "--overwrite"]
    began, peak_kb, own_kb = time.perf_counter(), 0, 0
    with subprocess.Popen([sys.executable, "-m", "railfix", *words], stdout=subprocess.DEVNULL) as process:
        status = Path(f"/proc/{process.pid}/status")
        while process.poll() is None:
            values = dict(line.split(":", 1) for line in status.read_text().splitlines())
            if "VmHWM" in values:
                peak_kb = max(peak_kb, int(values["VmHWM"].split()[0]))
                own_kb = max(own_kb, int(values["RssAnon"].split()[0]))
            time.sleep(0.02)
    if process.returncode:
        raise SystemExit(process.returncode)
    return time.perf_counter() - began, peak_kb / 1024, own_kb / 1024


def main() -> None:
    """Make the run, write the report, open it five times."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=100_000, help="epochs of each antenna")
    parser.add_argument("--keep", type=Path, help="folder to leave the page in")
    parser.add_argument("--run", nargs=2, type=Path, metavar=("RUN", "REFERENCE"), help="these in place of new ones")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        run, truth = arguments.run or long_run(Path(place), arguments.epochs)
        page = (arguments.keep or Path(place)) / "report.html"
        took, peak, own = written(run, truth, page)
        rows = {name: pl.scan_parquet(run / f"{name}.parquet").select(pl.len()).collect().item() for name in
                ("positions", "observations")}  # fmt: skip
        print(f"{rows['positions']:,} rows of positions, {rows['observations']:,} of observations")
        memory = f"{peak:.0f} MB of memory ({own:.0f} without pages of files)"
        print(f"written in {took:.1f} s with {memory}, {page.stat().st_size / 1e6:.2f} MB")
        if browser() is not None:
            paper = Path(place) / "report.pdf"
            run_browser(page, f"--print-to-pdf={paper}")
            print(f"printed: {paper.stat().st_size / 1e6:.2f} MB")
        if browser() is None:
            sys.exit("no chromium here: the opening time is not measured")
        tries = [timing_ms(opened(page)) for _ in range(5)]
        for name, what in (("load", "loaded"), ("drawn", "first pictures drawn")):
            values = [found[name] for found in tries]
            print(f"{what} after {median(values):.0f} ms (median of 5; {min(values):.0f} to {max(values):.0f})")


if __name__ == "__main__":
    main()
