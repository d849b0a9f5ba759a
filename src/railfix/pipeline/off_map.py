"""Detection of a train away from its line, from single-epoch positions over some seconds."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Masks
from railfix.core.timescale import seconds

_NEVER: Final = np.datetime64("NaT", "ns")
#: Time constant of the mean offset from the line while a train is off the map [s].
_REMEMBERED_S: Final = 30.0
#: A train is back on the line if its recent mean offset is at most this fraction of its mean offset while off the map.
_BACK_SHARE: Final = 0.5
#: A train is also back on the line if the mean offset of its positions is at most this limit [m].
_BACK_M: Final = 1.0


@dataclass(frozen=True, kw_only=True)
class OffMapState:
    """State of the off-map test after a chunk."""

    off: bool = False  #: True if the train was off the map at the last epoch.
    known: bool = False  #: True after the first tested position; until then, one position is enough to set `off`.
    #: Start of the current series of positions that contradict `off`; NaT if the last position agrees with `off`.
    since: np.datetime64 = _NEVER
    back: Floats = field(default_factory=lambda: np.zeros(2))  #: Sum [m] and number of offsets from `since` on.
    away: Floats = field(default_factory=lambda: np.zeros(2))  #: Decaying sum and number of offsets while off the map.
    away_at: np.datetime64 = _NEVER  #: Time of the last offset in `away`.


def off_map_epochs(
    time: Datetimes, on_map: Masks, off_map: Masks, offset_m: Floats, state: OffMapState, *, least_s: float
) -> tuple[Masks, OffMapState]:
    """Return the epochs at which the train is off the map, shape (T,), and the state for the next chunk.

    The train leaves the map once all positions of the last `least_s` are off the map; because of reflected signals, a
    single position can be off the map. The train returns once all positions of the last `least_s` are on the map, and
    their mean offset is at most 1 m, or at most half of the mean offset while off the map. The mean offset is tested
    because some positions on an unmapped track beside the line fit the map by chance. At the start of a log, the first
    position alone decides. `on_map` and `off_map` mark epochs whose ranges fit the map, and epochs whose ranges
    contradict it; `offset_m` is the offset of 3-D positions to the right of the line, NaN if unknown; shapes (T,).
    """
    off, known, since, back = state.off, state.known, state.since, state.back
    away, away_at = state.away, state.away_at
    result = np.full(len(time), off)
    judged = (on_map | off_map).nonzero()[0]
    states = off_map[judged]
    edges = [0, *((states[1:] != states[:-1]).nonzero()[0] + 1).tolist(), len(judged)]
    for first, end in pairwise(edges) if len(judged) else ():
        run, says = judged[first:end], bool(states[first])
        sums = np.cumsum([np.nan_to_num(offset_m[run]), np.isfinite(offset_m[run])], axis=1)
        if says:
            age = seconds(time[run[-1]] - time[run])
            decay = 0.0 if np.isnat(away_at) else np.exp(-seconds(time[run[-1]] - away_at) / _REMEMBERED_S)
            away = away * decay + np.diff(sums, prepend=0.0) @ np.exp(-age / _REMEMBERED_S)
            away_at = time[run[-1]]
        if known and says == off:
            since, back = _NEVER, np.zeros(2)
            continue
        since = time[run[0]] if np.isnat(since) else since
        sums, back = sums + back[:, None], sums[:, -1] + back
        enough = seconds(time[run] - since) >= least_s if known else np.ones(len(run), dtype=np.bool_)
        if off and away[1] > 0.0:
            limit = max(_BACK_M, _BACK_SHARE * abs(away[0] / away[1]))
            enough &= (sums[1] > 0.0) & (np.abs(sums[0]) <= limit * sums[1])
        if enough.any():
            result[run[np.argmax(enough)] :] = says
            off, known, since, back = says, True, _NEVER, np.zeros(2)
            away = away if says else np.zeros(2)
    return result, OffMapState(off=off, known=known, since=since, back=back, away=away, away_at=away_at)
