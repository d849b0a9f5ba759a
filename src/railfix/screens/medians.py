"""Medians over the satellites of a receiver clock: what takes the clock out of a screen's metric."""

from __future__ import annotations

import numpy as np

from railfix.core.arrays import Floats, Indices, Masks, Strings
from railfix.core.constants import CLOCK_GROUP


def row_median(values: Floats) -> Floats:
    """Median of each row over what is finite, shape (T, 1); NaN where nothing is."""
    ordered = np.sort(values, axis=1)  # NaN last
    count = np.count_nonzero(~np.isnan(values), axis=1)[:, None]
    if not values.shape[1]:
        return np.full((len(values), 1), np.nan)
    low = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0), axis=1)
    high = np.take_along_axis(ordered, np.minimum(count // 2, values.shape[1] - 1), axis=1)
    return np.asarray(np.where(count > 0, (low + high) / 2.0, np.nan))


def clock_columns(satellite: Strings) -> list[Indices]:
    """Columns of the channels of each receiver clock (`constants.CLOCK_GROUP`)."""
    clock = np.array([CLOCK_GROUP[name[0]] for name in satellite.tolist()], dtype="<U1")
    return [np.flatnonzero(clock == letter) for letter in np.unique(clock)]


def enough_satellites(finite: Masks, satellite: Strings, least: int) -> Masks:
    """Whether each row has at least `least` satellites with a finite channel, shape (T, 1)."""
    names, which = np.unique(satellite, return_inverse=True)
    # small counts are exact as floats, which are multiplied in blocks
    seen = finite.astype(np.float32) @ (which[:, None] == np.arange(len(names))).astype(np.float32) > 0
    return np.asarray(np.count_nonzero(seen, axis=1) >= least)[:, None]
