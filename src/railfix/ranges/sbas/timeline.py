"""Which row of a series was the newest at an instant, for all series and instants by one search."""

from __future__ import annotations

from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Integers

#: Longest time that is told apart [ms]: 278 years, all that `datetime64[ns]` reaches.
_SPAN: Final = np.int64(2**43)
_ORIGIN: Final = np.datetime64("1980-01-06T00:00:00", "ns")
_MS: Final = np.int64(1_000_000)


def series_order(series: Integers, time: Datetimes) -> Integers:
    """Order of rows by series, then time, then as they came."""
    return np.lexsort((time, series)).astype(np.int64)


class Timeline:
    """Rows sorted by series and time of reception.

    Parameters
    ----------
    series : ndarray of int, shape (n,)
        Number of the series, not negative, rising.
    time : ndarray of datetime64[ns], shape (n,)
        Rising in a series.

    Notes
    -----
    Times are told apart to the millisecond, a row's rounded up and an instant's rounded down: no
    row is found before it was received.
    """

    def __init__(self, series: Integers, time: Datetimes) -> None:
        self._series = series
        ahead = -((_ORIGIN - time.astype("datetime64[ns]")).astype(np.int64) // _MS)
        self._key = series * _SPAN + np.clip(ahead, 0, _SPAN - 1)

    def newest(self, series: Integers, time: Datetimes) -> Integers:
        """Newest row of each series at or before each instant; -1 where there is none.

        Parameters
        ----------
        series : ndarray of int
            -1 for none.
        time : ndarray of datetime64[ns]
            Broadcasts against `series`.
        """
        since = (time - _ORIGIN).astype("timedelta64[ns]").astype(np.int64) // _MS
        wanted_series, wanted_time = np.broadcast_arrays(series, np.clip(since, 0, _SPAN - 1))
        if not len(self._key):
            return np.full(wanted_series.shape, -1, dtype=np.int64)
        at = np.searchsorted(self._key, wanted_series * _SPAN + wanted_time, side="right") - 1
        found = (at >= 0) & (wanted_series >= 0) & (self._series[np.maximum(at, 0)] == wanted_series)
        return np.where(found, at, -1).astype(np.int64)
