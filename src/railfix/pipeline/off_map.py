"""Epochs at which the train is away from the line, by the verdicts of single epochs over some seconds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Masks
from railfix.core.timescale import seconds

_NEVER: Final = np.datetime64("NaT", "ns")


@dataclass(frozen=True, kw_only=True)
class OffMapState:
    """State of the test after a chunk.

    Attributes
    ----------
    off : bool
        The train was off the map at the last epoch.
    known : bool
        A position has been tested; the first one of a log decides alone.
    since : datetime64[ns]
        First of the last positions in a row that contradict `off`; NaT where the last one agrees with it.
    """

    off: bool = False
    known: bool = False
    since: np.datetime64 = _NEVER


def off_map_epochs(
    time: Datetimes, on_map: Masks, off_map: Masks, state: OffMapState, *, least_s: float
) -> tuple[Masks, OffMapState]:
    """Return the epochs at which the train is off the map, shape (T,), and the state to pass on.

    It leaves the map once all positions of the last `least_s` are off it, and returns once all of that time are on
    it: a single position can be off the map by reflected signals, or on it by chance. The first position of a log
    decides alone.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    on_map, off_map : ndarray of bool, shape (T,)
        Single-epoch positions that the ranges fit, and those that they contradict; both False without a position.
    state : OffMapState
    least_s : float [s]
        How long positions contradict the state before it changes.
    """
    off, known, since = state.off, state.known, state.since
    result = np.full(len(time), off)
    judged = np.flatnonzero(on_map | off_map)
    runs = np.split(judged, np.flatnonzero(np.diff(off_map[judged])) + 1) if len(judged) else []
    for run in runs:
        says = bool(off_map[run[0]])
        if known and says == off:
            since = _NEVER
            continue
        since = time[run[0]] if np.isnat(since) else since
        enough = run[seconds(time[run] - since) >= least_s] if known else run
        if len(enough):
            result[enough[0] :] = says
            off, known, since = says, True, _NEVER
    return result, OffMapState(off=off, known=known, since=since)
