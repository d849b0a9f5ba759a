"""Errors and levels of the filter in simulated streets: ``python tests/studies/city_score.py FIRST LAST``.

Runs of 20 minutes of the shipped scenario ``city``, seeds FIRST to LAST, two antennas, 1 Hz or ``--rate``; other
options go to ``railfix run`` (``--set tracking.level=off`` to do without levels). A line for each antenna with an error
beyond 10 m where the status says that the place is known, or over its level.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import polars as pl

LARGE_M = 10.0
KNOWN = ("tracking", "coasting")


def made(folder: Path, seed: int, rate_hz: float, options: list[str]) -> pl.DataFrame:
    """Rows of the filter beside the true chainage."""

    def railfix(*words: str) -> None:
        command = [sys.executable, "-m", "railfix", *words]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    railfix("simulate", "city", "--out", str(folder), "--seed", str(seed), "--set", f"rate_hz={rate_hz}", "--plain")
    files = ("front.rnx", "rear.rnx", "nav.rnx", "track.csv", "vehicle.toml")
    given = [word for file in files for word in (f"--{Path(file).stem}", str(folder / file))]
    railfix("run", *given, "--out", str(folder / "run"), *options)
    truth = pl.read_csv(folder / "truth.csv", columns=["time_gpst", "antenna", "chainage_m"], try_parse_dates=True)
    found = pl.read_parquet(folder / "run" / "train.parquet").with_columns(pl.col("antenna").cast(pl.String))
    keys = [pl.col("time_gpst").cast(pl.Datetime("ms")), pl.col("antenna")]
    return found.with_columns(keys).join(truth.with_columns(keys), on=["time_gpst", "antenna"], suffix="_true")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    parser.add_argument("--rate", type=float, default=1.0)
    given, options = parser.parse_known_args()
    sizes, ratios, levels, large, beyond = [], [], [], 0, 0
    for seed in range(given.first, given.last + 1):
        with tempfile.TemporaryDirectory(prefix="railfix-city-") as name:
            rows = made(Path(name) / "run", seed, given.rate, options)
        for antenna, own in rows.group_by("antenna", maintain_order=True):
            error = (own["chainage_m"] - own["chainage_m_true"]).abs().to_numpy()
            known = own["status"].cast(pl.String).is_in(KNOWN).to_numpy()
            sizes.append(error[known])
            ratios.append((error / own["along_sigma_m"].to_numpy())[known])
            over = np.count_nonzero(sizes[-1] > LARGE_M)
            large += over
            level = own["protection_level_m"].to_numpy()
            bounded = np.isfinite(level)
            levels.append(level[bounded])
            misled = np.count_nonzero(error[bounded] > level[bounded])
            beyond += misled
            if misled:
                print(f"seed {seed}, {antenna[0]}: {misled} epochs over their level")
            if over:
                print(f"seed {seed}, {antenna[0]}: {over} epochs over {LARGE_M:g} m, largest {sizes[-1].max():.1f} m")
    error, ratio = np.concatenate(sizes), np.concatenate(ratios)
    at = "p50 {:.2f}, p95 {:.2f}, p99 {:.2f}, largest {:.1f}"
    print(f"{len(error)} epochs with a known place, {large} over {LARGE_M:g} m")
    print(f"error [m]: {at.format(*np.percentile(error, [50, 95, 99, 100]))}")
    print(f"error over sigma: {at.format(*np.percentile(ratio, [50, 95, 99, 100]))}")
    level = np.concatenate(levels)
    if len(level):
        print(
            f"{len(level)} levels, {beyond} errors over them; {at.format(*np.percentile(level, [50, 95, 99, 100]))} m"
        )


if __name__ == "__main__":
    main()
