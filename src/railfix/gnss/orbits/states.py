"""Satellite positions and clocks at the times of transmission, as arrays over (epoch, channel)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from railfix.core.arrays import Datetimes, Floats, Integers, Masks, Strings, freeze_arrays
from railfix.core.constants import SPEED_OF_LIGHT
from railfix.core.timescale import seconds, timedelta
from railfix.gnss.navigation import Navigation, PreciseEphemeris
from railfix.gnss.orbits.ephemerides import kepler_state, precise_clock_s, precise_state
from railfix.gnss.orbits.prepared_records import ChannelRecords, PreparedRecords, prepared_records

#: Chunks of fewer epochs are computed with all channels together, longer chunks channel by channel, with the same
#: arithmetic on every element. Both single live epochs and complete logs are then fast.
_SHORT: Final = 96
_BLOCK: Final = 4096  #: Largest number of epochs of a channel computed at once, so that the arrays stay in the cache.


@dataclass(frozen=True, kw_only=True)
class SatelliteStates:
    """Satellite states at the times of transmission, T epochs by M channels.

    Values are NaN where a channel has no code, no record or no valid record.
    """

    #: Position in the Earth-fixed frame at the time of transmission, not rotated to the time of reception
    #: (`railfix.core.geodesy.range_with_rotation` does that); shape (T, M, 3).
    position_ecef_m: Floats
    velocity_ecef_mps: Floats  #: Derivative of `position_ecef_m` in the same frame, shape (T, M, 3).
    clock_m: Floats  #: Satellite clock offset in metres, with relativistic correction, without group delay; (T, M).
    #: Group delay of the channel's signal: corrected code = code + clock_m - group_delay_m. NaN on signals whose delay
    #: is not broadcast (`prepared_records.group_delay_s`); shape (T, M).
    group_delay_m: Floats
    age_s: Floats  #: Epoch minus toe of the record, 0 for a precise ephemeris; shape (T, M).
    accuracy_m: Floats  #: Broadcast URA or SISA; NaN for GLONASS and for a precise ephemeris; shape (T, M).
    #: Row in the record table of the constellation, even if the record is too old or the channel has no code; -1 if the
    #: satellite has no record; shape (T, M).
    record: Integers
    no_record: Masks  #: Whether the satellite has no record, shape (T, M).
    #: Whether the satellite has records, but none is valid at the epoch; False where there is no code; shape (T, M).
    too_old: Masks
    unhealthy: Masks  #: Whether the record used flags the signal as unhealthy, shape (T, M).
    #: Whether the record used was transmitted after the epoch, so that it is not available live; shape (T, M).
    future_record: Masks

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> SatelliteStates:
        """Return writable states in which no satellite has a record."""
        position, velocity = np.full((2, *shape, 3), np.nan)
        clock, delay, age, accuracy = np.full((4, *shape), np.nan)
        too_old, unhealthy, future = np.zeros((3, *shape), dtype=bool)
        return cls(
            position_ecef_m=position, velocity_ecef_mps=velocity, clock_m=clock, group_delay_m=delay, age_s=age,
            accuracy_m=accuracy, record=np.full(shape, -1, dtype=np.int64), no_record=np.ones(shape, dtype=bool),
            too_old=too_old, unhealthy=unhealthy, future_record=future,
        )  # fmt: skip


def satellite_states(
    time: Datetimes,
    satellite: Strings,
    signal: Strings,
    code_m: Floats,
    navigation: Navigation,
    *,
    max_age_s: float | None = None,
    record: Integers | None = None,
) -> SatelliteStates:
    """Compute satellite states at the times of transmission ``time - code / c - dt_sv``.

    The receiver clock error cancels in the time of transmission, because it affects time tag and code equally. Results
    are the same to the last bit, whatever other epochs and channels are computed together.

    Galileo channels on E5a use F/NAV records, and other Galileo channels use I/NAV records. Where no such record is
    valid at an epoch, a valid record of the other message is used, with the clock and group delay of that message.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
        Receiver time tags.
    satellite, signal : ndarray of str, shape (M,)
    code_m : ndarray, shape (T, M) [m]
        NaN where not observed.
    navigation : Navigation
        If `precise` is set, positions and clocks are taken from the precise ephemeris; health and group delays are
        taken from the nearest broadcast record of any age. Satellites absent from the precise ephemeris, or (except for
        GLONASS) from the broadcast records, have no record.
    max_age_s : float, optional
        Limit on the time between epoch and toe, in addition to the validity of the records [s].
    record : ndarray of int, shape (T, M), optional
        Rows of `navigation.kepler` to use if corrections refer to one issue of data (`issue_records`); with -1, the
        record is selected as without `record`. A signal is also unhealthy if the record selected without `record` flags
        it as unhealthy. Rows for GLONASS are ignored.

    Raises
    ------
    ValueError
        Shapes do not match.
    """
    if code_m.shape != (len(time), len(satellite)) or len(signal) != len(satellite):
        expected = (len(time), len(satellite))
        raise ValueError(f"code_m has shape {code_m.shape}, expected {expected}; signal has {len(signal)} channels")
    if record is not None and record.shape != code_m.shape:
        raise ValueError(f"record has shape {record.shape}, expected {code_m.shape}")
    table = prepared_records(navigation)
    plan = table.channels(satellite, signal)
    states = SatelliteStates.empty(code_m.shape)
    observed = np.isfinite(code_m)
    if len(plan.kepler) and len(navigation.kepler):
        _fill_kepler(table, plan, time, code_m, observed, max_age_s, states, record)
    if len(plan.glonass) and len(navigation.glonass):
        _fill_glonass(table, plan, time, code_m, observed, max_age_s, states)
    if navigation.precise is not None:
        _fill_precise(navigation.precise, satellite, time, code_m, observed, states)
    freeze_arrays(states)
    return states


def _limit(validity: NDArray[np.timedelta64], max_age_s: float | None) -> NDArray[np.timedelta64]:
    return validity if max_age_s is None else np.minimum(validity, timedelta(max_age_s))


def _fill_kepler(
    table: PreparedRecords,
    plan: ChannelRecords,
    time: Datetimes,
    code_m: Floats,
    observed: Masks,
    max_age_s: float | None,
    states: SatelliteStates,
    record: Integers | None,
) -> None:
    """Fill in the channels of GPS, QZSS, Galileo and BeiDou."""
    limit = _limit(table.validity, max_age_s)
    rows, valid, future = table.lookup.find(plan.preferred, time, limit)
    if plan.any_other:
        others, other_valid, other_future = table.lookup.find(plan.other, time, limit)
        # A record transmitted before the epoch takes precedence over a record transmitted later.
        better = other_valid & (~valid | (future & ~other_future))
        rows, future, valid = np.where(better, others, rows), np.where(better, other_future, future), valid | better
    channels, newest = plan.kepler, rows
    if record is not None:
        selected = record[:, channels].T
        given = selected >= 0
        valid = np.where(given, np.abs(time - table.lookup.toe[selected]) <= limit[selected], valid)
        future = np.where(given, table.lookup.available[selected] > time, future)
        rows = np.where(given, selected, rows)
    states.record[:, channels] = rows.T
    states.no_record[:, channels] = (rows < 0).T
    seen = observed[:, channels].T & (rows >= 0)
    precise = table.navigation.precise is not None
    usable = seen if precise else seen & valid
    states.too_old[:, channels] = (seen & ~usable).T
    states.future_record[:, channels] = (usable & future).T
    for k, t, row in _groups(rows, usable):
        m, signal = channels[k], plan.signal[k]
        age, clock, ahead = seconds(time[t] - table.lookup.toe[row]), table.clock[:, row], table.toe_after_toc_s[row]
        since_toe = age - code_m[t, m] / SPEED_OF_LIGHT
        since_toe = since_toe - _polynomial(clock, since_toe + ahead)
        place, speed, relativity = kepler_state(table.orbits.take(row), since_toe)
        for i in range(3):
            states.position_ecef_m[t, m, i], states.velocity_ecef_mps[t, m, i] = place[i], speed[i]
        states.clock_m[t, m] = SPEED_OF_LIGHT * (_polynomial(clock, since_toe + ahead) + relativity)
        states.age_s[t, m], states.accuracy_m[t, m] = age, table.navigation.kepler.accuracy_m[row]
        states.group_delay_m[t, m] = SPEED_OF_LIGHT * plan.group_delay_s[signal, row]
        states.unhealthy[t, m] = plan.unhealthy[signal, row]
    if record is not None:
        # Where a correction refers to an older record, the newest record may also flag the signal as unhealthy.
        newest_unhealthy = plan.unhealthy[plan.signal[:, None], np.maximum(newest, 0)] & (newest >= 0)
        states.unhealthy[:, channels] |= newest_unhealthy.T


def _groups(rows: Integers, usable: Masks) -> Iterator[tuple[Any, Any, Integers]]:
    """Yield channels, epochs and record rows to compute together: a short chunk, or epochs of one channel."""
    if rows.shape[1] < _SHORT:
        k, t = np.nonzero(usable)
        if len(k):
            yield k, t, rows[k, t]
        return
    for channel, (row, used) in enumerate(zip(rows, usable, strict=True)):
        at = used.nonzero()[0]
        if not len(at):
            continue
        of_at = row[at]
        edges = ((of_at[1:] != of_at[:-1]).nonzero()[0] + 1).tolist()
        for begin, end in zip([0, *edges], [*edges, len(at)], strict=True):
            for first in range(begin, end, _BLOCK):
                own = at[first : min(first + _BLOCK, end)]
                whole = own[-1] - own[0] == len(own) - 1  # a slice is read and written faster than single rows
                yield channel, slice(own[0], own[-1] + 1) if whole else own, of_at[begin : begin + 1]


def _polynomial(clock: Floats, since_toc_s: Floats) -> Floats:
    return np.asarray(clock[0] + since_toc_s * (clock[1] + since_toc_s * clock[2]))


def _fill_glonass(
    table: PreparedRecords,
    plan: ChannelRecords,
    time: Datetimes,
    code_m: Floats,
    observed: Masks,
    max_age_s: float | None,
    states: SatelliteStates,
) -> None:
    """Fill in the channels of GLONASS; code biases between frequency channels are not corrected."""
    records = table.navigation.glonass
    rows, valid, future = table.glonass_lookup.find(
        plan.glonass_number, time, _limit(table.glonass_validity, max_age_s)
    )
    channels = plan.glonass
    states.record[:, channels] = rows.T
    states.no_record[:, channels] = (rows < 0).T
    seen = observed[:, channels].T & (rows >= 0)
    if table.navigation.precise is None:
        states.too_old[:, channels] = (seen & ~valid).T
    k, t = np.nonzero(seen & valid)
    m, row = channels[k], rows[k, t]
    age = seconds(time[t] - records.toe[row])
    since = age - code_m[t, m] / SPEED_OF_LIGHT
    bias, rate = records.clock_bias_s[row], records.relative_frequency[row]
    since = since - (bias + rate * since)
    position, velocity = table.step_states.state(row, since)
    for i in range(3):
        states.position_ecef_m[t, m, i], states.velocity_ecef_mps[t, m, i] = position[i], velocity[i]
    states.clock_m[t, m] = SPEED_OF_LIGHT * (bias + rate * since)
    states.group_delay_m[t, m] = 0.0
    states.age_s[t, m] = age
    states.future_record[t, m] = future[k, t]
    states.unhealthy[t, m] = records.health[row] != 0


def _fill_precise(
    precise: PreciseEphemeris,
    satellite: Strings,
    time: Datetimes,
    code_m: Floats,
    observed: Masks,
    states: SatelliteStates,
) -> None:
    """Replace broadcast positions and clocks by the positions and clocks of a precise ephemeris."""
    known = {str(s): i for i, s in enumerate(precise.satellite)}
    column = np.array([known.get(s, -1) for s in satellite.tolist()], dtype=np.intp)
    glonass = np.char.startswith(satellite, "R")
    states.group_delay_m[:, glonass] = 0.0
    absent = (column < 0) | (states.no_record.all(axis=0) & ~glonass)
    m, t = np.nonzero(observed.T & ~absent[:, None])
    travel = -code_m[t, m] / SPEED_OF_LIGHT
    # As with broadcast clocks, the time of transmission omits the relativistic correction, which is below 0.4 us.
    clock = precise_clock_s(precise, column[m], time[t], travel)
    position, velocity, clock = precise_state(precise, column[m], time[t], travel - np.nan_to_num(clock))
    missing = np.isnan(position[0]) | np.isnan(clock)
    for values in (states.position_ecef_m, states.velocity_ecef_mps, states.clock_m, states.age_s, states.accuracy_m):
        values[...] = np.nan
    for i in range(3):
        states.position_ecef_m[t, m, i] = np.where(missing, np.nan, position[i])
        states.velocity_ecef_mps[t, m, i] = np.where(missing, np.nan, velocity[i])
    states.clock_m[t, m] = np.where(missing, np.nan, SPEED_OF_LIGHT * clock)
    states.age_s[t, m] = np.where(missing, np.nan, 0.0)
    states.no_record[...] = absent
    states.no_record[t, m] = missing
