"""Elevation mask (P1 table 6: 20 degrees)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from railfix.screens.result import Screened


@dataclass(frozen=True, kw_only=True)
class ElevationLimits:
    """Limits of the elevation mask.

    Attributes
    ----------
    mask_deg : float
        Satellites below are refused; P1 3.3 and table 6 use 20.
    """

    mask_deg: float = 20.0

    def __post_init__(self) -> None:
        if not -90.0 <= self.mask_deg < 90.0:
            raise ValueError(f"mask_deg must lie in [-90, 90), got {self.mask_deg}")


def elevation_screen(elevation_deg: ArrayLike, *, limits: ElevationLimits | None = None) -> Screened:
    """Refuse satellites below the mask.

    Parameters
    ----------
    elevation_deg : array_like, shape (T, M) [deg]
        NaN where unknown: not judged here.
    limits : ElevationLimits, optional

    Returns
    -------
    Screened
        The metric is the elevation [deg].
    """
    limits = limits or ElevationLimits()
    metric = np.asarray(elevation_deg, dtype=np.float64)
    return Screened(metric=metric, reject=metric < limits.mask_deg)
