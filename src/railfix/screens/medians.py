"""Medians over the channels of one receiver clock."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from railfix import kernels
from railfix.core.arrays import Floats, Indices, Strings, kernel_array
from railfix.core.constants import CLOCK_GROUP


def clock_medians(values: Floats, satellite: Strings, *, least: int = 0) -> Floats:
    """Return for each channel the median of `values` over all channels of the same receiver clock, shape (T, M).

    The median is NaN where fewer than `least` satellites of the clock have a value.
    """
    return kernels.screens.clock_medians(
        kernel_array(values), *_clocks(satellite.dtype.str, satellite.tobytes()), least
    )


@lru_cache(maxsize=256)
def _clocks(kind: str, satellites: bytes) -> tuple[Indices, Indices]:
    """Return the index of the clock and the index of the satellite of each channel, shape (M,) each."""
    names = np.frombuffer(satellites, dtype=kind).tolist()
    clock, number = (np.unique(of, return_inverse=True)[1] for of in ([CLOCK_GROUP[n[0]] for n in names], names))
    return clock.astype(np.intp), number.astype(np.intp)
