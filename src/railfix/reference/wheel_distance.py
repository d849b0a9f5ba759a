"""Estimate the distance per tachometer pulse from good fixes, and compute distances from the tachometer table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats
from railfix.core.errors import MismatchError
from railfix.core.timescale import seconds
from railfix.io.reference_log import Pulses

_WINDOW_S: Final = 10.0  #: Length of a window for the estimate of the distance per pulse [s].
_LEAST_DISTANCE_M: Final = 30.0  #: A window is used only if the train travels at least this distance in it [m].
_LEAST_WINDOWS: Final = 5  #: The distance per pulse is estimated only from at least this number of windows.
_DIRECTION_MPS: Final = 0.3  #: The sign of a speed determines the direction only if the speed exceeds this value [m/s].
_FASTEST_MPS: Final = 150.0  #: Pulses that imply a higher speed are an error [m/s].


@dataclass(frozen=True, kw_only=True)
class Wheel:
    """Tachometer table, and distance per pulse."""

    pulses: Pulses
    pulse_m: float
    source: str  #: Source of the distance per pulse, in words.

    @property
    def reading_sigma_m(self) -> float:
        """Standard deviation of a reading [m]: 0, except for a counter, with an error assumed uniform over a pulse."""
        return self.pulse_m / float(np.sqrt(12.0)) if self.pulses.kind == "count" else 0.0

    def distance_m(self, time: Datetimes, speed_hint_mps: Floats) -> Floats:
        """Compute the cumulated distance along rising chainage at instants, shape (N,) [m].

        `speed_hint_mps` are speeds from another source; their sign determines the direction of unsigned pulses. Between
        hints of opposite directions, the direction changes at the longest standstill. The distance is NaN where the
        table has no reading, and where the direction is undetermined because of a reversal without a stop.
        """
        run = self.pulse_m * self.pulses.at(time)
        sign = _direction(run, speed_hint_mps)
        if self.pulses.signed:
            # A signed counter distinguishes the directions. The hints only determine which sign means rising chainage.
            rising = np.sign(np.nansum(np.diff(run) * sign))
            return run if rising >= 0 else -run
        step = np.diff(run) * sign
        return _cumulate(run, step)


def _cumulate(run: Floats, step: Floats) -> Floats:
    """Return the cumulative sum of signed steps; NaN at instants without a reading or after an unknown step."""
    known = np.isfinite(step)
    total = np.concatenate([[0.0], np.cumsum(np.where(known, step, 0.0))])
    open_ = np.isnan(run)
    # The first instant after an unknown step is dropped, so that no difference spans a gap.
    open_[1:] |= ~known
    return np.where(open_, np.nan, total)


def _direction(run: Floats, hint: Floats) -> Floats:
    """Return the direction of each step, 1 or -1, shape (N - 1,). It is NaN where undetermined, and 1 without hints."""
    known = np.where(np.abs(hint) > _DIRECTION_MPS, np.sign(hint), np.nan)
    at = np.flatnonzero(np.isfinite(known))
    if not len(at):
        return np.ones(len(run) - 1)
    steps = np.arange(len(run) - 1) + 0.5
    after = np.clip(np.searchsorted(at, steps), 0, len(at) - 1)
    before = np.clip(np.searchsorted(at, steps) - 1, 0, len(at) - 1)
    sign = known[at[before]].copy()
    turning = np.flatnonzero(known[at[1:]] != known[at[:-1]])
    for k in turning.tolist():
        first, last = int(at[k]), int(at[k + 1])
        sign[first:last] = _turn(np.diff(run[first : last + 1]), float(known[first]), float(known[last]))
    sign[: at[0]] = known[at[after[: at[0]]]]
    return sign


def _turn(step: Floats, before: float, after: float) -> Floats:
    """Return the direction of each step of a stretch in which the train reverses.

    The train is assumed to reverse at the longest stop; the directions are NaN if there is no stop.
    """
    standing = np.abs(np.nan_to_num(step, nan=1.0)) < 1e-9
    if not standing.any():
        # A train can reverse between two pulses without a step of zero, so that the time of reversal is unknown.
        return np.full(len(step), np.nan)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], standing, [False]]).astype(np.int8)))
    begin, end = edges[::2], edges[1::2]
    longest = int(np.argmax(end - begin))
    middle = (int(begin[longest]) + int(end[longest])) // 2
    return np.where(np.arange(len(step)) < middle, before, after)


def estimate_wheel(pulses: Pulses, pulse_m: float | None, time: Datetimes, arc_m: Floats) -> Wheel:
    """Return a `Wheel` with the given distance per pulse, or with the median of the estimates from good fixes.

    Raise MismatchError if there are too few fixes in motion, or if the speed between two rows exceeds 150 m/s.
    """
    source = "given"
    if pulses.kind == "distance":
        pulse_m, source = 1.0, "metres in the table"
    elif pulse_m is None:
        pulse_m, source = _estimate(pulses, time, arc_m), "estimated from the fixes"
    speed = np.abs(np.diff(pulses.count)) * pulse_m / seconds(np.diff(pulses.time))
    if speed.max() > _FASTEST_MPS:
        row = int(np.argmax(speed))
        raise MismatchError(
            f"{pulses.path}: {speed[row]:.0f} m/s between rows {row + 1} and {row + 2} with {pulse_m:.6g} m "
            "per pulse; does the counter wrap, or is the distance per pulse wrong?"
        )
    return Wheel(pulses=pulses, pulse_m=pulse_m, source=source)


def _estimate(pulses: Pulses, time: Datetimes, arc_m: Floats) -> float:
    count = pulses.at(time)
    t = seconds(time - time[0])
    end = np.searchsorted(t, t + _WINDOW_S)
    start = np.flatnonzero(end < len(t))
    end = end[start]
    inside = t[end] - t[start] <= 1.5 * _WINDOW_S
    distance, turned = np.abs(arc_m[end] - arc_m[start])[inside], np.abs(count[end] - count[start])[inside]
    usable = (distance > _LEAST_DISTANCE_M) & np.isfinite(turned) & (turned > 0)
    if usable.sum() < _LEAST_WINDOWS:
        raise MismatchError(
            f"{pulses.path}: too few fixes in motion to estimate the distance per pulse; specify it with --pulse "
            "(wheel circumference divided by pulses per turn)"
        )
    return float(np.median(distance[usable] / turned[usable]))
