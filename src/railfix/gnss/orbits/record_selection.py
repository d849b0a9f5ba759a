"""Selection of the navigation record of a satellite at an epoch.

The newest record transmitted before the epoch is selected. A record without a transmission time
counts as transmitted half-way between the reference times of the record before it and its own. Where
the newest record is outside its validity (expired while an older one is still valid, or transmitted
long before its validity begins), or where all records were transmitted after the epoch (a file that
begins later than the log), the record with the nearest reference time is selected if it is valid,
and flagged if it had not been transmitted yet. Health is that of the selected record: an older
healthy record does not override it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, Strings
from railfix.core.timescale import timedelta
from railfix.gnss.navigation import KeplerRecords, Navigation

#: Longest distance of an epoch from toe [s]: GPS and QZSS half the broadcast fit interval and
#: never less than this (IS-GPS-200, 20.3.4.4; QZSS broadcasts 2 h records every hour);
#: Galileo 4 h (Galileo OS SDD 1.3, 2.4.2: no data older than that are broadcast). BeiDou (renewed
#: every hour) and GLONASS (renewed every 30 min) broadcast none: the limits are those of RTKLIB 2.4.3
#: (MAXDTOE_CMP, MAXDTOE_GLO of rtklib.h).
VALIDITY_S: Final[Mapping[str, float]] = {"G": 7200.0, "J": 7200.0, "E": 14_400.0, "C": 21_600.0, "R": 1800.0}

#: A record transmitted earlier than this before its validity begins has a wrong transmission time [s].
_EARLY_S: Final = 3600.0
#: Time span that a lookup key can hold [ms]: 34 years, so that records of another year are kept apart.
_SPAN: Final = np.int64(2**40)
_MILLISECOND: Final = np.timedelta64(1, "ms")


@dataclass(frozen=True)
class Lookup:
    """Records of all satellites in two sorted lists, each searched by bisection."""

    number: Mapping[str, int]  #: Number of a satellite (or of its message: "E01 INAV") in the lists.
    first: Integers  #: First record of each satellite in both lists, shape (satellites,).
    #: Satellite and time of availability [ms since `origin`] as one ascending number, and the row of the record table;
    #: shape (n,).
    sent_key: Integers
    sent_record: Integers
    #: The same by reference time: from half-way between the reference time before and its own; shape (n,).
    toe_key: Integers
    toe_record: Integers

    origin: np.datetime64
    #: Reference time, and time from which the record is available, by row of the record table; shape (n,).
    toe: Datetimes
    available: Datetimes

    def find(self, number: Integers, time: Datetimes, limit: NDArray[np.timedelta64]) -> tuple[Integers, Masks, Masks]:
        """Select the record of each satellite at each epoch, shapes (M, T): row of the table, in its validity, not yet
        sent.

        `number`, shape (M,), are values of the lookup's; -1 for a satellite without records. `limit` is the longest
        distance of an epoch from toe, by row of the record table.
        """
        shape = (len(number), len(time))
        if not len(self.sent_key):
            return np.full(shape, -1, dtype=np.int64), np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        base = np.maximum(number, 0)
        key = base[:, None] * _SPAN + np.clip((time - self.origin) // _MILLISECOND, 0, _SPAN - 1)
        position = np.searchsorted(self.sent_key, key, side="right") - 1
        future = position < self.first[base][:, None]
        record = self.sent_record[np.maximum(position, 0)]
        valid = (np.abs(time - self.toe[record]) <= limit[record]) & ~future
        if not valid.all():
            m, t = np.nonzero(~valid)
            nearest = self.toe_record[np.searchsorted(self.toe_key, key[m, t], side="right") - 1]
            nearest_valid = np.abs(time[t] - self.toe[nearest]) <= limit[nearest]
            replaced = nearest_valid | future[m, t]
            record[m, t] = np.where(replaced, nearest, record[m, t])
            valid[m, t] = nearest_valid
            future[m, t] = replaced & (self.available[nearest] > time[t])
        absent = number < 0
        if absent.any():
            record[absent], valid[absent], future[absent] = -1, False, False
        return record, valid, future


def make_lookup(label: Strings, toe: Datetimes, transmitted: Datetimes, validity_s: Floats) -> Lookup:
    """Sort the records of a table by label (satellite, or satellite and message) for `Lookup.find`."""
    empty = np.empty(0, dtype=np.int64)
    if not len(label):
        return Lookup({}, empty, empty, empty, empty, empty, np.datetime64(0, "ns"), toe, toe)
    names, number = np.unique(label, return_inverse=True)
    number = number.astype(np.int64)
    order = np.lexsort((toe, number))
    toe, transmitted, number = toe[order], transmitted[order], number[order]
    middle = toe.copy()
    middle[1:] = toe[:-1] + (toe[1:] - toe[:-1]) // 2
    known = ~np.isnat(transmitted) & (np.abs(transmitted - toe) <= timedelta(validity_s[order] + _EARLY_S))
    first = np.searchsorted(number, np.arange(len(names)))
    earliest = toe[first] - timedelta(validity_s[order][first] + _EARLY_S)
    middle[first] = earliest
    available = np.where(known, transmitted, middle)
    origin: np.datetime64 = np.minimum(available.min(), earliest.min()) - np.timedelta64(1, "s")
    sent = number * _SPAN + (available - origin) // _MILLISECOND
    resort = np.argsort(sent, kind="stable")
    by_row = np.argsort(order)
    middle[first] = origin
    return Lookup(
        number={str(name): i for i, name in enumerate(names)},
        first=first,
        sent_key=sent[resort],
        sent_record=order[resort].astype(np.int64),
        toe_key=number * _SPAN + (middle - origin) // _MILLISECOND,
        toe_record=order.astype(np.int64),
        origin=origin,
        toe=toe[by_row],
        available=available[by_row],
    )


def validity_s(records: KeplerRecords) -> Floats:
    """Compute the longest distance of an epoch from toe for each record, shape (n,) [s]."""
    base = np.array([VALIDITY_S[s[0]] for s in records.satellite.tolist()], dtype=np.float64)
    return np.fmax(base, records.fit_interval_h * 1800.0)


_ISSUES: Final = 1024  #: Number of different issues of data: 10 bits of Galileo; GPS and QZSS have 8.
#: Time span that a lookup key can hold [ms]: 278 years.
_ISSUE_SPAN: Final = np.int64(2**43)
_ORIGIN: Final = np.datetime64("1980-01-06T00:00:00", "ns")
_MS: Final = np.timedelta64(1, "ms")


class _Issues:
    """Records by satellite and issue, each from half-way between the toe before and its own; F/NAV before I/NAV."""

    def __init__(self, navigation: Navigation) -> None:
        kepler = navigation.kepler
        row = np.flatnonzero(np.isin(kepler.message, ("LNAV", "INAV", "FNAV")))
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
        self.key = self.series * _ISSUE_SPAN + (since - _ORIGIN) // _MS
        self.toe, self.limit = kepler.toe, timedelta(validity_s(kepler))


@lru_cache(maxsize=8)
def _issues_of(navigation: Navigation) -> _Issues:
    return _Issues(navigation)


def issue_records(navigation: Navigation, satellite: Strings, time: Datetimes, issue: Integers) -> Integers:
    """Find the rows of `navigation.kepler` with given issues of data.

    Parameters
    ----------
    satellite : ndarray of str, shape (M,)
    time : ndarray of datetime64[ns], shape (T,)
    issue : ndarray of int, shape (T, M)
        IODE, of Galileo IODnav; -1 for none. Of 10 bits for GPS and QZSS (IODC) the lower 8 count.

    Returns
    -------
    ndarray of int, shape (T, M)
        The record of that issue whose reference time is nearest, if the epoch lies in its
        validity; -1 elsewhere, and for satellites other than GPS, QZSS and Galileo. The record may
        have been transmitted after the epoch: see `SatelliteStates.future_record`.
    """
    table = _issues_of(navigation)
    number = np.array([table.number.get(str(name), -1) for name in satellite], dtype=np.int64)
    issue = np.where(np.char.startswith(satellite, "E") | (issue < 0), issue, issue % 256)
    series = np.where((issue >= 0) & (number >= 0), number * _ISSUES + issue, -1)
    if not len(table.key):
        return np.full(series.shape, -1, dtype=np.int64)
    key = series * _ISSUE_SPAN + np.clip((time - _ORIGIN) // _MS, 0, _ISSUE_SPAN - 1)[:, None]
    at = np.maximum(np.searchsorted(table.key, key, side="right") - 1, 0)
    record = table.row[at]
    usable = (series >= 0) & (table.series[at] == series)
    usable &= np.abs(time[:, None] - table.toe[record]) <= table.limit[record]
    return np.where(usable, record, -1)
