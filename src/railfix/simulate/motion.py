"""Chainage and speed of the train over time: pieces of even acceleration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from railfix.simulate.scenario import RunSettings

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Pieces of even acceleration; the last one goes on.

    Attributes
    ----------
    time_s : ndarray, shape (P,) [s]
        Start of each piece, rising from 0.
    chainage_m, speed_mps, acceleration_mps2 : ndarray, shape (P,)
        At the start of the piece; signs are those of rising chainage.
    """

    time_s: Floats
    chainage_m: Floats
    speed_mps: Floats
    acceleration_mps2: Floats

    def at(self, time_s: ArrayLike) -> tuple[Floats, Floats]:
        """Chainage [m] and speed [m/s] at times; before 0 the train stands."""
        time = np.asarray(time_s, dtype=np.float64)
        piece = np.maximum(np.searchsorted(self.time_s, time, side="right") - 1, 0)
        since = np.maximum(time - self.time_s[piece], 0.0)
        speed = self.speed_mps[piece] + self.acceleration_mps2[piece] * since
        return self.chainage_m[piece] + (self.speed_mps[piece] + speed) / 2.0 * since, speed


def shuttle(first_m: float, last_m: float, duration_s: float, settings: RunSettings) -> Motion:
    """A train that runs between two chainages, standing at each, for at least a duration.

    Parameters
    ----------
    first_m, last_m : float [m]
    duration_s : float [s]
    settings : RunSettings

    Returns
    -------
    Motion
    """
    length = last_m - first_m
    up, down = settings.acceleration_mps2, settings.deceleration_mps2
    top = min(settings.cruise_mps, float(np.sqrt(2.0 * length * up * down / (up + down))))
    cruise_s = max(0.0, (length - top**2 / (2.0 * up) - top**2 / (2.0 * down)) / top)
    # One leg: accelerate, cruise, brake, stand; in the units of its own direction.
    steps = np.array([top / up, cruise_s, top / down, settings.stand_s])
    offsets = np.array([0.0, top**2 / (2.0 * up), length - top**2 / (2.0 * down), length])
    speeds, accelerations = np.array([0.0, top, top, 0.0]), np.array([up, 0.0, -down, 0.0])
    legs = max(1, int(np.ceil((duration_s - settings.first_stand_s) / steps.sum())))
    outward = (np.arange(legs) % 2 == 0)[:, None]
    sign = np.where(outward, 1.0, -1.0)
    chainage = np.where(outward, first_m + offsets, last_m - offsets).ravel()
    ends = settings.first_stand_s + np.cumsum(np.tile(steps, legs))
    return Motion(
        time_s=np.concatenate([[0.0, settings.first_stand_s], ends[:-1]]),
        chainage_m=np.concatenate([[first_m], chainage]),
        speed_mps=np.concatenate([[0.0], (sign * speeds).ravel()]),
        acceleration_mps2=np.concatenate([[0.0], (sign * accelerations).ravel()]),
    )
