"""Figures of a simulated run beside the requirements of OCORA: ``localisation_requirements.py RUN SIMULATED``.

``railfix simulate commercial-run --set rate_hz=1.0 --out SIMULATED``, then ``railfix run --out RUN`` with all its
files. The front antenna along the track (train.parquet) is compared with the ground truth.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import polars as pl

SLOW_MPS = 30.0 / 3.6


def lines(run: Path, simulated: Path) -> list[str]:
    """Return a line for each requirement, by its number."""
    found = pl.read_parquet(run / "train.parquet").filter(pl.col("antenna") == "front")
    truth = pl.read_csv(simulated / "truth.csv.gz").filter(pl.col("antenna") == "front")
    place, speed, acceleration, level = (
        found[name].cast(pl.Float64).to_numpy()
        for name in ("chainage_m", "speed_mps", "acceleration_mps2", "protection_level_m")
    )
    true_place, true_speed, true_acceleration = (
        truth[name].to_numpy() for name in ("chainage_m", "speed_mps", "acceleration_mps2")
    )
    error, bounded, slow = np.abs(place - true_place), np.isfinite(level), np.abs(true_speed) < SLOW_MPS
    way, rise = np.diff(place), np.diff(np.where(bounded, place - level, np.nan))  # toward rising chainage
    both = np.isfinite(rise)
    wide = np.maximum(30.0, np.abs(true_speed))
    return [
        f"7239: level within max(30 m, 1 s) {np.mean(level <= wide):.1%}, 10 m {np.mean(level <= 10.0):.1%} of epochs",
        f"7240: error {np.nanpercentile(error, 95.4):.2f} m (95.4 %)",
        f"7241: below 30 km/h error {np.nanpercentile(error[slow], 99.98):.2f} m (99.98 %), level within 1 m "
        f"{np.mean(level[slow] <= 1.0):.1%}",
        f"7244: least safe place rises by more than the way at {np.mean(rise[both] > way[both] + 1e-3):.1%}",
        f"7248: speed {3.6 * np.percentile(np.abs(np.abs(speed) - np.abs(true_speed)), 95.4):.2f} km/h (95.4 %)",
        f"7252: acceleration {np.percentile(np.abs(acceleration - true_acceleration), 95.4):.2f} m/s2 (95.4 %)",
        f"7230: first level at epoch {np.flatnonzero(bounded)[0] + 1}",
        f"7.4.3.6: with a level {np.mean(bounded):.1%}; over it {np.count_nonzero(error[bounded] > level[bounded])}",
    ]


if __name__ == "__main__":
    print(*lines(*map(Path, sys.argv[1:])), sep="\n")
