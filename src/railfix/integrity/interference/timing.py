"""How long signs last: conditions that must hold for a time, and suspicions that stay for a time."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks
from railfix.core.timescale import seconds

_NS = 1e9
_NEVER = np.datetime64("NaT", "ns")


@dataclass(frozen=True, kw_only=True)
class HeldState:
    """State of C conditions after a chunk."""

    time: np.datetime64 = field(default_factory=lambda: _NEVER)  #: Last epoch; NaT before the first.
    #: How long each condition had held, shape (C,).
    run_ns: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    #: When it last counted; NaT for never; shape (C,).
    last: Datetimes = field(default_factory=lambda: np.zeros(0, dtype="datetime64[ns]"))


def held(
    time: Datetimes, signs: Masks, state: HeldState, *, hold_s: Floats, release_s: Floats
) -> tuple[Masks, Masks, HeldState]:
    """Return which conditions have held for their time, and which have within their time of release.

    An interval between epochs counts for half the time of holding at most, so that one epoch after a gap proves
    nothing.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    signs : ndarray of bool, shape (T, C)
    state : HeldState
    hold_s, release_s : ndarray, shape (C,) [s]
        A time of holding of 0 counts at once.

    Returns
    -------
    counts, stays : ndarray of bool, shape (T, C)
    state : HeldState
    """
    conditions = signs.shape[1]
    run, last = state.run_ns, state.last
    if not len(run):
        run, last = np.zeros(conditions, dtype=np.int64), np.full(conditions, _NEVER)
    if not len(time):
        return signs, signs, state
    hold = np.round(hold_s * _NS).astype(np.int64)
    before = time[0] if np.isnat(state.time) else state.time
    step = np.diff(np.concatenate([[before], time])).astype(np.int64)[:, None]
    total = np.cumsum(np.minimum(step, np.maximum(hold // 2, 0)), axis=0)
    # lengths of runs: total so far less the total at the last epoch at which the condition did not hold
    start = np.maximum.accumulate(np.vstack([-run, np.where(signs, np.iinfo(np.int64).min, total)]), axis=0)[1:]
    length = total - start
    counts = signs & (length >= hold)
    when = np.vstack([last, np.where(counts, time[:, None], _NEVER)])
    latest = np.fmax.accumulate(when, axis=0)[1:]
    stays = seconds(time[:, None] - latest) <= release_s
    return counts, stays, HeldState(time=time[-1], run_ns=np.where(signs[-1], length[-1], 0), last=latest[-1])
