"""Select navigation records by satellite and issue of data; SBAS corrections name the issue of data of a record."""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Integers, Strings
from railfix.core.timescale import timedelta
from railfix.gnss.navigation import KeplerRecords, Navigation
from railfix.gnss.orbits.prepared_records import validity_s

_MILLISECOND: Final = np.timedelta64(1, "ms")
_ISSUES: Final = 1024  #: Number of distinct issues of data (Galileo: 10 bits, others: 8 bits).
#: Number of distinct times in a lookup key, in steps of 1 ms: 278 years. Times outside this range are clipped.
_ISSUE_SPAN: Final = np.int64(2**43)
_ORIGIN: Final = np.datetime64("1980-01-06T00:00:00", "ns")


class _Issues:
    """Index of records by satellite and issue.

    Among records of one satellite and issue, the record with the nearest toe is used.

    Of two records with the same toe, the F/NAV record takes precedence over the I/NAV record.
    """

    def __init__(self, kepler: KeplerRecords) -> None:
        row = np.isin(kepler.message, ("LNAV", "INAV", "FNAV", "CNV1")).nonzero()[0]
        issue = kepler.iode[row] % np.where(kepler.message[row] == "LNAV", 256, _ISSUES)
        names, number = np.unique(kepler.satellite[row], return_inverse=True)
        self.number = {str(name): i for i, name in enumerate(names)}
        series = number.astype(np.int64) * _ISSUES + issue
        toe = kepler.toe[row]
        order = np.lexsort((kepler.message[row] == "FNAV", toe, series))
        twice = (series[order][1:] == series[order][:-1]) & (toe[order][1:] == toe[order][:-1])
        order = order[~np.append(twice, np.zeros(min(len(order), 1), dtype=bool))]
        row, toe = row[order], toe[order]
        self.series, self.row = series[order], row.astype(np.int64)
        since = toe.copy()
        same = np.zeros(len(row), dtype=bool)
        same[1:] = self.series[1:] == self.series[:-1]
        since[1:] = np.where(same[1:], toe[:-1] + (toe[1:] - toe[:-1]) // 2, _ORIGIN)
        since[:1] = _ORIGIN
        self.key = self.series * _ISSUE_SPAN + (since - _ORIGIN) // _MILLISECOND
        self.toe, self.limit = kepler.toe, timedelta(validity_s(kepler))


@lru_cache(maxsize=8)
def _index_issues(navigation: Navigation) -> _Issues:
    return _Issues(navigation.kepler)


def issue_records(navigation: Navigation, satellite: Strings, time: Datetimes, issue: Integers) -> Integers:
    """Return the row of `navigation.kepler` with a given issue and the nearest toe, shape (T, M).

    The row is -1 if this record is absent or not valid at the time of reception (`time`, shape (T,)).
    """
    table = _index_issues(navigation)
    number = np.array([table.number.get(str(name), -1) for name in satellite], dtype=np.int64)
    issue = np.where(np.char.startswith(satellite, "E") | (issue < 0), issue, issue % 256)
    series = np.where((issue >= 0) & (number >= 0), number * _ISSUES + issue, -1)
    if not len(table.key):
        return np.full(series.shape, -1, dtype=np.int64)
    key = series * _ISSUE_SPAN + np.clip((time - _ORIGIN) // _MILLISECOND, 0, _ISSUE_SPAN - 1)[:, None]
    at = np.maximum(np.searchsorted(table.key, key, side="right") - 1, 0)
    record = table.row[at]
    usable = (series >= 0) & (table.series[at] == series)
    usable &= np.abs(time[:, None] - table.toe[record]) <= table.limit[record]
    return np.where(usable, record, -1)
