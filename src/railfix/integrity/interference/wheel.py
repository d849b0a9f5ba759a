"""Detection of slow spoofing along the track from GNSS and wheel distances.

The GNSS distance is the difference between two GNSS positions along the line. Without spoofing, it differs from the
wheel distance by position noise and the wheel scale-factor error, which is estimated from the data before the window.
Spoofing that begins with the run, or stays within the uncertainty of the scale factor, is not detected.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, RowArrays, join_rows
from railfix.core.timescale import GPS_EPOCH, seconds, timedelta
from railfix.integrity.interference.limits import HeldState, InterferenceLimits, hold_signs

_LEAST_M: Final = 1.0  #: Standard deviation of satellite and atmospheric errors that change over minutes [m].
_SLOW_MPS: Final = 0.5  #: Speed below which a tachometer may have no output [m/s].
#: Compared positions are a second apart. Time tags up to 5 ms before a whole second count as that second.
_SECOND, _TAG = np.timedelta64(1, "s"), np.timedelta64(5, "ms")


@dataclass(frozen=True, kw_only=True)
class WheelSamples(RowArrays):
    """GNSS positions and wheel distances, at most one pair per second, shape (N,)."""

    time: Datetimes = field(default_factory=lambda: np.empty(0, dtype="datetime64[ns]"))
    arc_m: Floats = field(default_factory=lambda: np.empty(0))  #: GNSS position along the line.
    sigma_m: Floats = field(default_factory=lambda: np.empty(0))  #: Standard deviation of the GNSS position.
    distance_m: Floats = field(default_factory=lambda: np.empty(0))  #: Wheel distance since the start of the run.
    #: Upper bound on the distance that is missing from `distance_m`, because tachometers have no output at low speed.
    doubt_m: Floats = field(default_factory=lambda: np.empty(0))
    #: Index of the part of the run. Within a part, the wheel data have neither slip nor a gap.
    part: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))


@dataclass(frozen=True, kw_only=True)
class WheelState:
    """State of the comparison at the end of a chunk."""

    #: First sample of the current part, and the samples of the last window.
    samples: WheelSamples = field(default_factory=WheelSamples)
    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))  #: Time of the last epoch.
    distance_m: float = 0.0  #: `WheelSamples.distance_m` at the last epoch.
    doubt_m: float = 0.0  #: `WheelSamples.doubt_m` at the last epoch.
    speed_mps: float = float("nan")  #: Last known wheel speed; NaN if no speed is known yet.
    part: int = 0  #: Number of the current part.
    second: int = -1  #: GPS second of the last epoch; -1 before the first epoch.
    held: HeldState = field(default_factory=HeldState)
    difference_m: float = float("nan")  #: `WheelSigns.difference_m` at the last sample.
    bound_m: float = float("nan")  #: `WheelSigns.bound_m` at the last sample.
    beyond: bool = False  #: True if the difference exceeds its limits at the last sample.


@dataclass(frozen=True, kw_only=True)
class WheelSigns:
    """Differences between GNSS and wheel distances at T epochs."""

    #: GNSS distance minus scaled wheel distance over the window, shape (T,); NaN where not compared.
    difference_m: Floats
    #: Bound of the position error caused by spoofing that began within the window, shape (T,): absolute difference plus
    #: `wheel_level_sigmas` times the combined standard deviation of the wheel distance and of the position at the
    #: window start.
    bound_m: Floats
    #: True where the difference has exceeded its limits for `hold_s`, or did so within the release time; shape (T,).
    parted: Masks


def wheel_signs(
    time: Datetimes,
    arc_m: Floats,
    sigma_m: Floats,
    wheel_m: Floats,
    state: WheelState,
    limits: InterferenceLimits,
    *,
    signed: bool,
) -> tuple[WheelSigns, WheelState]:
    """Compare GNSS and wheel distances at T epochs; return the signs and the state for the next chunk.

    `arc_m` are single-epoch or filtered positions along the line, `sigma_m` their standard deviations, and `wheel_m`
    the wheel distances since the previous epoch. All have the shape (T,), with NaN where unknown. `signed` is True if
    the sign of the wheel distance indicates the direction of motion along the line.
    """
    if not len(time):
        return WheelSigns(difference_m=np.empty(0), bound_m=np.empty(0), parted=np.empty(0, dtype=np.bool_)), state
    rolled, after = _wheel_distances(time, wheel_m, state, limits)
    second = ((time - GPS_EPOCH + _TAG) // _SECOND).astype(np.int64)
    due = second != np.concatenate([[state.second], second[:-1]])
    usable = due & np.isfinite(arc_m) & (sigma_m <= limits.largest_sigma_m)
    every = replace(rolled, arc_m=arc_m, sigma_m=np.hypot(sigma_m, _LEAST_M))
    before = len(state.samples.time)
    samples = join_rows([state.samples, every.take(usable)])
    difference, bound, beyond = _compare(samples, before, limits, signed=signed)
    latest = np.cumsum(usable)
    of_epoch = np.concatenate([[state.difference_m], difference])[latest]
    bounds = np.concatenate([[state.bound_m], bound])[latest]
    signs = np.concatenate([[state.beyond], beyond])[latest]
    hold, release = np.array([limits.hold_s]), np.array([limits.spoofing_release_s])
    _, stays, held_state = hold_signs(time, signs[:, None], state.held, hold_s=hold, release_s=release)
    window = samples.time >= time[-1] - timedelta(np.array(limits.wheel_window_s + 2.0))
    own = samples.part == after.part
    window[np.flatnonzero(own)[:1]] = True
    after = replace(
        after, samples=samples.take(window & own), second=int(second[-1]), held=held_state,
        difference_m=float(of_epoch[-1]), bound_m=float(bounds[-1]), beyond=bool(signs[-1]),
    )  # fmt: skip
    return WheelSigns(difference_m=of_epoch, bound_m=bounds, parted=stays[:, 0]), after


def _wheel_distances(
    time: Datetimes, wheel_m: Floats, state: WheelState, limits: InterferenceLimits
) -> tuple[WheelSamples, WheelState]:
    """Accumulate the wheel distance. A new part begins after a slip, a long interval or an unknown distance."""
    span = seconds(np.diff(np.concatenate([[time[0] if np.isnat(state.time) else state.time], time])))
    known = np.isfinite(wheel_m) & (span > 0.0)
    speed = np.where(known, wheel_m / np.where(span > 0.0, span, 1.0), np.nan)
    row = np.maximum.accumulate(np.where(known, np.arange(1, len(time) + 1), 0))
    last = np.concatenate([[state.speed_mps], speed])[np.concatenate([[0], row[:-1]])]
    slow = ~known & (np.abs(np.nan_to_num(last)) <= 2.0 * _SLOW_MPS)
    held_rail = np.abs(speed - last) <= limits.wheel_acceleration_mps2 * span + _SLOW_MPS
    new = np.where(known, ~held_rail & np.isfinite(last), ~slow) | (span > limits.longest_gap_s)
    part = state.part + np.cumsum(new)
    distance = state.distance_m + np.cumsum(np.where(known, wheel_m, 0.0))
    doubt = state.doubt_m + np.cumsum(np.where(slow, _SLOW_MPS * span, 0.0))
    none = np.full(len(time), np.nan)
    after = replace(
        state, time=time[-1], distance_m=float(distance[-1]), doubt_m=float(doubt[-1]), part=int(part[-1]),
        speed_mps=float(np.concatenate([[state.speed_mps], speed])[row[-1]]),
    )  # fmt: skip
    return WheelSamples(time=time, arc_m=none, sigma_m=none, distance_m=distance, doubt_m=doubt, part=part), after


def _compare(
    samples: WheelSamples, first: int, limits: InterferenceLimits, *, signed: bool
) -> tuple[Floats, Floats, Masks]:
    """Compare GNSS and wheel distances over the window before each sample, beginning with sample `first`.

    Return differences, bounds, and a mask of differences that exceed their limits.
    """
    time = seconds(samples.time - samples.time[0]) if len(samples.time) else np.empty(0)
    now = np.arange(first, len(time))
    begun = np.searchsorted(time, time[now] - limits.wheel_window_s - 0.5)
    start = np.searchsorted(samples.part, samples.part[now])  # part numbers are sorted
    begun = np.maximum(begun, start)
    long_enough = time[now] - time[begun] >= limits.wheel_least_s - 0.5

    def apart(a: Integers, b: Integers) -> tuple[Floats, Floats, Floats]:
        """Return GNSS minus wheel distance, wheel distance, and the variance of the difference without `sigma_m[b]`."""
        arc, distance = samples.arc_m[b] - samples.arc_m[a], samples.distance_m[b] - samples.distance_m[a]
        if not signed:
            arc, distance = np.abs(arc), np.abs(distance)
        doubt = samples.doubt_m[b] - samples.doubt_m[a]
        return arc - distance, distance, samples.sigma_m[a] ** 2 + doubt**2

    difference, distance, at_beginning = apart(begun, now)
    earlier, rolled, noise = apart(start, begun)
    prior = limits.wheel_scale**-2.0
    weight = rolled**2 / (noise + samples.sigma_m[begun] ** 2)
    ratio = np.where(rolled != 0.0, earlier / np.where(rolled != 0.0, rolled, 1.0), 0.0)
    scale = weight * ratio / (prior + weight)
    variance = 1.0 / (prior + weight) + limits.wheel_change**2
    left = difference - scale * distance
    by_wheel = at_beginning + distance**2 * variance
    sigma = np.sqrt(by_wheel + samples.sigma_m[now] ** 2)
    beyond = long_enough & (np.abs(left) >= limits.wheel_m) & (np.abs(left) >= limits.wheel_sigmas * sigma)
    bound = np.abs(left) + limits.wheel_level_sigmas * np.sqrt(by_wheel)
    return np.where(long_enough, left, np.nan), bound, beyond
