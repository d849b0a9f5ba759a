"""Reliability: minimal detectable biases, and their effect on the position.

The chi-square test misses a fault of noncentrality lambda with the probability `missed_detection` (P4). For satellite
i, this fault is a range bias of ``sigma_i sqrt(lambda / r_ii)``, because only the fraction r_ii of the squared bias
appears in the statistic. ``slope_i`` is the position change per unit of the statistic's square root. The protection
level is the largest slope times ``sigma0 sqrt(lambda)`` (P4), plus K sigma for the position noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import scipy
from numpy.typing import ArrayLike

from railfix.core.arrays import Floats, Indices, Masks
from railfix.core.constants import LEAST_REDUNDANCY
from railfix.integrity.raim.exclusion import RaimLimits
from railfix.integrity.raim.position_model import LinearModel, compact

#: An effect of a range on the position counts as zero if it is at most this number of position sigmas.
_NO_EFFECT: Final = 1e-6
_BLOCK_SIZE: Final = 40_000  #: Largest number of elements of a block's array of channel pairs.


@dataclass(frozen=True, kw_only=True)
class Reliability:
    """Reliability of the chi-square test at T epochs with M channels."""

    #: Noncentrality lambda of faults missed with the probability `missed_detection`, shape (T,); NaN if untestable.
    noncentrality: Floats
    #: Range error that the test misses with the probability `missed_detection`, shape (T, M); infinite for ranges that
    #: no other range tests, NaN for unused ranges.
    minimal_detectable_bias_m: Floats
    #: Position error per unit of the statistic's square root, shape (T, M); infinite if undetectable, NaN if unused.
    slope_m: Floats
    #: Largest slope for simultaneous errors of two satellites, shape (T,); only if `RaimLimits.faults` is 2, else NaN.
    pair_slope_m: Floats
    worst: Indices  #: Channel with the largest `slope_m`, shape (T,); -1 if all slopes are NaN.
    #: Position standard deviation, shape (T,): along the line, or along the major axis of the horizontal ellipse.
    position_sigma_m: Floats
    #: Position error caused by a fault of noncentrality lambda: largest slope times sqrt(lambda), shape (T,).
    fault_level_m: Floats
    noise_level_m: Floats  #: Noise part of the protection level: K sigma, shape (T,).
    #: Sum of fault and noise level, shape (T,); infinite where a fault is undetectable, NaN without a position.
    protection_level_m: Floats
    available: Masks  #: True where the protection level is finite, shape (T,).
    alarm: Masks  #: True where the protection level exceeds the alarm limit or is NaN, shape (T,).


def reliability(model: LinearModel, *, limits: RaimLimits | None = None, scale: ArrayLike = 1.0) -> Reliability:
    """Compute minimal detectable biases, slopes and protection levels from a model after exclusions.

    The limits of the chi-square test are used even in mode "fixed". `scale`, shape (T,) or (), is the noise scale (see
    `detect`); it does not affect the map error in `position_sigma_m`.
    """
    limits = limits or RaimLimits()
    scale = np.broadcast_to(np.asarray(scale, dtype=np.float64), (len(model),))
    located = np.asarray(np.isfinite(model.covariance_m2).all(axis=(1, 2)))
    sigma = _longest_axis(model.position_covariance_m2(scale))
    root = np.sqrt(noncentrality(model.freedom, limits=limits))
    root[~located] = np.nan
    share = model.redundancy
    checked = share > LEAST_REDUNDANCY
    with np.errstate(divide="ignore"):
        own = np.where(model.used & located[:, None], 1.0 / np.sqrt(np.where(checked, share, 0.0)), np.nan)
    bias = model.sigma_m * (scale * root)[:, None] * own
    slope = _single_slopes(model, share, scale, sigma)
    effective = np.where(np.isnan(slope), -1.0, slope)
    largest = effective.max(axis=1, initial=-1.0)
    worst = np.where(largest >= 0, np.argmax(effective, axis=1), -1) if slope.shape[1] else np.full(len(model), -1)
    largest = np.where(largest >= 0, largest, np.nan)
    pair = np.full(len(model), np.nan)
    if limits.faults == 2:
        pair = _pair_slopes(model, scale, sigma)
        largest = np.fmax(largest, pair)
    # without redundancy, a fault of any size is undetected
    fault = np.where(located & (model.freedom < 1), np.inf, largest * root)
    # K: two-sided Gaussian factor on the line; in the plane, Rayleigh factor of the longest axis (an upper bound)
    risk = limits.noise_risk
    noise = sigma * (
        float(-scipy.special.ndtri(risk / 2.0)) if model.interest == 1 else math.sqrt(-2.0 * math.log(risk))
    )
    level = fault + noise
    return Reliability(
        noncentrality=root**2,
        minimal_detectable_bias_m=bias,
        slope_m=slope,
        pair_slope_m=pair,
        worst=np.asarray(worst, dtype=np.intp),
        position_sigma_m=sigma,
        fault_level_m=fault,
        noise_level_m=noise,
        protection_level_m=level,
        available=np.isfinite(level),
        alarm=~(level <= limits.alarm_limit_m),
    )


def noncentrality(freedom: ArrayLike, *, limits: RaimLimits | None = None) -> Floats:
    """Return the noncentrality of a fault that the chi-square test misses with probability `missed_detection` (P4).

    The result has the shape of `freedom` and is NaN below 1 degree of freedom.
    """
    limits = limits or RaimLimits()
    freedom = np.asarray(freedom, dtype=np.int64)
    values, which = np.unique(freedom, return_inverse=True)
    roots = [_noncentrality(int(v), limits.false_alarm, limits.missed_detection) if v >= 1 else np.nan for v in values]
    return np.array(roots, dtype=np.float64)[which].reshape(freedom.shape)


@lru_cache(maxsize=1024)
def _noncentrality(freedom: int, false_alarm: float, missed_detection: float) -> float:
    """Return lambda such that ``P(noncentral chi-square(lambda) < T_CS) = missed_detection``."""
    return float(scipy.special.chndtrinc(scipy.special.chdtri(freedom, false_alarm), freedom, missed_detection))


def _longest_axis(covariance: Floats) -> Floats:
    """Return the square root of the largest eigenvalue of 1 x 1 or 2 x 2 covariances, shape (T,)."""
    if covariance.shape[1] == 1:
        return np.asarray(np.sqrt(covariance[:, 0, 0]))
    return np.asarray(np.sqrt(_largest_eigenvalue(covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1])))


def _largest_eigenvalue(a: Floats, b: Floats, c: Floats) -> Floats:
    """Return the largest eigenvalue of the symmetric matrices ((a, b), (b, c))."""
    return np.asarray((a + c) / 2.0 + np.hypot((a - c) / 2.0, b))


def _single_slopes(model: LinearModel, share: Floats, scale: Floats, sigma: Floats) -> Floats:
    """Return `Reliability.slope_m` for a noise scale; slopes of undetectable errors are infinite."""
    effect = np.sqrt((model.gain_m**2).sum(axis=2))
    checked = share > LEAST_REDUNDANCY
    unchecked = np.where(effect > _NO_EFFECT * sigma[:, None], np.inf, 0.0)
    slope = np.where(checked, effect / np.sqrt(np.where(checked, share, 1.0)), unchecked)
    located = np.isfinite(sigma)[:, None]
    return np.where(model.used & located, scale[:, None] * slope, np.nan)


def _pair_slopes(model: LinearModel, scale: Floats, sigma: Floats) -> Floats:
    """Return the largest slope for errors of two satellites, shape (T,) [m]; NaN for fewer than two used satellites.

    The squared slope of a pair is the maximum of ``|G^T b|^2 / (b^T S_EE b)`` over its errors b. The maximum is the
    largest eigenvalue of ``G^T S_EE^-1 G``, where G are the gains of the pair (2 x k).
    """
    result = np.full(len(model), np.nan)
    rows = np.flatnonzero(np.isfinite(sigma) & (np.count_nonzero(model.used, axis=1) >= 2))
    for block in _blocks(model, rows):
        result[block] = scale[block] * _pair_block(model.take(block), sigma[block])
    return result


def _blocks(model: LinearModel, rows: Indices) -> Iterator[Indices]:
    width = int(np.count_nonzero(model.used[rows], axis=1).max(initial=1))
    size = max(1, _BLOCK_SIZE // (width * width))
    return (rows[first : first + size] for first in range(0, len(rows), size))


def _pair_block(model: LinearModel, sigma: Floats) -> Floats:
    parts = compact(model)
    n = parts.channel.shape[1]
    i, j = np.triu_indices(n, 1)
    share = np.einsum("tii->ti", parts.projector)
    a, b, c = share[:, i], parts.projector[:, i, j], share[:, j]
    product = a * c
    determinant = product - b * b
    both = parts.used[:, i] & parts.used[:, j]
    regular = both & (np.minimum(a, c) > LEAST_REDUNDANCY) & (determinant > LEAST_REDUNDANCY * product)
    first, second = parts.gain_m[:, i], parts.gain_m[:, j]

    # Entries of G^T adj(S_EE) G, to be divided by the determinant.
    def entry(k: int, m: int) -> Floats:
        cross = first[..., k] * second[..., m] + second[..., k] * first[..., m]
        return np.asarray(c * first[..., k] * first[..., m] - b * cross + a * second[..., k] * second[..., m])

    wide = parts.gain_m.shape[2] == 2
    largest = _largest_eigenvalue(entry(0, 0), entry(0, 1), entry(1, 1)) if wide else entry(0, 0)
    squared = np.where(regular, largest / np.where(regular, determinant, 1.0), 0.0)

    # If S_EE is singular, errors proportional to (sqrt c, -+ sqrt a) do not appear in the residuals. If they do not
    # change the position either, the slope of the pair is at most the larger single slope.
    x, y = np.sqrt(np.maximum(c, 0.0)), -np.copysign(np.sqrt(np.maximum(a, 0.0)), b)
    hidden = np.linalg.norm(x[..., None] * first + y[..., None] * second, axis=2)
    blind = both & ~regular & (hidden > _NO_EFFECT * sigma[:, None] * np.hypot(x, y))
    single = np.nanmax(_single_slopes(model, model.redundancy, np.ones(len(model)), sigma), axis=1)
    largest = np.sqrt(np.maximum(squared.max(axis=1), 0.0))
    return np.asarray(np.maximum(np.where(blind.any(axis=1), np.inf, largest), single))
