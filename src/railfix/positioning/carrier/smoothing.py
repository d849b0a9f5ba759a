"""Carrier-smoothed codes (Hatch filter).

The mean of code less phase over the arc so far, put back on the phase, is a code with less noise. The ionosphere makes
it drift by twice the change of its delay, which the window limits: at 1 mm/s one of 100 s leaves up to 0.2 m.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, Strings, read_only
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.positioning.carrier.continuity import ChannelKeys, channel_keys, rows_before


def linear_recursion(gain: Floats, drive: Floats) -> Floats:
    """``x_k = gain_k x_{k-1} + drive_k`` along axis 0 with x_{-1} = 0, without a loop over epochs.

    Pairs (gain, drive) are composed over strides of 1, 2, 4, ...; gains in [0, 1] are stable.
    """
    total, factor = drive.copy(), gain.copy()  # gains may have fewer elements, those of `drive` broadcast
    stride = 1
    while stride < len(total):
        total[stride:] = total[stride:] + factor[stride:] * total[:-stride]
        factor[stride:] = factor[stride:] * factor[:-stride]
        stride *= 2
    return total


class SmoothingLimits(Settings):
    """Limits of the smoothing."""

    #: Time constant: each code of an arc counts the same until the arc is this old, from then on older ones fade
    #: (DO-229D 2.1.4.1.5 takes 100 s, for the ionosphere's drift).
    window_s: float = Field(default=100.0, gt=0)
    #: "own": the codes' mean change against their phases is a clock: subtracted before and added after averaging. For
    #: telephones, whose codes jump together by tens of metres (urban 95 % of the error along the line 10.8 to 7.0 m,
    #: against 50 m with "shared"); other receivers did not lose by it.
    clocks: Literal["own", "shared"] = "own"


@dataclass(frozen=True, kw_only=True)
class SmoothingState:
    """The last epoch of a chunk, by channel."""

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: NaT before the first epoch.
    channels: ChannelKeys = ()
    #: First code less phase of the running arc; NaN where none runs; shape (M,).
    base_m: Floats = field(default_factory=lambda: np.empty(0))
    #: Smoothed code less phase, less `base_m`; shape (M,).
    offset_m: Floats = field(default_factory=lambda: np.empty(0))
    #: Of the smoothed code, in units of that of a code; shape (M,).
    variance: Floats = field(default_factory=lambda: np.empty(0))
    #: Codes of the running arc, shape (M,).
    count: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    #: Last code less phase, for `clocks="own"`; shape (M,).
    last_m: Floats = field(default_factory=lambda: np.empty(0))
    clock_m: float = 0.0  #: Mean change of the codes against the phases so far.


@dataclass(frozen=True, kw_only=True)
class SmoothedCodes:
    """Smoothed codes, T epochs by M channels."""

    #: The raw code where there is no phase, and at the first epoch of an arc; NaN where there is no code, unless the
    #: arc of its phase continues: then the smoothed code continues; shape (T, M).
    code_m: Floats
    #: Expected standard deviation against that of one code, for noise that is white in time; multipath lasts for tens
    #: of seconds and is averaged less. NaN where `code_m` is; shape (T, M).
    sigma_factor: Floats


def _hold(values: Floats, at: Masks, first: Floats) -> Floats:
    """Values at the marked epochs held until the next mark, `first` before any; shapes (T, M) and (M,)."""
    rows = np.where(at, np.arange(1, len(values) + 1)[:, None], 0)
    rows = np.maximum.accumulate(rows, axis=0)
    return np.asarray(np.take_along_axis(np.concatenate([first[None], values]), rows, axis=0))


def _common_change(difference: Floats, begins: Masks, last: Floats) -> Floats:
    """Mean change of code less phase over the channels that run on, 0 where there is none; shape (T,)."""
    change = np.where(begins, np.nan, difference - np.concatenate([last[None], difference[:-1]]))
    number = np.count_nonzero(np.isfinite(change), axis=1)
    return np.asarray(np.nansum(change, axis=1) / np.maximum(number, 1))


def smooth_codes(
    time: Datetimes,
    satellite: Strings,
    signal: Strings,
    code_m: Floats,
    phase_m: Floats,
    slip: Masks,
    state: SmoothingState | None = None,
    *,
    limits: SmoothingLimits | None = None,
) -> tuple[SmoothedCodes, SmoothingState]:
    """Codes smoothed by the phase along unbroken arcs.

    Weight of the n-th code of an arc: the greater of 1/n and dt / window. A phase times its
    wavelength is of the order of 1e8 m, where a double steps by 1.5e-8 m; the recursion runs on
    code less phase less its first value on the arc, which is metres, so nothing builds up.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    satellite, signal : ndarray of str, shape (M,)
    code_m, phase_m : ndarray, shape (T, M) [m]
        Raw codes, and `Slips.phase_m`; NaN where absent.
    slip : ndarray of bool, shape (T, M)
        Where arcs begin.
    state : SmoothingState, optional
    limits : SmoothingLimits, optional

    Returns
    -------
    SmoothedCodes
    SmoothingState
        Division into chunks does not change the result beyond rounding (1e-9 m).
    """
    limits, state = limits or SmoothingLimits(), state or SmoothingState()
    channels = channel_keys(satellite, signal)
    rows = rows_before(state.channels, channels)
    base0, last0 = (np.append(values, np.nan)[rows] for values in (state.base_m, state.last_m))
    offset0, variance0 = (np.append(values, 0.0)[rows] for values in (state.offset_m, state.variance))
    count0 = np.append(state.count, 0)[rows]
    if not len(time):
        return SmoothedCodes(code_m=code_m, sigma_factor=np.ones(code_m.shape)), state
    has_phase = np.isfinite(phase_m)
    has = has_phase & np.isfinite(code_m)
    # An arc ends with its phase: without one, nothing runs into the next epoch.
    begins = slip | ~has_phase
    codes = np.cumsum(has, axis=0)
    before = _hold((codes - has).astype(np.float64), begins, -count0.astype(np.float64))
    count = np.where(has_phase, codes - before, 0.0)
    difference = np.where(has, code_m - phase_m, np.nan)
    apart = np.full(len(time) + 1, state.clock_m)
    if limits.clocks == "own":
        apart = np.cumsum(np.r_[state.clock_m, _common_change(difference, begins, last0)])
    last, difference = difference[-1], difference - apart[1:, None]
    # The arc's first code may come after its first phase.
    base = _hold(difference, (has & (count == 1)) | begins, base0)

    dt = seconds(np.diff(np.concatenate([np.asarray([state.time], dtype="datetime64[ns]"), time])))
    fade = np.clip(np.where(np.isnan(dt), 0.0, dt) / limits.window_s, 0.0, 1.0)[:, None]
    gain = np.where(has, np.maximum(1.0 / np.maximum(count, 1.0), fade), 0.0)
    gain = np.where(has & (count <= 1), 1.0, gain)
    keep = np.where(begins, 0.0, 1.0 - gain)
    drive = gain * np.where(has, difference - base, 0.0)
    unchanged = np.ones((1, len(channels)))
    offset = linear_recursion(np.concatenate([unchanged, keep]), np.concatenate([offset0[None], drive]))[1:]
    variance = linear_recursion(np.concatenate([unchanged, keep**2]), np.concatenate([variance0[None], gain**2]))[1:]

    runs = has_phase & (count >= 1)
    smoothed = np.where(runs, phase_m + (base + offset + apart[1:, None]), code_m)
    smoothed = np.where(has & (gain == 1.0), code_m, smoothed)
    factor = np.where(runs, np.sqrt(variance), np.where(np.isfinite(code_m), 1.0, np.nan))
    after = SmoothingState(
        time=time[-1],
        channels=channels,
        base_m=read_only(np.where(runs[-1], base[-1], np.nan)),
        offset_m=read_only(np.where(runs[-1], offset[-1], 0.0)),
        variance=read_only(np.where(runs[-1], variance[-1], 0.0)),
        count=read_only(np.where(runs[-1], count[-1], 0.0).astype(np.int64)),
        last_m=read_only(last),
        clock_m=float(apart[-1]),
    )
    return SmoothedCodes(code_m=smoothed, sigma_factor=factor), after
