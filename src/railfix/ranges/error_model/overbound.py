"""Gaussian overbounds of samples, with a bias, for both tails.

A normal distribution shifted by +b bounds the upper half of the errors, one shifted by -b the lower
half: whatever probability one asks for, the bound's quantile lies further out than the sample's
(CDF overbounding, B. DeCleene, Defining pseudorange integrity: overbounding, ION GPS 2000). Sums of
independent errors stay bounded by the summed biases and the root of the summed squared sigmas as long
as the distribution after the shift is symmetric and has one peak (the two-step method of J. Blanch, T.
Walter, P. Enge, Gaussian bounds of sample distributions for integrity analysis, IEEE Trans. Aerospace
and Electronic Systems 55(4), 2019, doi:10.1109/TAES.2018.2876583). Neither can be proven from samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import ndtri

from railfix.core.arrays import Floats

#: Standard scores from which on a sample belongs to the tail, which alone sets sigma.
TAIL_SCORE: Final = 1.0


@dataclass(frozen=True, kw_only=True)
class Overbound:
    """Pair of normal distributions that bound a sample, one for each half.

    Attributes
    ----------
    bias_m : float [m]
        Distance of their means from zero, to either side.
    sigma_m : float [m]
    """

    bias_m: float
    sigma_m: float


def gaussian_overbound(error_m: Floats) -> Overbound:
    """The pair that bounds a sample, sigma from the tails and the bias from the middle.

    The k-th of n samples counts as the quantile of probability ``k / (n + 1)``, from either end. Sigma is
    the least that bounds both tails (beyond one standard score) about the median's distance from zero;
    the bias is then the least that bounds the rest. Beyond the largest sample the bound is an
    extrapolation by the normal distribution and nothing else.

    Parameters
    ----------
    error_m : ndarray, shape (n,) [m]
        At least three, finite.

    Returns
    -------
    Overbound

    Raises
    ------
    ValueError
        Fewer than three samples, or one that is not finite.
    """
    if len(error_m) < 3 or not np.isfinite(error_m).all():
        raise ValueError("an overbound needs at least three samples, all finite")
    ordered = np.sort(error_m)
    score = ndtri(np.arange(1, len(ordered) + 1) / (len(ordered) + 1.0))
    half = score >= 0.0
    # Both halves as distances from zero outward: the upper as it is, the lower mirrored.
    score, sizes = score[half], (ordered[half], -ordered[::-1][half])
    center = abs(float(np.median(ordered)))
    tail = score >= min(TAIL_SCORE, float(score[-1]))
    sigma = max(0.0, *(float(np.max((size[tail] - center) / score[tail])) for size in sizes))
    bias = max(center, *(float(np.max(size - sigma * score)) for size in sizes))
    return Overbound(bias_m=bias, sigma_m=sigma)
