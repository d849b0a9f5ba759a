"""The recursion with compiled kernels: epochs handed to `railfix.kernels.tracking` and what it returns taken back."""

from __future__ import annotations

from dataclasses import fields
from functools import lru_cache
from types import ModuleType
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.core.timescale import seconds, timedelta
from railfix.tracking import clocks, hypotheses, misfit, predict, rows
from railfix.tracking.chunk import Chunk
from railfix.tracking.epochs import SensorEpochs
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.predict import singer
from railfix.tracking.result import DECIDED, Tracked, TrackStatus
from railfix.tracking.robust import DOUBTFUL, FREEDOM, MOVED_M, RELINEARISED, SENSOR_FLOOR
from railfix.tracking.state import OFFSETS, SATELLITES, TrackState, Unknown

#: Unknowns that are always in use, in the order of the kernel.
_ALWAYS: Final = np.array([
    Unknown.PLACE, Unknown.SPEED, Unknown.ACCELERATION, Unknown.DRIFT, Unknown.MAP_RIGHT, Unknown.MAP_UP,
    Unknown.DOPPLER_SPEED, Unknown.CODE_PLACE,
])  # fmt: skip
#: Unknowns of sensors, as the kernel names them, and the columns of measurements that need them.
_SENSORS: Final = ((Unknown.WHEEL, 0), (Unknown.FORCE_OFFSET, 2), (Unknown.RADAR, 1))
#: Satellites come and go: the unknowns in use are chosen again after so many epochs.
_EPOCHS: Final = 512


class Compiled:
    """A chunk as the kernel takes it.

    Parameters
    ----------
    kernel : module
        `railfix.kernels.tracking`.
    chunk : Chunk
    line : Line
    sensors : SensorEpochs
    limits : TrackingLimits
    result : Tracked
        Written to.
    """

    def __init__(
        self,
        kernel: ModuleType,
        chunk: Chunk,
        line: Line,
        sensors: SensorEpochs,
        limits: TrackingLimits,
        result: Tracked,
    ) -> None:
        self.kernel, self.chunk, self.limits, self.result = kernel, chunk, limits, result
        interval, singers = np.unique(chunk.interval_s, return_inverse=True)
        matrices = [singer(float(dt), limits.acceleration_mps2, limits.acceleration_s) for dt in interval]
        ranged, left = sensors.ranges, chunk.apart | chunk.off_map
        sensor, sigma = _columns(sensors, len(chunk.time))
        self.sensed = [bool(column.any()) for column in np.isfinite(sensor).T]
        values = {
            "time_s": seconds(chunk.time - chunk.time[0]),
            "interval_s": chunk.interval_s,
            "left": left if ranged is None else left | np.isfinite(ranged.range_m).any(axis=1),
            "singer": singers.reshape(-1).astype(np.intp),
            "step": np.stack([step for step, _ in matrices]),
            "noise": np.stack([noise for _, noise in matrices]),
            "sensor": sensor,
            "sensor_sigma": sigma,
        }
        for name in kernel.Epochs._fields:
            if name not in values and name != "unsigned":
                values[name] = getattr(chunk, name)
        arrays = {name: _own(array) for name, array in values.items()}
        self.epochs = kernel.Epochs(**arrays, unsigned=sensors.wheel_sign == "unknown")
        self.course = kernel.Course(**line.written)
        self.numbers = _numbers(kernel, limits)
        written = {field.name: getattr(result, field.name) for field in fields(result)}
        self.answers = kernel.Answers(**{name: written[name] for name in kernel.Answers._fields})

    def advance(self, state: TrackState, first: int) -> int:
        """Do epochs from `first` on, change the state, and return the first epoch that is left to numpy."""
        limits = self.limits
        if (
            not state.hypotheses
            or np.isnat(state.measured)
            or self.epochs.left[first]
            or (state.weak_motion_s > 0.0 and state.hypotheses <= limits.most_hypotheses // 2)
            or state.weak_motion_s >= limits.lost_motion_s
            or state.weak_code_s >= limits.lost_code_s
        ):
            return first
        last = min(first + _EPOCHS, len(self.chunk.time))
        full = self._in_use(state, first, last)
        place = np.full(state.mean.shape[1], -1, dtype=np.intp)
        place[full] = np.arange(len(full))
        active = self.kernel.Active(
            full=full,
            wheel=int(place[Unknown.WHEEL]),
            force=int(place[Unknown.FORCE_OFFSET]),
            radar=int(place[Unknown.RADAR]),
            offset=place[OFFSETS:SATELLITES].copy(),
            satellite=place[SATELLITES:].copy(),
        )
        count = state.hypotheses
        origin = self.chunk.time[0]
        scalars = np.array([
            count, state.weak_motion_s, state.weak_code_s, *state.log_scale, state.unaided_m, state.direction,
            seconds(state.measured - origin), *state.code_shift, state.map_log_scale,
        ])  # fmt: skip
        memory = self.kernel.Memory(
            mean=_own(state.mean[:, full]),
            covariance=_own(state.covariance[:, full[:, None], full]),
            log_probability=_own(state.log_probability),
            origin_m=_own(state.origin_m),
            offset_known=_own(state.offset_known),
            scalars=scalars,
        )
        done = int(
            self.kernel.advance(self.epochs, self.course, self.numbers, active, memory, self.answers, first, last)
        )
        if done > first:
            self._take_back(state, full, memory, first, done)
        return done

    def _in_use(self, state: TrackState, first: int, last: int) -> Indices:
        """Unknowns that are measured in some epochs, or correlated with others."""
        covariance = state.covariance
        correlated = np.full(covariance.shape[1], False)
        correlated[:] = np.count_nonzero(covariance, axis=1).max(axis=0) > 1
        for unknown, column in _SENSORS:
            correlated[unknown] |= self.sensed[column]
        chunk = self.chunk
        channels = np.flatnonzero(chunk.has[:, first:last].any(axis=(0, 1)))
        correlated[OFFSETS + chunk.offset[channels]] = True
        correlated[SATELLITES + chunk.slot[channels]] = True
        correlated[:OFFSETS] &= np.isin(np.arange(OFFSETS), [unknown for unknown, _ in _SENSORS])
        return np.concatenate([_ALWAYS, np.flatnonzero(correlated)]).astype(np.intp)

    def _take_back(self, state: TrackState, full: Indices, memory: Any, first: int, done: int) -> None:
        """Put what the kernel leaves into the state; unknowns that are not in use only walk."""
        count = int(memory.scalars[0])
        elapsed = float(self.chunk.interval_s[first:done].sum())
        idle = state.mean[0].copy()
        variance = np.diagonal(state.covariance[0]).copy()
        limits = self.limits
        for unknown, walk in (
            (Unknown.WHEEL, predict.WHEEL_WALK),
            (Unknown.FORCE_OFFSET, predict.FORCE_WALK_MPS2),
            (Unknown.RADAR, predict.RADAR_WALK),
        ):
            variance[unknown] += walk**2 * elapsed
        variance[OFFSETS:SATELLITES] += limits.offset_walk_m**2 * elapsed
        mean = np.repeat(idle[None], count, axis=0)
        covariance = np.zeros((count, len(idle), len(idle)))
        diagonal = np.arange(len(idle))
        covariance[:, diagonal, diagonal] = variance
        mean[:, full] = memory.mean[:count]
        covariance[:, full[:, None], full] = memory.covariance[:count]
        placed = slice(first, done)
        known = np.isfinite(self.result.arc_m[placed])
        for name, unknown in (
            ("wheel_scale", Unknown.WHEEL),
            ("force_offset_mps2", Unknown.FORCE_OFFSET),
            ("radar_scale", Unknown.RADAR),
        ):
            if unknown not in full:
                getattr(self.result, name)[placed][known] = idle[unknown]
        state.mean, state.covariance = mean, covariance
        state.log_probability = memory.log_probability[:count].copy()
        state.origin_m = memory.origin_m[:count].copy()
        state.time = self.chunk.time[done - 1]
        _, motion, code, doppler, phase, unaided, direction, measured, *shift, map_scale = memory.scalars.tolist()
        state.weak_motion_s, state.weak_code_s, state.log_scale = motion, code, (doppler, phase)
        state.unaided_m, state.direction = unaided, direction
        state.code_shift, state.map_log_scale = (shift[0], shift[1]), map_scale
        state.measured = self.chunk.time[0] + timedelta(measured)


def _own(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """A writable copy, row by row: one type of arrays for the compiler."""
    return np.array(array, order="C")


def _columns(sensors: SensorEpochs, epochs: int) -> tuple[Floats, Floats]:
    """Measurements of the wheel, radar, force and place and their standard deviations, shape (T, 4)."""
    value, sigma = np.full((epochs, 4), np.nan), np.ones((epochs, 4))
    for column, (values, sigmas) in enumerate(
        (
            (sensors.wheel_m, sensors.wheel_sigma_m),
            (sensors.radar_m, sensors.radar_sigma_m),
            (sensors.force_mps2, sensors.force_sigma_mps2),
            (sensors.place_m, sensors.place_sigma_m),
        )
    ):
        if values is not None and sigmas is not None:
            value[:, column], sigma[:, column] = values, sigmas
    return value, sigma


@lru_cache(maxsize=8)
def _numbers(kernel: ModuleType, limits: TrackingLimits) -> Any:
    given = {
        "degrees": limits.degrees_of_freedom,
        "least_step_m2": predict.LEAST_STEP_M2,
        "code_clock_sigma_m": predict.CODE_CLOCK_SIGMA_M,
        "wheel_walk": predict.WHEEL_WALK,
        "force_walk_mps2": predict.FORCE_WALK_MPS2,
        "radar_walk": predict.RADAR_WALK,
        "misfit_codes": misfit.CODES,
        "misfit_clipped": misfit.CLIPPED,
        "misfit_learnt_s": misfit.LEARNT_S,
        "misfit_largest": misfit.LARGEST,
        "stepped": clocks.STEPPED,
        "unknown_clock": clocks.UNKNOWN_CLOCK,
        "scale_s": clocks.SCALE_S,
        "least_scale": clocks.SCALE_RANGE[0],
        "largest_scale": clocks.SCALE_RANGE[1],
        "doubtful": DOUBTFUL,
        "freedom_place": float(FREEDOM[0]),
        "freedom_speed": float(FREEDOM[1]),
        "moved_m": MOVED_M,
        "relinearised": RELINEARISED,
        "sensor_floor": SENSOR_FLOOR,
        "direction_mps": rows.DIRECTION_MPS,
        "chord_m": rows.CHORD_M,
        "gravity_mps2": rows.GRAVITY_MPS2,
        "switch": hypotheses.SWITCH,
        "most_odds": hypotheses.MOST_ODDS,
        "decided": DECIDED,
        "tracking": int(TrackStatus.TRACKING),
        "coasting": int(TrackStatus.COASTING),
        "several": int(TrackStatus.SEVERAL_BRANCHES),
        "expired": int(TrackStatus.EXPIRED),
    }
    return kernel.Numbers(
        **{name: given[name] if name in given else getattr(limits, name) for name in kernel.Numbers._fields}
    )
