"""Stanford diagram on the along-track axis: the error against the level that was to bound it.

Every epoch is in one region. With an alarm limit AL, the level PL and the absolute error:

- no position: neither is there;
- unjudged: a level, but no reference to take an error from;
- nominal: error <= PL <= AL;
- misleading: PL < error <= AL;
- hazardously misleading: PL <= AL < error;
- unavailable: PL > AL, error <= PL;
- unavailable and misleading: PL > AL, error > PL.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Codes, Datetimes, Floats, Indices, Integers, Masks

_BINS: Final = 100  #: Bins of an axis, up to twice the alarm limit.
_GAP: Final = 1.5  #: Epochs farther apart than this many usual intervals are separated by a gap.


class Region(IntEnum):
    """Region of an epoch in the diagram."""

    NO_POSITION = 0
    NOMINAL = 1
    MISLEADING = 2
    HAZARDOUS = 3
    UNAVAILABLE = 4
    UNAVAILABLE_MISLEADING = 5
    UNJUDGED = 6


@dataclass(frozen=True, kw_only=True)
class Continuity:
    """Probability that an available epoch stays available? Windows that start at an available epoch."""

    window_s: float
    windows: int  #: Windows that the run covers to their end.
    kept: int  #: Those in which every epoch is available and none is missing.
    probability: float  #: kept / windows; NaN without windows.


@dataclass(frozen=True, kw_only=True)
class Stanford:
    """Stanford diagram of T epochs."""

    alarm_limit_m: float
    region: Codes  #: `Region`, shape (T,).
    counts: dict[Region, int]  #: Epochs of each region; they add up to T.
    available_rate: float  #: Epochs with a level within the alarm limit, judged or not / T.
    beyond: Indices  #: Indices of the epochs whose error is over the level, the largest excess first.
    continuity: tuple[Continuity, ...]  #: One a window.
    #: Blocks of time with epochs, and of these those with an error over the level: errors stay alike for tens of
    #: seconds, so that a block is worth an epoch of statistics.
    blocks: int
    misleading_blocks: int
    #: Edges of the bins of error and level; the upper edge of the last one is infinite; shape (N + 1,).
    edges_m: Floats
    histogram: Integers  #: Epochs by bin of the absolute error (axis 0) and of the level (axis 1), shape (N, N).


def stanford(
    time: Datetimes,
    error_m: ArrayLike,
    level_m: ArrayLike,
    *,
    alarm_limit_m: float,
    windows_s: Sequence[float] = (15.0, 60.0),
    block_s: float = 60.0,
) -> Stanford:
    """Sort epochs into the diagram.

    Parameters
    ----------
    time : ndarray of datetime64, shape (T,)
        Ascending; every epoch of the run, with a position or without.
    error_m : array_like, shape (T,) [m]
        Along the track, signed or not; NaN without a position or no reference.
    level_m : array_like, shape (T,) [m]
        Infinite where no error can be excluded, NaN without a position. An error without a level counts as one
        with an infinite level.
    windows_s : sequence of float [s]
        Lengths of the windows of continuity: 15 s is an approach's in aviation; a minute, a station to the next.
    block_s : float [s]
        Length of the blocks, from the first epoch.
    """
    time = time.astype("datetime64[ns]")
    error, level = np.abs(np.asarray(error_m, dtype=np.float64)), np.asarray(level_m, dtype=np.float64)
    if not len(time) == len(error) == len(level):
        raise ValueError(f"one time, error and level an epoch: got {len(time)}, {len(error)} and {len(level)}")
    if (np.diff(time) <= np.timedelta64(0, "ns")).any():
        raise ValueError("times must ascend")
    if (level < 0).any():
        raise ValueError("a level cannot be negative")
    if not min(alarm_limit_m, block_s, *windows_s) > 0:
        raise ValueError("alarm_limit_m, windows_s and block_s must be positive")
    judged = ~np.isnan(error)
    bound = np.where(np.isnan(level), np.inf, level)
    beyond, within = judged & (error > bound), bound <= alarm_limit_m
    region = np.select(
        [~judged & np.isnan(level), ~judged, ~within & beyond, ~within, beyond & (error > alarm_limit_m), beyond],
        [
            Region.NO_POSITION,
            Region.UNJUDGED,
            Region.UNAVAILABLE_MISLEADING,
            Region.UNAVAILABLE,
            Region.HAZARDOUS,
            Region.MISLEADING,
        ],
        Region.NOMINAL,
    ).astype(np.int8)
    excess = np.where(beyond, error - bound, -np.inf)
    edges = np.append(2.0 * alarm_limit_m / _BINS * np.arange(_BINS), np.inf)
    place = np.searchsorted(edges[1:-1], error[judged], side="right")
    other = np.searchsorted(edges[1:-1], bound[judged], side="right")
    block = (time - time[:1]) // _nanoseconds(block_s)
    return Stanford(
        alarm_limit_m=alarm_limit_m,
        region=region,
        counts={r: int(np.count_nonzero(region == r)) for r in Region},
        available_rate=float(np.mean(within)) if len(time) else np.nan,
        beyond=np.argsort(-excess, kind="stable")[: int(beyond.sum())],
        continuity=tuple(_continuity(time, within, window) for window in windows_s),
        blocks=len(np.unique(block)),
        misleading_blocks=len(np.unique(block[beyond])),
        edges_m=edges,
        histogram=np.bincount(place * _BINS + other, minlength=_BINS * _BINS).reshape(_BINS, _BINS),
    )


def _nanoseconds(value_s: float) -> np.timedelta64:
    return np.timedelta64(round(value_s * 1e9), "ns")


def _continuity(time: Datetimes, available: Masks, window_s: float) -> Continuity:
    """Return windows ``[t, t + window]`` from each available epoch; a gap in the times breaks one."""
    if len(time) < 2:
        return Continuity(window_s=window_s, windows=0, kept=0, probability=np.nan)
    step = np.diff(time)
    across = step > _GAP * np.median(step.astype(np.int64)) * np.timedelta64(1, "ns")
    broken = np.concatenate([[0], np.cumsum(~available[1:] | across)])
    until = time + _nanoseconds(window_s)
    started = available & (until <= time[-1])
    last = np.searchsorted(time, until, side="right") - 1
    # A window that ends inside a gap is broken too: the next epoch is across it.
    ends = np.append(across, False)[last] & (until > time[last])
    kept = started & (broken[last] == broken) & ~ends
    windows = int(started.sum())
    return Continuity(
        window_s=window_s,
        windows=windows,
        kept=int(kept.sum()),
        probability=int(kept.sum()) / windows if windows else np.nan,
    )
