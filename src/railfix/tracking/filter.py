"""The filter along the track: epochs in, places along the trajectory and the state for the next epochs out."""

from __future__ import annotations

from copy import copy

import numpy as np

from railfix.tracking.chunk import finish_chunk, prepare_chunk
from railfix.tracking.epochs import GnssEpochs, SensorEpochs
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.line import Line
from railfix.tracking.recursion import Recursion
from railfix.tracking.result import Tracked, TrackStatus
from railfix.tracking.smoother import Step
from railfix.tracking.state import StateIndex, TrackState


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
    """Places along the trajectory, each from its own and earlier epochs.

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
    state = TrackState.empty() if state is None else copy(state)
    result = Tracked.empty(epochs.time, len(epochs.satellite))
    if len(epochs):
        chunk = prepare_chunk(epochs, state, limits)
        recursion = Recursion(chunk, line, sensors, limits, result, levels=levels)
        epoch = 0
        while epoch < len(epochs):
            lost = not np.isfinite(state.mean[:, StateIndex.ARC]).all()
            if lost or chunk.apart[epoch] or chunk.off_map[epoch]:
                state.reset()
            if chunk.off_map[epoch]:
                state.time, result.status[epoch] = chunk.time[epoch], TrackStatus.OFF_MAP
                if trace is not None:
                    trace.append(Step.without_place(state, float(chunk.interval_s[epoch])))
                epoch += 1
                continue
            done = epoch
            if state.hypotheses:
                done = recursion.advance(state, epoch, trace)
            if done == epoch:
                recursion.search(state, epoch, trace)
                done += 1
            epoch = done
        finish_chunk(chunk, epochs, state, limits)
    np.add(result.arc_m, line.round_m(result.arc_m), out=result.arc_m)
    return result, state
