"""Medians over the satellites of a receiver clock: what takes the clock out of a screen's metric."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from railfix.core.arrays import Floats, Indices, Strings, read_only
from railfix.core.constants import CLOCK_GROUP


def row_median(values: Floats) -> Floats:
    """Median of each row over what is not NaN, shape (T, 1); NaN where nothing is."""
    if not values.shape[1]:
        return np.full((len(values), 1), np.nan)
    alike = np.zeros(values.shape[1], dtype=np.intp)
    return medians_of_clocks(np.ascontiguousarray(values), alike, alike, 0)[:, :1]


def clock_medians(values: Floats, satellite: Strings, *, least: int = 0) -> Floats:
    """Median over the channels of one receiver clock (`constants.CLOCK_GROUP`), at each channel, shape (T, M).

    Parameters
    ----------
    values : ndarray, shape (T, M)
        NaN where there is none.
    satellite : ndarray of str, shape (M,)
    least : int
        NaN where fewer satellites of the clock have a finite value.
    """
    return medians_of_clocks(np.ascontiguousarray(values), *_number(tuple(satellite.tolist())), least)


@lru_cache(maxsize=256)
def _number(satellites: tuple[str, ...]) -> tuple[Indices, Indices]:
    """Receiver clock and satellite of each channel as numbers, shape (M,) each."""
    clock = np.unique([CLOCK_GROUP[name[0]] for name in satellites], return_inverse=True)[1]
    number = np.unique(list(satellites), return_inverse=True)[1]
    return read_only(clock.astype(np.intp)), read_only(number.astype(np.intp))


def medians_of_clocks(values: Floats, clock: Indices, satellite: Indices, least: int) -> Floats:
    """Compute `clock_medians`; clocks and satellites as numbers from 0 on, arrays in C order."""
    result = np.full(values.shape, np.nan)
    for one in range(int(clock.max(initial=-1)) + 1):
        columns = np.flatnonzero(clock == one)
        part = values[:, columns]
        ordered = np.sort(part, axis=1)  # NaN last
        count = np.count_nonzero(~np.isnan(part), axis=1)[:, None]
        low = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0), axis=1)
        high = np.take_along_axis(ordered, np.minimum(count // 2, len(columns) - 1), axis=1)
        enough = count > 0
        if least:
            # small counts are exact as floats, which are multiplied in blocks
            member = (satellite[columns, None] == np.unique(satellite[columns])).astype(np.float32)
            seen = np.isfinite(part).astype(np.float32) @ member > 0
            enough = enough & (np.count_nonzero(seen, axis=1)[:, None] >= least)
        result[:, columns] = np.where(enough, (low + high) / 2.0, np.nan)
    return result
