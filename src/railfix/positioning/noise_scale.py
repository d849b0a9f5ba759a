"""How noisy is this receiver? The scale of its ranges against the weights, and what one epoch vouches for."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy.special import digamma, ndtri, stdtrit

from railfix.core.arrays import Floats, Integers

#: Half-widths of the 95 % interval, Student's t against the normal distribution, by degrees of freedom from 1.
_WIDENED: Final = stdtrit(np.arange(1, 129), 0.975) / ndtri(0.975)


def noise_scale(
    redundancy: Integers, wsse: Floats, sums: tuple[float, float], *, prior: float
) -> tuple[Floats, tuple[float, float]]:
    """Standard deviation of a receiver's ranges against the weights', from the epochs before each.

    The mean of the logarithm of wsse / degrees of freedom, each weighted by its degrees of freedom,
    less what the logarithm of a chi-square variable is lower by. A logarithm, so that multipath does
    not carry it.

    Parameters
    ----------
    redundancy : ndarray of int, shape (T,)
        Degrees of freedom of each epoch's fit.
    wsse : ndarray, shape (T,)
    sums : tuple of float
        Left by the epochs before: weighted sum of the logarithms, and of the weights.
    prior : float
        Degrees of freedom that a scale of 1 counts for.

    Returns
    -------
    scale : ndarray, shape (T,)
    sums : tuple of float
    """
    freedom = redundancy.astype(np.float64)
    usable = (freedom > 0) & (wsse > 0)
    safe = np.where(usable, freedom, 1.0)
    level = np.log(np.where(usable, wsse, 1.0) / safe) - (digamma(safe / 2) - np.log(safe / 2))
    weight = np.where(usable, freedom, 0.0)
    # cumsum from the carried sums: the same additions in the same order however epochs are cut.
    total = np.cumsum(np.concatenate([[sums[0]], weight * level]))
    weights = np.cumsum(np.concatenate([[sums[1]], weight]))
    scale = np.exp(0.5 * total[:-1] / (weights[:-1] + prior))
    return scale, (float(total[-1]), float(weights[-1]))


def own_sigma_m(redundancy: Integers, wsse: Floats, sigma_m: Floats, scale: Floats) -> Floats:
    """What the ranges of each epoch vouch for along the line, shape (T,) [m].

    The standard deviation by the weights, times the larger of the receiver's scale and the one that
    the epoch's own residuals show, widened as Student's t is where few ranges are redundant.

    Parameters
    ----------
    redundancy : ndarray of int, shape (T,)
    wsse, sigma_m, scale : ndarray, shape (T,)
    """
    freedom = np.maximum(redundancy, 1)
    shown = np.sqrt(np.maximum(wsse, 0.0) / freedom)
    return np.asarray(sigma_m * np.maximum(scale, shown) * _WIDENED[np.minimum(freedom, len(_WIDENED)) - 1])
