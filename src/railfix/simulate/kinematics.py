"""Motion as pieces of constant jerk, and the limit of its jerk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Floats

#: Rounds in which the length of the average is lengthened until every change of acceleration fits.
_ROUNDS: Final = 20


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Pieces of constant jerk (without a limit of the jerk: of constant acceleration); the last one continues.

    Attributes
    ----------
    time_s : ndarray, shape (P,) [s]
        Start of each piece, rising from 0.
    chainage_m, speed_mps, acceleration_mps2 : ndarray, shape (P,)
        At the start of the piece; signs are those of rising chainage.
    jerk_mps3 : ndarray, shape (P,), or float [m/s^3]
    """

    time_s: Floats
    chainage_m: Floats
    speed_mps: Floats
    acceleration_mps2: Floats
    jerk_mps3: Floats | float = 0.0

    def at(self, time_s: ArrayLike) -> tuple[Floats, Floats]:
        """Chainage [m] and speed [m/s] at times; before 0 the train stands."""
        time = np.asarray(time_s, dtype=np.float64)
        piece = np.maximum(np.searchsorted(self.time_s, time, side="right") - 1, 0)
        since = np.maximum(time - self.time_s[piece], 0.0)
        speed = self.speed_mps[piece] + self.acceleration_mps2[piece] * since
        chainage = self.chainage_m[piece] + (self.speed_mps[piece] + speed) / 2.0 * since
        if not np.any(self.jerk_mps3):
            return chainage, speed
        jerk = np.asarray(self.jerk_mps3)[piece]
        return chainage + jerk * since**3 / 6.0, speed + jerk * since**2 / 2.0

    def acceleration_at(self, time_s: ArrayLike) -> Floats:
        """Acceleration along the line [m/s^2] at times; before 0 none."""
        time = np.asarray(time_s, dtype=np.float64)
        piece = np.searchsorted(self.time_s, time, side="right") - 1
        at = np.maximum(piece, 0)
        acceleration = self.acceleration_mps2[at]
        if np.any(self.jerk_mps3):
            acceleration = acceleration + np.asarray(self.jerk_mps3)[at] * (time - self.time_s[at])
        return np.where(piece < 0, 0.0, acceleration)


def limit_jerk(motion: Motion, jerk_mps3: float) -> Motion:
    """Moving average of a motion of constant accelerations over the time that keeps its jerk within a limit.

    The average of the chainage over [t - T, t] has the speed ``(s(t) - s(t - T)) / T``, the acceleration
    ``(v(t) - v(t - T)) / T`` and the jerk ``(a(t) - a(t - T)) / T``: it never exceeds the motion's
    own largest speed and acceleration, stops at the same chainages, and is late by T / 2. A stop shorter than
    T is not reached.
    """
    start = motion.time_s
    duration = float(np.abs(np.diff(motion.acceleration_mps2, prepend=0.0)).max()) / jerk_mps3
    if duration == 0.0:
        return motion
    for _ in range(_ROUNDS):
        change = float(np.abs(_acceleration_change(motion, _breakpoints(start, duration), duration)).max())
        if change <= jerk_mps3 * duration * (1.0 + 1e-9):
            break
        duration = change / jerk_mps3
    time = _breakpoints(start, duration)
    chainage, speed = motion.at(time)
    earlier_chainage, earlier_speed = motion.at(time - duration)
    new_speed = (chainage - earlier_chainage) / duration
    new_acceleration = (speed - earlier_speed) / duration
    new_jerk = _acceleration_change(motion, time, duration) / duration
    step = np.diff(time)
    way = new_speed[:-1] * step + new_acceleration[:-1] * step**2 / 2.0 + new_jerk[:-1] * step**3 / 6.0
    return Motion(
        time_s=time,
        chainage_m=motion.chainage_m[0] + np.concatenate([[0.0], np.cumsum(way)]),
        speed_mps=new_speed,
        acceleration_mps2=new_acceleration,
        jerk_mps3=new_jerk,
    )


def _breakpoints(start_s: Floats, duration_s: float) -> Floats:
    return np.unique(np.concatenate([start_s, start_s + duration_s]))


def _acceleration_change(motion: Motion, time_s: Floats, duration_s: float) -> Floats:
    """Acceleration at breakpoints less that a duration earlier, both just after them."""
    after = time_s + 1e-9
    return np.asarray(motion.acceleration_at(after) - motion.acceleration_at(after - duration_s))
