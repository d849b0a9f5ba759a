"""Smoothed positions of a run: the filter runs over the stored input, and a smoother runs backward over its results."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields
from typing import Final

import numpy as np

from railfix.core.arrays import join_rows
from railfix.pipeline.filter_result import Replay, SmoothedTrack
from railfix.tracking import (
    BackwardInformation,
    GnssEpochs,
    Line,
    SensorEpochs,
    Step,
    TrackingLimits,
    TrackState,
    smooth_steps,
    track,
)

#: The covariances of at most this number of epochs are in memory at the same time.
_EPOCHS: Final = 300


def smooth(backward: Iterable[Replay], line: Line, limits: TrackingLimits) -> SmoothedTrack:
    """Return the smoothed positions of all epochs; `backward` has the filter's input in reverse order of time."""
    parts: list[SmoothedTrack] = []
    later: BackwardInformation | None = None
    for replay in backward:
        for epochs, before in reversed(_pieces(replay, line, limits)):
            trace: list[Step] = []
            track(epochs, line, before, limits=limits, sensors=replay.sensors, trace=trace)
            found, later = smooth_steps(trace, before or TrackState(), later, limits)
            arc = found.arc_m + line.round_m(found.arc_m)
            parts.append(SmoothedTrack(time=epochs.time, arc_m=arc, sigma_m=found.sigma_m, speed_mps=found.speed_mps))
    nothing = np.empty(0)
    empty = SmoothedTrack(time=nothing.astype("M8[ns]"), arc_m=nothing, sigma_m=nothing, speed_mps=nothing)
    return join_rows([*reversed(parts), empty])


def _pieces(replay: Replay, line: Line, limits: TrackingLimits) -> list[tuple[GnssEpochs, TrackState | None]]:
    """Split filter input into short pieces, each with the state before it; input with sensors is already in pieces."""
    size = len(replay.epochs)
    sensed = any(getattr(replay.sensors, f.name) is not None for f in fields(SensorEpochs) if f.name != "wheel_sign")
    if size <= _EPOCHS or sensed:
        return [(replay.epochs, replay.before)] if size else []
    state, pieces = replay.before, []
    for first in range(0, size, _EPOCHS):
        epochs = replay.epochs.take(slice(first, first + _EPOCHS))
        pieces.append((epochs, state))
        _, state = track(epochs, line, state, limits=limits)
    return pieces
