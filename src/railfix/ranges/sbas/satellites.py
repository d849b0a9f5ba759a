"""Satellite corrections in force at epochs: fast, long-term, degradation, sigma UDRE (DO-229D, A.4.4 and A.4.5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, Strings
from railfix.core.timescale import seconds, timedelta
from railfix.gnss.navigation import Navigation
from railfix.gnss.orbits.issues import issue_records
from railfix.ranges.sbas.decode import Decoded, service
from railfix.ranges.sbas.limits import TIMEOUT_S, SbasLimits
from railfix.ranges.sbas.messages import SbasMessages
from railfix.ranges.sbas.standard import FAST_DEGRADATION_MPS2, FAST_TIMEOUT_S, SERVICE_FACTOR
from railfix.ranges.sbas.tables import ALARM, SatelliteTables, Series

#: A range rate is applied for at most this multiple of the time between the two corrections that determine the rate.
_RATE_REACH: Final = 8.0
_ACCELERATION: Final = np.array(FAST_DEGRADATION_MPS2)
_FACTOR: Final = np.array(SERVICE_FACTOR)


@dataclass(frozen=True, kw_only=True)
class FastInForce:
    """Fast corrections in force; all arrays have shape (T, K)."""

    missing: Masks  #: True where no fast correction was received.
    timed_out: Masks  #: True where the correction is too old, or the mask is not active.
    no_factor: Masks  #: True where no type 7 is in force.
    no_rate: Masks  #: True where a range rate is required but unknown.
    udrei: Integers  #: UDREI; -1 where no UDREI was received.
    correction_m: Floats
    rate_mps: Floats
    growth_m: Floats  #: Degradation due to the age of the correction (A.4.5.1.1).
    #: Growth per second of the range-rate degradation; 0 where the rate does not degrade (A.4.5.1.2).
    rate_growth_mps: Floats
    #: Time between the two fast corrections that determine the range rate; infinite where the rate does not degrade.
    rate_span_s: Floats
    since_s: Floats  #: Time since the applicability of the correction.
    aged: Masks  #: True where the correction is older than the time-out of precision approach.


def fast_in_force(
    tables: SatelliteTables, limits: SbasLimits, time: Datetimes, number: Integers, stop: Datetimes
) -> FastInForce:
    """Find the fast corrections at epochs (T, 1) for satellites with PRN mask numbers (1, K), -1 for none."""
    fast, udre = tables.fast, tables.udre
    row, of_udre = fast.newest(number, time), udre.newest(number, time)
    missing = (row < 0) | (fast.time[row] <= stop)
    indicator, shortest, latency, no_factor = _factors(tables, limits, time, number, stop)
    timeout = np.array(FAST_TIMEOUT_S[limits.mode], dtype=np.float64)
    age, udre_age = seconds(time - udre["grows_from"][of_udre]), seconds(time - udre.time[of_udre])
    late = (age > timeout[indicator]) | (udre_age > limits.timeout_s("udrei"))
    own_age = seconds(time - fast.time[row])
    late |= ~tables.masks.active(fast["iodp"][row], time)
    since = own_age + limits.message_s
    rate, growth, span, no_rate = _rate(fast, limits, row, stop, indicator, timeout[shortest], since)
    precision = np.array(FAST_TIMEOUT_S["precision"], dtype=np.float64)
    return FastInForce(
        missing=missing,
        timed_out=late & ~missing,
        no_factor=no_factor,
        no_rate=no_rate & (limits.range_rate == "mops"),
        udrei=np.where(missing, -1, udre["udrei"][of_udre]),
        correction_m=fast["prc_m"][row] + rate * since,
        rate_mps=rate,
        growth_m=_ACCELERATION[indicator] / 2.0 * (age + limits.message_s + latency) ** 2,
        rate_growth_mps=growth,
        rate_span_s=span,
        since_s=since,
        aged=(age > precision[indicator]) | (udre_age > 12.0),
    )


def _factors(
    tables: SatelliteTables, limits: SbasLimits, time: Datetimes, number: Integers, stop: Datetimes
) -> tuple[Integers, Integers, Floats, Masks]:
    """Return the indicator of type 7, the largest indicator in the same message, the latency, and a mask that is true
    where type 7 is missing.

    Where type 7 is missing, both indicators have the worst value.
    """
    table = tables.fast_degradation
    row, worst = table.newest(number, time), len(_ACCELERATION) - 1
    active = table.in_force(row, time, stop, limits.timeout_s("fast_degradation"))
    return (
        np.where(active, table["indicator"][row], worst),
        np.where(active, table["shortest"][row], worst),
        np.where(active, table["latency_s"][row], 0.0),
        ~active,
    )


def _rate(
    fast: Series,
    limits: SbasLimits,
    row: Integers,
    stop: Datetimes,
    indicator: Integers,
    reach_s: Floats,
    since_s: Floats,
) -> tuple[Floats, Floats, Floats, Masks]:
    """Return the range rate, the growth per second of the rate's degradation, the time between the two corrections
    used, and a mask of missing rates.

    The rate is computed from the newest and the previous correction. After an alarm (IODF 3), the previous correction
    is replaced by the earlier correction whose age, relative to the newest, is nearest to half the time-out.
    """
    zero = np.zeros(row.shape)
    if limits.range_rate == "off":
        return zero, zero, zero + np.inf, np.zeros(row.shape, dtype=bool)
    iodf, prc = fast["iodf"], fast["prc_m"]
    last = np.maximum(row - 1, 0)
    alarm = (iodf[row] == ALARM) | (iodf[last] == ALARM)
    earlier = np.where(alarm, _nearest(fast, row, timedelta(reach_s / 2.0)), last)
    steady = indicator == 0
    there = (row >= 0) & (earlier >= fast["fresh"][row]) & (earlier < row) & (fast.time[earlier] > stop)
    span = np.where(there, seconds(fast.time[row] - fast.time[earlier]), np.nan)
    usable = there & (span > 0.0) & (span <= reach_s) & (since_s <= _RATE_REACH * span)
    rate = np.where(usable & ~steady, (prc[row] - prc[earlier]) / np.where(usable, span, 1.0), 0.0)
    acceleration = _ACCELERATION[indicator]
    in_turn = (iodf[row] - iodf[earlier]) % 3 == 1
    off_half = np.abs(span - reach_s / 2.0)
    growth = np.where(alarm, acceleration * off_half / 2.0, acceleration * reach_s / 4.0)
    degrades = usable & ~steady & np.where(alarm, off_half > 0.0, ~in_turn)
    return rate, np.where(degrades, growth, 0.0), np.where(degrades, span, np.inf), ~usable & ~steady


def _nearest(fast: Series, row: Integers, before: NDArray[np.timedelta64]) -> Integers:
    """Return, for each row, the satellite's earlier row received nearest to the time `fast.time[row] - before`.

    If two earlier rows are equally near, the later of them is returned.
    """
    wanted = fast.time[row] - before
    first = fast["fresh"][row]
    low = np.maximum(fast.newest(fast.series[row], wanted), first)
    high = np.maximum(np.minimum(low + 1, row - 1), 0)
    nearer = np.abs(fast.time[high] - wanted) <= np.abs(fast.time[low] - wanted)
    return np.asarray(np.where(nearer & (high >= first), high, low))


@dataclass(frozen=True, kw_only=True)
class LongTermInForce:
    """Long-term corrections in force; all arrays have shape (T, K)."""

    row: Integers  #: Row of `SatelliteTables.long_term`, -1 without a correction.
    record: Integers  #: Row of the navigation record, -1 without a record.
    missing: Masks  #: True where a required correction was not received.
    timed_out: Masks  #: True where the correction is too old, or the mask is not active.
    mismatch: Masks  #: True where no navigation record has the correction's issue of data.


def long_term_in_force(
    tables: SatelliteTables,
    limits: SbasLimits,
    time: Datetimes,
    satellite: Strings,
    number: Integers,
    stop: Datetimes,
    navigation: Navigation | None,
) -> LongTermInForce:
    """Find the newest long-term corrections that match a navigation record; SBAS satellites need no such correction.

    `number`, shape (K,), are the numbers in the PRN mask. Without `navigation`, the newest correction is used
    unchecked.
    """
    table, limit = tables.long_term, limits.timeout_s("long_term")
    newest = table.newest(number[None, :], time[:, None])

    def judged(row: Integers) -> tuple[Masks, Masks, Integers]:
        received = table.received(row)
        known = (row >= 0) & (received > stop)
        late = (seconds(time[:, None] - received) > limit) | ~tables.masks.active(table["iodp"][row], time[:, None])
        record = np.full(row.shape, -1, dtype=np.int64)
        if navigation is not None:
            record = issue_records(navigation, satellite, time, np.where(known, table["iode"][row], -1))
        return known, known & late, record

    known, late, record = judged(newest)
    taken = newest
    if navigation is not None:
        other = np.where(newest >= 0, table["other"][newest], -1)
        other_known, other_late, other_record = judged(other)
        swap = known & (late | (record < 0)) & other_known & ~other_late & (other_record >= 0)
        taken, record, late = np.where(swap, other, newest), np.where(swap, other_record, record), late & ~swap
    needless = np.char.startswith(satellite, "S")[None, :]
    mismatch = known & (record < 0) & (navigation is not None)
    return LongTermInForce(
        row=np.where(known, taken, -1),
        record=record,
        missing=~known & ~needless,
        timed_out=late & ~needless,
        mismatch=mismatch & ~needless,
    )


def covariance_in_force(
    tables: SatelliteTables, limits: SbasLimits, time: Datetimes, number: Integers, stop: Datetimes
) -> tuple[Integers, Masks]:
    """Return the row of the covariance in force, and a mask of satellites lacking it although the GEO sends type 28."""
    table, limit, sent_at = tables.covariance, limits.timeout_s("covariance"), tables.covariance_time
    row = table.newest(number[None, :], time[:, None])
    if not len(sent_at):
        return row, np.zeros(row.shape, dtype=bool)
    active = table.in_force(row, time[:, None], stop, limit)
    last = np.searchsorted(sent_at, time, side="right") - 1
    newest = sent_at[np.maximum(last, 0)]
    sent = (last >= 0) & (seconds(time - newest) <= limit) & (newest > stop[:, 0])
    return np.where(active, row, -1), sent[:, None] & ~active


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Degradation terms [m], (T, K); `missing` is True without type 10, `rss` where squares of terms are summed."""

    fast_m: Floats
    rate_m: Floats
    long_term_m: Floats
    en_route_m: Floats
    rss: Masks
    missing: Masks


def degradation_row(
    tables: SatelliteTables, limits: SbasLimits, time: Datetimes, stop: Datetimes
) -> tuple[Integers, Masks]:
    """Return for each epoch the row of the newest message of type 10, and whether this message is in force."""
    row = tables.degradation.newest(0, time)
    return row, tables.degradation.in_force(row, time, stop, limits.timeout_s("degradation"))


def growth(
    tables: SatelliteTables, limits: SbasLimits, time: Datetimes, fast: FastInForce, long_row: Integers, stop: Datetimes
) -> Growth:
    """Return the degradation terms of satellites at epochs; `time` and `stop` have shape (T, 1)."""
    row, active = degradation_row(tables, limits, time, stop)
    shape, ten = fast.udrei.shape, tables.degradation
    rate = np.where(
        np.isfinite(fast.rate_span_s),
        (fast.rate_growth_mps + ten["range_rate_m"][row] / fast.rate_span_s) * fast.since_s,
        0.0,
    )
    long_term, aged = _long_term_growth(tables, limits, time, long_row, row)
    en_route = (fast.aged | aged) & (limits.mode == "en_route")
    return Growth(
        fast_m=fast.growth_m,
        rate_m=rate,
        long_term_m=long_term,
        en_route_m=np.where(en_route, ten["en_route_m"][row], 0.0),
        rss=np.broadcast_to(ten["rss_udre"][row] == 1, shape),
        missing=np.broadcast_to(~active, shape),
    )


def _long_term_growth(
    tables: SatelliteTables, limits: SbasLimits, time: Datetimes, long_row: Integers, row: Integers
) -> tuple[Floats, Masks]:
    """Return the long-term degradation (A.4.5.1.3), and a mask of corrections too old for precision approach."""
    table, ten = tables.long_term, tables.degradation
    there = long_row >= 0
    since_reference = seconds(time - table["reference"][long_row])
    interval = ten["long_term_interval_s"][row]
    over = np.maximum(0.0, np.maximum(-since_reference, since_reference - interval))
    inside = (since_reference > 0.0) & (since_reference < interval)
    moving = np.where(inside, 0.0, ten["long_term_step_m"][row] + ten["long_term_rate_mps"][row] * over)
    age = seconds(time - table.time[long_row])
    still_interval = np.maximum(ten["still_interval_s"][row], 1.0)
    still = ten["still_step_m"][row] * np.floor((age + limits.message_s) / still_interval)
    grown = np.where(table["velocity_code"][long_row] == 1, moving, still)
    return np.where(there, grown, 0.0), there & (age > TIMEOUT_S["long_term"][0])


def delta_udre_covariance(tables: SatelliteTables, time: Datetimes, row: Integers, line_of_sight: Floats) -> Floats:
    """Return the factor on sigma UDRE along lines of sight (A.4.4.16); 1 without a covariance."""
    table, ten = tables.covariance, tables.degradation
    newest = ten.newest(0, time)
    constant = np.where(newest >= 0, ten["covariance"][newest], 0.0)
    sight = np.concatenate([line_of_sight, np.ones((*row.shape, 1))], axis=-1)
    projected = np.einsum("tkij,tkj->tki", table["factor"][row], sight)
    extra = constant[:, None] * table["scale"][row]
    return np.where(row >= 0, np.sqrt(np.einsum("tki,tki->tk", projected, projected)) + extra, 1.0)


class ServiceTable:
    """Messages of type 27 of one GEO: the regions in which sigma UDRE is valid (A.4.4.13)."""

    def __init__(self, messages: SbasMessages, limits: SbasLimits) -> None:
        self.values: Decoded = service(messages)
        self.time = messages.time[self.values["row"]]
        self._limit = limits.timeout_s("service")
        self._reject = limits.incomplete == "reject"

    def factor(self, time: Datetimes, latitude_deg: Floats, longitude_deg: Floats) -> tuple[Floats, Masks]:
        """Return the sigma UDRE factor (T,) at positions (NaN without type 27), and a mask (T,) of incomplete sets.

        The newest complete set of one issue is used. Inside several regions the factor of the highest priority applies,
        or the smallest factor among equal priorities. Outside all regions, the factor stated for the outside applies.
        """
        factor, incomplete = np.full(len(time), np.nan), np.zeros(len(time), dtype=bool)
        newest = np.searchsorted(self.time, time, side="right") - 1
        for last in np.unique(newest[newest >= 0]).tolist():
            at = np.flatnonzero(newest == last)
            at = at[seconds(time[at] - self.time[last]) <= self._limit]
            rows = self._complete(last)
            if rows is None:
                incomplete[at], factor[at] = self._reject, np.nan if self._reject else 1.0
            else:
                factor[at] = self._of_set(rows, latitude_deg[at], longitude_deg[at])
        return factor, incomplete

    def _complete(self, last: int) -> Integers | None:
        """Return the rows of the newest complete set at or before a row; None without a complete set."""
        issue, message = self.values["issue"], self.values["message"]
        young = np.flatnonzero(seconds(self.time[last] - self.time[: last + 1]) <= self._limit)
        for row in young[::-1].tolist():
            of_issue = young[(issue[young] == issue[row]) & (young <= row)]
            numbers, place = np.unique(message[of_issue][::-1], return_index=True)
            if len(numbers) == self.values["messages"][row]:
                return np.asarray(of_issue[::-1][place], dtype=np.int64)
        return None

    def _of_set(self, rows: Integers, latitude_deg: Floats, longitude_deg: Floats) -> Floats:
        values = self.values
        best = np.full(len(latitude_deg), -1)
        factor = np.full(len(latitude_deg), _FACTOR[values["outside"][rows[0]]])
        for row in rows.tolist():
            for region in range(int(values["regions"][row])):
                inside = _inside(values, row, region, latitude_deg, longitude_deg)
                priority, here = int(values["priority"][row]), _FACTOR[values["inside"][row]]
                better = inside & ((priority > best) | ((priority == best) & (here < factor)))
                factor[better], best[better] = here, priority
        return factor


def _inside(values: Decoded, row: int, region: int, latitude_deg: Floats, longitude_deg: Floats) -> Masks:
    """Return True in a region: a rectangle, or the half of a rectangle with the corner (latitude 1, longitude 2)."""
    north, west, south, east = (
        values[name][row, region] for name in ("latitude_1_deg", "longitude_1_deg", "latitude_2_deg", "longitude_2_deg")
    )
    height, width = north - south, _wrap(east - west)
    if height == 0.0 or width == 0.0:
        return np.zeros(len(latitude_deg), dtype=bool)
    up, along = (latitude_deg - south) / height, _wrap(longitude_deg - west) / width
    inside = (up >= 0.0) & (up <= 1.0) & (along >= 0.0) & (along <= 1.0)
    return np.asarray(inside if values["square"][row, region] else inside & (up + along >= 1.0))


def _wrap(angle_deg: Floats | np.float64) -> Floats:
    """Return the angle in [-180, 180)."""
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0)
