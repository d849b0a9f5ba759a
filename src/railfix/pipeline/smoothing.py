"""Smooth the filter along the track over a whole log: replay its chunks backward."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.tracking import (
    BackwardInformation,
    GnssEpochs,
    Line,
    SensorEpochs,
    Step,
    TrackingLimits,
    TrackState,
    smoothed,
    track,
)

#: Epochs whose covariances are in memory at a time.
_EPOCHS: Final = 300


@dataclass(frozen=True, kw_only=True)
class Replay:
    """What the filter was given for some epochs."""

    epochs: GnssEpochs
    sensors: SensorEpochs
    before: TrackState | None  #: State before them.


@dataclass(frozen=True, kw_only=True)
class SmoothedTrack:
    """Places of T epochs by everything measured before and after them."""

    time: Datetimes  #: Shape (T,).
    #: Shape (T,).
    arc_m: Floats
    sigma_m: Floats
    speed_mps: Floats  #: Shape (T,).


def smooth(backward: Iterable[Replay], line: Line, limits: TrackingLimits) -> SmoothedTrack:
    """Return the places of all epochs.

    Parameters
    ----------
    backward : iterable of Replay
        The last one first.
    line : Line
    limits : TrackingLimits
    """
    parts: list[SmoothedTrack] = []
    later: BackwardInformation | None = None
    for replay in backward:
        for epochs, before in reversed(_pieces(replay, line, limits)):
            trace: list[Step] = []
            track(epochs, line, before, limits=limits, sensors=replay.sensors, trace=trace)
            found, later = smoothed(trace, before or TrackState.empty(), later, limits)
            arc = found.arc_m + line.round_m(found.arc_m)
            parts.append(SmoothedTrack(time=epochs.time, arc_m=arc, sigma_m=found.sigma_m, speed_mps=found.speed_mps))
    parts.reverse()
    empty = {"time": np.empty(0, dtype="datetime64[ns]")}
    return SmoothedTrack(
        **{
            f.name: np.concatenate([getattr(part, f.name) for part in parts])
            if parts
            else empty.get(f.name, np.empty(0))
            for f in fields(SmoothedTrack)
        }
    )


def _pieces(replay: Replay, line: Line, limits: TrackingLimits) -> list[tuple[GnssEpochs, TrackState | None]]:
    """Short pieces and the states before them; those with sensors are short already."""
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
