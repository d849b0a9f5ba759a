"""Speed, acceleration and distance from the instants of a tachometer's pulses (P2 2.2), and checks of its settings.

Over the pulses k0 to k the mean speed is ``(k - k0) p / (t_k - t_k0)``; where the acceleration is even it is the speed
at the middle of the interval, and that instant is returned with it.
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

#: Ratios of a speed in a wrong unit to one in m/s, and the names of the units.
_UNITS: Final = {3.6: "km/h", 2.2369: "miles per hour", 1.94384: "knots"}
#: A ratio within this fraction of a unit's is that unit: more than a worn wheel (2 %), less than between two units.
_UNIT_SHARE: Final = 0.05
LEAST_SPEED_MPS: Final = 1.0 / 3.6  #: Lowest speed of the output (P2 1; 1 km/h).


class TachometerLimits(Settings):
    """Wheel and window of a tachometer."""

    wheel_diameter_m: float = Field(default=0.86, gt=0.2, lt=2.0)  #: As configured on board.
    pulses_per_turn: int = Field(default=60, ge=1)  #: After multiplication of edges.
    #: Time over which speeds are taken. P2 3.2 gives 0.1 s as the usual smoothing of a tachometer; with uneven teeth
    #: use the time of a whole turn.
    window_s: float = Field(default=0.1, gt=0)
    silence_s: float = Field(default=0.3, gt=0)  #: Time without a pulse after which the output is NaN.
    #: Standard deviation of a pulse's instant, and the step of its clock.
    jitter_s: float = Field(default=5e-6, ge=0)
    resolution_s: float = Field(default=1e-6, ge=0)

    @property
    def pulse_m(self) -> float:
        """Distance per pulse [m]."""
        return float(np.pi) * self.wheel_diameter_m / self.pulses_per_turn


@dataclass(frozen=True, kw_only=True)
class PulseSpeeds:
    """Speeds at N requested instants."""

    #: Instant at which each speed is valid, earlier than requested; NaT where there is none; shape (N,).
    time: Datetimes
    speed_mps: Floats  #: Signed by the direction; NaN where the pulses give no speed; shape (N,).
    sigma_mps: Floats  #: Standard deviation by jitter and clock; the wheel's scale error is separate; shape (N,).


def pulse_speeds(pulses: TachometerPulses, time: Datetimes, *, limits: TachometerLimits | None = None) -> PulseSpeeds:
    """Return speeds from the intervals of pulses, each from pulses up to its instant, shape (N,)."""
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
    # The absence of a pulse bounds the speed, too.
    valid &= limits.pulse_m / np.maximum(since, 1e-9) >= 0.5 * size
    sign = np.where(pulses.direction[at] == 0, 1.0, pulses.direction[at])
    middle = pulses.time[first] + (pulses.time[at] - pulses.time[first]) // 2
    return PulseSpeeds(
        time=np.where(valid, middle, np.datetime64("NaT", "ns")),
        speed_mps=np.where(valid, sign * size, np.nan),
        sigma_mps=np.where(valid, spread, np.nan),
    )


def window_start(time: Datetimes, last: Indices, window_s: float) -> Indices:
    """Return the last pulse not after a window before each pulse, at least one pulse back; the first at the start."""
    start = np.searchsorted(time, time[last] - timedelta(np.full(len(last), window_s)), side="right") - 1
    return np.asarray(np.maximum(np.minimum(start, last - 1), 0), dtype=np.intp)


def pulse_acceleration(early: PulseSpeeds, late: PulseSpeeds) -> Floats:
    """Return the difference of two speeds over the time between them [m/s2]; NaN where one is missing."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray((late.speed_mps - early.speed_mps) / seconds(late.time - early.time))


def distance_m(pulses: TachometerPulses, time: Datetimes, *, limits: TachometerLimits | None = None) -> Floats:
    """Return the signed distance run up to instants, from pulses up to each, shape (N,) [m].

    Between pulses the distance continues at the last speed, by less than one pulse. It is 0 before the first pulse.
    Where the sensor has no direction every pulse counts forward.
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
    """Return pulses before which one was lost, and pulses that are one of a doubled pair, shapes (P,).

    An interval twice as long as both neighbours hides a lost pulse (also shown by `pulse` numbers); two successive
    intervals that together equal one neighbour are a doubled pulse.
    """
    count = len(pulses)
    lost, doubled = np.zeros(count, dtype=np.bool_), np.zeros(count, dtype=np.bool_)
    if count < 5:
        return lost, doubled
    interval = seconds(np.diff(pulses.time))
    before, after = interval[:-2], interval[2:]
    even = np.abs(before - after) < 0.3 * np.minimum(before, after)
    with np.errstate(divide="ignore", invalid="ignore"):  # pulses with the same time tag
        lost[2:-1] = even & (np.abs(interval[1:-1] / (0.5 * (before + after)) - 2.0) < 0.3)
    lost[1:] |= np.diff(pulses.pulse) > 1
    pair = interval[1:-2] + interval[2:-1]
    outer = 0.5 * (interval[:-3] + interval[3:])
    close = np.abs(interval[:-3] - interval[3:]) < 0.3 * outer
    doubled[2:-2] = close & (np.abs(pair / outer - 1.0) < 0.2)
    return lost, doubled


def faults_until(pulses: TachometerPulses, time: Datetimes) -> Integers:
    """Return the number of lost and doubled pulses detected up to instants, two pulses late, shape (N,)."""
    lost, doubled = tooth_faults(pulses)
    total = np.concatenate([[0], np.cumsum((lost & (np.diff(pulses.pulse, prepend=pulses.pulse[:1]) < 2)) | doubled)])
    return np.asarray(total[np.maximum(np.searchsorted(pulses.time, time, side="right") - 2, 0)], dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class SpeedCheck:
    """Comparison of logged speeds with correct speeds."""

    ratio: float  #: Logged over right, without the unit.
    unit: str  #: "m/s", or the actual unit of the log.
    lag_s: float  #: Delay of its time tags.


#: Largest lag that is searched for [s].
_LARGEST_LAG_S: Final = 3.0


def check_speeds(time: Datetimes, speed_mps: Floats, right_time: Datetimes, right_mps: Floats) -> SpeedCheck:
    """Return scale, unit and lag of logged speeds (N,) by the least squares of their sizes over a search of lags.

    `right_time`, `right_mps`, shape (M,), for example by Doppler. ValueError with fewer than ten speeds over 1 m/s in
    common.
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
        raise ValueError("fewer than ten speeds over 1 m/s in common; give a longer log")
    best = int(np.argmin(costs))
    ratio = float(ratios[best])
    unit = next((f for f in _UNITS if abs(ratio / f - 1.0) < _UNIT_SHARE), None)
    return SpeedCheck(
        ratio=ratio if unit is None else ratio / unit,
        unit="m/s" if unit is None else _UNITS[unit],
        lag_s=round(float(lags[best]), 3),
    )
