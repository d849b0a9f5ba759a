"""Slips found on a simulated run, by the paper's rule and by the map: ``python tests/slip_score.py FOLDER``.

FOLDER is that of ``railfix simulate commercial-run``: tachometer, inertial unit, their ground truth. The place of the
gradient is the ground truth's.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import polars as pl

from railfix.core.timescale import seconds, timedelta
from railfix.motion.slip import MotionState, SlipLimits, find_slips
from railfix.motion.tachometer import TachometerLimits, pulse_acceleration, pulse_speeds
from railfix.run.sensors import read_sensors
from railfix.track import read_track
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line

RATE_HZ = 50.0
INERTIAL = (MotionState.INERTIAL_SPIN, MotionState.INERTIAL_SLIDE)


def main() -> int:
    folder = Path(sys.argv[1])
    samples = read_sensors(tachometer=folder / "tachometer.parquet", inertial=folder / "inertial.parquet")
    truth = pl.read_csv(
        folder / "truth.csv.gz", schema_overrides={"time_gpst": pl.Datetime("ns")}, infer_schema_length=None
    ).filter(antenna="front")
    slips = pl.read_parquet(folder / "wheel_slips.parquet")
    begin = samples.inertial.time[0]
    t = np.arange(1.0, float(seconds(samples.inertial.time[-1] - begin)), 1.0 / RATE_HZ)
    when = begin + timedelta(t)
    limits = TachometerLimits()
    speed = pulse_speeds(samples.tachometer, when, limits=limits)
    earlier = pulse_speeds(samples.tachometer, when - np.timedelta64(200, "ms"), limits=limits)
    acceleration = pulse_acceleration(earlier, speed)
    inertial_t = seconds(samples.inertial.time - begin)
    total = np.concatenate([[0.0], np.cumsum(samples.inertial.force_mps2[:, 0])])
    after, before = (np.searchsorted(inertial_t, at, side="right") for at in (t, t - 0.2))
    force = (total[after] - total[before]) / np.maximum(after - before, 1)
    truth_t = seconds(truth["time_gpst"].to_numpy().astype("datetime64[ns]") - begin)
    chainage = np.interp(t, truth_t, truth["chainage_m"].to_numpy())
    true_speed = np.interp(t, truth_t, truth["speed_mps"].to_numpy())
    trajectory = Trajectory.from_track(read_track([folder / "track.csv"]))
    gradient = Line.of(trajectory).gradient_at(trajectory.arc_at_chainage(chainage - 9.1))
    sine = gradient / np.sqrt(1.0 + gradient**2)
    spans = [
        (float(seconds(a - begin)), float(seconds(b - begin)), r)
        for a, b, r in zip(
            slips["time_gpst"].to_numpy().astype("datetime64[ns]"),
            slips["end_gpst"].to_numpy().astype("datetime64[ns]"),
            slips["ratio"].to_list(),
            strict=True,
        )
    ]
    for rule in ("p2", "map"):
        found, _ = find_slips(
            t,
            speed.speed_mps,
            acceleration,
            force,
            np.nan_to_num(sine),
            limits=SlipLimits.model_validate({"rule": rule}),
        )
        flagged = np.isin(found.state, INERTIAL)
        seen, late, ways, share = 0, [], [], []
        covered = np.zeros(len(t), dtype=bool)
        for first, last, _ in spans:
            inside = (t >= first) & (t <= last + 2.0)
            covered |= (t >= first - 0.2) & (t <= last + 5.0)
            hit = flagged & inside
            if hit.any():
                seen += 1
                late.append(float(t[np.argmax(hit)] - first))
            share.append(float(flagged[(t >= first) & (t <= last)].mean()))
            k, m = np.searchsorted(t, [first - 1.0, last + 3.0])
            m = min(int(m), len(t) - 1)
            true = float(np.trapezoid(true_speed[k : m + 1], t[k : m + 1]))
            ways.append(abs(float(found.way_m[m] - found.way_m[k]) - true))
        alarms = np.count_nonzero(np.diff((flagged & ~covered).astype(int)) == 1)
        print(
            f"rule {rule:3s}: {seen} of {len(spans)} slips found, after {np.median(late) if late else np.nan:.2f} s; "
            f"instants flagged {100 * np.mean(share):.0f} %; false alarms {alarms} in {t[-1] / 3600:.2f} h; "
            f"way through a slip p50 {np.nanmedian(ways):.2f}, largest {np.nanmax(ways):.2f} m"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
