"""Availability: comparison of protection levels with an alarm limit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from railfix.core.arrays import Codes
from railfix.integrity.protection.solution_separation import LevelStatus


def availability(level_m: ArrayLike, alarm_limit_m: float, *, consistent: ArrayLike = True) -> Codes:
    """Return the `LevelStatus` of each protection level for an alarm limit (P1 2.4), int8, shape of `level_m`.

    `level_m` is NaN for epochs without a position. `consistent` is `ProtectionLevel.consistent`. The status is ALARM
    for epochs with a position and inconsistent ranges. Raise ValueError if the alarm limit is not positive.
    """
    if not alarm_limit_m > 0.0:
        raise ValueError(f"alarm_limit_m must be positive, got {alarm_limit_m}")
    level = np.asarray(level_m, dtype=np.float64)
    status = np.full(level.shape, LevelStatus.UNAVAILABLE, dtype=np.int8)
    status[level <= alarm_limit_m] = LevelStatus.AVAILABLE
    status[~np.isnan(level) & ~np.asarray(consistent)] = LevelStatus.ALARM
    return status
