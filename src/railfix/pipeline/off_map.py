"""Whether a train is away from its line: positions of single epochs over some seconds."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Masks
from railfix.core.timescale import seconds

_NEVER: Final = np.datetime64("NaT", "ns")


@dataclass(frozen=True, kw_only=True)
class OffMapState:
    """State of the test after a chunk."""

    off: bool = False  #: The train was off the map at the last epoch.
    known: bool = False  #: A position has been tested; the first one of a log decides alone.
    #: First of the last positions in a row that contradict `off`; NaT where the last one agrees with it.
    since: np.datetime64 = _NEVER


def off_map_epochs(
    time: Datetimes, on_map: Masks, off_map: Masks, state: OffMapState, *, least_s: float
) -> tuple[Masks, OffMapState]:
    """Return the epochs at which the train is off the map, shape (T,), and the state to pass on.

    The train leaves the map once all positions of the last `least_s` are off it, and returns once all of that time are
    on it: a single position can be off the map by reflected signals, or on it by chance. The first position of a log
    decides alone. `on_map`, `off_map`: positions that the ranges fit, and that they contradict, shape (T,).
    """
    off, known, since = state.off, state.known, state.since
    result = np.full(len(time), off)
    judged = (on_map | off_map).nonzero()[0]
    states = off_map[judged]
    edges = [0, *((states[1:] != states[:-1]).nonzero()[0] + 1).tolist(), len(judged)]
    for first, end in pairwise(edges) if len(judged) else ():
        run, says = judged[first:end], bool(states[first])
        if known and says == off:
            since = _NEVER
            continue
        since = time[run[0]] if np.isnat(since) else since
        enough = run[seconds(time[run] - since) >= least_s] if known else run
        if len(enough):
            result[enough[0] :] = says
            off, known, since = says, True, _NEVER
    return result, OffMapState(off=off, known=known, since=since)
