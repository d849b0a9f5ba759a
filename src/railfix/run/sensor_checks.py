"""Notes on sensors on board whose unit, time tags or wheel diameter contradict the satellites."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats
from railfix.core.timescale import seconds
from railfix.motion.samples import SensorSamples
from railfix.motion.tachometer import SpeedCheck, TachometerLimits, check_speeds, pulse_speeds

#: Speeds of the wheel are compared this far apart [ns].
_STEP_NS: Final = 500_000_000
#: Speeds by satellites are known this near to an instant [s].
_NEAR_S: Final = 1.5
#: Scale and lag that are told.
_SCALE: Final = 0.01
_LAG_S: Final = 0.3


def doppler_speeds(train: pl.DataFrame) -> pl.DataFrame:
    """Return times and speeds of filtered positions (`railfix.pipeline.train_table`) for which Dopplers were used."""
    known = train.filter(pl.col("sources").str.contains("doppler"), pl.col("speed_mps").is_not_null())
    return known.select("time_gpst", "speed_mps")


def sensor_notes(samples: SensorSamples, speeds: pl.DataFrame, tachometer: TachometerLimits) -> tuple[str, ...]:
    """Return a sentence on each sensor whose speeds are in another unit, late, or off in scale.

    `speeds` are those by satellites of one antenna (`doppler_speeds`). `tachometer` is the wheel as entered.
    """
    right_time = speeds["time_gpst"].to_numpy().astype("datetime64[ns]")
    right = speeds["speed_mps"].to_numpy()
    notes: list[str] = []
    if len(samples.radar):
        found = _checked(samples.radar.time, samples.radar.speed_mps, right_time, right)
        notes += _sentences("radar", found, "its speeds are {:+.1f} % off those by Dopplers")
    if len(samples.tachometer):
        first, last = (int(t.astype(np.int64)) for t in samples.tachometer.time[[0, -1]])
        grid = np.arange(first, last, _STEP_NS).astype("datetime64[ns]")
        wheel = pulse_speeds(samples.tachometer, grid, limits=tachometer)
        heard = np.isfinite(wheel.speed_mps)
        found = _checked(wheel.time[heard], wheel.speed_mps[heard], right_time, right)
        real = np.nan if found is None else tachometer.wheel_diameter_m / found.ratio
        scale = (
            "the way of its wheel is {:+.1f} % off that by satellites; sensors.tachometer.wheel_diameter_m = "
            f"{real:.3f} would fit"
        )
        notes += _sentences("tachometer", found, scale)
    return tuple(notes)


def _checked(time: Datetimes, speed_mps: Floats, right_time: Datetimes, right_mps: Floats) -> SpeedCheck | None:
    """Speeds against those by satellites; None with too few in common."""
    if len(right_time) < 2 or not len(time):
        return None
    after = np.clip(np.searchsorted(right_time, time), 1, len(right_time) - 1)
    apart = np.maximum(np.abs(seconds(right_time[after] - time)), np.abs(seconds(time - right_time[after - 1])))
    near = apart <= _NEAR_S
    try:
        return check_speeds(time[near], speed_mps[near], right_time, right_mps)
    except ValueError:
        return None


def _sentences(name: str, found: SpeedCheck | None, scale: str) -> Iterator[str]:
    if found is None:
        yield f"{name}: fewer than ten speeds in common with the satellites; unit, time tags and scale are not checked"
        return
    if found.unit != "m/s":
        yield f"{name}: its speeds are in {found.unit}, not in m/s; convert them"
    if abs(found.ratio - 1.0) > _SCALE:
        yield f"{name}: {scale.format(100.0 * (found.ratio - 1.0))}"
    if abs(found.lag_s) >= _LAG_S:
        late = "late" if found.lag_s > 0 else "early"
        yield f"{name}: its time tags are {abs(found.lag_s):.1f} s {late} against the satellites'; mend them"
