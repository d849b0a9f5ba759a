"""Speeds that a train can have after those measured so far.

Reflections off one wall can agree with each other on a speed and a place that are wrong; with few satellites in view
the measurements do not show it. The speed does: no train goes from 11 m/s to rest in a second.
The prediction's own standard deviation does not, as it grows with every epoch without redundancy.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats
from railfix.tracking.limits import TrackingLimits
from railfix.tracking.state import ANY_SPEED, TrackState, Unknown

#: A measured speed is known to so many standard deviations.
SPEED_SIGMAS: Final = 4.0


def widen(state: TrackState, dt: float, limits: TrackingLimits, *, refused: bool = False) -> None:
    """Widen the range of possible speeds by what a train does in `dt` seconds; no bounds on several branches.

    `refused`: after an epoch that was not used, by emergency braking, so that braking is followed from the next epoch.
    """
    low, high = state.speed_range_mps if state.hypotheses == 1 else ANY_SPEED
    change = (limits.level_acceleration_mps2 if refused else limits.service_acceleration_mps2) * dt
    state.speed_range_mps = (low - change, high + change)


def possible(state: TrackState, mean: Floats, covariance: Floats, *, trusted: bool) -> bool:
    """Return whether the speed after an epoch's update is possible, and narrow the range to it where it is.

    Parameters
    ----------
    state : TrackState
    mean, covariance : ndarray, shapes (N,), (N, N)
        After the update.
    trusted : bool
        It is by enough satellites, or a sensor on board too, to be believed whatever the range.
    """
    low, high = ANY_SPEED if trusted else state.speed_range_mps
    speed, reach = float(mean[Unknown.SPEED]), SPEED_SIGMAS * float(np.sqrt(covariance[Unknown.SPEED, Unknown.SPEED]))
    if speed + reach < low or speed - reach > high:
        return False
    state.speed_range_mps = (max(low, speed - reach), min(high, speed + reach))
    return True
