"""Selection of navigation records by issue of data, for corrections that refer to one issue."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Integers, Strings
from railfix.core.timescale import timedelta
from railfix.gnss.navigation import Navigation
from railfix.gnss.orbits.record_selection import validity_s

#: Number of different issues of data: 8 bits in the records of GPS and QZSS, and in corrections.
_ISSUES: Final = 256
#: Time span that a lookup key can hold [ms]: 278 years.
_SPAN: Final = np.int64(2**43)
_ORIGIN: Final = np.datetime64("1980-01-06T00:00:00", "ns")
_MS: Final = np.timedelta64(1, "ms")


class _Issues:
    """Records of GPS and QZSS by satellite and issue, each from half-way between the toe before and its own."""

    def __init__(self, navigation: Navigation) -> None:
        kepler = navigation.kepler
        row = np.flatnonzero(kepler.message == "LNAV")
        names, number = np.unique(kepler.satellite[row], return_inverse=True)
        self.number = {str(name): i for i, name in enumerate(names)}
        series = number.astype(np.int64) * _ISSUES + kepler.iode[row] % _ISSUES
        toe = kepler.toe[row]
        order = np.lexsort((toe, series))
        self.series, self.row = series[order], row[order].astype(np.int64)
        toe = toe[order]
        since = toe.copy()
        same = np.zeros(len(row), dtype=bool)
        same[1:] = self.series[1:] == self.series[:-1]
        since[1:] = np.where(same[1:], toe[:-1] + (toe[1:] - toe[:-1]) // 2, _ORIGIN)
        since[:1] = _ORIGIN
        self.key = self.series * _SPAN + (since - _ORIGIN) // _MS
        self.toe, self.limit = kepler.toe, timedelta(validity_s(kepler))


@lru_cache(maxsize=8)
def _issues_of(navigation: Navigation) -> _Issues:
    return _Issues(navigation)


def issue_records(navigation: Navigation, satellite: Strings, time: Datetimes, issue: Integers) -> Integers:
    """Find the rows of `navigation.kepler` with given issues of data.

    Parameters
    ----------
    navigation : Navigation
    satellite : ndarray of str, shape (M,)
    time : ndarray of datetime64[ns], shape (T,)
    issue : ndarray of int, shape (T, M)
        IODE, 0 to 255; -1 for none.

    Returns
    -------
    ndarray of int, shape (T, M)
        The record of that issue whose reference time is nearest, if the epoch lies in its
        validity; -1 elsewhere, and for satellites other than GPS and QZSS. The record may
        have been transmitted after the epoch: see `SatelliteStates.future_record`.
    """
    table = _issues_of(navigation)
    number = np.array([table.number.get(str(name), -1) for name in satellite], dtype=np.int64)
    series = np.where((issue >= 0) & (number >= 0), number * _ISSUES + issue, -1)
    if not len(table.key):
        return np.full(series.shape, -1, dtype=np.int64)
    key = series * _SPAN + np.clip((time - _ORIGIN) // _MS, 0, _SPAN - 1)[:, None]
    at = np.maximum(np.searchsorted(table.key, key, side="right") - 1, 0)
    record = table.row[at]
    usable = (series >= 0) & (table.series[at] == series)
    usable &= np.abs(time[:, None] - table.toe[record]) <= table.limit[record]
    return np.where(usable, record, -1)
