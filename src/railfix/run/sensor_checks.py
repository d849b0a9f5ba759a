"""Notes on sensors that contradict the satellites: units, time tags, wheel diameter, position of the ranging unit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import polars as pl

from railfix.core.arrays import Datetimes, Floats
from railfix.core.timescale import seconds
from railfix.motion.radar_watch import RadarWatch
from railfix.motion.samples import GroundUnits, RadarSpeeds, SensorSamples, StationRanges
from railfix.motion.tachometer import SpeedCheck, TachometerLimits, check_speeds, pulse_speeds
from railfix.pipeline.sensor_epochs import SensorLimits, ranging_lever_m
from railfix.run.sensor_signs import sign_notes
from railfix.track.trajectory import Trajectory
from railfix.tracking import Line

#: Speeds of the wheel are compared this far apart [ns].
_STEP_NS: Final = 500_000_000
#: Speeds by satellites are known this near to an instant [s].
_NEAR_S: Final = 1.5
#: Scale and lag that are told.
_SCALE: Final = 0.01
_LAG_S: Final = 0.3
#: No worn wheel differs by so much.
_OTHER_TEETH: Final = 0.1
#: Ranges are compared with places by satellites that are so near in time [s], from a moving train, to a unit no further
#: away [m] and seen along the track by this share; so many are needed on a side.
_BETWEEN_S: Final = 3.0
_MOVED_M: Final = 1.0
_FAR_M: Final = 500.0
_AHEAD: Final = 0.7
_LEAST_RANGES: Final = 10
#: Difference between ranges and satellites that is told: twice what codes are off by for minutes [m].
_RANGE_M: Final = 3.0


@dataclass(frozen=True, kw_only=True)
class SensorChecks:
    """Positions and speeds of one antenna by satellites, to compare the sensors on board with."""

    #: By Dopplers (`doppler_speeds`), and of single epochs that passed every check; of each chunk.
    speeds: list[pl.DataFrame] = field(default_factory=list)
    places: list[pl.DataFrame] = field(default_factory=list)

    def take(self, positions: pl.DataFrame, train: pl.DataFrame) -> None:
        """Take the rows of a chunk; two places a second are kept."""
        passed = positions.filter(pl.col("status") == "ok").select("time_gpst", "chainage_m")
        self.places.append(passed.unique(pl.col("time_gpst").dt.truncate("500ms"), keep="first", maintain_order=True))
        self.speeds.append(doppler_speeds(train))

    def notes(
        self, samples: SensorSamples, units: GroundUnits | None, trajectory: Trajectory, limits: SensorLimits
    ) -> tuple[str, ...]:
        """Return a sentence on each sensor whose settings or tables contradict the satellites."""
        if not self.speeds:
            return ()
        places = pl.concat(self.places)
        reversed_ones = tuple(sign_notes(samples, places, trajectory, limits.tachometer))
        if reversed_ones:  # the filter's speeds, which the rest is compared with, depend on these sensors
            return reversed_ones
        notes = sensor_notes(samples, pl.concat(self.speeds), limits.tachometer)
        if units is not None and len(samples.ranging):
            notes += tuple(range_notes(samples.ranging, units, places, trajectory, limits))
        return notes

    def radar_alarms(self, radar: RadarSpeeds) -> tuple[str, ...]:
        """Return a sentence on each alarm of the radar while its table lasts (live: `railfix.live.sensor_watch`)."""
        if not self.speeds or not len(radar):
            return ()
        speeds = pl.concat(self.speeds)
        time, speed = speeds["time_gpst"].to_numpy().astype("datetime64[ns]"), speeds["speed_mps"].to_numpy()
        both = (time >= radar.time[0]) & (time <= radar.time[-1])
        return tuple(alarm.sentence for alarm in RadarWatch().take_samples(radar, time[both], speed[both]))


def range_notes(
    ranging: StationRanges, units: GroundUnits, places: pl.DataFrame, trajectory: Trajectory, limits: SensorLimits
) -> Iterator[str]:
    """Yield sentences on ranges that are moved along the track, or too long, against the places by satellites.

    Parameters
    ----------
    ranging : StationRanges
    units : GroundUnits
    places : polars.DataFrame
        ``time_gpst`` and ``chainage_m`` of an antenna.
    trajectory : Trajectory
        Of that antenna.
    limits : SensorLimits
        The place of the vehicle's ranging unit as entered.
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
    point, axes = Line.of(trajectory).at(arc[rows] + along)
    sight = units.ecef_m[unit[rows]] - point - right * axes[:, 1] - up * axes[:, 2]
    distance = np.linalg.norm(sight, axis=1)
    ahead = (sight * axes[:, 0]).sum(axis=1) / np.maximum(distance, 1e-9)
    longer = ranging.range_m[rows] - distance
    sides = [longer[(distance < _FAR_M) & (side * ahead > _AHEAD)] for side in (1.0, -1.0)]
    seen = [float(np.median(side)) for side in sides if len(side) >= _LEAST_RANGES]
    if not seen:
        yield "ranging: too few ranges beside places by satellites; the places of its units are not checked"
        return
    if len(seen) == 2:
        moved, excess = (seen[1] - seen[0]) / 2.0, (seen[1] + seen[0]) / 2.0
    else:
        moved, excess = (-seen[0] if len(sides[0]) >= _LEAST_RANGES else seen[0]), 0.0
    if abs(moved) > _RANGE_M:
        fits = limits.range_ahead_m + trajectory.front_sign * moved
        which = "ahead of" if moved > 0 else "behind"
        yield (
            f"ranging: places by the ranges are {abs(moved):.1f} m {which} those by satellites in rising chainage; "
            f"sensors.range_ahead_m = {fits:.1f} would fit, or the units' surveyed places are displaced"
        )
    if abs(excess) > _RANGE_M:
        which = "long" if excess > 0 else "short"
        yield (
            f"ranging: the ranges are {abs(excess):.1f} m too {which} against the satellites; the devices may have a "
            "delay"
        )


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
        found = _check(samples.radar.time, samples.radar.speed_mps, right_time, right)
        notes += _sentences("radar", found, "its speeds are {:+.1f} % off those by Dopplers")
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
        scale = f"the way of its wheel is {{:+.1f}} % off that by satellites; {fits} would fit"
        notes += _sentences("tachometer", found, scale)
    return tuple(notes)


def _check(time: Datetimes, speed_mps: Floats, right_time: Datetimes, right_mps: Floats) -> SpeedCheck | None:
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
        yield f"{name}: its time tags are {abs(found.lag_s):.1f} s {late} against the satellites'; correct them"
