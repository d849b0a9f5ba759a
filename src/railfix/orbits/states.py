"""Satellite positions and clocks at the times of transmission, as arrays over (epoch, channel)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from railfix.constants import SPEED_OF_LIGHT
from railfix.epochs import frozen
from railfix.navigation import KeplerRecords, Navigation
from railfix.orbits.glonass import propagate
from railfix.orbits.kepler import GM, ROTATION, Elements, kepler_state
from railfix.orbits.precise import precise_state
from railfix.orbits.selection import (
    VALIDITY_S,
    Lookup,
    find_records,
    group_delay_s,
    kepler_unhealthy,
    make_lookup,
    validity_s,
)
from railfix.timescale import seconds

Floats = NDArray[np.float64]
Masks = NDArray[np.bool_]
Indices = NDArray[np.int64]
Datetimes = NDArray[np.datetime64]


@dataclass(frozen=True, kw_only=True)
class SatelliteStates:
    """Satellites as the receiver's codes saw them, T epochs by M channels.

    NaN where a channel has no code, no record, or only records out of their validity.

    Attributes
    ----------
    position_ecef_m : ndarray, shape (T, M, 3) [m]
        In the Earth-fixed frame of the instant of transmission, not turned to reception.
    velocity_ecef_mps : ndarray, shape (T, M, 3) [m/s]
    clock_m : ndarray, shape (T, M) [m]
        c times the satellite clock, relativity included, group delay not.
    group_delay_m : ndarray, shape (T, M) [m]
        Of the channel's signal: corrected code = code + clock_m - group_delay_m - delays.
    age_s : ndarray, shape (T, M) [s]
        Epoch less the record's reference time, signed; 0 for a precise ephemeris.
    accuracy_m : ndarray, shape (T, M) [m]
        As broadcast.
    record : ndarray of int, shape (T, M)
        Row of the record table of the constellation, -1 where there is none.
    no_record : ndarray of bool, shape (T, M)
        There is no record of the satellite at all.
    too_old : ndarray of bool, shape (T, M)
        There are records, but none valid at the epoch.
    unhealthy : ndarray of bool, shape (T, M)
        The record used calls the signal unhealthy.
    future_record : ndarray of bool, shape (T, M)
        The record used was transmitted after the epoch: right after the fact, not live.
    """

    position_ecef_m: Floats
    velocity_ecef_mps: Floats
    clock_m: Floats
    group_delay_m: Floats
    age_s: Floats
    accuracy_m: Floats
    record: Indices
    no_record: Masks
    too_old: Masks
    unhealthy: Masks
    future_record: Masks

    def __post_init__(self) -> None:
        for item in fields(self):
            object.__setattr__(self, item.name, frozen(getattr(self, item.name)))


class _Table:
    """What is prepared once for a `Navigation`: lookups, and record columns as one array each."""

    def __init__(self, navigation: Navigation) -> None:
        kepler, glonass = navigation.kepler, navigation.glonass
        self.kepler = kepler
        self.validity_s = validity_s(kepler)
        system = kepler.satellite.astype("<U1")
        galileo = system == "E"
        rows = np.arange(len(kepler))
        # Galileo: the message that belongs to the band first, the other one where it is all there is.
        self.by_message = {
            message: make_lookup(
                kepler,
                rows[~galileo | (kepler.message == message)],
                self.validity_s[~galileo | (kepler.message == message)],
            )
            for message in ("INAV", "FNAV")
        }
        self.glonass = make_lookup(glonass, np.arange(len(glonass)), np.full(len(glonass), VALIDITY_S["R"]))
        names = [item.name for item in fields(Elements) if item.name not in ("gm", "rotation", "geo")]
        self.elements = np.stack([getattr(kepler, name) for name in names])
        self.gm = np.array([GM.get(s, np.nan) for s in system.tolist()], dtype=np.float64)
        self.rotation = np.array([ROTATION.get(s, np.nan) for s in system.tolist()], dtype=np.float64)
        self.geo = kepler.message == "D2"
        self.clock = np.stack([kepler.af0_s, kepler.af1, kepler.af2])
        self.group_delay = {band: group_delay_s(kepler, band) for band in "125678"}
        self.unhealthy = {band: kepler_unhealthy(kepler, band) for band in "125678"}

    def take(self, rows: Indices) -> Elements:
        names = [item.name for item in fields(Elements)]
        values = [*self.elements[:, rows], self.gm[rows], self.rotation[rows], self.geo[rows]]
        return Elements(**dict(zip(names, values, strict=True)))


@lru_cache(maxsize=8)
def _table(navigation: Navigation) -> _Table:
    return _Table(navigation)


def satellite_states(
    time: Datetimes,
    satellite: NDArray[np.str_],
    signal: NDArray[np.str_],
    code_m: Floats,
    navigation: Navigation,
    *,
    max_age_s: float | None = None,
) -> SatelliteStates:
    """Satellites at the instants of transmission ``time - code / c - dt_sv``.

    The receiver clock is in the time tag and in the code alike, so the instant needs no estimate
    of it.

    Parameters
    ----------
    time : ndarray of datetime64[ns], shape (T,)
        Receiver time tags.
    satellite, signal : ndarray of str, shape (M,)
    code_m : ndarray, shape (T, M) [m]
        NaN where not observed.
    navigation : Navigation
        With `precise` set, positions and clocks come from there, and a satellite that it does not
        have has no record; health still comes from broadcast records where there are any.
    max_age_s : float, optional
        Tighter limit on the distance from toe than the records' own validity [s].

    Returns
    -------
    SatelliteStates
    """
    table = _table(navigation)
    shape = code_m.shape
    out = {name: np.full(shape, np.nan) for name in ("clock_m", "group_delay_m", "age_s", "accuracy_m")}
    out["position_ecef_m"], out["velocity_ecef_mps"] = np.full((2, *shape, 3), np.nan)
    record = np.full(shape, -1, dtype=np.int64)
    masks = {name: np.zeros(shape, dtype=bool) for name in ("too_old", "unhealthy", "future_record")}

    letters, bands = satellite.astype("<U1"), np.array([s[0] for s in signal.tolist()], dtype="<U1")
    kepler = np.flatnonzero(np.isin(letters, list(GM)))
    glonass = np.flatnonzero(letters == "R")
    if len(kepler):
        _kepler(table, navigation.kepler, time, satellite, bands, kepler, code_m, max_age_s, out, record, masks)
    if len(glonass):
        _glonass(table, navigation, time, satellite, glonass, code_m, max_age_s, out, record, masks)
    no_record = record < 0
    if navigation.precise is not None:
        no_record = _precise(navigation, time, satellite, code_m, out)
    return SatelliteStates(record=record, no_record=no_record, **masks, **out)


def _kepler_rows(
    table: _Table, time: Datetimes, satellite: NDArray[np.str_], bands: NDArray[np.str_]
) -> tuple[Indices, Masks]:
    """Record of each epoch and channel; Galileo by the message that carries the band's clock."""
    rows, future = np.empty((2, len(time), len(satellite)), dtype=np.int64)
    preferred = np.where((np.char.startswith(satellite, "E")) & (bands == "5"), "FNAV", "INAV")
    for message, other in (("INAV", "FNAV"), ("FNAV", "INAV")):
        at = np.flatnonzero(preferred == message)
        if not len(at):
            continue
        rows[:, at], future[:, at] = find_records(table.by_message[message], satellite[at], time)
        without = at[[s not in table.by_message[message].first for s in satellite[at].tolist()]]
        if len(without):
            rows[:, without], future[:, without] = find_records(table.by_message[other], satellite[without], time)
    return rows, future.astype(bool)


def _kepler(
    table: _Table,
    kepler: KeplerRecords,
    time: Datetimes,
    satellite: NDArray[np.str_],
    bands: NDArray[np.str_],
    columns: NDArray[np.intp],
    code_m: Floats,
    max_age_s: float | None,
    out: dict[str, Floats],
    record: Indices,
    masks: dict[str, Masks],
) -> None:
    """Fill in the channels of GPS, QZSS, Galileo and BeiDou."""
    rows, future = _kepler_rows(table, time, satellite[columns], bands[columns])
    record[:, columns] = rows
    observed = np.isfinite(code_m[:, columns]) & (rows >= 0)
    t, k = np.nonzero(observed)
    row = rows[t, k]
    age = seconds(time[t] - kepler.toe[row])
    limit = table.validity_s[row] if max_age_s is None else np.minimum(table.validity_s[row], max_age_s)
    valid = np.abs(age) <= limit
    masks["too_old"][t[~valid], columns[k[~valid]]] = True
    t, k, row, age = t[valid], k[valid], row[valid], age[valid]
    m = columns[k]
    travel = -code_m[t, m] / SPEED_OF_LIGHT
    since_toc = seconds(time[t] - kepler.toc[row]) + travel
    offset = _polynomial(table.clock[:, row], since_toc)
    since_toc -= offset
    since_toe = age + travel - offset
    position, velocity, relativity = kepler_state(table.take(row), since_toe)
    out["position_ecef_m"][t, m], out["velocity_ecef_mps"][t, m] = position, velocity
    out["clock_m"][t, m] = SPEED_OF_LIGHT * (_polynomial(table.clock[:, row], since_toc) + relativity)
    out["age_s"][t, m], out["accuracy_m"][t, m] = age, kepler.accuracy_m[row]
    masks["future_record"][t, m] = future[t, k]
    for band in np.unique(bands[columns]).tolist():
        here = bands[m] == band
        out["group_delay_m"][t[here], m[here]] = SPEED_OF_LIGHT * table.group_delay[band][row[here]]
        masks["unhealthy"][t[here], m[here]] = table.unhealthy[band][row[here]]


def _polynomial(clock: Floats, since_toc_s: Floats) -> Floats:
    return np.asarray(clock[0] + since_toc_s * (clock[1] + since_toc_s * clock[2]))


def _glonass(
    table: _Table,
    navigation: Navigation,
    time: Datetimes,
    satellite: NDArray[np.str_],
    columns: NDArray[np.intp],
    code_m: Floats,
    max_age_s: float | None,
    out: dict[str, Floats],
    record: Indices,
    masks: dict[str, Masks],
) -> None:
    """Fill in the channels of GLONASS; its code biases between channels are left as they are."""
    records = navigation.glonass
    rows, future = find_records(table.glonass, satellite[columns], time)
    record[:, columns] = rows
    t, k = np.nonzero(np.isfinite(code_m[:, columns]) & (rows >= 0))
    row = rows[t, k]
    age = seconds(time[t] - records.toe[row])
    valid = np.abs(age) <= (VALIDITY_S["R"] if max_age_s is None else min(VALIDITY_S["R"], max_age_s))
    masks["too_old"][t[~valid], columns[k[~valid]]] = True
    t, k, row, age = t[valid], k[valid], row[valid], age[valid]
    m = columns[k]
    since = age - code_m[t, m] / SPEED_OF_LIGHT
    bias, rate = records.clock_bias_s[row], records.relative_frequency[row]
    since -= bias + rate * since
    position, velocity = propagate(
        records.position_ecef_m[row], records.velocity_ecef_mps[row], records.acceleration_ecef_mps2[row], since
    )
    out["position_ecef_m"][t, m], out["velocity_ecef_mps"][t, m] = position, velocity
    out["clock_m"][t, m] = SPEED_OF_LIGHT * (bias + rate * since)
    out["group_delay_m"][t, m] = 0.0
    out["age_s"][t, m] = age
    masks["future_record"][t, m] = future[t, k]
    masks["unhealthy"][t, m] = records.health[row] != 0


def _precise(
    navigation: Navigation, time: Datetimes, satellite: NDArray[np.str_], code_m: Floats, out: dict[str, Floats]
) -> Masks:
    """Replace positions and clocks by the precise ones; returns which channels have none."""
    precise = navigation.precise
    if precise is None:
        raise ValueError("no precise ephemeris is given")
    known = {str(s): i for i, s in enumerate(precise.satellite)}
    column = np.array([known.get(s, -1) for s in satellite.tolist()], dtype=np.intp)
    t, m = np.nonzero(np.isfinite(code_m))
    travel = -code_m[t, m] / SPEED_OF_LIGHT
    _, _, clock = precise_state(precise, column[m], time[t], travel)
    position, velocity, clock = precise_state(precise, column[m], time[t], travel - np.nan_to_num(clock))
    missing = np.isnan(position[:, 0]) | np.isnan(clock)
    out["position_ecef_m"][t, m] = np.where(missing[:, None], np.nan, position)
    out["velocity_ecef_mps"][t, m] = np.where(missing[:, None], np.nan, velocity)
    out["clock_m"][t, m] = np.where(missing, np.nan, SPEED_OF_LIGHT * clock)
    out["age_s"][t, m] = np.where(missing, np.nan, 0.0)
    no_record = np.zeros(code_m.shape, dtype=bool)
    no_record[t, m] = missing
    return no_record
