"""Positions of the two antennas against their spacing along the track (P1 2.3(5), table 6: 5 m).

The two positions come from different receivers and antennas, so that their distance is a check on
both. Where it does not fit, one of them is wrong, which one is not known, and both are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from railfix.screens.result import Screened


@dataclass(frozen=True, kw_only=True)
class AntennaSpacingLimits:
    """Limits of the check of two positions.

    Attributes
    ----------
    limit_m : float [m]
        Largest difference from the spacing; P1 table 6: 5.
    """

    limit_m: float = 5.0

    def __post_init__(self) -> None:
        if not 0.0 < self.limit_m < np.inf:
            raise ValueError(f"limit_m must be positive and finite, got {self.limit_m}")


def antenna_spacing_screen(
    chainage_front_m: ArrayLike,
    chainage_rear_m: ArrayLike,
    spacing_m: ArrayLike,
    *,
    facing: ArrayLike = 1,
    limits: AntennaSpacingLimits | None = None,
) -> Screened:
    """Refuse pairs of positions that are not as far apart along the track as the antennas.

    Parameters
    ----------
    chainage_front_m, chainage_rear_m : array_like, shape (P,) [m]
        Of the same instants, counted along one line; NaN where there is no position: not judged.
    spacing_m : array_like, shape (P,) or scalar [m]
        Front less rear along the track as the chainages count it, not negative: the antennas' distance
        where each chainage is the one abeam its antenna, 0 where both are that of one reference point.
    facing : array_like of int, shape (P,) or scalar
        1 where the vehicle's front looks to rising chainage, -1 to falling, 0 where that is unknown:
        then the order of the two is not judged.
    limits : AntennaSpacingLimits, optional

    Returns
    -------
    Screened
        Shapes (P,). The metric is ``facing (front - rear) - spacing`` [m], positive where they are too
        far apart; ``|front - rear| - spacing`` where facing is 0. Refused are both positions.
    """
    limits = limits or AntennaSpacingLimits()
    apart = np.asarray(chainage_front_m, dtype=np.float64) - np.asarray(chainage_rear_m, dtype=np.float64)
    spacing, sign = np.asarray(spacing_m, dtype=np.float64), np.asarray(facing)
    if not np.isin(sign, (-1, 0, 1)).all():
        raise ValueError("facing must be 1 (rising chainage), -1 (falling) or 0 (unknown)")
    if (spacing < 0.0).any():
        raise ValueError("spacing_m must not be negative; facing tells which of the two is ahead")
    metric = np.where(sign == 0, np.abs(apart), sign * apart) - spacing
    return Screened(metric=metric, reject=np.abs(metric) > limits.limit_m)
