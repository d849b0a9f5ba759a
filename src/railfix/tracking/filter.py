"""Along-track filter: positions along the trajectory from epochs of measurements and the previous state.

`railfix.kernels.tracking.layout` defines the arrays, and `railfix.kernels.tracking.recursion` the recursion.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from railfix.core.arrays import Floats, Indices, Strings, copy_with
from railfix.kernels.tracking import constants, layout
from railfix.kernels.tracking import index as ix
from railfix.kernels.tracking.layout import Trace
from railfix.tracking.chunk import Chunk, finish_chunk, prepare_chunk
from railfix.tracking.epochs import GnssEpochs, SensorEpochs
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.packing import pack_parameters, pack_sensors, pack_state, unpack_state
from railfix.tracking.result import Tracked, TrackStatus, new_results
from railfix.tracking.search import Sought, SplitHypothesis, begin, seek
from railfix.tracking.state import TrackState


@dataclass(kw_only=True)
class Step:
    """Result of one filter epoch with H hypotheses."""

    dt: float  #: Interval since the previous epoch [s].
    satellite: Strings  #: Satellites whose errors are in the state, shape (N - ix.SATELLITES,).
    trace: Trace | None = None  #: Measurements and restarted unknowns of the epoch; None if there is no hypothesis.
    #: Means and covariances after the epoch, shapes (H, N) and (H, N, N).
    mean: Floats = field(default_factory=lambda: np.empty((0, 0)))
    covariance: Floats = field(default_factory=lambda: np.empty((0, 0, 0)))
    #: For each hypothesis, its index at the previous epoch, shape (H,); -1 if it is new.
    parent: Indices = field(default_factory=lambda: np.empty(0, dtype=np.intp))
    splits: list[SplitHypothesis | None] | None = None  #: For each hypothesis, the split that produced it, or None.
    tilt_scale: float = 1.0  #: Error of the ionospheric model divided by its error in a quiet ionosphere.


class Recursion:
    """Kernel inputs and results of a chunk; `start_state` is the initial state, as modified by `prepare_chunk`."""

    def __init__(
        self, chunk: Chunk, line: Line, sensors: SensorEpochs, limits: TrackingLimits, start_state: TrackState, *,
        levels: bool,
    ) -> None:  # fmt: skip
        from railfix.kernels.tracking.recursion import advance  # imports numba: only if the filter is on

        self.kernel = advance
        self.chunk, self.line, self.limits, self.levels = chunk, line, limits, levels
        self.results = new_results(len(chunk.time), len(chunk.satellite))
        vertex, whole = line.records
        _, unknown = begin(np.zeros(1), len(start_state.satellite), line, limits, sigma_m=constants.EXPIRED_SIGMA_M)
        self.given = layout.Given(
            epoch=chunk.epoch, channel=chunk.channel, sensor=pack_sensors(sensors, chunk.time), fresh=chunk.fresh,
            within_memory=chunk.within_memory, vertex=vertex, line=whole,
            parameters=pack_parameters(limits, line.sigma_plan_m),
            start_variance=np.diagonal(unknown[0]).copy(),
        )  # fmt: skip

    def seek(self, state: TrackState, epoch: int, reasons: int, trace: list[Step] | None) -> Sought | None:
        """Search for positions at an epoch to which the hypotheses have already been predicted.

        If no hypothesis exists after the search, finish the epoch and return None.
        """
        if not state.hypotheses:
            state.code_bias = np.where(self.chunk.fresh[epoch], 0.0, state.code_bias)
        found = seek(state, self.chunk, epoch, self.line, self.limits, reasons)
        state.time = self.chunk.time[epoch]
        if state.hypotheses:
            state.bank = None if found.lost else state.bank
            return found
        if trace is not None:
            trace.append(self.make_step(state, epoch))
        return None

    def run(self, state: TrackState, first: int, found: Sought | None, trace: list[Step] | None) -> tuple[int, int]:
        """Process epochs from `first` on, and update the state.

        Only the epoch `first` is processed if `found` is the result of a position search at this epoch, or if a `trace`
        is required. Return the index of the next epoch, and the reasons for a search at this epoch, 0 if none.
        """
        count, width = state.mean.shape
        last = len(self.chunk.time) if trace is None and found is None else first + 1
        sought = ix.NOT_SOUGHT if found is None else ix.SOUGHT_AS_LOST if found.lost else ix.SOUGHT
        rows = 3 * len(self.chunk.satellite) + self.given.sensor.shape[1]
        traced = _new_trace(0, 0, 0) if trace is None else _new_trace(count, rows, width)
        packed = pack_state(state, self.limits, levels=self.levels)
        done, reasons = self.kernel(self.given, packed, self.results, traced, (first, last), sought)
        unpack_state(state, packed)
        if done > first:
            state.time = self.chunk.time[done - 1]
        if done > first and trace is not None:
            step, kept = self.make_step(state, first), traced.kept[: state.hypotheses]
            traced.restarted[:, ix.SATELLITES + self.chunk.fresh[first].nonzero()[0]] = True
            step.trace = layout.Trace._make([values[kept] for values in traced])
            step.mean, step.covariance = state.mean, state.covariance
            step.parent = kept if found is None else found.parent[kept]
            if found is not None and found.splits is not None:
                step.splits = [found.splits[k] for k in kept.tolist()]
            trace.append(step)
        return done, reasons

    def make_step(self, state: TrackState, epoch: int) -> Step:
        """Return the record of an epoch for the smoother, still without hypotheses."""
        own = self.chunk.epoch[epoch]
        return Step(dt=float(own["interval_s"]), satellite=state.satellite, tilt_scale=float(own["tilt_scale"]))


def _new_trace(hypotheses: int, rows: int, unknowns: int) -> layout.Trace:
    """Return an empty trace of an epoch."""
    return layout.Trace(
        prior=np.zeros((hypotheses, unknowns, unknowns)), row=np.zeros((hypotheses, rows, unknowns)),
        value=np.zeros((hypotheses, rows)), variance=np.full((hypotheses, rows), np.inf),
        restarted=np.zeros((hypotheses, unknowns), dtype=np.bool_), kept=np.arange(hypotheses),
    )  # fmt: skip


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
    """Estimate the position at each epoch from measurements up to this epoch (motion model: R. A. Singer, 1970).

    The equations are in docs/filter-equations.md; the compiled recursion is `railfix.kernels.tracking.recursion`.
    Results are the same whether epochs are processed in one call or in several. With ``NUMBA_DISABLE_JIT=1`` in the
    environment, the same code runs as plain Python for debugging.

    Parameters
    ----------
    epochs : GnssEpochs
        T epochs in ascending time; positions of epochs without measurements are predicted.
    line : Line
    state : TrackState, optional
        State after the previous epochs; None at the start.
    limits : TrackingLimits, optional
    sensors : SensorEpochs, optional
    levels : bool
        If True, sub-filters compute a protection level at every epoch. (`railfix.tracking.levels` uses fewer epochs.)
    trace : list of Step, optional
        List to which the record of each epoch is appended for the smoother (`railfix.tracking.smoother`).

    Returns
    -------
    Tracked
    TrackState
        State for the next epochs.
    """
    limits, sensors = limits or TrackingLimits(), sensors or SensorEpochs()
    state = TrackState() if state is None else copy_with(state)
    if not len(epochs):
        return Tracked.empty(epochs.time, len(epochs.satellite)), state
    chunk = prepare_chunk(epochs, state, limits)
    recursion = Recursion(chunk, line, sensors, limits, state, levels=levels)
    epoch, reasons = 0, 0
    while epoch < len(epochs):
        lost = not np.isfinite(state.mean[:, ix.ARC]).all()
        if lost or chunk.epoch["begins"][epoch]:
            state.reset()
        if chunk.off_map[epoch]:
            state.time, recursion.results.epoch["status"][epoch] = chunk.time[epoch], TrackStatus.OFF_MAP
            if trace is not None:
                trace.append(recursion.make_step(state, epoch))
            epoch += 1
            continue
        found = None
        if reasons or not state.hypotheses:
            found, reasons = recursion.seek(state, epoch, reasons, trace), 0
        if state.hypotheses:
            epoch, reasons = recursion.run(state, epoch, found, trace)
        else:
            epoch += 1
    finish_chunk(chunk, epochs, state)
    result = Tracked.from_records(epochs.time, recursion.results)
    np.add(result.arc_m, line.round_m(result.arc_m), out=result.arc_m)
    return result, state
