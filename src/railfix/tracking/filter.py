"""The filter along the track: epochs in, places along the trajectory and the state for the next epochs out.

`railfix.kernels.tracking.layout` has the arrays, `railfix.kernels.tracking.recursion` the recursion over them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from railfix.core.arrays import copy_with
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking import layout
from railfix.tracking.chunk import Chunk, finish_chunk, prepare_chunk
from railfix.tracking.epochs import GnssEpochs, SensorEpochs
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.packing import (
    compute_start_variance,
    pack_parameters,
    pack_sensors,
    pack_state,
    unpack_state,
)
from railfix.tracking.result import Tracked, TrackStatus, new_results
from railfix.tracking.search import Sought, seek
from railfix.tracking.smoother import Step, Updated
from railfix.tracking.state import SATELLITES, StateIndex, TrackState

if TYPE_CHECKING:
    from collections.abc import Callable


class Recursion:
    """A chunk as the kernel takes it.

    Parameters
    ----------
    chunk : Chunk
    line : Line
    sensors : SensorEpochs
    limits : TrackingLimits
    start_state : TrackState
        State before the chunk, with the errors of its satellites.
    levels : bool
        Whether there are sub-filters.
    """

    def __init__(
        self,
        chunk: Chunk,
        line: Line,
        sensors: SensorEpochs,
        limits: TrackingLimits,
        start_state: TrackState,
        *,
        levels: bool,
    ) -> None:
        self.kernel = _kernel()
        self.chunk, self.line, self.limits, self.levels = chunk, line, limits, levels
        self.results = new_results(len(chunk.time), len(chunk.satellite))
        vertex, whole = line.records
        self.given = layout.Given(
            epoch=chunk.epoch, channel=chunk.channel, sensor=pack_sensors(sensors, chunk.time), fresh=chunk.fresh,
            within_memory=chunk.within_memory, vertex=vertex, line=whole,
            parameters=pack_parameters(limits, line.sigma_plan_m),
            start_variance=compute_start_variance(start_state, line, limits),
        )  # fmt: skip

    def advance(self, state: TrackState, first: int, trace: list[Step] | None) -> tuple[int, bool]:
        """Do epochs from `first` on and change the state; return the next, and whether places have to be sought there.

        One at a time where the smoother needs something of each.
        """
        last = len(self.chunk.time) if trace is None else first + 1
        parents = Sought(lost=False, parent=np.arange(state.hypotheses), splits=None)
        done = self._run(state, first, last, ix.WHOLE, parents, trace)
        return done, done < last

    def search(self, state: TrackState, epoch: int, trace: list[Step] | None) -> None:
        """Do an epoch before which places have to be sought."""
        chunk = self.chunk
        if state.hypotheses:
            packed = pack_state(state, chunk.time[0], self.limits, levels=self.levels)
            self.kernel(self.given, packed, self.results, _new_trace(0, 0, 0), (epoch, epoch + 1), ix.PREDICTION)
            unpack_state(state, packed, chunk.time[0])
        else:
            state.code_bias = np.where(chunk.fresh[epoch], 0.0, state.code_bias)
        found = seek(state, chunk, epoch, self.line, self.limits)
        state.time = chunk.time[epoch]
        if not state.hypotheses:
            if trace is not None:
                trace.append(Step.without_place(state, float(chunk.epoch["interval_s"][epoch])))
            return
        if found.lost:
            state.bank = None
        self._run(state, epoch, epoch + 1, ix.REST_LOST if found.lost else ix.REST, found, trace)

    def _run(self, state: TrackState, first: int, last: int, part: int, found: Sought, trace: list[Step] | None) -> int:
        """Run the recursion over epochs, change the state, and return the first epoch that is not done."""
        count, width = state.mean.shape
        rows = 3 * len(self.chunk.satellite) + self.given.sensor.shape[1]
        traced = _new_trace(0, 0, 0) if trace is None else _new_trace(count, rows, width)
        packed = pack_state(state, self.chunk.time[0], self.limits, levels=self.levels)
        done = int(self.kernel(self.given, packed, self.results, traced, (first, last), part))
        if done > first:
            unpack_state(state, packed, self.chunk.time[0])
            state.time = self.chunk.time[done - 1]
            if trace is not None:
                trace.append(self._make_step(state, first, traced, found))
        return done

    def _make_step(self, state: TrackState, epoch: int, traced: layout.Trace, found: Sought) -> Step:
        """Return what the smoother needs of an epoch."""
        measured = bool(np.isfinite(traced.variance).any())
        cut = traced.restarted
        cut[:, SATELLITES + self.chunk.fresh[epoch].nonzero()[0]] = True
        updated = Updated(prior=traced.prior, row=traced.row, value=traced.value, variance=traced.variance)
        step = Step(
            dt=float(self.chunk.epoch["interval_s"][epoch]), cut=cut, satellite=state.satellite, parent=found.parent,
            splits=found.splits, updated=updated if measured else None,
        )  # fmt: skip
        step.choose(traced.kept[: state.hypotheses])
        step.mean, step.covariance = state.mean, state.covariance
        return step


def _new_trace(hypotheses: int, rows: int, unknowns: int) -> layout.Trace:
    """Return room for what the smoother needs of an epoch, none of it measured."""
    return layout.Trace(
        prior=np.zeros((hypotheses, unknowns, unknowns)), row=np.zeros((hypotheses, rows, unknowns)),
        value=np.zeros((hypotheses, rows)), variance=np.full((hypotheses, rows), np.inf),
        restarted=np.zeros((hypotheses, unknowns), dtype=np.bool_), kept=np.arange(hypotheses),
    )  # fmt: skip


def _kernel() -> Callable[..., int]:
    """Return the compiled recursion; numba is imported here, for what runs no filter does without."""
    from railfix.kernels.tracking.recursion import advance

    return advance


def track(
    epochs: GnssEpochs,
    line: Line,
    state: TrackState | None = None,
    *,
    limits: TrackingLimits | None = None,
    sensors: SensorEpochs | None = None,
    levels: bool = False,
    trace: list[Step] | None = None,
) -> tuple[Tracked, TrackState]:
    """Return places along the trajectory, each from its own and earlier epochs.

    The recursion is compiled (`railfix.kernels.tracking.recursion`); with ``NUMBA_DISABLE_JIT=1`` in the environment
    the same code runs as plain Python, for a debugger.

    Parameters
    ----------
    epochs : GnssEpochs
        T epochs in rising time; those without any measurement are predicted.
    line : Line
    state : TrackState, optional
        Left by the epochs before; None at the start.
    limits : TrackingLimits, optional
    sensors : SensorEpochs, optional
    levels : bool
        Whether a bank of sub-filters gives a level at every epoch (`railfix.tracking.levels`: at a lower rate).
    trace : list of Step, optional
        Gets what the smoother needs of each epoch (`railfix.tracking.smoother`).

    Returns
    -------
    Tracked
    TrackState
        Epochs one by one with the state handed on give the same numbers as all at once.
    """
    limits, sensors = limits or TrackingLimits(), sensors or SensorEpochs()
    state = TrackState.empty() if state is None else copy_with(state)
    if not len(epochs):
        return Tracked.empty(epochs.time, len(epochs.satellite)), state
    chunk = prepare_chunk(epochs, state, limits)
    recursion = Recursion(chunk, line, sensors, limits, state, levels=levels)
    epoch, sought = 0, False
    while epoch < len(epochs):
        lost = not np.isfinite(state.mean[:, StateIndex.ARC]).all()
        if lost or chunk.apart[epoch] or chunk.off_map[epoch]:
            state.reset()
        if chunk.off_map[epoch]:
            state.time, recursion.results.epoch["status"][epoch] = chunk.time[epoch], TrackStatus.OFF_MAP
            if trace is not None:
                trace.append(Step.without_place(state, float(chunk.epoch["interval_s"][epoch])))
            epoch += 1
            continue
        if state.hypotheses and not sought:
            epoch, sought = recursion.advance(state, epoch, trace)
        else:
            recursion.search(state, epoch, trace)
            epoch, sought = epoch + 1, False
    finish_chunk(chunk, epochs, state)
    result = Tracked.from_records(epochs.time, recursion.results)
    np.add(result.arc_m, line.round_m(result.arc_m), out=result.arc_m)
    return result, state
