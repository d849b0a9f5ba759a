"""Messages of one GEO laid out by satellite: slots resolved by the PRN mask, ready to be searched."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Final

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks
from railfix.core.timescale import seconds
from railfix.ranges.sbas.decode import (
    FastCorrections,
    fast_corrections,
    fast_degradation,
    integrity,
    long_term,
    prn_masks,
)
from railfix.ranges.sbas.decode_service import Degradation, covariance, degradation
from railfix.ranges.sbas.limits import NOT_MONITORED, SbasLimits
from railfix.ranges.sbas.log import SbasLog
from railfix.ranges.sbas.timeline import Timeline, series_order

#: Before every message.
LONG_AGO: Final = np.datetime64("1980-01-06", "ns")
#: IODF that says alarm.
ALARM: Final = 3
_BLOCK: Final = 13


class Stops:
    """When type 0 stopped the GEO."""

    def __init__(self, log: SbasLog, limits: SbasLimits) -> None:
        stops = log.type == 0
        if limits.type0 == "as_type2":
            stops &= ~(np.unpackbits(log.bits, axis=1)[:, 14:226].any(axis=1))
        self.time = log.time[stops]

    def last(self, time: Datetimes) -> Datetimes:
        """Newest stop at or before instants; long ago where there was none."""
        if not len(self.time):
            return np.full(np.shape(time), LONG_AGO)
        at = np.searchsorted(self.time, time, side="right") - 1
        return np.where(at >= 0, self.time[np.maximum(at, 0)], LONG_AGO)


class MaskTable:
    """Types 1: which satellite a slot was when a message with an IODP came."""

    def __init__(self, log: SbasLog, limits: SbasLimits, stops: Stops) -> None:
        masks = prn_masks(log)
        time = log.time[masks.row]
        order = series_order(masks.iodp, time)
        self.number, self.time = masks.number[order], time[order]
        self._by_issue = Timeline(masks.iodp[order], self.time)
        self._by_time = Timeline(np.zeros(len(time), dtype=np.int64), time)
        self._time_in_time = time
        member = np.zeros((len(time), 256), dtype=bool)
        np.put_along_axis(member, masks.number, True, axis=1)
        member[:, 0] = False
        self._member = member
        self._limit = limits.timeout_s("mask")
        self._stops = stops

    def resolve(self, iodp: Integers, slot: Integers, time: Datetimes) -> tuple[Integers, Integers]:
        """Mask number of slots of messages, 0 where the mask leaves the slot out, -1 without an active mask.

        Returns
        -------
        number, mask : ndarray of int
            And the row of the mask.
        """
        mask = self._by_issue.newest(iodp, time)
        active = self.active(iodp, time)
        number = np.where(active, self.number[mask, slot] if len(self.number) else 0, -1)
        return number, mask

    def active(self, iodp: Integers, time: Datetimes) -> Masks:
        """Whether a mask of an issue is known and not timed out."""
        mask = self._by_issue.newest(iodp, time)
        received = self.time[mask] if len(self.time) else np.broadcast_to(LONG_AGO, mask.shape)
        return (mask >= 0) & (seconds(time - received) <= self._limit) & (received > self._stops.last(time))

    def holds(self, number: Integers, time: Datetimes) -> tuple[Masks, Masks]:
        """Whether there is an active mask (T,), and whether the newest names the satellites (T, K)."""
        row = self._by_time.newest(np.zeros(len(time), dtype=np.int64), time)
        if not len(self._time_in_time):
            nothing = np.zeros(len(time), dtype=bool)
            return nothing, np.zeros((len(time), len(number)), dtype=bool)
        received = self._time_in_time[row]
        known = (row >= 0) & (seconds(time - received) <= self._limit) & (received > self._stops.last(time))
        return known, self._member[row][:, np.maximum(number, 0)] & known[:, None]


@dataclass(frozen=True, kw_only=True)
class FastTable:
    """Fast corrections by satellite and time; `fresh` is the first row since the satellite was last out of use."""

    number: Integers
    time: Datetimes
    prc_m: Floats
    udrei: Integers
    iodf: Integers
    iodp: Integers
    fresh: Integers
    newest: Timeline


@dataclass(frozen=True, kw_only=True)
class UdreTable:
    """UDREI by satellite and time, from fast corrections and type 6.

    `grows_from` is the reception of the message that the error, and the fast correction's time-out,
    run from.
    """

    number: Integers
    time: Datetimes
    udrei: Integers
    grows_from: Datetimes
    newest: Timeline


@dataclass(frozen=True, kw_only=True)
class FastDegradationTable:
    """Type 7 by satellite and time; `shortest` is the smallest time-out of the message's satellites [s]."""

    number: Integers
    time: Datetimes
    indicator: Integers
    latency_s: Floats
    shortest: Integers
    newest: Timeline


@dataclass(frozen=True, kw_only=True)
class LongTermTable:
    """Long-term corrections by satellite and time; `other` is the last row with another IODE, -1 without."""

    number: Integers
    time: Datetimes
    iode: Integers
    iodp: Integers
    velocity_code: Integers
    position_m: Floats
    velocity_mps: Floats
    clock_s: Floats
    clock_rate: Floats
    reference: Datetimes
    other: Integers
    newest: Timeline


@dataclass(frozen=True, kw_only=True)
class CovarianceTable:
    """Type 28 by satellite and time; `all_times` are those of any satellite."""

    number: Integers
    time: Datetimes
    scale: Floats
    factor: Floats
    newest: Timeline
    all_times: Datetimes


@dataclass(frozen=True, kw_only=True)
class DegradationTable:
    """Type 10 by time."""

    time: Datetimes
    values: Degradation
    newest: Timeline


class SatelliteTables:
    """Everything one GEO said about satellites.

    Attributes
    ----------
    unused : Counter of str
        Corrections that no mask, or no fast correction, fits.
    """

    def __init__(self, log: SbasLog, limits: SbasLimits) -> None:
        self.unused: Counter[str] = Counter()
        self.stops = Stops(log, limits)
        self.masks = MaskTable(log, limits, self.stops)
        self.fast = self._fast(log, fast_corrections(log, type0=limits.type0))
        self.udre = self._udre(log)
        self.fast_degradation = self._fast_degradation(log)
        self.long_term = self._long_term(log)
        self.covariance = self._covariance(log)
        values = degradation(log)
        time = log.time[values.row]
        self.degradation = DegradationTable(
            time=time, values=values, newest=Timeline(np.zeros(len(time), dtype=np.int64), time)
        )

    def _numbers(self, what: str, iodp: Integers, slot: Integers, time: Datetimes) -> Integers:
        number, _ = self.masks.resolve(iodp, slot, time)
        self.unused[f"{what} without a mask of their IODP"] += int((number < 0).sum())
        return number

    def _fast(self, log: SbasLog, decoded: FastCorrections) -> FastTable:
        time = log.time[decoded.row]
        number = self._numbers("fast corrections", decoded.iodp, decoded.slot, time)
        kept = np.flatnonzero(number > 0)
        order = kept[series_order(number[kept], time[kept])]
        number, time, udrei = number[order], time[order], decoded.udrei[order]
        at = np.arange(len(order))
        first = np.ones(len(order), dtype=bool)
        first[1:] = number[1:] != number[:-1]
        # A row after one that was not monitored, or the first of its satellite, begins anew.
        begins = first.copy()
        begins[1:] |= udrei[:-1] >= NOT_MONITORED
        return FastTable(
            number=number,
            time=time,
            prc_m=decoded.prc_m[order],
            udrei=udrei,
            iodf=decoded.iodf[order],
            iodp=decoded.iodp[order],
            fresh=np.maximum.accumulate(np.where(begins, at, 0)) if len(order) else at,
            newest=Timeline(number, time),
        )

    def _udre(self, log: SbasLog) -> UdreTable:
        """Fast corrections bring their own UDREI; type 6 renews those whose IODF it names, an alarm all."""
        fast, six = self.fast, integrity(log)
        time = np.repeat(log.time[six.row], six.udrei.shape[1])
        slot = np.tile(np.arange(six.udrei.shape[1]), len(six.row))
        number = self._current_numbers(time, slot)
        row = fast.newest.newest(number, time)
        iodf = np.repeat(six.iodf, _BLOCK, axis=1)[:, : six.udrei.shape[1]].ravel()
        held = fast.iodf[row] if len(fast.iodf) else np.full(row.shape, -1)
        fits = (row >= 0) & (number > 0) & ((iodf == ALARM) | (iodf == held))
        self.unused["UDREI of type 6 without a fast correction of their IODF"] += int((~fits & (number > 0)).sum())
        time, row, alarm = time[fits], row[fits], iodf[fits] == ALARM
        renewed = np.where(alarm, fast.time[row], time) if len(fast.time) else time
        numbers = np.concatenate([fast.number, number[fits]])
        times = np.concatenate([fast.time, time])
        order = series_order(numbers, times)
        return UdreTable(
            number=numbers[order],
            time=times[order],
            udrei=np.concatenate([fast.udrei, six.udrei.ravel()[fits]])[order],
            grows_from=np.concatenate([fast.time, renewed])[order],
            newest=Timeline(numbers[order], times[order]),
        )

    def _current_numbers(self, time: Datetimes, slot: Integers) -> Integers:
        """Mask numbers of slots by the newest mask of any issue: type 6 names none."""
        issues = np.arange(4)
        rows = self.masks._by_issue.newest(issues[None, :], time[:, None])
        if not len(self.masks.time):
            return np.full(len(time), -1, dtype=np.int64)
        received = np.where(rows >= 0, self.masks.time[rows], LONG_AGO)
        best = np.take_along_axis(rows, np.argmax(received, axis=1)[:, None], axis=1)[:, 0]
        active = self.masks.active(np.argmax(received, axis=1), time)
        return np.where(active & (best >= 0), self.masks.number[best, slot], -1)

    def _fast_degradation(self, log: SbasLog) -> FastDegradationTable:
        decoded = fast_degradation(log)
        slots = decoded.indicator.shape[1]
        time = np.repeat(log.time[decoded.row], slots)
        slot = np.tile(np.arange(slots), len(decoded.row))
        number = self._numbers("degradation factors", np.repeat(decoded.iodp, slots), slot, time)
        indicator = decoded.indicator.ravel()
        # The largest indicator has the smallest time-out.
        largest = np.where(number > 0, indicator, -1).reshape(-1, slots).max(axis=1) if len(number) else number
        kept = np.flatnonzero(number > 0)
        order = kept[series_order(number[kept], time[kept])]
        return FastDegradationTable(
            number=number[order],
            time=time[order],
            indicator=indicator[order],
            latency_s=np.repeat(decoded.latency_s, slots)[order],
            shortest=np.repeat(largest, slots)[order],
            newest=Timeline(number[order], time[order]),
        )

    def _long_term(self, log: SbasLog) -> LongTermTable:
        decoded = long_term(log)
        time = log.time[decoded.row]
        number = self._numbers("long-term corrections", decoded.iodp, decoded.slot, time)
        kept = np.flatnonzero(number > 0)
        order = kept[series_order(number[kept], time[kept])]
        number, iode = number[order], decoded.iode[order]
        at = np.arange(len(order))
        changed = np.ones(len(order), dtype=bool)
        changed[1:] = (number[1:] != number[:-1]) | (iode[1:] != iode[:-1])
        run = np.maximum.accumulate(np.where(changed, at, 0)) if len(order) else at
        same = (run > 0) & (number[run - 1] == number) if len(order) else changed
        return LongTermTable(
            number=number,
            time=time[order],
            iode=iode,
            iodp=decoded.iodp[order],
            velocity_code=decoded.velocity_code[order],
            position_m=decoded.position_m[order],
            velocity_mps=decoded.velocity_mps[order],
            clock_s=decoded.clock_s[order],
            clock_rate=decoded.clock_rate[order],
            reference=decoded.reference[order],
            other=np.where(same, run - 1, -1),
            newest=Timeline(number, time[order]),
        )

    def _covariance(self, log: SbasLog) -> CovarianceTable:
        decoded = covariance(log)
        time = log.time[decoded.row]
        number = self._numbers("covariances", decoded.iodp, decoded.slot, time)
        kept = np.flatnonzero(number > 0)
        order = kept[series_order(number[kept], time[kept])]
        return CovarianceTable(
            number=number[order],
            time=time[order],
            scale=decoded.scale[order],
            factor=decoded.factor[order],
            newest=Timeline(number[order], time[order]),
            all_times=np.sort(time[kept]),
        )
