"""Tables of one GEO's messages by satellite and time of reception, with slots resolved by the PRN mask."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Integers, Masks
from railfix.core.timescale import GPS_EPOCH, seconds
from railfix.ranges.sbas.decode import (
    BLOCK,
    SLOTS,
    Decoded,
    covariance,
    decode,
    fast_corrections,
    has_data,
    long_term,
    prn_masks,
)
from railfix.ranges.sbas.limits import SbasLimits
from railfix.ranges.sbas.messages import SbasMessages
from railfix.ranges.sbas.standard import NOT_MONITORED, OLDEST_S

LONG_AGO: Final = GPS_EPOCH  #: Time before any message.
ALARM: Final = 3  #: IODF that marks an alarm.
#: Longest time that a key can represent [ms]: 278 years, the range of `datetime64[ns]` after the GPS epoch.
_SPAN: Final = np.int64(2**43)
_MS: Final = np.int64(1_000_000)
_OLDEST_MS: Final = np.int64(1000.0 * OLDEST_S)
_NO_SERIES: Final = 2**19  #: Series number of the placeholder row of an empty table; no search returns this row.


@dataclass(frozen=True, kw_only=True)
class Series:
    """Rows of many series (satellites, grid points ...) sorted by series and time of reception.

    An empty table has one row that is never used, so that `columns` can be indexed with -1. Reception times are rounded
    up to the millisecond, and the instants of searches down, so that no row is used before it was received.
    """

    series: Integers  #: Number of the row's series, shape (n,).
    time: Datetimes  #: Time of reception, shape (n,).
    columns: Mapping[str, NDArray[Any]]  #: Decoded values by name, shape (n, ...).
    key: Integers  #: Series and time of reception in one number, in ascending order; shape (n,).

    @classmethod
    def of(cls, series: Integers, time: Datetimes, columns: Mapping[str, NDArray[Any]]) -> Series:
        """Sort rows by series, then time, then original order; rows of series below 0 are left out."""
        order = np.lexsort((time, series)).astype(np.int64)
        order = order[series[order] >= 0]
        columns = {name: values[order] for name, values in columns.items()}
        series, time = series[order], time[order].astype("datetime64[ns]")
        if not len(order):
            series, time = np.array([_NO_SERIES], dtype=np.int64), np.array([LONG_AGO])
            columns = {name: np.zeros((1, *values.shape[1:]), dtype=values.dtype) for name, values in columns.items()}
        ahead = -((GPS_EPOCH - time).astype(np.int64) // _MS)
        return cls(series=series, time=time, columns=columns, key=series * _SPAN + np.clip(ahead, 0, _SPAN - 1))

    @property
    def empty(self) -> bool:
        """Whether the table is empty."""
        return bool(self.series[0] == _NO_SERIES)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return the column of a name."""
        return self.columns[name]

    def add_columns(self, **columns: NDArray[Any]) -> Series:
        """Return the same rows with more columns."""
        return replace(self, columns={**self.columns, **columns})

    def newest(self, series: Integers | int, time: Datetimes) -> Integers:
        """Return the newest row of each series at or before each instant; -1 without a row within `OLDEST_S`."""
        since = (time - GPS_EPOCH).astype("timedelta64[ns]").astype(np.int64) // _MS
        wanted_series, wanted_time = np.broadcast_arrays(series, np.clip(since, 0, _SPAN - 1))
        wanted = wanted_series * _SPAN + wanted_time
        at = np.searchsorted(self.key, wanted, side="right") - 1
        known = (at >= 0) & (wanted_series >= 0) & (wanted - self.key[np.maximum(at, 0)] <= _OLDEST_MS)
        return np.where(known, at, -1).astype(np.int64)

    def received(self, row: Integers) -> Datetimes:
        """Return the time of reception of rows; `LONG_AGO` for row -1."""
        return np.where(row >= 0, self.time[row], LONG_AGO)

    def in_force(self, row: Integers, time: Datetimes, stop: Datetimes, limit_s: float) -> Masks:
        """Return True for rows received after the last stop of the GEO and at most `limit_s` ago; False for row -1."""
        received = self.received(row)
        return np.asarray((row >= 0) & (received > stop) & (seconds(time - received) <= limit_s))


class Stops:
    """Times at which a message of type 0 stopped the use of the GEO."""

    def __init__(self, messages: SbasMessages, limits: SbasLimits) -> None:
        stops = messages.type == 0
        if limits.type0 == "as_type2":
            stops &= ~has_data(messages.bits)
        self.time = messages.time[stops]

    def last(self, time: Datetimes) -> Datetimes:
        """Return the newest stop at or before instants; `LONG_AGO` where there was none."""
        if not len(self.time):
            return np.full(np.shape(time), LONG_AGO)
        at = np.searchsorted(self.time, time, side="right") - 1
        return np.where(at >= 0, self.time[np.maximum(at, 0)], LONG_AGO)


class MaskTable:
    """PRN masks (type 1), which assign a satellite to each slot of the messages with the same IODP."""

    def __init__(self, messages: SbasMessages, limits: SbasLimits, stops: Stops) -> None:
        masks = prn_masks(messages)
        time = messages.time[masks["row"]]
        member = np.zeros((len(time), 256), dtype=bool)
        np.put_along_axis(member, masks["number"], True, axis=1)
        member[:, 0] = False
        self.by_issue = Series.of(masks["iodp"], time, {"number": masks["number"]})
        self._by_time = Series.of(np.zeros(len(time), dtype=np.int64), time, {"member": member})
        self._limit = limits.timeout_s("mask")
        self._stops = stops

    def resolve(self, iodp: Integers, slot: Integers, time: Datetimes) -> Integers:
        """Return the mask numbers of slots of messages; 0 for an empty slot, -1 without an active mask."""
        mask = self.by_issue.newest(iodp, time)
        return np.where(self._in_force(self.by_issue, mask, time), self.by_issue["number"][mask, slot], -1)

    def active(self, iodp: Integers, time: Datetimes) -> Masks:
        """Return whether a mask of an issue is known and not timed out."""
        return self._in_force(self.by_issue, self.by_issue.newest(iodp, time), time)

    def _in_force(self, table: Series, row: Integers, time: Datetimes) -> Masks:
        return table.in_force(row, time, self._stops.last(time), self._limit)

    def holds(self, number: Integers, time: Datetimes) -> tuple[Masks, Masks]:
        """Return whether a PRN mask is in force at each epoch (T,), and whether this mask has each satellite (T, K)."""
        row = self._by_time.newest(0, time)
        known = self._in_force(self._by_time, row, time)
        return known, self._by_time["member"][row][:, np.maximum(number, 0)] & known[:, None]

    def current(self, slot: Integers, time: Datetimes) -> Integers:
        """Return the mask numbers of slots in the newest mask (for messages without an IODP); -1 without a mask."""
        rows = self.by_issue.newest(np.arange(4)[None, :], time[:, None])
        issue = np.argmax(self.by_issue.received(rows), axis=1)
        best = np.take_along_axis(rows, issue[:, None], axis=1)[:, 0]
        return np.where(self.active(issue, time) & (best >= 0), self.by_issue["number"][best, slot], -1)


class SatelliteTables:
    """Tables of all messages of one GEO that concern satellites, by PRN mask number.

    `fast` has fast corrections; its column `fresh` is the index of the satellite's first row after its latest earlier
    unmonitored row. `udre` has the UDREI from fast corrections and type 6; `grows_from` is the reception time from
    which degradation and time-out are counted. `fast_degradation` has type 7; `shortest` is the indicator with the
    shortest time-out in the same message. `long_term` has long-term corrections; its column `other` is the index of the
    satellite's latest earlier row with a different IODE, -1 if there is none. `covariance` has type 28, `degradation`
    type 10. `unused` counts corrections without a matching mask or fast correction.
    """

    def __init__(self, messages: SbasMessages, limits: SbasLimits) -> None:
        self.unused: Counter[str] = Counter()
        self.stops = Stops(messages, limits)
        self.masks = MaskTable(messages, limits, self.stops)
        fast = fast_corrections(messages, type0=limits.type0)
        self.fast = _with_fresh(self._by_satellite("fast corrections", messages, fast))
        self.udre = self._udre(messages)
        self.fast_degradation = self._fast_degradation(messages)
        self.long_term = _with_other(self._by_satellite("long-term corrections", messages, long_term(messages)))
        self.covariance = self._by_satellite("covariances", messages, covariance(messages))
        self.covariance_time: Datetimes = np.sort(self.covariance.time[: 0 if self.covariance.empty else None])
        ten = decode(messages, 10)
        row = ten.pop("row")
        self.degradation = Series.of(np.zeros(len(row), dtype=np.int64), messages.time[row], ten)

    def _by_satellite(self, kind: str, messages: SbasMessages, decoded: Decoded) -> Series:
        """Return the rows of satellites in an active mask; count the rows without a mask of their issue."""
        time = messages.time[decoded["row"]]
        number = self.masks.resolve(decoded["iodp"], decoded["slot"], time)
        self.unused[f"{kind} without a mask of their IODP"] += int((number < 0).sum())
        return Series.of(np.where(number > 0, number, -1), time, decoded)

    def _udre(self, messages: SbasMessages) -> Series:
        """Return the UDREI from fast corrections and from type 6.

        Type 6 updates the UDREI of the corrections with the same IODF; an alarm updates the UDREI of all corrections.
        """
        fast, six = self.fast, decode(messages, 6)
        time = np.repeat(messages.time[six["row"]], SLOTS)
        number = self.masks.current(np.tile(np.arange(SLOTS), len(six["row"])), time)
        row = fast.newest(number, time)
        iodf = np.repeat(six["iodf"], BLOCK, axis=1)[:, :SLOTS].ravel()
        fits = (row >= 0) & (number > 0) & ((iodf == ALARM) | (iodf == fast["iodf"][row]))
        self.unused["UDREI of type 6 without a fast correction of the same IODF"] += int((~fits & (number > 0)).sum())
        time, row, alarm = time[fits], row[fits], iodf[fits] == ALARM
        renewed = np.where(alarm, fast.time[row], time)
        return Series.of(
            np.concatenate([fast.series, number[fits]]),
            np.concatenate([fast.time, time]),
            {
                "udrei": np.concatenate([fast["udrei"], six["udrei"].ravel()[fits]]),
                "grows_from": np.concatenate([fast.time, renewed]),
            },
        )

    def _fast_degradation(self, messages: SbasMessages) -> Series:
        """Return the rows of type 7, one per satellite."""
        seven = decode(messages, 7)
        count = len(seven["row"])
        rows = {name: np.repeat(seven[name], SLOTS) for name in ("row", "iodp", "latency_s")}
        time = messages.time[rows["row"]]
        number = self.masks.resolve(rows["iodp"], np.tile(np.arange(SLOTS), count), time)
        self.unused["degradation factors without a mask of their IODP"] += int((number < 0).sum())
        # The largest indicator has the smallest time-out.
        used = np.where(number > 0, seven["indicator"].ravel(), -1).reshape(count, SLOTS)
        return Series.of(
            np.where(number > 0, number, -1),
            time,
            {
                "indicator": seven["indicator"].ravel(),
                "latency_s": rows["latency_s"],
                "shortest": np.repeat(used.max(axis=1, initial=-1), SLOTS),
            },
        )


def _with_fresh(fast: Series) -> Series:
    """Add the column `fresh`: the index of the first row after the satellite's latest earlier unmonitored row."""
    begins = np.ones(len(fast.series), dtype=bool)
    begins[1:] = (fast.series[1:] != fast.series[:-1]) | (fast["udrei"][:-1] >= NOT_MONITORED)
    return fast.add_columns(fresh=np.maximum.accumulate(np.where(begins, np.arange(len(begins)), 0)))


def _with_other(table: Series) -> Series:
    """Add the column `other`: index of the satellite's latest earlier row with a different IODE, -1 for none."""
    number, iode = table.series, table["iode"]
    changed = np.ones(len(number), dtype=bool)
    changed[1:] = (number[1:] != number[:-1]) | (iode[1:] != iode[:-1])
    run = np.maximum.accumulate(np.where(changed, np.arange(len(number)), 0))
    same = (run > 0) & (number[run - 1] == number)
    return table.add_columns(other=np.where(same, run - 1, -1))
