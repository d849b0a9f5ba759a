"""Signs, units and axes of the sensors on board, held against the places of single epochs.

These do not depend on the sensors, as speeds of the filter do: a sensor that is turned round moves the filter too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats
from railfix.core.constants import GRAVITY_MPS2
from railfix.core.geodesy import enu_axes
from railfix.core.timescale import seconds, timedelta
from railfix.motion.samples import InertialSamples, SensorSamples
from railfix.motion.tachometer import TachometerLimits, pulse_speeds

#: Places are averaged over cells of this length [s].
_CELL_S: Final = 4.0
#: A train that moves, for signs of speeds [m/s], and as far between cells that its heading is known [m].
_MOVING_MPS: Final = 1.0
_HEADED_M: Final = 8.0
#: Cells that are needed for a statement, and the least root mean square of what is compared: changes of a force [m/s2],
#: a rate [rad/s].
_LEAST_CELLS: Final = 15
_LEAST_FORCE_MPS2: Final = 0.08
_LEAST_RATE_RADPS: Final = 0.003
#: A slope of measured over expected below this is a turned sign, above that a rate in degrees.
_TURNED: Final = -0.3
_IN_DEGREES: Final = 10.0
#: Share of gravity that a force at rest may differ from it by.
_GRAVITY_SHARE: Final = 0.12


@dataclass(frozen=True)
class Motion:
    """Motion of an antenna by its places, M cells of time one after the other; NaN where a neighbour is missing.

    Attributes
    ----------
    time : ndarray of datetime64[ns], shape (M,)
    speed_mps, acceleration_mps2, gradient, heading_rate_radps : ndarray, shape (M,)
        Along the line toward rising chainage; the gradient as rise over way, the rate positive to the right.
    """

    time: Datetimes
    speed_mps: Floats
    acceleration_mps2: Floats
    gradient: Floats
    heading_rate_radps: Floats


def motion_of(places: pl.DataFrame) -> Motion:
    """Compute the motion by places: time, chainage, coordinates and ECEF by the names of ``positions.csv``."""
    start = places["time_gpst"].to_numpy().astype("datetime64[ns]").min()
    columns = ("chainage_m", "latitude_deg", "longitude_deg", "x_m", "y_m", "z_m")
    cells = (
        places.with_columns(pl.Series("t", seconds(places["time_gpst"].to_numpy().astype("datetime64[ns]") - start)))
        .group_by((pl.col("t") // _CELL_S).cast(pl.Int64).alias("cell"))
        .agg(pl.col("t", *columns).mean())
        .sort("cell")
    )
    whole = pl.DataFrame({"cell": np.arange(int(cells["cell"][-1]) + 1)}).join(cells, on="cell", how="left")
    t, chainage, latitude, longitude = (whole[name].to_numpy() for name in ("t", "chainage_m", *columns[1:3]))
    ecef = whole.select(columns[3:]).to_numpy()
    speed, rise, heading = (np.full(len(t), np.nan) for _ in range(3))
    east, north, up = np.moveaxis(enu_axes(latitude, longitude), 1, 0)
    way, span = ecef[2:] - ecef[:-2], t[2:] - t[:-2]
    moved = np.linalg.norm(way, axis=1)
    speed[1:-1] = (chainage[2:] - chainage[:-2]) / span
    sign = np.sign(speed[1:-1])
    with np.errstate(divide="ignore", invalid="ignore"):
        rise[1:-1] = (way * up[1:-1]).sum(axis=1) / moved * sign
    heading[1:-1] = np.arctan2((way * east[1:-1]).sum(axis=1) * sign, (way * north[1:-1]).sum(axis=1) * sign)
    heading[1:-1][~(moved > _HEADED_M)] = np.nan
    rate, gained = np.full(len(t), np.nan), np.full(len(t), np.nan)
    turned = heading[2:] - heading[:-2]
    rate[1:-1] = np.arctan2(np.sin(turned), np.cos(turned)) / span
    before, after = t[1:-1] - t[:-2], t[2:] - t[1:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.diff(chainage)
        gained[1:-1] = 2.0 * (steps[1:] / after - steps[:-1] / before) / span
    time = np.full(len(t), np.datetime64("NaT", "ns"))
    known = np.isfinite(t)
    time[known] = start + timedelta(t[known])
    return Motion(time, speed, gained, np.nan_to_num(rise), rate)


def sign_notes(
    samples: SensorSamples, places: pl.DataFrame, tachometer: TachometerLimits, facing: float
) -> Iterator[str]:
    """Yield a sentence on each sensor that is turned round, in another unit or on other axes.

    Parameters
    ----------
    samples : SensorSamples
    places : polars.DataFrame
        Of single epochs of one antenna that passed every check.
    tachometer : TachometerLimits
    facing : float
        1 where the vehicle's front points toward rising chainage, else -1.
    """
    yield from _forces_at_rest(samples.inertial)
    if len(places) < 2:
        return
    motion = motion_of(places)
    moving = np.abs(motion.speed_mps) > _MOVING_MPS
    time, forward = motion.time[moving], facing * motion.speed_mps[moving]
    if len(samples.tachometer) and samples.tachometer.direction.any():
        wheel = pulse_speeds(samples.tachometer, time, limits=tachometer).speed_mps
        yield from _turned_speeds("tachometer", wheel, forward, "the direction of its pulses is")
    if len(samples.radar):
        at = np.clip(np.searchsorted(samples.radar.time, time), 0, len(samples.radar) - 1)
        near = np.abs(seconds(samples.radar.time[at] - time)) < 1.0
        radar = np.where(near, samples.radar.speed_mps[at], np.nan)
        yield from _turned_speeds("radar", radar, forward, "the sign of its speeds is")
    if len(samples.inertial):
        yield from _turned_unit(samples.inertial, motion, facing)


def _turned_speeds(name: str, speed: Floats, forward: Floats, what: str) -> Iterator[str]:
    known = np.isfinite(speed) & np.isfinite(forward)
    if known.sum() >= _LEAST_CELLS and np.mean(speed[known] * forward[known] < 0.0) > 0.5:
        yield f"{name}: {what} opposite to the motion by satellites; turn it, or the vehicle file's facing is wrong"


def _forces_at_rest(inertial: InertialSamples) -> Iterator[str]:
    """The mean force is gravity, upward: -9.8 m/s2 on the axis that points down."""
    if not np.isfinite(inertial.force_mps2).any(axis=0).all():
        return
    forward, right, down = np.nanmedian(inertial.force_mps2, axis=0).tolist()
    size = float(np.sqrt(forward**2 + right**2 + down**2))
    if abs(size - 1.0) < _GRAVITY_SHARE:
        yield "inertial: its forces are in g, not in m/s2; multiply them by 9.80665"
    elif abs(size / GRAVITY_MPS2 - 1.0) > _GRAVITY_SHARE:
        yield f"inertial: its mean force is {size:.2f} m/s2, gravity {GRAVITY_MPS2:.2f}; specific forces are expected"
    elif abs(down) < 0.8 * size:
        axis = "force_forward_mps2" if abs(forward) > abs(right) else "force_right_mps2"
        yield f"inertial: gravity is in {axis}, not in force_down_mps2; exchange the columns of the axes"
    elif down > 0.0:
        yield f"inertial: force_down_mps2 is {down:+.1f} in the mean, -9.8 was expected; turn its sign, or the unit"


def _turned_unit(inertial: InertialSamples, motion: Motion, facing: float) -> Iterator[str]:
    """Forward force against acceleration and gradient, yaw rate against the heading's, by the slope of a line."""
    half = timedelta(np.array([_CELL_S]))[0]
    known = ~np.isnat(motion.time)
    begin, end = motion.time[known] - half, motion.time[known] + half
    first, last = np.searchsorted(inertial.time, begin), np.searchsorted(inertial.time, end)
    whole = (last > first) & (begin >= inertial.time[0]) & (end <= inertial.time[-1])

    def mean(values: Floats) -> Floats:
        total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(values))])
        return np.where(whole, (total[last] - total[first]) / np.maximum(last - first, 1), np.nan)

    expected = facing * (motion.acceleration_mps2[known] + GRAVITY_MPS2 * motion.gradient[known])
    force = mean(inertial.force_mps2[:, 0])
    both = np.isfinite(expected) & np.isfinite(force)
    offsets = (expected[both].mean(), force[both].mean()) if both.any() else (0.0, 0.0)  # of the unit on the body
    slope = _slope(expected - offsets[0], force - offsets[1], _LEAST_FORCE_MPS2)
    if slope < _TURNED:
        yield (
            "inertial: its force forward is opposite to the acceleration by satellites; the unit is turned round, or "
            "the vehicle file's facing is wrong"
        )
    slope = _slope(motion.heading_rate_radps[known], mean(inertial.rate_radps[:, 2]), _LEAST_RATE_RADPS)
    if slope < _TURNED:
        yield "inertial: its yaw rate is opposite to that of the line; it must be positive to the right, about down"
    if abs(slope) > _IN_DEGREES:
        yield "inertial: its rates are in degrees per second, not in radians; convert them"


def _slope(expected: Floats, measured: Floats, least: float) -> float:
    """Slope of measured over expected values; NaN where there are too few, or these are too small."""
    known = np.isfinite(expected) & np.isfinite(measured)
    x, y = expected[known], measured[known]
    if len(x) < _LEAST_CELLS or np.sqrt(np.mean(x * x)) < least:
        return float("nan")
    return float((x * y).sum() / (x * x).sum())
