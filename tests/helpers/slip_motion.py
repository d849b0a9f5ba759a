"""Motions of a train with slips of a wheel and the ground truth, for the slip detection by itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.constants import GRAVITY_MPS2
from railfix.motion.slip import MotionSamples, MotionState, SlipLimits, SlipResult, find_slips

RATE_HZ = 50.0
SLIPPING = (MotionState.INERTIAL_SPIN, MotionState.INERTIAL_SLIDE)


@dataclass(frozen=True)
class Motion:
    """Speed of train and wheel [m/s], specific force forward [m/s2], sine of the line's gradient, by time [s]."""

    time_s: np.ndarray
    speed: np.ndarray
    wheel: np.ndarray
    force: np.ndarray
    sine: np.ndarray

    def run(self, *, gyro_bias_radps: float | None = None, line: bool = True, **limits: object) -> SlipResult:
        """The slip detection; with a pitch gyro of that bias, and with or without the gradient of the line."""
        acceleration = np.gradient(self.wheel, self.time_s)
        body = None
        if gyro_bias_radps is not None:
            body = np.zeros((len(self.time_s), 3))
            body[:, 1] = np.gradient(np.arcsin(self.sine), self.time_s) + gyro_bias_radps
        sine = self.sine if line else np.full(len(self.time_s), np.nan)
        return find_slips(
            MotionSamples(self.time_s, self.wheel, acceleration, self.force, sine, body),
            limits=SlipLimits.model_validate(limits),
        )[0]  # fmt: skip

    def way_error_m(self, found: SlipResult, begin_s: float, end_s: float) -> float:
        """Way found less the true distance between two instants."""
        k, m = np.searchsorted(self.time_s, [begin_s, end_s])
        true = np.trapezoid(self.speed[k : m + 1], self.time_s[k : m + 1])
        return float(found.distance_m[m] - found.distance_m[k] - true)


def motion(
    seconds: float, slips: list[tuple[float, float, float]], *, noise: float = 0.0, pitching: float = 0.0, seed: int = 0
) -> Motion:
    """Runs between 5 and 25 m/s; each slip (begin, duration, ratio) rises and falls by half a sine."""
    t = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    speed = 15.0 + 10.0 * np.sin(2.0 * np.pi * t / 120.0 - 0.5 * np.pi) * np.minimum(t / 60.0, 1.0)
    acceleration = np.gradient(speed, t)
    sine = 0.02 * np.sin(2.0 * np.pi * np.cumsum(speed) / RATE_HZ / 4000.0)
    ratio = np.zeros(len(t))
    for begin, duration, size in slips:
        inside = (t >= begin) & (t <= begin + duration)
        ratio[inside] = size * np.sin(np.pi * (t[inside] - begin) / duration)
    random = np.random.default_rng(seed)
    body = pitching * np.sin(2.0 * np.pi * 1.1 * t + 3.0 * np.sin(0.05 * t))
    force = acceleration + GRAVITY_MPS2 * (sine + body) + 0.02 + noise * random.normal(size=len(t))
    return Motion(t, speed, speed * (1.0 + ratio), force, sine)


def even_motion(seconds: float, begin_s: float, duration_s: float, excess_mps: float) -> Motion:
    """20 m/s on the level; the wheel is faster by half a sine up to `excess_mps` for one slip."""
    t = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    inside = (t >= begin_s) & (t <= begin_s + duration_s)
    excess = np.where(inside, excess_mps * np.sin(np.pi * (t - begin_s) / duration_s), 0.0)
    still = np.zeros(len(t))
    return Motion(t, np.full(len(t), 20.0), 20.0 + excess, still, still)
