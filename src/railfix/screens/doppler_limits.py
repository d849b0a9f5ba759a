"""How far a pseudorange may change against its Doppler, and how that grows with the interval.

P1 ran at 0.1 s, where 1.5 m were enough (2.3(2)). Over longer intervals three things grow:

- the noise of two codes: a receiver smooths its codes over about a second (its delay lock loop), so
  codes 0.1 s apart share most of their noise and codes a second apart little of it. The part that
  differs is ``sqrt(1 - exp(-dt / correlation_s))``, and the limit grows as it does;
- the change of acceleration: the mean of two Dopplers is exact for a constant acceleration, and
  wrong by ``jerk dt^3 / 12`` otherwise, which differs from satellite to satellite;
- the noise of the Doppler, ``sigma dt``.

The jerk of satellites (below 1e-4 m/s^3) and the ionosphere (below 0.01 m/s) are nothing beside these.

Receivers differ by more than the interval does: the changes of a geodetic receiver have a standard
deviation of 0.1 to 0.2 m at 1 s, those of u-blox receivers in a city 0.7 to 1.2 m, those of a phone
5 m. There are three modes:

"fixed"
    P1's limit, the same for all, widened with the interval.
"receiver"
    `factor` times the scale that the receiver's own changes show (median over the satellites,
    averaged over the epochs so far), never below the fixed limit.
"sigma"
    `factor` times the standard deviation that the caller expects of each code, never below
    `step_m`. With a sigma from C/N0 and elevation this forgives weak satellites most, and these are the
    ones that multipath falsifies: at the same loss of good codes it found a quarter of the bad
    ones that a limit common to the satellites found (urban recordings at 1 Hz).
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from railfix.core.arrays import Floats
from railfix.core.settings import Settings
from railfix.screens.pairs import row_median

#: Median of the absolute value of a unit normal variable.
_MEDIAN_NORMAL: Final = 0.674_489_750_196_081_7
#: Smallest change used for the receiver's scale [m].
_FINEST_M: Final = 1e-3
#: Changes an epoch needs for its scale.
_LEAST_CHANGES: Final = 5


class DopplerLimits(Settings):
    """Limits of the Doppler screen."""

    #: Limit scaled by the receiver's noise, P1's, or by the stated sigmas; see the module.
    mode: Literal["fixed", "receiver", "sigma"] = "receiver"
    #: Largest change against the Doppler up to `short_interval_s`; P1 table 6: 1.5.
    step_m: float = Field(default=1.5, gt=0.0, allow_inf_nan=False)
    #: P1's interval is 0.1 s; twice that, so that one lost epoch changes nothing.
    short_interval_s: float = Field(default=0.2, gt=0.0, allow_inf_nan=False)
    #: Time over which the receiver smooths its codes. 1 s gives 2.9 m at 1 s.
    correlation_s: float = Field(default=1.0, gt=0.0, allow_inf_nan=False)
    #: Largest jerk of the vehicle; trains stay below 1 [m/s^3].
    jerk_mps3: float = Field(default=1.0, ge=0.0, allow_inf_nan=False)
    #: Modes "receiver" and "sigma": standard deviations.
    factor: float = Field(default=5.0, gt=0.0, allow_inf_nan=False)
    #: Mode "sigma": standard deviation of a range rate from the Doppler.
    doppler_sigma_mps: float = Field(default=0.1, ge=0.0, allow_inf_nan=False)
    #: Mode "receiver": weight of the fixed limit in the estimate of the scale, in epochs.
    prior_epochs: float = Field(default=5.0, gt=0.0, allow_inf_nan=False)
    #: Over a longer interval the screen cannot judge.
    longest_interval_s: float = Field(default=2.5, gt=0.0, allow_inf_nan=False)
    #: How long a satellite stays rejected after a jump; 0 rejects only the epochs of the jumps out and back, which is
    #: exactly P1's test.
    hold_s: float = Field(default=2.0, ge=0.0, allow_inf_nan=False)
    least_satellites: int = Field(default=3, ge=3)  #: Satellites of one clock needed to take its step out.
    #: Treatment of a suspected satellite: its sigma grows by the size of the jump
    #: (`railfix.screens.suspicion_sigma_m`), or it is rejected, as in P1. Where few satellites are left, the geometry
    #: without one turns a few metres into a hundred; a weight does not.
    verdict: Literal["weigh", "reject"] = "weigh"


def doppler_limit_m(interval_s: ArrayLike, *, limits: DopplerLimits | None = None) -> Floats:
    """Limit of mode "fixed" at an interval [m]: 1.50 up to 0.2 s, 2.88 at 1 s, 3.94 at 2 s.

    ``step sqrt((1 - exp(-dt / correlation)) / (1 - exp(-short / correlation))) + jerk dt^3 / 12``,
    with dt not below `short_interval_s` in the first term and the second one only above it.
    """
    limits = limits or DopplerLimits()
    interval = np.asarray(interval_s, dtype=np.float64)
    return np.asarray(limits.step_m * _growth(interval, limits) + _jerk_m(interval, limits))


def _growth(interval: Floats, limits: DopplerLimits) -> Floats:
    """Noise of a change against that at the short interval."""
    long = np.expm1(-np.maximum(interval, limits.short_interval_s) / limits.correlation_s)
    return np.asarray(np.sqrt(long / np.expm1(-limits.short_interval_s / limits.correlation_s)))


def _jerk_m(interval: Floats, limits: DopplerLimits) -> Floats:
    return np.where(interval > limits.short_interval_s, limits.jerk_mps3 * interval**3 / 12.0, 0.0)


def expected_limit_m(interval_s: Floats, sigma_m: Floats, *, limits: DopplerLimits) -> Floats:
    """Limit of mode "sigma", shape (T, M) [m].

    Parameters
    ----------
    interval_s : ndarray, shape (T,) [s]
    sigma_m : ndarray, shape (T + 1, M) [m]
        Of the codes, the epoch before the first one included.
    """
    interval = interval_s[:, None]
    fresh = -np.expm1(-interval / limits.correlation_s)
    noise = (sigma_m[1:] ** 2 + sigma_m[:-1] ** 2) * fresh + (limits.doppler_sigma_mps * interval) ** 2
    # a NaN stays one: without its sigma a satellite is not judged
    return np.asarray(np.maximum(limits.step_m, limits.factor * np.sqrt(noise)) + _jerk_m(interval, limits))


def receiver_limit_m(
    interval_s: Floats, metric_m: Floats, sum_log: float, weight: float, *, limits: DopplerLimits
) -> tuple[Floats, float, float]:
    """Limit of mode "receiver", shape (T,) [m], and the sums to go on with.

    Parameters
    ----------
    interval_s : ndarray, shape (T,) [s]
    metric_m : ndarray, shape (T, M) [m]
    sum_log, weight : float
        Sum of the logarithms of the epochs' scales so far, and their number.

    Notes
    -----
    The scale is that of changes at the short interval: what an epoch shows is divided by the growth
    of the noise with the interval. An epoch's own changes count in its scale. Of a dozen satellites the
    scale comes out a tenth to a seventh too small (their own median is taken out, and logarithms are
    averaged, so that an epoch full of multipath does not carry it).
    """
    growth = _growth(interval_s, limits)
    shown = row_median(np.abs(metric_m))[:, 0] / _MEDIAN_NORMAL / growth
    counts = (np.count_nonzero(np.isfinite(metric_m), axis=1) >= _LEAST_CHANGES) & np.isfinite(shown)
    logs = np.where(counts, np.log(np.maximum(np.where(counts, shown, 1.0), _FINEST_M)), 0.0)
    # running sums, one after the other from the carried ones: a cut does not show
    sums = np.cumsum(np.concatenate([[sum_log], logs]))[1:]
    weights = np.cumsum(np.concatenate([[weight], counts]))[1:]
    prior = limits.prior_epochs
    scale = np.exp((sums + prior * np.log(limits.step_m / limits.factor)) / (weights + prior))
    limit = np.maximum(limits.step_m, limits.factor * scale) * growth + _jerk_m(interval_s, limits)
    return limit, float(sums[-1]), float(weights[-1])
