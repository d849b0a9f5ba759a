"""Two-way ranges to ground units, and speeds of a Doppler radar (P2 3): formulas, and the gate of the ranges."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.settings import Settings


def two_way_range_m(delay_s: Floats, answer_s: float) -> Floats:
    """Return the range by the delay of an answer: ``r = (dt_A - dt_B) c / 2`` (P2 3.3, equation 1)."""
    return np.asarray((delay_s - answer_s) * SPEED_OF_LIGHT / 2.0)


def radar_speed_mps(shift_hz: Floats, carrier_hz: float, angle_rad: float) -> Floats:
    """Return the speed by a Doppler shift: ``v = c f_d / (2 f_0 cos(alpha))`` (P2 3.1, figure 9)."""
    return np.asarray(SPEED_OF_LIGHT * shift_hz / (2.0 * carrier_hz * np.cos(angle_rad)))


class EchoLimits(Settings):
    """Gate of ranges against the predicted one."""

    #: Least width of the gate toward long ranges: echoes are late, and separate from 0.3 m on (P2, table 3).
    late_m: float = Field(default=0.6, gt=0)
    #: Width of the gate on both sides.
    early_sigmas: float = Field(default=3.0, gt=0)
    late_sigmas: float = Field(default=3.0, gt=0)
