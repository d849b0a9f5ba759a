"""How corrections grow old (DO-229D, A.4.5.1), and what place does to sigma UDRE (A.4.4.13, A.4.4.16)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from railfix.core.arrays import Datetimes, Floats, Integers, Masks
from railfix.core.timescale import seconds
from railfix.ranges.sbas.fast import FastCorrected
from railfix.ranges.sbas.limits import TIMEOUT_S, SbasLimits
from railfix.ranges.sbas.tables import SatelliteTables


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Degradation terms [m], all (T, K); `missing` where type 10 is, `rss` where squares are summed."""

    fast_m: Floats
    rate_m: Floats
    long_term_m: Floats
    en_route_m: Floats
    rss: Masks
    missing: Masks


def degradation_row(
    tables: SatelliteTables, limits: SbasLimits, time: Datetimes, stop: Datetimes
) -> tuple[Integers, Masks]:
    """Newest message of type 10 at epochs, and where it is in force."""
    table = tables.degradation
    row = table.newest.newest(np.zeros(np.shape(time), dtype=np.int64), time)
    if not len(table.time):
        return row, np.zeros(row.shape, dtype=bool)
    received = table.time[row]
    return row, (row >= 0) & (received > stop) & (seconds(time - received) <= limits.timeout_s("degradation"))


def growth(
    tables: SatelliteTables,
    limits: SbasLimits,
    time: Datetimes,
    fast: FastCorrected,
    long_row: Integers,
    stop: Datetimes,
) -> Growth:
    """Degradation terms of satellites at epochs; times and stops of shape (T, 1)."""
    row, active = degradation_row(tables, limits, time, stop)
    shape = fast.udrei.shape
    zero = np.zeros(shape)
    if not len(tables.degradation.time):
        nothing = np.zeros(shape, dtype=bool)
        return Growth(fast_m=zero, rate_m=zero, long_term_m=zero, en_route_m=zero, rss=nothing, missing=~nothing)
    values = tables.degradation.values
    rate = np.where(
        np.isfinite(fast.rate_span_s),
        (fast.rate_growth_mps + values.range_rate_m[row] / fast.rate_span_s) * fast.since_s,
        0.0,
    )
    long_term, aged = _long_term(tables, limits, time, long_row, row)
    en_route = (fast.aged | aged) & (limits.mode == "en_route")
    return Growth(
        fast_m=fast.growth_m,
        rate_m=rate,
        long_term_m=long_term,
        en_route_m=np.where(en_route, values.en_route_m[row], 0.0),
        rss=np.broadcast_to(values.rss_udre[row] == 1, shape),
        missing=np.broadcast_to(~active, shape),
    )


def _long_term(
    tables: SatelliteTables, limits: SbasLimits, time: Datetimes, long_row: Integers, row: Integers
) -> tuple[Floats, Masks]:
    """Growth of long-term corrections (A.4.5.1.3), and which are older than precision approach allows."""
    table, values = tables.long_term, tables.degradation.values
    if not len(table.time):
        return np.zeros(long_row.shape), np.zeros(long_row.shape, dtype=bool)
    there = long_row >= 0
    since_reference = seconds(time - table.reference[long_row])
    interval = values.long_term_interval_s[row]
    over = np.maximum(0.0, np.maximum(-since_reference, since_reference - interval))
    inside = (since_reference > 0.0) & (since_reference < interval)
    moving = np.where(inside, 0.0, values.long_term_step_m[row] + values.long_term_rate_mps[row] * over)
    age = seconds(time - table.time[long_row])
    still_interval = np.maximum(values.still_interval_s[row], 1.0)
    still = values.still_step_m[row] * np.floor((age + limits.message_s) / still_interval)
    grown = np.where(table.velocity_code[long_row] == 1, moving, still)
    return np.where(there, grown, 0.0), there & (age > TIMEOUT_S["long_term"][0])


def delta_udre_covariance(tables: SatelliteTables, time: Datetimes, row: Integers, line_of_sight: Floats) -> Floats:
    """Factor on sigma UDRE along lines of sight (A.4.4.16), 1 without a covariance."""
    table = tables.covariance
    if not len(table.time):
        return np.ones(row.shape)
    sight = np.concatenate([line_of_sight, np.ones((*row.shape, 1))], axis=-1)
    projected = np.einsum("tkij,tkj->tki", table.factor[row], sight)
    extra = _covariance_constant(tables, time)[:, None] * table.scale[row]
    return np.where(row >= 0, np.sqrt(np.einsum("tki,tki->tk", projected, projected)) + extra, 1.0)


def _covariance_constant(tables: SatelliteTables, time: Datetimes) -> Floats:
    """C_covariance of the newest message of type 10, 0 before the first, shape (T,)."""
    table = tables.degradation
    if not len(table.time):
        return np.zeros(len(time))
    row = table.newest.newest(np.zeros(len(time), dtype=np.int64), time)
    return np.where(row >= 0, table.values.covariance[row], 0.0)
