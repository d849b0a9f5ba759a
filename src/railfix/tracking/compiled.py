"""The recursion with compiled kernels: epochs handed to `railfix.kernels.tracking` and what it returns taken back.

`railfix.kernels.tracking.layout` has the arrays, `railfix.kernels.tracking.recursion` the recursion over them.
"""

from __future__ import annotations

from dataclasses import fields
from functools import lru_cache
from importlib import import_module
from types import ModuleType
from typing import Any, Final

import numpy as np

from railfix.core.arrays import Floats, Indices
from railfix.core.constants import GRAVITY_MPS2
from railfix.core.timescale import seconds, timedelta
from railfix.tracking import bank, branches, clocks, faulty, misfit, monitors, possible_speed, predict, rows
from railfix.tracking.chunk import Chunk
from railfix.tracking.epochs import SensorEpochs
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.predict import singer
from railfix.tracking.result import Tracked, TrackStatus
from railfix.tracking.robust import DOUBTFUL, FREEDOM, MOVED_M, RELINEARISED, SENSOR_FLOOR
from railfix.tracking.state import CLOCKS, OFFSETS, SATELLITES, Bank, TrackState, Unknown

#: Unknowns that are always in use, in the order of the kernel.
_ALWAYS: Final = np.array([
    Unknown.PLACE, Unknown.SPEED, Unknown.ACCELERATION, Unknown.DRIFT, Unknown.MAP_RIGHT, Unknown.MAP_UP,
    Unknown.DOPPLER_SPEED, Unknown.CODE_PLACE,
])  # fmt: skip
#: Unknowns of sensors, as the kernel names them, and the columns of measurements that need them.
_SENSORS: Final = ((Unknown.WHEEL, 0), (Unknown.FORCE_OFFSET, 2), (Unknown.RADAR, 1))
_OF_SENSORS: Final = np.isin(np.arange(OFFSETS), [unknown for unknown, _ in _SENSORS])
#: Unknowns of an epoch, as the kernel orders them after those in use.
_OF_EPOCH: Final = np.array([
    Unknown.BEFORE, Unknown.SPEED_BEFORE, Unknown.PHASE_CLOCK, Unknown.STEP_RIGHT, Unknown.STEP_UP, Unknown.STEP_ALONG,
    Unknown.CODE_CLOCK,
])  # fmt: skip
#: Satellites come and go: the unknowns in use are chosen again after so many epochs.
_EPOCHS: Final = 512


class Compiled:
    """A chunk as the kernel takes it.

    Parameters
    ----------
    chunk : Chunk
    line : Line
    sensors : SensorEpochs
    limits : TrackingLimits
    result : Tracked
        Written to.
    levels : bool
        Whether there are sub-filters.
    """

    def __init__(
        self,
        chunk: Chunk,
        line: Line,
        sensors: SensorEpochs,
        limits: TrackingLimits,
        result: Tracked,
        *,
        levels: bool,
    ) -> None:
        layout, self.recursion = _kernels()
        self.layout, self.chunk, self.line, self.limits, self.result = layout, chunk, line, limits, result
        self.levels = levels
        interval, singers = np.unique(chunk.interval_s, return_inverse=True)
        matrices = [singer(float(dt), limits.acceleration_mps2, limits.acceleration_s) for dt in interval]
        ranged, left = sensors.ranges, chunk.apart | chunk.off_map
        sensor, sigma = _columns(sensors, len(chunk.time))
        if line.closed:
            left = left | np.isfinite(sensor[:, 3])
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
        for name in layout.Epochs._fields:
            if name not in values and name != "unsigned":
                values[name] = getattr(chunk, name)
        arrays = {name: _own(array) for name, array in values.items()}
        self.epochs = layout.Epochs(**arrays, unsigned=sensors.wheel_sign == "unknown")
        self.course = layout.Course(**line.written)
        self.numbers = _numbers(layout, limits)
        written = {field.name: getattr(result, field.name) for field in fields(result)}
        self.answers = layout.Answers(**{name: written[name] for name in layout.Answers._fields})

    def advance(self, state: TrackState, first: int) -> int:
        """Do epochs from `first` on, change the state, and return the first epoch that is left to numpy."""
        limits = self.limits
        if (
            not state.hypotheses
            or np.isnat(state.measured)
            or (state.bank is None and self.levels)
            or self.epochs.left[first]
            or (
                max(state.weak_motion_s - branches.BESIDE_AFTER_S, state.across - monitors.ACROSS_DOUBT) >= 0.0
                and state.hypotheses <= limits.most_hypotheses // 2
            )
            or state.weak_motion_s >= limits.lost_motion_s
            or state.weak_code_s >= limits.lost_code_s
            or state.across >= monitors.ACROSS_LOST
        ):
            return first
        last = min(first + _EPOCHS, len(self.chunk.time))
        full = self._in_use(state, first, last)
        place = np.full(state.mean.shape[1], -1, dtype=np.intp)
        place[full] = np.arange(len(full))
        active = self.layout.Active(
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
            seconds(state.measured - origin), *state.code_shift, state.map_log_scale, *state.speed_range_mps,
            np.nan_to_num(seconds(state.coded - origin), nan=-np.inf), state.branch_s, state.branch_m,
            state.across, state.step_s, state.withheld_s, state.open_s,
        ])  # fmt: skip
        memory = self.layout.Memory(
            mean=_own(state.mean[:, full]),
            covariance=_own(state.covariance[:, full[:, None], full]),
            log_probability=_own(state.log_probability),
            log_code=_own(state.log_code),
            log_least=_own(state.log_least),
            code_bias=_own(state.code_bias),
            origin_m=_own(state.origin_m),
            offset_known=_own(state.offset_known),
            scalars=scalars,
        )
        sub = self._subfilters(state, full)
        rows, work = _work_space(
            self.layout, len(self.epochs.slot), len(full), len(memory.log_probability), len(sub.running)
        )
        done = int(
            self.recursion.advance(
                self.epochs, self.course, self.numbers, active, memory, sub, self.answers, rows, work, first, last
            )
        )
        if done > first:
            self._take_back(state, full, memory, sub, first, done)
        return done

    def _subfilters(self, state: TrackState, full: Indices) -> Any:
        """Sub-filters by source, none of them where levels are off."""
        limits, n = self.limits, len(full)
        names = _sources(state) if self.levels else []
        prior, k, k_speed = (np.zeros(len(names)) for _ in range(3))
        begun = np.zeros(n + len(_OF_EPOCH))
        running, weak = np.zeros(len(names), dtype=np.bool_), np.zeros(len(names))
        mean, covariance = np.zeros((len(names), n)), np.zeros((len(names), n, n))
        if names:
            given, kinds = bank.budget(limits), [bank.kind_of(name) for name in names]
            prior[:], k[:] = np.array(given.prior)[kinds], np.array(given.k_fault)[kinds]
            k_speed[:] = np.array(given.k_speed_fault)[kinds]
            start = np.full(1, limits.expired_sigma_m)
            _, fresh = branches.begin(np.zeros(1), start, len(state.satellite), self.line, limits)
            begun[:] = np.diagonal(fresh[0])[np.concatenate([full, _OF_EPOCH])]
        if names and state.bank is not None:
            at = [names.index(name) for name in state.bank.without if name in names]
            kept = [k for k, name in enumerate(state.bank.without) if name in names]
            running[at], weak[at] = True, state.bank.weak_s[kept]
            mean[at] = state.bank.mean[kept][:, full]
            covariance[at] = state.bank.covariance[kept][:, full[:, None], full]
        clock = [CLOCKS.index(bank.clock_of(name)) for name in state.satellite.tolist()] if names else []
        return self.layout.Subfilters(
            running=running,
            mean=mean,
            covariance=covariance,
            weak_s=weak,
            prior=prior,
            k=k,
            k_speed=k_speed,
            begun=begun,
            clock=np.array(clock, dtype=np.intp),
        )

    def _in_use(self, state: TrackState, first: int, last: int) -> Indices:
        """Unknowns that are measured in some epochs, or correlated with others."""
        covariance = state.covariance
        correlated = np.count_nonzero(covariance, axis=1).max(axis=0) > 1
        if state.bank is not None and len(state.bank.without):
            correlated |= np.count_nonzero(state.bank.covariance, axis=1).max(axis=0) > 1
        for unknown, column in _SENSORS:
            correlated[unknown] |= self.sensed[column]
        chunk = self.chunk
        channels = np.flatnonzero(chunk.has[:, first:last].any(axis=(0, 1)))
        correlated[OFFSETS + chunk.offset[channels]] = True
        correlated[SATELLITES + chunk.slot[channels]] = True
        correlated[:OFFSETS] &= _OF_SENSORS
        return np.concatenate([_ALWAYS, np.flatnonzero(correlated)]).astype(np.intp)

    def _take_back(self, state: TrackState, full: Indices, memory: Any, sub: Any, first: int, done: int) -> None:
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

        def whole(means: Floats, covariances: Floats) -> tuple[Floats, Floats]:
            mean = np.repeat(idle[None], len(means), axis=0)
            covariance = np.zeros((len(means), len(idle), len(idle)))
            covariance[:, np.arange(len(idle)), np.arange(len(idle))] = variance
            mean[:, full] = means
            covariance[:, full[:, None], full] = covariances
            return mean, covariance

        placed = slice(first, done)
        known = np.isfinite(self.result.arc_m[placed])
        for name, unknown in (
            ("wheel_scale", Unknown.WHEEL),
            ("force_offset_mps2", Unknown.FORCE_OFFSET),
            ("radar_scale", Unknown.RADAR),
        ):
            if unknown not in full:
                getattr(self.result, name)[placed][known] = idle[unknown]
        state.mean, state.covariance = whole(memory.mean[:count], memory.covariance[:count])
        if self.levels:
            running = np.flatnonzero(sub.running)
            names = _sources(state)
            means, covariances = whole(sub.mean[running], sub.covariance[running])
            state.bank = Bank(
                without=tuple(names[k] for k in running), mean=means, covariance=covariances, weak_s=sub.weak_s[running]
            )
        state.log_probability = memory.log_probability[:count].copy()
        state.log_code = memory.log_code[:count].copy()
        state.log_least = memory.log_least[:count].copy()
        state.code_bias = memory.code_bias.copy()
        state.origin_m = memory.origin_m[:count].copy()
        state.time = self.chunk.time[done - 1]
        _, motion, code, doppler, phase, unaided, direction, measured, *learnt = memory.scalars.tolist()
        state.weak_motion_s, state.weak_code_s, state.log_scale = motion, code, (doppler, phase)
        state.unaided_m, state.direction = unaided, direction
        state.code_shift, state.map_log_scale = (learnt[0], learnt[1]), learnt[2]
        state.speed_range_mps = (learnt[3], learnt[4])
        state.measured = self.chunk.time[0] + timedelta(measured)
        state.coded = self.chunk.time[0] + timedelta(learnt[5])
        state.branch_s, state.branch_m = learnt[6], learnt[7]
        state.across, state.step_s, state.withheld_s, state.open_s = learnt[8:12]


def _kernels() -> tuple[ModuleType, ModuleType]:
    """Layout and recursion; imported only where numba is used."""
    package = "railfix.kernels.tracking"
    return import_module(f"{package}.layout"), import_module(f"{package}.recursion")


def _work_space(layout: ModuleType, channels: int, unknowns: int, hypotheses: int, sources: int) -> tuple[Any, Any]:
    """Lists of rows and work space of the kernel for so many channels, compact unknowns and hypotheses."""
    sensors, width, room = len(bank.SENSORS), unknowns + len(_OF_EPOCH), hypotheses + 1
    most = 3 * channels + sensors
    size = channels + layout.COMBINED + sensors
    shapes = {
        "mean": (room, width), "spread": (room, width, width), "now": (room,), "before": (room,),
        "design": (room, most, 4), "value": (room, most), "innovation": (room, most), "sensed": (room, sensors, 6),
        "cross": (room, size, width), "root": (room, size), "own": (room, size, size),
        "information": (room, size, size), "after": (room, size, size), "change": (room, size),
        "weight": (room, most), "residual": (room, most), "fitted": (room, most), "new_mean": (room, unknowns + 1),
        "new_covariance": (room, unknowns, unknowns), "log_before": (room,), "log_after": (room,),
        "evidence": (room,), "code_evidence": (room,), "joined": (4, room), "branch": (room, 3),
        "pushed": (room,), "variance": (most,), "masked": (most,),
        "system": (room, size, size), "factor": (size, size), "lower": (size, size), "right": (max(size, room),),
        "diagonal": (size,), "with_clock": (size,),
        "ordered": (most,), "part": (4,), "gain": (size, unknowns + 1), "less": (size, unknowns),
        "stepped": (width, unknowns), "faded": (unknowns,), "share": (size, 6), "sight": (channels, 7), "bend": (2,),
        "point": (2, 3), "axes": (2, 3, 3), "places": (room, 3), "place_axes": (room, 3, 3),
    }  # fmt: skip
    work = layout.Work(
        **{name: np.zeros(shape) for name, shape in shapes.items()},
        anew=np.zeros((room, 2), dtype=np.bool_),
        source=np.zeros(sources, dtype=np.bool_),
        met=np.zeros(sources, dtype=np.bool_),
        ranked=np.empty(room, dtype=np.intp),
        kept=np.empty(room, dtype=np.intp),
        unknown=np.empty((size, 6), dtype=np.intp),
    )
    listed = (np.empty(length, dtype=np.intp) for length in (channels, channels, channels, sensors, 4))
    return layout.Rows(*listed), work


def _sources(state: TrackState) -> list[str]:
    """Sources of sub-filters in the order of the kernel."""
    return [*state.satellite.tolist(), *CLOCKS, *bank.SENSORS.values(), *bank.OTHERS]


def _own(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """A writable copy, row by row: one type of arrays for the compiler."""
    return np.array(array, order="C")


def _columns(sensors: SensorEpochs, epochs: int) -> tuple[Floats, Floats]:
    """Measurements of the wheel, radar, force and place and their standard deviations, shape (T, len(bank.SENSORS)).

    The column of ranges is blank: their epochs are left to numpy.
    """
    shape = (epochs, len(bank.SENSORS))
    value, sigma = np.full(shape, np.nan), np.ones(shape)
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
def _numbers(layout: ModuleType, limits: TrackingLimits) -> Any:
    given = {
        "degrees": tuple(limits.tails),
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
        "speed_sigmas": possible_speed.SPEED_SIGMAS,
        "direction_mps": rows.DIRECTION_MPS,
        "chord_m": rows.CHORD_M,
        "gravity_mps2": GRAVITY_MPS2,
        "beside_after_s": branches.BESIDE_AFTER_S,
        "switch": branches.SWITCH,
        "most_odds": branches.MOST_ODDS,
        "most_motion": branches.MOST_MOTION,
        "motion_m": branches.MOTION_M,
        "least_rise": branches.LEAST_RISE,
        "takeover": branches.TAKEOVER,
        "takeover_after_s": branches.TAKEOVER_AFTER_S,
        "level_risk": bank.budget(limits).risk,
        "level_k": bank.budget(limits).k,
        "level_k_speed": bank.budget(limits).k_speed,
        "precision_m": bank.PRECISION_M,
        "rounds": bank.ROUNDS,
        "scale_bound": bank.SCALE_BOUND,
        "joined": bank.JOINED,
        "tracking": int(TrackStatus.TRACKING),
        "coasting": int(TrackStatus.COASTING),
        "several": int(TrackStatus.SEVERAL_BRANCHES),
        "expired": int(TrackStatus.EXPIRED),
        "unsure": int(TrackStatus.DOUBTFUL),
        "motion_leak": clocks.MOTION_LEAK,
        "bias_memory_s": faulty.MEMORY_S,
        "bias_most": faulty.MOST,
        "bias_faulty": faulty.FAULTY,
        "bias_inflated": faulty.INFLATED,
        "freed_m": faulty.FREED_M,
        "freed_sigmas": faulty.FREED_SIGMAS,
        "code_leak": clocks.CODE_LEAK,
        "misfit_most": misfit.MOST_SIGMAS,
        "reach_sigmas": monitors.REACH_SIGMAS,
        "reach_m": monitors.REACH_M,
        "velocity_floor_mps": monitors.VELOCITY_FLOOR_MPS,
        "direction_share": monitors.DIRECTION_SHARE,
        "largest_square": monitors.LARGEST_SQUARE,
        "allowed_square": monitors.ALLOWED_SQUARE,
        "across_doubt": monitors.ACROSS_DOUBT,
        "across_lost": monitors.ACROSS_LOST,
        "across_taken": monitors.ACROSS_TAKEN,
        "drift_sigmas": monitors.DRIFT_SIGMAS,
        "drift_log": 2.0 * float(np.log(monitors.DRIFT_SCALE)),
        "young": monitors.YOUNG,
        "young_held_s": monitors.YOUNG_HELD_S,
        "beside_sigmas": monitors.BESIDE_SIGMAS,
        "beside_m": monitors.BESIDE_M,
        "motion_satellites": branches.MOTION_SATELLITES,
        "step_sigmas": monitors.STEP_SIGMAS,
        "step_s": monitors.STEP_S,
        "step_held_s": monitors.STEP_HELD_S,
    }
    return layout.Numbers(
        **{name: given[name] if name in given else getattr(limits, name) for name in layout.Numbers._fields}
    )
