"""Two-way ranges to ground units, and speeds of a Doppler radar (P2 3): formulas and rejection of echoes."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats, Masks
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.settings import Settings


def two_way_range_m(delay_s: Floats, answer_s: float) -> Floats:
    """Return the range by the delay of an answer: ``r = (dt_A - dt_B) c / 2`` (P2 3.3, equation 1)."""
    return np.asarray((delay_s - answer_s) * SPEED_OF_LIGHT / 2.0)


def radar_speed_mps(shift_hz: Floats, carrier_hz: float, angle_rad: float) -> Floats:
    """Return the speed by a Doppler shift: ``v = c f_d / (2 f_0 cos(alpha))`` (P2 3.1, figure 9)."""
    return np.asarray(SPEED_OF_LIGHT * shift_hz / (2.0 * carrier_hz * np.cos(angle_rad)))


def along_m(range_m: Floats, lateral_m: float, height_m: float) -> Floats:
    """Return the distance along a straight track to a unit beside it: ``r^2 = ds^2 + dy^2 + dh^2``; NaN below."""
    square = range_m**2 - lateral_m**2 - height_m**2
    return np.sqrt(np.where(square >= 0.0, square, np.nan))


def along_sigma_m(range_m: Floats, along: Floats, sigma_m: float) -> Floats:
    """Return the standard deviation of that distance: ``r / ds dr``, infinite abeam."""
    with np.errstate(divide="ignore"):
        return np.asarray(sigma_m * range_m / np.abs(along))


class EchoLimits(Settings):
    """Gate of ranges against the predicted one.

    Attributes
    ----------
    sigma_m : float
        Of a range: 0.19 m on a straight, 0.24 m in a curve (P2 3.3).
    late_m : float
        Least width of the gate toward long ranges: echoes are late, and separate from 0.3 m on (P2, table 3).
    early_sigmas, late_sigmas : float
    start_of, start_within : int
        So many of the last ranges must agree before any is accepted.
    still_mps : float
        Slower than this nothing is acquired: standing, an echo stays.
    """

    sigma_m: float = Field(default=0.24, gt=0)
    late_m: float = Field(default=0.6, gt=0)
    early_sigmas: float = Field(default=3.0, gt=0)
    late_sigmas: float = Field(default=3.0, gt=0)
    start_of: int = Field(default=3, ge=2)
    start_within: int = Field(default=5, ge=2)
    still_mps: float = Field(default=0.3, ge=0)


@dataclass(frozen=True, kw_only=True)
class EchoResult:
    """Verdicts on N ranges to one unit.

    Attributes
    ----------
    accepted : ndarray of bool, shape (N,)
    residual_m : ndarray, shape (N,) [m]
        Range less predicted; NaN before the start.
    """

    accepted: Masks
    residual_m: Floats


#: Share of an accepted residual that the prediction follows.
_FOLLOW: Final = 0.2


def reject_echoes(
    range_m: Floats, predicted_m: Floats, speed_mps: Floats, *, limits: EchoLimits | None = None
) -> EchoResult:
    """Return which ranges are direct ones, each from itself and earlier ones.

    Parameters
    ----------
    range_m : ndarray, shape (N,) [m]
        To one unit, in order of time; NaN without an answer.
    predicted_m : ndarray, shape (N,) [m]
        By the motion since some earlier instant, up to a constant: the offset is found from consistent ranges.
    speed_mps : ndarray, shape (N,) [m/s]
    limits : EchoLimits, optional
    """
    limits = limits or EchoLimits()
    size = len(range_m)
    accepted, residual = np.zeros(size, dtype=np.bool_), np.full(size, np.nan)
    early, late = -limits.early_sigmas * limits.sigma_m, max(limits.late_sigmas * limits.sigma_m, limits.late_m)
    offset: float | None = None
    recent: deque[float] = deque(maxlen=limits.start_within)
    for k in range(size):
        difference = float(range_m[k] - predicted_m[k])
        if difference != difference:
            continue
        if offset is None:
            if abs(speed_mps[k]) < limits.still_mps:
                continue
            recent.append(difference)
            near = sorted(recent)
            # Echoes are late: the earliest ranges that agree are the direct ones.
            for first in range(len(near) - limits.start_of + 1):
                group = near[first : first + limits.start_of]
                if group[-1] - group[0] <= 2.0 * limits.early_sigmas * limits.sigma_m:
                    offset = float(np.mean(group))
                    break
            continue
        residual[k] = difference - offset
        accepted[k] = early <= residual[k] <= late
        if accepted[k] and abs(speed_mps[k]) >= limits.still_mps:
            offset += _FOLLOW * float(residual[k])
    return EchoResult(accepted=accepted, residual_m=residual)
