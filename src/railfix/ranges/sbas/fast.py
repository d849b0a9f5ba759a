"""Fast corrections at epochs, with the rate that two of them give (DO-229D, A.4.4.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Integers, Masks
from railfix.core.timescale import seconds, timedelta
from railfix.ranges.sbas.limits import FAST_DEGRADATION_MPS2, FAST_TIMEOUT_S, SbasLimits
from railfix.ranges.sbas.tables import ALARM, FastTable, SatelliteTables

#: A rate may carry a fast correction this many times the time between the two it was made of.
_RATE_REACH: Final = 8.0
_ACCELERATION: Final = np.array(FAST_DEGRADATION_MPS2)


@dataclass(frozen=True, kw_only=True)
class FastCorrected:
    """Fast corrections in force, all (T, K).

    Attributes
    ----------
    missing, timed_out, no_factor, no_rate : ndarray of bool
        No fast correction at all; too old, or of a mask no longer in force; type 7 is missing; a
        rate is needed and cannot be had.
    udrei : ndarray of int
        -1 without one.
    correction_m, rate_mps : ndarray
    growth_m : ndarray [m]
        Of the fast correction (A.4.5.1.1).
    rate_growth_mps, rate_span_s : ndarray
        a Ifc / 4, or what an alarm puts in its place, and the time between the two corrections;
        0 and infinite where the rate does not degrade (A.4.5.1.2).
    since_s : ndarray [s]
        Since the time of applicability.
    aged : ndarray of bool
        Older than precision approach allows.
    """

    missing: Masks
    timed_out: Masks
    no_factor: Masks
    no_rate: Masks
    udrei: Integers
    correction_m: Floats
    rate_mps: Floats
    growth_m: Floats
    rate_growth_mps: Floats
    rate_span_s: Floats
    since_s: Floats
    aged: Masks


def fast_corrected(
    tables: SatelliteTables, limits: SbasLimits, time: Datetimes, number: Integers, stop: Datetimes
) -> FastCorrected:
    """Fast corrections of satellites at epochs.

    Parameters
    ----------
    tables : SatelliteTables
    limits : SbasLimits
    time, stop : ndarray of datetime64[ns], shape (T, 1)
        Epochs, and when the GEO was last stopped.
    number : ndarray of int, shape (1, K)
        PRN mask numbers, -1 for none.
    """
    fast, udre = tables.fast, tables.udre
    shape = np.broadcast_shapes(time.shape, number.shape)
    if not len(fast.time):
        return _nothing(shape)
    row, of_udre = fast.newest.newest(number, time), udre.newest.newest(number, time)
    missing = (row < 0) | (fast.time[row] <= stop)
    indicator, shortest, latency, no_factor = _factors(tables, limits, time, number, stop)
    timeout = np.array(FAST_TIMEOUT_S[limits.mode], dtype=np.float64)
    age, udre_age = seconds(time - udre.grows_from[of_udre]), seconds(time - udre.time[of_udre])
    late = (age > timeout[indicator]) | (udre_age > limits.timeout_s("udrei"))
    late |= ~tables.masks.active(fast.iodp[row], time)
    since = seconds(time - fast.time[row]) + limits.message_s
    rate, growth, span, no_rate = _rate(fast, limits, row, stop, indicator, timeout[shortest], since)
    precision = np.array(FAST_TIMEOUT_S["precision"], dtype=np.float64)
    return FastCorrected(
        missing=missing,
        timed_out=late & ~missing,
        no_factor=no_factor,
        no_rate=no_rate & (limits.range_rate == "mops"),
        udrei=np.where(missing, -1, udre.udrei[of_udre]),
        correction_m=fast.prc_m[row] + rate * since,
        rate_mps=rate,
        growth_m=_ACCELERATION[indicator] / 2.0 * (age + limits.message_s + latency) ** 2,
        rate_growth_mps=growth,
        rate_span_s=span,
        since_s=since,
        aged=(age > precision[indicator]) | (udre_age > 12.0),
    )


def _nothing(shape: tuple[int, ...]) -> FastCorrected:
    yes, no, zero = np.ones(shape, dtype=bool), np.zeros(shape, dtype=bool), np.zeros(shape)
    return FastCorrected(
        missing=yes, timed_out=no, no_factor=yes, no_rate=no, udrei=np.full(shape, -1, dtype=np.int64),
        correction_m=zero, rate_mps=zero, growth_m=zero, rate_growth_mps=zero, rate_span_s=zero + np.inf,
        since_s=zero, aged=no,
    )  # fmt: skip


def _factors(
    tables: SatelliteTables, limits: SbasLimits, time: Datetimes, number: Integers, stop: Datetimes
) -> tuple[Integers, Integers, Floats, Masks]:
    """Indicator of type 7, the largest of its message, latency; the worst where type 7 is missing."""
    table = tables.fast_degradation
    row = table.newest.newest(number, time)
    worst = np.full(row.shape, len(_ACCELERATION) - 1, dtype=np.int64)
    if not len(table.time):
        return worst, worst, np.zeros(row.shape), np.ones(row.shape, dtype=bool)
    received = table.time[row]
    active = (row >= 0) & (received > stop) & (seconds(time - received) <= limits.timeout_s("fast_degradation"))
    return (
        np.where(active, table.indicator[row], worst),
        np.where(active, table.shortest[row], worst),
        np.where(active, table.latency_s[row], 0.0),
        ~active,
    )


def _rate(
    fast: FastTable,
    limits: SbasLimits,
    row: Integers,
    stop: Datetimes,
    indicator: Integers,
    reach_s: Floats,
    since_s: Floats,
) -> tuple[Floats, Floats, Floats, Masks]:
    """Range-rate correction, how it degrades per second, time between its two corrections, where there is none.

    After an alarm (IODF 3) the earlier of the two is the one nearest to half the time-out before.
    """
    zero = np.zeros(row.shape)
    if limits.range_rate == "off":
        return zero, zero, zero + np.inf, np.zeros(row.shape, dtype=bool)
    last = row - 1
    alarm = (fast.iodf[row] == ALARM) | (fast.iodf[last] == ALARM)
    before = _nearest(fast, row, timedelta(reach_s / 2.0))
    earlier = np.where(alarm, before, last)
    steady = indicator == 0
    there = (row >= 0) & (earlier >= fast.fresh[row]) & (earlier < row) & (fast.time[earlier] > stop)
    span = np.where(there, seconds(fast.time[row] - fast.time[earlier]), np.nan)
    usable = there & (span > 0.0) & (span <= reach_s) & (since_s <= _RATE_REACH * span)
    rate = np.where(usable & ~steady, (fast.prc_m[row] - fast.prc_m[earlier]) / np.where(usable, span, 1.0), 0.0)
    acceleration = _ACCELERATION[indicator]
    in_turn = (fast.iodf[row] - fast.iodf[earlier]) % 3 == 1
    off_half = np.abs(span - reach_s / 2.0)
    growth = np.where(alarm, acceleration * off_half / 2.0, acceleration * reach_s / 4.0)
    degrades = usable & ~steady & np.where(alarm, off_half > 0.0, ~in_turn)
    return rate, np.where(degrades, growth, 0.0), np.where(degrades, span, np.inf), ~usable & ~steady


def _nearest(fast: FastTable, row: Integers, before: NDArray[np.timedelta64]) -> Integers:
    """Earlier row of the same satellite whose time is nearest to `before` ahead of a row; the later of two."""
    wanted = fast.time[row] - before
    at = fast.newest.newest(fast.number[row], wanted)
    first = fast.fresh[row]
    low = np.maximum(at, first)
    high = np.minimum(low + 1, row - 1)
    nearer = np.abs(fast.time[high] - wanted) <= np.abs(fast.time[low] - wanted)
    return np.where(nearer & (high >= first), high, low)
