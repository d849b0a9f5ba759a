"""Fault detection: is the sum of squared residuals what noise explains?

P4 tests ``T = sqrt(WSSE)`` against ``T_D = sigma0 sqrt(T_CS)``, where T_CS leaves the false-alarm
rate to the right of it under the chi-square distribution; the squares of both are compared here.
P1 2.3(4) and table 6 compare the sum of squared residuals in metres with a fixed 100 m^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator
from scipy.special import chdtri

from railfix.core.arrays import Floats, Integers, Masks
from railfix.core.settings import Settings

#: Degrees of freedom are tabulated in steps of this many.
_TABLE_STEP: Final = 64


class RaimLimits(Settings):
    """Limits of detection, exclusion and reliability."""

    mode: Literal["chi_square", "fixed"] = "chi_square"  #: False-alarm rate (P4), or P1's fixed limit.
    #: Probability that noise alone is called a fault; P4: 0.001. An excluded satellite's own error must be over what
    #: noise reaches with this probability (chi-square mode).
    false_alarm: float = Field(default=1e-3, gt=0, lt=1)
    #: Probability of missing a fault of the minimal detectable size. P4 gives no value.
    missed_detection: float = Field(default=1e-3, gt=0, lt=1)
    #: Mode "fixed": limit on the sum of squared residuals, and on the square of an excluded satellite's error; P1 table
    #: 6 ("FDE 2 SAT, 100 m2").
    fixed_limit_m2: float = Field(default=100.0, gt=0)
    #: Satellites excluded at an epoch at most: 0, 1 or 2 (P1 2.3(4): 2).
    max_excluded: int = Field(default=2, ge=0, le=2)
    min_redundancy: int = Field(default=1, ge=1)  #: Degrees of freedom left after an exclusion.
    #: Probability that noise makes the true exclusion fit this much worse than another one. Chi-square, one degree of
    #: freedom. Another exclusion of as many satellites that passes and fits nearly as well makes the epoch inseparable.
    separation_risk: float = Field(default=1e-3, gt=0, le=1)
    #: Exclusions with positions nearer than this do not compete: either way the position is the same (the two
    #: satellites of a clock of their own). 0: they always do.
    same_position_m: float = Field(default=0.0, ge=0)
    #: Two-sided probability that K sigma leaves to noise in the protection level; 1 gives K = 0, which is P4's ``HSlope
    #: sigma0 sqrt(lambda)``.
    noise_risk: float = Field(default=1e-3, gt=0, le=1)
    #: Protection levels above it alarm. P4 takes an error within a car length, 20 m, as acceptable.
    alarm_limit_m: float = Field(default=20.0, gt=0)
    faults: int = Field(default=1, ge=1, le=2)  #: Simultaneous faults that the protection level covers: 1 (P4) or 2.

    @model_validator(mode="after")
    def _rates_below_one(self) -> Self:
        if not self.false_alarm + self.missed_detection < 1.0:
            raise ValueError("false_alarm and missed_detection must add up to less than 1")
        return self

    @cached_property
    def separation(self) -> float:
        """WSSE by which another exclusion must fit worse, in noise variances."""
        return float(chdtri(1, self.separation_risk))

    @cached_property
    def own_error(self) -> float:
        """Square of an excluded satellite's own error over its sigma that noise does not reach."""
        return float(chdtri(1, self.false_alarm))


@dataclass(frozen=True, kw_only=True)
class Detection:
    """Verdict on T epochs."""

    #: WSSE over the noise scale squared; in fixed mode the sum of squared residuals [m^2]. NaN where there is no
    #: position; shape (T,).
    statistic: Floats
    threshold: Floats  #: What it is compared with; NaN where not testable; shape (T,).
    freedom: Integers  #: Degrees of freedom, shape (T,).
    detected: Masks  #: The statistic is at or over the threshold, shape (T,).
    testable: Masks  #: At least one range is redundant, shape (T,).


def detect(
    wsse: ArrayLike,
    residual_m: ArrayLike,
    freedom: ArrayLike,
    *,
    limits: RaimLimits | None = None,
    scale: ArrayLike = 1.0,
) -> Detection:
    """Test the residuals of positions (P4: ``T >= T_D`` accepts that there is a fault).

    Takes what the solvers return, or the attributes of these names of a `LinearModel`.

    Parameters
    ----------
    wsse : array_like, shape (T,)
        Weighted sum of squared residuals; NaN where there is no position.
    residual_m : array_like, shape (T, M) [m]
        Residuals, 0 (or NaN) where not used; asked for in fixed mode only. Those of a `LinearModel`
        allow for the map error, those of a `Constrained` position do not: the same only where the
        map is taken as exact, as in P1 (a sigma of a millimetre).
    freedom : array_like of int, shape (T,)
        Ranges beyond the unknowns: on the line ``ranges.n_used - ranges.n_clocks - 1``, in space - 3.
    limits : RaimLimits, optional
    scale : array_like, shape (T,) or ()
        Noise scale: standard deviation of this receiver's ranges over the sigmas of the weights.
        Not used in fixed mode.
    """
    limits = limits or RaimLimits()
    freedom = np.asarray(freedom, dtype=np.int64)
    if limits.mode == "chi_square":
        statistic = np.asarray(wsse, dtype=np.float64) / np.asarray(scale, dtype=np.float64) ** 2
    else:
        squares = np.nansum(np.asarray(residual_m, dtype=np.float64) ** 2, axis=1)
        statistic = np.where(np.isfinite(wsse), squares, np.nan)
    testable = (freedom >= 1) & np.isfinite(statistic)
    limit = np.where(testable, threshold(freedom, limits=limits), np.nan)
    return Detection(
        statistic=statistic,
        threshold=limit,
        freedom=freedom,
        detected=statistic >= limit,
        testable=testable,
    )


def threshold(freedom: ArrayLike, *, limits: RaimLimits | None = None) -> Floats:
    """Threshold of the statistic by degrees of freedom; NaN below 1.

    P4: false alarm 0.001 and 3 degrees of freedom give T_CS = 16.27, T_D = sqrt(T_CS) = 4.03.

    Parameters
    ----------
    freedom : array_like of int, any shape
    limits : RaimLimits, optional

    Returns
    -------
    ndarray, same shape
    """
    limits = limits or RaimLimits()
    freedom = np.asarray(freedom, dtype=np.int64)
    if limits.mode == "fixed":
        return np.where(freedom >= 1, limits.fixed_limit_m2, np.nan)
    size = int(freedom.max(initial=0)) // _TABLE_STEP + 1
    return np.asarray(_chi_square_table(limits.false_alarm, size * _TABLE_STEP)[np.maximum(freedom, 0)])


@lru_cache(maxsize=64)
def _chi_square_table(false_alarm: float, size: int) -> Floats:
    """Chi-square thresholds of 0 (NaN) to size - 1 degrees of freedom."""
    table = np.full(size, np.nan)
    table[1:] = chdtri(np.arange(1, size), false_alarm)
    table.flags.writeable = False
    return table
