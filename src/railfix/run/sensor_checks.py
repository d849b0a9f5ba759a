"""Checks of on-board sensors against satellite positions and speeds: sign, unit, axes, time tags, scale.

Signs are checked against single-epoch positions, because the filter's speeds depend on the sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats
from railfix.core.constants import GRAVITY_MPS2
from railfix.core.timescale import gpst_minus_utc, seconds, timedelta
from railfix.motion.radar_watch import RadarWatch
from railfix.motion.samples import GroundUnits, InertialSamples, RadarSpeeds, SensorSamples, StationRanges
from railfix.motion.tachometer import SpeedCheck, TachometerLimits, check_speeds, pulse_speeds
from railfix.pipeline.sensor_epochs import SensorLimits, ranging_lever_m
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line

#: Length of the time cells over which positions are averaged [s].
_CELL_S: Final = 4.0
#: Signs of speeds are checked only where the expected speed exceeds this [m/s].
_MOVING_MPS: Final = 1.0
#: Checks with fewer time cells than this are omitted.
_LEAST_CELLS: Final = 15
#: Forces are compared only if the expected force varies by at least this (rms) [m/s2].
_LEAST_FORCE_MPS2: Final = 0.08
#: Speeds are compared only if the expected speed varies by at least this (rms) [m/s].
_LEAST_SPEED_MPS: Final = 1.0
#: Turn rates are compared only if the rms of the expected turn rate is at least this [rad/s].
_LEAST_RATE_RADPS: Final = 0.003
#: A sensor's sign is taken to be reversed if the slope of measured over expected values is below this.
_REVERSED: Final = -0.3
#: Turn rates are taken to be in deg/s if the slope of measured over expected turn rates exceeds this in magnitude.
_IN_DEGREES: Final = 10.0
#: Lags of a sensor's time tags are tested up to this, early and late [s].
_LONGEST_LAG_S: Final = 20.0
#: Lags of a sensor's time tags relative to single-epoch positions are reported if they are at least this [s].
_LEAST_LAG_S: Final = 2.0
#: A lag is reported only if it reduces the unexplained variance by more than this factor.
_LESS_ALIKE: Final = 2.0
#: Largest accepted difference between the magnitude of the median force and gravity, as a fraction of gravity.
_GRAVITY_SHARE: Final = 0.12


@dataclass(frozen=True)
class PositionMotion:
    """Motion of an antenna, computed from positions averaged over M time cells; NaN if a neighbouring cell is empty."""

    time: Datetimes  #: Mean time of each cell, shape (M,).
    speed_mps: Floats  #: Speed toward rising chainage, shape (M,).
    acceleration_mps2: Floats  #: Acceleration toward rising chainage, shape (M,).
    gradient: Floats  #: Gradient of the line (rise over horizontal length), shape (M,).
    heading_rate_radps: Floats  #: Turn rate of the line's heading, positive to the right, shape (M,).


def compute_motion(places: pl.DataFrame, trajectory: Trajectory) -> PositionMotion:
    """Compute the motion from ``time_gpst`` and ``chainage_m`` of single epochs, averaged over time cells of 4 s."""
    time = places["time_gpst"].to_numpy().astype("datetime64[ns]")
    since = seconds(time - time[0])
    cell = (since // _CELL_S).astype(np.int64)
    with np.errstate(invalid="ignore"):
        count = np.bincount(cell)
        t, chainage = (np.bincount(cell, values) / count for values in (since, places["chainage_m"].to_numpy()))
    arc = trajectory.arc_at_chainage(chainage)
    heading = np.radians(trajectory.heading_deg)[trajectory.segment_at(arc)[0]]
    step, way, turned = np.diff(t), np.diff(chainage), heading[2:] - heading[:-2]
    span = t[2:] - t[:-2]
    speed, gained, rate = (np.full(len(t), np.nan) for _ in range(3))
    speed[1:-1] = (chainage[2:] - chainage[:-2]) / span
    gained[1:-1] = 2.0 * (way[1:] / step[1:] - way[:-1] / step[:-1]) / span
    rate[1:-1] = np.arctan2(np.sin(turned), np.cos(turned)) / span
    known = count > 0
    gradient = Line(trajectory).gradient_at(arc)
    return PositionMotion(time[0] + timedelta(t[known]), speed[known], gained[known], gradient[known], rate[known])


def sign_notes(
    samples: SensorSamples, places: pl.DataFrame, trajectory: Trajectory, tachometer: TachometerLimits
) -> Iterator[str]:
    """Yield a sentence on each wrong sign, unit or axis of a sensor, and on time tags that are wrong by seconds.

    `places` has ``time_gpst`` and ``chainage_m`` of one antenna's single-epoch positions that passed every check.
    """
    wheel, radar, inertial = samples.tachometer, samples.radar, samples.inertial
    yield from _forces_at_rest(inertial)
    if len(places) < 2:
        return
    motion, facing = compute_motion(places, trajectory), trajectory.front_sign
    time, forward = motion.time, facing * motion.speed_mps
    if len(wheel):
        directed = "the direction of its pulses is" if wheel.direction.any() else None
        speeds = lambda at: pulse_speeds(wheel, at, limits=tachometer).speed_mps  # noqa: E731
        yield from _of_speeds("tachometer", time, forward, speeds, directed)
    if len(radar):
        yield from _of_speeds("radar", time, forward, partial(_radar_speeds, radar), "the sign of its speeds is")
    if len(inertial):
        expected = facing * (motion.acceleration_mps2 + GRAVITY_MPS2 * motion.gradient)
        force = partial(_means, inertial.time, inertial.force_mps2[:, 0])
        lag = _lag_s(time, expected, force, _LEAST_FORCE_MPS2)
        if lag:
            yield _late("inertial", lag, time[0])
            return
        slope = _slope(_centre(expected), _centre(force(time)), _LEAST_FORCE_MPS2)
        if slope < _REVERSED:
            yield (
                "inertial: the forward force is opposite to the acceleration from satellites; the unit is mounted "
                "backwards, or facing in the vehicle file is wrong"
            )
        yaw = _means(inertial.time, inertial.rate_radps[:, 2], time)
        slope = _slope(motion.heading_rate_radps, yaw, _LEAST_RATE_RADPS)
        if slope < _REVERSED:
            yield (
                "inertial: its yaw rate is opposite to the turning rate of the line; it must be positive to the "
                "right, about the down axis"
            )
        if abs(slope) > _IN_DEGREES:
            yield "inertial: its rates are in degrees per second, not in radians; convert them"


def _of_speeds(
    name: str, time: Datetimes, forward: Floats, speeds: Callable[[Datetimes], Floats], directed: str | None
) -> Iterator[str]:
    """Check the time tags and the sign of a speed sensor, and yield sentences on errors.

    `forward` are the expected speeds at `time`; the function `speeds` returns the measured speeds. `directed` is the
    beginning of a sentence on a wrong sign; if it is None, the sign is not checked.
    """
    lag = _lag_s(time, np.abs(forward), lambda at: np.abs(speeds(at)), _LEAST_SPEED_MPS)
    if lag:
        yield _late(name, lag, time[0])
        return
    measured = speeds(time)
    known = np.isfinite(measured) & (np.abs(forward) > _MOVING_MPS)
    if directed and known.sum() >= _LEAST_CELLS and np.mean(measured[known] * forward[known] < 0.0) > 0.5:
        yield f"{name}: {directed} opposite to the motion from satellites; reverse it, or correct the vehicle's facing"


def _lag_s(time: Datetimes, expected: Floats, measured: Callable[[Datetimes], Floats], least: float) -> float:
    """Return the lag of a sensor's time tags [s], positive for late tags, or 0 if no lag of at least 2 s is certain."""
    x, found = _centre(expected), {}
    for lag in np.arange(-_LONGEST_LAG_S, _LONGEST_LAG_S + 1.0).tolist():
        y = measured(time + timedelta(np.array([lag])))
        both = np.isfinite(x) & np.isfinite(y)
        if both.sum() >= _LEAST_CELLS and x[both].std() >= least and y[both].std() > 0.0:
            found[lag] = float(np.corrcoef(x[both], y[both])[0, 1]) ** 2
    if 0.0 not in found:
        return 0.0
    best = max(found, key=lambda lag: found[lag])
    certain = found[best] > 0.5 and 1.0 - found[0.0] > _LESS_ALIKE * (1.0 - found[best])
    return best if certain and abs(best) >= _LEAST_LAG_S else 0.0


def _late(name: str, lag_s: float, time: np.datetime64) -> str:
    leap = int(gpst_minus_utc(time))
    utc = "they are UTC, GPS time is expected" if abs(lag_s + leap) <= 1.0 else "correct them"
    way = "late" if lag_s > 0 else "early"
    return f"{name}: its time tags are {abs(lag_s):.0f} s {way} compared with GPS time; {utc}"


def _radar_speeds(radar: RadarSpeeds, time: Datetimes) -> Floats:
    at = np.clip(np.searchsorted(radar.time, time), 0, len(radar) - 1)
    return np.where(np.abs(seconds(radar.time[at] - time)) < 1.0, radar.speed_mps[at], np.nan)


def _means(time: Datetimes, values: Floats, middle: Datetimes) -> Floats:
    """Return the mean of samples within a cell length of each instant; NaN where samples do not cover this interval."""
    half = timedelta(np.array([_CELL_S]))
    begin, end = middle - half, middle + half
    first, last = np.searchsorted(time, begin), np.searchsorted(time, end)
    whole = (last > first) & (begin >= time[0]) & (end <= time[-1])
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(values))])
    return np.where(whole, (total[last] - total[first]) / np.maximum(last - first, 1), np.nan)


def _centre(values: Floats) -> Floats:
    """Return the values minus their mean, so that a sensor bias or misalignment does not affect the comparison."""
    known = np.isfinite(values)
    return values - (values[known].mean() if known.any() else 0.0)


def _forces_at_rest(inertial: InertialSamples) -> Iterator[str]:
    """Yield a sentence if the median specific force is not -9.8 m/s2 (gravity) on the axis that points down."""
    if not np.isfinite(inertial.force_mps2).any(axis=0).all():
        return
    forward, right, down = np.nanmedian(inertial.force_mps2, axis=0).tolist()
    size = float(np.sqrt(forward**2 + right**2 + down**2))
    if abs(size - 1.0) < _GRAVITY_SHARE:
        yield "inertial: its forces are in g, not in m/s2; multiply them by 9.80665"
    elif abs(size / GRAVITY_MPS2 - 1.0) > _GRAVITY_SHARE:
        yield f"inertial: its median force is {size:.2f} m/s2, not {GRAVITY_MPS2:.2f}; specific forces are expected"
    elif abs(down) < 0.8 * size:
        axis = "force_forward_mps2" if abs(forward) > abs(right) else "force_right_mps2"
        yield f"inertial: gravity is in {axis}, not in force_down_mps2; swap the columns of the axes"
    elif down > 0.0:
        yield f"inertial: force_down_mps2 is {down:+.1f} on average, -9.8 was expected; the unit is upside down"


def _slope(expected: Floats, measured: Floats, least: float) -> float:
    """Return the slope of measured over expected values; NaN for too few values or an expected rms below `least`."""
    known = np.isfinite(expected) & np.isfinite(measured)
    x, y = expected[known], measured[known]
    if len(x) < _LEAST_CELLS or np.sqrt(np.mean(x * x)) < least:
        return float("nan")
    return float((x * y).sum() / (x * x).sum())


#: Interval at which wheel speeds are compared with Doppler speeds [ns].
_STEP_NS: Final = 500_000_000
#: A sensor speed is compared only if the Doppler speeds before and after it are at most this far away [s].
_NEAR_S: Final = 1.5
#: Relative scale errors of speed sensors are reported if they exceed this.
_SCALE: Final = 0.01
#: Lags of a speed sensor's time tags are reported if they are at least this [s].
_LAG_S: Final = 0.3
#: Relative scale error that wheel wear cannot cause; above it, the note suggests another number of pulses per turn.
_OTHER_TEETH: Final = 0.1
#: A range is compared with the satellite positions before and after it if these are at most this far apart [s].
_BETWEEN_S: Final = 3.0
#: Ranges are not compared if the train moves by at most this between the two satellite positions [m].
_MOVED_M: Final = 1.0
#: Ranges are compared with satellite positions only if the ground unit is closer than this [m].
_FAR_M: Final = 500.0
#: Ground units are taken as ahead or behind if the cosine of their angle to the track exceeds this in magnitude.
_AHEAD: Final = 0.7
#: Ranges to units ahead (or behind) are compared only if the number of these ranges is at least this.
_LEAST_RANGES: Final = 10
#: Offsets of ranges from satellite positions are reported if they exceed this [m]: twice the assumed code error that
#: lasts for minutes.
_RANGE_M: Final = 3.0


@dataclass(frozen=True, kw_only=True)
class SensorChecks:
    """Satellite positions and speeds of one antenna, collected for the checks of the on-board sensors."""

    #: Doppler speeds (`doppler_speeds`), one table per chunk.
    speeds: list[pl.DataFrame] = field(default_factory=list)
    #: Single-epoch positions that passed every check, one table per chunk.
    places: list[pl.DataFrame] = field(default_factory=list)

    def take(self, positions: pl.DataFrame, train: pl.DataFrame) -> None:
        """Add the rows of a chunk. At most two positions per second are kept."""
        self.places.append(_thin(positions.filter(pl.col("status") == "ok").select("time_gpst", "chainage_m")))
        self.speeds.append(doppler_speeds(train))

    def notes(
        self, samples: SensorSamples, units: GroundUnits | None, trajectory: Trajectory, limits: SensorLimits
    ) -> tuple[str, ...]:
        """Return sentences on sensors whose settings or table contradict satellite positioning.

        If a sign, unit, axis or time tag is wrong, scale errors and ranges are not checked.
        """
        if not self.speeds:
            return ()
        places = _thin(pl.concat(self.places))  # so that rows do not depend on the chunk length
        reversed_ones = tuple(sign_notes(samples, places, trajectory, limits.tachometer))
        if reversed_ones:  # other checks use the filter's speeds, which depend on these sensors
            return reversed_ones
        notes = sensor_notes(samples, pl.concat(self.speeds), limits.tachometer)
        if units is not None and len(samples.ranging):
            notes += tuple(range_notes(samples.ranging, units, places, trajectory, limits))
        return notes

    def radar_alarms(self, radar: RadarSpeeds) -> tuple[str, ...]:
        """Return a sentence on each radar alarm (`RadarWatch`) in the time span of the radar table."""
        if not self.speeds or not len(radar):
            return ()
        speeds = pl.concat(self.speeds)
        time, speed = speeds["time_gpst"].to_numpy().astype("datetime64[ns]"), speeds["speed_mps"].to_numpy()
        both = (time >= radar.time[0]) & (time <= radar.time[-1])
        return tuple(alarm.sentence for alarm in RadarWatch().take_samples(radar, time[both], speed[both]))


def range_notes(
    ranging: StationRanges, units: GroundUnits, places: pl.DataFrame, trajectory: Trajectory, limits: SensorLimits
) -> Iterator[str]:
    """Yield sentences on an along-track offset or a bias of ranges, found by comparison with satellite positions.

    `places` has ``time_gpst`` and ``chainage_m`` of an antenna. `limits` has the ranging unit's position on the
    vehicle.
    """
    of_unit = {str(name): k for k, name in enumerate(units.name)}
    unit = np.array([of_unit.get(str(name), -1) for name in ranging.station], dtype=np.intp)
    time = places["time_gpst"].to_numpy().astype("datetime64[ns]")
    if len(time) < 2:
        return
    after = np.clip(np.searchsorted(time, ranging.time), 1, len(time) - 1)
    before = after - 1
    chainage = places["chainage_m"].to_numpy()
    ran, between = chainage[after] - chainage[before], seconds(time[after] - time[before])
    share = seconds(ranging.time - time[before]) / np.maximum(between, 1e-9)
    arc = trajectory.arc_at_chainage(chainage[before] + share * ran)
    near = (share >= 0.0) & (share <= 1.0) & (between <= _BETWEEN_S) & np.isfinite(arc)
    near &= (np.abs(ran) > _MOVED_M) & (unit >= 0) & np.isfinite(ranging.range_m)
    rows = np.flatnonzero(near)
    along, right, up = ranging_lever_m(trajectory, limits).tolist()
    point, axes = Line(trajectory).at(arc[rows] + along)
    sight = units.ecef_m[unit[rows]] - point - right * axes[:, 1] - up * axes[:, 2]
    distance = np.linalg.norm(sight, axis=1)
    ahead = (sight * axes[:, 0]).sum(axis=1) / np.maximum(distance, 1e-9)
    longer = ranging.range_m[rows] - distance
    sides = [longer[(distance < _FAR_M) & (side * ahead > _AHEAD)] for side in (1.0, -1.0)]
    seen = [float(np.median(side)) for side in sides if len(side) >= _LEAST_RANGES]
    if not seen:
        yield "ranging: too few ranges at times of satellite positions; the positions of ground units are not checked"
        return
    if len(seen) == 2:
        moved, excess = (seen[1] - seen[0]) / 2.0, (seen[1] + seen[0]) / 2.0
    else:
        moved, excess = (-seen[0] if len(sides[0]) >= _LEAST_RANGES else seen[0]), 0.0
    if abs(moved) > _RANGE_M:
        fits = limits.range_ahead_m + trajectory.front_sign * moved
        which = "ahead of" if moved > 0 else "behind"
        yield (
            f"ranging: positions from ranges are {abs(moved):.1f} m {which} satellite positions in rising chainage; "
            f"sensors.range_ahead_m = {fits:.1f} would fit, or the units' surveyed positions are displaced"
        )
    if abs(excess) > _RANGE_M:
        which = "long" if excess > 0 else "short"
        yield (
            f"ranging: the ranges are {abs(excess):.1f} m too {which} compared with satellite positions; the devices "
            "may have a delay"
        )


def _thin(places: pl.DataFrame) -> pl.DataFrame:
    """Return at most two rows per second: the first row in each half second of `time_gpst`."""
    return places.unique(pl.col("time_gpst").dt.truncate("500ms"), keep="first", maintain_order=True)


def doppler_speeds(train: pl.DataFrame) -> pl.DataFrame:
    """Return ``time_gpst`` and ``speed_mps`` of filtered positions that used Dopplers."""
    known = train.filter(pl.col("sources").str.contains("doppler"), pl.col("speed_mps").is_not_null())
    return known.select("time_gpst", "speed_mps")


def sensor_notes(samples: SensorSamples, speeds: pl.DataFrame, tachometer: TachometerLimits) -> tuple[str, ...]:
    """Return sentences on wrong units, lags and scale errors of speed sensors.

    `speeds` are the Doppler speeds of one antenna (`doppler_speeds`); `tachometer` has the tachometer settings.
    """
    right_time = speeds["time_gpst"].to_numpy().astype("datetime64[ns]")
    right = speeds["speed_mps"].to_numpy()
    notes: list[str] = []
    if len(samples.radar):
        found = _check(samples.radar.time, samples.radar.speed_mps, right_time, right)
        notes += _sentences("radar", found, "its speeds differ from Doppler speeds by {:+.1f} %")
    if len(samples.tachometer):
        first, last = (int(t.astype(np.int64)) for t in samples.tachometer.time[[0, -1]])
        grid = np.arange(first, last, _STEP_NS).astype("datetime64[ns]")
        wheel = pulse_speeds(samples.tachometer, grid, limits=tachometer)
        heard = np.isfinite(wheel.speed_mps)
        found = _check(wheel.time[heard], wheel.speed_mps[heard], right_time, right)
        real = np.nan if found is None else tachometer.wheel_diameter_m / found.ratio
        fits = f"sensors.tachometer.wheel_diameter_m = {real:.3f}"
        if found is not None and abs(found.ratio - 1.0) > _OTHER_TEETH:
            fits = f"sensors.tachometer.pulses_per_turn = {found.ratio * tachometer.pulses_per_turn:.0f} or {fits}"
        scale = f"its distance differs by {{:+.1f}} % from the distance measured by satellites; {fits} would fit"
        notes += _sentences("tachometer", found, scale)
    return tuple(notes)


def _check(time: Datetimes, speed_mps: Floats, right_time: Datetimes, right_mps: Floats) -> SpeedCheck | None:
    """Compare sensor speeds with Doppler speeds (`right_mps`). Return None if too few speeds are close in time."""
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
        yield f"{name}: its time tags are {abs(found.lag_s):.1f} s {late} compared with GPS time; correct them"
