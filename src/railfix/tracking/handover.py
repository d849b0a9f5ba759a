"""State of the filter as the compiled recursion takes it: the unknowns in use, and work space."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.timescale import seconds, timedelta
from railfix.kernels.tracking import layout
from railfix.kernels.tracking.constants import FORCE_WALK_MPS2, RADAR_WALK, WHEEL_WALK
from railfix.tracking import bank
from railfix.tracking.chunk import Chunk
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.search import begin
from railfix.tracking.smoother import Updated
from railfix.tracking.state import CLOCKS, OFFSETS, SATELLITES, Bank, StateIndex, TrackState

if TYPE_CHECKING:
    from railfix.tracking.filter import Recursion

#: Unknowns that are always in use, in the order of the kernel.
_ALWAYS: Final = np.array([
    StateIndex.ARC, StateIndex.SPEED, StateIndex.ACCELERATION, StateIndex.DRIFT, StateIndex.MAP_RIGHT,
    StateIndex.MAP_UP, StateIndex.DOPPLER_SPEED, StateIndex.CODE_PLACE,
])  # fmt: skip
#: Unknowns of sensors, as the kernel names them, the columns of measurements that need them, and their random walks.
_SENSORS: Final = (
    (int(StateIndex.WHEEL), layout.WHEEL_ROW, WHEEL_WALK),
    (int(StateIndex.FORCE_OFFSET), layout.FORCE_ROW, FORCE_WALK_MPS2),
    (int(StateIndex.RADAR), layout.RADAR_ROW, RADAR_WALK),
)
#: Fields of the result that these unknowns are.
_RESULTS: Final = ("wheel_scale", "force_offset_mps2", "radar_scale")
_OF_SENSORS: Final = np.isin(np.arange(OFFSETS), [unknown for unknown, _, _ in _SENSORS])
#: Unknowns of an epoch, as the kernel orders them after those in use.
_OF_EPOCH: Final = np.array([
    StateIndex.PREVIOUS_ARC, StateIndex.PREVIOUS_SPEED, StateIndex.PHASE_CLOCK, StateIndex.STEP_RIGHT,
    StateIndex.STEP_UP, StateIndex.MAP_LENGTH_ERROR, StateIndex.CODE_CLOCK,
])  # fmt: skip


class Handover:
    """State of the filter as the kernel takes it at some epochs, with its work space.

    Parameters
    ----------
    recursion : Recursion
    state : TrackState
    first, last : int
        Epochs that it is for.
    every : bool
        Whether all unknowns are handed over, not only those in use.
    predicted : bool
        Whether the state is that before the measurements of `first`.
    """

    def __init__(
        self,
        recursion: Recursion,
        state: TrackState,
        first: int,
        last: int,
        *,
        every: bool = False,
        predicted: bool = False,
    ) -> None:
        self.recursion, self.first, self.last, self.predicted = recursion, first, last, predicted
        chunk, limits = recursion.chunk, recursion.limits
        in_use = _in_use(state, chunk, recursion.sensed, first, last)
        in_use[:] |= every
        in_use[:OFFSETS] &= _OF_SENSORS
        self.full = np.concatenate([_ALWAYS, in_use.nonzero()[0]]).astype(np.intp)
        self.both = np.concatenate([self.full, _OF_EPOCH])
        full, place = self.full, np.full(state.mean.shape[1], -1, dtype=np.intp)
        place[full] = np.arange(len(full))
        self.active = layout.Active(
            full=full, wheel=int(place[StateIndex.WHEEL]), force=int(place[StateIndex.FORCE_OFFSET]),
            radar=int(place[StateIndex.RADAR]), offset=place[OFFSETS:SATELLITES].copy(),
            satellite=place[SATELLITES:].copy(),
        )  # fmt: skip
        origin = chunk.time[0]
        scalars = np.array([
            state.hypotheses, state.weak_motion_s, state.weak_code_s, *state.log_scale, state.distance_since_code_m,
            state.direction, seconds(state.measured - origin), *state.code_shift, state.map_log_variance,
            *state.speed_range_mps, np.fmax(seconds(state.coded - origin), -np.inf), state.branch_s,
            state.branch_m, state.across, state.step_s, state.withheld_s, state.open_s, state.motion_misfit,
        ])  # fmt: skip
        self.memory = layout.KernelState(
            # writable copies, row by row: one type of arrays for the compiler
            mean=np.array(state.mean[:, full], order="C"),
            covariance=np.array(state.covariance[:, full[:, None], full], order="C"),
            log_probability=np.array(state.log_probability),
            log_code=np.array(state.log_code),
            log_least=np.array(state.log_least),
            log_recent=np.array(state.log_recent),
            code_bias=np.array(state.code_bias),
            origin_m=np.array(state.origin_m),
            offset_known=np.array(state.offset_known),
            scalars=scalars,
        )
        self.names = _sources(state) if recursion.levels else []
        self.subfilters = _subfilters(state, full, self.names, recursion.line, limits)
        sensors = recursion.epochs.sensor.shape[1]
        self.rows, self.work = _work_space(len(chunk.slot), sensors, len(full), state.hypotheses, len(self.names))
        if predicted:
            self.work.mean[: state.hypotheses] = state.mean[:, self.both]
            self.work.spread[: state.hypotheses] = state.covariance[:, self.both[:, None], self.both]

    def run(self, part: int) -> int:
        """Run the kernel; return the first epoch that it has not done."""
        given = self.recursion
        return int(
            given.kernel(
                layout.Inputs(given.epochs, given.course, given.parameters, self.active), self.memory,
                self.subfilters, given.answers, self.rows, self.work, (self.first, self.last), part,
            )
        )  # fmt: skip

    def take_back_prediction(self, state: TrackState, epoch: int) -> None:
        """Put the prediction to an epoch into the state."""
        count, elapsed = state.hypotheses, float(self.recursion.chunk.interval_s[epoch])
        idle = self._idle(state, elapsed)
        state.mean, state.covariance = _scatter(self.both, self.work.mean[:count], self.work.spread[:count], *idle)
        state.code_bias, state.origin_m = self.memory.code_bias, self.memory.origin_m
        self._take_back_bank(state, *idle)

    def take_back(self, state: TrackState, first: int, done: int) -> None:
        """Put what the kernel leaves into the state; unknowns that are not in use only walk."""
        chunk, result, memory = self.recursion.chunk, self.recursion.result, self.memory
        idle = self._idle(state, 0.0 if self.predicted else float(chunk.interval_s[first:done].sum()))
        placed = slice(first, done)
        known = np.isfinite(result.arc_m[placed])
        for name, (unknown, _, _) in zip(_RESULTS, _SENSORS, strict=True):
            if unknown not in self.full:
                getattr(result, name)[placed][known] = idle[0][unknown]
        count, *scalars = memory.scalars.tolist()
        kept = slice(0, int(count))
        state.mean, state.covariance = _scatter(self.full, memory.mean[kept], memory.covariance[kept], *idle)
        self._take_back_bank(state, *idle)
        state.log_probability = memory.log_probability[kept].copy()
        state.log_code, state.log_least = memory.log_code[kept].copy(), memory.log_least[kept].copy()
        state.log_recent = memory.log_recent[kept].copy()
        state.origin_m = memory.origin_m[kept].copy()
        state.code_bias, state.offset_known = memory.code_bias, memory.offset_known
        state.time, origin = chunk.time[done - 1], chunk.time[0]
        state.weak_motion_s, state.weak_code_s, doppler, phase, state.distance_since_code_m, state.direction = scalars[
            :6
        ]
        state.log_scale, state.code_shift, state.map_log_variance = (
            (doppler, phase),
            (scalars[7], scalars[8]),
            scalars[9],
        )
        state.measured = origin + timedelta(scalars[6])
        state.speed_range_mps, state.coded = (scalars[10], scalars[11]), origin + timedelta(scalars[12])
        state.branch_s, state.branch_m = scalars[13:15]
        state.across, state.step_s, state.withheld_s, state.open_s, state.motion_misfit = scalars[15:20]

    def _take_back_bank(self, state: TrackState, mean: Floats, variance: Floats) -> None:
        """Put the sub-filters that there are into the state."""
        if not self.names:
            return
        running = self.subfilters.running.nonzero()[0]
        means, covariances = _scatter(
            self.full, self.subfilters.mean[running], self.subfilters.covariance[running], mean, variance
        )
        state.bank = Bank(
            without=tuple(self.names[k] for k in running),
            mean=means,
            covariance=covariances,
            weak_s=self.subfilters.weak_s[running],
        )

    def _idle(self, state: TrackState, elapsed_s: float) -> tuple[Floats, Floats]:
        """Return the mean and variance of unknowns that are not in use, after so many seconds of random walks."""
        mean, variance = state.mean[0].copy(), state.covariance[0].diagonal().copy()
        for unknown, _, walk in _SENSORS:
            variance[unknown] += walk**2 * elapsed_s
        variance[OFFSETS:SATELLITES] += self.recursion.limits.offset_walk_m**2 * elapsed_s
        return mean, variance

    def collect_update(self, state: TrackState, epoch: int) -> tuple[Updated | None, Masks]:
        """Return the update of an epoch, None where nothing was used, and the unknowns that have restarted."""
        work, count, both = self.work, state.hypotheses, self.both
        cut = np.zeros(state.mean.shape, dtype=np.bool_)
        if self.memory.scalars[layout.MEASURED] != self.recursion.epochs.time_s[epoch]:
            return None, cut
        cut[:, [StateIndex.PHASE_CLOCK, StateIndex.DRIFT]] = work.restarted[:count, :2]
        if self.rows.counts[0]:
            cut[:, OFFSETS + self.recursion.chunk.offset[self.rows.codes[0]]] = work.restarted[:count, 2]
        size = int(self.rows.counts[0] + layout.COMBINED + self.rows.counts[3])
        _, prior = _scatter(both, work.mean[:count], work.spread[:count], *self._idle(state, 0.0))
        combine = np.zeros((count, size, state.mean.shape[1]))
        at = both[work.unknown[:count, :size]]
        np.add.at(combine, (*np.ogrid[:count, :size, :0][:2], at), work.share[:count, :size])
        return Updated(
            prior=prior,
            combine=combine,
            information=work.information[:count, :size, :size].copy(),
            covariance=work.after[:count, :size, :size].copy(),
            change=work.change[:count, :size].copy(),
        ), cut


def _in_use(state: TrackState, chunk: Chunk, sensed: Masks, first: int, last: int) -> Masks:
    """Return the unknowns that are measured in some epochs, or correlated with others, shape (N,)."""
    used = (state.covariance != 0.0).sum(axis=1).max(axis=0) > 1
    if state.bank is not None and len(state.bank.without):
        used |= (state.bank.covariance != 0.0).sum(axis=1).max(axis=0) > 1
    for unknown, column, _ in _SENSORS:
        used[unknown] |= sensed[column]
    channels = np.flatnonzero(chunk.has[:, first:last].any(axis=(0, 1)))
    used[OFFSETS + chunk.offset[channels]] = True
    used[SATELLITES + chunk.slot[channels]] = True
    return np.asarray(used)


def _scatter(
    at: Indices, means: Floats, covariances: Floats, idle_mean: Floats, idle_variance: Floats
) -> tuple[Floats, Floats]:
    """Gaussians of all unknowns from those `at` some of them; the others are independent."""
    every = np.arange(len(idle_mean))
    mean = idle_mean[None].repeat(len(means), axis=0)
    covariance = np.zeros((len(means), len(every), len(every)))
    covariance[:, every, every] = idle_variance
    mean[:, at] = means
    covariance[:, at[:, None], at] = covariances
    return mean, covariance


def _subfilters(
    state: TrackState, full: Indices, names: list[str], line: Line, limits: TrackingLimits
) -> layout.Subfilters:
    """Return the sub-filters by source, none of them where levels are off."""
    n = len(full)
    begun, parameters = np.zeros(n + len(_OF_EPOCH)), _source_parameters(tuple(names), limits)
    running, weak = np.zeros(len(names), dtype=np.bool_), np.zeros(len(names))
    mean, covariance = np.zeros((len(names), n)), np.zeros((len(names), n, n))
    if names:
        start = np.full(1, limits.expired_sigma_m)
        _, fresh = begin(np.zeros(1), start, len(state.satellite), line, limits)
        begun[:] = np.diagonal(fresh[0])[np.concatenate([full, _OF_EPOCH])]
    if names and state.bank is not None:
        kept = [k for k, name in enumerate(state.bank.without) if name in names]
        at = [names.index(state.bank.without[k]) for k in kept]
        running[at], weak[at] = True, state.bank.weak_s[kept]
        mean[at] = state.bank.mean[kept][:, full]
        covariance[at] = state.bank.covariance[kept][:, full[:, None], full]
    clock = [CLOCKS.index(bank.get_clock(name)) for name in state.satellite.tolist()] if names else []
    return layout.Subfilters(
        running=running, mean=mean, covariance=covariance, weak_s=weak, **parameters, begun=begun,
        clock=np.array(clock, dtype=np.intp),
    )  # fmt: skip


@lru_cache(maxsize=64)
def _source_parameters(names: tuple[str, ...], limits: TrackingLimits) -> dict[str, Floats]:
    """Return the prior and factors of sub-filters by their source, which the kernel only reads."""
    given, kinds = bank.budget(limits), np.array([bank.classify_source(name) for name in names], dtype=np.intp)
    return {
        "prior": np.array(given.prior)[kinds],
        "k": np.array(given.k_fault)[kinds],
        "k_speed": np.array(given.k_speed_fault)[kinds],
    }


def _work_space(
    channels: int, sensors: int, unknowns: int, hypotheses: int, sources: int
) -> tuple[layout.Rows, layout.Work]:
    """Return the lists of rows and work space of the kernel for so many channels, compact unknowns and hypotheses."""
    width, room = unknowns + len(_OF_EPOCH), hypotheses + 1
    pairs = sources * (sources - 1) // 2
    most = 3 * channels + sensors
    size = channels + layout.COMBINED + sensors
    lanes = whole_lanes(size)
    shapes = {
        "mean": (room, width), "spread": (room, width, width), "now": (room,), "before": (room,),
        "design": (room, most, 4), "value": (room, most), "innovation": (room, most), "sensed": (room, sensors, 6),
        "cross": (room, size, whole_lanes(width)), "root": (room, size), "own": (room, size, lanes),
        "information": (room, size, lanes), "after": (room, size, lanes), "change": (room, lanes),
        "weight": (room, most), "residual": (room, most), "fitted": (room, most), "new_mean": (room, unknowns + 1),
        "new_covariance": (room, unknowns, whole_lanes(unknowns)), "log_before": (room,), "log_after": (room,),
        "evidence": (room,), "code_evidence": (room,), "joined": (5, room), "branch": (room + pairs, 4),
        "beyond": (room,), "variance": (most,), "masked": (most,),
        "system": (1, size, lanes), "factor": (size, lanes), "lower": (2 * lanes + 1, lanes), "pivots": (3, lanes),
        "right": (max(size, room),), "diagonal": (size,), "with_clock": (lanes,),
        "ordered": (most,), "part": (layout.MOTION,), "scaled": (size,),
        "normal": (layout.MOTION, layout.MOTION + 1), "motion": (layout.MOTION, layout.MOTION + 1),
        "joint": (layout.MOTION, lanes), "found": (size + 1, whole_lanes(unknowns + 3)),
        "stepped": (width, unknowns), "faded": (unknowns,), "share": (room, size, 6), "sight": (channels, 7),
        "bend": (2,), "point": (2, 3), "axes": (2, 3, 3), "places": (room, 3), "place_axes": (room, 3, 3),
    }  # fmt: skip
    work = layout.Work(
        **{name: np.zeros(shape) for name, shape in shapes.items()}, restarted=np.zeros((room, 3), dtype=np.bool_),
        source=np.zeros(sources, dtype=np.bool_), met=np.zeros(sources, dtype=np.bool_),
        ranked=np.empty(room, dtype=np.intp), kept=np.empty(room, dtype=np.intp),
        unknown=np.zeros((room, size, 6), dtype=np.intp),
    )  # fmt: skip
    work.lower[lanes:-1], work.pivots[2] = np.eye(lanes), 1.0
    listed = (np.empty(length, dtype=np.intp) for length in (channels, channels, channels, sensors, 4))
    return layout.Rows(*listed), work


def whole_lanes(size: int) -> int:
    """Return a length as whole vectors of the processor (`railfix.kernels.tracking.algebra`)."""
    return -(-size // layout.LANES) * layout.LANES


def _sources(state: TrackState) -> list[str]:
    """Return the sources of sub-filters in the order of the kernel."""
    return [*state.satellite.tolist(), *CLOCKS, *bank.SENSORS.values(), *bank.OTHERS]
