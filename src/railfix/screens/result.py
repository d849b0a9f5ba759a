"""Result of a screen, and the weight of what it suspects."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Masks

#: Sigmas of its own that a suspected range gets added at least: it never keeps more than a fifth of its weight.
_LEAST_SUSPICION: Final = 2.0


@dataclass(frozen=True, kw_only=True)
class Screened:
    """Verdict of one screen, T epochs by M channels.

    Attributes
    ----------
    metric : ndarray, shape (T, M)
        What was measured, in the unit that the screen names; NaN where it cannot judge.
    reject : ndarray of bool, shape (T, M)
        True = rejected. Where the metric is NaN the screen does not reject.
    """

    metric: Floats
    reject: Masks


def suspicion_sigma_m(reject: Masks, size_m: Floats, sigma_m: Floats) -> Floats:
    """Standard deviation of suspected ranges, that of the others unchanged, shape (T, M) [m].

    The error of a suspected range is of the size that the screen measured: that size, two sigmas at least, is added as
    another standard deviation.

    Parameters
    ----------
    reject : ndarray of bool, shape (T, M)
        Ranges that the screen suspects.
    size_m : ndarray, shape (T, M) [m]
        Size of the error that it measured.
    sigma_m : ndarray, shape (T, M) [m]
        Without the suspicion.
    """
    extra = np.maximum(np.abs(np.nan_to_num(size_m)), _LEAST_SUSPICION * sigma_m)
    return np.where(reject, np.hypot(sigma_m, extra), sigma_m)
