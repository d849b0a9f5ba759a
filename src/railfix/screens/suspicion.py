"""Standard deviations of ranges that a screen suspects."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Masks

#: Minimum assumed error of a suspected range [sigma]. With this minimum, the weight falls to a fifth or less.
LEAST_SUSPICION: Final = 2.0


def suspicion_sigma_m(reject: Masks, error_m: Floats, sigma_m: Floats) -> Floats:
    """Return the standard deviations of ranges, increased for suspected ranges, shape (T, M) [m].

    For a suspected range (`reject`) the result is ``hypot(sigma_m, max(|error_m|, 2 sigma_m))``; `error_m` is the error
    that the screen measured, and NaN counts as zero.
    """
    if not reject.any():
        return sigma_m
    at, result = np.nonzero(reject), sigma_m.copy()
    sigma = sigma_m[at]
    result[at] = np.hypot(sigma, np.fmax(np.abs(error_m[at]), LEAST_SUSPICION * sigma))
    return result
