"""Cycle slips and gaps of carrier phases, and carrier-smoothed codes (Hatch filter).

The phase change is compared with the Dopplers, ``(phase_k - phase_{k-1}) + lambda dt (D_k + D_{k-1}) / 2``, or, where
Dopplers are missing, with the code change. The median over the channels is subtracted, because a receiver clock step is
common to all channels. The true interval between epochs is the difference of the time tags minus the clock step of the
codes. In some receivers, the phases have the same clock steps as the codes. In other receivers, the phases differ from
the codes by whole milliseconds after a step; `Slips.phase_m` has these milliseconds added.

The smoothed code is the phase plus the mean of code minus phase over the arc so far. This mean drifts by twice the
change of the ionospheric delay. The window limits the effect: for a change of 1 mm/s and a window of 100 s, the error
is at most 0.2 m.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntFlag
from typing import Final, Literal

import numpy as np
from pydantic import Field

from railfix.core.array_functions import medians
from railfix.core.arrays import Datetimes, Floats, Integers, Masks, Strings, read_only
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.settings import Settings
from railfix.core.timescale import seconds
from railfix.gnss.observations import Observations, carrier_frequency_hz
from railfix.positioning.carrier.continuity import ChannelKeys, channel_keys, rows_before

#: Clock step of one millisecond [m], used by receivers that keep their clock near GPS time.
MILLISECOND_M: Final = 1e-3 * SPEED_OF_LIGHT
#: A change common to all codes is a receiver clock step if it is larger than this [m].
_CLOCK_STEP_M: Final = 1e4
_COMMON: Final = 3  #: With fewer channels than this, the median counts as 0.


class SlipReason(IntFlag):
    """Reasons for a new phase arc at an epoch and channel; 0 where the arc continues."""

    JOINED = 0
    NO_PHASE = 1 << 0  #: No phase at this epoch; no arc begins.
    FIRST = 1 << 1  #: The channel had no phase at the previous epoch.
    LOSS_OF_LOCK = 1 << 2  #: Bit 0 of the receiver's loss-of-lock indicator is set.
    HALF_CYCLE = 1 << 3  #: Bit 1 (half-cycle ambiguity) of the loss-of-lock indicator has changed.
    GAP = 1 << 4  #: The interval since the previous epoch exceeds `max_gap_s`.
    BREAK = 1 << 5  #: The log marks a break before this epoch.
    DOPPLER = 1 << 6  #: The phase change disagrees with the Dopplers.
    CODE = 1 << 7  #: The phase change disagrees with the code change (tested only without precise Dopplers).


class CycleSlipLimits(Settings):
    """Limits of the slip tests, for an interval dt [s].

    The Doppler test detects a slip if phase change and Dopplers disagree by more than ``doppler_m + doppler_mps dt +
    jerk_mps3 dt^3 / 12``. The three terms are phase noise, mean Doppler noise, and the error of the trapezoidal rule
    for a motion with this jerk. Slips of one L1 cycle (0.19 m) are detected for intervals up to about 1 s, slips of two
    cycles up to 1.5 s. The test on the track (`continuity.track_jumps`) does not depend on the jerk.
    """

    #: An arc ends if the interval between epochs exceeds this. Station logs have intervals of 30 s.
    max_gap_s: float = Field(default=31.0, gt=0)
    #: Constant part of the Doppler test limit. For recorded data at 1 Hz, the median of phase change minus change
    #: predicted from Dopplers is 0.01 to 0.04 m.
    doppler_m: float = Field(default=0.05, gt=0)
    #: Part of the Doppler test limit that is proportional to the interval.
    doppler_mps: float = Field(default=0.05, gt=0)
    jerk_mps3: float = Field(default=0.5, gt=0)  #: Largest expected jerk; passenger trains have less.
    #: An arc ends if code minus phase changes by more than this; tested unless the Doppler test has a smaller limit.
    code_m: float = Field(default=10.0, gt=0)


@dataclass(frozen=True, kw_only=True)
class CycleSlipState:
    """State after a chunk: observations of the last epoch by channel ("G05", "1C"), and clock steps so far."""

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: Time of the last epoch, or NaT.
    channels: ChannelKeys = ()
    code_m: Floats = field(default_factory=lambda: np.empty(0))  #: Code, shape (M,).
    phase_m: Floats = field(default_factory=lambda: np.empty(0))  #: Phase before adding `step_ms`, shape (M,).
    doppler_mps: Floats = field(default_factory=lambda: np.empty(0))  #: Doppler times wavelength, shape (M,).
    half_cycle: Masks = field(default_factory=lambda: np.empty(0, dtype=np.bool_))  #: Half-cycle flags, shape (M,).
    step_ms: int = 0  #: Sum of the clock steps of the codes that did not occur in the phases [ms].


@dataclass(frozen=True, kw_only=True)
class Slips:
    """Phases and starts of phase arcs, T epochs by M channels."""

    slip: Masks  #: True where a phase starts a new arc, shape (T, M).
    reason: Integers  #: `SlipReason` bits, shape (T, M).
    #: Phase times wavelength, shape (T, M); NaN where phase or wavelength is unknown. Clock steps that only the codes
    #: have are added, so that codes and phases refer to the same clock.
    phase_m: Floats
    doppler_metric_m: Floats  #: Phase change minus Doppler and clock change, shape (T, M); NaN where not testable.
    code_metric_m: Floats  #: Code change minus phase and clock change, shape (T, M); NaN where not testable.
    doppler_limit_m: Floats  #: Limit of `doppler_metric_m`, shape (T,).
    #: Receiver clock step of the codes since the previous epoch, shape (T,); 0 where no step is detected.
    clock_step_m: Floats
    half_cycle: Masks  #: True where the receiver reports an unresolved half cycle, shape (T, M).


def median_or_zero(values: Floats) -> Floats:
    """Return the median over the channels of each epoch, shape (T,); 0 for fewer than three values."""
    return np.where(np.isfinite(values).sum(axis=1) >= _COMMON, medians(values), 0.0)


def _before(values: Floats, last: Floats) -> Floats:
    """Return, for each epoch, the values of the previous epoch; for the first epoch, these are `last`."""
    return np.concatenate([last[None], values[:-1]])


def find_slips(
    observations: Observations,
    state: CycleSlipState | None = None,
    *,
    frequency_hz: Floats | None = None,
    limits: CycleSlipLimits | None = None,
) -> tuple[Slips, CycleSlipState]:
    """Return the cycle slips of every channel of a chunk.

    The first phase of a channel after an epoch without a phase is also reported, because it starts a new arc. With
    fewer than three channels, a clock step cannot be distinguished from a slip and is reported as a slip.

    Parameters
    ----------
    observations : Observations
        T epochs, M channels.
    state : CycleSlipState, optional
        State after the previous chunk; None at the start of a log.
    frequency_hz : ndarray, shape (M,), optional [Hz]
        Carrier frequency of each channel. By default, the log's header is used, which may lack GLONASS channels.
    limits : CycleSlipLimits, optional

    Returns
    -------
    Slips
    CycleSlipState
        State for the next chunk. The division into chunks does not change the result.
    """
    limits, state = limits or CycleSlipLimits(), state or CycleSlipState()
    channels = channel_keys(observations.satellite, observations.signal)
    last = {name: getattr(state, name) for name in ("code_m", "phase_m", "doppler_mps", "half_cycle")}
    if state.channels != channels:
        rows = rows_before(state.channels, channels)
        last = {name: np.append(values, np.nan)[rows] for name, values in last.items()}
    if frequency_hz is None:
        frequency_hz = carrier_frequency_hz(
            observations.satellite, observations.signal, observations.header.glonass_channel
        )
    wavelength = SPEED_OF_LIGHT / frequency_hz
    phase, doppler = observations.phase_cycles * wavelength, observations.doppler_hz * wavelength
    times = np.concatenate([np.asarray([state.time], dtype="datetime64[ns]"), observations.time])
    since, moved = seconds(times[1:] - times[:-1]), phase - _before(phase, last["phase_m"])
    step, lag_ms, doppler_metric, code_metric = slip_metrics(
        since,
        observations.code_m - _before(observations.code_m, last["code_m"]),
        moved,
        -0.5 * (doppler + _before(doppler, last["doppler_mps"])),
    )
    dt = np.where(np.isnan(since), 0.0, since)
    doppler_limit = limits.doppler_m + limits.doppler_mps * dt + limits.jerk_mps3 * dt**3 / 12.0
    half = (observations.loss_of_lock & 2) > 0
    half_before = _before(half.astype(np.float64), last["half_cycle"])
    by_doppler = np.isfinite(doppler_metric) & (doppler_limit <= limits.code_m)[:, None]

    has = np.isfinite(phase)
    reason = np.zeros(phase.shape, dtype=np.int64)
    for mask, bit in (
        (np.isnan(moved), SlipReason.FIRST),
        ((observations.loss_of_lock & 1) > 0, SlipReason.LOSS_OF_LOCK),
        (half != (half_before > 0), SlipReason.HALF_CYCLE),
        ((dt > limits.max_gap_s)[:, None], SlipReason.GAP),
        (observations.break_before[:, None], SlipReason.BREAK),
        (by_doppler & (np.abs(doppler_metric) > doppler_limit[:, None]), SlipReason.DOPPLER),
        (~by_doppler & (np.abs(code_metric) > limits.code_m), SlipReason.CODE),
    ):
        reason |= np.where(mask & has, int(bit), 0)
    reason[~has] = SlipReason.NO_PHASE
    total_ms = np.concatenate([[state.step_ms], lag_ms]).cumsum()
    after = state
    if len(observations):
        after = CycleSlipState(
            time=observations.time[-1], channels=channels, code_m=read_only(observations.code_m[-1].copy()),
            phase_m=read_only(phase[-1].copy()), doppler_mps=read_only(doppler[-1].copy()),
            half_cycle=read_only(half[-1].copy()), step_ms=int(total_ms[-1]),
        )  # fmt: skip
    slips = Slips(
        slip=has & (reason != 0), reason=reason, phase_m=phase + (total_ms[1:] * MILLISECOND_M)[:, None],
        doppler_metric_m=doppler_metric, code_metric_m=code_metric, doppler_limit_m=doppler_limit, clock_step_m=step,
        half_cycle=half,
    )  # fmt: skip
    return slips, after


def slip_metrics(
    dt: Floats, code_m: Floats, phase_m: Floats, range_mps: Floats
) -> tuple[Floats, Integers, Floats, Floats]:
    """Return the codes' clock step [m], the part of it missing in the phases [ms], and the metrics of both tests.

    `dt`, shape (T,), is the time since the previous epoch. `code_m` and `phase_m`, shape (T, M), are the changes since
    the previous epoch, and `range_mps` is the mean range rate from the Dopplers.
    """
    moved = np.where(np.isnan(range_mps), 0.0, range_mps) * dt[:, None]
    step = median_or_zero(code_m - moved)
    step = np.where(np.abs(step) > _CLOCK_STEP_M, step, 0.0)
    apart = code_m - phase_m
    lag_ms = np.rint(median_or_zero(apart) / MILLISECOND_M).astype(np.int64)
    apart = apart - (lag_ms * MILLISECOND_M)[:, None]
    doppler = phase_m - range_mps * (dt - step / SPEED_OF_LIGHT)[:, None]
    return step, lag_ms, doppler - median_or_zero(doppler)[:, None], apart - median_or_zero(apart)[:, None]


def linear_recursion(gain: Floats, drive: Floats) -> Floats:
    """Return ``x_k = gain_k x_{k-1} + drive_k`` along axis 0, with x_{-1} = 0, without a loop over epochs.

    Pairs (gain, drive) are combined over strides of 1, 2, 4, ... Rounding errors do not grow for gains in [0, 1].
    """
    total, factor = drive.copy(), gain.copy()  # `gain` may have fewer columns than `drive`
    stride = 1
    while stride < len(total):
        total[stride:] = total[stride:] + factor[stride:] * total[:-stride]
        factor[stride:] = factor[stride:] * factor[:-stride]
        stride *= 2
    return total


class SmoothingLimits(Settings):
    """Limits of code smoothing."""

    #: Time constant; 100 s in DO-229D 2.1.4.1.5 because of the ionospheric drift. All codes of an arc have equal weight
    #: until the arc has this age. Afterwards, the weight of older codes decays.
    window_s: float = Field(default=100.0, gt=0)
    #: With "own", the mean change of code minus phase over all channels counts as a clock change. It is subtracted
    #: before averaging and added afterwards. Telephones require "own", because their codes jump together by tens of
    #: metres. In a town, smoothing with "own" reduced the 95 % error along the line from 10.8 to 7.0 m; with "shared",
    #: this error was 50 m. With other receivers, "own" was as accurate as "shared".
    clocks: Literal["own", "shared"] = "own"


@dataclass(frozen=True, kw_only=True)
class SmoothingState:
    """State of the smoothing after a chunk, by channel."""

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: Time of the last epoch, or NaT.
    channels: ChannelKeys = ()
    #: First value of code minus phase on the current arc, shape (M,); NaN without an arc.
    base_m: Floats = field(default_factory=lambda: np.empty(0))
    #: Mean of code minus phase on the current arc, minus `base_m`, shape (M,).
    offset_m: Floats = field(default_factory=lambda: np.empty(0))
    #: Number of codes of the current arc, shape (M,).
    count: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    #: Last value of code minus phase, used for `clocks="own"`, shape (M,).
    last_m: Floats = field(default_factory=lambda: np.empty(0))
    clock_m: float = 0.0  #: Clock for `clocks="own"`: sum of the mean changes of code minus phase so far.


def _hold(values: Floats, at: Masks, first: Floats) -> Floats:
    """Return for each epoch the value at the newest epoch marked by `at`, or `first` before the first marked epoch;
    shape (T, M).
    """
    rows = np.where(at, np.arange(1, len(values) + 1)[:, None], 0)
    rows = np.maximum.accumulate(rows, axis=0)
    return np.asarray(np.take_along_axis(np.concatenate([first[None], values]), rows, axis=0))


def _common_change(difference: Floats, begins: Masks, last: Floats) -> Floats:
    """Return the mean change of code minus phase over channels whose arc continues, shape (T,); 0 if there are none."""
    change = np.where(begins, np.nan, difference - np.concatenate([last[None], difference[:-1]]))
    number = np.isfinite(change).sum(axis=1)
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
) -> tuple[Floats, SmoothingState]:
    """Return codes smoothed by the phase along unbroken arcs.

    The weight of the n-th code of an arc is the greater of 1/n and dt / window. To avoid accumulated rounding errors
    (phases of 1e8 m are resolved to 1.5e-8 m), the recursion uses the change of code minus phase on the arc.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
    satellite, signal : ndarray of str, shape (M,)
    code_m, phase_m : ndarray, shape (T, M) [m]
        Raw codes, and phases (`Slips.phase_m`); NaN where missing.
    slip : ndarray of bool, shape (T, M)
        True where an arc begins.
    state : SmoothingState, optional
    limits : SmoothingLimits, optional

    Returns
    -------
    ndarray, shape (T, M) [m]
        Smoothed codes. Without a phase, and at the first epoch of an arc, the raw code is returned. Where the code is
        missing, the smoothed code is extrapolated by the phase of the arc; if there is no arc, it is NaN.
    SmoothingState
        State for the next chunk. The division into chunks changes the result only by rounding errors (1e-9 m).
    """
    limits, state = limits or SmoothingLimits(), state or SmoothingState()
    channels = channel_keys(satellite, signal)
    rows = rows_before(state.channels, channels)
    base0, last0 = (np.append(values, np.nan)[rows] for values in (state.base_m, state.last_m))
    offset0 = np.append(state.offset_m, 0.0)[rows]
    count0 = np.append(state.count, 0)[rows]
    if not len(time):
        return code_m, state
    has_phase = np.isfinite(phase_m)
    has = has_phase & np.isfinite(code_m)
    # without a phase, no arc continues into the next epoch
    begins = slip | ~has_phase
    codes = np.cumsum(has, axis=0)
    before = _hold((codes - has).astype(np.float64), begins, -count0.astype(np.float64))
    count = np.where(has_phase, codes - before, 0.0)
    difference = np.where(has, code_m - phase_m, np.nan)
    apart = np.full(len(time) + 1, state.clock_m)
    if limits.clocks == "own":
        apart = np.cumsum(np.r_[state.clock_m, _common_change(difference, begins, last0)])
    last, difference = difference[-1], difference - apart[1:, None]
    # the first code of an arc may be later than its first phase
    base = _hold(difference, (has & (count == 1)) | begins, base0)

    dt = seconds(np.diff(np.concatenate([np.asarray([state.time], dtype="datetime64[ns]"), time])))
    fade = np.clip(np.where(np.isnan(dt), 0.0, dt) / limits.window_s, 0.0, 1.0)[:, None]
    gain = np.where(has, np.maximum(1.0 / np.maximum(count, 1.0), fade), 0.0)
    gain = np.where(has & (count <= 1), 1.0, gain)
    keep = np.where(begins, 0.0, 1.0 - gain)
    drive = gain * np.where(has, difference - base, 0.0)
    unchanged = np.ones((1, len(channels)))
    offset = linear_recursion(np.concatenate([unchanged, keep]), np.concatenate([offset0[None], drive]))[1:]

    runs = has_phase & (count >= 1)
    smoothed = np.where(runs, phase_m + (base + offset + apart[1:, None]), code_m)
    smoothed = np.where(has & (gain == 1.0), code_m, smoothed)
    after = SmoothingState(
        time=time[-1], channels=channels, base_m=read_only(np.where(runs[-1], base[-1], np.nan)),
        offset_m=read_only(np.where(runs[-1], offset[-1], 0.0)),
        count=read_only(np.where(runs[-1], count[-1], 0.0).astype(np.int64)), last_m=read_only(last),
        clock_m=float(apart[-1]),
    )  # fmt: skip
    return smoothed, after
