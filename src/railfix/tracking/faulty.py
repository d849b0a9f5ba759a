"""Satellites whose codes are wrong for long: found over a minute, and left out by the filter.

The innovation of a code over its standard deviation has a mean near 0 over a minute, reflections included: they come
and go. A clock record that is wrong, or a reflection that lasts, keeps its sign. The mean of the innovations, each
clipped to a standard deviation, so that single large ones count little, tells one from the other.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks

#: Time constant of the mean [s], what one innovation counts at most, and the mean from which on codes are left out.
MEMORY_S: Final = 60.0
MOST: Final = 1.0
FAULTY: Final = 0.35
#: Factor on the variance of codes that are left out: their innovations go on telling when the fault ends.
INFLATED: Final = 1e6
#: Standard deviation added to the place when a satellite is left out from here on: its codes have led it so far [m].
FREED_M: Final = 15.0
#: Not where all codes ask for another place by more standard deviations (`railfix.tracking.misfit.code_shift`): they
#: may have stepped together.
FREED_SIGMAS: Final = 3.0


def is_faulty(code_bias: Floats, slot: Indices) -> Masks:
    """Return the channels whose codes are left out, shape (K,).

    Parameters
    ----------
    code_bias : ndarray, shape (S,)
        Mean innovation of each satellite in the state.
    slot : ndarray of int, shape (K,)
        Its place among them; -1 for a channel that is never measured.
    """
    return np.asarray((slot >= 0) & (np.abs(code_bias[slot]) > FAULTY)) if len(code_bias) else slot >= 0


def update_bias(
    code_bias: Floats, slot: Indices, innovation_m: Floats, sigma_m: Floats, code_s: float
) -> tuple[Floats, bool]:
    """Take the innovations of an epoch into the means; return them, and whether another satellite is left out now.

    Parameters
    ----------
    code_bias : ndarray, shape (S,)
    slot : ndarray of int, shape (M,)
        Of each code.
    innovation_m, sigma_m : ndarray, shape (M,) [m]
        With the standard deviation of a code's error.
    code_s : float [s]
        Time that the codes represent.
    """
    after = code_bias.copy()
    share = 1.0 - np.exp(-min(code_s, 1.0) / MEMORY_S)
    after[slot] += share * (np.clip(innovation_m / sigma_m, -MOST, MOST) - after[slot])
    return after, bool(((np.abs(after) > FAULTY) & (np.abs(code_bias) <= FAULTY)).any())
