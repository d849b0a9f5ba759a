"""Speed, acceleration and distance from the pulse times of a tachometer (P2 2.2), and checks of its settings.

From pulse k0 to pulse k, the mean speed is ``(k - k0) p / (t_k - t_k0)``, with the distance per pulse p. At constant
acceleration, this is the speed at the middle of the interval, so that each speed is returned with this time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Datetimes, Floats, Indices, Integers, Masks
from railfix.core.settings import Settings
from railfix.core.timescale import seconds, timedelta
from railfix.motion.samples import TachometerPulses

#: Names of speed units, by their conversion factors from m/s.
_UNITS: Final = {3.6: "km/h", 2.2369: "miles per hour", 1.94384: "knots"}
#: Largest relative deviation of a speed ratio from a unit's factor. Wear is at most 2 %; units differ by 15 % or more.
_UNIT_SHARE: Final = 0.05
LEAST_SPEED_MPS: Final = 1.0 / 3.6  #: Lowest speed that is returned: 1 km/h (P2 1).


class TachometerLimits(Settings):
    """Parameters of a tachometer and of the computation of its speeds."""

    wheel_diameter_m: float = Field(default=0.86, gt=0.2, lt=2.0)  #: Wheel diameter configured on board.
    pulses_per_turn: int = Field(default=60, ge=1)  #: Pulses per turn of the wheel, including an edge multiplication.
    #: Time over which a speed is computed. The usual smoothing time of a tachometer is 0.1 s (P2 3.2). With uneven
    #: teeth, use the time of a full turn.
    window_s: float = Field(default=0.1, gt=0)
    silence_s: float = Field(default=0.3, gt=0)  #: Time without a pulse after which the speed is NaN.
    jitter_s: float = Field(default=5e-6, ge=0)  #: Standard deviation of a pulse time.
    resolution_s: float = Field(default=1e-6, ge=0)  #: Resolution of the clock that tags the pulses.

    @property
    def pulse_m(self) -> float:
        """Distance per pulse [m]."""
        return float(np.pi) * self.wheel_diameter_m / self.pulses_per_turn


@dataclass(frozen=True, kw_only=True)
class PulseSpeeds:
    """Speeds from the pulses before N requested instants."""

    #: Time at which each speed is valid, which precedes the requested instant, shape (N,); NaT without a speed.
    time: Datetimes
    speed_mps: Floats  #: Speed, negative backward, shape (N,); NaN if not available.
    #: Standard deviation of the speed from jitter and clock resolution, without the wheel scale error, shape (N,).
    sigma_mps: Floats


def pulse_speeds(pulses: TachometerPulses, time: Datetimes, *, limits: TachometerLimits | None = None) -> PulseSpeeds:
    """Compute the speeds at N instants, each from the pulses of the last `window_s` up to the instant.

    A speed is NaN before the second pulse, after `silence_s` without a pulse, or if it is below `LEAST_SPEED_MPS`.
    """
    limits = limits or TachometerLimits()
    last = np.searchsorted(pulses.time, time, side="right") - 1
    some = last >= 1
    if not len(pulses) or not some.any():
        nothing = np.full(len(time), np.nan)
        return PulseSpeeds(time=np.full(len(time), np.datetime64("NaT", "ns")), speed_mps=nothing, sigma_mps=nothing)
    at = np.maximum(last, 0)
    first = window_start(pulses.time, at, limits.window_s)
    count = np.abs(pulses.pulse[at] - pulses.pulse[first]).astype(np.float64)
    duration = seconds(pulses.time[at] - pulses.time[first])
    since = seconds(time - pulses.time[at])
    with np.errstate(divide="ignore", invalid="ignore"):
        size = count * limits.pulse_m / duration
        spread = size * np.sqrt(2.0 * limits.jitter_s**2 + limits.resolution_s**2 / 6.0) / duration
    valid = some & (duration > 0) & (size >= LEAST_SPEED_MPS) & (since <= limits.silence_s)
    # reject speeds above twice the speed at which the next pulse would have come by now
    valid &= limits.pulse_m / np.maximum(since, 1e-9) >= 0.5 * size
    sign = np.where(pulses.direction[at] == 0, 1.0, pulses.direction[at])
    middle = pulses.time[first] + (pulses.time[at] - pulses.time[first]) // 2
    return PulseSpeeds(
        time=np.where(valid, middle, np.datetime64("NaT", "ns")),
        speed_mps=np.where(valid, sign * size, np.nan),
        sigma_mps=np.where(valid, spread, np.nan),
    )


def window_start(time: Datetimes, last: Indices, window_s: float) -> Indices:
    """Return, for each pulse in `last`, the index of the first pulse of the window that ends at this pulse.

    The first pulse is the latest pulse at least `window_s` before the end, or pulse 0 if no pulse is that early. Only
    for pulse 0 are the first pulse and the end the same pulse.
    """
    start = np.searchsorted(time, time[last] - timedelta(np.full(len(last), window_s)), side="right") - 1
    return np.asarray(np.maximum(np.minimum(start, last - 1), 0), dtype=np.intp)


def pulse_acceleration(early: PulseSpeeds, late: PulseSpeeds) -> Floats:
    """Return the acceleration between two speeds [m/s2]; NaN where either speed is missing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((late.speed_mps - early.speed_mps) / seconds(late.time - early.time))


def distance_m(pulses: TachometerPulses, time: Datetimes, *, limits: TachometerLimits | None = None) -> Floats:
    """Return the signed distance [m] travelled up to N instants, each from the pulses up to the instant.

    Between pulses, the distance is extrapolated with the last speed, by at most one pulse. The distance before the
    first pulse is 0. A pulse without direction counts as forward.
    """
    limits = limits or TachometerLimits()
    if not len(pulses):
        return np.zeros(len(time))
    step = np.diff(pulses.pulse, prepend=pulses.pulse[0] - 1).astype(np.float64)
    sign = np.where(pulses.direction == 0, 1.0, pulses.direction.astype(np.float64))
    total = np.concatenate([[0.0], np.cumsum(np.abs(step) * sign)])
    last = np.searchsorted(pulses.time, time, side="right") - 1
    speed = pulse_speeds(pulses, time, limits=limits)
    since = seconds(time - pulses.time[np.maximum(last, 0)])
    ahead = np.clip(np.nan_to_num(speed.speed_mps * since / limits.pulse_m), -1.0, 1.0)
    return np.asarray(limits.pulse_m * (total[last + 1] + np.where(last >= 0, ahead, 0.0)))


def tooth_faults(pulses: TachometerPulses) -> tuple[Masks, Masks]:
    """Return masks of the pulses that follow a lost pulse, and of doubled pulses, shape (P,) each.

    A pulse is lost in an interval about twice as long as each adjacent interval, or where `pulse` numbers are missing.
    A pulse is doubled if the sum of the intervals before and after the pulse equals each adjacent interval.
    """
    count = len(pulses)
    lost, doubled = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
    if count < 5:
        return lost, doubled
    interval = seconds(np.diff(pulses.time))
    before, after = interval[:-2], interval[2:]
    even = np.abs(before - after) < 0.3 * np.minimum(before, after)
    with np.errstate(divide="ignore", invalid="ignore"):  # intervals may be zero
        lost[2:-1] = even & (np.abs(interval[1:-1] / (0.5 * (before + after)) - 2.0) < 0.3)
    lost[1:] |= np.diff(pulses.pulse) > 1
    pair = interval[1:-2] + interval[2:-1]
    outer = 0.5 * (interval[:-3] + interval[3:])
    close = np.abs(interval[:-3] - interval[3:]) < 0.3 * outer
    doubled[2:-2] = close & (np.abs(pair / outer - 1.0) < 0.2)
    return lost, doubled


def faults_until(pulses: TachometerPulses, time: Datetimes) -> Integers:
    """Return the number of lost and doubled pulses that are detected up to each of N instants.

    A fault is detected two pulses later. Lost pulses with missing `pulse` numbers are not counted.
    """
    lost, doubled = tooth_faults(pulses)
    total = np.concatenate([[0], np.cumsum((lost & (np.diff(pulses.pulse, prepend=pulses.pulse[:1]) < 2)) | doubled)])
    return np.asarray(total[np.maximum(np.searchsorted(pulses.time, time, side="right") - 2, 0)], dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class SpeedCheck:
    """Scale, unit and delay of logged speeds relative to reference speeds."""

    ratio: float  #: Ratio of logged to reference speeds, after conversion from `unit`.
    unit: str  #: Detected unit of the logged speeds; "m/s" if no other unit fits the ratio.
    lag_s: float  #: Delay of the logged speeds.


#: Largest positive or negative delay in the search [s].
_LARGEST_LAG_S: Final = 3.0


def check_speeds(time: Datetimes, speed_mps: Floats, right_time: Datetimes, right_mps: Floats) -> SpeedCheck:
    """Estimate scale, unit and delay of logged speeds by least squares over a grid of delays.

    `speed_mps`, shape (N,), are logged speeds. `right_mps`, shape (M,), are reference speeds, for example from
    Dopplers. Absolute speeds are compared. Raise ValueError for fewer than ten pairs of speeds above 1 m/s.
    """
    known = np.isfinite(right_mps)
    right_t = seconds(right_time[known] - right_time[0])
    size = np.abs(right_mps[known])
    t = seconds(time - right_time[0])
    lags = np.arange(-_LARGEST_LAG_S, _LARGEST_LAG_S + 0.05, 0.1)
    costs, ratios = np.full(len(lags), np.inf), np.full(len(lags), np.nan)
    for k, lag in enumerate(lags.tolist()):
        right = np.interp(t - lag, right_t, size, left=np.nan, right=np.nan)
        use = np.isfinite(right) & np.isfinite(speed_mps) & (right > 1.0)
        if use.sum() >= 10:
            logged = np.abs(speed_mps[use])
            ratios[k] = float((logged * right[use]).sum() / (right[use] ** 2).sum())
            costs[k] = float(np.mean((logged / ratios[k] - right[use]) ** 2))
    if not np.isfinite(costs).any():
        raise ValueError("fewer than ten common speeds over 1 m/s; provide a longer log")
    best = int(np.argmin(costs))
    ratio = float(ratios[best])
    unit = next((f for f in _UNITS if abs(ratio / f - 1.0) < _UNIT_SHARE), None)
    return SpeedCheck(
        ratio=ratio if unit is None else ratio / unit,
        unit="m/s" if unit is None else _UNITS[unit],
        lag_s=round(float(lags[best]), 3),
    )
