"""What every screen returns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


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

    metric: NDArray[np.float64]
    reject: NDArray[np.bool_]
