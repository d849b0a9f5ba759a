"""Stanford diagram along the track: position error against protection level.

The region of an epoch depends on the alarm limit AL, the protection level PL and the absolute position error:

- no position: both PL and error are unknown;
- unjudged: PL is known, but there is no reference for the error;
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

_BINS: Final = 100  #: Number of bins per axis. Both axes extend to twice the alarm limit.
_GAP: Final = 1.5  #: Intervals between epochs longer than this multiple of the median interval are gaps.


class Region(IntEnum):
    """Region of an epoch in the Stanford diagram."""

    NO_POSITION = 0
    NOMINAL = 1
    MISLEADING = 2
    HAZARDOUS = 3
    UNAVAILABLE = 4
    UNAVAILABLE_MISLEADING = 5
    UNJUDGED = 6


@dataclass(frozen=True, kw_only=True)
class Continuity:
    """Continuity over windows of one length, each of which starts at an available epoch."""

    window_s: float  #: Length of the windows.
    windows: int  #: Number of windows that end within the run.
    kept: int  #: Number of windows with neither unavailable epochs nor gaps.
    probability: float  #: Ratio kept / windows; NaN without windows.


@dataclass(frozen=True, kw_only=True)
class Stanford:
    """Stanford diagram of T epochs."""

    alarm_limit_m: float
    region: Codes  #: `Region`, shape (T,).
    counts: dict[Region, int]  #: Number of epochs in each region; the counts add up to T.
    available_rate: float  #: Fraction of all epochs with PL <= AL; NaN without epochs.
    beyond: Indices  #: Indices of epochs with error > PL, sorted by descending excess.
    continuity: tuple[Continuity, ...]  #: One entry per window length.
    #: Number of time blocks that contain epochs. Errors are correlated over tens of seconds, so that a block counts as
    #: one independent sample.
    blocks: int
    misleading_blocks: int  #: Number of time blocks that contain an epoch with error > PL.
    #: Edges of the error bins and of the protection level bins, shape (N + 1,); the last edge is infinite.
    edges_m: Floats
    histogram: Integers  #: Number of epochs per error bin (axis 0) and protection level bin (axis 1), shape (N, N).


def stanford(
    time: Datetimes,
    error_m: ArrayLike,
    level_m: ArrayLike,
    *,
    alarm_limit_m: float,
    windows_s: Sequence[float] = (15.0, 60.0),
    block_s: float = 60.0,
) -> Stanford:
    """Assign each epoch to a region of the Stanford diagram, and compute availability and continuity.

    Parameters
    ----------
    time : ndarray of datetime64, shape (T,)
        Ascending times of all epochs of the run, including epochs without a position.
    error_m : array_like, shape (T,) [m]
        Error along the track, signed or absolute; NaN without a position or without a reference.
    level_m : array_like, shape (T,) [m]
        Protection level; infinite where the error is unbounded, NaN without a position. If the error is known, a
        protection level of NaN counts as infinite.
    windows_s : sequence of float [s]
        Lengths of the continuity windows. The default of 15 s is used for aviation approaches; 60 s is a typical travel
        time between two stations.
    block_s : float [s]
        Length of the time blocks, counted from the first epoch.
    """
    time = time.astype("datetime64[ns]")
    error, level = np.abs(np.asarray(error_m, dtype=np.float64)), np.asarray(level_m, dtype=np.float64)
    if not len(time) == len(error) == len(level):
        raise ValueError(
            f"time, error_m and level_m must have one value per epoch, got {len(time)}, {len(error)} and {len(level)}"
        )
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
    """Return the continuity over windows ``[t, t + window_s]`` that start at each available epoch t."""
    if len(time) < 2:
        return Continuity(window_s=window_s, windows=0, kept=0, probability=np.nan)
    step = np.diff(time)
    across = step > _GAP * np.median(step.astype(np.int64)) * np.timedelta64(1, "ns")
    broken = np.concatenate([[0], np.cumsum(~available[1:] | across)])
    until = time + _nanoseconds(window_s)
    started = available & (until <= time[-1])
    last = np.searchsorted(time, until, side="right") - 1
    # A window that ends within a gap is also interrupted.
    ends = np.append(across, False)[last] & (until > time[last])
    kept = started & (broken[last] == broken) & ~ends
    windows = int(started.sum())
    return Continuity(
        window_s=window_s,
        windows=windows,
        kept=int(kept.sum()),
        probability=int(kept.sum()) / windows if windows else np.nan,
    )
