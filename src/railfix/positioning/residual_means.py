"""Means of the residuals of each satellite over a minute: limits and state of `railfix.pipeline.lasting_errors`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydantic import Field

from railfix.core.arrays import Floats, Strings
from railfix.core.settings import Settings


class LastingErrorLimits(Settings):
    """When a satellite is wrong for long.

    Attributes
    ----------
    memory_s : float [s]
        Time constant of the mean of the residuals: a minute, as reflections on a train that moves last less.
    clipped : float
        Standard deviations that a residual counts with at most: those of the weights, or of the receiver's noise where
        that is larger.
    share : float
        Mean from which on a satellite is left out, over `clipped`. On recordings in cities without a fault the
        largest is 0.59, but for satellites seen by reflection alone; 20 m on one satellite reach it after 75 to 115 s.
    most_satellites : int
        Satellites left out at a time; 0: none.
    """

    memory_s: float = Field(default=60.0, gt=0)
    clipped: float = Field(default=2.0, gt=0)
    share: float = Field(default=0.62, gt=0, le=1)
    most_satellites: int = Field(default=2, ge=0, le=4)


@dataclass(frozen=True, kw_only=True)
class LastingErrorState:
    """Means of the residuals after the last epoch.

    Attributes
    ----------
    time : datetime64[ns]
    age : float [windows]
    channel : ndarray of str, shape (S,)
        Satellite and signal.
    noise : ndarray, shape (2,)
        Sums behind the noise of the ranges, those in error included (`railfix.positioning.noise_scale.NoiseState`).
    sums : ndarray, shape (S, P)
        By turn: of the residuals of all ranges, then of those without the worst satellite, and so on.
    """

    time: np.datetime64 = field(default_factory=lambda: np.datetime64("NaT", "ns"))
    age: float = 0.0
    channel: Strings = field(default_factory=lambda: np.empty(0, dtype="<U6"))
    noise: Floats = field(default_factory=lambda: np.zeros(2))
    sums: Floats = field(default_factory=lambda: np.empty((0, 0)))
