"""Numbers of phase arcs without a cycle slip.

The number of an arc is unique in a run: the channel's five letters and the count of
arcs of that channel so far. It does not depend on chunks or on the order of channels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from railfix.core.arrays import Indices, Integers, Masks, Strings

#: Bits of the count in an arc's number; the channel's letters are above them.
COUNT_BITS: Final = 23
#: No phase, no arc.
NO_ARC: Final = -1

#: Satellite and signal of each channel.
ChannelKeys = tuple[tuple[str, str], ...]


@dataclass(frozen=True, kw_only=True)
class ArcState:
    """Arcs that each channel has had so far, by channel code."""

    count: Mapping[int, int] = field(default_factory=dict)


def channel_code(satellite: str, signal: str) -> int:
    """A channel's letters as one number: ``G05`` on ``1C``."""
    return int.from_bytes(f"{satellite:<3.3}{signal:<2.2}".encode("ascii"), "big")


def channel_keys(satellite: Strings, signal: Strings) -> ChannelKeys:
    """Satellite and signal of each channel, by which states refer to channels."""
    return tuple(zip(satellite.tolist(), signal.tolist(), strict=True))


def rows_before(before: ChannelKeys, now: ChannelKeys) -> Indices:
    """Row of each channel among those of the epoch before, -1 for new ones, shape (M,).

    Values of a state with one more for new channels at the end, ``np.append(values, np.nan)``, are indexed with it.
    """
    row = {key: i for i, key in enumerate(before)}
    return np.array([row.get(key, -1) for key in now], dtype=np.intp)


def number_arcs(
    slip: Masks,
    has_phase: Masks,
    satellite: Strings,
    signal: Strings,
    state: ArcState | None = None,
) -> tuple[Integers, ArcState]:
    """Number of the arc of each phase.

    Parameters
    ----------
    slip : ndarray of bool, shape (T, M)
        Where arcs begin (`slips.find_slips`, and what other tests add).
    has_phase : ndarray of bool, shape (T, M)
    satellite, signal : ndarray of str, shape (M,)
    state : ArcState, optional

    Returns
    -------
    ndarray of int64, shape (T, M)
        `NO_ARC` where there is no phase.
    ArcState
    """
    before = dict(state.count) if state else {}
    codes = [channel_code(str(a), str(b)) for a, b in zip(satellite.tolist(), signal.tolist(), strict=True)]
    first = np.array([before.get(code, 0) for code in codes], dtype=np.int64)
    count = first + np.cumsum(slip & has_phase, axis=0, dtype=np.int64)
    names = np.array(codes, dtype=np.int64) << COUNT_BITS
    if len(count):
        before.update({code: int(c) for code, c in zip(codes, count[-1], strict=True)})
    return np.where(has_phase, names + count, NO_ARC), ArcState(count=before)


def last_arcs(satellite: Strings, signal: Strings, state: ArcState | None) -> Integers:
    """Return the number of the last arc of each channel, shape (M,); `NO_ARC` for channels without one."""
    count = {} if state is None else state.count
    codes = [channel_code(str(a), str(b)) for a, b in zip(satellite.tolist(), signal.tolist(), strict=True)]
    return np.array([(code << COUNT_BITS) + count[code] if code in count else NO_ARC for code in codes], dtype=np.int64)


def channel_of(arc_id: Integers) -> Integers:
    """Channel code of each arc."""
    return np.asarray(arc_id >> COUNT_BITS)
