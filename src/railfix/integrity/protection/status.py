"""May the position be used? The level against the alarm limit."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Codes


class LevelStatus(IntEnum):
    """Of an epoch, against an alarm limit."""

    #: The level is within the alarm limit.
    AVAILABLE = 0
    #: The level is above the alarm limit, infinite, or there is no position.
    UNAVAILABLE = 1
    #: The ranges contradict each other: the level does not hold.
    ALARM = 2


def availability(level_m: ArrayLike, alarm_limit_m: float, *, consistent: ArrayLike = True) -> Codes:
    """LevelStatus of epochs.

    Parameters
    ----------
    level_m : array_like, shape (T,) [m]
        Protection level; NaN where there is no position.
    alarm_limit_m : float [m]
    consistent : array_like of bool, shape (T,) or ()
        `ProtectionLevel.consistent`. An epoch with a position and without consistency alarms.

    Returns
    -------
    ndarray of int8, shape (T,)
        `LevelStatus`.
    """
    if not alarm_limit_m > 0.0:
        raise ValueError(f"alarm_limit_m must be positive, got {alarm_limit_m}")
    level = np.asarray(level_m, dtype=np.float64)
    status = np.full(level.shape, LevelStatus.UNAVAILABLE, dtype=np.int8)
    status[level <= alarm_limit_m] = LevelStatus.AVAILABLE
    status[~np.isnan(level) & ~np.asarray(consistent)] = LevelStatus.ALARM
    return status
